"""Who speaks with the tool's id: an echo of what was sent, or somebody else."""

from __future__ import annotations

from flasher import events
from flasher.bus.echoes import Echoes
from flasher.host.guard import ForeignFrame, Guard
from flasher.protocol.frame import Frame
from flasher.protocol.messages import UpdateCommand
from flasher.protocol.spec import BMS, OBC, TARGETS, Target
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, encode, split
from tests.loops import each

OWN = [Frame(0x752, bytes([number] * 8)) for number in range(18)]
OTHER = Frame(0x752, bytes.fromhex("55AA160742055245"))


class MarkedGuard(Guard):
    """A guard on a link that marks the echoes of what it has sent."""

    def __init__(self, target: Target) -> None:
        super().__init__(target, DEFAULT_TIMINGS)
        self.link = Echoes()

    def see(self, frame: Frame, now: float) -> ForeignFrame | None:
        return super().see(self.link.mark(frame, now, is_rx=True), now)


def guard(target: Target = BMS) -> MarkedGuard:
    return MarkedGuard(target)


def sent(frames: list[Frame]) -> MarkedGuard:
    """A guard whose link has sent these frames."""
    made = guard()
    for frame in frames:
        made.link.sent(frame)
    return made


@each("step", [2, 3, 7])
def test_echoes_of_which_some_are_missing_are_no_second_tool(step: int) -> None:
    made = sent(OWN)
    assert all(made.see(frame, 1.01) is None for frame in OWN[::step])


def test_a_frame_that_was_not_sent_is_from_another_sender_and_is_reported_in_hex() -> None:
    found = sent(OWN).see(OTHER, 1.01)
    assert found is not None
    assert "55 aa 16 07" in found.description
    assert "0x752" in found.description
    assert found.query is None


def test_nothing_sent_at_all_and_somebody_speaks() -> None:
    assert guard().see(OWN[0], 1.0) is not None


READ_MEMORY = split(0x752, encode(Message(0x752, 0x11, 0x4308, bytes(8))))
WRITE = split(0x752, encode(Message(0x752, 0x16, 0x3A10, bytes(16))))
PACKET = split(0x752, encode(Message(0x752, 0x16, 0xA385, bytes(133))))
TAILS = [
    *READ_MEMORY[1:],
    Frame(0x752, READ_MEMORY[-1].data.ljust(8, b"\xff")),
    Frame(0x752, b"\x55\xaa\xf0"),  # its CRC ends as a header begins
    *WRITE[1:],
]


def test_a_foreign_query_is_harmless_and_named() -> None:
    assert guard().see(READ_MEMORY[0], 1.0) == ForeignFrame(
        SEEN % "55 aa 11 0a 43 08 00 00", True, 0x4308
    )


SEEN = "frame %s with id 0x752, not sent by this tool"


@each("frame", [WRITE[0], PACKET[0], Frame(0x752, b"\x55\xaa\x0c" + bytes(5))])
def test_every_other_foreign_message_is_not_harmless(frame: Frame) -> None:
    found = guard().see(frame, 1.0)
    assert found is not None
    assert not found.is_harmless


@each("frame", TAILS)
def test_a_frame_that_begins_no_message_is_not_judged_by_itself(frame: Frame) -> None:
    """Its beginning was, or got lost, as when the adapter was away for a moment."""
    found = guard().see(frame, 1.0)
    assert found is not None
    assert found.is_harmless
    assert found.query is None


@each("target", TARGETS.values())
def test_an_update_command_of_another_size_is_no_echo_of_the_own_one(target: Target) -> None:
    """Its first frame is equal, and two frames may be the rest of a query."""

    def update(size_bytes: int) -> list[Frame]:
        row = UpdateCommand(target.update_text, size_bytes)
        return split(target.request_id, encode(row.to_message(target.request_id)))

    made = guard(target)
    for frame in update(0x12345):
        made.link.sent(frame)
    found = [made.see(frame, 1.0) for frame in update(0x12344)]
    assert found[0] is None
    assert found[1] is not None
    assert not found[1].is_harmless


def test_an_adapter_without_echoes_hides_no_second_tool() -> None:
    """Packets of another image: the frames that begin a packet differ in their number or bytes."""
    made = sent(OWN)
    other = [Frame(0x752, bytes([99, number] * 4)) for number in range(18)]
    assert made.see(other[0], 1.01) is not None


@each(
    "frame",
    [
        Frame(0x752, b"", is_remote=True),
        Frame(0x752, b"\x01", is_extended=True),
        Frame(0x752, b"\x01", is_error=True),
        Frame(0x752, b""),
        Frame(0x751, b"\x01"),
        Frame(0x753, b"\x01"),
        Frame(0x725, b"\x01"),
        Frame(0x750, b"\xff\x00"),
    ],
)
def test_other_kinds_of_frame_and_other_ids_are_no_second_tool(frame: Frame) -> None:
    assert guard().see(frame, 1.0) is None


def frames_of(can_id: int, mode: int, command: int, data: bytes) -> list[Frame]:
    return split(can_id, encode(Message(can_id, mode, command, data)))


@each("target", [BMS, OBC])
def test_the_batterys_shutdown_is_noticed_whatever_the_target_and_reported_once(
    target: Target,
) -> None:
    made = guard(target)
    for repetition in range(4):
        for frame in frames_of(0x720, 0x0C, 0x1308, b"SHUTDOWN"):
            assert made.see(frame, 1.0 + repetition * 0.2) is None
    assert made.shutdown_heard
    assert made.take_events() == [events.ShutdownHeard("BMS")]
    assert made.take_events() == []


def test_other_words_of_the_battery_are_no_shutdown() -> None:
    made = guard()
    for can_id, mode, command, data in (
        (0x720, 0x0C, 0x1204, b"\0\0\1\0"),
        (0x720, 0x11, 0x1308, b"SHUTDOWN"),
        (0x721, 0x0C, 0x1308, b"SHUTDOWN"),
    ):
        for frame in frames_of(can_id, mode, command, data):
            made.see(frame, 1.0)
    assert not made.shutdown_heard
