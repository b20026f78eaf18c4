"""The messages that an upgrade listens to: the device's answers to the tool, and, while the new
application is asked for its version, the id on which it tells it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.host.options import UpgradeOptions
from flasher.host.table import State
from flasher.image.plan import Plan
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Malformed, Row, Unknown, decode
from flasher.protocol.wire import Damage, Message, Reassembler

_NOBODY: Final = -1
"""A CAN id that no frame has."""


class IncomingMessages:
    """Makes messages of frames, and rows of messages."""

    def __init__(self, plan: Plan, options: UpgradeOptions) -> None:
        inter_frame_s = options.timings.inter_frame_timeout_s
        request = options.version_request_for(plan.target)
        self._version = None if request is None else request.answer_item
        version_id = self._version.can_id if self._version else _NOBODY
        self._answers = Reassembler(plan.target.answer_id, inter_frame_s)
        self._broadcasts = Reassembler(version_id, inter_frame_s)

    def feed(self, frame: Frame, state: State, now: float) -> Sequence[Message | Damage]:
        """What the frame completes or spoils; nothing for a frame on an id of no concern."""
        can_id = frame[0]
        if can_id == self._answers.can_id:
            reassembler = self._answers
        elif can_id == self._broadcasts.can_id and state is State.CONFIRMING:
            reassembler = self._broadcasts
        else:
            return ()
        return reassembler.feed(frame[1], now) if frame.is_payload else ()

    def tick(self, now: float) -> Sequence[Message | Damage]:
        """What the silence has spoilt."""
        return (*self._answers.tick(now), *self._broadcasts.tick(now))

    def deadlines(self) -> tuple[float | None, float | None]:
        """When each of the two ids wants `tick`; None where nothing is half received."""
        return self._answers.deadline(), self._broadcasts.deadline()

    def decode(self, message: Message) -> Row | Malformed | Unknown | Content:
        """What the message says: one of the upgrade's messages, or the application's version."""
        version = self._version
        if version is not None and message[:3] == (version.can_id, version.mode, version.command):
            return version.content.from_data(message.data)
        return decode(message)
