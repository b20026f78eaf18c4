"""What the host's machines do when nothing is left to do, and with messages that fit nowhere."""

from __future__ import annotations

import pytest

from flasher import events
from flasher.host.duplicates import SECOND_DEVICE_WAIT_S
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.query import Queries, Request
from flasher.host.session import UpgradeSession
from flasher.host.table import UpgradeState
from flasher.host.verify import Level, memory_check, version_check
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Ack, Complete, Packet
from flasher.protocol.spec import BMS, WELLING, WMC
from flasher.protocol.wire import Message, encode, split
from tests.host.bench import Bench

VERSION = Request(BY_KEY[0x752, 0x3300])
PLAN = plan(Image.from_bytes(bytes(300), base=0x0800_0000), BMS, WELLING.bitrate_bps)


def test_messages_that_are_malformed_or_unknown_are_reported_by_command_and_id() -> None:
    """FR-10."""
    bench = Bench()
    bench.to_packet(1)
    bench.say(Message(0x725, 0x16, 0xC202, b"\x01\x00"), Message(0x725, 0x0C, 0x7702, b"\x00\x00"))
    noted = [event.what for event in bench.events if isinstance(event, events.Reported)]
    assert noted == [
        "message C202 from 725 ignored: mode is 16, not 0C",
        "unknown message 7702 from 725 ignored",
    ]
    bench.say(Ack(1))
    assert bench.expect(Packet).number == 2


def test_an_answer_before_the_packet_has_left_is_none() -> None:
    bench = Bench(options=UpgradeOptions(packet_gap_s=0.1))
    bench.to_packet(1)
    bench.say(Ack(1))
    bench.say(Ack(2))
    assert bench.expect(Packet).number == 2
    bench.wait(0.3)
    assert bench.unread == []


def test_a_deadline_in_the_middle_of_a_message_lets_it_end() -> None:
    bench = Bench(options=UpgradeOptions(timeout_s=2.0, frame_gap_s=0.08))
    bench.wait(60.0)
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED
    assert bench.engine.state is UpgradeState.DONE
    bench.engine.tick(bench.now)
    assert bench.engine.deadline() is None


def test_a_query_that_is_done_does_nothing_more() -> None:
    query = Queries([VERSION], bitrate_bps=WELLING.bitrate_bps)
    query.cancel(0.0)
    query.cancel(1.0)
    query.tick(2.0)
    query.receive(Frame(0x720, b"\x55\xaa"), 3.0)
    assert query.done
    assert query.queries[0].cancelled
    assert query.deadline() is None
    assert query.next_frame(4.0) is None


def test_queries_that_are_done_do_nothing_more() -> None:
    queries = Queries([], bitrate_bps=WELLING.bitrate_bps)
    assert queries.done
    queries.tick(0.0)
    queries.receive(Frame(0x720, b"\x55\xaa"), 0.0)
    queries.frame_sent(0.0)
    queries.cancel(0.0)
    assert queries.take_events() == []
    assert queries.deadline() is None
    assert queries.next_frame(0.0) is None
    assert queries.answers == []


def test_a_check_that_is_done_does_nothing_more() -> None:
    check = version_check(PLAN, UpgradeOptions())
    check.tick(0.0)
    check.cancel(0.0)
    check.tick(1.0)
    check.frame_sent(1.0)
    check.receive(Frame(0x720, b"\x55\xaa"), 1.0)
    assert check.done


def test_a_session_states_where_it_is_in_the_upgrade_and_in_the_check() -> None:
    bench = Bench(100)
    session = UpgradeSession(plan(bench.image, BMS, WELLING.bitrate_bps), level=Level.VERSION)
    bench.engine = session  # type: ignore[assignment]
    bench.sent.clear()
    bench._step()
    stands = [(session.progress, session.device_left)]
    bench.wait(LISTEN_FIRST_S)
    stands.append((session.progress, session.device_left))
    bench.to_end()
    stands.append((session.progress, session.device_left))
    bench.say(Complete())
    stands.append((session.progress, session.device_left))
    bench.wait(SECOND_DEVICE_WAIT_S)
    stands.append((session.progress, session.device_left))
    assert stands == [
        ("listening for another tool", DeviceLeft.UNTOUCHED),
        ("resetting the application", DeviceLeft.UNTOUCHED),
        ("waiting for the final answer", DeviceLeft.UNKNOWN),
        ("listening for a second device", DeviceLeft.NEW),
        ("verifying by version", DeviceLeft.NEW),
    ]
    session.cancel(bench.now)
    bench.wait(1.0)
    assert session.done


def test_a_memory_check_that_is_cancelled_between_two_pieces_asks_no_more() -> None:
    check = memory_check(PLAN, UpgradeOptions(), None)
    check.tick(0.0)
    while check.next_frame(0.0) is not None:
        check.frame_sent(0.0)
    check.cancel(0.01)
    piece = (0x0800_0000).to_bytes(4, "little") + (0x0800_0080).to_bytes(4, "little") + bytes(128)
    for frame in split(0x725, encode(Message(0x725, 0x0C, 0x5688, piece))):
        check.receive(frame, 0.02)
    assert check.done
    assert not check.result.ok


def test_a_version_check_needs_somebody_to_ask() -> None:
    other = plan(Image.from_bytes(bytes(10)), WMC, WELLING.bitrate_bps)
    with pytest.raises(ValueError, match="no version query"):
        version_check(other, UpgradeOptions()).tick(0.0)
