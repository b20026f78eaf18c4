"""List of steps in a story: acknowledged packets folded, error frames counted, length limited."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Final

from flasher.protocol.spec import Node
from flasher.trace.decoder import BusEvent, Kind
from flasher.trace.story import PacketRun, Step, StepKind, StoryLine

MAX_STEPS: Final = 1000
"""Maximum number of lines in a list: its first and its last half are kept."""
_VALUE_WIDTH: Final = 64
"""Characters of a value, which is truncated after them."""
_ERRORS: Final = "error frames"


class StepList:
    """Collects lines; `fold` combines packets that were sent once and acknowledged into runs."""

    def __init__(self, *, fold: bool = True, limit: int = MAX_STEPS) -> None:
        self._fold = fold
        self._head: list[StoryLine] = []
        self._half = max(1, limit // 2)
        self._tail: deque[StoryLine] = deque(maxlen=self._half)
        self._taken = 0
        self._pending: tuple[int, float, Step] | None = None
        """Packet that waits for its ACK: number, begin, and its line if none arrives."""
        self._run: PacketRun | None = None
        self._errors = 0
        self._errors_at = (0.0, 0.0)

    @property
    def left_out(self) -> int:
        """Number of lines dropped."""
        return self._taken - len(self._head) - len(self._tail)

    def add(self, step: Step) -> None:
        self._flush()
        self._keep(step)

    def packet(self, number: int, begin_s: float, step: Step) -> None:
        """Add a packet; it gets its own line unless its ACK follows directly."""
        if not self._fold:
            self.add(step)
            return
        self._flush_errors()
        if self._pending is not None:
            self._flush()
        self._pending = (number, begin_s, step)

    def ack(self, number: int, step: Step) -> None:
        """Add an ACK; with the packet before it, it extends a run."""
        if self._pending is None or self._pending[0] != number:
            self.add(step)
            return
        begin_s = self._pending[1]
        self._pending = None
        if self._run is not None and self._run.last == number - 1:
            self._run = PacketRun(self._run.first, number, self._run.begin_s, step.at_s)
        else:
            self._flush_run()
            self._run = PacketRun(number, number, begin_s, step.at_s)

    def error_frame(self, at_s: float) -> None:
        """Add an error frame; consecutive ones share a line."""
        if not self._errors:
            self._flush()
            self._errors_at = (at_s, at_s)
        self._errors += 1
        self._errors_at = (self._errors_at[0], at_s)

    def lines(self) -> tuple[StoryLine, ...]:
        self._flush()
        return (*self._head, *self._tail)

    def _keep(self, line: StoryLine) -> None:
        self._taken += 1
        if len(self._head) < self._half:
            self._head.append(line)
        else:
            self._tail.append(line)

    def _flush(self) -> None:
        self._flush_errors()
        self._flush_run()
        if self._pending is not None:
            step = self._pending[2]
            self._pending = None
            self._keep(step)

    def _flush_run(self) -> None:
        if self._run is not None:
            self._keep(self._run)
            self._run = None

    def _flush_errors(self) -> None:
        if self._errors:
            begin_s, end_s = self._errors_at
            text = f"{self._errors:,}"
            if self._errors > 1:
                text += f" within {end_s - begin_s:.3f} s"
            self._errors = 0
            self._keep(Step(begin_s, StepKind.ERROR_FRAMES, "", "", _ERRORS, text, is_trouble=True))


def mark_unanswered(steps: StepList, device: str, *, is_over: bool) -> tuple[StoryLine, ...]:
    """Return the lines of an upgrade, with unanswered messages of the tool to `device` marked as
    trouble. `is_over`: nothing followed the last one.
    """
    lines = list(steps.lines())
    gap = len(lines) // 2 - 1 if steps.left_out else None
    is_answered = not is_over
    for index in reversed(range(len(lines))):
        line = lines[index]
        if index == gap:
            is_answered = True
        if isinstance(line, PacketRun):
            is_answered = False
        elif line.sender == device:
            is_answered = True
        elif line.sender == Node.CDL.name and line.kind is StepKind.MESSAGE:
            if not is_answered:
                text = f"{line.text}, not answered".removeprefix(", ")
                lines[index] = replace(line, text=text, is_trouble=True)
            is_answered = False
    return tuple(lines)


def step_of(event: BusEvent, at_s: float) -> Step:
    """Convert a bus event to a line."""
    kind = StepKind.DAMAGED if event.kind is Kind.DAMAGED else StepKind.MESSAGE
    width = None if event.is_alarm else _VALUE_WIDTH  # no fault is left out
    # Image bytes, and a constant text that repeats the title, add nothing.
    fields = (shown for shown in event.fields if shown.name not in ("payload", "text"))
    values = ", ".join(shown.words(width) for shown in fields)
    return Step(
        at_s,
        kind,
        event.sender,
        event.receiver,
        event.title,
        values,
        is_trouble=event.is_trouble,
        can_id=event.can_id,
    )
