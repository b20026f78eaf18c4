"""`flasher station pages`: the supervisor pages alone, of records that are only read."""

from __future__ import annotations

import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from flasher.cli.output import Output
from flasher.cli.station.commands import Address, PagesOptions, RecordsOptions
from flasher.cli.station.place import open_to_read
from flasher.cli.station.serving import served
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode
from flasher.station.config import load_config
from flasher.station.people import BADGES
from flasher.station.tally import DEFAULT_SHIFTS
from flasher.web.desk import Desk, DeskPages
from flasher.web.pages import Pages
from flasher.web.supervisor import PAGES, open_supervisor, place_of

_TURN_S: Final = 0.1


def serve(output: Output, address: Address, options: PagesOptions, records: RecordsOptions) -> int:
    config = None if records.sockets is None else load_config(records.sockets)
    shifts = DEFAULT_SHIFTS if config is None else config.shifts
    badges = "" if config is None else config.badges
    people = BADGES.load(Path(badges)).person if badges else ()
    with closing(open_to_read(records)) as store:  # what is wrong with them is said before
        place = place_of(store)
    pages = Pages(options.language)
    desk = Desk(partial(open_supervisor, *place, shifts))
    routes = [Route("/", _start), *DeskPages(pages, desk.ask, PAGES).routes]
    with (
        closing(desk),
        stop_on_signal() as stopped,
        served(
            options,
            address,
            routes,
            pages=pages,
            keeping=None,
            people=people,
            is_supervised=lambda _path: True,
        ) as url,
    ):
        desk.begin()
        output.progress(f"The supervisor pages: {url}; Ctrl-C ends them")
        while not stopped():
            time.sleep(_TURN_S)
    return ExitCode.OK


async def _start(_request: Request) -> Response:
    return RedirectResponse("/runs", 303)
