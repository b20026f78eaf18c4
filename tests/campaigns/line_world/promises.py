"""What the station owes to people beside the right unit, judged by what they scanned and by what
became of the unit that was in the socket when a run began.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from flasher.mock.table import BootloaderState
from flasher.station.events import (
    RunEnded,
    RunStarted,
    ScanAccepted,
    SocketChanged,
    SocketState,
    StationEvent,
    StepEnded,
)
from flasher.station.records.model import RunState, StepName, StepState
from flasher.station.socket import SCANNER
from tests.campaigns.line_world.clockwork import PaperUnit

_AFTER_FLASH: Final = (StepName.WRITE, StepName.RESTART, StepName.VERIFY)
SETTLED_S: Final = 4.0
"""So long after its start a station knows what is in its sockets."""


_OF_ANOTHER: Final = ("UNIT_CHANGED", "NOT_OBSERVED")
"""Codes of runs in which another unit may have been in the socket."""


class Violation(Exception):  # noqa: N818
    """What must never be: its kind, and what happened, in which socket."""

    def __init__(self, kind: str, text: str, socket: str = "") -> None:
        super().__init__(f"{kind}: {text}")
        self.kind = kind
        self.socket = socket


@dataclass
class _Run:
    """A run, and the unit that was in its socket when it began."""

    label: str
    unit: PaperUnit
    number: str | None
    """What the unit says that it is; None when it answers nothing."""
    had_application: bool
    operations: list[tuple[PaperUnit, int]]
    """All units that were in its socket, and how often each had been erased or written then."""
    is_identified: bool = False
    has_commanded: bool = False
    """It has sent a command after which a unit erases or writes. What a unit does without one was
    commanded before the run."""
    was_running: bool = False
    """It was pulled after it had answered and before its flash, while its application ran."""

    @property
    def is_flashed(self) -> bool:
        return self.has_commanded and self.unit.operations != self.operations[0][1]

    @property
    def has_flashed(self) -> bool:
        """A unit was flashed in it, perhaps another one."""
        return self.has_commanded and any(
            unit.operations != before for unit, before in self.operations
        )


class Promises:
    """Promises by the labels and sockets that they are about; raises Violation."""

    def __init__(self, number_of: Callable[[PaperUnit], str | None]) -> None:
        self._number_of = number_of
        self._sources: dict[str, str] = {}
        """Where each label was scanned last."""
        self._cancelled: set[str] = set()
        self._cards: set[str] = set()
        """Sources at which a card waits."""
        self._labels: dict[str, str] = {}
        """Labels that may wait, by their sources."""
        self._carded: set[str] = set()
        """Labels that were scanned with a card."""
        self._changed: set[str] = set()
        """Labels that were not flashed since a run in which the unit may have become another one.
        """
        self._runs: dict[str, _Run] = {}
        self._aborted: set[str] = set()
        """Sockets whose run somebody aborts."""
        self._interrupted: dict[str, tuple[str, float | None]] = {}
        """Labels of runs that a dead station left, by socket, and when that has to be shown."""

    def hear(self, event: StationEvent, unit_in: Callable[[str], PaperUnit | None]) -> None:
        """An event of the station."""
        match event:
            case ScanAccepted(text=text, source=source):
                self._scanned(text, source)
            case RunStarted(socket=socket, serial=label):
                self._begun(socket, label, unit_in(socket))
            case StepEnded(step=StepName.IDENTIFY, state=StepState.PASS, socket=socket):
                if socket in self._runs:
                    self._runs[socket].is_identified = True
            case RunEnded():
                self._ended(event)

    # -- scans ------------------------------------------------------------------------------------

    def _scanned(self, text: str, source: str) -> None:
        word, _, argument = text.partition(" ")
        match word:
            case "SOCKET":
                self.touched(argument)
                # Whether the label that was scanned before it still waits is not known here.
                self._cards.add(source)
                if source in self._labels:
                    self._carded.add(self._labels.pop(source))
            case "CANCEL":
                running = {run.label for run in self._runs.values()}
                own = {label for label, last in self._sources.items() if last == source}
                self._cancelled |= own - running
                self._cards.discard(source)
                self._labels.pop(source, None)
            case "FREE":
                self.touched(argument)
            case "ABORT":
                self._aborted.add(argument)
            case _ if not argument:
                is_mounted = source.startswith(SCANNER)
                self._interrupted.clear()
                self._label(text, source, has_card=is_mounted or source in self._cards)

    def _label(self, label: str, source: str, *, has_card: bool) -> None:
        self._sources[label] = source
        self._cancelled.discard(label)
        self._carded.discard(label)
        self._cards.discard(source)
        self._labels.pop(source, None)
        if has_card:
            self._carded.add(label)
        else:
            self._labels[source] = label

    # -- runs -------------------------------------------------------------------------------------

    def _begun(self, socket: str, label: str, unit: PaperUnit | None) -> None:
        self.touched(socket)
        self._aborted.discard(socket)
        if label in self._cancelled:
            raise Violation("CANCELLED", f"{label} was cancelled, and its run begins in {socket}")
        self._runs.pop(socket, None)
        if unit is not None:
            engine = unit.engine
            self._runs[socket] = _Run(
                label,
                unit,
                self._number_of(unit),
                # One that cannot be asked is not identified with an application either; one without
                # power announces its bootloader before anybody can ask its application.
                (engine.stored_image is not None and engine.has_power)
                or not engine.target.has_version_query,
                [(unit, unit.operations)],
            )

    def put(self, socket: str, unit: PaperUnit) -> None:
        self.touched(socket)
        if socket in self._runs:
            self._runs[socket].operations.append((unit, unit.operations))

    def flashes(self, socket: str) -> None:
        """A command left after which what is in a socket erases or writes its flash."""
        if socket in self._runs:
            self._runs[socket].has_commanded = True

    def pulled(self, socket: str, unit: PaperUnit, *, was_calm: bool) -> None:
        """`was_calm`: it was in the socket and detected for some time before the run."""
        self.touched(socket)
        run = self._runs.get(socket)
        if run is None or run.number is None or run.unit is not unit:
            return
        if (run.is_identified or was_calm) and not run.is_flashed:
            run.was_running = (
                run.was_running or run.unit.engine.state is BootloaderState.APPLICATION
            )

    def numbers_known(self, socket: str, step: StepName | None) -> frozenset[str]:
        """What the unit of the run that goes on in a socket may report in this step, without being
        another one; empty where it has not reported anything yet.
        """
        run = self._runs.get(socket)
        if run is None or run.number is None or step is None:
            return frozenset()
        if step in _AFTER_FLASH:
            return frozenset({run.number, run.label})
        return frozenset({run.number} if run.had_application and run.is_identified else ())

    def _ended(self, event: RunEnded) -> None:
        ended, run = event.run, self._runs.pop(event.socket, None)
        if ended.state is RunState.ABORTED and event.socket not in self._aborted:
            raise Violation(
                "ABORTED", f"the run of {event.serial} ended as if somebody had aborted it"
            )
        was_changed = event.serial in self._changed
        if ended.code in _OF_ANOTHER:
            self._changed.add(event.serial)
        elif run is None or run.has_flashed:
            self._changed.discard(event.serial)
        if run is None:
            return
        label = run.label
        own = run.number or ""
        says_other = own.startswith("W") and own != label
        if run.is_flashed and run.had_application and says_other:
            raise Violation(
                "TOUCHED",
                f"a unit that says that it is {own} was flashed as {label}",
                event.socket,
            )
        if run.is_flashed and not run.had_application and label not in self._carded:
            raise Violation(
                "UNIDENTIFIED",
                f"a unit without application was flashed as {label}, which was scanned without the"
                f" card of {event.socket}",
            )
        if ended.state is RunState.FAIL and run.was_running:
            raise Violation(
                "BLAMED",
                f"{label} was pulled before its flash, and is recorded as {ended.code}",
            )
        if ended.state is RunState.PASS and was_changed and not run.has_flashed:
            raise Violation(
                "TRUSTED", f"{label} passes without a flash, after a run with a changed unit"
            )

    # -- a dead station ---------------------------------------------------------------------------

    def died(self) -> None:
        """The station: what it worked on is to be rechecked."""
        self._interrupted = {socket: (run.label, None) for socket, run in self._runs.items()}
        self._changed -= {run.label for run in self._runs.values() if run.has_flashed}
        self._runs.clear()
        self._cards.clear()
        self._labels.clear()

    def restarted(self, now: float) -> None:
        self._interrupted = {
            socket: (label, now + SETTLED_S) for socket, (label, _) in self._interrupted.items()
        }

    def touched(self, socket: str) -> None:
        """Something befell what is in a socket, or somebody scans for it."""
        self._interrupted.pop(socket, None)

    def look(self, now: float, shown: Callable[[str], SocketChanged | None]) -> None:
        """Look at the tiles."""
        for socket, (label, due_at) in list(self._interrupted.items()):
            if due_at is None or now < due_at:
                continue
            del self._interrupted[socket]
            tile = shown(socket)
            if tile is not None and tile.state is SocketState.STOPPED:
                continue
            if tile is None or (tile.state, tile.serial) != (SocketState.SCAN, label):
                raise Violation(
                    "FORGOTTEN",
                    f"the run of {label} in {socket} was interrupted, and {socket} does not say so",
                )
