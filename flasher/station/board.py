"""Current state of a station, built from its events. The terminal and the pages display it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.codes import Code
from flasher.station.events import (
    FiguresChanged,
    LabelFailed,
    LabelPrinted,
    LineResumed,
    LineStopped,
    OperatorPrompted,
    PinAwaited,
    PinEnded,
    Progressed,
    RecipeChanged,
    RecipesOffered,
    RecordNotSaved,
    RunEnded,
    RunStarted,
    ScanAccepted,
    ScannerChanged,
    ScanRefused,
    SocketChanged,
    SocketState,
    StationEvent,
    StationStarted,
    StepStarted,
    UnitArrived,
    UnitRemoved,
    WorkerFailed,
)
from flasher.station.records.model import Figures, RunRecord, RunState, StepName
from flasher.station.scans import Word
from flasher.station.socket import PAGE, source_words

STEPS: Final = {
    StepName.PLANT: text("plant"),
    StepName.CONNECT: text("connect"),
    StepName.IDENTIFY: text("identify"),
    StepName.CHECK: text("check"),
    StepName.FLASH: text("flash"),
    StepName.WRITE: text("write"),
    StepName.RESTART: text("restart"),
    StepName.VERIFY: text("verify"),
    StepName.SAVE: text("save"),
}
"""Steps of a run, for people."""
NAMES_SHOWN: Final = 3
_PAGES_MAX: Final = 100
"""Maximum number of pages whose last reply is stored."""
NO_BADGES: Final = text("No badge table: operator names are not checked.")


def _doing(step: StepName, target: str, try_number: int) -> str:
    words = STEPS[step]
    if target:
        words = text("{step} {target}", step=words, target=target)
    if try_number > 1:
        words = text("{step} try {number}", step=words, number=try_number)
    return words


@dataclass
class Row:
    """Displayed state of one socket. Its texts are safe to show."""

    socket: str
    state: SocketState = SocketState.STARTING
    serial: str = ""
    step: str = ""
    share: float | None = None
    """Progress of the step, from 0 to 1."""
    left_s: float | None = None
    note: str = ""
    """An error, or the next action of the operator."""
    code: str = ""
    """Code of the last run, while its unit is in the socket without a PASS."""
    is_virtual: bool = False
    """The socket has virtual units, which are not products."""
    virtual_label: str = ""
    """Label of the virtual unit in the socket, which a trainee has to type."""


@dataclass(frozen=True)
class ScanReply:
    """The reply to a scan, or a prompt to a person."""

    text: str = ""
    is_refusal: bool = False
    number: int = 0
    """Sequence number of replies to all sources."""


@dataclass(frozen=True)
class Replies:
    """The last reply to each page, and the last reply to all other sources."""

    to_all: ScanReply = ScanReply()
    to_pages: Mapping[str, ScanReply] = field(default_factory=dict)

    def to(self, source: str) -> ScanReply:
        """The newest reply that a source may see: its own, or the last to all."""
        return max(
            self.to_all, self.to_pages.get(source, ScanReply()), key=lambda each: each.number
        )

    def with_answer(self, text: str, source: str, *, is_refusal: bool) -> Replies:
        before = max((each.number for each in self.to_pages.values()), default=0)
        answer = ScanReply(text, is_refusal, max(before, self.to_all.number) + 1)
        if not source.startswith(PAGE):
            return replace(self, to_all=answer)
        others = {name: each for name, each in self.to_pages.items() if name != source}
        return replace(self, to_pages=dict([*others.items(), (source, answer)][-_PAGES_MAX:]))


@dataclass
class Board:
    """Displayed state of a station; `apply` updates it with each event."""

    rows: dict[str, Row] = field(default_factory=dict)
    title: str = ""
    station: str = ""
    recipe: str = ""
    """Name and revision; by socket, if they have different ones."""
    recipes: dict[str, str] = field(default_factory=dict)
    """Name and revision by socket."""
    offered: RecipesOffered | None = None
    """Recipes from the plant; None without any news of them."""
    part: str = ""
    figures: Figures | None = None
    stopped: LineStopped | None = None
    page: str = ""
    """URL of the operator page; empty without one."""
    records_fault: str = ""
    """Reason why the last record was not saved; "" if it was."""
    replies: Replies = Replies()
    scanners: set[str] = field(default_factory=set)
    """Sources of scans so far, except pages."""
    prompt: str = ""
    """Next action for the label that was scanned last."""
    pin_of: str = ""
    """Person whose PIN is typed next: typed text must not be shown. Empty: no PIN is awaited."""
    has_badges: bool = True
    """False if the station was started without a badge table."""
    labels: dict[str, str] = field(default_factory=dict)
    """Labels of the virtual units in sockets, by socket."""
    ended: dict[str, RunRecord] = field(default_factory=dict)
    """Last run of each unit, by serial number."""
    refused: list[ScanRefused] = field(default_factory=list)
    waiting: dict[str, str] = field(default_factory=dict)
    """Sources of accepted labels without a socket, by label."""
    lost_scanners: dict[str, ScannerChanged] = field(default_factory=dict)
    """Scanners that cannot be read, by name."""
    unprinted: dict[str, LabelFailed] = field(default_factory=dict)
    """Labels that were not printed, by serial number."""
    arrived: set[str] = field(default_factory=set)
    """Labels of all virtual units so far."""
    virtual_sockets: tuple[str, ...] = ()
    broken: dict[str, str] = field(default_factory=dict)
    """Reasons of the sockets that will not work until the station is restarted or they get another
    recipe, by socket."""

    @property
    def unprinted_words(self) -> str:
        """Units whose labels were not printed, and what to do; "" without any."""
        if not self.unprinted:
            return ""
        names, first = few(self.unprinted), printable(next(iter(self.unprinted)))
        return text("not printed: {names}; scan REPRINT {first}", names=names, first=first)

    @property
    def last_reply(self) -> str:
        """Reply to the last scan outside pages, or a prompt."""
        return self.replies.to_all.text

    @property
    def is_refusal(self) -> bool:
        """True if the last scan outside pages was refused."""
        return self.replies.to_all.is_refusal

    def apply(self, event: StationEvent) -> None:
        match event:
            case StationStarted() | RecipeChanged() | RecipesOffered():
                self._set_up(event)
            case FiguresChanged(figures):
                self.figures = figures
            case LineStopped():
                self.stopped = event
            case LineResumed():
                self.stopped, self.records_fault = None, ""
            case ScanAccepted() | ScanRefused():
                self._scanned(event)
            case PinAwaited() | PinEnded() | LabelPrinted() | LabelFailed() | ScannerChanged():
                self._apply_device_event(event)
            case OperatorPrompted("", text, _, source):
                # The next event accepts the scan that it belongs to.
                self.prompt = shown(text)
                self.reply(self.prompt, source=source)
            case UnitArrived(socket, _, label):
                self.labels[socket] = label
                self.rows[socket].virtual_label = printable(label)
                self.arrived.add(label)
            case UnitRemoved(socket):
                self.labels.pop(socket, None)
                self.rows[socket].virtual_label = ""
            case WorkerFailed(socket, reason, restart_in_s):
                if restart_in_s is None:
                    self.broken[socket] = reason
            case _:
                self._socket(event)

    def _set_up(self, event: StationStarted | RecipeChanged | RecipesOffered) -> None:
        if isinstance(event, StationStarted):
            self._begun(event)
        elif isinstance(event, RecipeChanged):
            self._recipe_changed(event)
        else:
            self.offered = event

    def _begun(self, event: StationStarted) -> None:
        recipe, revision, part = event.recipe, event.revision, event.part
        self.recipe = printable(f"{recipe}, {revision}")
        self.recipes = dict.fromkeys(event.sockets, self.recipe)
        self.station, self.part = printable(event.station), printable(part)
        self.title = printable(f"{event.station}: {recipe}, revision {revision}, {part}")
        self.virtual_sockets = virtual = event.virtual_sockets
        self.rows = {n: Row(printable(n), is_virtual=n in virtual) for n in event.sockets}
        self.has_badges = event.has_badges
        if not self.has_badges:
            self.reply(NO_BADGES)
        if virtual:
            self.title = f"{self.virtual_words} {self.title}"

    def _recipe_changed(self, event: RecipeChanged) -> None:
        self.broken.pop(event.socket, None)  # a process with this recipe is started
        self.recipes[event.socket] = printable(f"{event.recipe}, {event.revision}")
        names = dict.fromkeys(self.recipes.values())
        self.recipe, self.part = next(iter(names)), printable(event.part)
        if len(names) > 1:
            self.recipe = "; ".join(f"{printable(s)}: {name}" for s, name in self.recipes.items())
        self.title = printable(f"{self.station}: {self.recipe}, {self.part}")
        if self.virtual_sockets:
            self.title = f"{self.virtual_words} {self.title}"

    def _apply_device_event(
        self, event: PinAwaited | PinEnded | LabelPrinted | LabelFailed | ScannerChanged
    ) -> None:
        """Apply an event of PINs, labels or scanners."""
        if isinstance(event, ScannerChanged):
            self._scanner(event)
            return
        if isinstance(event, LabelPrinted | LabelFailed):
            self._labelled(event)
            return
        self.pin_of = printable(event.person) if isinstance(event, PinAwaited) else ""
        if isinstance(event, PinAwaited):
            sentence = printable(event.text)
            self.reply(
                text(
                    "{text}: type the PIN of {name}, or scan CANCEL.",
                    text=sentence,
                    name=self.pin_of,
                )
            )

    def _scanner(self, event: ScannerChanged) -> None:
        name = printable(event.scanner)
        self.lost_scanners.pop(name, None)
        self.reply(device_event_text(event), is_refusal=not event.is_ready)
        if not event.is_ready:
            self.lost_scanners[name] = event

    def _labelled(self, event: LabelPrinted | LabelFailed) -> None:
        if isinstance(event, LabelPrinted):
            self.unprinted.pop(event.serial, None)
            return
        self.unprinted[event.serial] = event
        self.reply(device_event_text(event), is_refusal=True)
        row = self.rows.get(event.socket)
        if row is not None and row.serial == printable(event.serial):
            row.note = self.last_reply

    def _scanned(self, event: ScanAccepted | ScanRefused) -> None:
        sentence = printable(event.text)
        if isinstance(event, ScanRefused):
            self.refused.append(event)
            if self.waiting.get(event.text) == event.source:
                del self.waiting[event.text]
            reason, remedy = shown(event.reason), shown(event.remedy)
            reply = text("{text}: {reason} {remedy}", text=sentence, reason=reason, remedy=remedy)
            self.reply(reply, event.source, is_refusal=True)
        else:
            meaning = text(event.meaning)
            if event.socket and event.meaning != Word.SOCKET.value.lower():
                socket = printable(event.socket)
                reply = text(
                    "{text}: {meaning} for socket {socket}",
                    text=sentence, meaning=meaning, socket=socket,
                )  # fmt: skip
            else:
                reply = text("{text}: {meaning}", text=sentence, meaning=meaning)
            if event.meaning == "label" and not event.socket:
                self.waiting[event.text] = event.source
                reply = text("{reply}. {prompt}", reply=reply, prompt=self.prompt)
            elif event.meaning == Word.CANCEL.value.lower():
                kept = {n: source for n, source in self.waiting.items() if source != event.source}
                self.waiting = kept
            self.reply(reply, event.source)
        self.prompt = ""

    def reply(self, answer: str, source: str = "", *, is_refusal: bool = False) -> None:
        """Show a reply where the scan came from; names the source if there are several."""
        if source and not source.startswith(PAGE):
            self.scanners.add(source)
            if len(self.scanners) > 1:
                answer = text("{source}: {reply}", source=source_words(source), reply=answer)
        self.replies = self.replies.with_answer(answer, source, is_refusal=is_refusal)

    def _socket(self, event: StationEvent) -> None:
        if isinstance(event, RecordNotSaved):
            self.records_fault = shown(event.reason)
        row = self.rows.get(getattr(event, "socket", ""))
        if row is None:
            return
        match event:
            case SocketChanged(_, state, serial, text):
                row.state, row.serial, row.note = state, printable(serial), shown(text)
                if state not in (SocketState.RUNNING, SocketState.SAVING):
                    row.step, row.share, row.left_s = "", None, None
                if not state.is_verdict:
                    row.code = ""
            case RunStarted(_, serial):
                self.waiting.pop(serial, None)
                row.code = ""
            case StepStarted(_, _, step, try_number, target):
                row.step = _doing(step, target, try_number)
                row.share, row.left_s, row.note = None, None, ""
            case Progressed(_, _, _, share, left_s):
                row.share, row.left_s = share, left_s
            case OperatorPrompted(_, text, _):
                row.note = shown(text)
            case RecordNotSaved(_, _, _, reason):
                row.note = shown(reason)
            case RunEnded(run):
                self.ended[run.serial] = run
                row.code = "" if run.state is RunState.PASS else run.code
                self.unprinted.pop(run.serial, None)  # its label is reported after its end
            case _:
                pass

    @property
    def virtual_words(self) -> str:
        """Notice that the station makes no products; empty when all sockets have adapters."""
        if not self.virtual_sockets:
            return ""
        if len(self.virtual_sockets) == len(self.rows):
            return text("VIRTUAL UNITS, no products.")
        names = ", ".join(map(printable, self.virtual_sockets))
        return text("VIRTUAL UNITS in {names}, no products.", names=names)

    @property
    def exchanged(self) -> frozenset[str]:
        """Units whose last run ended because they were exchanged."""
        changed = Code.UNIT_CHANGED.name
        return frozenset(name for name, run in self.ended.items() if run.code == changed)

    @property
    def bad_units(self) -> tuple[RunRecord, ...]:
        """Last runs of units that did not pass."""
        return tuple(each for each in self.ended.values() if each.state is not RunState.PASS)


def device_event_text(event: LabelFailed | LabelPrinted | ScannerChanged) -> str:
    """Text of an event of a label or a scanner, with its remedy."""
    if isinstance(event, LabelPrinted):
        return text("The label of {serial} was printed.", serial=printable(event.serial))
    if isinstance(event, LabelFailed):
        return text(
            "No label for {serial}: {reason} {remedy}",
            serial=printable(event.serial),
            reason=shown(event.reason),
            remedy=shown(event.remedy),
        )
    name = printable(event.scanner)
    if event.is_ready:
        return text("Scanner {name} is ready.", name=name)
    return text("Scanner {name} cannot be read: {why}", name=name, why=shown(event.reason))


def few(names: Collection[str]) -> str:
    """The first names, and the number of the others."""
    first = ", ".join(map(printable, list(names)[:NAMES_SHOWN]))
    more = len(names) - NAMES_SHOWN
    return text("{first} and {more} more", first=first, more=more) if more > 0 else first


def shown(text: str) -> str:
    """Make a text safe to show. A safe `Text` is returned as it is, since it can be translated."""
    safe = printable(text)
    return text if safe == text else safe
