"""How `flasher monitor` shows what a watcher sees: line by line, or as JSON lines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, Self

from flasher.cli.documents import FieldValue
from flasher.cli.output import Output
from flasher.protocol.frame import Frame
from flasher.trace.decoder import BusEvent, Kind
from flasher.trace.watcher import Board, Pulse, RawFrame

_VALUE_WIDTH: Final = 64
"""Longer values are cut in lines, unless -v is given."""


@dataclass(frozen=True)
class SeenLine:
    """A message, a damage or a foreign frame, decoded. `from` and `to` are nodes, "all", or empty
    for an id of no node.
    """

    at_s: float
    """Since the first of them."""
    kind: Kind
    can_id: int
    command: int | None
    from_: str
    to: str
    message: str
    """Its title in the documents."""
    trouble: bool
    fields: dict[str, FieldValue]
    changed: list[str]
    """Fields that differ from the same message before."""
    in_dialect: bool
    """False for a message that the document of --dialect does not have."""
    event: Literal["Seen"] = "Seen"


@dataclass(frozen=True)
class FrameLine:
    """A CAN frame as it came (--raw)."""

    at_s: float
    kind: Literal["frame"]
    can_id: int
    data: str
    """In hexadecimal."""
    extended: bool
    remote: bool
    error: bool
    event: Literal["Frame"] = "Frame"


class View:
    """Takes the watcher's events; times are counted from the first of them."""

    is_live = False
    """True when it wants to be refreshed from time to time."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.board = Board()
        self.name = ""
        self.messages = 0
        self.troubles = 0
        self._origin: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Nothing is held."""

    def __call__(self, event: object) -> None:
        """Show one event."""
        match event:
            case BusEvent():
                self.messages += 1
                self.troubles += event.is_trouble
                self.show(event, self.since(event.at), self.board.add(event))
            case RawFrame(at, frame):
                self.show_frame(frame, self.since(at))
            case Pulse(at):
                self.refresh(at)

    def since(self, at: float) -> float:
        """Seconds since the first event."""
        if self._origin is None:
            self._origin = at
        return at - self._origin

    def show(self, seen: BusEvent, at_s: float, changed: frozenset[str]) -> None:
        """A message, a damage, a foreign frame."""

    def show_frame(self, frame: Frame, at_s: float) -> None:
        """A frame, where frames are wanted."""

    def refresh(self, now: float) -> None:
        """The time to refresh has come."""


class Lines(View):
    """One line, or one JSON document, for each."""

    def show(self, seen: BusEvent, at_s: float, changed: frozenset[str]) -> None:
        # No fault is left out.
        width = None if seen.is_alarm or self.output.verbosity >= 1 else _VALUE_WIDTH
        said = ", ".join(
            shown.words(width, "*" if shown.name in changed else "") for shown in seen.fields
        )
        mark = "! " if seen.is_trouble else ""
        text = f"{at_s:10.3f}  {seen.can_id:03X}  {seen.route:<9}  {mark}{seen.marked_title}"
        self.output.result(f"{text}: {said}" if said else text)
        self.output.line(
            SeenLine(
                at_s=round(at_s, 6),
                kind=seen.kind,
                can_id=seen.can_id,
                command=seen.command,
                from_=seen.sender,
                to=seen.receiver,
                message=seen.title,
                trouble=seen.is_trouble,
                fields={shown.name: shown.value for shown in seen.fields},
                changed=sorted(changed),
                in_dialect=seen.in_dialect,
            )
        )

    def show_frame(self, frame: Frame, at_s: float) -> None:
        words = [f"[{len(frame.data)}]", *filter(None, [frame.data.hex(" ")])]
        words += ["29-bit id"] * frame.is_extended
        words += ["remote request"] * frame.is_remote + ["error frame"] * frame.is_error
        self.output.result(f"{at_s:10.3f}  {frame.can_id:03X}  {' '.join(words)}")
        self.output.line(
            FrameLine(
                at_s=round(at_s, 6),
                kind="frame",
                can_id=frame.can_id,
                data=frame.data.hex(),
                extended=frame.is_extended,
                remote=frame.is_remote,
                error=frame.is_error,
            )
        )
