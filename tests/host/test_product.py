"""Settings of a product: its own reset (R3), its own version query."""

from __future__ import annotations

from flasher.host.options import UpgradeOptions
from flasher.host.session import UpgradeSession
from flasher.host.table import Ending
from flasher.host.verify import Level, possible_levels
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.messages import GeneralFeedbackMessage, UpdateCommand
from flasher.protocol.spec import WMC
from flasher.protocol.wire import Message
from flasher.settings.profile import VersionQuery
from tests.host.bench import Bench

QUERY = VersionQuery(
    command=0x3000, answer_id=0x715, answer_command=0x6012, offset=2, size_bytes=16
)
VERSION = "V2r0r1_20260102"


def test_the_products_own_reset_is_sent() -> None:
    bench = Bench(options=UpgradeOptions(reset_command=0x4F04, reset_data=b"BOOT"))
    assert bench.expect(Message) == Message(0x752, 0x16, 0x4F04, b"BOOT")
    bench.say(GeneralFeedbackMessage())
    bench.wait(0.5)
    assert bench.unread == []


def test_a_version_query_of_the_products_own_decides_a_lost_final_answer() -> None:
    image = Image.from_bytes(VERSION.encode() + bytes(100))
    options = UpgradeOptions(version_request=QUERY.request(WMC), allow_boot_name=True)
    bench = Bench(image=image, target=WMC, options=options)
    bench.to_end()
    bench.wait(31.0)
    assert Message(0x751, 0x11, 0x3000, b"") in bench.unread
    bench.say(Message(0x715, 0x0C, 0x6012, b"\x01\x02" + VERSION.encode() + b"."))
    assert bench.outcome.ending is Ending.CONFIRMED_BY_VERSION
    assert bench.outcome.running_version == VERSION
    assert not any(isinstance(row, UpdateCommand) for row in bench.unread)


def test_with_a_version_query_of_its_own_any_target_can_be_verified() -> None:
    options = UpgradeOptions(version_request=QUERY.request(WMC))
    assert possible_levels(WMC) == (Level.NONE,)
    assert possible_levels(WMC, options) == (Level.NONE, Level.VERSION)
    image = Image.from_bytes(bytes(10))
    session = UpgradeSession(plan(image, WMC, 250_000), options, Level.VERSION)
    assert not session.done
