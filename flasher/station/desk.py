"""Scans: which label belongs to which socket, and what is refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from flasher.protocol.text import printable
from flasher.station.claiming import Claiming
from flasher.station.events import (
    OperatorPrompted,
    ScanAccepted,
    ScanRefused,
    SocketState,
)
from flasher.station.records.errors import Refusal
from flasher.station.scans import Command, Label, Nonsense, Word, understand
from flasher.station.socket_line import SocketLine

if TYPE_CHECKING:
    from flasher.station.station import Station

_WAIT: Final = "Wait for its end."


class Refused(Exception):  # noqa: N818  a scan that changes nothing
    """Why a scan is refused: a stable word, a sentence, and what to do."""

    def __init__(self, code: str, reason: str, remedy: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason
        self.remedy = remedy


class Desk:
    """Where scans arrive."""

    def __init__(self, station: Station, *, operator: str, lot: str) -> None:
        self._station = station
        self._lines = station.lines
        self._label = ""
        """The label that waits for its socket."""
        self._chosen: SocketLine | None = None
        """The socket that waits for its label."""
        self._is_choice_refused = False
        """A socket was chosen in vain: the label behind it must not go to another one."""
        self.claiming = Claiming(station, operator=operator, lot=lot)

    def scan(self, text: str) -> None:
        """Something was scanned."""
        shown = printable(text.strip())[:80]
        try:
            match understand(text):
                case Label(serial):
                    meaning, socket = self._take_label(serial)
                case Command(word, argument):
                    meaning, socket = self._take_command(word, argument)
                case Nonsense(why):
                    meaning, socket = self._take_nonsense(why)
        except Refused as refused:
            event = ScanRefused(shown, refused.code, refused.reason, refused.remedy)
            self._station.tell(event)
        else:
            self._station.tell(ScanAccepted(shown, meaning, socket))

    @staticmethod
    def _take_nonsense(why: str) -> tuple[str, str]:
        raise Refused("NOT_UNDERSTOOD", why, "Scan the label again.")

    # -- labels -----------------------------------------------------------------------------------

    def _take_label(self, serial: str) -> tuple[str, str]:
        was_refused, self._is_choice_refused = self._is_choice_refused, False
        if was_refused:
            raise Refused(
                "NO_SOCKET",
                "The socket that was scanned before it cannot take it.",
                "Scan a socket that is free, then the label again.",
            )
        self._check_label(serial)
        line = self._again(serial) or self._chosen
        self.claiming.take_label(serial)
        if line is not None:
            self._chosen = None
            self._assign(line, serial, was_chosen=True)
            return "label", line.name
        waiting = [each for each in self._lines.values() if self._awaits_label(each)]
        if len(waiting) == 1:
            self._assign(waiting[0], serial)
            return "label", waiting[0].name
        only = list(self._lines.values())
        if len(only) == 1 and only[0].is_free:
            self._assign(only[0], serial)
            return "label", only[0].name
        self._label = serial
        words = "Scan the socket of this unit." if waiting else f"Connect {printable(serial)}."
        self._station.tell(OperatorPrompted("", words))
        return "label", ""

    def _check_label(self, serial: str) -> None:
        """Raises Refused."""
        stopped = self._station.committing.stopped
        if stopped is not None:
            raise Refused("LINE_STOPPED", f"The line stands: {stopped.reason}", stopped.remedy)
        try:
            self._station.recipe.recipe.serial_number.read(serial)
        except ValueError as error:
            raise Refused(
                Refusal.WRONG_SERIAL.value,
                f"No serial number of this recipe: {error}.",
                "Scan the label of the unit.",
            ) from error
        for line in self._lines.values():
            if line.run is not None and line.serial == serial:
                raise Refused(Refusal.UNIT_RUNNING.value, f"It runs in socket {line.name}.", _WAIT)
            if line.label == serial:
                raise Refused(
                    "DOUBLE_SCAN", f"It is known for socket {line.name}.", "Connect the unit."
                )
        if self._label == serial:
            raise Refused("DOUBLE_SCAN", "It was scanned already.", "Connect the unit.")
        if self._label:
            raise Refused(
                "LABEL_WAITS",
                f"{printable(self._label)} was scanned before and waits for its unit.",
                "Connect that unit first, or scan CANCEL.",
            )

    def _again(self, serial: str) -> SocketLine | None:
        """The socket in which this very unit still is, without a PASS: it is to be done again.

        Raises Refused when it has passed.
        """
        for line in self._lines.values():
            if line.serial != serial or not line.is_there or not line.state.is_verdict:
                continue
            if line.state is SocketState.PASS:
                raise Refused(
                    "JUST_PASSED",
                    f"It has just passed in socket {line.name}.",
                    "Take it out, and scan the next unit.",
                )
            return line
        return None

    @staticmethod
    def _awaits_label(line: SocketLine) -> bool:
        return line.is_free and line.is_there

    def _assign(self, line: SocketLine, serial: str, *, was_chosen: bool = False) -> None:
        """The label is for this socket. Somebody who chose it says that the unit is there."""
        line.label = serial
        if was_chosen or not line.sees_units:
            limit_s = self._station.options.arrival_limit_s if line.sees_units else 0.0
            line.begin_at_s = self._station.clock.monotonic_s() + limit_s
        self._station.show_rest(line)

    def arrived(self, line: SocketLine, label: str = "") -> None:
        """A unit came into a socket; `label` is what was scanned with it, for virtual ones."""
        if label and not line.label:
            line.serial = ""
            self._station.show_rest(line)
            try:
                self._check_label(label)
            except Refused as refused:
                self._station.tell(
                    ScanRefused(label, refused.code, refused.reason, refused.remedy, line.name)
                )
                return
            self._station.tell(ScanAccepted(label, "label", line.name))
            self._assign(line, label, was_chosen=True)
            return
        others = [e for e in self._lines.values() if e is not line and self._awaits_label(e)]
        if self._label and not line.label and not others:
            serial, self._label = self._label, ""
            self._assign(line, serial)
        elif line.label:
            self._station.show_rest(line)
        else:
            line.serial = ""
            self._station.show_rest(line)

    def forget_unit(self, line: SocketLine) -> None:
        """The unit is out: a label that was meant for it is not for the next one."""
        if line.label and not line.state.is_verdict and line.begin_at_s is None:
            line.label = ""

    # -- commands ---------------------------------------------------------------------------------

    def _take_command(self, word: Word, argument: str) -> tuple[str, str]:
        match word:
            case Word.SOCKET:
                return self._take_socket(argument)
            case Word.ABORT:
                return self._abort(self._named(argument))
            case Word.FREE:
                return self._free(self._named(argument))
            case Word.CANCEL:
                self._cancel()
            case Word.LOT:
                self.claiming.lot = argument
            case Word.OPERATOR:
                self.claiming.operator = argument
            case Word.REASON:
                self.claiming.give_reason(argument)
            case Word.RESUME:
                self._resume()
        return word.value.lower(), ""

    def _named(self, name: str) -> SocketLine:
        found = next((e for e in self._lines.values() if e.name.lower() == name.lower()), None)
        if found is None:
            raise Refused(
                "NO_SUCH_SOCKET",
                "There is no such socket.",
                f"There are: {', '.join(self._lines)}.",
            )
        return found

    def _take_socket(self, argument: str) -> tuple[str, str]:
        self._is_choice_refused = True
        line = self._named(argument)
        if line.run is not None:
            raise Refused(
                Refusal.SOCKET_BUSY.value, f"Socket {line.name} is busy with {line.serial}.", _WAIT
            )
        if not line.can_work:
            raise Refused(
                "SOCKET_BROKEN", f"Socket {line.name}: {line.text}", "Use another socket."
            )
        if line.label:
            # The label is there, and a person says that the unit is: do not wait for more.
            line.begin_at_s = self._station.clock.monotonic_s()
            self._is_choice_refused = False
            return "socket", line.name
        if not line.is_free:
            raise Refused(
                "TAKE_OUT", f"{line.serial} is still in socket {line.name}.", "Take it out first."
            )
        self._is_choice_refused = False
        if self._label:
            serial, self._label = self._label, ""
            self._assign(line, serial, was_chosen=True)
        else:
            self._chosen = line
        return "socket", line.name

    def _abort(self, line: SocketLine) -> tuple[str, str]:
        if line.run is None or line.run.finished is not None:
            raise Refused("NOT_RUNNING", f"Nothing runs in socket {line.name}.", "Nothing to do.")
        self._station.abort(line)
        return "abort", line.name

    def _free(self, line: SocketLine) -> tuple[str, str]:
        if line.run is not None:
            raise Refused(
                Refusal.SOCKET_BUSY.value, f"Socket {line.name} is busy with {line.serial}.", _WAIT
            )
        line.is_there = False
        line.label, line.begin_at_s = "", None
        self._station.show_rest(line)
        return "free", line.name

    def _cancel(self) -> None:
        self._label, self._chosen = "", None
        self.claiming.cancel()
        self._is_choice_refused = False
        for line in self._lines.values():
            if line.label and line.run is None:
                line.label, line.begin_at_s = "", None
                self._station.show_rest(line)

    def _resume(self) -> None:
        if not self._station.is_line_stopped:
            raise Refused("NOT_STOPPED", "The line is not stopped.", "Nothing to do.")
        if not self._station.committing.resume():
            raise Refused("STILL_NOT_SAVED", "It still cannot be saved.", "Mend the cause first.")
