"""Names of items from the catalogue, and a survey step by step."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.errors import UsageError
from flasher.host.items import check_date, readable, writable
from flasher.host.query import Request
from flasher.host.survey import Survey
from flasher.protocol.catalogue import BY_KEY, decode
from flasher.protocol.contents import BatteryFault, Faults
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, MOTINOVA, OBC, WELLING, WMC, Dialect, Node, Target
from flasher.protocol.wire import Message
from tests.loops import each
from tests.peers.wording import build, payloads

BOTH = pytest.mark.parametrize("dialect", [WELLING, MOTINOVA], ids=lambda d: d.name)


@BOTH
def test_the_names_are_those_of_the_document(dialect: Dialect) -> None:
    assert {name: entry.item.command for name, entry in readable(BMS, dialect).items()} == {
        "physical-id": 0x3000,
        "check-code": 0x3100,
        "version-information": 0x3300,
        "running-information": 0x3400,
        "cell-voltages": 0x3500,
        "design-information": 0x3600,
        "production-information": 0x3700,
        "history": 0x3800,
        "user-string-1": 0x3900,
        "user-string-2": 0x3B00,
        "user-string-3": 0x3D00,
        "model": 0x3300,
        "serial-number": 0x3300,
    }


@BOTH
def test_everything_that_can_be_written_can_be_read_back(dialect: Dialect) -> None:
    items = writable(BMS, dialect)
    assert {name: entry.item.command for name, entry in items.items()} == {
        "check-code": 0x320C,
        "user-string-1": 0x3A10,
        "user-string-2": 0x3C10,
        "user-string-3": 0x3E10,
        "production-information": 0x3F20,
        "model": 0x4010,
        "serial-number": 0x4110,
    }
    assert [entry.read_back.item.command for entry in items.values()] == [
        0x3100,
        0x3900,
        0x3B00,
        0x3D00,
        0x3700,
        0x3300,
        0x3300,
    ]
    reserved = {name for name, entry in items.items() if entry.item.manufacturer_only}
    assert reserved == {"production-information", "model", "serial-number"}


@each("target", [WMC, OBC])
def test_the_documents_give_nothing_for_the_others(target: Target) -> None:
    assert readable(target, MOTINOVA) == {}
    assert writable(target, MOTINOVA) == {}


@each("text", ["20240229", "2024-02-29"])
def test_a_leap_day_is_a_date(text: str) -> None:
    assert check_date(text) == "20240229"


@each(
    "text",
    ["20230229", "20261301", "20260100", "00000101", "2026W101", "260517", "", "\uff120260517"],
)
def test_what_no_calendar_has_is_no_date(text: str) -> None:
    with pytest.raises(UsageError, match="date"):
        check_date(text)


# -- survey ----------------------------------------------------------------------------------------


def survey(*, listen_s: float = 1.0) -> Survey:
    request = Request(BY_KEY[0x752, 0x3300])
    return Survey([request], listen_s=listen_s, bitrate_bps=250_000, dialect=WELLING)


def test_nothing_is_sent_while_it_listens() -> None:
    engine = survey()
    engine.tick(0.0)
    assert engine.deadline() == 1.0
    engine.tick(0.99)
    assert engine.next_frame(0.99) is None
    engine.tick(1.0)
    frame = engine.next_frame(1.0)
    assert frame is not None
    assert (frame.can_id, frame.data[4:6].hex()) == (0x752, "3300")


def test_what_is_received_while_listening_belongs_to_its_sender() -> None:
    engine = survey()
    engine.tick(0.0)
    for part in payloads(build(0x732, 0x11, 0x5000, b"")):
        engine.receive(Frame(0x732, part), 0.1)
    assert engine.heard[Node.OBC].messages == {"732 5000 read running information": 1}
    assert engine.heard[Node.OBC].frames == 2


@each(
    "message, title, is_in_dialect",
    [
        ((0x720, 0x0C, 0x1204, bytes((4, 0, 1, 0))), "720 1204 faults", True),
        ((0x740, 0x0C, 0x1305, b"READY"), "740 1305 ready for shutdown", False),
        ((0x725, 0x0C, 0xC109, b"BMSV1.2.3"), "725 C109 boot version", True),
        ((0x720, 0x0C, 0x9901, b"?"), "720 9901 (not in the documents)", True),
    ],
)
def test_a_message_is_named_and_its_last_content_kept(
    message: tuple[int, int, int, bytes], title: str, *, is_in_dialect: bool
) -> None:
    engine = survey()
    engine.tick(0.0)
    for data in (message[3], message[3]):
        for part in payloads(build(*message[:3], data)):
            engine.receive(Frame(message[0], part), 0.1)
    (heard,) = engine.heard.values()
    assert heard.messages == {title: 2}
    assert heard.not_in_dialect == (set() if is_in_dialect else {title})
    decoded = decode(Message(*message))
    assert heard.last == ({} if decoded is None else {title: decoded.content})


def heard(engine: Survey, can_id: int, mode: int, command: int, data: bytes) -> None:
    for part in payloads(build(can_id, mode, command, data)):
        engine.receive(Frame(can_id, part), 0.1)


def test_all_faults_of_the_battery_are_kept_together() -> None:
    engine = survey()
    engine.tick(0.0)
    assert survey().faults is None
    heard(engine, 0x720, 0x0C, 0x1204, bytes((4, 0, 1, 0)))
    assert engine.faults == Faults(BatteryFault(0x00010004))
    heard(engine, 0x720, 0x0C, 0x1204, bytes((8, 0, 0, 0)))
    assert engine.faults == Faults(BatteryFault(0x0001000C))


@each(
    "message, dialect, why",
    [
        ((0x740, 0x0C, 0x1305, b"READY"), MOTINOVA, "a display unit (HMI) sends"),
        ((0x725, 0x0C, 0xC109, b"BMSV1.2.3"), WELLING, "a bootloader announces itself"),
        ((0x710, 0x0C, 0x1808, b"SHUTDOWN"), WELLING, "the WMC sent 'SHUTDOWN'"),
        ((0x720, 0x0C, 0x1204, bytes((4, 0, 1, 0))), None, "the same in both dialects"),
        ((0x720, 0x0C, 0x1308, b"SHUTDOWN"), None, "the same in both dialects"),
    ],
)
def test_the_dialect_is_guessed_by_what_only_one_of_the_two_has(
    message: tuple[int, int, int, bytes], dialect: Dialect | None, why: str
) -> None:
    engine = survey()
    engine.tick(0.0)
    assert engine.guess_dialect()[0] is None
    heard(engine, *message)
    guessed, reason = engine.guess_dialect()
    assert guessed is dialect
    assert why in reason


def test_the_announcement_of_a_bootloader_is_kept() -> None:
    engine = survey()
    engine.tick(0.0)
    heard(engine, 0x725, 0x0C, 0xC109, b"BMSV1.2.3")
    assert engine.heard[Node.BMS].boot_version == "BMS V1.2.3"
    heard(engine, 0x725, 0x0C, 0xC202, b"\1\0")
    assert engine.heard[Node.BMS].boot_version == "BMS V1.2.3"


@each("is_heard, asked", [(False, 3), (True, 5)])
def test_a_device_that_is_silent_to_three_questions_is_asked_no_more(
    *, is_heard: bool, asked: int
) -> None:
    requests = [Request(BY_KEY[0x752, command]) for command in (0x3300, 0x3400, 0x3500, 0x3600,
                                                                0x3700)]  # fmt: skip
    engine = Survey(requests, listen_s=0.0, bitrate_bps=250_000, dialect=WELLING)
    engine.tick(0.0)
    if is_heard:
        engine.receive(Frame(0x720, b"\x05"), 0.0)
    now = 0.0
    while not engine.done:
        while engine.next_frame(now) is not None:
            engine.frame_sent(now)
        wanted = engine.deadline()
        assert wanted is not None
        now = max(now, wanted)
        engine.tick(now)
    assert len(engine.queries) == asked
    assert not engine.cancelled


def test_a_tool_that_is_detected_while_listening_is_not_disturbed_by_questions() -> None:
    engine = survey()
    engine.tick(0.0)
    engine.receive(Frame(0x752, bytes.fromhex("55AA1687A3850101")), 0.5)
    engine.tick(1.0)
    assert engine.next_frame(1.0) is None
    assert engine.done
    assert engine.other_tool_heard
    assert engine.queries == []


def test_damage_is_counted_and_nothing_is_made_of_it() -> None:
    engine = survey()
    engine.tick(0.0)
    wire = bytearray(build(0x720, 0x0C, 0x1308, b"SHUTDOWN"))
    wire[8] ^= 1
    for part in payloads(bytes(wire)):
        engine.receive(Frame(0x720, part), 0.1)
    engine.tick(0.3)
    assert engine.heard[Node.BMS].damaged == 1
    assert engine.heard[Node.BMS].messages == {}


def test_cancelled_while_listening_it_is_done_and_has_sent_nothing() -> None:
    engine = survey()
    engine.tick(0.0)
    engine.cancel(0.1)
    assert engine.done
    assert engine.cancelled
    assert engine.next_frame(0.1) is None


def test_the_echo_of_an_own_frame_is_no_other_tool_but_a_second_one_is() -> None:
    engine = survey(listen_s=0.0)
    engine.tick(0.0)
    engine.tick(0.0)
    question = []
    while (frame := engine.next_frame(0.0)) is not None:
        question.append(frame)
        engine.frame_sent(0.0)
    assert len(question) == 2
    for frame in question:
        engine.receive(frame._replace(is_echo=True), 0.001)
    assert engine.heard == {}
    for frame in question:
        engine.receive(frame, 0.002)
    assert set(engine.heard) == {Node.CDL}
    for frame in question:
        engine.receive(frame._replace(is_echo=True), 0.003)
    assert engine.heard[Node.CDL].messages.total() == 1


def test_cancelled_in_a_question_it_is_done_and_reported_as_cancelled() -> None:
    engine = survey(listen_s=0.0)
    engine.tick(0.0)
    engine.tick(0.0)
    assert engine.queries
    assert not engine.cancelled
    engine.cancel(0.1)
    assert engine.done
    assert engine.cancelled


def test_frames_that_the_documents_do_not_give_are_counted() -> None:
    engine = survey()
    engine.tick(0.0)
    engine.receive(Frame(0x720, b"\x55"), 0.1)
    assert engine.foreign_frames == 0
    engine.receive(Frame(0x1FF, b"\x55"), 0.1)
    engine.receive(Frame(0x720, b"", is_remote=True), 0.1)
    assert engine.foreign_frames == 2
    assert engine.heard[Node.BMS].frames == 1
    assert not engine.other_tool_heard


FRAMES = st.lists(
    st.tuples(st.integers(0x6F0, 0x7FF), st.binary(max_size=8), st.floats(0, 0.05)), max_size=60
)


@given(FRAMES)
def test_no_traffic_whatever_stops_it_from_ending(
    traffic: list[tuple[int, bytes, float]],
) -> None:
    engine = survey(listen_s=0.1)
    now = 0.0
    for can_id, data, gap_s in traffic:
        now += gap_s
        engine.tick(now)
        engine.receive(Frame(can_id, data), now)
    for _ in range(1000):
        now = max(now, engine.deadline() or now)
        engine.tick(now)
        while engine.next_frame(now) is not None:
            engine.frame_sent(now)
        if engine.done:
            break
    assert engine.done
    assert now < 60 * 0.05 + 0.1 + 1.1
