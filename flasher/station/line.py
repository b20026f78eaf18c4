"""The line of a station as a pure state machine: which label belongs to which socket, which runs
are started, and what each socket shows.

    scans, units that come and go, what a socket's process said, what is saved, the time
        -> Line ->
    events, claims, aborts, and entries of the audit trail

It does no I/O and reads no clock: times are seconds on the station's monotonic clock. `Station`
carries out its effects and feeds back their results. The rule that assigns labels to sockets is in
`flasher.station.scans`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Final

from flasher.protocol.text import printable
from flasher.said import say
from flasher.station import codes
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OperatorPrompted,
    PinAwaited,
    PinEnded,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    StationEvent,
    UnitArrived,
    UnitRemoved,
)
from flasher.station.messages import AdapterDown, PresenceChanged, Ready
from flasher.station.people import HIDDEN, Asked, Crew
from flasher.station.pins import FORM_WORDS, Pin, is_form
from flasher.station.records.errors import Refusal
from flasher.station.records.model import AuditEvent, RunState
from flasher.station.scans import (
    Command,
    Label,
    NotUnderstood,
    Refused,
    Word,
    check_first,
    check_fits,
    check_free,
    check_known,
    check_one_socket,
    check_service,
    place,
    still_there,
    understand,
    was_in,
)
from flasher.station.socket import Binding, LastRun, Occupancy, Phase, Socket

ARRIVAL_LIMIT_S: Final = 20.0
SCAN_LIMIT_S: Final = 120.0
"""After this time a label without its unit, or a socket without its label, is forgotten."""
CARD_LIMIT_S: Final = 15.0
"""The label has to follow the card of its socket within this time."""
SHORT_OUTAGE_S: Final = 3.0
"""A restart of the process takes less; a unit cannot be swapped in this time."""
REACH_S: Final = 2.0
"""A unit that is heard sooner after the prompt was in the socket before."""
IDENTIFY_S: Final = 3.0
"""A unit with an application reports its serial number within this time after power-on."""
_RESUME: Final = Word.RESUME.value.lower()
_REPRINT: Final = Word.REPRINT.value.lower()
_PIN: Final = "pin"
_FORGOTTEN: Final = "FORGOTTEN"
_AGAIN: Final = say("Scan it again.")
_NOTHING: Final = say("Nothing to do.")


# -- inputs and effects ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Claimed:
    """The claim is in the records; the process of the socket works on the run."""


@dataclass(frozen=True)
class NotClaimed:
    """The records refused the claim. `code` is a stable word; `stops_line` stops the line."""

    code: str
    reason: str
    remedy: str
    stops_line: bool = False


@dataclass(frozen=True)
class Ended:
    """The process reported the end of the run; the outcome is not on disk yet."""


@dataclass(frozen=True)
class Saved:
    """The outcome of the run is on disk. `action` tells the operator what to do."""

    outcome: RunState
    action: str


@dataclass(frozen=True)
class NotSaved:
    """A part of the run could not be saved."""

    reason: str
    remedy: str


SocketInput = (
    Ready | AdapterDown | PresenceChanged | Claimed | NotClaimed | Ended | Saved | NotSaved
)


@dataclass(frozen=True)
class ClaimRun:
    """Claim a run in the records; answered by `Claimed`, `NotClaimed` or `NotSaved`."""

    socket: str
    serial: str
    operator: str
    lot: str
    reason: str


@dataclass(frozen=True)
class SaveAgain:
    """Save the outcomes of these sockets again; then call `Line.resumed`."""

    sockets: tuple[str, ...]


@dataclass(frozen=True)
class AbortRun:
    """Stop the run of this socket at its next safe place."""

    socket: str


@dataclass(frozen=True)
class CheckPin:
    """Compare a PIN with its hash; then call `Line.pin_checked`, and give no scan before."""

    pin: Pin
    pin_hash: str


@dataclass(frozen=True)
class Reprint:
    """Print the label of this unit once more, if it has passed, when that is in the audit trail
    with `data`; then call `Line.reprinted`.
    """

    serial: str
    data: Mapping[str, str]


@dataclass(frozen=True)
class Audit:
    """Add an action of a person to the audit trail."""

    what: AuditEvent
    data: Mapping[str, str]


Effect = ClaimRun | SaveAgain | AbortRun | CheckPin | Reprint | Audit | StationEvent
"""An event is to be published."""


# -- the line -------------------------------------------------------------------------------------


CheckSerial = Callable[[str], object]
"""Raises ValueError for a text that is no serial number of the recipe."""


class Line:
    """All sockets and the scans. After each call, `take` returns the effects, in their order.

    `arrival_limit_s`: a label with a scanned socket waits this long for its unit; then the run
    starts all the same and reports the fault. `crew`: who has a badge; None: people are taken at
    their word.
    """

    def __init__(
        self,
        sockets: Iterable[Socket],
        check_serial: CheckSerial,
        *,
        operator: str,
        lot: str = "",
        arrival_limit_s: float = ARRIVAL_LIMIT_S,
        scans_labels: bool = False,
        crew: Crew | None = None,
    ) -> None:
        self.sockets = {socket.name: socket for socket in sockets}
        self.operator = operator
        self.lot = lot
        self.stopped: LineStopped | None = None
        """Why the line is stopped; None while it runs."""
        self.is_checking_pin = False
        """A PIN is being checked: no scan may be given meanwhile."""
        self.is_closing = False
        """No further run is begun."""
        self._check_serial = check_serial
        self._arrival_limit_s = arrival_limit_s
        self._scans_labels = scans_labels
        self._crew = crew or Crew(())
        self._effects: list[Effect] = []
        self._label = ""
        """The label that waits for the card of its socket."""
        self._chosen: Socket | None = None
        """The socket whose card was scanned, and that waits for its label."""
        self._is_choice_refused = False
        """The last card was refused: the label that follows must not go to another socket."""
        self._forget_at_s: float | None = None
        self._reason = ""
        """Given by REASON, for the next label."""
        self._reasons: dict[str, str] = {}
        """Reasons by label, so that a run that starts in between does not take another one's."""

    def take(self) -> list[Effect]:
        """The effects since the last call; call again after feeding back a result."""
        effects, self._effects = self._effects, []
        return effects

    # -- the table of a socket --------------------------------------------------------------------

    def feed(self, name: str, what: SocketInput, now: float) -> None:
        """Handle an input of a socket. A pair missing in the table is a bug (KeyError)."""
        socket = self.sockets[name]
        self._TABLE[socket.phase][type(what)](self, socket, what, now)
        self._go_on(now)

    def _ready(self, socket: Socket, what: Ready, now: float) -> None:
        if socket.can_work:
            return  # an adapter that was opened anew between two looks at it
        was_short = now - socket.out_since_s < SHORT_OUTAGE_S
        socket.is_last_there = socket.is_last_there and was_short
        socket.out_of_service, socket.sees_units = None, what.sees_units
        if not what.sees_units:
            socket.occupancy = Occupancy.SILENT

    def _down(self, socket: Socket, what: AdapterDown, now: float) -> None:
        if socket.can_work or not socket.out_since_s:
            socket.out_since_s = now
        socket.out_of_service = what.reason or say("It cannot work.")
        reason = say("Socket {socket} is out of service.", socket=socket.name)
        self._drop_label(socket, reason, say("Scan it again when it works again."))
        # What happens in it cannot be seen now. What was silent before stays doubtful.
        socket.own, socket.is_own_known = None, False
        if socket.occupancy is not Occupancy.SILENT:
            socket.occupancy = Occupancy.UNKNOWN

    def _unit(self, socket: Socket, what: PresenceChanged, now: float) -> None:
        """A unit is heard, reports its serial number, or is not heard any more."""
        if not what.is_there:
            self._silent(socket, is_certain=what.is_certain)
            return
        was_silent = socket.occupancy in (Occupancy.SILENT, Occupancy.EMPTY)
        is_new = socket.hear(what, is_serial=self._is_serial(what.serial or ""))
        if is_new:
            self._tell(UnitArrived(socket.name, what.how, what.label))
        if socket.phase is not Phase.REST:
            return
        if what.label and self._scans_labels and not socket.label:
            self._scan_borne(socket, what.label, now)
        elif (is_new or was_silent) and socket.label and socket.binding is Binding.NAMED:
            self._arrived_where_named(socket, what.label, now)
        elif self._label and socket.own == self._label and socket.awaits_label:
            serial = self._label
            self._forget_scans()
            self._bind(socket, serial, Binding.SAID, now)
        elif is_new:
            self._arrived_elsewhere(socket)

    def _silent(self, socket: Socket, *, is_certain: bool) -> None:
        if not socket.fall_silent(is_certain=is_certain):
            return
        self._tell(UnitRemoved(socket.name))
        if socket.binding is Binding.NAMED:
            socket.begin_at_s = None  # the one that arrived was not the one
        else:
            # It was meant for the unit that was there.
            reason = say("Its unit is not heard any more.")
            self._drop_label(socket, reason, say("Scan it again when it is connected."))

    def _arrived_where_named(self, socket: Socket, borne: str, now: float) -> None:
        if not borne and now < socket.bound_at_s + REACH_S:
            self._drop_label(
                socket,
                say("A unit was in socket {socket} already.", socket=socket.name),
                say("Scan it again with the card of its socket."),
            )
        elif borne and borne != socket.label:
            reason = say(
                "The unit in socket {socket} bears {label}.", socket=socket.name, label=borne
            )
            remedy = say("Scan {label}.", label=borne)
            self._refuse(socket.let_go(), "OTHER_UNIT", reason, remedy, socket)
        else:
            # It may be one that woke up: it is asked who it is before anything begins.
            socket.begin_at_s = now if borne else now + IDENTIFY_S

    def _arrived_elsewhere(self, socket: Socket) -> None:
        named = next(
            (e for e in self.sockets.values() if e.label and e.binding is Binding.NAMED), None
        )
        if named is not None and socket.awaits_label:
            text = say(
                "Wrong socket: {label} goes into socket {socket}. If it stays here, scan SOCKET"
                " {here}, then its label.",
                label=printable(named.label),
                socket=named.name,
                here=socket.name,
            )
            self._tell(OperatorPrompted(socket.name, text))

    def _claimed(self, socket: Socket, _what: Claimed, _now: float) -> None:
        socket.phase = Phase.RUN
        socket.last, socket.is_last_there, socket.note = None, False, ""
        for each in self.sockets.values():
            if each is socket or each.interrupted == socket.serial:
                each.interrupted = ""
        self._reasons.pop(socket.serial, None)

    def _not_claimed(self, socket: Socket, what: NotClaimed, _now: float) -> None:
        serial, socket.phase, socket.serial = socket.serial, Phase.REST, ""
        self._refuse(serial, what.code, what.reason, what.remedy, socket)
        socket.note = say("{reason} {remedy}", reason=what.reason, remedy=what.remedy)
        if what.stops_line:
            self.stop(what.code, what.reason, what.remedy)

    def _claim_failed(self, socket: Socket, what: NotSaved, _now: float) -> None:
        socket.phase, socket.serial = Phase.REST, ""
        self.stop(codes.RECORD_NOT_SAVED.name, what.reason, what.remedy)

    def _ended(self, socket: Socket, _what: Ended, now: float) -> None:
        socket.phase = Phase.SAVE
        socket.last, socket.is_last_there = LastRun(socket.serial), True
        # In the run it may have got its number: what is heard from now on counts.
        socket.own, socket.is_own_known = None, False
        if not socket.is_virtual and socket.sees_units:
            socket.occupancy = Occupancy.UNKNOWN

    def _saved(self, socket: Socket, what: Saved, _now: float) -> None:
        socket.phase, socket.note, socket.serial = Phase.REST, "", ""
        if socket.last is not None:
            socket.last = replace(socket.last, outcome=what.outcome, action=what.action)

    def _not_saved(self, socket: Socket, what: NotSaved, _now: float) -> None:
        """A part of a run is not saved: it cannot pass, and no other run is started."""
        if socket.phase is Phase.SAVE:
            socket.note = what.reason
        self.stop(codes.RECORD_NOT_SAVED.name, what.reason, what.remedy)

    # -- scans ------------------------------------------------------------------------------------

    def scan(self, text: str, now: float, mounted: str = "") -> None:
        """Something was scanned; `mounted`: by the scanner of this socket."""
        scanned = text.strip()
        crew = self._crew
        person = crew.find(scanned)
        if mounted and self._is_serial(scanned):  # not the PIN that a person may be typing
            socket = self.sockets[mounted]
            self._answer(
                printable(scanned)[:80], lambda: ("label", self._take_mounted(socket, scanned, now))
            )
        elif crew.asked is not None:
            self._take_pin(crew.asked, scanned, now)
        elif person is not None:
            crew.person = person
            before, self.operator = self.operator, person.name
            role = person.role.value
            self._audit(AuditEvent.OPERATOR, before=before, now=person.name, role=role)
            self._tell(ScanAccepted(printable(person.name), "badge"))
        elif crew.may_be_pin(scanned) and not self._is_serial(scanned):
            # Typed too late, or too often: it must not be shown in what is said of it.
            reason = say("No PIN is awaited, and it is no serial number of this recipe.")
            self._refuse(HIDDEN, "NO_PIN_AWAITED", reason, say("Scan first what needs the PIN."))
        else:
            self._answer(printable(scanned)[:80], lambda: self._understand(text, now))
        self._go_on(now)

    def _answer(self, shown: str, understand: Callable[[], tuple[str, Socket | None]]) -> None:
        """Tell what came of a scan that is `shown` so."""
        try:
            meaning, socket = understand()
        except Refused as refused:
            self._refuse(shown, refused.code, refused.reason, refused.remedy)
        else:
            if meaning not in (_RESUME, _REPRINT, _PIN):  # what came of it is said by other events
                name = "" if socket is None else socket.name
                self._tell(ScanAccepted(shown, meaning, name))

    def _understand(self, text: str, now: float) -> tuple[str, Socket | None]:
        """What a scan means, and for which socket. Raises Refused."""
        understood = understand(text)
        if isinstance(understood, Label):
            self._crew.check_somebody()
        was_refused, self._is_choice_refused = self._is_choice_refused, False
        match understood:
            case Label(serial):
                if was_refused:
                    raise Refused(
                        "NO_SOCKET",
                        say("The socket that was scanned before it cannot take it."),
                        say("Scan the card of a socket that can, then the label again."),
                    )
                return "label", self._take_label(serial, now)
            case Command(word, argument):
                person = self._crew.check_role(word)
                if person is not None and person.pin:
                    asked = self._crew.ask(person, word, argument, now)
                    self._tell(PinAwaited(person.name, asked.text, asked.until_s - now))
                    return _PIN, None
                return word.value.lower(), self._COMMANDS[word](self, argument, now)
            case NotUnderstood(why):
                raise Refused("NOT_UNDERSTOOD", why, say("Scan the label again."))

    # -- badges and PINs --------------------------------------------------------------------------

    def _take_pin(self, asked: Asked, scanned: str, now: float) -> None:
        """What was scanned while a PIN is awaited: it is never shown."""
        if scanned.upper() == Word.CANCEL.value:
            self._end_pin(asked, "CANCELLED", say("It was cancelled."), _NOTHING)
        elif is_form(scanned):
            self._crew.count_try(asked.person.name, now)
            self.is_checking_pin = True
            self._effects.append(CheckPin(Pin(scanned), asked.person.pin))
        else:
            self._refuse(
                HIDDEN,
                "NO_PIN",
                say("That is no PIN: it has {form}.", form=FORM_WORDS),
                say("Type the PIN of {name}, or scan CANCEL.", name=printable(asked.person.name)),
            )

    def pin_checked(self, now: float, *, is_right: bool) -> None:
        """Result of `CheckPin`."""
        crew = self._crew
        self.is_checking_pin = False
        asked = crew.asked
        if asked is None:
            return
        if is_right:
            crew.asked = None
            crew.was_right(asked.person.name)
            word, argument = asked.word, asked.argument
            self._tell(PinEnded(asked.person.name, is_right=True))
            self._answer(
                printable(asked.text)[:80],
                lambda: (word.value.lower(), self._COMMANDS[word](self, argument, now)),
            )
        elif remedy := crew.lock_words(asked.person.name, now):
            self._end_pin(asked, "PIN_LOCKED", say("Too many wrong PINs."), remedy)
        else:
            remedy = say("Type it again, or scan CANCEL.")
            self._refuse(HIDDEN, "WRONG_PIN", say("The PIN is wrong."), remedy)
        self._go_on(now)

    def _end_pin(self, asked: Asked, code: str, reason: str, remedy: str) -> None:
        """The override that waited for its PIN is refused."""
        self._crew.asked = None
        self._tell(PinEnded(asked.person.name, is_right=False))
        self._refuse(printable(asked.text)[:80], code, reason, remedy)

    # -- labels and commands ----------------------------------------------------------------------

    def _take_label(self, serial: str, now: float) -> Socket | None:
        """The socket that a label is for; None while it waits for one. Raises Refused."""
        chosen = self._chosen
        if chosen is not None:
            self._take_for_chosen(chosen, serial, now)
            return chosen
        self._check_label(serial)
        check_first(self.sockets, serial, self._label)
        placed = place(self.sockets, serial)
        if placed is None:
            self._keep_waiting(serial, now)
            return None
        socket, why = placed
        self._bind(socket, serial, why, now)
        if why is not Binding.SAID and not socket.is_due(now):
            self._tell(OperatorPrompted(socket.name, socket.wanted))
        return socket

    def _take_mounted(self, socket: Socket, serial: str, now: float) -> Socket:
        """A label of the scanner at a socket: as its card and the label. Raises Refused. What waits
        of another scanner goes on waiting.
        """
        self._crew.check_somebody()
        self._check_label(serial)
        self._check_takes(socket)
        self._check_for(socket, serial)
        if socket.label == serial:  # it scans by itself: nobody says that the unit is there
            raise Refused("DOUBLE_SCAN", say("It was scanned already."), socket.wanted)
        self._take_for(socket, serial, now)
        return socket

    def _take_for_chosen(self, chosen: Socket, serial: str, now: float) -> None:
        """A label behind the card of its socket. Raises Refused: the card was for this label."""
        try:
            self._check_label(serial)
            self._check_for(chosen, serial)
        except Refused:
            self._forget_scans()
            raise
        self._take_for(chosen, serial, now)

    def _check_for(self, socket: Socket, serial: str) -> None:
        check_free(socket)
        check_fits(self.sockets, socket, serial)
        check_one_socket(self.sockets, socket, serial)

    def _take_for(self, socket: Socket, serial: str, now: float) -> None:
        was_here = socket.label == serial
        for each in self.sockets.values():
            if each is socket or each.label == serial:
                each.let_go()  # what was scanned for it before, or it was put elsewhere
        if socket is self._chosen or serial == self._label:
            self._forget_scans()
        self._bind(socket, serial, Binding.SAID, now)
        if was_here:
            socket.begin_at_s = now  # said twice: do not wait until it is heard

    def _check_line(self) -> None:
        if self.stopped is not None:
            reason = say("The line stands: {reason}", reason=self.stopped.reason)
            remedy = say("{remedy} Then scan RESUME.", remedy=self.stopped.remedy)
            raise Refused("LINE_STOPPED", reason, remedy)

    def _check_label(self, serial: str) -> None:
        """Raises Refused for what is no label of this recipe, or can be run by nobody now."""
        self._check_line()
        try:
            self._check_serial(serial)
        except ValueError as error:
            raise Refused(
                Refusal.WRONG_SERIAL.value,
                say("No serial number of this recipe: {why}.", why=str(error)),
                say("Scan the label of the unit."),
            ) from error
        check_known(self.sockets, serial)

    def _keep_waiting(self, serial: str, now: float) -> None:
        if not any(each.can_work for each in self.sockets.values()):
            raise Refused(
                "SOCKET_BROKEN",
                say("No socket works."),
                say("Mend one of them, then scan it again."),
            )
        self._label, self._forget_at_s = serial, now + SCAN_LIMIT_S
        shown, before = printable(serial), was_in(self.sockets, serial)
        words = say("Scan the card of the socket that {label} is in, or goes into.", label=shown)
        if before is not None:
            words = say(
                "{label} was in socket {socket}. If it is still there, scan SOCKET {socket}; else"
                " the card of its socket.",
                label=shown,
                socket=before.name,
            )
        self._tell(OperatorPrompted("", words))

    def _take_socket(self, argument: str, now: float) -> Socket:
        self._is_choice_refused = True  # until nothing speaks against it
        socket = self._named(argument)
        self._check_line()
        self._check_takes(socket)
        if self._label:
            check_fits(self.sockets, socket, self._label)
            serial = self._label
            self._forget_scans()
            self._bind(socket, serial, Binding.SAID, now)
        else:
            self._forget_scans()
            # Its label waits until it is said whether it is another one.
            self._chosen, self._forget_at_s = socket, now + CARD_LIMIT_S
            socket.is_chosen = True
        self._is_choice_refused = False
        return socket

    @staticmethod
    def _check_takes(socket: Socket) -> None:
        """Raises Refused for a socket that can take no unit now."""
        check_free(socket)
        check_service(socket)
        last = socket.holds
        if last is not None and last.outcome is RunState.PASS:
            raise still_there(socket, last)

    def _named(self, name: str) -> Socket:
        found = next((e for e in self.sockets.values() if e.name.lower() == name.lower()), None)
        if found is None:
            remedy = say("There are: {sockets}.", sockets=", ".join(self.sockets))
            raise Refused("NO_SUCH_SOCKET", say("There is no such socket."), remedy)
        return found

    def _abort(self, argument: str, _now: float) -> Socket:
        socket = self._named(argument)
        if socket.phase is not Phase.RUN:
            reason = say("Nothing runs in socket {socket}.", socket=socket.name)
            raise Refused("NOT_RUNNING", reason, _NOTHING)
        self._audit(AuditEvent.ABORT, socket=socket.name, serial=socket.serial)
        self._effects.append(AbortRun(socket.name))
        return socket

    def _free(self, argument: str, _now: float) -> Socket:
        socket = self._named(argument)
        check_free(socket)
        reason = say("Socket {socket} is free.", socket=socket.name)
        self._drop_label(socket, reason, say("Scan it again when it is connected."))
        socket.last, socket.is_last_there, socket.interrupted, socket.note = None, False, "", ""
        if socket.can_work and not (socket.is_there and socket.sees_units):
            socket.occupancy = Occupancy.EMPTY
        return socket

    def _cancel(self, _argument: str, _now: float) -> None:
        self._forget_scans()
        self._reason = ""
        self._reasons.clear()
        for socket in self.sockets.values():
            socket.let_go()

    def _set_lot(self, argument: str, _now: float) -> None:
        self.lot = argument

    def _set_operator(self, argument: str, _now: float) -> None:
        if self._crew.has_badges:
            raise Refused("BADGES", say("Here a badge says who works."), say("Scan your badge."))
        self._audit(AuditEvent.OPERATOR, before=self.operator, now=argument)
        self.operator = argument

    def _give_reason(self, argument: str, _now: float) -> None:
        self._audit(AuditEvent.REASON, text=argument)
        self._reason = argument

    def _reprint(self, argument: str, _now: float) -> None:
        self._crew.check_somebody()
        self._effects.append(Reprint(argument, self._with_author({"serial": argument})))

    def reprinted(self, serial: str, refused: Refused | None) -> None:
        """Result of `Reprint`."""
        text = printable(f"{Word.REPRINT.value} {serial}")[:80]
        if refused is None:
            self._tell(ScanAccepted(text, _REPRINT))
        else:
            self._refuse(text, refused.code, refused.reason, refused.remedy)

    def _resume(self, _argument: str, _now: float) -> None:
        if self.stopped is None:
            raise Refused("NOT_STOPPED", say("The line is not stopped."), _NOTHING)
        self._audit(AuditEvent.RESUME, code=self.stopped.code)
        unsaved = [each.name for each in self.sockets.values() if each.phase is Phase.SAVE]
        self._effects.append(SaveAgain(tuple(unsaved)))

    def resumed(self, now: float, *, all_saved: bool) -> None:
        """Result of `SaveAgain`: the line goes on, or stays stopped."""
        word = Word.RESUME.value
        if all_saved:
            self.stopped = None
            self._tell(ScanAccepted(word, _RESUME))
            self._tell(LineResumed())
            for socket in self.sockets.values() if self._scans_labels else ():
                if socket.awaits_label and socket.borne:  # it was refused meanwhile
                    self._scan_borne(socket, socket.borne, now)
        else:
            self._refuse(
                word,
                "STILL_NOT_SAVED",
                say("It still cannot be saved."),
                say("Mend the cause first."),
            )
        self._go_on(now)

    # -- the time, and what is due ----------------------------------------------------------------

    def tick(self, now: float) -> None:
        if self._forget_at_s is not None and now >= self._forget_at_s:
            if self._label:
                reason = say("No card of a socket was scanned for it.")
                self._refuse(self._label, _FORGOTTEN, reason, _AGAIN)
            elif self._chosen is not None:
                text = f"SOCKET {self._chosen.name}"
                reason = say("No label was scanned for it.")
                self._refuse(text, _FORGOTTEN, reason, _AGAIN)
            self._forget_scans()
        asked = self._crew.asked
        if asked is not None and not self.is_checking_pin and now >= asked.until_s:
            self._end_pin(asked, "NO_PIN", say("No PIN came."), _AGAIN)
        for socket in self.sockets.values():
            waits = socket.label and socket.begin_at_s is None and socket.phase is Phase.REST
            if waits and now >= socket.bound_at_s + SCAN_LIMIT_S:
                reason = say("Its unit did not come.")
                self._drop_label(socket, reason, say("Scan it again with its unit."))
        self._go_on(now)

    def _go_on(self, now: float) -> None:
        """Start the runs that are due, then report the sockets that changed."""
        for socket in self.sockets.values():
            if self.stopped is None and not self.is_closing and socket.is_due(now):
                serial, socket.label, socket.begin_at_s = socket.label, "", None
                socket.phase, socket.serial = Phase.CLAIM, serial
                reason = self._reasons.get(serial, "")
                self._effects.append(ClaimRun(socket.name, serial, self.operator, self.lot, reason))
        for socket in self.sockets.values():
            shown = socket.view(self.stopped, is_only=len(self.sockets) == 1)
            if socket.shown != shown and socket.phase is not Phase.CLAIM:
                socket.shown = shown
                state, serial, text = shown
                self._tell(SocketChanged(socket.name, state, serial, text))

    def _bind(self, socket: Socket, serial: str, why: Binding, now: float) -> None:
        """Assign the label to the unit in this socket, or to the one that will arrive."""
        if self._reason:
            self._reasons[serial], self._reason = self._reason, ""
        was_here = serial in (socket.interrupted, socket.last.serial if socket.last else "")
        socket.label, socket.binding, socket.note = serial, why, ""
        socket.begin_at_s, socket.bound_at_s = None, now
        if why is Binding.NAMED:
            return  # the unit that has passed is shown until it has left
        socket.last, socket.is_last_there = None, False
        if not socket.sees_units or (was_here and why is Binding.SAID):
            socket.begin_at_s = now  # it may sit in its bootloader, and say nothing
        elif why is Binding.SAID or (why is Binding.ONLY and was_here):
            socket.begin_at_s = now + self._arrival_limit_s

    def _drop_label(self, socket: Socket, reason: str, remedy: str) -> None:
        label = socket.let_go()
        if label:
            self._refuse(label, _FORGOTTEN, reason, remedy, socket)

    def _forget_scans(self) -> None:
        if self._chosen is not None:
            self._chosen.is_chosen = False
            why = say("SOCKET {socket} was scanned, and not its label.", socket=self._chosen.name)
            self._drop_label(self._chosen, why, say("Scan it again with the card."))
        self._label, self._chosen, self._forget_at_s = "", None, None

    def stop(self, code: str, reason: str, remedy: str) -> None:
        """Start no run until RESUME. Labels are dropped, since units may be swapped meanwhile."""
        if self.stopped is not None:
            return
        self.stopped = LineStopped(code, reason, remedy)
        self._tell(self.stopped)
        if self._label:
            self._refuse(self._label, _FORGOTTEN, say("The line was stopped."), _AGAIN)
        self._forget_scans()
        for socket in self.sockets.values():
            remedy = say("Scan it again when it goes on.")
            self._drop_label(socket, say("The line was stopped."), remedy)

    def _is_serial(self, text: str) -> bool:
        try:
            self._check_serial(text)
        except ValueError:
            return False
        return True

    # -- effects ----------------------------------------------------------------------------------

    def _tell(self, event: StationEvent) -> None:
        self._effects.append(event)

    def _refuse(
        self, text: str, code: str, reason: str, remedy: str, socket: Socket | None = None
    ) -> None:
        name = "" if socket is None else socket.name
        self._tell(ScanRefused(text, code, reason, remedy, name))
        self._audit(AuditEvent.REFUSED_SCAN, text=text, code=code, socket=name)

    def _audit(self, what: AuditEvent, **data: str) -> None:
        self._effects.append(Audit(what, self._with_author(data)))

    def _with_author(self, data: dict[str, str]) -> dict[str, str]:
        """What goes into the audit trail: with badges, who it is by."""
        if not self._crew.has_badges:
            return data
        return {**data, "by": "" if self._crew.person is None else self._crew.person.name}

    def _scan_borne(self, socket: Socket, label: str, now: float) -> None:
        """Assign the label of a virtual unit, as an operator does with card and label."""
        try:
            self._check_label(label)
        except Refused as refused:
            self._refuse(label, refused.code, refused.reason, refused.remedy, socket)
        else:
            self._tell(ScanAccepted(label, "label", socket.name))
            self._bind(socket, label, Binding.SAID, now)

    # -- the tables -------------------------------------------------------------------------------

    _TABLE: ClassVar[Mapping[Phase, Mapping[type, Callable[..., None]]]] = {
        Phase.REST: {Ready: _ready, AdapterDown: _down, PresenceChanged: _unit},
        Phase.CLAIM: {Claimed: _claimed, NotClaimed: _not_claimed, NotSaved: _claim_failed},
        Phase.RUN: {
            Ready: _ready,
            AdapterDown: _down,
            PresenceChanged: _unit,
            NotSaved: _not_saved,
            Ended: _ended,
        },
        Phase.SAVE: {
            Ready: _ready,
            AdapterDown: _down,
            PresenceChanged: _unit,
            NotSaved: _not_saved,
            Saved: _saved,
        },
    }
    """Handlers by phase of the socket and type of the input."""
    _COMMANDS: ClassVar[Mapping[Word, Callable[[Line, str, float], Socket | None]]] = {
        Word.SOCKET: _take_socket,
        Word.CANCEL: _cancel,
        Word.ABORT: _abort,
        Word.FREE: _free,
        Word.LOT: _set_lot,
        Word.OPERATOR: _set_operator,
        Word.REASON: _give_reason,
        Word.REPRINT: _reprint,
        Word.RESUME: _resume,
    }
    """Handlers of the commands."""
