"""State of one socket: its process, its unit, the unit's label and the last run.

A unit is detected by its frames. A silent one may sleep; it counts as removed only if it would
report its serial number on waking up. A unit that announces a power-up, or reports another serial
number, may be another one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.events import LineStopped, SocketState
from flasher.station.messages import PresenceChanged
from flasher.station.records.model import RunState, UnitState

Shown = tuple[SocketState, str, str]
"""State, serial number and text of a socket."""


@dataclass(frozen=True)
class Source:
    """Origin of scans: a scanner, page or terminal. Sources with the same name are equal."""

    name: str = ""
    """Name in events and messages, for example "scanner left"."""
    socket: str = field(default="", compare=False)
    """Socket at which the scanner is mounted."""


SCANNER: Final = "scanner "
PAGE: Final = "page "
"""Prefix of the names of browser sessions."""
TERMINAL: Final = Source("terminal")
PIPE: Final = Source("standard input")
FILE: Final = Source("file of scans")
UNNAMED: Final = Source()
"""The source of a program that has only one."""
PLANT_ASKED: Final = text("The plant is asked about this unit.")
_SHOWN: Final = {
    TERMINAL.name: text("terminal"),
    PIPE.name: text("standard input"),
    FILE.name: text("file of scans"),
    UNNAMED.name: text("a program"),
}


def source_words(name: str) -> str:
    """Name of a source, for people."""
    if name.startswith(SCANNER):
        return text("scanner {name}", name=printable(name.removeprefix(SCANNER)))
    if name.startswith(PAGE):
        return text("page {number}", number=printable(name.removeprefix(PAGE)))
    return _SHOWN.get(name, printable(name))


class SocketPhase(Enum):
    """Progress of a socket's run."""

    REST = "no run"
    CLAIM = "a run is being claimed in the records"
    RUN = "the process of the socket runs the unit"
    SAVE = "the run has ended, but is not on disk"


class Occupancy(Enum):
    """Whether a unit is in the socket."""

    UNKNOWN = "not known yet: the process has just started"
    THERE = "frames of a unit are received"
    SILENT = "no frames are received: no unit, or a sleeping one"
    EMPTY = "no unit"


class Binding(Enum):
    """How a label was assigned to a socket."""

    PROMPTED = "the station named the socket, in which the unit has yet to arrive"
    CONFIRMED = "the socket's card was scanned with it, or the unit reported its number"
    ONLY_SOCKET = "the station has one socket"


@dataclass(frozen=True)
class LastRun:
    """The last run in a socket, while its unit may still be there."""

    serial: str
    outcome: RunState | None = None
    """None until the outcome is on disk."""
    action: str = ""
    has_sent: bool = False
    """The unit has sent a frame since the run."""
    has_answered: bool = False
    """The unit has answered since the run, with or without a serial number."""
    has_reported_serial: bool = False
    """The unit has reported its serial number since the run."""


def _state_after(outcome: RunState) -> SocketState:
    return SocketState(UnitState.after(outcome).value)


@dataclass
class Socket:
    """A socket; only `Line` changes it."""

    name: str
    is_virtual: bool = False
    phase: SocketPhase = SocketPhase.REST
    out_of_service: str | None = ""
    """Reason why the socket cannot work; "" while it starts, None if it works."""
    sees_units: bool = True
    occupancy: Occupancy = Occupancy.UNKNOWN
    own: str | None = None
    """Serial number that the unit reports; "": it has none; None: not reported yet."""
    is_own_known: bool = False
    """`own` is a serial number of the recipe, so it identifies the unit."""
    virtual_label: str = ""
    """Label of the virtual unit."""
    label: str = ""
    """Label of the next run."""
    binding: Binding = Binding.CONFIRMED
    source: Source = UNNAMED
    """Source at which the label was scanned."""
    begin_at_s: float | None = None
    """Time at which the run starts even if no unit is detected or identified."""
    bound_at_s: float = 0.0
    """Time at which the label was assigned."""
    presence_number: int = 0
    """Number of the last reported change of presence."""
    changed_at_s: float = float("-inf")
    """Time at which its unit left or may have been exchanged, or a run ended."""
    arrived_at_s: float = 0.0
    """Time at which its unit was detected."""
    is_in_bootloader: bool = False
    """The unit sends only bootloader announcements, so it cannot report its serial number."""
    serial: str = ""
    """Serial number of the active run."""
    last: LastRun | None = None
    is_last_there: bool = False
    """The unit of the last run may still be there: no frame suggests another one."""
    asked: str = ""
    """Label about which the plant is asked; its answer is outstanding."""
    is_chosen: bool = False
    """The card of the socket was scanned, and the label must follow."""
    interrupted: str = ""
    """Serial number of a run in this socket that was interrupted by the end of the station."""
    note: str = ""
    """Error of the last label, or of saving."""
    note_until_s: float | None = None
    """Time until which the note about a dropped scan is shown."""
    out_since_s: float = 0.0
    """Start of the present outage."""
    shown: Shown | None = None
    """State, serial number and text that were reported last."""

    @property
    def can_work(self) -> bool:
        """True if the process of the socket runs and its adapter is open."""
        return self.out_of_service is None

    @property
    def is_there(self) -> bool:
        """True while a unit is detected in the socket."""
        return self.occupancy is Occupancy.THERE

    @property
    def is_running(self) -> bool:
        """True from the claim until the process has reported the end of the run."""
        return self.phase in (SocketPhase.CLAIM, SocketPhase.RUN)

    @property
    def is_busy(self) -> bool:
        """True while a run is active, not saved yet, or has its label."""
        return self.phase is not SocketPhase.REST or bool(self.label)

    @property
    def state(self) -> SocketState:
        """State that was reported last."""
        return SocketState.STARTING if self.shown is None else self.shown[0]

    @property
    def verdict(self) -> LastRun | None:
        """The last run, while its unit is assumed to be in the socket."""
        last = self.last
        if last is None or last.outcome is None or self.occupancy is Occupancy.EMPTY:
            return None
        return last if self.is_last_there else None

    @property
    def holds(self) -> LastRun | None:
        """The last run, while its unit is detected or not known to be removed."""
        return None if self.occupancy is Occupancy.SILENT else self.verdict

    @property
    def awaits_label(self) -> bool:
        """True if the socket holds a unit without a label."""
        is_free = self.can_work and self.phase is SocketPhase.REST and not self.label
        return is_free and self.is_there and self.verdict is None

    @property
    def is_starting(self) -> bool:
        """True while it is unknown whether a unit is in the socket."""
        if self.phase is not SocketPhase.REST or self.verdict is not None:
            return False
        is_listening = self.sees_units and self.occupancy is Occupancy.UNKNOWN
        return self.out_of_service == "" or (self.can_work and is_listening)

    # -- the unit in it ---------------------------------------------------------------------------

    def is_exchange(self, what: PresenceChanged) -> bool:
        """True if the detected unit may be another one than a moment ago."""
        is_other = None not in (self.own, what.serial) and self.own != what.serial
        return self.is_there and what.is_there and (what.is_power_up or what.was_missed or is_other)

    @property
    def has_passed(self) -> bool:
        """True if the last run passed, wherever its unit is now."""
        return self.last is not None and self.last.outcome is RunState.PASS

    def note_unit(self, what: PresenceChanged, *, is_serial: bool) -> bool:
        """Note a unit that was detected or reported its serial number; `is_serial`: a number of the
        recipe. True if it is another unit than before.
        """
        before, self.occupancy = self.occupancy, Occupancy.THERE
        self.is_in_bootloader = what.is_in_bootloader
        is_starting = what.is_power_up or what.is_in_bootloader
        if before is Occupancy.UNKNOWN and self.has_passed and is_starting:
            # A unit that has passed runs its application: another one was put in, unobserved.
            before = Occupancy.SILENT
        if what.serial is not None:
            self.own, self.is_own_known = what.serial, is_serial
        is_new = self._is_new(before) or bool(what.label)
        if is_new:
            self._forget_note()
            self.virtual_label = what.label
        return is_new

    def _is_new(self, before: Occupancy) -> bool:
        last = self.last
        if last is None:
            return before is not Occupancy.THERE
        if self.own == last.serial:
            self.last = replace(last, has_sent=True, has_answered=True, has_reported_serial=True)
            self.is_last_there = True
            return False
        reports_other = self.own is not None and (last.has_reported_serial or self.is_own_known)
        if reports_other or before in (Occupancy.SILENT, Occupancy.EMPTY):
            # Another unit; or one that was silent for a while, and has not identified itself.
            was_last, self.is_last_there = self.is_last_there, False
            return was_last or before is not Occupancy.THERE
        has_answered = last.has_answered or self.own is not None
        self.last = replace(last, has_sent=True, has_answered=has_answered)
        return False

    def _forget_note(self) -> None:
        """Clear the note about the previous unit."""
        if self.phase is SocketPhase.REST and self.note_until_s is None:
            self.note = ""

    def fall_silent(self, *, is_certain: bool) -> bool:
        """Note that no unit is detected any more; `is_certain`: none is there. True if one was."""
        before = self.occupancy
        last = self.last
        # One that has passed has answered at the end of its run: it does not sleep, it was pulled,
        # in the middle of its next answer perhaps. Nor does one that has reported its number since,
        # whatever happened to the adapter.
        is_pulled = (
            last is not None
            and self.has_passed
            and (not last.has_answered or (last.has_reported_serial and self.is_last_there))
        )
        is_out = is_certain or self.is_own_known or is_pulled or before is Occupancy.EMPTY
        self.occupancy = Occupancy.EMPTY if is_out else Occupancy.SILENT
        if is_out:
            self.is_last_there = False
        self.own, self.is_own_known, self.virtual_label, self.is_in_bootloader = (
            None,
            False,
            "",
            False,
        )
        self._forget_note()
        if is_certain:
            self.last = None
        return before is Occupancy.THERE

    def release_label(self) -> str:
        """Remove the label from the socket and return it."""
        label, self.label, self.begin_at_s = self.label, "", None
        if label and self.occupancy is Occupancy.EMPTY:
            self.occupancy = Occupancy.SILENT  # its unit may have been put in, and sleep
        return label

    def is_of_another(self, label: str) -> bool:
        """True if the unit reports another serial number than the label."""
        return self.is_there and self.is_own_known and self.own != label

    @property
    def has_card(self) -> bool:
        """True if the label was scanned with the socket's card, or the unit is virtual."""
        return self.binding is Binding.CONFIRMED or self.is_virtual

    @property
    def is_unidentified(self) -> bool:
        """True if the label was scanned without the socket's card, and the unit has not identified
        itself: it does not answer, or is in its bootloader.
        """
        could_say = self.sees_units and self.binding is Binding.PROMPTED and not self.virtual_label
        return (
            self.binding is not Binding.CONFIRMED
            and self.is_there
            and (self.is_in_bootloader or (could_say and self.own is None))
        )

    def is_due(self, now: float) -> bool:
        """True if the run can start: the unit of the label is present, as far as known."""
        is_free = self.can_work and self.phase is SocketPhase.REST and not self.is_chosen
        if not (self.label and is_free) or self.is_unidentified:
            return False
        # While it is not known whether a unit is there, nothing begins.
        is_known = self.occupancy is not Occupancy.UNKNOWN
        is_time = self.begin_at_s is not None and now >= self.begin_at_s and is_known
        if self.binding is Binding.PROMPTED:
            # The unit was put in, and has identified itself or had time to.
            has_arrived = self.is_there and self.begin_at_s is not None
            is_time = has_arrived and (self.own is not None or is_time)
        else:
            is_time = self.is_there or is_time
        return is_time and not self.is_of_another(self.label)

    # -- what it shows ----------------------------------------------------------------------------

    @property
    def wanted(self) -> str:
        """The operator's next action for the label."""
        shown = printable(self.label)
        if self.binding is not Binding.PROMPTED:
            return text("Connect {label}.", label=shown)
        if self.verdict is not None:
            before = printable(self.verdict.serial)
            return text("Take {before} out, then connect {label}.", before=before, label=shown)
        return text("Put {label} into socket {socket}.", label=shown, socket=self.name)

    def view(self, stopped: LineStopped | None, *, is_only: bool) -> Shown:
        """The displayed state. `stopped`: reason of a stopped line; `is_only`: the only socket."""
        if self.is_running:
            return SocketState.RUNNING, self.serial, ""
        if self.phase is SocketPhase.SAVE:
            return SocketState.ERROR if self.note else SocketState.SAVING, self.serial, self.note
        if self.is_chosen:
            words = text("Scan the label of the unit that is in this socket, or goes into it.")
            return SocketState.SCAN, self.label, words
        last = self.verdict
        if last is not None and last.outcome is not None and not self.label:
            shown = last.action if self.note_until_s is None else self.note
            return _state_after(last.outcome), last.serial, shown
        if self.out_of_service is not None:
            state = SocketState.ERROR if self.out_of_service else SocketState.STARTING
            return state, self.label, self.out_of_service or (self.wanted if self.label else "")
        if stopped is not None:
            return SocketState.STOPPED, "", stopped.reason
        if self.label and self.label == self.asked:
            return SocketState.STARTING, self.label, PLANT_ASKED
        if self.label:
            own = printable(self.own or "")
            wanted = self.wanted
            if self.is_of_another(self.label):
                wanted = text("The unit in it reports {own}. {wanted}", own=own, wanted=self.wanted)
            return SocketState.SCAN, self.label, wanted
        if self.is_starting:
            return SocketState.STARTING, "", text("Listening for a unit.")
        needs_card = not is_only or self.is_in_bootloader
        card = text(" and SOCKET {socket}", socket=self.name) if needs_card else ""
        return self._view_free(card)

    def _view_free(self, card: str) -> Shown:
        """The view without a label; `card` is the scan that must accompany the label."""
        own = printable(self.virtual_label)
        label = text(" Its label is {label}.", label=own) if own else ""
        if self.interrupted:
            sentence = text(
                "{serial} was interrupted here: scan its label{card}.{virtual}",
                serial=printable(self.interrupted),
                card=card,
                virtual=label,
            )
            return SocketState.SCAN, self.interrupted, sentence
        if self.note:
            return SocketState.SCAN, "", text("{note}{virtual}", note=self.note, virtual=label)
        if self.is_there:
            asked = self._asked_for(card)
            return SocketState.SCAN, "", text("{note}{virtual}", note=asked, virtual=label)
        if self.occupancy is Occupancy.EMPTY:
            return SocketState.EMPTY, "", ""
        return SocketState.SILENT, "", text("No frames are received: no unit, or a sleeping one.")

    def _asked_for(self, card: str) -> str:
        if self.is_own_known:
            own = printable(self.own or "")
            return text("It reports {own}: scan its label.", own=own)
        last = self.last
        if last is None or last.outcome is None:
            return text("Scan the label of the unit{card}.", card=card)
        return text(
            "It was off or silent after {state} of {serial}: if this is another unit,"
            " scan its label{card}.",
            state=_state_after(last.outcome).value,
            serial=printable(last.serial),
            card=card,
        )
