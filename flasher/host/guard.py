"""Watches the whole bus while a session runs, for what no single dialogue would notice; pure.

A second tool: a frame with the id on which only the tool speaks, and that is no echo of an own one.
A query (mode 11) is told from all other messages: it writes nothing.
The battery's SHUTDOWN: whatever the target is, its power goes with it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from flasher import events
from flasher.protocol import catalogue
from flasher.protocol.contents import Shutdown
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    COMMAND_SIZE,
    FRAME_DATA_SIZE,
    HEADER,
    PREFIX_SIZE,
    Mode,
    Node,
    Target,
    can_id,
)
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message, Reassembler


class ForeignFrame(NamedTuple):
    """A frame of a second tool: what was seen; whether a transfer may go on beside it; the command
    that it asks for, None where it is not the beginning of a query.

    The first frame of a message tells what it is. Frames that are no beginning are harmless as long
    as they may be the rest of a query; more of them are a message whose beginning was not heard, or
    was taken for an echo since it is equal to an own one, as that of a packet with the same number.
    """

    seen: str
    is_harmless: bool
    query: int | None = None


_QUERY_REST_FRAMES: Final = 2
"""Frames after the first one of the longest query (4308, 19 bytes)."""


class Guard:
    """Give it every frame in both directions."""

    def __init__(self, target: Target, timings: Timings) -> None:
        self._own_id = target.request_id
        battery_id = can_id(Node.BMS, None)
        self._battery = Reassembler(battery_id, timings.inter_frame_timeout_s)
        self._gap_s = timings.inter_frame_timeout_s
        self._rest_frames = 0
        """Foreign frames since the last that began a message."""
        self._rest_at = 0.0
        self._events: list[object] = []
        self.shutdown_heard = False
        """The battery has announced that it switches off."""

    def see(self, frame: Frame, now: float) -> ForeignFrame | None:
        """A frame was received; returns what it is when a second tool has sent it."""
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

    def _judge_own(self, frame: Frame, now: float) -> ForeignFrame | None:
        if frame.is_echo or not frame.is_payload:
            return None
        data = frame.data
        seen = f"frame {data.hex(' ')} with id 0x{frame.can_id:03X}, not sent by this tool"
        if len(data) < FRAME_DATA_SIZE or not data.startswith(HEADER):
            if now - self._rest_at > self._gap_s:
                self._rest_frames = 0
            self._rest_frames, self._rest_at = self._rest_frames + 1, now
            return ForeignFrame(seen, is_harmless=self._rest_frames <= _QUERY_REST_FRAMES)
        self._rest_frames = 0
        if data[len(HEADER)] != Mode.READ:
            return ForeignFrame(seen, is_harmless=False)
        command = int.from_bytes(data[PREFIX_SIZE : PREFIX_SIZE + COMMAND_SIZE], "big")
        return ForeignFrame(seen, is_harmless=True, query=command)

    def _note(self, message: Message) -> None:
        decoded = catalogue.decode(message)
        if decoded is not None and isinstance(decoded.content, Shutdown):
            if not self.shutdown_heard:
                self._events.append(events.ShutdownHeard(Node.BMS.name))
            self.shutdown_heard = True
