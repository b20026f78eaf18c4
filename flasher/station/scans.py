"""Scans of the operator: labels of units, and commands, which are barcodes on a card.

SOCKET A      the unit of the label before or after this scan is, or will be, in socket A
CANCEL        drop the label and the card that wait at this scanner
ABORT A       stop the run in socket A
FREE A        the unit was taken out of socket A, which the station cannot detect
LOT 4711      the lot of the following units
OPERATOR Jo   the operator from now on
REASON text   why units that passed are flashed again; applies to the next label
REPRINT W1    print the label of a passed unit again
RECIPE 1a2b.. a supervisor approves a recipe from the plant, by the digits of its digest
RESUME        the cause of a stopped line was removed: save open outcomes, and continue

`place` assigns a label that is scanned alone. No label is assigned to a unit only because it is the
first to report. The label belongs to

- the only socket of a station with one socket;
- the socket whose unit reports this serial number;
- the socket that the station names, when the unit is put in afterwards. It only names a socket that
  is known to be empty.

In all other cases the operator scans the card of the socket.

Each scanner, page and terminal is a `Source` with its own card or label that waits for the other
(`Waiting`): scans of two people do not mix.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.codes import Code
from flasher.station.pattern import TEXT_MAX
from flasher.station.records.errors import Refusal
from flasher.station.records.model import RunState
from flasher.station.socket import (
    PLANT_ASKED,
    Binding,
    LastRun,
    Occupancy,
    Socket,
    SocketPhase,
    Source,
)

_COMMAND_MAX: Final = 200


class Word(StrEnum):
    """The first word of a command."""

    SOCKET = "SOCKET"
    CANCEL = "CANCEL"
    ABORT = "ABORT"
    FREE = "FREE"
    LOT = "LOT"
    OPERATOR = "OPERATOR"
    REASON = "REASON"
    RECIPE = "RECIPE"
    REPRINT = "REPRINT"
    RESUME = "RESUME"


@dataclass
class Waiting:
    """A scan that waits for the other scan of its pair, card and label, from the same source."""

    source: Source
    label: str = ""
    """A label that waits for the card of its socket."""
    card: Socket | None = None
    """A socket whose card waits for its label."""
    is_in_doubt: bool = False
    """A card, or a second card or label, was refused: the next scan may belong to it, and must not
    be assigned to another unit or socket."""
    refused_label: tuple[str, float] | None = None
    """The last label refused for that reason, and its time. A later scan of the same label is
    accepted; another label is not, since people who share the source may each have scanned the
    card."""
    forget_at_s: float | None = None

    @property
    def text(self) -> str:
        """The waiting scan; "" without one."""
        return self.label or ("" if self.card is None else f"{Word.SOCKET.value} {self.card.name}")

    def forget(self) -> None:
        if self.card is not None:
            self.card.is_chosen = False
        self.label, self.card, self.is_in_doubt, self.forget_at_s = "", None, False, None
        self.refused_label = None


ALONE: Final = frozenset({Word.CANCEL, Word.RESUME})
"""Commands without an argument."""


@dataclass(frozen=True)
class Label:
    """A scan that is the serial number of a unit."""

    serial: str


@dataclass(frozen=True)
class ScanCommand:
    """A scan that is a command, for example SOCKET A."""

    word: Word
    argument: str = ""


@dataclass(frozen=True)
class NotUnderstood:
    """A scan that is neither a label nor a command; `why` is the reason."""

    why: str


def understand(scan: str) -> Label | ScanCommand | NotUnderstood:
    """Parse a scan. Whether a label belongs to the recipe is checked later."""
    scanned = scan.strip()
    if not scanned:
        return NotUnderstood(text("Nothing was scanned."))
    if not scanned.isprintable() or len(scanned) > _COMMAND_MAX:
        return NotUnderstood(text("It contains characters that no label has, or too many."))
    first, _, rest = scanned.partition(" ")
    word = next((each for each in Word if each.value == first.upper()), None)
    if word is not None and (word in ALONE) == (not rest.strip()):
        return ScanCommand(word, rest.strip())
    if word is not None:
        return NotUnderstood(
            text("{word} has no argument.", word=word.value)
            if word in ALONE
            else text("{word} what?", word=word.value)
        )
    if len(scanned) > TEXT_MAX:
        return NotUnderstood(text("It is longer than {most} characters.", most=TEXT_MAX))
    return Label(scanned)


WAIT: Final = text("Wait until that run ends.")
Sockets = Mapping[str, Socket]


class Refused(Exception):  # noqa: N818  not an error of the program
    """A scan is refused without effect: stable code, reason and remedy."""

    def __init__(self, code: str, reason: str, remedy: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason
        self.remedy = remedy


def place(sockets: Sockets, serial: str, source: Source) -> tuple[Socket, Binding] | None:
    """Socket for a label that was scanned alone. None: the operator has to scan the card of its
    socket. Raises Refused.
    """
    if len(sockets) == 1:
        (only,) = sockets.values()
        return only, _why_only(only, serial, source)
    idle = [
        e
        for e in sockets.values()
        if e.can_work and e.phase is SocketPhase.REST and not e.is_chosen
    ]
    reporting = [each for each in idle if each.is_there and each.own == serial]
    if len(reporting) == 1:
        return reporting[0], Binding.CONFIRMED
    starting = next((each for each in sockets.values() if each.is_starting), None)
    if starting is not None:
        raise Refused(
            "STARTING",
            text(
                "Socket {socket} is still starting: it is not known what is in it.",
                socket=starting.name,
            ),
            text("Scan the card of the unit's socket, then the label; or wait for it."),
        )
    may_be_in = (each.awaits_label and not each.is_of_another(serial) for each in sockets.values())
    if was_in(sockets, serial) is not None or any(may_be_in):
        return None
    empty = (e for e in sockets.values() if e.occupancy is Occupancy.EMPTY and e.can_work)
    named = next((e for e in empty if e in idle and not e.label), None)
    return None if named is None else (named, Binding.PROMPTED)


def was_in(sockets: Sockets, serial: str) -> Socket | None:
    """Socket of the unit's last run, unless it passed; None without one."""
    for each in sockets.values():
        last = each.verdict
        if each.interrupted == serial or (last is not None and last.serial == serial):
            return each
    return None


def _why_only(only: Socket, serial: str, source: Source) -> Binding:
    check_service(only)
    check_free(only)
    if only.is_chosen:
        raise card_waits(only)
    if only.label:
        raise one_at_a_time(only.label, only.wanted, _way_out(only, source))
    last = only.verdict
    if last is None or last.serial == serial:
        return Binding.ONLY_SOCKET
    if only.occupancy is not Occupancy.SILENT:
        return Binding.PROMPTED  # the next one, when this one is out
    if last.outcome is not RunState.PASS and not last.has_sent and only.sees_units:
        # The unit may be in its bootloader and announce itself at any time.
        raise Refused(
            "TAKE_OUT",
            text(
                "{serial} may still be in socket {socket}.",
                serial=printable(last.serial),
                socket=only.name,
            ),
            text("Take it out, scan FREE {socket}, then the label again.", socket=only.name),
        )
    return Binding.ONLY_SOCKET


def check_free(socket: Socket) -> None:
    """Check that the socket has no active or unsaved run. Raises Refused."""
    if socket.phase is not SocketPhase.REST:
        serial = printable(socket.serial)
        reason = text("Socket {socket} is busy with {serial}.", socket=socket.name, serial=serial)
        raise Refused(Refusal.SOCKET_BUSY.value, reason, WAIT)


def check_service(socket: Socket) -> None:
    """Check that the socket is in service, or starting. Raises Refused."""
    if socket.out_of_service:
        reason = text(
            "Socket {socket} is out of service: {why}",
            socket=socket.name,
            why=socket.out_of_service,
        )
        raise Refused("SOCKET_BROKEN", reason, text("Use another socket, or repair this one."))


def check_known(sockets: Sockets, serial: str) -> None:
    """Check that the unit is not running and has not just passed. Raises Refused."""
    for each in sockets.values():
        if each.phase is not SocketPhase.REST and each.serial == serial:
            reason = text("It runs in socket {socket}.", socket=each.name)
            raise Refused(Refusal.UNIT_RUNNING.value, reason, WAIT)
        last = each.verdict
        if last is not None and last.serial == serial and last.outcome is RunState.PASS:
            reason = text("It has just passed in socket {socket}.", socket=each.name)
            raise Refused("JUST_PASSED", reason, text("Take it out, and scan the next unit."))


def check_first(sockets: Sockets, serial: str, waiting: Waiting) -> None:
    """Check that no other label waits, and this one was not scanned already. Raises Refused.
    `waiting`: the waiting scan of the same source.
    """
    for each in sockets.values():
        if each.label == serial and each.asked == serial:
            raise Refused("DOUBLE_SCAN", text("It was scanned already."), PLANT_ASKED)
        if each.label == serial:
            remedy = text(
                "{wanted} If it is there, scan SOCKET {socket}, then the label.",
                wanted=each.wanted,
                socket=each.name,
            )
            raise Refused("DOUBLE_SCAN", text("It was scanned already."), remedy)
        if each.label and each.binding is Binding.PROMPTED:
            raise one_at_a_time(each.label, each.wanted, _way_out(each, waiting.source))
    label = waiting.label
    if label:
        remedy = text("Scan the card of the socket that {label} is in.", label=printable(label))
        if label == serial:
            raise Refused("DOUBLE_SCAN", text("It was scanned already."), remedy)
        raise one_at_a_time(label, remedy)


def check_fits(sockets: Sockets, socket: Socket, serial: str) -> None:
    """Check that no other unit is known to be in the socket. Raises Refused."""
    last = socket.holds
    if last is not None and last.serial != serial:
        raise still_there(socket, last)
    if socket.is_of_another(serial):
        raise Refused(Code.WRONG_UNIT.name, _report_of(socket), Code.WRONG_UNIT.action)
    for each in sockets.values():
        if each is not socket and each.is_there and each.own == serial:
            raise Refused(
                Code.WRONG_UNIT.name,
                _report_of(each),
                text(
                    "Compare the labels of the units in the sockets {one} and {other}.",
                    one=each.name,
                    other=socket.name,
                ),
            )


def _report_of(socket: Socket) -> str:
    own = printable(socket.own or "")
    return text("The unit in socket {socket} reports {own}.", socket=socket.name, own=own)


def check_one_socket(sockets: Sockets, socket: Socket, serial: str, source: Source) -> None:
    """Check that the label was not assigned to another socket by its card. Raises Refused."""
    for each in sockets.values():
        if each is not socket and each.label == serial and each.binding is not Binding.PROMPTED:
            reason = text("It was scanned for socket {socket}.", socket=each.name)
            way = _way_out(each, source)
            remedy = text("{wanted} Or scan {way}.", wanted=each.wanted, way=way)
            raise Refused("DOUBLE_SCAN", reason, remedy)


def _way_out(socket: Socket, source: Source) -> str:
    """Scan that drops a label which waits for its unit."""
    return Word.CANCEL.value if socket.source == source else f"{Word.FREE.value} {socket.name}"


def card_waits(socket: Socket) -> Refused:
    """Refusal of a scan for a socket whose card was scanned at another source."""
    return Refused(
        "CARD_WAITS",
        text("The card of socket {socket} was scanned elsewhere.", socket=socket.name),
        text("Its label has to be scanned there, or CANCEL; then scan it here."),
    )


def one_at_a_time(label: str, wanted: str, way: str = Word.CANCEL.value) -> Refused:
    """Refusal of a label while another one waits."""
    reason = text("{label} was scanned before and waits for its unit.", label=printable(label))
    return Refused("LABEL_WAITS", reason, text("{wanted} Or scan {way}.", wanted=wanted, way=way))


def still_there(socket: Socket, last: LastRun) -> Refused:
    """Refusal of a scan while the unit of the last run is still in the socket."""
    return Refused(
        "TAKE_OUT",
        text(
            "{serial} is still in socket {socket}.",
            serial=printable(last.serial),
            socket=socket.name,
        ),
        text("Take it out first. If it is out, scan FREE {socket}.", socket=socket.name),
    )
