"""One question and its answer: when it is sent, what is taken for an answer, how it ends."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Generic, TypeVar

import pytest

from flasher import events
from flasher.host.query import Queries, Query, Request
from flasher.host.query import ask as ask_one
from flasher.host.runner import Runner
from flasher.protocol import contents
from flasher.protocol.catalogue import BY_KEY, Item
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.wire import Message
from tests.loops import each
from tests.peers.wording import build, payloads

RATE = 250_000
READ_VERSION = BY_KEY[0x752, 0x3300]
READ_RUNNING = BY_KEY[0x752, 0x3400]
READ_MEMORY = BY_KEY[0x752, 0x4308]
WRITE_STRING = BY_KEY[0x752, 0x3A10]
VERSION = b"BM36.           W2605001.       V1r2r0_20220512.V1r0r0_20220512."
RUNNING = bytes.fromhex("A08C 18FC 401F 1027 41 50 01 63 00000000")


def frames(can_id: int, mode: int, command: int, data: bytes) -> list[Frame]:
    return [Frame(can_id, part) for part in payloads(build(can_id, mode, command, data))]


EngineT = TypeVar("EngineT", bound=Runner[Any])


class Bench(Generic[EngineT]):
    """Drives an engine on virtual time and keeps what it sent, frame by frame with its time."""

    def __init__(self, engine: EngineT, *, accepts: bool = True) -> None:
        self.engine = engine
        self.accepts = accepts
        self.now = 0.0
        self.sent: list[tuple[float, Frame]] = []
        self.events: list[object] = []

    @property
    def query(self: Bench[Queries]) -> Query:
        """The question that is asked."""
        return self.engine.queries[-1]

    def run(self, until: float) -> None:
        """Let time pass."""
        while True:
            wanted = self.engine.deadline()
            if wanted is not None and wanted <= self.now:
                self.engine.tick(self.now)
            while self.accepts and (frame := self.engine.next_frame(self.now)) is not None:
                self.sent.append((self.now, frame))
                self.engine.frame_sent(self.now)
            self.events += self.engine.take_events()
            wanted = self.engine.deadline()
            if wanted is None or wanted > until or (wanted <= self.now and not self.accepts):
                if self.now >= until:
                    return
                self.now = until if wanted is None or self.accepts else min(self.now + 0.01, until)
            else:
                self.now = max(self.now, wanted)

    def say(self, can_id: int, mode: int, command: int, data: bytes) -> None:
        """A message comes in."""
        for frame in frames(can_id, mode, command, data):
            self.engine.receive(frame, self.now)
        self.events += self.engine.take_events()

    def over(self) -> bool:
        """Whether the engine is done; a call, for it changes from one line to the next."""
        return self.engine.done

    def starts(self) -> list[float]:
        """When each copy began."""
        return [at for at, frame in self.sent if frame.data.startswith(b"\x55\xaa")]


def ask(item: Item = READ_VERSION, content: Content | None = None) -> Bench[Queries]:
    request = Request(item) if content is None else Request(item, content)
    return Bench(Queries([request], bitrate_bps=RATE))


# -- sending ---------------------------------------------------------------------------------------


def test_a_query_goes_out_as_the_document_has_it() -> None:
    bench = ask()
    bench.run(0.1)
    wire = build(0x752, 0x11, 0x3300, b"")
    assert wire[:6] == bytes.fromhex("55AA 11 02 3300")
    assert b"".join(frame.data for _, frame in bench.sent) == wire
    assert [frame.can_id for _, frame in bench.sent] == [0x752, 0x752]


def test_an_unanswered_question_is_repeated_every_200_ms_and_given_up_after_one_second() -> None:
    bench = ask()
    bench.run(5.0)
    starts = bench.starts()
    assert len(starts) == 5
    gaps = [later - earlier for earlier, later in itertools.pairwise(starts)]
    assert all(0.2 < gap < 0.202 for gap in gaps)  # it is timed from where the copy has left
    assert bench.over()
    assert bench.query.answer is None
    title = "read version information"
    assert bench.events == [
        *(events.MessageRepeated(title, "query_unanswered", tries) for tries in (2, 3, 4, 5)),
        events.QueryUnanswered(title, 5),
    ]


def test_of_a_quiet_question_nothing_is_reported() -> None:
    for is_quiet in (True, False):
        query = Query(Request(READ_VERSION), quiet=is_quiet)
        bench: Bench[Runner[Query]] = Bench(Runner(partial(ask_one, query=query), bitrate_bps=RATE))
        bench.run(0.25)
        for frame in frames(0x720, 0x0C, 0x1540, VERSION)[:5]:
            bench.engine.receive(frame, bench.now)
        bench.run(0.5)
        bench.say(0x720, 0x0C, 0x1540, VERSION)
        noted = [type(event) for event in bench.events]
        assert query.answer is not None
        repeated = events.MessageRepeated
        expected = [repeated, events.BytesDamaged, repeated, events.QueryAnswered]
        assert noted == ([] if is_quiet else expected)
        bench.run(2.0)
        assert bench.over()


def test_it_is_over_one_second_after_the_first_copy_has_left() -> None:
    bench = ask()
    bench.run(1.0)
    assert not bench.over()
    bench.run(1.002)
    assert bench.over()


def test_while_the_bus_takes_nothing_no_second_copy_is_made_and_it_still_ends() -> None:
    bench = ask()
    bench.accepts = False
    bench.run(0.9)
    assert bench.query.tries == 1
    assert not bench.over()
    bench.run(1.1)
    assert bench.over()
    assert bench.engine.next_frame(1.1) is None


def test_a_copy_that_waited_long_is_answered_in_a_full_second_after_it_left() -> None:
    bench = ask()
    bench.accepts = False
    bench.run(0.9)
    bench.accepts = True
    bench.run(1.8)
    assert not bench.over()
    assert bench.starts()[0] == pytest.approx(0.9, abs=0.02)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    assert isinstance(bench.query.answer, contents.VersionInformation)


def test_a_message_that_is_half_sent_at_the_end_is_finished_first() -> None:
    bench = ask()
    bench.engine.tick(0.0)
    assert bench.engine.next_frame(0.95) is not None
    bench.engine.frame_sent(0.95)
    bench.engine.tick(1.0)
    assert not bench.over()
    assert bench.engine.next_frame(1.0) is not None
    bench.engine.frame_sent(1.0)
    assert bench.over()


def test_a_first_copy_in_which_this_computer_paused_is_sent_again_and_may_be_answered() -> None:
    bench = ask()
    bench.engine.tick(0.0)
    assert bench.engine.next_frame(0.0) is not None
    bench.now = 0.95
    bench.engine.frame_sent(bench.now)
    bench.run(1.5)
    assert not bench.over()
    assert bench.query.tries == 2
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    assert isinstance(bench.query.answer, contents.VersionInformation)


def test_a_bus_that_never_takes_the_second_half_does_not_hold_it_up_for_ever() -> None:
    bench = ask()
    bench.engine.tick(0.0)
    bench.engine.frame_sent(0.0)
    bench.engine.tick(1.0)
    bench.engine.tick(2.0)
    assert bench.over()


# -- what is an answer -----------------------------------------------------------------------------


def test_the_answer_ends_it_at_once() -> None:
    bench = ask()
    bench.run(0.05)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    assert bench.over()
    answer = bench.query.answer
    assert isinstance(answer, contents.VersionInformation)
    assert str(answer.serial_number) == "W2605001"
    assert bench.events == [events.QueryAnswered("read version information", answer, 1)]


@each(
    "can_id, mode, command, data",
    [
        (0x725, 0x0C, 0x1540, VERSION),
        (0x715, 0x0C, 0x1540, VERSION),
        (0x720, 0x16, 0x1540, VERSION),
        (0x720, 0x0C, 0x1010, RUNNING),
        (0x720, 0x0C, 0x1530, VERSION[:0x30]),
    ],
)
def test_what_is_not_the_answer_is_not_taken_for_it(
    can_id: int, mode: int, command: int, data: bytes
) -> None:
    bench = ask()
    bench.run(0.05)
    bench.say(can_id, mode, command, data)
    bench.run(3.0)
    assert bench.query.answer is None
    assert len(bench.starts()) == 5


def test_an_answer_of_another_length_is_kept_as_a_misfit() -> None:
    bench = ask()
    bench.run(0.05)
    bench.say(0x720, 0x0C, 0x1530, VERSION[:0x30])
    assert bench.query.misformatted is not None
    assert (bench.query.misformatted.command, len(bench.query.misformatted.data)) == (0x1530, 48)


def test_a_damaged_answer_is_reported_and_the_question_repeated() -> None:
    bench = ask()
    bench.run(0.05)
    damaged = frames(0x720, 0x0C, 0x1540, VERSION)
    damaged[3] = Frame(0x720, b"\x00" * 8)
    for frame in damaged:
        bench.engine.receive(frame, bench.now)
    bench.run(0.35)
    damages = [event for event in bench.events if isinstance(event, events.BytesDamaged)]
    assert (damages[0].can_id, damages[0].reason) == (0x720, "bad_crc")
    assert len(bench.starts()) == 2


def test_an_answer_before_the_question_has_left_is_somebody_elses() -> None:
    bench = ask()
    bench.accepts = False
    bench.run(0.05)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    assert bench.query.answer is None


def test_a_memory_answer_counts_for_the_addresses_asked_only() -> None:
    bench = ask(READ_MEMORY, contents.ReadMemory(0x1000, 0x1080))
    bench.run(0.05)
    assert b"".join(f.data for _, f in bench.sent)[6:14].hex(" ") == "00 10 00 00 80 10 00 00"
    bench.say(0x725, 0x0C, 0x5688, bytes.fromhex("80100000 00110000") + bytes(128))
    assert not bench.over()
    bench.say(0x725, 0x0C, 0x5688, bytes.fromhex("00100000 80100000") + b"\x11" * 128)
    assert isinstance(bench.query.answer, contents.Memory)
    assert bench.query.answer.content == b"\x11" * 128


def test_the_caller_may_refuse_an_answer() -> None:
    request = Request(READ_RUNNING, accepts=lambda answer: answer.data()[0] != RUNNING[0])
    bench = Bench(Queries([request], bitrate_bps=RATE))
    bench.run(0.05)
    bench.say(0x720, 0x0C, 0x1010, RUNNING)
    assert bench.query.answer is None
    bench.say(0x720, 0x0C, 0x1010, b"\0" + RUNNING[1:])
    assert bench.query.answer is not None


def test_a_message_of_another_size_than_the_content_of_the_answer_is_none() -> None:
    """A product's own query, whose command gives another size than its content has."""
    answer = replace(BY_KEY[0x720, 0x1540], command=0x1539)
    query = Query(Request(READ_VERSION, answer=answer))
    assert not query.is_answer(Message(0x720, 0x0C, 0x1539, bytes(0x39)))
    assert query.answer is None


def test_answers_that_came_faster_than_the_bit_rate_do_not_defer_the_end_of_a_silent_question() -> (
    None
):
    """A bus in one computer."""
    engine = Queries([Request(READ_RUNNING)] * 60 + [Request(READ_VERSION)], bitrate_bps=RATE)
    bench = Bench(engine)
    for _ in range(60):
        bench.run(0.0)
        bench.say(0x720, 0x0C, 0x1010, RUNNING)
    assert bench.query.request.item is READ_VERSION
    bench.run(1.005)
    assert bench.over()


def test_a_message_that_nothing_answers_cannot_be_asked() -> None:
    with pytest.raises(ValueError, match="no answer"):
        Queries([Request(BY_KEY[0x720, 0x1204])], bitrate_bps=RATE).tick(0.0)


# -- repeated questions, and several ---------------------------------------------------------------


def write(text: bytes) -> Request:
    return Request(WRITE_STRING, contents.UserString.from_data(text.ljust(16)))


def test_after_a_repetition_it_waits_for_the_answers_to_both_copies() -> None:
    bench = Bench(Queries([write(b"ONE.")], bitrate_bps=RATE))
    bench.run(0.25)
    assert len(bench.starts()) == 2
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    assert bench.query.answer is not None
    assert not bench.over()
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    assert bench.over()
    assert [type(event) for event in bench.events] == [events.MessageRepeated, events.QueryAnswered]


def test_no_further_copy_is_sent_while_it_waits_for_a_second_answer() -> None:
    bench = Bench(Queries([write(b"ONE.")], bitrate_bps=RATE))
    bench.run(0.38)
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    bench.run(0.425)
    assert not bench.over()
    bench.run(0.431)
    assert bench.over()
    assert len(bench.starts()) == 2


def test_a_copy_that_has_not_begun_to_leave_when_the_answer_comes_is_dropped() -> None:
    bench = Bench(Queries([write(b"ONE.")], bitrate_bps=RATE))
    bench.run(0.1)
    bench.accepts = False
    bench.run(0.25)
    assert bench.query.tries == 2
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    assert bench.over()


def test_it_waits_for_a_second_answer_50_ms_only() -> None:
    bench = Bench(Queries([write(b"ONE.")], bitrate_bps=RATE))
    bench.run(0.25)
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    bench.run(0.29)
    assert not bench.over()
    bench.run(0.301)
    assert bench.over()
    assert len(bench.starts()) == 2


def test_a_late_confirmation_of_one_write_does_not_confirm_the_next() -> None:
    engine = Queries([write(b"ONE."), write(b"TWO.")], bitrate_bps=RATE)
    bench = Bench(engine)
    bench.run(0.25)
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    bench.run(0.28)
    bench.say(0x725, 0x0C, 0x5503, b"ACK")
    bench.run(3.0)
    assert engine.done
    assert [answer is not None for answer in engine.answers] == [True, False]


def test_questions_are_asked_in_order_and_an_unanswered_one_is_passed_over() -> None:
    engine = Queries([Request(READ_VERSION), Request(READ_RUNNING)], bitrate_bps=RATE)
    bench = Bench(engine)
    bench.run(1.1)
    bench.say(0x720, 0x0C, 0x1010, RUNNING)
    assert engine.done
    assert engine.answers[0] is None
    running = engine.answers[1]
    assert isinstance(running, contents.RunningInformation)
    assert (running.voltage_mv, running.mean_current_ma) == (36_000, -1000)
    assert [type(e).__name__ for e in bench.events if "Query" in type(e).__name__] == [
        "QueryUnanswered",
        "QueryAnswered",
    ]


def test_no_further_question_is_made_after_a_silence_if_so_wished() -> None:
    taken = []

    def requests() -> Iterator[Request]:
        for item in (READ_VERSION, READ_RUNNING):
            taken.append(item)
            yield Request(item)

    engine = Queries(requests(), bitrate_bps=RATE, stop_at_silence=True)
    Bench(engine).run(3.0)
    assert engine.done
    assert taken == [READ_VERSION]


def counting(*items: Item) -> Bench[Queries]:
    return Bench(Queries([Request(item) for item in items], bitrate_bps=RATE, counts=True))


def test_a_question_that_is_answered_twice_is_asked_again_and_then_two_devices_are_reported() -> (
    None
):
    bench = counting(READ_RUNNING, READ_VERSION)
    bench.run(1.05)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.08)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.16)
    assert not bench.over()
    assert len(bench.starts()) == 5 + 2
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.18)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.4)
    assert bench.over()
    answered = [each for each in bench.events if isinstance(each, events.QueryAnswered)]
    assert len(answered) == 1
    assert bench.events[-1] == events.TwoDevicesSeen("two devices answered")


def test_an_answer_to_another_node_that_asks_the_same_is_no_second_device() -> None:
    bench = counting(READ_VERSION)
    bench.run(0.01)
    bench.say(0x732, 0x11, 0x5100, b"")
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(0.02)
    bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.0)
    assert bench.over()
    assert len(bench.starts()) == 1
    assert not [each for each in bench.events if isinstance(each, events.TwoDevicesSeen)]


def test_the_echo_of_a_question_is_not_taken_for_the_question_of_another() -> None:
    bench = counting(READ_VERSION)
    for again in (0, 1):
        bench.run(0.01 + 0.12 * again)
        for _, frame in bench.sent[2 * again :]:
            bench.engine.receive(frame._replace(is_echo=True), bench.now)
        bench.say(0x720, 0x0C, 0x1540, VERSION)
        bench.run(0.02 + 0.12 * again)
        bench.say(0x720, 0x0C, 0x1540, VERSION)
    bench.run(1.0)
    assert bench.events[-1] == events.TwoDevicesSeen("two devices answered")


def test_where_nothing_was_answered_no_second_device_is_waited_for() -> None:
    bench = counting(READ_VERSION)
    bench.run(1.01)
    assert bench.over()
    assert events.QueryUnanswered("read version information", 5) == bench.events[-1]


def test_cancelled_it_ends_and_asks_nothing_more() -> None:
    engine = Queries([Request(READ_VERSION), Request(READ_RUNNING)], bitrate_bps=RATE)
    bench = Bench(engine)
    bench.run(0.05)
    engine.cancel(0.05)
    assert engine.done
    assert engine.queries[-1].cancelled
    assert len(engine.queries) == 1
    bench.run(2.0)
    assert len(bench.starts()) == 1


def test_cancelled_in_the_middle_of_a_message_it_finishes_that() -> None:
    engine = Queries([Request(READ_VERSION)], bitrate_bps=RATE)
    bench = Bench(engine)
    engine.tick(0.0)
    engine.frame_sent(0.0)
    engine.cancel(0.0)
    assert not bench.over()
    engine.frame_sent(0.001)
    assert bench.over()
    assert engine.queries[-1].cancelled


def test_nothing_to_ask_is_done_from_the_start() -> None:
    engine = Queries([], bitrate_bps=RATE)
    assert engine.done
    assert engine.deadline() is None
    assert engine.next_frame(0.0) is None
