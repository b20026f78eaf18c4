"""`flasher station run`: run a station and show its events."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from flasher.cli.extras import need
from flasher.cli.output import Output
from flasher.cli.station.commands import PagesOptions, RecordsOptions, RunOptions
from flasher.cli.station.documents import StationRunDocument
from flasher.cli.station.place import operator_of, records_of
from flasher.cli.station.scans import LineReader, ScanFile, Typing, keyboard, read_scans
from flasher.cli.station.setup import (
    check_golden,
    crew_of,
    gate_of,
    labels_of,
    offered,
    recipes_of,
    scanners_of,
)
from flasher.cli.station.views import JsonLines, Lines, Table, View, figures_line
from flasher.cli.stop import stop_on_signal
from flasher.errors import (
    BusError,
    ErrorCode,
    ExitCode,
    FlasherError,
    InterruptedByUserError,
    UsageError,
)
from flasher.protocol.text import printable
from flasher.station.adapters import Resolved, detect, resolve, with_recipe, worker_setups
from flasher.station.codes import Code
from flasher.station.config import MockUnits, StationConfig, load_config, mock_config
from flasher.station.events import StationEvent
from flasher.station.operators import Crew
from flasher.station.recipe_file import load_checked
from flasher.station.records.database import locate_records
from flasher.station.records.errors import RecordError, StationBusyError
from flasher.station.records.keys import KeyLocations
from flasher.station.records.store import Store
from flasher.station.socket import FILE, PIPE, TERMINAL
from flasher.station.station import SCANS_ENDED, Station, StationOptions
from flasher.station.supervisor import Launch, ProcessPort
from flasher.station.virtual_units import next_number, number_of_first

if TYPE_CHECKING:
    from flasher.cli.station.pages import OperatorView

LAUNCH: Launch = ProcessPort
"""Starts the process of a socket; tests replace it."""
END_LIMIT_S: Final = 10.0
"""Time limit for aborted runs; runs that take longer are INTERRUPTED at the next start."""
WAIT_LEFT_S: Final = 4.0
"""Time that a label waits for its unit after the last scan."""
RETURN_LIMIT_S: Final = 10.0
"""Time limit for the return of an exchanged virtual unit."""
_LEAVE_S: Final = 2.0
"""Time for which the verdict on a virtual unit is shown."""


def run(
    output: Output,
    options: RunOptions,
    pages: PagesOptions,
    records: RecordsOptions,
    *,
    golden: Callable[[Crew | None], Sequence[str]] | None = None,
) -> int:
    """Run the command and return its exit code. Without a terminal the output is JSON. `golden`:
    scans of one golden unit, which releases this flasher with the recipe.
    """
    is_terminal = sys.stdout.isatty()
    if not (is_terminal or options.lines):
        output.json_wanted = True
    scans = None if options.scans is None else read_scans(options.scans)
    day = datetime.now().astimezone().date()
    local = None if options.recipe is None else load_checked(options.recipe, day)
    config, sockets = _find_sockets(options, records.sockets)
    if golden is not None:
        config = config.model_copy(update={"plant_recipes": False, "golden_unit": "required"})
    if local is None and not config.plant_recipes:
        raise UsageError(
            "A station needs a recipe.",
            remedy="Give --recipe FILE, or set plant_recipes in the station file.",
        )
    crew = None
    if local is not None:
        check_golden(config, local)
        # Fails before records are created.
        crew = crew_of(options, config, local.recipe.serial_number)
        scans = scans if golden is None else list(golden(crew))
    is_virtual = all(socket.bus is None for socket in sockets)
    view: View = Table(output)
    if output.json_wanted:
        view = JsonLines(output)
    elif options.lines or os.environ.get("TERM") == "dumb":
        view = Lines(output)
    with (
        _opened_records(options, records, config, output) as store,
        _sent_to_plant(options, records, config),
        ExitStack() as stack,
    ):
        recipes = recipes_of(options, config, sockets, store, local, day)
        if local is not None and any(each is not local for each in recipes.values()):
            output.progress(
                f"The plant's approved recipes are used instead of {printable(str(local.path))}"
                " (--ignore-approved: use it)."
            )
        recipe = recipes[sockets[0].config.name]
        if recipe is not local:
            crew = crew_of(options, config, recipe.recipe.serial_number)
        session = _Session(
            options, pages, output, store, view, crew, config, is_virtual,
            is_temporary=_is_temporary(options, records), has_scans=scans is not None,
        )  # fmt: skip
        first = 1
        # Serial numbers that are not in the records yet.
        if is_virtual and not _is_temporary(options, records):
            start = number_of_first(config.name) if config.plant else 1
            first = max(
                next_number(
                    each.recipe.serial_number, partial(store.read.known, each.recipe.part), start
                )
                for each in recipes.values()
            )
        output.has_opened = True
        gate = None if _is_temporary(options, records) else gate_of(config, recipes, store)
        setups = worker_setups(
            sockets,
            recipe,
            first_number=first,
            units=options.units,
            speed=options.mock_speed,
            leave_after_s=_LEAVE_S,
        )
        session.station = Station(
            store,
            recipe,
            [with_recipe(each, recipes[each.socket]) for each in setups],
            recipes=recipes,
            operator=operator_of(options.operator) if crew is None else "",
            lot=options.lot,
            crew=crew,
            labels=labels_of(config, recipe),
            on_event=session.show,
            on_turn=session.turn,
            options=StationOptions(
                scans_labels=session.scans_itself,
                end_limit_s=END_LIMIT_S,
                mixes_virtual=options.mix_virtual,
                needs_golden=config.golden_unit == "required",
                gets_recipes=config.plant_recipes,
            ),
            launch=LAUNCH,
            gate=gate,
        )
        if scans is not None:
            session.file = ScanFile(
                scans,
                list(session.station.line.sockets),
                partial(session.station.submit, source=FILE),
                badges=frozenset() if crew is None else crew.codes,
            )
        if config.plant_recipes:
            stack.enter_context(offered(config, sockets, store.files.folder, session.station.offer))
        session.work()
        return session.report()


def _find_sockets(
    options: RunOptions, file: Path | None
) -> tuple[StationConfig, tuple[Resolved, ...]]:
    """Station settings from the station file or for virtual units, with the sockets' adapters.
    Raises UsageError, BusError for a missing adapter.
    """
    if file is not None and options.mock_sockets is None:
        config = load_config(file)
    elif file is None and options.mock_sockets is not None:
        shares = {"bad": options.mock_bad, "slow": options.mock_slow, "dead": options.mock_dead}
        if sum(shares.values()) > 1:
            raise UsageError(
                "--mock-bad, --mock-slow and --mock-dead add up to more than 1.",
                remedy="Give smaller shares.",
            )
        units = MockUnits(
            **shares,
            exchanged=options.mock_exchanged,
            mislabelled=options.mock_mislabelled,
            seed=options.mock_seed,
        )
        config = mock_config(options.mock_sockets, units)
    else:
        raise UsageError(
            "A station needs either a station file or virtual sockets.",
            remedy="Give --sockets FILE or --mock-sockets N.",
        )
    sockets = resolve(config.socket, detect(config.socket))
    given = [name for name in ("units", "scan_by_hand") if getattr(options, name)]
    if given and any(socket.bus is not None for socket in sockets):
        raise UsageError(
            f"--{given[0].replace('_', '-')} is for virtual units; this station has adapters.",
            remedy="Remove it.",
        )
    if options.units and options.scans is not None:
        raise UsageError(
            "--units and --scans both decide when the station ends.", remedy="Remove one of them."
        )
    return config, sockets


def _is_temporary(options: RunOptions, records: RecordsOptions) -> bool:
    """True for virtual units without --database, whose records are temporary."""
    return options.mock_sockets is not None and records.database is None


@contextmanager
def _opened_records(
    options: RunOptions, records: RecordsOptions, config: StationConfig, output: Output
) -> Iterator[Store]:
    """Open the records of the options, or temporary ones. Raises UsageError, RecordError."""
    if not _is_temporary(options, records):
        with records_of(records).open(config.name, report=output.progress) as store:
            yield store
        return
    with tempfile.TemporaryDirectory(prefix="flasher-station-") as folder:
        file, key_locations = Path(folder) / "records.sqlite", KeyLocations(Path(folder) / "keys")
        with Store.open(str(file), station=config.name, key_locations=key_locations) as store:
            yield store


def _sent_to_plant(
    options: RunOptions, records: RecordsOptions, config: StationConfig
) -> AbstractContextManager[None]:
    """Send the records to the plant of the station file. Raises UsageError."""
    if not config.plant or _is_temporary(options, records):
        return nullcontext()
    need("Sending records to a plant", "plant")
    from flasher.plant.central import Refusal, plant_location  # noqa: PLC0415  an extra
    from flasher.plant.forwarder import load_state  # noqa: PLC0415
    from flasher.plant.process import Sending, sending  # noqa: PLC0415

    plant_location(config.plant)  # refuses a wrong URL before the first unit
    place = records_of(records)
    refusal = load_state(locate_records(place.url, place.files).folder, config.name).refusal
    if refusal.startswith(Refusal.TAKEN_OVER):
        raise StationBusyError(
            f"Another PC has taken {printable(config.name)} over: {printable(refusal)}.",
            remedy="Use that PC. To take the station back: flasher station take-over.",
        )
    recipes_for = tuple(each.name for each in config.socket) if config.plant_recipes else ()
    return sending(Sending(config.plant, config.name, place.url, place.files, recipes_for))


@dataclass
class _Session:
    """One run of the command, from the start of the station to its end."""

    options: RunOptions
    pages: PagesOptions
    output: Output
    store: Store
    view: View
    crew: Crew | None
    config: StationConfig
    is_virtual: bool
    is_temporary: bool
    """True if the records are deleted at the end."""
    has_scans: bool
    """True if a list of scans is given."""
    station: Station = field(init=False)
    file: ScanFile | None = None
    _pipe: LineReader | None = None
    _typing: Typing | None = None
    _was_submitted: bool = False
    _is_used_up: bool = False
    _busy_at: float = 0.0
    """Time at which a socket was last busy, in monotonic seconds."""
    _used_up_at: float = 0.0
    """Time at which the last scan was submitted, in monotonic seconds."""
    _failure: FlasherError | None = None
    _page: OperatorView | None = None
    _is_begun: bool = False

    @property
    def scans_itself(self) -> bool:
        """True if the station scans the labels of its virtual units automatically."""
        options = self.options
        by_hand = options.scan_by_hand or self.crew is not None or bool(self.config.scanner)
        return self.is_virtual and not self.has_scans and not by_hand

    # -- at work ----------------------------------------------------------------------------------

    def work(self) -> None:
        """Run the station until its scans are used up or it is stopped. Raises RecordError."""
        try:
            with ExitStack() as stack:
                stopped = stack.enter_context(stop_on_signal(self._first_stop, self._second_stop))
                self._open_page(stack)
                stack.enter_context(self.view.on_screen())
                self._open_scans(stack)
                self.station.run(until=lambda: self._is_over(is_stopped=stopped()))
        except KeyboardInterrupt:
            self._failure = _stopped_now()

    def _open_page(self, stack: ExitStack) -> None:
        """Serve the pages if --web is given. Raises UsageError."""
        address = self.options.web
        if address is None:
            return
        from flasher.cli.station.pages import (  # noqa: PLC0415  an extra
            operator_page,
            report_certificate,
        )

        page = operator_page(
            self.pages,
            address,
            self.station,
            self.view.board,
            self.config,
            key_locations=None if self.is_temporary else self.store.signer.key_locations,
            people=() if self.crew is None else self.crew.people,
        )
        self._page, url = stack.enter_context(page)
        report_certificate(self.pages, self.output)
        self.view.board.page = url

    def show(self, event: StationEvent) -> None:
        """Show one event; called in the station's thread."""
        self.view(event)
        if self._page is not None:
            self._page.show(event)

    def turn(self) -> None:
        """Refresh the view; called in each turn of the station's loop."""
        if not self._is_begun:
            self._is_begun = True
            if (page := self.view.board.page) and not isinstance(self.view, Table):
                self.output.progress(f"The operator page: {page}")
        if self._typing is not None:
            typed = self._typing.text
            self.view.typed = "*" * len(typed) if self.view.board.pin_of else typed
        self.view.refresh()
        if self._page is not None:
            self._page.turn()

    def _open_scans(self, stack: ExitStack) -> None:
        """Open the scanners and the keyboard or pipe. Raises UsageError."""
        for scanner in scanners_of(self.config, self.station):
            stack.enter_context(scanner)
        if sys.stdin is None:
            return
        if sys.stdin.isatty():
            submit = partial(self.station.submit, source=TERMINAL)
            has_pins = self.crew is not None and self.crew.has_pins
            if isinstance(self.view, Table) or has_pins:  # no echo of typed text
                self._typing = Typing(submit)
                stack.enter_context(keyboard(self._typing))
            else:
                LineReader(sys.stdin, submit).start()
        elif not (self.file or self.scans_itself or self._page or self.config.scanner):
            self._pipe = LineReader(sys.stdin, partial(self.station.submit, source=PIPE))
            self._pipe.start()

    def _second_stop(self) -> None:
        """Abort all runs after a second Ctrl-C; called in the signal handler."""
        # Raising here could leave a socket without its reply, in the middle of a turn.
        self._failure = _stopped_now()
        self.station.abort_all()

    def _first_stop(self) -> None:
        text = "No further unit starts; running ones are finished. Ctrl-C again stops them."
        self.view.board.reply(text)
        self.output.progress(text)
        self.view.refresh()

    def _is_over(self, *, is_stopped: bool) -> bool:
        """True if the station has to end; called in each turn of its loop."""
        if is_stopped:
            return True
        try:
            self._check_sockets()
            is_held = self.station.line.stopped is not None or bool(self.view.board.pin_of)
            if self.file is not None and not is_held:
                sockets = self.station.line.sockets.values()
                self.file.turn(sockets, self.view.board.labels, self.view.board.exchanged)
        except FlasherError as error:
            self._failure = error
            return True
        is_at_end = self._pipe is not None and self._pipe.is_at_end
        is_alone = is_at_end or (
            (self.file or self.scans_itself) and not (self._typing or self._page)
        )
        if self.station.line.stopped is not None and is_alone:
            return not self.station.is_running  # no further scan, so no RESUME can come
        # The station handles a submitted scan only in its next turn.
        was_submitted, self._was_submitted = self._was_submitted, self._scans_used_up()
        self._drop_what_waits()
        is_busy = any(socket.is_busy for socket in self.station.line.sockets.values())
        is_quiet = not (is_busy or self.view.board.waiting)
        now = self.station.clock.monotonic_s()
        if not is_quiet:
            self._busy_at = now
        if self.is_virtual and self.view.board.exchanged and now - self._busy_at < RETURN_LIMIT_S:
            is_quiet = False
        self._is_used_up = was_submitted and self._was_submitted and is_quiet
        return self._is_used_up

    def _drop_what_waits(self) -> None:
        """Drop cards and labels that wait too long for a unit after the last scan."""
        now = self.station.clock.monotonic_s()
        is_starting = any(socket.is_starting for socket in self.station.line.sockets.values())
        if self.scans_itself or is_starting or not self._was_submitted:
            self._used_up_at = now
        elif now - self._used_up_at >= WAIT_LEFT_S:
            self.station.drop_waiting()

    def _check_sockets(self) -> None:
        """Raises BusError if no socket can work any more."""
        broken = self.view.board.broken
        if broken.keys() >= self.station.line.sockets.keys():
            name, reason = next(iter(broken.items()))
            raise BusError(
                f"No socket can work; socket {printable(name)}: {printable(reason)}",
                remedy="Repair it, then start the station again.",
                code=ErrorCode.NO_SOCKET,
            )

    def _scans_used_up(self) -> bool:
        if self.file is not None:
            return self.file.is_used_up
        if self.scans_itself:
            wanted = self.options.units
            return wanted is not None and len(self.view.board.arrived) >= wanted
        return self._pipe is not None and self._pipe.is_at_end

    # -- summary ----------------------------------------------------------------------------------

    def report(self) -> int:
        """Print the summary and return the exit code."""
        board = self.view.board
        code = ExitCode.PARTIAL if board.bad_units or self._not_done() else ExitCode.OK
        self.output.results(self._summary())
        error, stopped = self._failure, board.stopped
        if error is None and stopped is not None:
            is_record = stopped.code == Code.RECORD_NOT_SAVED.name
            kind = RecordError if is_record else UsageError
            error = kind(f"The line was stopped: {stopped.reason}", remedy=stopped.remedy)
        # Only a list of scans can be incomplete: a shift ends whenever a person ends it.
        is_list = self.file is not None or bool(self.options.units)
        if error is None and is_list and not self._is_used_up:
            error = InterruptedByUserError(
                "The station was ended before all units were done.",
                remedy="Start it again with the remaining units.",
            )
        if error is not None:
            self.output.failure(error, self._document())
            return error.exit_code
        self.output.document(self._document(), exit_code=code)
        return code

    def _not_done(self) -> list[str]:
        """Labels without a run: refused ones of a file, or those of a pipe that still waited."""
        refused = {
            each.text
            for each in self.view.board.refused
            if each.code == SCANS_ENDED or (self.file and each.text in self.file.labels)
        }
        return sorted(refused - self.view.board.ended.keys())

    def _summary(self) -> Iterator[str]:
        board = self.view.board
        if board.virtual_sockets:
            yield board.virtual_words
        if board.figures is not None:
            yield figures_line(board.figures)
        for each in board.bad_units:
            text = f"{each.state.value:<8} {each.serial}, socket {each.socket}: {each.code}: "
            yield printable(text + each.text)
        for label in self._not_done():
            last = next(each for each in reversed(board.refused) if each.text == label)
            yield printable(f"{'refused':<8} {label}: {last.code}: {last.reason} {last.remedy}")
        if not self.is_temporary:
            yield f"records: {self.store.database.location.shown}"

    def _document(self) -> StationRunDocument:
        board, recipe = self.view.board, self.station.recipe.recipe
        location = self.store.database.location
        figures = None
        with suppress(RecordError):
            figures = self.station.figures
        return StationRunDocument(
            station=self.store.station,
            recipe=recipe.name,
            revision=recipe.revision,
            records="" if self.is_temporary else str(location.file or Path(location.shown)),
            is_complete=self._is_used_up,
            figures=figures,
            units=list(board.ended.values()),
            refused=list(board.refused),
        )


def _stopped_now() -> InterruptedByUserError:
    return InterruptedByUserError(
        "The station was stopped during runs.",
        remedy="Units that were being flashed are RECHECK: scan them again.",
    )
