"""Bus guard: detects a second tool, and the battery's SHUTDOWN, during an upgrade session; pure.

A second tool sends with the CAN id of the tool. Queries (mode 11) are distinguished from other
messages, because they write nothing. SHUTDOWN switches off the supply of every target.
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
    """Frame of a second tool: its description, whether a transfer may continue, and the queried
    command (None if it does not begin a query).

    The first frame of a message determines its kind. Other frames are harmless as long as they may
    be the rest of a query. More of them belong to a message whose beginning was missed, or was
    mistaken for an echo because it equals an own frame (a packet with the same number).
    """

    description: str
    is_harmless: bool
    query: int | None = None


_QUERY_REST_FRAMES: Final = 2
"""Frames of the longest query (4308, 19 bytes) after its first one."""


class Guard:
    """Inspects every received frame of a session."""

    def __init__(self, target: Target, timings: Timings) -> None:
        self._own_id = target.request_id
        in_first_frame = FRAME_DATA_SIZE - PREFIX_SIZE - COMMAND_SIZE
        self._update_rest = target.update_text.encode("ascii")[in_first_frame:]
        """Beginning of the second frame of an update command, which has the size."""
        battery_id = can_id(Node.BMS, None)
        self._battery = Reassembler(battery_id, timings.inter_frame_timeout_s)
        self._gap_s = timings.inter_frame_timeout_s
        self._rest_frames = 0
        """Foreign frames since the last one that began a message."""
        self._rest_at = 0.0
        self._events: list[object] = []
        self.shutdown_heard = False
        """The battery sent SHUTDOWN."""

    def see(self, frame: Frame, now: float) -> ForeignFrame | None:
        """Inspect a received frame; return its description if a second tool sent it."""
        frame_id = frame[0]
        if frame_id == self._own_id:
            return self._judge_own(frame, now)
        if frame_id == self._battery.can_id and frame.is_payload:
            for found in self._battery.feed(frame.data, now):
                if isinstance(found, Message):
                    self._note(found)
        return None

    def take_events(self) -> list[object]:
        taken, self._events = self._events, []
        return taken

    def _judge_own(self, frame: Frame, now: float) -> ForeignFrame | None:
        if frame.is_echo or not frame.is_payload:
            return None
        data = frame.data
        description = f"frame {data.hex(' ')} with id 0x{frame.can_id:03X}, not sent by this tool"
        if len(data) < FRAME_DATA_SIZE or not data.startswith(HEADER):
            if now - self._rest_at > self._gap_s:
                self._rest_frames = 0
            self._rest_frames, self._rest_at = self._rest_frames + 1, now
            is_update = data.startswith(self._update_rest)
            is_long = self._rest_frames > _QUERY_REST_FRAMES
            return ForeignFrame(description, is_harmless=not (is_update or is_long))
        self._rest_frames = 0
        if data[len(HEADER)] != Mode.READ:
            return ForeignFrame(description, is_harmless=False)
        command = int.from_bytes(data[PREFIX_SIZE : PREFIX_SIZE + COMMAND_SIZE], "big")
        return ForeignFrame(description, is_harmless=True, query=command)

    def _note(self, message: Message) -> None:
        decoded = catalogue.decode(message)
        if decoded is not None and isinstance(decoded.content, Shutdown):
            if not self.shutdown_heard:
                self._events.append(events.ShutdownHeard(Node.BMS.name))
            self.shutdown_heard = True
