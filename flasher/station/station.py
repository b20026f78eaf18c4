"""Runs a station: the processes of its sockets, its records, and the `Line` that decides.

    with Store.open(...) as store:
        station = Station(store, recipe, setups, operator="jo", on_event=print)
        station.run(until=lambda: False)      # station.submit("W2605002") from any thread

One thread does all work and writes all records. A run starts after its claim is on disk; a socket's
process does nothing irreversible before the intent is on disk; `RunEnded`, the only event with a
PASS, is published after the outcome is on disk. `flasher.station.line` assigns labels to units.
"""

from __future__ import annotations

import hashlib
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Final

from flasher import __version__
from flasher.errors import UsageError
from flasher.i18n import text
from flasher.log import log_event
from flasher.protocol.text import printable
from flasher.station import line, pins
from flasher.station.adapters import with_recipe
from flasher.station.codes import Code
from flasher.station.events import (
    FiguresChanged,
    LabelFailed,
    LabelPrinted,
    OfferedRecipe,
    OperatorPrompted,
    Progressed,
    RecipeChanged,
    RecipesOffered,
    RecordNotSaved,
    RunEnded,
    RunStarted,
    StationEvent,
    StationStarted,
    StationStopped,
    StepEnded,
    StepStarted,
    WorkerFailed,
)
from flasher.station.gate import Gate
from flasher.station.label_printer import LabelJob, LabelPrinter
from flasher.station.label_template import values_of
from flasher.station.line import ARRIVAL_LIMIT_S, Line
from flasher.station.messages import (
    AdapterDown,
    AdapterReady,
    Ask,
    FromWorker,
    JournalWrite,
    PresenceChanged,
    Stop,
    WorkerSetup,
    WriteReply,
)
from flasher.station.operators import Crew
from flasher.station.recipe import groups_by
from flasher.station.recipe_changes import changes
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.recipe_offers import SCAN_DIGITS, Offer, Offers, used
from flasher.station.records.errors import ClaimRefusedError, RecordError, Refusal
from flasher.station.records.model import (
    AuditEvent,
    Claim,
    Figures,
    Measurement,
    Order,
    RunFilter,
    RunId,
    RunKind,
    RunRecord,
    RunResult,
    RunState,
    StationClock,
    WriteId,
)
from flasher.station.records.store import Store, SystemClock
from flasher.station.records.tally import Totals
from flasher.station.runs import ActiveRun, save, with_history
from flasher.station.scans import Refused, Word
from flasher.station.socket import UNNAMED, Socket, SocketPhase, Source
from flasher.station.supervisor import Launch, ProcessPort, WorkerLost, WorkerSupervisor
from flasher.station.virtual_units import next_number, number_of_first

TURN_S: Final = 0.1
"""Maximum time that a turn of the loop waits."""
LATE_S: Final = 0.5
"""A unit cannot be exchanged sooner after the scan of its label."""
SCANS_ENDED: Final = "SCANS_ENDED"
"""Refusal code of labels that still wait after the last scan."""
EventHandler = Callable[[StationEvent], None]


@dataclass(frozen=True)
class StationOptions:
    """Options of a station; the defaults are for a line with people."""

    arrival_limit_s: float = ARRIVAL_LIMIT_S
    """Time that a label waits for its unit, as for `Line`."""
    end_limit_s: float = 30.0
    """Time limit for runs to end when the station closes."""
    scans_labels: bool = False
    """Scan the labels of virtual units automatically."""
    needs_golden: bool = False
    """After an update of flasher or a change of the recipe a golden unit has to pass first."""
    gets_recipes: bool = False
    """The plant gives recipes: the audit trail states which socket uses which."""
    mixes_virtual: bool = False
    """Real and virtual units may share the records, but not a serial number."""


class Station:
    """A station. Incidents on the line are reported by events, not exceptions.

    Each socket has a recipe of its own, or the same one. A recipe that the plant gives and a
    supervisor approves replaces that of a socket between two units.

    `submit`, `publish`, `note`, `offer`, `stop` and `abort_all` may be called from any thread, the
    others from one.
    """

    def __init__(  # noqa: PLR0913  all parts of a station
        self,
        store: Store,
        recipe: LoadedRecipe,
        setups: Iterable[WorkerSetup],
        *,
        recipes: Mapping[str, LoadedRecipe] | None = None,
        operator: str,
        lot: str = "",
        crew: Crew | None = None,
        labels: LabelPrinter | None = None,
        on_event: EventHandler = lambda _event: None,
        on_turn: Callable[[], None] = lambda: None,
        options: StationOptions | None = None,
        clock: StationClock | None = None,
        launch: Launch = ProcessPort,
        checker: Executor | None = None,
        gate: Gate | None = None,
    ) -> None:
        self.store = store
        self.options = options or StationOptions()
        self.clock: StationClock = clock or SystemClock()
        self._on_event = on_event
        self._on_turn = on_turn
        setups = tuple(setups)
        self._setups = {each.socket: each for each in setups}
        self.recipes = {name: (recipes or {}).get(name, recipe) for name in self._setups}
        """Recipe of each socket."""
        self._offers = Offers()
        self._offered: deque[Offers] = deque()
        self._released: set[tuple[str, ...]] = set()
        """Versions of flasher with recipes that a golden unit has passed with."""
        self._approved: dict[str, Offer] = {}
        """Approved recipes by the socket that does not use them yet."""
        self.line = Line(
            [Socket(each.socket, is_virtual=each.virtual is not None) for each in setups],
            self._read_serial,
            operator=operator,
            lot=lot,
            arrival_limit_s=self.options.arrival_limit_s,
            scans_labels=self.options.scans_labels,
            crew=crew,
            asks_plant=gate is not None,
        )
        self._gate = gate or Gate(recipe.recipe, None, None, self.clock.monotonic_s)
        self._gate.wake = self._wake
        self._gate.recipes = self.recipes
        self._has_badges = crew is not None
        self._labels = labels
        self._unlabelled: set[str] = set()
        """Units that have passed, and whose label is not known to be printed."""
        self.supervisor = WorkerSupervisor(setups, self.clock.monotonic_s, launch)
        self._runs: dict[str, ActiveRun] = {}
        """Claimed runs that are not saved yet, by socket."""
        self._scans: deque[tuple[str, Source, float]] = deque()
        """Scans with the times at which they were submitted."""
        self.timer = self.clock.monotonic_s
        """Clock for the age of scans and the pauses between turns."""
        self._turned_at = self.timer()
        """Time at which the last turn ended."""
        self._stalled = (0.0, 0.0)
        """Begin and end of the last pause between two turns that was too long."""
        self._published: deque[StationEvent] = deque()
        self._notes: deque[tuple[AuditEvent, Mapping[str, str]]] = deque()
        self._checked: deque[bool] = deque()
        """Results of PIN checks that the line has not processed yet."""
        self.checker = checker or pins.checker()
        """Executor for PIN checks."""
        self._wake_receiver, self._wake_sender = multiprocessing.Pipe(duplex=False)
        started = RunFilter(since=self.clock.utc(), station=self.store.station)
        self._totals = Totals(self.store.database, started)
        self._is_stopping = False
        self._is_aborting = False
        self._is_open = False

    # -- public calls ---------------------------------------------------------------------------

    def start(self) -> None:
        """Mark runs that a dead station left as INTERRUPTED, then start the sockets.

        Raises RecordError; UsageError for records of the other kind of units.
        """
        sockets = self.line.sockets
        are_mixed = _check_unit_kinds(
            self.store.read.unit_kinds(),
            frozenset(each.is_virtual for each in sockets.values()),
            self.options,
        )
        recovered = self.store.recover()
        self._find_interrupted(recovered)
        self.store.files.spool.mkdir(parents=True, exist_ok=True)
        self._is_open = True
        if self._labels is not None:
            self._labels.start(self._wake)
        unlabelled = () if self._labels is None else self.store.read.unlabelled(self.store.station)
        rule = self.recipe.recipe
        self._note_recipes()
        self._find_released()
        self.emit(
            StationStarted(
                self.store.station,
                rule.name,
                rule.revision,
                rule.part,
                tuple(sockets),
                recovered,
                tuple(each.name for each in sockets.values() if each.is_virtual),
                self._has_badges,
            )
        )
        for name, each in self.recipes.items():
            if each is not self.recipe:
                self._emit_recipe(name, each)
        for run in unlabelled:
            self._label_failed(run, _no_label(run))
        if are_mixed and self._has_badges:
            self.line.stop(
                "VIRTUAL_MIXED",
                text("Real and virtual units share these records."),
                text("A supervisor has to allow it."),
            )
        self.turn(0.0)

    def submit(self, text: str, source: Source = UNNAMED) -> None:
        """Submit a scan. A card and its label come from the same source."""
        self._scans.append((text, source, self.timer()))
        self._wake()

    def publish(self, event: StationEvent) -> None:
        """Publish an event from outside the line in the next turn."""
        self._published.append(event)
        self._wake()

    def note(self, what: AuditEvent, data: Mapping[str, str]) -> None:
        """Append an action of a person outside the line to the audit trail, in the next turn."""
        self._notes.append((what, data))
        self._wake()

    def offer(self, offers: Offers) -> None:
        """Offer the recipes that the plant gives, in the next turn."""
        self._offered.append(offers)
        self._wake()

    def drop_waiting(self) -> None:
        """Drop waiting cards and labels. Called in the station's thread."""
        remedy = text("Scan it again when the station runs.")
        self.line.drop_all(Refused(SCANS_ENDED, text("The scans have ended."), remedy))
        self._carry_out()

    def stop(self) -> None:
        """Start no further run; `run` returns after the active runs."""
        self._is_stopping = True
        self._wake()

    def abort_all(self) -> None:
        """Start no further run, and abort the active runs at their next safe place."""
        self._is_aborting = True
        self.stop()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Start and work until `stop` was called or `until` returns True; then close.

        Raises RecordError or UsageError if the station cannot start.
        """
        self.start()
        try:
            while not (self._is_stopping or until()):
                self.turn(TURN_S)
            self._is_stopping = True
            while self.is_running:
                self.turn(TURN_S)
        finally:
            self.close()

    def turn(self, limit_s: float) -> None:
        """One turn of the loop: wait up to `limit_s`, then do all due work."""
        if limit_s > 0:
            self.supervisor.wait([self._wake_receiver], limit_s)
        while self._wake_receiver.poll():
            self._wake_receiver.recv_bytes()
        began_at = self.timer()
        if began_at - self._turned_at > limit_s + LATE_S:
            self._stalled = (self._turned_at, began_at)
        self.line.is_closing = self._is_stopping
        for socket, message in self.supervisor.poll():
            self._process_message(socket, message)
        while self._published:
            self.emit(self._published.popleft())
        self._write_notes()
        while self._offered:
            self._offers = self._offered.popleft()
            for name, offer in tuple(self._approved.items()):
                if offer.given.digest in self._offers.withdrawn:
                    del self._approved[name]
            self._show_offers()
        self._change_recipes()
        self._take_scans()
        self._take_answers()
        if self._is_aborting:
            self._abort_running()
        self.line.tick(self._now)
        self._carry_out()
        self._publish_labels()
        self._on_turn()
        self._turned_at = self.timer()

    def _age_s(self, submitted_at: float) -> float:
        """Age of a scan; 0 for one that could not be taken sooner than what sockets reported. While
        this process stands still, no thread of it reads a scan either.
        """
        begin, end = self._stalled
        made_at = min(submitted_at, begin) if submitted_at <= end + LATE_S else submitted_at
        age_s = self.timer() - made_at
        return age_s if age_s > LATE_S else 0.0

    def _take_scans(self) -> None:
        """Pass scans and results of PIN checks to the line; scans wait during a check."""
        while self._checked or (self._scans and not self.line.is_checking_pin):
            if self._checked:
                self.line.pin_checked(self._now, is_right=self._checked.popleft())
            else:
                text, source, submitted_at = self._scans.popleft()
                self.line.scan(text, self._now, source, age_s=self._age_s(submitted_at))
            self._carry_out()

    def _take_answers(self) -> None:
        """Pass answers of the plant to the line."""
        for order, admission in self._gate.take():
            self.line.answered(order, admission, self._now)
            self._carry_out()
        if released := self._gate.take_released():
            self._note_released(released)

    def _note_released(self, run_ids: set[RunId]) -> None:
        """Record which runs the plant marks. What is not saved is found again."""
        try:
            for run_id in sorted(run_ids - self.store.read.released()):
                self.store.note(AuditEvent.CLAIM_RELEASED, {}, run_id)
        except RecordError as error:
            self._not_saved("", "", None, error)

    def close(self) -> None:
        """End all processes. Active runs are aborted, and saved if they report their end in time;
        the next start finds the others.
        """
        if not self._is_open:
            return
        self._is_open = False
        self._is_stopping = True
        self._abort_running()
        give_up_at = self._now + self.options.end_limit_s
        while self.is_running and self._now < give_up_at:
            self.turn(TURN_S)
        self.supervisor.close()
        self._gate.close()
        if self._labels is not None:
            self._labels.close()
            self._publish_labels()
        self._write_notes()
        self.emit(StationStopped(self.store.station))

    @property
    def is_running(self) -> bool:
        """True while a run has not reported its end."""
        return any(socket.is_running for socket in self.line.sockets.values())

    @property
    def recipe(self) -> LoadedRecipe:
        """Recipe of the first socket."""
        return next(iter(self.recipes.values()))

    @property
    def figures(self) -> Figures:
        """Totals of this station since it started. Raises RecordError."""
        return self._totals.figures()

    # -- inputs and effects of the line -----------------------------------------------------------

    @property
    def _now(self) -> float:
        return self.clock.monotonic_s()

    def emit(self, event: StationEvent) -> None:
        """Publish an event with the current time."""
        try:
            at = self.clock.utc().isoformat(timespec="milliseconds").replace("+00:00", "Z")
            self._on_event(replace(event, at=at))
        except Exception as error:  # noqa: BLE001  a failing view must not stop the line
            log_event(error)

    def _feed(self, socket: str, what: line.SocketInput) -> None:
        self.line.feed(socket, what, self._now)
        self._carry_out()

    def _carry_out(self) -> None:
        """Execute the effects of the line and feed back their results, until none is left."""
        while effects := self.line.take():
            for effect in effects:
                match effect:
                    case Order(_, socket):
                        claimed = self._claim(effect)
                        self.line.feed(socket, claimed, self._now)
                        if isinstance(claimed, RunStarted):
                            self._begin(claimed)
                    case line.AskPlant(order):
                        self._gate.ask(order)
                    case line.DropAdmission(admission):
                        self._gate.dropped(admission)
                    case line.AbortRun(socket):
                        self.supervisor.send(socket, Stop())
                    case line.SaveAgain(sockets):
                        saved = [self._save(socket) for socket in sockets]  # try every one
                        all_saved = self._end_unknown() and all(saved)
                        self.line.resumed(self._now, all_saved=all_saved)
                    case line.CheckPin(pin, pin_hash):
                        checked = self.checker.submit(pins.is_right, pin, pin_hash)
                        checked.add_done_callback(self._pin_checked)
                    case line.DoCommand(word, argument, data):
                        do = self._reprint if word is Word.REPRINT else self._approve
                        self.line.done(effect, do(argument, data))
                        self._change_recipes()
                    case line.Audit(what, data):
                        self._audit(what, data)
                    case _:
                        self.emit(effect)

    def _process_message(self, socket: str, message: FromWorker | WorkerLost) -> None:
        match message:
            case AdapterReady() | AdapterDown() | PresenceChanged():
                self._feed(socket, message)
            case Ask():
                self._answer(socket, message)
            case StepStarted() | Progressed() | OperatorPrompted() if socket in self._runs:
                if isinstance(message, StepStarted):
                    self._runs[socket].where = f"{message.step.value} {message.target}".strip()
                self.emit(replace(message, socket=socket))
            case RunResult():
                self.supervisor.worked(socket)
                self._end(socket, message)
            case WorkerLost(reason, hung, restart_in_s):
                self._end_lost(socket, reason, hung=hung)
                self._feed(socket, AdapterDown(reason))
                self.emit(WorkerFailed(socket, reason, restart_in_s))
            case _:
                pass  # heartbeats and endings: the supervisor handles them

    def _abort_running(self) -> None:
        for socket in self.line.sockets.values():
            if socket.phase is SocketPhase.RUN:
                self.supervisor.send(socket.name, Stop())

    def _pin_checked(self, checked: Future[bool]) -> None:
        """Put the result of a PIN check into the queue; called in the checker's thread."""
        self._checked.append(checked.exception() is None and checked.result())
        self._wake()

    def _wake(self) -> None:
        self._wake_sender.send_bytes(b"x")

    def _find_interrupted(self, runs: Iterable[RunId]) -> None:
        """Pass the sockets of interrupted runs to the line."""
        for run_id in runs:
            run = self.store.read.run(run_id).run
            socket = self.line.sockets.get(run.socket)
            if socket is not None:
                socket.interrupted = run.serial

    def _end_unknown(self) -> bool:
        """End runs whose claim was saved although an error was reported. False if that cannot be
        saved.
        """
        known = {run.claim.run_id for run in self._runs.values()}
        try:
            self._find_interrupted(self.store.end_unknown(known))
        except RecordError as error:
            self._not_saved("", "", None, error)
            return False
        return True

    def _write_notes(self) -> None:
        while self._notes:
            self._audit(*self._notes.popleft())

    def _audit(
        self, what: AuditEvent, data: Mapping[str, str], run_id: RunId | None = None
    ) -> None:
        try:
            self.store.note(what, data, run_id)
        except RecordError as error:
            self._not_saved("", "", None, error)
            self.line.stop(Code.RECORD_NOT_SAVED.name, error.what, error.remedy)

    # -- recipes from the plant -------------------------------------------------------------------

    def _read_serial(self, serial: str) -> object:
        """Check that a text is a serial number of a recipe in use. Raises ValueError."""
        for recipe in self.recipes.values():
            with suppress(ValueError):
                return recipe.recipe.serial_number.read(serial)
        return self.recipe.recipe.serial_number.read(serial)

    def _show_offers(self) -> None:
        """Publish what waits for a supervisor, and what was withdrawn."""
        offered = []
        for offer in self._offers.offers:
            given, loaded = offer.given, offer.loaded
            sockets = [name for name in given.sockets if self._waits_for(name, given.digest)]
            if not sockets or given.digest in self._offers.withdrawn:
                continue
            found = OfferedRecipe(
                "", given.digest, tuple(sockets), given.at, given.by, problem=offer.problem
            )
            if loaded is not None and not offer.problem:
                rule = loaded.recipe
                found = replace(
                    found,
                    recipe=f"{rule.name}, {rule.revision}",
                    changes=self._changes(sockets, loaded),
                    scan=f"{Word.RECIPE.value} {given.digest[:SCAN_DIGITS]}",
                )
            offered.append(found)
        withdrawn = [
            name
            for name, recipe in self.recipes.items()
            if recipe.digest in self._offers.withdrawn and name not in self._approved
        ]
        self.emit(RecipesOffered(tuple(offered), tuple(withdrawn)))

    def _changes(self, sockets: Sequence[str], loaded: LoadedRecipe) -> tuple[str, ...]:
        """Differences from the recipes that these sockets use now."""
        users: dict[tuple[str, ...], list[str]] = {}
        for name in sockets:
            users.setdefault(tuple(self.recipes[name].files.values()), []).append(name)
        found = {
            ", ".join(names): changes(self.recipes[names[0]], loaded) for names in users.values()
        }
        if len(found) == 1:
            return found.popitem()[1]
        return tuple(
            text("socket {socket}, {change}", socket=printable(names), change=each)
            for names, differences in found.items()
            for each in differences
        )

    def _waits_for(self, socket: str, digest: str) -> bool:
        """True if a socket neither uses this recipe nor will do so."""
        if socket not in self.recipes:
            return False
        due = self._approved.get(socket)
        return digest != (self.recipes[socket].digest if due is None else due.given.digest)

    def _approve(self, digits: str, data: Mapping[str, str]) -> Refused | None:
        """Approve the offered recipe of these digits; returns the refusal, or None."""
        found = [
            offer
            for offer in self._offers.offers
            if len(digits) >= SCAN_DIGITS and offer.given.digest.startswith(digits.lower())
        ]
        if len(found) != 1:
            reason = text("The plant offers no recipe with this digest.")
            return Refused("NO_SUCH_RECIPE", reason, text("Scan what the operator page shows."))
        (offer,) = found
        loaded = offer.loaded
        if offer.given.digest in self._offers.withdrawn:
            reason = text("The plant has withdrawn this recipe.")
            return Refused(Refusal.RECIPE_WITHDRAWN.value, reason, _OTHER_RECIPE)
        if loaded is None or offer.problem:
            return Refused("RECIPE_UNUSABLE", offer.problem, _OTHER_RECIPE)
        sockets = [
            name for name in offer.given.sockets if self._waits_for(name, offer.given.digest)
        ]
        if not sockets:
            reason = text("This recipe is approved already.")
            return Refused("RECIPE_APPROVED", reason, text("Nothing to do."))
        facts = {**_recipe_facts(loaded), "sockets": sockets}
        published = {"published_at": offer.given.at, "published_by": offer.given.by}
        try:
            self.store.note(AuditEvent.RECIPE_APPROVED, {**data, **facts, **published})
        except RecordError as error:
            return Refused(Code.RECORD_NOT_SAVED.name, _error_line(error), error.remedy)
        self._approved |= dict.fromkeys(sockets, offer)
        self._show_offers()
        return None

    def _change_recipes(self) -> None:
        """Give the sockets that are between two units their approved recipe."""
        if self.line.stopped is not None:
            return  # what could not be recorded is tried again after RESUME
        for name, offer in tuple(self._approved.items()):
            recipe = offer.loaded
            if recipe is None or name in self._runs or not self.line.is_between_units(name):
                continue
            try:
                self.store.note(AuditEvent.RECIPE_USED, {**_recipe_facts(recipe), "socket": name})
                setup = self._with_number(with_recipe(self._setups[name], recipe), recipe)
            except RecordError as error:
                self._not_saved("", "", None, error)
                self.line.stop(Code.RECORD_NOT_SAVED.name, error.what, error.remedy)
                return
            del self._approved[name]
            # The process that knows the old recipe gets no further run.
            self.recipes[name], self._setups[name] = recipe, setup
            self.supervisor.replace(setup)
            self.line.restart(name, self._now)
            self._emit_recipe(name, recipe)
            self._show_offers()

    def _with_number(self, setup: WorkerSetup, recipe: LoadedRecipe) -> WorkerSetup:
        """Settings whose virtual units have new numbers. Raises RecordError."""
        virtual = setup.virtual
        if virtual is None:
            return setup
        rule, part = recipe.recipe.serial_number, recipe.recipe.part
        start = number_of_first(self.store.station)
        number = next_number(rule, lambda serials: self.store.read.known(part, serials), start)
        number += (virtual.first_number - number) % virtual.number_step
        return replace(setup, virtual=replace(virtual, first_number=number))

    def _note_recipes(self) -> None:
        """Record the recipes of a station that gets them from the plant. Raises RecordError."""
        if not self.options.gets_recipes:
            return
        last = used(self.store.read, self.store.station)
        for name, recipe in self.recipes.items():
            facts = {**_recipe_facts(recipe), "socket": name}
            if last.get(name) != facts:
                self.store.note(AuditEvent.RECIPE_USED, facts)

    def _emit_recipe(self, socket: str, recipe: LoadedRecipe) -> None:
        rule = recipe.recipe
        self.emit(RecipeChanged(socket, rule.name, rule.revision, rule.part, recipe.digest))

    # -- golden units after an update -------------------------------------------------------------

    def _find_released(self) -> None:
        """Read what a golden unit has passed with. Raises RecordError."""
        if self.options.needs_golden:
            rows = self.store.read.noted(self.store.station, AuditEvent.RELEASED)
            self._released = {_release_key(data) for data in rows}

    def _needs_golden(self, order: Order) -> Refused | None:
        """The refusal of a unit before a golden unit has passed; None if it may begin."""
        if not self.options.needs_golden:
            return None
        recipe = self.recipes[order.socket]
        golden = recipe.recipe.golden
        serials = () if golden is None else golden.serial_numbers
        is_released = _release_key(_release(recipe, is_virtual=order.is_virtual)) in self._released
        if is_released or order.serial in serials:
            return None
        reason = text(
            "No golden unit has passed with flasher {version} and this recipe yet.",
            version=__version__,
        )
        remedy = text("Scan and connect one of: {serials}.", serials=", ".join(serials))
        return Refused(Refusal.GOLDEN_DUE.value, reason, remedy)

    def _note_golden(self, socket: str, claim: Claim) -> None:
        """Record the PASS of a golden unit, which releases this flasher with its recipe."""
        if claim.kind is not RunKind.GOLDEN or not self.options.needs_golden:
            return
        recipe = self.recipes[socket]
        facts = _release(recipe, is_virtual=self.line.sockets[socket].is_virtual)
        key = _release_key(facts)
        if key not in self._released:
            run = {"recipe_sha256": recipe.sha256, "serial": claim.serial, "socket": socket}
            try:
                self.store.note(AuditEvent.RELEASED, {**facts, **run}, claim.run_id)
            except RecordError as error:
                self._not_saved(socket, claim.serial, claim.run_id, error)
                return
            self._released.add(key)

    # -- beginning --------------------------------------------------------------------------------

    def _claim(self, order: Order) -> line.SocketInput:
        socket = order.socket
        recipe = self.recipes[socket]
        refused = self._needs_golden(order)
        if refused is None and recipe.digest in self._offers.withdrawn:
            reason = text("The plant has withdrawn the recipe of this socket.")
            refused = Refused(Refusal.RECIPE_WITHDRAWN.value, reason, _OTHER_RECIPE)
        if refused is not None:
            self._gate.dropped(order.admission)
            return refused
        try:
            lives = self.store.read.units(order.serial)
            claim = self.store.claim(order, recipe)
        except ClaimRefusedError as error:
            self._gate.dropped(order.admission)
            return Refused(error.refusal.value, error.what, error.remedy)
        except RecordError as error:
            self._gate.ended(order.admission)  # whether a run began is not known
            return self._not_saved(socket, order.serial, None, error)
        claim = with_history(claim, lives, recipe, is_reworked=bool(order.reason))
        trace = self.store.files.spooled(claim.run_id)
        at = self.line.sockets[socket]
        claim = replace(claim, trace=trace, presence=at.presence_number, has_card=at.has_card)
        gets_label = (
            self._labels is not None
            and self._labels.prints_each
            and not order.is_virtual
            and claim.kind not in (RunKind.GOLDEN, RunKind.VERIFY_ONLY)
        )
        self._runs[socket] = ActiveRun(claim, self._now, order.admission, gets_label)
        return RunStarted(socket, claim.serial, claim.run_id, claim.kind, order.is_virtual)

    def _begin(self, started: RunStarted) -> None:
        """Send the claimed run to the process of its socket."""
        self.emit(started)
        socket = started.socket
        admission = self._runs[socket].admission
        if admission is not None and (answer := admission.answer) and answer.text != "yes":
            words = text("The plant: {answer}.", answer=printable(answer.text))
            self.emit(OperatorPrompted("", words))
        if not self.supervisor.send(socket, self._runs[socket].claim):
            self._end_lost(socket, Code.PROCESS_DIED.meaning, hung=False)

    def _active_run(self, socket: str) -> ActiveRun | None:
        """Run of a socket whose process has not reported the end."""
        run = self._runs.get(socket)
        return run if run is not None and run.reported is None else None

    # -- while a run goes on ----------------------------------------------------------------------

    def _answer(self, socket: str, asked: Ask) -> None:
        """Save a record that a process asks for, then reply."""
        run, number = self._active_run(socket), asked.number
        if run is None:
            reply = WriteReply(number, error="The run does not belong to this station.")
            self.supervisor.send(socket, reply)
            return
        write_id, claim = None, run.claim
        try:
            match asked.what:
                case JournalWrite(write_id=None) as write:
                    write_id = self.store.intent(
                        claim.run_id, write.target, write.what, write.value
                    )
                case JournalWrite(write_id=int() as done) as write:
                    self.store.verified(WriteId(done), write.read_back)
                case StepEnded() as step:
                    self._save_step(socket, claim, step, asked.measurements)
        except RecordError as error:
            run.journal_error = _error_line(error)
            self._feed(socket, self._not_saved(socket, claim.serial, claim.run_id, error))
            self.supervisor.send(socket, WriteReply(number, error=error.what))
        else:
            self.supervisor.send(socket, WriteReply(number, write_id))

    def _save_step(
        self, socket: str, claim: Claim, step: StepEnded, measurements: Sequence[Measurement]
    ) -> None:
        self.store.step(
            claim.run_id,
            step.name,
            step.state,
            duration_s=step.duration_s,
            code=step.code,
            text=step.text,
            measurements=measurements,
        )
        self.emit(replace(step, socket=socket, serial=claim.serial))

    # -- its end ----------------------------------------------------------------------------------

    def _end(self, socket: str, result: RunResult) -> None:
        """Save the outcome of a run that has ended, then publish it."""
        run = self._active_run(socket)
        if run is None:
            return
        run.reported, run.ended_s = result, self._now
        self._feed(socket, result)
        self._save(socket)
        self._carry_out()

    def _end_lost(self, socket: str, reason: str, *, hung: bool) -> None:
        run = self._active_run(socket)
        if run is None:
            return
        code = Code.PROCESS_HUNG if hung else Code.PROCESS_DIED
        text, duration_s = f"In {run.where}: {reason}.", self._now - run.begun_s
        self._end(socket, RunResult(code.outcome, code.name, text, duration_s))

    def _save(self, socket: str) -> bool:
        """Save the outcome of a run and publish it; False if it could not be saved."""
        run = self._runs[socket]
        claim = run.claim
        try:
            result = save(self.store, run, self.clock.monotonic_s)
            saved = self.store.read.run(claim.run_id)
        except RecordError as error:
            not_saved = self._not_saved(socket, claim.serial, claim.run_id, error)
            self.line.feed(socket, not_saved, self._now)
            return False
        del self._runs[socket]
        self._gate.ended(run.admission)
        code = Code[result.code]
        is_pass = result.outcome is RunState.PASS
        action = _RECHECK if is_pass and claim.unchecked else code.action
        ended = RunEnded(saved.run, action, saved.targets)
        self.emit(ended)
        self.line.feed(socket, ended, self._now)
        if code is Code.TRACE_NOT_SAVED:  # the next ones would not be judged either
            self.line.stop(code.name, result.text, code.action)
        with suppress(RecordError):
            self.emit(FiguresChanged(self.figures))
        if is_pass:
            self._note_golden(socket, claim)
            if run.gets_label or claim.serial in self._unlabelled:
                self._print(saved.run)
        return True

    # -- labels (without effect on verdicts) -------------------------------------------------------

    def _print(self, run: RunRecord) -> None:
        """Print the label of a unit whose PASS is on disk."""
        if self._labels is None or _not_labelled(run) is not None:
            return
        if run.is_unchecked:
            self._label_failed(run, _no_label(run))
            return
        groups = groups_by(self.recipes[run.socket].content, run.serial)
        self._labels.submit(LabelJob(run, run.socket, values_of(run, groups)))

    def _reprint(self, serial: str, data: Mapping[str, str]) -> Refused | None:
        """Print a label again; returns the refusal, or None."""
        if self._labels is None:
            reason = text("This station has no printer.")
            return Refused("NO_PRINTER", reason, text("Set it up in the station file."))
        try:
            lasts = [last for each in self.store.read.units(serial) if (last := each.last)]
            # Of several units with this serial number, that of a part that is made here.
            parts = {each.recipe.part for each in self.recipes.values()}
            last = max(lasts, key=lambda e: (e.run.part in parts, e.run.run_id), default=None)
            refused = _NOT_PASSED if last is None else _not_labelled(last.run)
            if refused is not None or last is None:
                return refused
            groups = groups_by(self.store.read.recipe(last.run.recipe_sha256), serial)
            self.store.note(AuditEvent.REPRINT, data)
        except RecordError as error:
            return Refused(Code.RECORD_NOT_SAVED.name, _error_line(error), error.remedy)
        self._labels.submit(LabelJob(last.run, "", values_of(last.run, groups), is_reprint=True))
        return None

    def _publish_labels(self) -> None:
        for job, reason in () if self._labels is None else self._labels.take():
            serial = job.run.serial
            if reason:
                shown = printable(serial)
                remedy = text("Repair the printer, then scan REPRINT {serial}.", serial=shown)
                self._label_failed(job.run, Refused("", reason, remedy), job.socket)
            else:
                self._unlabelled.discard(serial)
                self._audit(AuditEvent.LABELLED, {"serial": serial}, job.run.run_id)
                self.emit(LabelPrinted(job.socket, serial, job.is_reprint))

    def _label_failed(self, run: RunRecord, why: Refused, socket: str | None = None) -> None:
        self._unlabelled.add(run.serial)
        socket = run.socket if socket is None else socket
        self.emit(LabelFailed(socket, run.serial, why.reason, why.remedy))

    def _not_saved(
        self, socket: str, serial: str, run_id: RunId | None, error: RecordError
    ) -> line.NotSaved:
        """Publish an error of the records; returns the input for the line."""
        self.emit(RecordNotSaved(socket, serial, run_id, _error_line(error), error.remedy))
        return line.NotSaved(error.what, error.remedy)


_RECHECK: Final = text("Put it aside: it was not checked whether it has passed at another station.")
_OTHER_RECIPE: Final = text("A supervisor has to approve another recipe from the plant.")
_NOT_PASSED: Final = Refused(
    "NOT_PASSED", text("The unit has not passed."), text("Only a passed unit gets a label.")
)


def _recipe_facts(recipe: LoadedRecipe) -> dict[str, str]:
    """What the audit trail states about a recipe."""
    rule = recipe.recipe
    return {
        "name": rule.name,
        "revision": rule.revision,
        "part": rule.part,
        "sha256": recipe.sha256,
        "digest": recipe.digest,
    }


_RELEASE: Final = ("flasher", "files_sha256", "units")


def _release(recipe: LoadedRecipe, *, is_virtual: bool) -> dict[str, str]:
    """What a golden unit releases: images, manifests and profile too, which change without the
    recipe. A virtual one proves nothing about real ones.
    """
    files = hashlib.sha256("".join(sorted(recipe.files.values())).encode("ascii")).hexdigest()
    values = (__version__, files, "virtual" if is_virtual else "real")
    return dict(zip(_RELEASE, values, strict=True))


def _release_key(data: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(data.get(name, "")) for name in _RELEASE)


def _not_labelled(run: RunRecord) -> Refused | None:
    """Reason why a unit with this last run gets no label."""
    if run.state is not RunState.PASS:
        return _NOT_PASSED
    if run.is_virtual or run.kind is RunKind.GOLDEN:
        return Refused(
            "NO_PRODUCT", text("It is not a product."), text("Only products get a label.")
        )
    return None


def _no_label(run: RunRecord) -> Refused:
    """Reason why no label of a PASS was printed, or is known to be, and what to do."""
    serial = printable(run.serial)
    if run.is_unchecked:
        return Refused(
            Refusal.NOT_CHECKED.value,
            text("It was not checked whether it has passed at another station."),
            text("If it has passed at no other station, scan REPRINT {serial}.", serial=serial),
        )
    return Refused(
        "NOT_PRINTED",
        text("The station ended before its label was reported as printed."),
        text("If it has none, scan REPRINT {serial}.", serial=serial),
    )


def _error_line(error: RecordError) -> str:
    """Message and location of an error in one line, without its remedy."""
    where = f" ({error.where})" if error.where else ""
    return f"{error.what.rstrip('.')}{where}."


def _check_unit_kinds(
    known: frozenset[bool], own: frozenset[bool], options: StationOptions
) -> bool:
    """Check that sockets may use records with these kinds of units: True for virtual, False for
    real; `own` are the sockets' kinds. Returns True if the records will then hold both kinds.

    Raises UsageError: a PASS of a virtual unit must not be mistaken for one of a product.
    """
    are_mixed = len(own | known) == len((True, False))
    if options.mixes_virtual or not are_mixed:
        return are_mixed
    if len(own) > 1:
        what = "Some sockets of this station have adapters, others have virtual units."
    elif True in own:
        what = "These records hold real units, and this station has virtual ones."
    else:
        what = "These records hold virtual units, and this station has adapters."
    raise UsageError(
        what,
        remedy="Use a separate database for virtual units, or --mix-virtual.",
    )
