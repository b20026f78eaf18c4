"""A CAN bus in memory: exact bit times, arbitration by id, everybody hears everybody.

The devices on it are engines (`attach`), the host comes through a `SimulatedLink`. It is driven by
the link's calls and has no thread: sending and receiving make its time pass, on whichever clock it
was given. With a `VirtualClock` an upgrade takes no time at all, with a `PacedClock` as long as on
a real bus, with the same code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from flasher.bus.link import SEND_LIMIT_S, Clock
from flasher.errors import TransmitBlockedError
from flasher.protocol.bittime import frame_bits
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame

Disturbance = Callable[[Frame, float], Iterable[Frame]]
"""What becomes of a frame on the wire, given its end time: itself, nothing, two of it, another."""

DEFAULT_QUEUE_FRAMES = 32
"""Transmit queue of the host's simulated adapter."""


class _Node:
    """Somebody on the bus: what it has to send, and who hears for it."""

    def __init__(
        self, engine: Engine | None = None, on_event: Callable[[object], None] | None = None
    ) -> None:
        self.engine = engine
        self.on_event = on_event
        self.outbox: deque[tuple[float, Frame]] = deque()
        """Frames to send, with the time at which each was queued."""
        self.inbox: deque[Frame] = deque()

    def hear(self, frame: Frame, now: float) -> None:
        if self.engine is None:
            self.inbox.append(frame)
        else:
            self.engine.receive(frame, now)


class SimulatedBus:
    """The wire, its nodes and its time."""

    def __init__(
        self, bitrate_bps: int, clock: Clock, disturbance: Disturbance | None = None
    ) -> None:
        self.clock = clock
        self.frames_carried = 0
        self.busy_s = 0.0
        """Time that the wire was in use."""
        self._bitrate_bps = bitrate_bps
        self._disturbance = disturbance
        self._nodes: list[_Node] = []
        self._sending: tuple[_Node, Frame] | None = None
        self._sending_ends_at = 0.0

    def attach(self, engine: Engine, on_event: Callable[[object], None] | None = None) -> None:
        """Put a device on the bus; `on_event` is told what it reports."""
        self._nodes.append(_Node(engine, on_event))

    def link(self, queue_frames: int = DEFAULT_QUEUE_FRAMES) -> SimulatedLink:
        """A way onto the bus for somebody who drives it from outside."""
        node = _Node()
        self._nodes.append(node)
        return SimulatedLink(self, node, queue_frames)

    def advance(self, limit: float) -> None:
        """Let time pass up to the next thing that happens, `limit` at the latest."""
        now = self.clock.now()
        self._serve_engines(now)
        self._arbitrate()
        moment = limit
        if self._sending is not None:
            moment = min(moment, self._sending_ends_at)
        for node in self._nodes:
            wanted = node.engine.deadline() if node.engine and not node.outbox else None
            if wanted is not None:
                moment = min(moment, wanted)
        self.clock.wait_until(moment)
        if self._sending is not None and self._sending_ends_at <= moment:
            self._deliver()

    def _serve_engines(self, now: float) -> None:
        """Let every device do what it wants to do now: one frame each waits for the wire."""
        for node in self._nodes:
            engine = node.engine
            if engine is None:
                continue
            wanted = engine.deadline()
            if wanted is not None and wanted <= now:
                engine.tick(now)
            if not node.outbox:
                frame = engine.next_frame(now)
                if frame is not None:
                    node.outbox.append((now, frame))
                    engine.frame_sent(now)
            for event in engine.take_events():
                if node.on_event is not None:
                    node.on_event(event)

    def _arbitrate(self) -> None:
        if self._sending is not None:
            return
        waiting = [node for node in self._nodes if node.outbox]
        if not waiting:
            return
        winner = min(waiting, key=lambda node: node.outbox[0][1].can_id)
        queued_at, frame = winner.outbox.popleft()
        duration_s = frame_bits(frame) / self._bitrate_bps
        # A paced clock wakes a little late, the wire does not: a frame that waited for the one
        # before follows it without a gap.
        begins_at = max(self._sending_ends_at, queued_at)
        self._sending = (winner, frame)
        self._sending_ends_at = begins_at + duration_s
        self.busy_s += duration_s

    def _deliver(self) -> None:
        if self._sending is None:
            return
        sender, frame = self._sending
        self._sending = None
        self.frames_carried += 1
        ends_at = self._sending_ends_at
        frames = self._disturbance(frame, ends_at) if self._disturbance else (frame,)
        for carried in frames:
            for node in self._nodes:
                if node is not sender:
                    node.hear(carried, self.clock.now())


class SimulatedLink:
    """The host's adapter on a simulated bus."""

    def __init__(self, bus: SimulatedBus, node: _Node, queue_frames: int) -> None:
        self._bus = bus
        self._node = node
        self._queue_frames = queue_frames

    def send(self, frame: Frame) -> None:
        """Queue a frame; while the queue is full, time passes, up to `SEND_LIMIT_S`."""
        clock = self._bus.clock
        give_up_at = clock.now() + SEND_LIMIT_S
        while len(self._node.outbox) >= self._queue_frames:
            if clock.now() >= give_up_at:
                raise TransmitBlockedError(
                    f"The simulated bus took no frame for {SEND_LIMIT_S:g} s.",
                    cause="other traffic takes the whole bus",
                )
            self._bus.advance(give_up_at)
        self._node.outbox.append((clock.now(), frame))

    def receive(self, deadline: float) -> Frame | None:
        """Let time pass until a frame arrives or the deadline comes."""
        inbox = self._node.inbox
        while not inbox:
            if self._bus.clock.now() >= deadline:
                return None
            self._bus.advance(deadline)
        return inbox.popleft()

    def drain(self) -> int:
        """Forget what has arrived."""
        count = len(self._node.inbox)
        self._node.inbox.clear()
        return count

    def close(self) -> None:
        """Nothing to release."""
