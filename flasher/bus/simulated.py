"""Simulated CAN bus: exact bit times, arbitration by id, every node receives every frame.

Arbitration does not separate simultaneous senders of one id: equal frames merge; different frames
destroy each other until the error counters silence one sender. Without `collides` they take turns,
as on a virtual network.

Devices are engines (`attach`); the host uses a `SimulatedLink`. The bus has no thread: sending and
receiving advance its time, on the given clock. With a `VirtualClock` an upgrade takes no time, with
a `SteadyClock` as long as on a real bus.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import Final

from flasher.bus.health import (
    ControllerState,
    HealthKeeper,
    Layout,
    LinkHealth,
    bus_off_error,
)
from flasher.bus.link import SEND_LIMIT_S, Clock
from flasher.bus.simulated_faults import AdapterFaults
from flasher.errors import BusError, ErrorCode, TransmitBlockedError
from flasher.protocol.bittime import frame_bits
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame

_ERROR_FRAME_BITS: Final = 20
"""Error flag, delimiter and following pause, approximately."""
_ID_BITS: Final = 13
"""Start bit, id and remote bit, equal for two senders of one id."""
_PASSIVE: Final = 128
_OFF: Final = 256
"""Transmit error counters of a controller that is error-passive, and bus-off."""
Disturbance = Callable[[Frame, float], Iterable[Frame]]
"""Replaces a frame that ends at a time by the frames received: itself, none, two copies,
another."""

DEFAULT_QUEUE_FRAMES = 32
"""Frames that the host's simulated adapter queues."""


class _Node:
    def __init__(self) -> None:
        self.outbox: deque[tuple[float, Frame]] = deque()
        """Frames to send, each with the time at which it was queued."""
        self.tx_errors = 0
        """Transmit error counter: plus 8 for an error, minus 1 for a frame sent."""


class _Host(_Node):
    """Node of a program, driven through a `SimulatedLink`."""

    def __init__(self) -> None:
        super().__init__()
        self.inbox: deque[Frame] = deque()


class _Device(_Node):
    """Node of an engine, driven by the bus."""

    def __init__(self, engine: Engine, on_event: Callable[[object], None] | None) -> None:
        super().__init__()
        self.engine = engine
        self.on_event = on_event
        self.deadline: float | None = None
        """Deadline that the engine last asked for."""


class SimulatedBus:
    """CAN bus with hosts and devices, and its time."""

    def __init__(
        self,
        bitrate_bps: int,
        clock: Clock,
        disturbance: Disturbance | None = None,
        *,
        collides: bool = True,
    ) -> None:
        self.clock = clock
        self.frames_carried = 0
        self.busy_s = 0.0
        """Seconds during which the wire was in use."""
        self._bitrate_bps = bitrate_bps
        self._disturbance = disturbance
        self._collides = collides
        self._nodes: list[_Node] = []
        """Hosts and devices in the order in which they were added."""
        self._hosts: list[_Host] = []
        self._devices: list[_Device] = []
        self._sending: tuple[Sequence[_Node], Frame | None] | None = None
        """Senders of the frame on the wire, several for equal frames in the same bits; None as
        frame is a collision, which no node receives."""
        self._sending_ends_at = 0.0
        self._delivered_at: float | None = None
        """Time of a delivered frame to which devices answer: as exact as the wire, even if the
        clock woke late."""
        self.faults = AdapterFaults()
        """Faults of the host's adapter: `unplug`, `bus_off` and `is_unacknowledged`."""

    def unplug(self, back_after_s: float | None = None) -> None:
        """Unplug the host's adapter: its links raise BusError until it is plugged in again (`plug`,
        or after `back_after_s`) and the link is reopened.
        """
        now = self.clock.now()
        self.faults.unplug(None if back_after_s is None else now + back_after_s)
        self._silence_hosts()

    def bus_off(self, restart_after_s: float | None = None) -> None:
        """Set the host's controller bus-off until `plug`, or for `restart_after_s` seconds."""
        now = self.clock.now()
        self.faults.enter_bus_off(now, None if restart_after_s is None else now + restart_after_s)
        self._silence_hosts()

    def plug(self) -> None:
        """Plug the host's adapter in again and restart its controller."""
        self.faults.restore(self.clock.now())

    @property
    def is_unacknowledged(self) -> bool:
        """True while the host is isolated: it neither sends nor receives, and its queue fills."""
        return self.faults.is_isolated

    @is_unacknowledged.setter
    def is_unacknowledged(self, alone: bool) -> None:
        now = self.clock.now()
        self.faults.isolate(now, alone=alone)
        if not alone:  # what waited leaves from now on
            self._sending_ends_at = max(self._sending_ends_at, now)

    def attach(self, engine: Engine, on_event: Callable[[object], None] | None = None) -> None:
        """Add a device; `on_event` is called with its events."""
        device = _Device(engine, on_event)
        self._nodes.append(device)
        self._devices.append(device)

    def detach(self, engine: Engine) -> None:
        """Remove a device and its unsent frames."""
        device = next(each for each in self._devices if each.engine is engine)
        self._nodes.remove(device)
        self._devices.remove(device)

    def add_host(self) -> _Host:
        """Add a node for a host."""
        host = _Host()
        self._nodes.append(host)
        self._hosts.append(host)
        return host

    def link(self, queue_frames: int = DEFAULT_QUEUE_FRAMES) -> SimulatedLink:
        """Add a host to the bus; return its link."""
        return SimulatedLink(self, queue_frames)

    @property
    def is_idle(self) -> bool:
        """True when no frame is on the wire, or waits for it."""
        return self._sending is None and not any(node.outbox for node in self._nodes)

    def advance(self, limit: float) -> None:
        """Advance to the next event on the bus, at latest to `limit`."""
        faults = self.faults
        if faults.due_at < inf:
            self._report_faults()
        now = self._delivered_at
        if now is None:
            now = self.clock.now()
        else:
            self._delivered_at = None
        self._serve_devices(now)
        if self._sending is None:
            self._arbitrate()
        moment = min(limit, faults.due_at)
        sending = self._sending
        if sending is not None and self._sending_ends_at < moment:
            moment = self._sending_ends_at
        for device in self._devices:
            wanted = device.deadline
            if wanted is None or wanted >= moment or device.outbox:
                continue
            # While a frame is sent, a deadline in the past is that of the next one.
            if sending is None or wanted > now:
                moment = wanted
        self.clock.wait_until(moment)
        if sending is not None and self._sending_ends_at <= moment:
            self._deliver(*sending)
        if faults.due_at < inf:
            self._report_faults()

    def advance_message(self, limit: float) -> None:
        """Advance to the next event and, when that is a frame of the only host, through the frames
        that it queued after it, until a device is due: faster than one call for each.
        """
        self.advance(limit)
        sender, *others = senders = self._hosts
        faults, outbox = self.faults, sender.outbox
        if others or faults.due_at < inf or not faults.takes_part or sender.tx_errors:
            return
        while outbox and self._delivered_at is not None:
            queued_at, frame = outbox[0]
            taken_s = frame_bits(frame) / self._bitrate_bps
            ends_at = self._begin_of(queued_at) + taken_s
            if ends_at > limit:
                return
            for device in self._devices:
                wanted = device.engine.deadline()
                if device.outbox or device.on_event or (wanted is not None and wanted < ends_at):
                    return
            outbox.popleft()
            self._sending_ends_at = ends_at
            self.busy_s += taken_s
            self.clock.wait_until(ends_at)
            self._deliver(senders, frame)

    def _report_faults(self) -> None:
        """Report the faults of the adapter that are due."""
        now = self.clock.now()
        if self.faults.due_at > now:
            return
        for report in self.faults.tick(now):
            for host in self._hosts:
                host.inbox.append(report)

    def _silence_hosts(self) -> None:
        """Drop the frames that hosts queued or were sending."""
        for host in self._hosts:
            host.outbox.clear()
        if self._sending is not None and self._sending[0][0] in self._hosts:
            self._sending = None

    def _serve_devices(self, now: float) -> None:
        """Call every engine that is due; each device queues one frame at a time, the next one when
        that has been sent.
        """
        anything_happened = False
        for device in self._devices:
            engine = device.engine
            wanted = device.deadline = engine.deadline()
            if wanted is not None and wanted <= now:
                anything_happened = True
                engine.tick(now)
                if not device.outbox and (frame := engine.next_frame(now)) is not None:
                    device.outbox.append((now, frame))
                    engine.frame_sent(now)
            elif device.on_event is None:
                continue
            for event in engine.take_events():
                anything_happened = True
                if device.on_event is not None:
                    device.on_event(event)
        if anything_happened:
            for device in self._devices:
                device.deadline = device.engine.deadline()

    def _arbitrate(self) -> None:
        waiting: Sequence[_Node] = [node for node in self._nodes if node.outbox]
        if not waiting:
            return
        if not self.faults.takes_part:
            self._send_unacknowledged(host for host in self._hosts if host.outbox)
            waiting = [device for device in self._devices if device.outbox]
            if not waiting:
                return
        winners = waiting if len(waiting) == 1 else self._winners(waiting)
        queued_at, frame = winners[0].outbox[0]
        collides = False
        if len(winners) > 1:
            queued_at = min(node.outbox[0][0] for node in winners)
            collides = any(node.outbox[0][1] != frame for node in winners)
        if collides:
            self._sending, bits = (winners, None), self._collide(winners)
        else:
            self._sending, bits = (winners, frame), frame_bits(frame)
            for node in winners:
                node.outbox.popleft()
                if node.tx_errors:
                    node.tx_errors -= 1
        taken_s = bits / self._bitrate_bps
        self._sending_ends_at = self._begin_of(queued_at) + taken_s
        self.busy_s += taken_s

    def _begin_of(self, queued_at: float) -> float:
        """Return when a frame that was queued then begins. A paced clock wakes slightly late, the
        wire does not: a frame that waited for the previous one follows it without a gap.
        """
        return max(self._sending_ends_at, queued_at)

    def _winners(self, waiting: Sequence[_Node]) -> Sequence[_Node]:
        """Select the senders of the frame that has priority, several if they send one id."""
        lowest = min(node.outbox[0][1].can_id for node in waiting)
        winners = [node for node in waiting if node.outbox[0][1].can_id == lowest]
        if len(winners) == 1:
            return winners
        return self._contend(winners) if self._collides else winners[:1]

    def _contend(self, rivals: Sequence[_Node]) -> Sequence[_Node]:
        """Select among senders of one id those of the frame with the first dominant bit, and any
        that are still error-active and disturb it.
        """
        first = min(_bits_after_id(node.outbox[0][1]) for node in rivals)
        strongest = [node for node in rivals if _bits_after_id(node.outbox[0][1]) == first]
        others = [node for node in rivals if node not in strongest]
        if any(node.tx_errors < _PASSIVE for node in others):
            return rivals
        for node in others:
            _count_error(node)
        return strongest

    def _collide(self, rivals: Sequence[_Node]) -> int:
        """Let different frames with one id destroy each other; return the bit times used."""
        different = {_bits_after_id(node.outbox[0][1]) for node in rivals}
        same = next(i for i, bits in enumerate(zip(*different, strict=False)) if len(set(bits)) > 1)
        for node in rivals:
            _count_error(node)
        return _ID_BITS + 8 * same + _ERROR_FRAME_BITS

    def _send_unacknowledged(self, hosts: Iterable[_Host]) -> None:
        for host in hosts:
            queued_at, frame = host.outbox[0]
            duration_s = frame_bits(frame) / self._bitrate_bps
            self.faults.send_unacknowledged(queued_at, duration_s, 1 / self._bitrate_bps)

    def _deliver(self, senders: Sequence[_Node], frame: Frame | None) -> None:
        self._sending = None
        if frame is None:
            return
        self._delivered_at = self._sending_ends_at
        self.frames_carried += 1
        ends_at = self._sending_ends_at
        frames = self._disturbance(frame, ends_at) if self._disturbance else (frame,)
        for carried in frames:
            for device in self._devices:
                if device not in senders:
                    device.engine.receive(carried, ends_at)
            for host in self._hosts:
                if host not in senders and self.faults.takes_part:
                    host.inbox.append(carried)


def _bits_after_id(frame: Frame) -> bytes:
    """Sort key of frames with one id; a 0 is dominant."""
    return bytes((frame.is_extended, len(frame.data))) + frame.data


def _count_error(node: _Node) -> None:
    """Count a transmit error; a node at bus-off loses its frame and restarts at once."""
    node.tx_errors += 8
    if node.tx_errors >= _OFF:
        node.tx_errors = 0
        node.outbox.popleft()


class SimulatedLink:
    """Host's adapter on a simulated bus: a `Link` without hardware."""

    def __init__(self, bus: SimulatedBus, queue_frames: int) -> None:
        self._bus = bus
        self._host = bus.add_host()
        self._queue_frames = queue_frames
        self._health = HealthKeeper(Layout.SOCKETCAN)
        self._opened_at = bus.faults.times_unplugged

    def __str__(self) -> str:
        return "the simulated bus"

    def send(self, frame: Frame) -> None:
        """Queue a frame; wait up to `SEND_LIMIT_S` for room. Raises TransmitBlockedError."""
        bus, outbox = self._bus, self._host.outbox
        self._check_sending()
        if len(outbox) >= self._queue_frames:
            self._await_room()
        self._health.sent += 1
        if not bus.faults.is_off:  # as drivers do until they report it
            outbox.append((bus.clock.now(), frame))

    def _await_room(self) -> None:
        clock = self._bus.clock
        give_up_at = clock.now() + SEND_LIMIT_S
        while len(self._host.outbox) >= self._queue_frames:
            if clock.now() >= give_up_at:
                self._health.is_blocked = True
                raise TransmitBlockedError(
                    f"The simulated bus took no frame for {SEND_LIMIT_S:g} s.",
                    cause="no node on the bus acknowledges"
                    if self._bus.is_unacknowledged
                    else "other traffic takes the whole bus",
                )
            self._bus.advance(give_up_at)
            self._check_sending()

    def receive(self, deadline: float) -> Frame | None:
        """Advance the bus until a frame arrives or the deadline comes."""
        bus, inbox = self._bus, self._host.inbox
        faults = bus.faults
        while True:
            if self._opened_at != faults.times_unplugged:
                raise self._unplugged("receiving")
            if inbox:
                frame = inbox.popleft()
                self._health.count_frame(frame)
                return frame
            if bus.clock.now() >= deadline:
                return None
            bus.advance(deadline)

    def drain(self) -> int:
        """Discard received frames, but count error frames."""
        count = len(self._host.inbox)
        for frame in self._host.inbox:
            self._health.count_frame(frame)
        self._host.inbox.clear()
        return count

    def close(self) -> None:
        """Nothing to release."""

    def reopen(self) -> None:
        """Reopen with empty queues. Raises BusError while the adapter is unplugged or bus-off."""
        faults = self._bus.faults
        self._bus.advance(self._bus.clock.now())  # time may have passed elsewhere
        if not faults.is_plugged:
            raise BusError(
                "The adapter cannot be opened: it is not there.",
                where=str(self),
                cause="it is not plugged in",
                remedy="Plug it in.",
                code=ErrorCode.ADAPTER_NOT_OPENED,
            )
        if faults.is_off:
            raise bus_off_error(str(self))
        self._opened_at = faults.times_unplugged
        self._host.inbox.clear()
        self._host.outbox.clear()
        self._health.reset()

    @property
    def is_off(self) -> bool:
        """True while the adapter reports bus-off."""
        return self._health.state is ControllerState.BUS_OFF

    @property
    def is_physical(self) -> bool:
        return False

    def health(self) -> LinkHealth:
        """Return the health as an adapter on Linux: error-active unless there was a fault."""
        faults = self._bus.faults
        if not faults.is_plugged:
            return self._health.health()
        if faults.is_off:
            return self._health.health(ControllerState.BUS_OFF)
        if self._health.state in (ControllerState.UNKNOWN, ControllerState.BUS_OFF):
            return self._health.health(ControllerState.ACTIVE)
        return self._health.health()

    def _check_sending(self) -> None:
        if self._opened_at != self._bus.faults.times_unplugged:
            raise self._unplugged("sending")
        if self._health.state is ControllerState.BUS_OFF:
            raise bus_off_error(str(self), "The adapter failed while sending: it is bus-off.")

    def _unplugged(self, doing: str) -> BusError:
        return BusError(
            f"The adapter failed while {doing}: no such device.",
            where=str(self),
            cause="it was unplugged",
            remedy="Plug it in. Run the same command again.",
            code=ErrorCode.ADAPTER_LOST,
        )
