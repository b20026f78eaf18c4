"""Any engine on a virtual clock, spoken to in bytes: messages in, whole messages out.

Messages are built and taken apart without flasher's own code.
"""

from __future__ import annotations

from typing import NamedTuple

from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from tests.peers.wording import build, intact, payloads

START_S = 1000.0
READ, WRITE, REPORT = 0x11, 0x16, 0x0C
_BLOCKED_STEP_S = 0.01


class Answer(NamedTuple):
    """A whole message that came out, with the time of its last frame."""

    at_s: float
    can_id: int
    mode: int
    command: int
    data: bytes


class Talk:
    """Runs one engine; what it sends is accepted at once, unless `accepts_frames` is off."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self.now = START_S
        self.accepts_frames = True
        self.events: list[object] = []
        self._heard: list[Answer] = []
        self._partial: dict[int, bytes] = {}

    def run(self, duration_s: float) -> None:
        until_s = self.now + duration_s
        self._collect()
        while (wanted := self.engine.deadline()) is not None and wanted <= until_s:
            step_s = 0.0 if self.accepts_frames else _BLOCKED_STEP_S
            self.now = max(self.now + step_s, wanted)
            self.engine.tick(self.now)
            self._collect()
            if self.now > until_s:
                break
        self.now = max(self.now, until_s)

    def put(self, can_id: int, mode: int, command: int, data: bytes = b"") -> None:
        """A message arrives."""
        for payload in payloads(build(can_id, mode, command, data)):
            self.engine.receive(Frame(can_id, payload), self.now)
        self._collect()

    def ask(self, can_id: int, mode: int, command: int, data: bytes = b"") -> list[Answer]:
        """A message arrives; its immediate answers."""
        self.take()
        self.put(can_id, mode, command, data)
        return self.take()

    def data_of(self, command: int, can_id: int = 0x752) -> bytes:
        """The data of the one answer to a query."""
        (heard,) = self.ask(can_id, READ, command)
        return heard.data

    def take(self) -> list[Answer]:
        """Whole messages since the last call."""
        self._collect()
        heard, self._heard = self._heard, []
        return heard

    def times_of(self, can_id: int, command: int) -> list[float]:
        """When that message came out since the last call, counted from the start; takes all."""
        wanted = (can_id, command)
        return [one.at_s - START_S for one in self.take() if (one.can_id, one.command) == wanted]

    def _collect(self) -> None:
        while self.accepts_frames and (frame := self.engine.next_frame(self.now)) is not None:
            self.engine.frame_sent(self.now)
            wire = self._partial.pop(frame.can_id, b"") + frame.data
            if len(wire) < 4 or len(wire) < wire[3] + 9:
                self._partial[frame.can_id] = wire
                continue
            assert wire[:2] == b"\x55\xaa"
            assert len(wire) == wire[3] + 9
            assert intact(frame.can_id, wire)
            command = int.from_bytes(wire[4:6], "big")
            self._heard.append(Answer(self.now, frame.can_id, wire[2], command, wire[6:-5]))
        self.events += self.engine.take_events()
