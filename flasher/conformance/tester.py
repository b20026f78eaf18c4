"""The tester's side of the bus: sends frames, reassembles the device's messages, keeps a trace.

Frames are received whenever time passes, and no wait goes beyond the time limit of the case.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Final, NamedTuple

from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import CaseLimitReached, RunStopped, TraceEntry
from flasher.conformance.subject import BusPort
from flasher.conformance.wire import (
    UPDATE,
    WRITE,
    DeviceDecoder,
    Encoder,
    MessageKind,
    RawFrame,
    Received,
)

TRACE_FRAMES: Final = 20_000
"""Frames of a case that are kept: the newest ones."""
_LIMITS: Final = {
    MessageKind.FEEDBACK: "feedback_s",
    MessageKind.BOOT_VERSION: "first_version_s",
    MessageKind.REQUEST: "erase_s",
    MessageKind.ACK: "ack_s",
    MessageKind.NAK: "ack_s",
    MessageKind.COMPLETE: "complete_s",
    MessageKind.VERSION_INFORMATION: "start_s",
}
_RECEIVED_LIMIT: Final = 50_000
"""Messages that are kept: a babbling device must not fill the memory."""
_ECHO_LIMIT_S: Final = 2.0
"""A frame that has not left by then is taken as sent: its echo was lost."""
_FRAME_BITS: Final = 47
"""A frame without data and stuff bits, interframe space included."""
_STUFFED_BITS: Final = 33
"""Of these, what can be stuffed."""
_UPDATE_HEAD: Final = b"\x55\xaa" + bytes((WRITE, 2 + (UPDATE & 0xFF))) + UPDATE.to_bytes(2, "big")
_NO_READ: Final = re.compile(rb"\x55\xaa[^\x11\x0c]", re.DOTALL)
"""The beginning of a message that is neither read nor report."""
_POLL_S: Final = 0.2
"""Longest single wait, so that a request to stop is noticed soon."""


class FaultKind(Enum):
    """What happens to the frame."""

    DROP = "dropped"
    DOUBLE = "doubled"
    DELAY = "delayed"
    SWAP = "swapped with the next one"


@dataclass(frozen=True)
class LineFault:
    """One fault on the line, of the `index`-th frame (from 0) since `BusTester.disturb`: of those
    that are sent or, with `incoming`, of those that arrive (which can be dropped and doubled only).
    """

    kind: FaultKind
    index: int
    incoming: bool = False
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        if self.incoming and self.kind not in (FaultKind.DROP, FaultKind.DOUBLE):
            raise ValueError(f"a frame that arrives cannot be {self.kind.value}")

    def __str__(self) -> str:
        """As a step of a case."""
        side = "received" if self.incoming else "sent"
        return f"frame {self.index + 1} {side} is {self.kind.value}"


class Sent(NamedTuple):
    """When a message began and when its last frame had left, in seconds."""

    at: float
    left_at: float


class BusTester:
    """Sends and receives on one `BusPort`, for one case, which may take `limit_s`."""

    def __init__(
        self,
        port: BusPort,
        encoder: Encoder,
        profile: ConformanceProfile,
        limit_s: float,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.port = port
        self.encoder = encoder
        self.profile = profile
        self.began_at = port.now()
        self.ends_at = self.began_at + limit_s
        self.update_was_sent = False
        """True once an update command went out: the application may be erased."""
        self.collects_feedback = profile.choice("fr_10") == "silence"
        """Else general feedback that a write may be answered by (R15) is in the trace only."""
        self.collects_application = False
        """Set by a case that cares about `Kind.APPLICATION`; else they are in the trace only."""
        self.frames_sent = 0
        self.frames_received = 0
        self.left_at = self.began_at
        """When the last frame sent had left."""
        self._stopped = stopped
        self._decoder = DeviceDecoder(encoder)
        self._received: deque[Received] = deque(maxlen=_RECEIVED_LIMIT)
        self._trace: deque[TraceEntry] = deque(maxlen=TRACE_FRAMES)
        self._traced = 0
        self._echoes_due = 0
        self._feedback_due = 0
        """Writes that general feedback may still answer."""
        self._written_at = -inf
        self._faults: dict[tuple[bool, int], LineFault] = {}
        self._fault_origin = (0, 0)
        self._swapped: RawFrame | None = None

    # -- time -------------------------------------------------------------------------------------

    @property
    def now(self) -> float:
        """The time, in seconds on the port's clock."""
        return self.port.now()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the case began."""
        return self.now - self.began_at

    def wait(self, for_s: float) -> None:
        """Let time pass; messages received meanwhile are kept for the calls below."""
        self.wait_until(self.now + for_s)

    def wait_until(self, moment: float) -> None:
        """Let time pass until `moment`."""
        while self.now < moment:
            self._pump(moment)

    # -- sending ----------------------------------------------------------------------------------

    def send(
        self,
        frames: Sequence[RawFrame],
        *,
        gap_s: float = 0.0,
        gaps: int | None = None,
        at: float | None = None,
    ) -> Sent:
        """Send frames, `gap_s` of silence behind each of the first `gaps` of them (None: between
        all), from the time `at` on; returns when the last one has left.
        """
        if at is not None:
            self.wait_until(at)
        began_at = self.now
        raw = b"".join(frame.data for frame in frames if frame.can_id == self.encoder.to_device)
        if writes := len(_NO_READ.findall(raw)):
            self._feedback_due += writes
            self._written_at = began_at
        for index, frame in enumerate(frames):
            if index and gap_s and (gaps is None or index <= gaps):
                self._wait_for_echoes()
                self.wait(gap_s)
            self._send_disturbed(frame)
        if self._swapped is not None:
            frame, self._swapped = self._swapped, None
            self._send_frame(frame)
        self._wait_for_echoes()
        if writes:
            self._written_at = self.left_at
        return Sent(began_at, self.left_at)

    def wire_s(self, frames: Iterable[RawFrame], *, is_stuffed: bool = False) -> float:
        """How long frames take on the wire: at the least, or with all stuff bits there can be."""
        sizes = [8 * len(frame.data) for frame in frames]
        stuff_bits = sum((_STUFFED_BITS + size) // 4 for size in sizes) if is_stuffed else 0
        return (len(sizes) * _FRAME_BITS + sum(sizes) + stuff_bits) / self.port.bitrate_bps

    @contextmanager
    def collecting_feedback(self) -> Iterator[None]:
        """General feedback is heard inside the `with`, as that of an application is waited for."""
        before, self.collects_feedback = self.collects_feedback, True
        try:
            yield
        finally:
            self.collects_feedback = before

    @contextmanager
    def disturb(self, *faults: LineFault) -> Iterator[None]:
        """Let these faults happen inside the `with`; frames are counted from its beginning."""
        self._faults = {(fault.incoming, fault.index): fault for fault in faults}
        self._fault_origin = (self.frames_sent, self.frames_received)
        try:
            yield
        finally:
            self._faults = {}

    # -- receiving --------------------------------------------------------------------------------

    def next_message(self, within_s: float) -> Received | None:
        """The next message, or None after `within_s`."""
        deadline = self.now + within_s
        while not self._received:
            if self.now >= deadline:
                return None
            self._pump(deadline)
        return self._received.popleft()

    def wait_for(
        self,
        *kinds: MessageKind,
        within_s: float | None = None,
        unlike: Callable[[Received], bool] | None = None,
    ) -> Received | None:
        """The next message of one of `kinds`, others skipped; None after `within_s`, by default
        the limit for the first kind. One for which `unlike` is true is skipped too.
        """
        deadline = self.now + (self.limit_s(kinds[0]) if within_s is None else within_s)
        while (received := self.next_message(deadline - self.now)) is not None:
            if received.kind in kinds and not (unlike is not None and unlike(received)):
                return received
        return None

    def limit_s(self, kind: MessageKind) -> float:
        """The profile's limit for the answer of that kind. Raises KeyError for one without."""
        return self.profile.limit(_LIMITS[kind])

    def collect(self, for_s: float) -> list[Received]:
        """The messages of the next `for_s`, and those received before and not yet taken."""
        self.wait(for_s)
        found = list(self._received)
        self._received.clear()
        return found

    def forget(self) -> None:
        """Discard the messages received so far and not yet taken."""
        self._received.clear()

    # -- trace ------------------------------------------------------------------------------------

    @property
    def trace(self) -> tuple[TraceEntry, ...]:
        """The newest `TRACE_FRAMES` frames."""
        return tuple(self._trace)

    @property
    def trace_dropped(self) -> int:
        """Older frames that were not kept."""
        return self._traced - len(self._trace)

    # -- inside -----------------------------------------------------------------------------------

    def _pump(self, deadline: float) -> None:
        """Take one frame, or let time pass, up to `deadline` or for `_POLL_S`."""
        now = self.port.now()
        if now >= self.ends_at:
            raise CaseLimitReached(
                f"not at an end after {self.ends_at - self.began_at:g} s, the case's own limit"
            )
        if self._stopped():
            raise RunStopped("the run was stopped")
        arrival = self.port.receive(min(deadline, self.ends_at, now + _POLL_S))
        if arrival is None:
            return
        frame, at, is_echo = arrival
        self._record(at, frame, sent=is_echo)
        if is_echo:
            self._echoes_due = max(self._echoes_due - 1, 0)
            self.left_at = at
            return
        fault = self._faults.get((True, self.frames_received - self._fault_origin[1]))
        self.frames_received += 1
        copies = 1 if fault is None else {FaultKind.DROP: 0, FaultKind.DOUBLE: 2}[fault.kind]
        for _ in range(copies):
            heard = self._decoder.feed(frame, at)
            self._received.extend(filter(self._is_collected, heard))

    def _is_collected(self, one: Received) -> bool:
        if one.kind is MessageKind.FEEDBACK and not self.collects_feedback:
            is_late = one.first_at - self._written_at > self.profile.limit("feedback_s")
            if self._feedback_due and not is_late:
                self._feedback_due -= 1
                return False
        return self.collects_application or one.kind is not MessageKind.APPLICATION

    def _send_disturbed(self, frame: RawFrame) -> None:
        fault = self._faults.get((False, self.frames_sent - self._fault_origin[0]))
        self.frames_sent += 1
        held, self._swapped = self._swapped, None
        if fault is None:
            self._send_frame(frame)
        elif fault.kind is FaultKind.DOUBLE:
            self._send_frame(frame)
            self._send_frame(frame)
        elif fault.kind is FaultKind.DELAY:
            self._wait_for_echoes()
            self.wait(fault.delay_s)
            self._send_frame(frame)
        elif fault.kind is FaultKind.SWAP:
            self._swapped = frame
        if held is not None:
            self._send_frame(held)

    def _send_frame(self, frame: RawFrame) -> None:
        if frame.can_id == self.encoder.to_device and frame.data.startswith(_UPDATE_HEAD):
            self.update_was_sent = True
        self.port.send(frame)
        if self.port.echoes:
            self._echoes_due += 1
            return
        wire_s = self.wire_s([frame])
        self.left_at = max(self.left_at, self.now) + wire_s
        self._record(self.left_at, frame, sent=True)

    def _wait_for_echoes(self) -> None:
        """Wait until the last frame has left: by its echo, or by its length on the wire."""
        if not self.port.echoes:
            self.wait_until(self.left_at)
            return
        now = self.port.now
        give_up_at = now() + _ECHO_LIMIT_S
        while self._echoes_due and now() < give_up_at:
            self._pump(give_up_at)
        if self._echoes_due:
            self._echoes_due = 0
            self.left_at = self.now

    def _record(self, at: float, frame: RawFrame, *, sent: bool) -> None:
        self._traced += 1
        self._trace.append(TraceEntry(at - self.began_at, sent, frame))
