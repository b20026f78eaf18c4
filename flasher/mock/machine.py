"""Base of all simulated nodes: reception, transmission, a timer, an application.

`MockDevice` (`model`) adds the bootloader; a `Unit` is a node without one. One timer is enough,
because a bootloader waits for one thing in every state; the application has its own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import inf
from typing import ClassVar, Final

from flasher.events import BytesDamaged, DeviceReported
from flasher.mock.application import Application, due_again
from flasher.protocol.engine import Transmitter
from flasher.protocol.frame import Frame
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Damage, Message, Reassembler, encode, split

_UNUSED_WIRE_S: Final = 0.0
"""The time on the wire is not needed here, so it is not computed."""
BUS_OFF_S: Final = 0.02
"""Default duration of bus-off in seconds: longer than the standard's 128 times 11 bits, because
software must react first."""


class Machine(ABC):
    """Engine (`flasher.protocol.engine`) that receives the CAN ids of its application and
    `own_ids`; base of `MockDevice` and `Unit`.
    """

    reassembler_type: ClassVar[type[Reassembler]] = Reassembler
    """Reassembler class of every CAN id."""

    def __init__(
        self,
        application: Application,
        own_ids: frozenset[int] = frozenset(),
        *,
        bitrate_bps: int,
        timings: Timings,
    ) -> None:
        self.application = application
        self.timings = timings
        self._bitrate_bps = bitrate_bps
        self._reassemblers = {
            can_id: self.reassembler_type(can_id, timings.inter_frame_timeout_s)
            for can_id in sorted(own_ids | application.received_ids)
        }
        self._transmitter = Transmitter(bitrate_bps)
        self._events: list[object] = []
        self._due_at = inf
        self._off_bus_until: float | None = None
        self._is_deaf = False
        self._is_cancelled = False
        self._runs_application = False
        application.attach(self)

    # -- the engine interface ---------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True once the machine was cancelled and the current message was sent."""
        return self._is_cancelled and self._transmitter.idle

    def receive(self, frame: Frame, now: float) -> None:
        """Process a frame; only payload on the machine's CAN ids matters."""
        if self._off_bus_until is not None:
            self._rejoin_bus(now)
        if self._is_cancelled or self._is_deaf or self._off_bus_until is not None:
            return
        if self._runs_application:
            self.application.note_traffic(now)
        can_id, payload, is_extended, is_remote, is_error = frame[:5]
        reassembler = self._reassemblers.get(can_id)
        if reassembler is None or not payload or is_extended or is_remote or is_error:
            return
        for found in reassembler.feed(payload, now):
            self._take(found, now)

    def tick(self, now: float) -> None:
        if self._is_cancelled:
            return
        self._rejoin_bus(now)
        for reassembler in self._reassemblers.values():
            for found in reassembler.tick(now):
                self._take(found, now)
        self._run_timer(now)
        if self._runs_application:
            self.application.tick(now)

    def deadline(self) -> float | None:
        # Asked after every frame of a simulated bus: calls of `min` took a third of its time.
        due_at = self._transmitter.due_at
        if not self._is_cancelled:
            if self._due_at < due_at:  # noqa: PLR1730
                due_at = self._due_at
            for reassembler in self._reassemblers.values():
                if reassembler.due_at < due_at:  # noqa: PLR1730
                    due_at = reassembler.due_at
            if self._off_bus_until is not None and self._off_bus_until < due_at:
                due_at = self._off_bus_until
            if self._runs_application and self.application.due_at < due_at:
                due_at = self.application.due_at
        return None if due_at == inf else due_at

    def next_frame(self, now: float) -> Frame | None:
        return self._transmitter.next_frame(now)

    def frame_sent(self, now: float) -> None:
        self._transmitter.frame_sent(now)

    def cancel(self, now: float) -> None:
        self._is_cancelled = True
        self._transmitter.drop_unstarted()

    def take_events(self) -> Sequence[object]:
        if not self._events:
            return ()
        events, self._events = self._events, []
        return events

    # -- for the application ----------------------------------------------------------------------

    @property
    def is_idle(self) -> bool:
        return self._transmitter.idle

    def send(self, message: Message) -> None:
        """Queue a message. It is lost while the machine is bus-off."""
        if self._off_bus_until is not None:
            return
        frames = split(message.can_id, encode(message))
        self._transmitter.queue(frames, wire_s=_UNUSED_WIRE_S)

    def emit(self, event: object) -> None:
        self._events.append(event)

    def hold_key(self, now: float) -> None:
        """Tell the application that the key was held long enough to switch off."""
        if self._runs_application:
            self.application.hold_key(now)

    # -- the bus's faults -------------------------------------------------------------------------

    def bus_off(self, now: float, off_s: float = BUS_OFF_S) -> None:
        """Go bus-off for `off_s` seconds.

        Unsent messages are lost, a partly sent one included, and so is everything that others or
        the device send meanwhile.
        """
        self._transmitter = Transmitter(self._bitrate_bps)
        self._off_bus_until = now + off_s

    @property
    def is_off_bus(self) -> bool:
        return self._off_bus_until is not None

    def _rejoin_bus(self, now: float) -> None:
        if self._off_bus_until is not None and now >= self._off_bus_until:
            self._off_bus_until = None

    # -- for the model ----------------------------------------------------------------------------

    @property
    @abstractmethod
    def has_power(self) -> bool:
        """False after a power cut."""

    @abstractmethod
    def power_cut(self, now: float) -> None:
        """Lose power and all memory except flash and stored data."""

    @abstractmethod
    def power_on(self, now: float) -> None:
        """Restore power."""

    @abstractmethod
    def _take_message(self, message: Message, now: float) -> None:
        """Process an intact message."""

    @abstractmethod
    def _take_damage(self, damage: Damage, now: float) -> None:
        """Process damaged bytes."""

    @abstractmethod
    def _expire(self, now: float) -> None:
        """Handle the expired timer: restart or stop it."""

    def _run_timer(self, now: float) -> None:
        """Expire the timer as often as it is due; delays of 0 follow each other at once."""
        while self._due_at <= now:
            self._expire(now)

    def _rearm(self, delay_s: float, now: float) -> None:
        self._due_at = due_again(self._due_at, delay_s, now)

    def _report(self, what: str) -> None:
        self.emit(DeviceReported(what))

    def _forget_received(self) -> None:
        """Drop all incomplete messages."""
        for reassembler in self._reassemblers.values():
            reassembler.reset()

    def _lose_memory(self) -> None:
        """Drop everything received, and all unsent messages, even a partly sent one."""
        self._forget_received()
        self._transmitter = Transmitter(self._bitrate_bps)
        self._off_bus_until = None
        self._due_at = inf

    def _take(self, found: Message | Damage, now: float) -> None:
        # An earlier message may have restarted the device.
        if self._is_deaf:
            return
        due_before = self._due_at
        if isinstance(found, Damage):
            self.emit(BytesDamaged(found.can_id, found.reason.value, found.data))
            self._take_damage(found, now)
        else:
            self._take_message(found, now)
        # With times of 0, what this message began ends at once. An older timer waits for `tick`, so
        # that delayed messages are processed first.
        if self._due_at != due_before:
            self._run_timer(now)


class Unit(Machine):
    """Node without bootloader: its application runs while it has power."""

    def __init__(self, application: Application, *, bitrate_bps: int, timings: Timings) -> None:
        super().__init__(application, bitrate_bps=bitrate_bps, timings=timings)
        self.power_on(float("-inf"))

    @property
    def has_power(self) -> bool:
        return self._runs_application

    def power_cut(self, now: float) -> None:
        self._runs_application = False
        self._is_deaf = True
        self.application.stop()
        self._lose_memory()

    def power_on(self, now: float) -> None:
        if not self._runs_application:
            self._runs_application = True
            self._is_deaf = False
            self.application.start("", now)

    def _take_message(self, message: Message, now: float) -> None:
        self.application.take(message, now)

    def _take_damage(self, damage: Damage, now: float) -> None:
        pass

    def _expire(self, now: float) -> None:
        self._due_at = inf
