"""Logic of a station without I/O: assigns labels to sockets, starts runs, sets their displays.

    scans, presence of units, messages of the sockets' processes, results of saving, the time
        -> Line ->
    events, claims, aborts, and entries of the audit trail

Times are seconds on the station's monotonic clock. `Station` executes the effects and feeds back
their results. `flasher.station.scans` has the rule that assigns labels to sockets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.codes import Code
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OperatorPrompted,
    PinAwaited,
    PinEnded,
    RunEnded,
    RunStarted,
    ScanAccepted,
    ScanRefused,
    SocketChanged,
    StationEvent,
    UnitArrived,
    UnitRemoved,
)
from flasher.station.messages import AdapterDown, AdapterReady, PresenceChanged
from flasher.station.operators import HIDDEN, Asked, Crew
from flasher.station.pins import FORM_WORDS, Pin, is_form
from flasher.station.records.errors import Refusal
from flasher.station.records.model import Admission, AuditEvent, Order, RunResult, RunState
from flasher.station.scans import (
    Label,
    NotUnderstood,
    Refused,
    ScanCommand,
    Waiting,
    Word,
    card_waits,
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
from flasher.station.socket import (
    UNNAMED,
    Binding,
    LastRun,
    Occupancy,
    Socket,
    SocketPhase,
    Source,
    source_words,
)

ARRIVAL_LIMIT_S: Final = 20.0
SCAN_LIMIT_S: Final = 120.0
"""Time limit for the unit of a label, or the label of a socket; then it is dropped."""
CARD_LIMIT_S: Final = 15.0
"""Time limit for the label after the card of its socket."""
SHORT_OUTAGE_S: Final = 3.0
"""A socket still shows its last verdict in an outage of this time; its process restarts faster."""
REACH_S: Final = 2.0
"""A unit that appears sooner after the prompt was already in the socket."""
IDENTIFY_S: Final = 3.0
"""A unit with an application reports its serial number within this time after power-on."""
READ_S: Final = 2.0
"""Time in which a second scan of a label is a double read, or by a person who had not read the
refusal."""
NOTE_S: Final = 15.0
"""Time for which a socket shows that a card or label was dropped."""
_PIN: Final = "pin"
_REPORTED_LATER: Final = (
    _PIN,
    *(word.value.lower() for word in (Word.RESUME, Word.REPRINT, Word.RECIPE)),
)
"""Meanings of scans whose result other events report."""
_STOPS_LINE: Final = (Refusal.RECIPE_CHANGED.value, Refusal.RECIPE_NOT_TRUSTED.value)
"""Refused claims that stop the line."""
_AGAIN: Final = text("Scan it again.")
_NOTHING: Final = text("Nothing to do.")
_CHANGED: Final = Refused(
    Code.UNIT_CHANGED.name,
    text("The unit was exchanged, or had no power."),
    text("Check which unit it is, then scan again."),
)


def _dropped(reason: str, remedy: str = _AGAIN) -> Refused:
    """Refusal of a scan that was accepted and is now dropped."""
    return Refused("FORGOTTEN", reason, remedy)


# -- inputs and effects ---------------------------------------------------------------------------


@dataclass(frozen=True)
class NotSaved:
    """A part of the run could not be saved."""

    reason: str
    remedy: str


SocketInput = (
    AdapterReady
    | AdapterDown
    | PresenceChanged
    | RunStarted
    | Refused
    | RunResult
    | RunEnded
    | NotSaved
)
"""`RunStarted`: the claim is in the records. `Refused`: it is not. `RunResult`: the process has
reported the end of the run. `RunEnded`: it is on disk."""


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
    """Compare a PIN with its hash; then call `Line.pin_checked`. Scans wait for it."""

    pin: Pin
    pin_hash: str


@dataclass(frozen=True)
class DoCommand:
    """Record `data` and carry a command out; then call `Line.done`. REPRINT prints the label of a
    passed unit again, RECIPE uses the offered recipe whose digest begins with the argument.
    """

    word: Word
    argument: str
    data: Mapping[str, str]


@dataclass(frozen=True)
class Audit:
    """Append an action of a person to the audit trail."""

    what: AuditEvent
    data: Mapping[str, str]


@dataclass(frozen=True)
class AskPlant:
    """Ask the plant about the unit of an order; then call `Line.answered`."""

    order: Order


@dataclass(frozen=True)
class DropAdmission:
    """No run begins with this answer of the plant."""

    admission: Admission


Effect = (
    Order
    | AskPlant
    | DropAdmission
    | SaveAgain
    | AbortRun
    | CheckPin
    | DoCommand
    | Audit
    | StationEvent
)
"""An `Order` is claimed, and the result fed back; a `StationEvent` is published."""


# -- the line -------------------------------------------------------------------------------------


CheckSerial = Callable[[str], object]
"""Raises ValueError for a text that is not a serial number of the recipe."""


class Line:
    """Sockets and scans of a station. After each call, `take` returns the effects in order.

    `arrival_limit_s`: time that a label with a scanned socket waits for its unit; then the run
    starts and reports the fault. `crew`: people with badges; None: names are not checked.
    `asks_plant`: a plant is asked before each run.
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
        asks_plant: bool = False,
    ) -> None:
        self._asks_plant = asks_plant
        self.sockets = {socket.name: socket for socket in sockets}
        self.operator = operator
        self.lot = lot
        self.stopped: LineStopped | None = None
        """Reason why the line is stopped; None while it runs."""
        self._pin_from: Source | None = None
        """Source of the PIN that is being checked."""
        self.is_closing = False
        """True if no further run may start."""
        self._check_serial = check_serial
        self._arrival_limit_s = arrival_limit_s
        self._scans_labels = scans_labels
        self._crew = crew or Crew(())
        self._effects: list[Effect] = []
        self._waiting: dict[str, Waiting] = {}
        """Scans that wait for another scan of the same source, by the source's name."""
        self._scanned_at_s = 0.0
        """Time at which the present scan was made."""
        self._reason = ""
        """Reason from a REASON command, for the next label."""
        self._reasons: dict[str, str] = {}
        """Reasons by label, so that a run in between does not use another one's."""

    @property
    def is_checking_pin(self) -> bool:
        """True while a PIN is being checked; scans have to wait."""
        return self._pin_from is not None

    def take(self) -> list[Effect]:
        """Effects since the last call; call again after feeding back a result."""
        effects, self._effects = self._effects, []
        return effects

    # -- the table of a socket --------------------------------------------------------------------

    def feed(self, name: str, what: SocketInput, now: float) -> None:
        """Process an input of a socket. Raises KeyError (a bug) for one that the table lacks."""
        socket = self.sockets[name]
        self._TABLE[socket.phase][type(what)](self, socket, what, now)
        self._go_on(now)

    def _ready(self, socket: Socket, what: AdapterReady, now: float) -> None:
        if socket.can_work:
            return  # the adapter was reopened between two polls
        was_short = now - socket.out_since_s < SHORT_OUTAGE_S
        # A unit can be exchanged quickly: one that has passed must report its number again.
        socket.is_last_there = socket.is_last_there and was_short and not socket.has_passed
        socket.out_of_service, socket.sees_units = None, what.sees_units
        if not what.sees_units:
            socket.occupancy = Occupancy.SILENT

    def _down(self, socket: Socket, what: AdapterDown, now: float) -> None:
        socket.changed_at_s = now
        if socket.can_work or not socket.out_since_s:
            socket.out_since_s = now
        socket.out_of_service = what.reason or text("It cannot work.")
        reason = text("Socket {socket} is out of service.", socket=socket.name)
        self._drop_scans(socket, _dropped(reason, text("Scan it again when it works again.")))
        # The socket cannot be observed now. A unit that was silent before stays doubtful.
        socket.own, socket.is_own_known, socket.presence_number = None, False, 0
        if socket.occupancy is not Occupancy.SILENT:
            socket.occupancy = Occupancy.UNKNOWN

    def _unit(self, socket: Socket, what: PresenceChanged, now: float) -> None:
        """A unit was detected, reported its serial number, or stopped sending."""
        socket.presence_number = what.number
        if not what.is_there:
            reason = text("Its unit stopped sending.")
            why = _dropped(reason, text("Scan it again when it is connected."))
            self._silent(socket, now, why, is_certain=what.is_certain)
            return
        if socket.is_exchange(what):
            why = _CHANGED
            if what.was_missed and not what.is_power_up:
                reason = text("This computer stalled: the unit may have been exchanged meanwhile.")
                why = Refused(Code.NOT_OBSERVED.name, reason, _CHANGED.remedy)
            self._silent(socket, now, why, is_certain=False)
        elif socket.occupancy is Occupancy.UNKNOWN and what.is_power_up:
            # The unit may have replaced a silent one after the scan of its card or label.
            self._drop_for(socket, now, _CHANGED, keeps_label=socket.binding is Binding.PROMPTED)
        was_silent = socket.occupancy in (Occupancy.SILENT, Occupancy.EMPTY)
        is_new = socket.note_unit(what, is_serial=self._is_serial(what.serial or ""))
        if is_new:
            socket.arrived_at_s = now
            self._emit(UnitArrived(socket.name, what.how, what.label))
        if socket.phase is not SocketPhase.REST:
            return
        if what.label and self._scans_labels and not socket.label:
            self._scan_virtual_label(socket, what.label, now)
        elif (is_new or was_silent) and socket.label and socket.binding is Binding.PROMPTED:
            self._arrived_where_named(socket, what, now)
        elif (
            socket.awaits_label
            and not socket.is_chosen
            and (waiting := self._label_of(socket.own)) is not None
        ):
            serial = waiting.label
            waiting.forget()
            self._bind(socket, serial, Binding.CONFIRMED, now, waiting.source)
        elif is_new:
            self._arrived_elsewhere(socket)

    def _silent(self, socket: Socket, now: float, why: Refused, *, is_certain: bool) -> None:
        """The unit may have been removed: drop its scans."""
        # No unit came for its label yet, or the unit reported another serial number.
        awaits = socket.begin_at_s is None or socket.is_of_another(socket.label)
        awaits = awaits and socket.binding is Binding.PROMPTED
        if not socket.fall_silent(is_certain=is_certain):
            return
        self._emit(UnitRemoved(socket.name))
        if awaits:
            socket.begin_at_s = None
        self._drop_for(socket, now, why, keeps_label=awaits)

    def _drop_for(self, socket: Socket, now: float, why: Refused, *, keeps_label: bool) -> None:
        """Drop the scans of a unit, and show that on its socket for a while."""
        socket.changed_at_s = now
        if self._drop_scans(socket, why, keeps_label=keeps_label):
            socket.note = text("{reason} {remedy}", reason=why.reason, remedy=why.remedy)
            socket.note_until_s = now + NOTE_S

    def _arrived_where_named(self, socket: Socket, what: PresenceChanged, now: float) -> None:
        virtual_label = what.label
        in_reach_at_s = socket.bound_at_s + REACH_S
        remedy = text("Scan it again with the card of its socket.")
        if not virtual_label and now < in_reach_at_s:
            reason = text("A unit was already in socket {socket}.", socket=socket.name)
            self._drop_label(socket, _dropped(reason, remedy))
        elif now - what.unobserved_s < in_reach_at_s <= now:
            reason = text("This computer stalled: the unit may have been exchanged meanwhile.")
            self._drop_label(socket, Refused(Code.NOT_OBSERVED.name, reason, remedy))
        elif virtual_label and virtual_label != socket.label:
            reason = text(
                "The unit in socket {socket} has the label {label}.",
                socket=socket.name,
                label=virtual_label,
            )
            why = Refused("OTHER_UNIT", reason, text("Scan {label}.", label=virtual_label))
            self._refuse(socket.release_label(), why, socket, socket.source)
        else:
            # The unit may have woken up: identify it before anything begins.
            socket.begin_at_s = now if virtual_label else now + IDENTIFY_S

    def _arrived_elsewhere(self, socket: Socket) -> None:
        named = next(
            (e for e in self.sockets.values() if e.label and e.binding is Binding.PROMPTED), None
        )
        if named is not None and socket.awaits_label:
            sentence = text(
                "Wrong socket: {label} goes into socket {socket}. If it stays here, scan SOCKET"
                " {here}, then its label.",
                label=printable(named.label),
                socket=named.name,
                here=socket.name,
            )
            self._emit(OperatorPrompted(socket.name, sentence, source=named.source.name))

    def _claimed(self, socket: Socket, _what: RunStarted, _now: float) -> None:
        socket.phase = SocketPhase.RUN
        socket.last, socket.is_last_there, socket.note = None, False, ""
        for each in self.sockets.values():
            if each is socket or each.interrupted == socket.serial:
                each.interrupted = ""
        self._reasons.pop(socket.serial, None)

    def _not_claimed(self, socket: Socket, why: Refused, _now: float) -> None:
        serial, socket.phase, socket.serial = socket.serial, SocketPhase.REST, ""
        self._refuse(serial, why, socket, socket.source)
        socket.note = text("{reason} {remedy}", reason=why.reason, remedy=why.remedy)
        if why.code in _STOPS_LINE:
            self.stop(why.code, why.reason, why.remedy)

    def _claim_failed(self, socket: Socket, what: NotSaved, _now: float) -> None:
        socket.phase, socket.serial = SocketPhase.REST, ""
        self.stop(Code.RECORD_NOT_SAVED.name, what.reason, what.remedy)

    def _ended(self, socket: Socket, _what: RunResult, now: float) -> None:
        socket.phase, socket.changed_at_s = SocketPhase.SAVE, now
        socket.last, socket.is_last_there = LastRun(socket.serial), True
        # The run may have written its number: only later reports count.
        socket.own, socket.is_own_known = None, False
        if not socket.is_virtual and socket.sees_units:
            socket.occupancy = Occupancy.UNKNOWN

    def _saved(self, socket: Socket, what: RunEnded, _now: float) -> None:
        socket.phase, socket.note, socket.serial = SocketPhase.REST, "", ""
        if socket.last is not None:
            socket.last = replace(socket.last, outcome=what.run.state, action=what.action)

    def _not_saved(self, socket: Socket, what: NotSaved, _now: float) -> None:
        """A part of a run was not saved: the run cannot pass, and no other one starts."""
        if socket.phase is SocketPhase.SAVE:
            socket.note = what.reason
        self.stop(Code.RECORD_NOT_SAVED.name, what.reason, what.remedy)

    def is_between_units(self, name: str) -> bool:
        """True if no run, scan or question to the plant is about this socket as it is now."""
        socket = self.sockets[name]
        return not (socket.is_busy or socket.is_chosen or socket.asked)

    def restart(self, name: str, now: float) -> None:
        """The process of a socket between two units is replaced by another one."""
        socket = self.sockets[name]
        self._down(socket, AdapterDown(""), now)
        socket.out_of_service = ""  # it starts
        self._go_on(now)

    # -- scans ------------------------------------------------------------------------------------

    def scan(self, raw: str, now: float, source: Source = UNNAMED, *, age_s: float = 0.0) -> None:
        """Process a scan that was made `age_s` ago."""
        self._scanned_at_s = now - age_s
        scanned = raw.strip()
        crew = self._crew
        person = crew.find(scanned)
        waiting = self._waiting.setdefault(source.name, Waiting(source))
        is_mounted_label = bool(source.socket) and self._is_serial(scanned)
        if is_mounted_label and waiting.card is None and not waiting.is_in_doubt:
            socket = self.sockets[source.socket]
            self._answer(
                printable(scanned)[:80],
                source,
                lambda: ("label", self._take_mounted(socket, scanned, now, source)),
            )
        elif crew.asked is not None and not is_mounted_label:  # not a typed PIN
            self._take_pin(crew.asked, scanned, source, now)
        elif person is not None:
            crew.person = person
            before, self.operator = self.operator, person.name
            role = person.role.value
            self._audit(AuditEvent.OPERATOR, before=before, now=person.name, role=role)
            self._emit(ScanAccepted(printable(person.name), "badge", source=source.name))
        elif crew.may_be_pin(scanned) and not self._is_serial(scanned):
            # No message may show a PIN that was typed too late or too often.
            reason = text("No PIN is expected, and it is not a serial number of this recipe.")
            remedy = text("First scan the command that needs the PIN.")
            self._refuse(HIDDEN, Refused("NO_PIN_AWAITED", reason, remedy), source=source)
        else:
            self._answer(
                printable(scanned)[:80], source, lambda: self._understand(raw, waiting, now)
            )
        self._go_on(now)

    def _answer(
        self, shown: str, source: Source, understand: Callable[[], tuple[str, Socket | None]]
    ) -> None:
        """Process a scan, and report whether it was accepted; `shown` is its text for people."""
        try:
            meaning, socket = understand()
        except Refused as refused:
            self._refuse(shown, refused, source=source)
        else:
            if meaning not in _REPORTED_LATER:
                name = "" if socket is None else socket.name
                self._emit(ScanAccepted(shown, meaning, name, source.name))

    def _understand(self, raw: str, waiting: Waiting, now: float) -> tuple[str, Socket | None]:
        """Meaning of a scan, and its socket. Raises Refused."""
        understood = understand(raw)
        if isinstance(understood, Label):
            self._crew.check_assigned()
        was_in_doubt = waiting.is_in_doubt
        # A refused card affects the next scan; two cards or labels, until it is clear which counts.
        waiting.is_in_doubt = was_in_doubt and bool(waiting.text)
        match understood:
            case Label(serial):
                if was_in_doubt and not waiting.label:
                    refused, at_s = waiting.refused_label or ("", now)
                    if refused != serial:
                        waiting.refused_label = serial, now
                    if refused != serial or now - at_s < READ_S:
                        waiting.is_in_doubt = True
                        raise self._in_doubt(waiting)
                return "label", self._take_label(serial, waiting, now)
            case ScanCommand(word, argument):
                person = self._crew.check_role(word)
                if person is not None and person.pin:
                    asked = self._crew.ask(person, word, argument, now, waiting.source)
                    self._emit(PinAwaited(person.name, asked.text, asked.until_s - now))
                    return _PIN, None
                return word.value.lower(), self._COMMANDS[word](self, argument, now, waiting)
            case NotUnderstood(why):
                waiting.is_in_doubt = bool(waiting.text)  # it may have been a second card or label
                raise Refused("NOT_UNDERSTOOD", why, text("Scan the label again."))

    @staticmethod
    def _in_doubt(waiting: Waiting) -> Refused:
        """Refusal of a scan that may belong to a refused one before it."""
        if not waiting.text:
            return Refused(
                "NO_SOCKET",
                text("The card that was scanned before it does not count."),
                text("Scan the card of the socket that the unit is in, then the label again."),
            )
        return Refused(
            "CARD_WAITS" if waiting.card is not None else "LABEL_WAITS",
            text("{text} waits, and something else was scanned after it.", text=waiting.text),
            text("Scan {text} again, then its card or label; or scan CANCEL.", text=waiting.text),
        )

    # -- badges and PINs --------------------------------------------------------------------------

    def _take_pin(self, asked: Asked, scanned: str, source: Source, now: float) -> None:
        """Process a scan or typed line as the awaited PIN; it is never displayed."""
        if scanned.upper() == Word.CANCEL.value:
            self._end_pin(asked, Refused("CANCELLED", text("It was cancelled."), _NOTHING))
        elif is_form(scanned):
            name = asked.person.name
            if remedy := self._crew.lock_words(name, source, now):
                reason = text("Too many wrong PINs of {name}.", name=printable(name))
                self._refuse(HIDDEN, Refused("PIN_LOCKED", reason, remedy), source=source)
                return
            self._crew.count_try(name, source, now)
            self._pin_from = source
            self._effects.append(CheckPin(Pin(scanned), asked.person.pin))
        else:
            reason = text("That is not a PIN: a PIN has {form}.", form=FORM_WORDS)
            name = printable(asked.person.name)
            remedy = text("Type the PIN of {name}, or scan CANCEL.", name=name)
            self._refuse(HIDDEN, Refused("NO_PIN", reason, remedy), source=source)

    def pin_checked(self, now: float, *, is_right: bool) -> None:
        """Process the result of `CheckPin`."""
        crew = self._crew
        asked, source, self._pin_from = crew.asked, self._pin_from, None
        if asked is None or source is None:
            return
        if is_right:
            crew.asked = None
            crew.forget_tries(asked.person.name, source)
            word, argument = asked.word, asked.argument
            waiting = self._waiting.setdefault(asked.source.name, Waiting(asked.source))
            self._emit(PinEnded(asked.person.name, is_right=True))
            self._answer(
                printable(asked.text)[:80],
                asked.source,
                lambda: (word.value.lower(), self._COMMANDS[word](self, argument, now, waiting)),
            )
        elif remedy := crew.lock_words(asked.person.name, source, now):
            self._end_pin(asked, Refused("PIN_LOCKED", text("Too many wrong PINs."), remedy))
        else:
            remedy = text("Type it again, or scan CANCEL.")
            wrong = Refused("WRONG_PIN", text("The PIN is wrong."), remedy)
            self._refuse(HIDDEN, wrong, source=source)
        self._go_on(now)

    def _end_pin(self, asked: Asked, why: Refused) -> None:
        """Refuse the command that waited for a PIN."""
        self._crew.asked = None
        self._emit(PinEnded(asked.person.name, is_right=False))
        self._refuse(printable(asked.text)[:80], why)

    # -- labels and commands ----------------------------------------------------------------------

    def _take_label(self, serial: str, waiting: Waiting, now: float) -> Socket | None:
        """Socket of a label; None while the label waits for a card. Raises Refused."""
        card = waiting.card
        if card is not None:
            self._take_for_card(card, serial, waiting, now)
            return card
        # The card that follows another label may belong to either.
        waiting.is_in_doubt = waiting.label not in ("", serial)
        self._check_label(serial)
        check_first(self.sockets, serial, waiting)
        placed = place(self.sockets, serial, waiting.source)
        if placed is not None:
            self._check_in_time(placed[0])
        for other in self._waiting.values():
            if other.label == serial and other is not waiting:  # its last scan counts
                self._drop_waiting(other, _dropped(text("It was scanned elsewhere."), _NOTHING))
        if placed is None:
            self._keep_waiting(serial, waiting, now)
            return None
        socket, why = placed
        self._bind(socket, serial, why, now, waiting.source)
        if why is not Binding.CONFIRMED and not socket.is_due(now):
            source = waiting.source.name
            self._emit(OperatorPrompted(socket.name, socket.wanted, source=source))
        return socket

    def _take_mounted(self, socket: Socket, serial: str, now: float, source: Source) -> Socket:
        """Process a label from a socket's own scanner. Raises Refused."""
        self._crew.check_assigned()
        self._check_label(serial)
        self._check_in_time(socket)
        self._check_takes(socket)
        self._check_for(socket, serial, source)
        if socket.label == serial:  # this scanner needs no person: no proof of a unit
            raise Refused("DOUBLE_SCAN", text("It was scanned already."), socket.wanted)
        self._take_for(socket, serial, self._waiting[source.name], now)
        return socket

    def _take_for_card(self, card: Socket, serial: str, waiting: Waiting, now: float) -> None:
        """Process a label after the card of its socket. Raises Refused, which drops the card: a
        second reading of the label must not count as a label without a card.
        """
        try:
            self._check_label(serial)
            self._check_in_time(card)
            self._check_for(card, serial, waiting.source)
        except Refused:
            self._forget_card(waiting)
            waiting.is_in_doubt, waiting.refused_label = True, (serial, now)
            raise
        self._take_for(card, serial, waiting, now)

    def _check_for(self, socket: Socket, serial: str, source: Source) -> None:
        check_free(socket)
        check_fits(self.sockets, socket, serial)
        check_one_socket(self.sockets, socket, serial, source)

    def _take_for(self, socket: Socket, serial: str, waiting: Waiting, now: float) -> None:
        was_here = socket.label == serial
        for each in self.sockets.values():
            if each.label == serial:
                each.release_label()  # it was moved
        for other in self._waiting.values():
            if other.label == serial:
                other.forget()
        reason = text(
            "Socket {socket} is for {label} now.", socket=socket.name, label=printable(serial)
        )
        for other in self._waiting.values():
            if other.card is socket and other is not waiting:
                self._drop_waiting(other, _dropped(reason))
        self._drop_label(socket, _dropped(reason))  # was scanned for it before
        waiting.forget()
        self._bind(socket, serial, Binding.CONFIRMED, now, waiting.source)
        if was_here:
            socket.begin_at_s = now  # scanned twice: do not wait for its first message

    def _label_of(self, own: str | None) -> Waiting | None:
        """Waiting label of the unit that reports this serial number."""
        found = (each for each in self._waiting.values() if each.label and each.label == own)
        return next(found, None)

    def _check_line(self) -> None:
        if self.stopped is not None:
            reason = text("The line is stopped: {reason}", reason=self.stopped.reason)
            remedy = text("{remedy} Then scan RESUME.", remedy=self.stopped.remedy)
            raise Refused("LINE_STOPPED", reason, remedy)

    def _check_in_time(self, socket: Socket) -> None:
        """Check that a scan was made after the last change in this socket. Raises Refused."""
        if self._scanned_at_s < socket.changed_at_s:
            raise Refused(
                Code.NOT_OBSERVED.name,
                text("The station stalled: the unit may have been exchanged after this scan."),
                _CHANGED.remedy,
            )

    def _check_label(self, serial: str) -> None:
        """Check that a label is of this recipe and its unit can be run now. Raises Refused."""
        self._check_line()
        try:
            self._check_serial(serial)
        except ValueError as error:
            raise Refused(
                Refusal.WRONG_SERIAL.value,
                text("Not a serial number of this recipe: {why}.", why=str(error)),
                text("Scan the label of the unit."),
            ) from error
        check_known(self.sockets, serial)

    def _keep_waiting(self, serial: str, waiting: Waiting, now: float) -> None:
        if not any(each.can_work for each in self.sockets.values()):
            raise Refused(
                "SOCKET_BROKEN",
                text("No socket is in service."),
                text("Repair one of them, then scan it again."),
            )
        waiting.label, waiting.forget_at_s = serial, now + SCAN_LIMIT_S
        shown, before = printable(serial), was_in(self.sockets, serial)
        words = text("Scan the card of the socket that {label} is in, or goes into.", label=shown)
        if before is not None:
            words = text(
                "{label} was in socket {socket}. If it is still there, scan SOCKET {socket}; else"
                " the card of its socket.",
                label=shown,
                socket=before.name,
            )
        self._emit(OperatorPrompted("", words, source=waiting.source.name))

    def _take_socket(self, argument: str, now: float, waiting: Waiting) -> Socket:
        is_again = waiting.card is not None and waiting.card.name.lower() == argument.lower()
        if waiting.label and waiting.is_in_doubt:
            raise self._in_doubt(waiting)
        if not waiting.label:
            # Kept until all checks pass: the label that follows must not go to another socket.
            waiting.is_in_doubt, waiting.refused_label = True, None
            waiting.forget_at_s = None if waiting.card is None else now + CARD_LIMIT_S
        socket = self._named(argument)
        self._check_line()
        self._check_in_time(socket)
        if waiting.card is not None and not is_again:
            raise self._in_doubt(waiting)
        if socket.is_chosen and not is_again:
            raise card_waits(socket)
        self._check_takes(socket)
        if waiting.label:
            serial = waiting.label
            check_fits(self.sockets, socket, serial)
            waiting.forget()
            self._bind(socket, serial, Binding.CONFIRMED, now, waiting.source)
        else:
            # The label waits until it is known whether the unit is another one.
            waiting.card, waiting.is_in_doubt, socket.is_chosen = socket, False, True
            waiting.forget_at_s = now + CARD_LIMIT_S
            self._clear_drop_note(socket)
        return socket

    @staticmethod
    def _check_takes(socket: Socket) -> None:
        """Check that a socket can take a unit now. Raises Refused."""
        check_free(socket)
        check_service(socket)
        last = socket.holds
        if last is not None and last.outcome is RunState.PASS:
            raise still_there(socket, last)

    def _named(self, name: str) -> Socket:
        found = next((e for e in self.sockets.values() if e.name.lower() == name.lower()), None)
        if found is None:
            remedy = text("There are: {sockets}.", sockets=", ".join(self.sockets))
            raise Refused("NO_SUCH_SOCKET", text("There is no such socket."), remedy)
        return found

    def _abort(self, argument: str, _now: float, _waiting: Waiting) -> Socket:
        socket = self._named(argument)
        self._check_in_time(socket)
        if socket.phase is not SocketPhase.RUN:
            reason = text("Nothing runs in socket {socket}.", socket=socket.name)
            raise Refused("NOT_RUNNING", reason, _NOTHING)
        self._audit(AuditEvent.ABORT, socket=socket.name, serial=socket.serial)
        self._effects.append(AbortRun(socket.name))
        return socket

    def _free(self, argument: str, _now: float, _waiting: Waiting) -> Socket:
        socket = self._named(argument)
        self._check_in_time(socket)
        check_free(socket)
        reason = text("Socket {socket} is free.", socket=socket.name)
        self._drop_scans(socket, _dropped(reason, text("Scan it again when it is connected.")))
        socket.last, socket.is_last_there, socket.interrupted, socket.note = None, False, "", ""
        if socket.can_work and not (socket.is_there and socket.sees_units):
            socket.occupancy = Occupancy.EMPTY
        return socket

    def _cancel(self, _argument: str, _now: float, waiting: Waiting) -> None:
        """Drop the waiting scans of this source."""
        bound = [each for each in self.sockets.values() if each.label]
        own = [each for each in bound if each.source == waiting.source]
        if not (own or waiting.text or self._reason):
            self._check_waits_nowhere(bound)
        self._forget_card(waiting)
        self._reason = ""
        for socket in own:
            self._reasons.pop(socket.release_label(), None)

    def _check_waits_nowhere(self, bound: list[Socket]) -> None:
        """Check that a CANCEL does not mean scans of another source. Raises Refused."""
        waits: list[tuple[str, Source, str]] = [
            (
                each.label,
                each.source,
                text("Scan CANCEL there, or FREE {socket}.", socket=each.name),
            )
            for each in bound
        ]
        there = text("Scan CANCEL there.")
        waits += [(e.text, e.source, there) for e in self._waiting.values() if e.text]
        if waits:
            waiting_text, source, remedy = waits[0]
            reason = text(
                "{text} waits, and was not scanned here ({source}).",
                text=printable(waiting_text),
                source=source_words(source.name),
            )
            raise Refused("NOTHING_WAITS", reason, remedy)

    def _set_lot(self, argument: str, _now: float, _waiting: Waiting) -> None:
        self.lot = argument

    def _set_operator(self, argument: str, _now: float, _waiting: Waiting) -> None:
        if self._crew.has_badges:
            raise Refused(
                "BADGES", text("Badges identify the operator here."), text("Scan your badge.")
            )
        self._audit(AuditEvent.OPERATOR, before=self.operator, now=argument)
        self.operator = argument

    def _give_reason(self, argument: str, _now: float, _waiting: Waiting) -> None:
        self._audit(AuditEvent.REASON, text=argument)
        self._reason = argument

    def _reprint(self, argument: str, _now: float, _waiting: Waiting) -> None:
        self._crew.check_assigned()
        data = self._with_author({"serial": argument})
        self._effects.append(DoCommand(Word.REPRINT, argument, data))

    def _approve_recipe(self, argument: str, _now: float, _waiting: Waiting) -> None:
        if not self._crew.has_badges:
            raise Refused(
                "NO_BADGES",
                text("No person can be identified: this station has no badge table."),
                text("Name the badge table in the station file."),
            )
        self._effects.append(DoCommand(Word.RECIPE, argument, self._with_author({})))

    def done(self, command: DoCommand, refused: Refused | None) -> None:
        """Process the result of `DoCommand`."""
        text = printable(f"{command.word.value} {command.argument}")[:80]
        if refused is None:
            self._emit(ScanAccepted(text, command.word.value.lower()))
        else:
            self._refuse(text, refused)

    def _resume(self, _argument: str, _now: float, _waiting: Waiting) -> None:
        if self.stopped is None:
            raise Refused("NOT_STOPPED", text("The line is not stopped."), _NOTHING)
        self._audit(AuditEvent.RESUME, code=self.stopped.code)
        unsaved = [each.name for each in self.sockets.values() if each.phase is SocketPhase.SAVE]
        self._effects.append(SaveAgain(tuple(unsaved)))

    def resumed(self, now: float, *, all_saved: bool) -> None:
        """Process the result of `SaveAgain`: the line resumes, or stays stopped."""
        word = Word.RESUME.value
        if all_saved:
            self.stopped = None
            self._emit(ScanAccepted(word, word.lower()))
            self._emit(LineResumed())
            for socket in self.sockets.values() if self._scans_labels else ():
                if socket.awaits_label and socket.virtual_label:  # it was refused meanwhile
                    self._scan_virtual_label(socket, socket.virtual_label, now)
        else:
            reason = text("The outcome still cannot be saved.")
            self._refuse(word, Refused("STILL_NOT_SAVED", reason, text("Remove the cause first.")))
        self._go_on(now)

    # -- the time, and due actions ----------------------------------------------------------------

    def tick(self, now: float) -> None:
        for waiting in tuple(self._waiting.values()):
            if waiting.forget_at_s is not None and now >= waiting.forget_at_s:
                reason = (
                    text("No card of a socket was scanned for it.")
                    if waiting.label
                    else text("No label was scanned for it.")
                )
                is_card = waiting.card is not None
                self._drop_waiting(waiting, _dropped(reason))
                waiting.is_in_doubt = is_card  # its label may be scanned late, at another unit
            if waiting.is_in_doubt and waiting.forget_at_s is None:
                waiting.forget_at_s = now + SCAN_LIMIT_S
            if not (waiting.text or waiting.is_in_doubt):
                del self._waiting[waiting.source.name]
        asked = self._crew.asked
        if asked is not None and not self.is_checking_pin and now >= asked.until_s:
            self._end_pin(asked, Refused("NO_PIN", text("No PIN was entered in time."), _AGAIN))
        for socket in self.sockets.values():
            if socket.out_of_service and now - socket.out_since_s >= SHORT_OUTAGE_S:
                socket.is_last_there = False
            waits = socket.label and socket.begin_at_s is None and socket.phase is SocketPhase.REST
            if waits and now >= socket.bound_at_s + SCAN_LIMIT_S:
                remedy = text("Connect its unit, then scan it again.")
                self._drop_label(socket, _dropped(text("Its unit was not connected."), remedy))
            if socket.note_until_s is not None and now >= socket.note_until_s:
                self._clear_drop_note(socket)
        self._go_on(now)

    def _go_on(self, now: float) -> None:
        """Start due runs, then report changed sockets."""
        for socket in self.sockets.values():
            came_at_s = max(socket.bound_at_s, socket.arrived_at_s)
            if socket.label and socket.is_unidentified and now >= came_at_s + IDENTIFY_S:
                self._drop_unidentified(socket)
            if not self._may_begin(socket, now) or socket.asked:
                continue
            if self._asks_plant:
                # Until the answer the label waits as before, and is dropped with its unit.
                socket.asked = socket.label
                self._effects.append(AskPlant(self._order(socket)))
            else:
                self._begin(socket, None)
        for socket in self.sockets.values():
            shown = socket.view(self.stopped, is_only=len(self.sockets) == 1)
            if socket.shown != shown and socket.phase is not SocketPhase.CLAIM:
                socket.shown = shown
                state, serial, text = shown
                self._emit(SocketChanged(socket.name, state, serial, text))

    def _may_begin(self, socket: Socket, now: float) -> bool:
        return self.stopped is None and not self.is_closing and socket.is_due(now)

    def _order(self, socket: Socket, admission: Admission | None = None) -> Order:
        serial = socket.label
        return Order(
            serial,
            socket.name,
            self.operator,
            self.lot,
            self._reasons.get(serial, ""),
            socket.is_virtual,
            admission,
        )

    def _begin(self, socket: Socket, admission: Admission | None) -> None:
        """Claim the unit of a socket's label."""
        order = self._order(socket, admission)
        socket.label, socket.begin_at_s = "", None
        socket.phase, socket.serial = SocketPhase.CLAIM, order.serial
        self._effects.append(order)

    def answered(self, order: Order, admission: Admission, now: float) -> None:
        """Process the result of `AskPlant`. It counts if the unit and its label are still there."""
        socket = self.sockets[order.socket]
        asked, socket.asked = socket.asked, ""
        if asked == socket.label and self._may_begin(socket, now):
            self._begin(socket, admission)
        else:
            self._effects.append(DropAdmission(admission))
        self._go_on(now)

    def _bind(self, socket: Socket, serial: str, why: Binding, now: float, source: Source) -> None:
        """Assign a label to the unit in this socket, or to the next one."""
        if self._reason:
            self._reasons[serial], self._reason = self._reason, ""
        was_here = serial in (socket.interrupted, socket.last.serial if socket.last else "")
        socket.label, socket.binding, socket.source = serial, why, source
        socket.note, socket.note_until_s = "", None
        socket.begin_at_s, socket.bound_at_s = None, now
        if why is Binding.PROMPTED:
            return  # show the unit that has passed until it is removed
        socket.last, socket.is_last_there = None, False
        if not socket.sees_units or (was_here and why is Binding.CONFIRMED):
            socket.begin_at_s = now  # it may be in its bootloader and send nothing
        elif why is Binding.CONFIRMED or (why is Binding.ONLY_SOCKET and was_here):
            socket.begin_at_s = now + self._arrival_limit_s

    def _drop_scans(self, socket: Socket, why: Refused, *, keeps_label: bool = False) -> bool:
        """Drop the waiting card and label of a socket; False without any."""
        cards = [each for each in self._waiting.values() if each.card is socket]
        for waiting in cards:
            self._drop_waiting(waiting, why)
        is_label = not keeps_label and self._drop_label(socket, why)
        return bool(cards) or is_label

    def _drop_label(self, socket: Socket, why: Refused) -> bool:
        label = socket.release_label()
        if label:
            self._refuse(label, why, socket, socket.source)
        return bool(label)

    def _drop_waiting(self, waiting: Waiting, why: Refused) -> None:
        """Drop the waiting scan of a source, and report it there. The label after a dropped card
        must not be assigned to another socket.
        """
        text, card = waiting.text, waiting.card
        if text:
            self._refuse(text, why, card, waiting.source)
        self._forget_card(waiting)
        if card is not None:
            waiting.is_in_doubt, waiting.forget_at_s = True, None

    def _drop_unidentified(self, socket: Socket) -> None:
        reason = (
            text(
                "The unit in socket {socket} is in its bootloader and cannot identify itself.",
                socket=socket.name,
            )
            if socket.is_in_bootloader
            else text("The unit in socket {socket} does not identify itself.", socket=socket.name)
        )
        remedy = text("Scan SOCKET {socket}, then the label.", socket=socket.name)
        self._drop_label(socket, Refused("NOT_IDENTIFIED", reason, remedy))

    def _forget_card(self, waiting: Waiting) -> None:
        """Drop the waiting scan, and the label that waits at its socket."""
        card = waiting.card
        waiting.forget()
        if card is not None:
            reason = text("SOCKET {socket} was scanned, and not its label.", socket=card.name)
            self._drop_label(card, _dropped(reason, text("Scan it again with the card.")))

    @staticmethod
    def _clear_drop_note(socket: Socket) -> None:
        if socket.note_until_s is not None:
            socket.note, socket.note_until_s = "", None

    def drop_all(self, why: Refused) -> None:
        """Drop all waiting cards and labels."""
        for waiting in self._waiting.values():
            self._drop_waiting(waiting, why)
            waiting.is_in_doubt = False
        for socket in self.sockets.values():
            self._drop_label(socket, why)

    def stop(self, code: str, reason: str, remedy: str) -> None:
        """Start no run until RESUME, and drop labels, since units may be swapped meanwhile."""
        if self.stopped is not None:
            return
        self.stopped = LineStopped(code, reason, remedy)
        self._emit(self.stopped)
        remedy = text("Scan it again after RESUME.")
        self.drop_all(_dropped(text("The line was stopped."), remedy))

    def _is_serial(self, text: str) -> bool:
        try:
            self._check_serial(text)
        except ValueError:
            return False
        return True

    # -- effects ----------------------------------------------------------------------------------

    def _emit(self, event: StationEvent) -> None:
        self._effects.append(event)

    def _refuse(
        self, text: str, why: Refused, socket: Socket | None = None, source: Source = UNNAMED
    ) -> None:
        name = "" if socket is None else socket.name
        self._emit(ScanRefused(text, why.code, why.reason, why.remedy, name, source.name))
        self._audit(AuditEvent.REFUSED_SCAN, text=text, code=why.code, socket=name)

    def _audit(self, what: AuditEvent, **data: str) -> None:
        self._effects.append(Audit(what, self._with_author(data)))

    def _with_author(self, data: dict[str, str]) -> dict[str, str]:
        """Add the author to the data of an audit entry, if badges are used."""
        if not self._crew.has_badges:
            return data
        return {**data, "by": "" if self._crew.person is None else self._crew.person.name}

    def _scan_virtual_label(self, socket: Socket, label: str, now: float) -> None:
        """Assign the label of a virtual unit, like an operator with card and label."""
        try:
            self._check_label(label)
        except Refused as refused:
            self._refuse(label, refused, socket)
        else:
            self._emit(ScanAccepted(label, "label", socket.name))
            self._bind(socket, label, Binding.CONFIRMED, now, UNNAMED)

    # -- the tables -------------------------------------------------------------------------------

    _TABLE: ClassVar[Mapping[SocketPhase, Mapping[type, Callable[..., None]]]] = {
        SocketPhase.REST: {AdapterReady: _ready, AdapterDown: _down, PresenceChanged: _unit},
        SocketPhase.CLAIM: {
            RunStarted: _claimed,
            Refused: _not_claimed,
            NotSaved: _claim_failed,
        },
        SocketPhase.RUN: {
            AdapterReady: _ready,
            AdapterDown: _down,
            PresenceChanged: _unit,
            NotSaved: _not_saved,
            RunResult: _ended,
        },
        SocketPhase.SAVE: {
            AdapterReady: _ready,
            AdapterDown: _down,
            PresenceChanged: _unit,
            NotSaved: _not_saved,
            RunEnded: _saved,
        },
    }
    """Handlers by the socket's phase and the type of the input."""
    _COMMANDS: ClassVar[Mapping[Word, Callable[[Line, str, float, Waiting], Socket | None]]] = {
        Word.SOCKET: _take_socket,
        Word.CANCEL: _cancel,
        Word.ABORT: _abort,
        Word.FREE: _free,
        Word.LOT: _set_lot,
        Word.OPERATOR: _set_operator,
        Word.REASON: _give_reason,
        Word.RECIPE: _approve_recipe,
        Word.REPRINT: _reprint,
        Word.RESUME: _resume,
    }
    """Handlers of the commands."""
