"""Tester's end of the bus: sends frames, decodes the device's messages, records a trace.

Frames are received whenever time passes; no wait exceeds the time limit of the case.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Final, NamedTuple

from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.profile_time import limits_of
from flasher.conformance.results import CaseLimitReached, DeviceCrashed, RunStopped, TraceEntry
from flasher.conformance.subject import SIMULATED_BUS, BusPort
from flasher.conformance.waits import Waits
from flasher.conformance.wire import (
    UPDATE,
    WRITE,
    DeviceDecoder,
    Encoder,
    RawFrame,
    Received,
    Reply,
)

TRACE_FRAMES: Final = 20_000
"""Largest number of frames to keep of a case, the newest ones."""
_LIMITS: Final = {
    Reply.FEEDBACK: "feedback_s",
    Reply.BOOT_VERSION: "first_version_s",
    Reply.REQUEST: "erase_s",
    Reply.ACK: "ack_s",
    Reply.NAK: "ack_s",
    Reply.COMPLETE: "complete_s",
    Reply.VERSION_INFORMATION: "start_s",
}
_RECEIVED_LIMIT: Final = 50_000
"""Largest number of messages to keep, so that a babbling device does not exhaust memory."""
_ECHO_LIMIT_S: Final = 2.0
"""After this time a frame counts as sent and its echo as lost."""
_FRAME_BITS: Final = 47
"""Bits of a frame without data and stuff bits, including interframe space."""
_STUFFED_BITS: Final = 33
"""Bits of these that are subject to bit stuffing."""
_UPDATE_HEAD: Final = b"\x55\xaa" + bytes((WRITE, 2 + (UPDATE & 0xFF))) + UPDATE.to_bytes(2, "big")
_NO_READ: Final = re.compile(rb"\x55\xaa[^\x11\x0c]", re.DOTALL)
"""Start of a message that is neither read nor report."""
_POLL_S: Final = 0.2
"""Longest single wait in real time, so that a stop request is noticed soon."""


class FaultKind(Enum):
    """Effect on the frame."""

    DROP = "dropped"
    DOUBLE = "doubled"
    DELAY = "delayed"
    SWAP = "swapped with the next one"


@dataclass(frozen=True)
class LineFault:
    """A fault of frame number `index` (from 0) since `BusTester.disturb`, of those sent or, with
    `incoming`, of those received. Received frames can only be dropped and doubled.
    """

    kind: FaultKind
    index: int
    incoming: bool = False
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        if self.incoming and self.kind not in (FaultKind.DROP, FaultKind.DOUBLE):
            raise ValueError(f"a received frame cannot be {self.kind.value}")

    def __str__(self) -> str:
        side = "received" if self.incoming else "sent"
        return f"frame {self.index + 1} {side} is {self.kind.value}"


class Sent(NamedTuple):
    """Start of a message and end of its last frame, in seconds."""

    at: float
    left_at: float


class BusTester:
    """Sends and receives on one `BusPort`, for a case that may take `limit_s`."""

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
        self.waits = Waits(profile, port.bitrate_bps)
        self.began_at = port.now()
        self.ends_at = self.began_at + limit_s
        self.update_was_sent = False
        """True once an update command was sent, so that the application may be erased."""
        self.collects_feedback = profile.choice("fr_10") == "silence"
        """False: general feedback to a write (R15) only appears in the trace."""
        self.collects_application = False
        """Set by cases that need `Reply.APPLICATION`, which otherwise only appears in the
        trace.
        """
        self.expired: Mapping[str, float] = {}
        """Limits of the profile that the last wait since the last message was sent lasted for; none
        when a message arrived in it.
        """
        self.frames_sent = 0
        self.frames_received = 0
        self.left_at = self.began_at
        """End of the last frame sent."""
        self._stopped = stopped
        self._poll_s = inf if port.timestamp_source == SIMULATED_BUS else _POLL_S
        self._stall_s = self.waits.stall_s
        self._stalled_s = 0.0
        self._left_port_at = self.began_at
        """When the port was last used."""
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
        return self.port.now()

    @property
    def elapsed_s(self) -> float:
        """Seconds since the case began."""
        return self.now - self.began_at

    def wait(self, for_s: float) -> None:
        """Let time pass; received messages are kept for the calls below."""
        self.wait_until(self.now + for_s)

    def wait_until(self, moment: float) -> None:
        while self.now < moment:
            self._pump(moment)

    # -- stalls -----------------------------------------------------------------------------------

    @property
    def stalled_s(self) -> float:
        """Longest time since the start of the last message for which this program neither sent nor
        received although it was due to, beyond `Waits.stall_s`; 0 without one.
        """
        return self._stalled_s

    def forgive_stall(self) -> None:
        """What this program did since it last used the port takes its time, like a power switch."""
        self._left_port_at = self.now

    def _note_stall(self, gap_s: float) -> None:
        if gap_s > self._stall_s:
            self._stalled_s = max(self._stalled_s, gap_s)

    # -- sending ----------------------------------------------------------------------------------

    def send(
        self,
        frames: Sequence[RawFrame],
        *,
        gap_s: float = 0.0,
        gaps: int | None = None,
        at: float | None = None,
    ) -> Sent:
        """Send frames, with `gap_s` of silence after each of the first `gaps` of them (None: all),
        starting at `at`. Returns when the last one has left.
        """
        if at is not None:
            self.wait_until(at)
        began_at = self.now
        self._stalled_s = 0.0
        self.expired = {}
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
        """Minimum time of frames on the wire or, with `is_stuffed`, the maximum."""
        sizes = [8 * len(frame.data) for frame in frames]
        stuff_bits = sum((_STUFFED_BITS + size) // 4 for size in sizes) if is_stuffed else 0
        return (len(sizes) * _FRAME_BITS + sum(sizes) + stuff_bits) / self.port.bitrate_bps

    @contextmanager
    def collecting_feedback(self) -> Iterator[None]:
        """Context manager that collects general feedback, for answers of an application."""
        before, self.collects_feedback = self.collects_feedback, True
        try:
            yield
        finally:
            self.collects_feedback = before

    @contextmanager
    def disturb(self, *faults: LineFault) -> Iterator[None]:
        """Context manager that applies these faults; frames are counted from its start."""
        self._faults = {(fault.incoming, fault.index): fault for fault in faults}
        self._fault_origin = (self.frames_sent, self.frames_received)
        try:
            yield
        finally:
            self._faults = {}

    # -- receiving --------------------------------------------------------------------------------

    def next_message(self, within_s: float) -> Received | None:
        """The next message, or None after `within_s`; one at the very end counts."""
        deadline = self.now + within_s + self.port.uncertainty_s
        while not self._received:
            if self.now >= deadline:
                self.expired = limits_of(within_s)
                return None
            self._pump(deadline)
        self.expired = {}
        return self._received.popleft()

    def wait_for(
        self,
        *kinds: Reply,
        within_s: float | None = None,
        unlike: Callable[[Received], bool] | None = None,
    ) -> Received | None:
        """The next message of one of `kinds` for which `unlike` is false, skipping others; None
        after `within_s` (default: the limit for the first kind).
        """
        deadline = self.now + (self.limit_s(kinds[0]) if within_s is None else within_s)
        while (received := self.next_message(deadline - self.now)) is not None:
            if received.kind in kinds and not (unlike is not None and unlike(received)):
                return received
        return None

    def limit_s(self, kind: Reply) -> float:
        """The profile's limit for an answer of this kind. Raises KeyError without one."""
        return self.profile.limit(_LIMITS[kind])

    def collect(self, for_s: float) -> list[Received]:
        """Return the messages received so far and in the next `for_s`."""
        self.wait(for_s)
        found = list(self._received)
        self.expired = {} if found else limits_of(for_s)
        self._received.clear()
        return found

    def forget(self) -> None:
        """Discard the messages received so far."""
        self._received.clear()

    # -- trace ------------------------------------------------------------------------------------

    @property
    def trace(self) -> tuple[TraceEntry, ...]:
        return tuple(self._trace)

    @property
    def trace_dropped(self) -> int:
        """Number of older frames that were dropped."""
        return self._traced - len(self._trace)

    # -- inside -----------------------------------------------------------------------------------

    def _pump(self, deadline: float) -> None:
        """Receive one frame, or let time pass until `deadline` or for `_poll_s`."""
        port = self.port
        now = port.now()
        if now >= self.ends_at:
            raise CaseLimitReached(
                f"not finished after {self.ends_at - self.began_at:g} s, the time limit of the case"
            )
        if self._stopped():
            raise RunStopped("the run was stopped")
        if now - self._left_port_at > self._stall_s:
            self._note_stall(now - self._left_port_at)
        until = float(min(deadline, self.ends_at, now + self._poll_s))
        try:
            arrival = port.receive(until)
        except DeviceCrashed:
            while (arrival := port.receive(port.now())) is not None:
                self._record(arrival.at, arrival.frame, sent=arrival.is_echo)
            raise
        self._left_port_at = port.now()
        if arrival is None:
            self._note_stall(self._left_port_at - max(now, until))
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
            reply = self._decoder.feed(frame, at)
            self._received.extend(filter(self._is_collected, reply))

    def _is_collected(self, one: Received) -> bool:
        if one.kind is Reply.FEEDBACK and not self.collects_feedback:
            # A device that erases may confirm what it received meanwhile afterwards.
            within_s = max(map(self.profile.limit, ("feedback_s", "erase_s")))
            is_late = one.first_at - self._written_at > within_s
            if self._feedback_due and not is_late:
                self._feedback_due -= 1
                return False
        return self.collects_application or one.kind is not Reply.APPLICATION

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
        port = self.port
        began_at = port.now()
        port.send(frame)
        now = port.now()
        if now - self._left_port_at > self._stall_s:  # else neither part of it is one
            self._note_stall(began_at - self._left_port_at)
            self._note_stall(now - began_at)
        self._left_port_at = now
        if port.echoes:
            self._echoes_due += 1
            return
        wire_s = self.wire_s([frame])
        self.left_at = max(self.left_at, self.now) + wire_s
        self._record(self.left_at, frame, sent=True)

    def _wait_for_echoes(self) -> None:
        """Wait until the last frame has left: for its echo, or for its time on the wire."""
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
