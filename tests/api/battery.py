"""A battery for tests of the asking side: answers from a table of bytes, and can misbehave.

It shares no code with the device model; what it says is typed in here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from flasher.api import Connection
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.protocol.frame import Frame
from tests.peers.wording import build, payloads

VERSION: Final = b"BM36.           W2605001.       V1r2r0_20220512.V1r0r0_20220512."
RUNNING: Final = bytes.fromhex("A08C 18FC 401F 1027 41 50 01 63 00000000")
"""36 000 mV, -1000 mA, 8000 of 10000 mAh, 25 degrees, 80 %, charger connected, health 99 %."""
PRODUCTION: Final = b"WELLING.WUXI.   20220512" + bytes(8)
HISTORY: Final = bytes((85, 35)) + bytes(32) + bytes((99,)) + bytes(5)
TEXT: Final = b".               "

ANSWERS: Final = {
    0x3000: (0x720, 0x160C, bytes(range(12))),
    0x3100: (0x720, 0x170C, bytes(12)),
    0x3300: (0x720, 0x1540, VERSION),
    0x3400: (0x720, 0x1010, RUNNING),
    0x3500: (0x720, 0x1120, bytes.fromhex("100E" * 10 + "0000" * 6)),
    0x3600: (0x720, 0x1410, bytes.fromhex("1027 24") + b"21700A. " + bytes(5)),
    0x3700: (0x725, 0x5120, PRODUCTION),
    0x3800: (0x725, 0x5028, HISTORY),
    0x3900: (0x725, 0x5210, TEXT),
    0x3B00: (0x725, 0x5310, TEXT),
    0x3D00: (0x725, 0x5410, TEXT),
}
"""What answers each query: id, command, data (5.1, 5.2)."""
_WRITES: Final = {
    0x320C: (0x3100, 0),
    0x3A10: (0x3900, 0),
    0x3C10: (0x3B00, 0),
    0x3E10: (0x3D00, 0),
    0x3F20: (0x3700, 0),
    0x4010: (0x3300, 0),
    0x4110: (0x3300, 16),
}
"""Which query gives what was written, and at which byte of its answer."""


@dataclass
class Battery:
    """An engine that answers as the BMS."""

    answers: dict[int, tuple[int, int, bytes]] = field(default_factory=lambda: dict(ANSWERS))
    memory: bytes = bytes(range(256)) * 4
    memory_start: int = 0x1000
    silent: frozenset[int] = frozenset()
    """Commands that it does not answer."""
    deaf_messages: int = 0
    """Messages that it misses while it wakes up."""
    delay_s: float = 0.002
    copies: int = 1
    """How often it says each answer."""
    loses_writes: bool = False
    """Confirms writes and keeps the old value."""
    damages: bool = False
    """Sends everything with a wrong CRC."""
    repeats: tuple[tuple[int, int, bytes], ...] = ()
    """Reports sent every 200 ms: id, command, data."""
    received: list[tuple[int, bytes]] = field(default_factory=list)
    """Commands and data of the messages that it understood."""

    def __post_init__(self) -> None:
        self._buffer = b""
        self._out: list[tuple[float, Frame]] = []
        self._report_at: float | None = 0.0 if self.repeats else None

    def report(self, can_id: int, command: int, data: bytes) -> None:
        """Say this every 200 ms, from the beginning of the clock."""
        self.repeats = ((can_id, command, data),)
        self._report_at = 0.0

    @property
    def done(self) -> bool:
        """Never."""
        return False

    def receive(self, frame: Frame, now: float) -> None:
        """Messages are taken to be whole and well-formed: the host is under test."""
        if frame.can_id != 0x752:
            return
        start = frame.data[:2] == b"\x55\xaa"
        self._buffer = frame.data if start else self._buffer + frame.data
        if len(self._buffer) >= 6 and len(self._buffer) == 9 + self._buffer[3]:
            self._take(self._buffer, now)

    def tick(self, now: float) -> None:
        """Say the reports that are due."""
        if self._report_at is not None and now >= self._report_at:
            self._report_at = now + 0.2
            for report in self.repeats:
                self._say(*report, at=now)

    def deadline(self) -> float | None:
        """When it wants to say something."""
        times = [self._out[0][0]] if self._out else []
        if self._report_at is not None:
            times.append(self._report_at)
        return min(times, default=None)

    def next_frame(self, now: float) -> Frame | None:
        """The next frame whose time has come."""
        return self._out[0][1] if self._out and self._out[0][0] <= now else None

    def frame_sent(self, now: float) -> None:
        """Forget it."""
        self._out.pop(0)

    def cancel(self, now: float) -> None:
        """Not asked of a battery."""

    def take_events(self) -> list[object]:
        """None."""
        return []

    def _take(self, wire: bytes, now: float) -> None:
        if self.deaf_messages:
            self.deaf_messages -= 1
            return
        command, data = int.from_bytes(wire[4:6], "big"), wire[6:-5]
        assert wire == build(0x752, wire[2], command, data)
        self.received.append((command, data))
        if command in self.silent:
            return
        if command in _WRITES:
            self._store(command, data)
            self._say(0x725, 0x5503, b"ACK", at=now + self.delay_s)
        elif command == 0x4308:
            self._say_memory(data, now)
        elif command in self.answers:
            self._say(*self.answers[command], at=now + self.delay_s)

    def _store(self, command: int, data: bytes) -> None:
        if self.loses_writes:
            return
        query, at = _WRITES[command]
        can_id, answer, old = self.answers[query]
        self.answers[query] = (can_id, answer, old[:at] + data + old[at + len(data) :])

    def _say_memory(self, data: bytes, now: float) -> None:
        start, end = (int.from_bytes(part, "little") for part in (data[:4], data[4:]))
        at = start - self.memory_start
        if at >= 0 and at + end - start <= len(self.memory):
            piece = self.memory[at : at + end - start].ljust(128, b"\xff")
            self._say(0x725, 0x5688, data + piece, at=now + self.delay_s)

    def _say(self, can_id: int, command: int, data: bytes, *, at: float) -> None:
        wire = build(can_id, 0x0C, command, data)
        if self.damages:
            wire = wire[:-2] + bytes((wire[-2] ^ 1,)) + wire[-1:]
        for _ in range(self.copies):
            self._out += [(at, Frame(can_id, part)) for part in payloads(wire)]
        self._out.sort(key=lambda waiting: waiting[0])


def wire_to(*batteries: Battery) -> Connection:
    """A bus with these on it."""
    clock = VirtualClock()
    bus = SimulatedBus(250_000, clock)
    for battery in batteries:
        bus.attach(battery)
    return Connection(bus.link(), clock, "a simulated bus")


@contextmanager
def opened(*batteries: Battery) -> Iterator[Connection]:
    """The same as a context manager, as the command line wants it."""
    yield wire_to(*batteries)
