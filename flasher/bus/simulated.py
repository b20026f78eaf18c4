"""A CAN bus in memory: exact bit times, arbitration by id, everybody hears everybody.

The devices on it are engines (`attach`), the host comes through a `SimulatedLink`. It is driven by
the link's calls and has no thread: sending and receiving make its time pass, on whichever clock it
was given. With a `VirtualClock` an upgrade takes no time at all, with a `PacedClock` as long as on
a real bus, with the same code.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable

from flasher.bus.health import (
    ControllerState,
    HealthKeeper,
    Layout,
    LinkHealth,
    bus_off_error,
)
from flasher.bus.link import SEND_LIMIT_S, Clock
from flasher.bus.simulated_faults import AdapterFaults
from flasher.errors import BusError, TransmitBlockedError
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
        self.faults = AdapterFaults()
        """What befalls the host's adapter; see `unplug`, `bus_off` and `nobody_acknowledges`."""

    def unplug(self, back_after_s: float | None = None) -> None:
        """Pull the host's adapter out: its links raise BusError until it is back (`plug`, or by
        itself after `back_after_s`) and they were opened again.
        """
        now = self.clock.now()
        self.faults.unplug(None if back_after_s is None else now + back_after_s)
        self._silence_hosts()

    def bus_off(self, restart_after_s: float | None = None) -> None:
        """Put the host's controller bus-off: nothing goes out or comes in until `plug`, or until
        it restarts by itself.
        """
        now = self.clock.now()
        self.faults.go_off(now, None if restart_after_s is None else now + restart_after_s)
        self._silence_hosts()

    def plug(self) -> None:
        """End `unplug` and `bus_off`."""
        self.faults.come_back(self.clock.now())

    @property
    def nobody_acknowledges(self) -> bool:
        """True while the host's adapter is alone: its frames never leave, its queue fills up, and
        it hears nobody.
        """
        return self.faults.is_alone

    @nobody_acknowledges.setter
    def nobody_acknowledges(self, alone: bool) -> None:
        self.faults.be_alone(self.clock.now(), alone=alone)

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
        self._report_faults(now)
        self._serve_engines(now)
        self._arbitrate()
        moment = limit
        if (due := self.faults.deadline()) is not None:
            moment = min(moment, due)
        if self._sending is not None:
            moment = min(moment, self._sending_ends_at)
        for node in self._nodes:
            wanted = node.engine.deadline() if node.engine and not node.outbox else None
            if wanted is not None:
                moment = min(moment, wanted)
        self.clock.wait_until(moment)
        if self._sending is not None and self._sending_ends_at <= moment:
            self._deliver()
        self._report_faults(self.clock.now())

    def _report_faults(self, now: float) -> None:
        for report in self.faults.tick(now):
            for node in self._nodes:
                if node.engine is None:
                    node.inbox.append(report)

    def _silence_hosts(self) -> None:
        """What the host had queued, or was sending, is gone."""
        for node in self._nodes:
            if node.engine is None:
                node.outbox.clear()
        if self._sending is not None and self._sending[0].engine is None:
            self._sending = None

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
        if not self.faults.takes_part:
            self._try_in_vain([node for node in waiting if node.engine is None])
            waiting = [node for node in waiting if node.engine is not None]
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

    def _try_in_vain(self, hosts: Iterable[_Node]) -> None:
        for node in hosts:
            queued_at, frame = node.outbox[0]
            duration_s = frame_bits(frame) / self._bitrate_bps
            self.faults.try_in_vain(queued_at, duration_s, 1 / self._bitrate_bps)

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
                if node is not sender and (node.engine or self.faults.takes_part):
                    node.hear(carried, self.clock.now())


class SimulatedLink:
    """The host's adapter on a simulated bus."""

    def __init__(self, bus: SimulatedBus, node: _Node, queue_frames: int) -> None:
        self._bus = bus
        self._node = node
        self._queue_frames = queue_frames
        self._health = HealthKeeper(Layout.SOCKETCAN)
        self._opened_at = bus.faults.times_unplugged

    def __str__(self) -> str:
        """As messages name it."""
        return "the simulated bus"

    def send(self, frame: Frame) -> None:
        """Queue a frame; while the queue is full, time passes, up to `SEND_LIMIT_S`."""
        clock = self._bus.clock
        give_up_at = clock.now() + SEND_LIMIT_S
        self._check("sending")
        while len(self._node.outbox) >= self._queue_frames:
            if clock.now() >= give_up_at:
                self._health.is_blocked = True
                raise TransmitBlockedError(
                    f"The simulated bus took no frame for {SEND_LIMIT_S:g} s.",
                    cause="nobody on the bus acknowledges"
                    if self._bus.nobody_acknowledges
                    else "other traffic takes the whole bus",
                )
            self._bus.advance(give_up_at)
            self._check("sending")
        self._health.sent += 1
        if not self._bus.faults.is_off:  # as drivers do until they have reported it
            self._node.outbox.append((clock.now(), frame))

    def receive(self, deadline: float) -> Frame | None:
        """Let time pass until a frame arrives or the deadline comes."""
        inbox = self._node.inbox
        self._check_plugged("receiving")
        while not inbox:
            if self._bus.clock.now() >= deadline:
                return None
            self._bus.advance(deadline)
            self._check_plugged("receiving")
        frame = inbox.popleft()
        self._health.hear(frame)
        return frame

    def drain(self) -> int:
        """Forget what has arrived, but not what the adapter reported."""
        count = len(self._node.inbox)
        for frame in self._node.inbox:
            self._health.hear(frame)
        self._node.inbox.clear()
        return count

    def close(self) -> None:
        """Nothing to release."""

    def reopen(self) -> None:
        """Be there again, with empty queues. Raises BusError while the adapter is not back."""
        faults = self._bus.faults
        self._bus.advance(self._bus.clock.now())  # somebody else may have let time pass
        if not faults.is_plugged:
            raise BusError(
                "The adapter cannot be opened: it is not there.",
                where=str(self),
                cause="it is not plugged in",
                remedy="Plug it in.",
            )
        if faults.is_off:
            raise bus_off_error(str(self))
        self._opened_at = faults.times_unplugged
        self._node.inbox.clear()
        self._node.outbox.clear()
        self._health.reset()

    def health(self) -> LinkHealth:
        """As an adapter on Linux tells it: error-active unless something befell it."""
        faults = self._bus.faults
        if not faults.is_plugged:
            return self._health.health()
        if faults.is_off:
            return self._health.health(ControllerState.BUS_OFF)
        if self._health.state in (ControllerState.UNKNOWN, ControllerState.BUS_OFF):
            return self._health.health(ControllerState.ACTIVE)
        return self._health.health()

    def _check(self, doing: str) -> None:
        self._check_plugged(doing)
        if self._health.state is ControllerState.BUS_OFF:
            raise bus_off_error(str(self), f"The adapter failed while {doing}: it is bus-off.")

    def _check_plugged(self, doing: str) -> None:
        if self._opened_at != self._bus.faults.times_unplugged:
            raise BusError(
                f"The adapter failed while {doing}: no such device.",
                where=str(self),
                cause="it was unplugged",
                remedy="Plug it in, then run the same command again.",
            )
