"""Watches the whole bus while a session runs, for what no single dialogue would notice; pure.

A second tool: a frame with the id on which only the tool speaks, and that is no echo of what was
sent. Echoes come soon; an adapter that gives none, not all, or some of them twice is fine.
The battery's SHUTDOWN: whatever the target is, its power goes with it.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from flasher import events
from flasher.protocol import catalogue
from flasher.protocol.contents import Shutdown
from flasher.protocol.echoes import ECHO_FRAMES, Echoes
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Node, Target, can_id
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message, Reassembler

DOUBLE_LIMIT_S: Final = 0.1
"""A second copy of an echo (a network with two ways, a driver's own) comes right behind it."""


class Guard:
    """Give it every frame in both directions."""

    def __init__(self, target: Target, timings: Timings) -> None:
        self._own_id = target.request_id
        self._echoes = Echoes()
        self._echoed: deque[tuple[float, Frame]] = deque(maxlen=ECHO_FRAMES)
        battery_id = can_id(Node.BMS, None)
        self._battery = Reassembler(battery_id, timings.inter_frame_timeout_s)
        self._events: list[object] = []
        self.shutdown_heard = False
        """The battery has announced that it switches off."""

    def sent(self, frame: Frame, now: float) -> None:
        """A frame was handed to the adapter."""
        if frame[0] == self._own_id:
            self._echoes.sent(frame, now)

    def see(self, frame: Frame, now: float) -> str | None:
        """A frame was received; returns what it shows when a second tool has sent it."""
        frame_id = frame[0]
        if frame_id == self._own_id:
            return self._judge_own(frame, now)
        if frame_id == self._battery.can_id and frame.is_payload:
            for found in self._battery.feed(frame.data, now):
                if isinstance(found, Message):
                    self._note(found)
        return None

    def take_events(self) -> list[object]:
        """What was noticed since the last call."""
        taken, self._events = self._events, []
        return taken

    def _judge_own(self, frame: Frame, now: float) -> str | None:
        if not frame.is_payload:
            return None
        if self._echoes.take(frame, now):
            self._echoed.append((now, frame))
            return None
        if any(own == frame and now - at <= DOUBLE_LIMIT_S for at, own in self._echoed):
            return None
        return f"frame {frame.data.hex(' ')} with id 0x{frame.can_id:03X}, not sent by this tool"

    def _note(self, message: Message) -> None:
        decoded = catalogue.decode(message)
        if decoded is not None and isinstance(decoded.content, Shutdown):
            if not self.shutdown_heard:
                self._events.append(events.ShutdownHeard(Node.BMS.name))
            self.shutdown_heard = True
