"""docs/explanation/architecture.md is true of the code: its drawing, its packages, one packet."""

from __future__ import annotations

import re
import sys
import uuid
from collections import Counter
from itertools import pairwise
from pathlib import Path
from threading import Event as Flag
from threading import Thread
from types import FrameType

import pytest

from flasher import events
from flasher.bus.adapter import open_adapter
from flasher.bus.link import MonotonicClock
from flasher.driver import drive
from flasher.host.session import UpgradeSession
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.spec import BMS, WELLING
from tests import architecture

TEXT = architecture.PAGE.read_text(encoding="utf-8")
PACKAGE = str(Path(__file__).parents[1] / "flasher") + "/"
CALLS_MAX = 250
HOPS = [11, 12]


@pytest.mark.slow
def test_the_drawing_is_that_of_the_imports_and_every_package_is_in_the_table() -> None:
    assert architecture.page(TEXT) == TEXT, "draw it anew: python -m tests.architecture"
    named = set(re.findall(r"`(\w+)(?:/|\.py)`", TEXT))
    assert set(architecture.imports()) - named == set()


@pytest.mark.slow
def test_no_package_imports_itself_by_way_of_others() -> None:
    edges = architecture.imports()
    assert [name for name in edges if name in architecture._reached(edges, name)] == []


class Calls:
    """Counts the calls of the host between two acknowledged packets."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self.at: list[Counter[tuple[str, str]]] = []

    def profile(self, frame: FrameType, event: str, _argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE):
            self.counts[code.co_filename.removeprefix(PACKAGE), code.co_qualname] += 1

    def on_event(self, event: object) -> None:
        if isinstance(event, events.PacketAcknowledged):
            self.at.append(self.counts.copy())

    @property
    def of_a_packet(self) -> Counter[tuple[str, str]]:
        """Of the cheapest packet: a computer that is busy lets frames come one by one."""
        # The last one is followed by end of transfer.
        steps = [later - earlier for earlier, later in pairwise(self.at[3:-1])]
        return min(steps, key=lambda step: step.total())


def calls_of_a_packet() -> Counter[tuple[str, str]]:
    channel, calls, finished = uuid.uuid4().hex, Calls(), Flag()
    links = [
        open_adapter(WELLING.bitrate_bps, interface="virtual", channel=channel) for _ in range(2)
    ]
    instant = DeviceProfile(erase_time_s=0.0, program_time_s=0.0)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=instant)
    serving = Thread(
        target=drive,
        args=(device, links[1], MonotonicClock()),
        kwargs={"cancelled": finished.is_set},
    )
    serving.start()
    session = UpgradeSession(plan(Image.from_bytes(bytes(128 * 30)), BMS, WELLING.bitrate_bps))
    before = sys.getprofile()
    sys.setprofile(calls.profile)
    try:
        drive(session, links[0], MonotonicClock(), on_event=calls.on_event)
    finally:
        sys.setprofile(before)
        finished.set()
        serving.join()
        for link in links:
            link.close()
    assert session.result.ok
    return calls.of_a_packet


@pytest.mark.slow
def test_the_way_of_one_packet_is_as_short_as_it_is_written() -> None:
    way = TEXT[TEXT.index("## The way of one packet") : TEXT.index("## Where to add")]
    down, back = way.split("Back, when")
    hops = [re.findall(r"^\d+\. `([\w.]+)`", part, re.MULTILINE) for part in (down, back)]
    assert [len(part) for part in hops] == HOPS
    calls = calls_of_a_packet()
    called = {name for _, name in calls}
    assert [hop for part in hops for hop in part if hop not in called] == []
    assert calls.total() <= CALLS_MAX, calls.most_common(12)
