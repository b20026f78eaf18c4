"""The operator page of `flasher station run --web`, and the supervisor's beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import datetime
from functools import partial

from flasher.cli.station.commands import Address, PagesOptions
from flasher.cli.station.serving import served
from flasher.said import say
from flasher.station.board import Board
from flasher.station.config import StationConfig
from flasher.station.events import RunEnded, StationEvent
from flasher.station.health import Watch
from flasher.station.people import Person
from flasher.station.records.keys import Keeping
from flasher.station.records.model import RunFilter, RunState, utc_moment
from flasher.station.station import Station
from flasher.station.tally import EndedRun, Tally
from flasher.web.desk import Desk, DeskPages
from flasher.web.operator import LINE, Lot, OperatorPage, Screen
from flasher.web.pages import Pages
from flasher.web.supervisor import PAGES, open_supervisor, place_of


class OperatorView:
    """Hands the events and turns of a station to the screen; called in the station's thread."""

    def __init__(self, screen: Screen, station: Station, board: Board) -> None:
        self._screen = screen
        self._station = station
        self._board = board
        self._lot = ""
        self._good: dict[str, bool] = {}
        """Units of the lot, and whether each passed in the end."""

    def show(self, event: StationEvent) -> None:
        """Show an event that the board has applied."""
        if isinstance(event, RunEnded):
            self._good[event.serial] = event.outcome is RunState.PASS
        self._screen.show(event, self._board)

    def turn(self) -> None:
        """Once in each turn of the station's loop."""
        line, board = self._station.line, self._board
        rule = self._station.recipe.recipe
        if rule.lot.quantity_max and line.lot != self._lot:
            runs = self._station.store.read.table(RunFilter(lot=line.lot, part=rule.part))
            self._good = {str(run["serial"]): run["state"] == RunState.PASS for run in runs}
        self._lot = line.lot
        lot = Lot(line.lot, rule.lot.quantity_max or 0, sum(self._good.values()))
        names = (board.station, board.recipe, board.part)
        operator = line.operator or say("nobody: scan a badge")
        if not board.has_badges:
            operator = say("{name} (no badges)", name=line.operator)
        self._screen.turn(board, station=names, operator=operator, lot=lot)


@contextmanager
def operator_page(
    options: PagesOptions,
    address: Address,
    station: Station,
    board: Board,
    config: StationConfig,
    *,
    keeping: Keeping | None,
    people: Sequence[Person],
) -> Iterator[tuple[OperatorView, str]]:
    """Serve the page, and those of the supervisor beside it, while the block runs; gives its view
    and its address. `keeping`: where the secret of the sessions is kept, so that pages go on after
    a restart; None for no place. `people`: those with a badge.

    Raises UsageError.
    """
    tally = Tally(config.shifts)
    began = tally.began(datetime.now().astimezone())
    store = station.store
    for row in store.read.table(RunFilter(since=began)):
        state = RunState(str(row["state"]))
        if row["station"] == store.station and state is not RunState.RUNNING:
            at = utc_moment(str(row["begun_at"]))
            tally.add(EndedRun(at, str(row["serial"]), state, str(row["code"])))
    watch = Watch(store.files.folder, station.clock.utc, station.clock.monotonic_s)
    screen = Screen(tally, watch)
    pages = Pages(options.language)
    operator = OperatorPage(pages, screen.feed, station.submit, sound_volume=config.sound_volume)
    view = OperatorView(screen, station, board)
    # In processes of their own: a page takes no time from the station.
    desk = Desk(partial(open_supervisor, *place_of(store), config.shifts))
    routes = [*operator.routes, *DeskPages(pages, desk.ask, PAGES).routes]
    server = served(
        options,
        address,
        routes,
        pages=pages,
        keeping=keeping,
        people=people,
        is_supervised=lambda path: path != "/" and not path.startswith(LINE),
    )
    with closing(desk), server as url:
        try:
            yield view, url
        finally:
            screen.feed.close()
