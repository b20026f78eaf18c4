"""Parts of a dialogue that stand for themselves: one packet's record, and two senders on one id."""

from __future__ import annotations

from dataclasses import dataclass

from flasher.protocol.frame import Frame
from flasher.protocol.spec import COMMAND_SIZE, HEADER, OVERHEAD_SIZE, PREFIX_SIZE, Mode
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.trace.story import PacketStory


@dataclass(slots=True)
class PacketRecord:
    """One packet in one attempt."""

    number: int
    attempt: int
    sent_at_s: float
    left_s: float
    tries: int = 1
    naks: int = 0
    answered_at_s: float | None = None
    answer_s: float | None = None

    @property
    def is_clean(self) -> bool:
        """True while nothing went wrong with it."""
        return self.tries == 1 and not self.naks

    def story(self) -> PacketStory:
        """As it is told."""
        return PacketStory(
            self.number,
            self.attempt,
            self.tries,
            self.naks,
            self.sent_at_s,
            self.answered_at_s,
            self.answer_s,
        )


class Interleaving:
    """Finds messages that begin inside another one on the same id: two senders at once."""

    def __init__(self) -> None:
        self.found = 0
        self._left = 0
        self._last_at = 0.0

    def frame(self, frame: Frame, now: float) -> None:
        """One frame on the id."""
        data = frame.data
        if _is_head(data):
            soon = now - self._last_at <= DEFAULT_TIMINGS.inter_frame_timeout_s
            if self._left > 0 and soon:
                self.found += 1
            self._left = OVERHEAD_SIZE + data[PREFIX_SIZE - 1]
        self._left -= len(data)
        self._last_at = now

    def answered(self) -> None:
        """The other side spoke: the message was over, whatever is missing here."""
        self._left = 0


def _is_head(data: bytes) -> bool:
    return (
        len(data) > PREFIX_SIZE + 1
        and data.startswith(HEADER)
        and data[len(HEADER)] in (Mode.READ, Mode.WRITE)
        and data[PREFIX_SIZE + 1] == data[PREFIX_SIZE - 1] - COMMAND_SIZE
    )
