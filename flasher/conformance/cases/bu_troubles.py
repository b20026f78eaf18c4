"""What befalls the messages of an upgrade in BU: faults on the line, a controller off the bus."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.tester import Fault, FaultKind, Sent
from flasher.conformance.wire import (
    RawFrame,
    packet_payload,
)

_ANSWER_FRAMES: Final = 2
"""General feedback, ACK, complete: each one has two frames."""
_OFF_BUS_S: Final = 0.2
_POLL_S: Final = 0.0002
"""Shorter than a frame, so that an answer can be hit in its middle."""

Disturb = Callable[[Bench, Sequence[RawFrame]], AbstractContextManager[Sent]]


class Trouble(NamedTuple):
    """What befalls one message: `send` sends it, and what it yields is waited for inside."""

    name: str
    send: Disturb
    hits_answer: bool = False
    """True when the message itself arrives, so that the device goes on."""


class Troubles:
    """What is still to happen to each of the tool's messages, in turn."""

    def __init__(
        self, bench: Bench, image: bytes, make: Callable[[int], Iterator[Trouble]]
    ) -> None:
        words = bench.encoder
        self.left: Final = {
            "reset": deque(make(len(words.reset()))),
            "update command": deque(make(len(words.update(len(image))))),
            "packet": deque(make(len(words.packet(1, 1, packet_payload(image, 1))))),
            "end of transfer": deque(make(len(words.end()))),
        }

    @property
    def rounds_max(self) -> int:
        """More upgrades than that are never needed: each one takes a trouble of every message."""
        return 1 + max(map(len, self.left.values()))

    def __bool__(self) -> bool:
        return any(self.left.values())

    def take(self, message: str) -> Trouble:
        """The next one; none is left when everything happened."""
        queue = self.left[message]
        return queue.popleft() if queue else _NO_TROUBLE


@contextmanager
def _sent_well(bench: Bench, frames: Sequence[RawFrame]) -> Iterator[Sent]:
    yield bench.send(frames)


_NO_TROUBLE: Final = Trouble("", _sent_well)


def faults_of(frames: int, delay_s: float) -> Iterator[Fault]:
    """All that can happen to one of the frames of a message, and to those of its answer."""
    for index in range(frames):
        yield Fault(FaultKind.DROP, index)
        yield Fault(FaultKind.DOUBLE, index)
        if index:
            yield Fault(FaultKind.DELAY, index, delay_s=delay_s)
            yield Fault(FaultKind.SWAP, index - 1)
    for index in range(_ANSWER_FRAMES):
        for kind in (FaultKind.DROP, FaultKind.DOUBLE):
            yield Fault(kind, index, incoming=True)


def faulty(fault: Fault) -> Disturb:
    """A message in which, or in whose answer, this fault happens."""

    @contextmanager
    def send(bench: Bench, frames: Sequence[RawFrame]) -> Iterator[Sent]:
        with bench.disturb(fault):
            yield bench.send(frames)

    return send


def off_bus_after(after: int) -> Disturb:
    """A message in which the device's controller leaves the bus after so many frames."""

    @contextmanager
    def send(bench: Bench, frames: Sequence[RawFrame]) -> Iterator[Sent]:
        bench.send(frames[:after])
        bench.subject.bus_off(_OFF_BUS_S)
        yield bench.send(frames[after:])

    return send


@contextmanager
def off_bus_in_answer(bench: Bench, frames: Sequence[RawFrame]) -> Iterator[Sent]:
    """A message in whose answer the device's controller leaves the bus."""
    before = bench.tester.frames_received
    sent = bench.send(frames)
    give_up_at = bench.now + bench.limit("ack_s")
    while bench.tester.frames_received == before and bench.now < give_up_at:
        bench.wait(_POLL_S)
    bench.subject.bus_off(_OFF_BUS_S)
    yield sent
