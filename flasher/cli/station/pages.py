"""Serves the pages of a station, and controls access to them.

`flasher station run --web` serves all pages, `flasher station pages` those of supervisors.
"""

from __future__ import annotations

import logging
import os
import secrets
import socket
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from datetime import time as dtime
from functools import partial
from pathlib import Path
from typing import Final

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route

from flasher.cli.output import Output
from flasher.cli.station.commands import Address, PagesOptions, RecordsOptions
from flasher.cli.station.place import open_to_read
from flasher.cli.stop import stop_on_signal
from flasher.errors import ErrorCode, ExitCode, UsageError
from flasher.files import check_secret, read
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.board import Board
from flasher.station.config import StationConfig, load_config
from flasher.station.events import RunEnded, StationEvent
from flasher.station.health import HealthCheck, HealthWatch, certificate_checks
from flasher.station.operators import BADGES, Person
from flasher.station.pins import checker
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import RunFilter, RunKind, RunState, StationClock
from flasher.station.records.store import Store, SystemClock
from flasher.station.shift_counts import DEFAULT_SHIFTS, ShiftCounts
from flasher.station.station import Station
from flasher.web.guard import application
from flasher.web.login import Badges, Login
from flasher.web.operator import LINE, CurrentLot, OperatorPage, Screen
from flasher.web.pages import Pages
from flasher.web.query_processes import QueryProcesses, answer_routes
from flasher.web.server import LOOPBACK, Server, Tls
from flasher.web.sign_ins import Note
from flasher.web.supervisor import (
    PAGES,
    UPLOADS,
    SupervisorPages,
    open_supervisor,
    place_of,
)

_TURN_S: Final = 0.1
PASSWORD_MIN: Final = 8
_PASSWORD_FILE_MAX_SIZE: Final = 4096
"""Bytes."""
_CERTIFICATE_MAX_SIZE: Final = 1024 * 1024
_ANY: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104  compared, not bound
_SECRET_MAX_SIZE: Final = 200
_LOG: Final = logging.getLogger("flasher.web")


# -- operator page --------------------------------------------------------------------------------


class OperatorView:
    """Passes events of a station to the operator page, in the station's thread."""

    def __init__(self, screen: Screen, station: Station, board: Board) -> None:
        self._screen = screen
        self._station = station
        self._board = board
        self._lot = CurrentLot("")
        self._good: dict[str, bool] = {}
        """Units of the lot by serial number; True if the last run passed."""

    def show(self, event: StationEvent) -> None:
        """Show an event that the board has applied."""
        if isinstance(event, RunEnded) and event.run.kind is not RunKind.GOLDEN:
            self._good[event.serial] = event.run.state is RunState.PASS
        self._screen.show(event, self._board)

    def turn(self) -> None:
        """Update operator and lot; called in each turn of the station's loop."""
        line, board = self._station.line, self._board
        rules = [each.recipe.lot for each in self._station.recipes.values()]
        size = min((each.quantity_max for each in rules if each.quantity_max), default=0)
        if size and (line.lot, size) != (self._lot.name, self._lot.size):
            runs = self._station.store.read.table(RunFilter(lot=line.lot))
            self._good = {
                run.serial: run.state is RunState.PASS
                for run in runs
                if run.kind is not RunKind.GOLDEN
            }
        self._lot = CurrentLot(line.lot, size, sum(self._good.values()))
        operator = line.operator or text("none: scan a badge")
        if not board.has_badges:
            operator = text("{name} (no badges)", name=line.operator)
        self._screen.turn(board, operator=operator, lot=self._lot)


@contextmanager
def operator_page(
    options: PagesOptions,
    address: Address,
    station: Station,
    board: Board,
    config: StationConfig,
    *,
    key_locations: KeyLocations | None,
    people: Sequence[Person],
) -> Iterator[tuple[OperatorView, str]]:
    """Serve the operator page and the supervisor pages while the block runs. Yields the view and
    the URL. `key_locations` and `people`: see `served`. Raises UsageError.
    """
    tally = ShiftCounts(config.shifts)
    began = tally.began(datetime.now().astimezone())
    store = station.store
    for run in store.read.table(RunFilter(since=began)):
        if run.station == store.station and run.state is not RunState.RUNNING:
            tally.add(run)
    clock, ends_at = station.clock, _certificate_end(options)
    watch = HealthWatch(
        store.files.folder,
        clock.utc,
        clock.monotonic_s,
        store.signer.unkept,
        lambda: (
            *certificate_checks(ends_at, clock.utc()),
            *(_plant_checks(station) if config.plant else ()),
        ),
    )
    screen = Screen(tally, watch)
    pages = Pages(options.language)
    operator = OperatorPage(pages, screen.feed, station.submit, sound_volume=config.sound_volume)
    view = OperatorView(screen, station, board)
    # Separate processes, so that pages do not slow the station down.
    answering = QueryProcesses(
        partial(open_supervisor, *place_of(store), config.shifts, keeps_sums=True)
    )
    routes = [*operator.routes, *answer_routes(pages, answering.ask, PAGES, UPLOADS)]
    server = served(
        options,
        address,
        routes,
        pages=pages,
        key_locations=key_locations,
        people=people,
        is_supervised=lambda path: path != "/" and not path.startswith(LINE),
        clock=station.clock,
        note=station.note,
        checker=station.checker,
    )
    with closing(answering), server as url:
        try:
            yield view, url
        finally:
            screen.feed.close()


def _plant_checks(station: Station) -> Collection[HealthCheck]:
    """Check the sending of records to the plant's database, and the clock against it."""
    from flasher.plant.health import checks  # noqa: PLC0415  an extra

    store = station.store
    most_s = min(each.recipe.plant.clock_offset_max_s for each in station.recipes.values())
    return checks(store.files.folder, store.station, station.clock.utc(), most_s)


# -- supervisor pages only ------------------------------------------------------------------------


def serve(
    output: Output,
    web: Address,
    pages: PagesOptions,
    records: RecordsOptions,
    kind: type[Store] = Store,
    make: Callable[[Store, Sequence[dtime]], SupervisorPages] = SupervisorPages,
    paths: Sequence[str] = tuple(PAGES),
) -> int:
    """Serve the pages that `make` answers; the first of `paths` is the start page."""
    config = None if records.sockets is None else load_config(records.sockets)
    shifts = DEFAULT_SHIFTS if config is None else config.shifts
    badges = "" if config is None else config.badges
    people = BADGES.load(Path(badges)).person if badges else ()
    with closing(open_to_read(records, kind)) as store:  # fails before the pages are served
        place = place_of(store)
    shown = Pages(pages.language)
    answering = QueryProcesses(
        partial(open_supervisor, *place, shifts, kind, make, keeps_sums=True)
    )

    async def start(_request: Request) -> Response:
        return RedirectResponse(paths[0], 303)

    routes = [Route("/", start), *answer_routes(shown, answering.ask, paths, UPLOADS)]
    with (
        closing(answering),
        stop_on_signal() as stopped,
        served(
            pages,
            web,
            routes,
            pages=shown,
            key_locations=None,
            people=people,
            is_supervised=lambda _path: True,
            clock=SystemClock(),
            # Only a station writes the audit trail.
            note=lambda event, data: _LOG.info("%s: %s", event.value, printable(str(data))),
            checker=checker(),
        ) as url,
    ):
        answering.begin()
        output.progress(f"The supervisor pages: {url}; Ctrl-C ends them")
        report_certificate(pages, output)
        while not stopped():
            time.sleep(_TURN_S)
    return ExitCode.OK


# -- access ----------------------------------------------------------------------------------------


@contextmanager
def served(
    options: PagesOptions,
    address: Address,
    routes: Collection[BaseRoute],
    *,
    pages: Pages,
    key_locations: KeyLocations | None,
    people: Sequence[Person] = (),
    is_supervised: Callable[[str], bool],
    clock: StationClock,
    note: Note,
    checker: Executor,
) -> Iterator[str]:
    """Serve pages while the block runs; yields their URL. Raises UsageError.

    `key_locations`: folder of the secret that signs cookies, so that open pages survive restarts;
    None: the secret is not stored. `people`: the people with a badge; only their supervisors may
    open paths for which `is_supervised` is true. Without people everyone may. `note` records
    sign-ins and sign-outs; `checker` runs the check of PINs.
    """
    password, tls = _password(options), _tls(options)
    _check_open(options, address, has_password=bool(password or people), has_tls=tls is not None)
    is_far = address.host not in LOOPBACK
    badges = None
    if people:
        badges = Badges(
            people,
            # A badge can be copied: alone it does not replace a password.
            needs_pin=is_far or bool(password),
            is_supervised=is_supervised,
            are_for_all=is_far and not password,
        )
    login = None
    if people or password:
        login = Login(pages, clock, note, checker=checker, password=password, badges=badges)
    app = application(
        routes,
        hosts=_hosts(address),
        secret=secrets.token_urlsafe(32) if key_locations is None else kept_secret(key_locations),
        login=login,
        is_tls=tls is not None,
        uploads=UPLOADS,
    )
    with Server(app, address.host, address.port, tls) as server:
        yield server.url


def _hosts(address: Address) -> set[str]:
    """Host names of this server."""
    hosts = {address.host, *LOOPBACK, "[::1]"}
    if address.host not in LOOPBACK:
        hosts |= {socket.gethostname(), socket.getfqdn(), f"[{address.host}]"}
    if address.host in _ANY:
        hosts |= {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
    return hosts


def _check_open(
    options: PagesOptions, address: Address, *, has_password: bool, has_tls: bool
) -> None:
    """Raises UsageError for pages that other computers can reach without TLS or password."""
    if address.host in LOOPBACK:
        return
    if not (has_tls or options.web_insecure):
        raise UsageError(
            f"The pages on {address.host} would be served to other computers without TLS.",
            remedy="Give --web-certificate and --web-key, or allow it with --web-insecure.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    if not has_password:
        raise UsageError(
            f"The pages on {address.host} would be open to other computers without a password.",
            remedy="Give --web-password FILE, or a badge table (--badges).",
            code=ErrorCode.PAGES_NOT_SERVED,
        )


def _tls(options: PagesOptions) -> Tls | None:
    certificate, key = options.web_certificate, options.web_key
    if (certificate is None) != (key is None):
        raise UsageError(
            "--web-certificate and --web-key are needed together.",
            remedy="Give both.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    if certificate is None or key is None:
        return None
    check_secret(key, "the key of the pages")
    return Tls(certificate, key)


def report_certificate(options: PagesOptions, output: Output) -> None:
    """Report a certificate of the pages that has expired or soon does."""
    for check in certificate_checks(_certificate_end(options), datetime.now(UTC)):
        output.progress(f"The {check.name} of the pages {check.text}.")


def _certificate_end(options: PagesOptions) -> datetime | None:
    """Time at which the certificate of the pages expires; None without one. `Server` reports a file
    that is none.
    """
    if options.web_certificate is None:
        return None
    from cryptography import x509  # noqa: PLC0415  it takes a while

    data = read(options.web_certificate, _CERTIFICATE_MAX_SIZE, what="certificate")
    with suppress(ValueError):
        return x509.load_pem_x509_certificate(data).not_valid_after_utc
    return None


def _password(options: PagesOptions) -> str:
    path = options.web_password
    if path is None:
        return ""
    check_secret(path, "the password of the pages")
    data = read(path, _PASSWORD_FILE_MAX_SIZE, what="file of the password")
    text = data.decode("utf-8", "replace").partition("\n")[0].strip()
    if len(text) < PASSWORD_MIN:
        raise UsageError(
            f"The password of the pages has fewer than {PASSWORD_MIN} characters.",
            where="--web-password",
            remedy="Write a longer password into the first line of the file.",
            code=ErrorCode.PAGES_NOT_SERVED,
        )
    return text


def kept_secret(key_locations: KeyLocations) -> str:
    """Read the secret that signs cookies; create its file if missing. Raises UsageError."""
    path: Path = key_locations.keys_folder / "pages.secret"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            with os.fdopen(handle, "w", encoding="ascii") as file:
                file.write(secrets.token_urlsafe(32))
        except OSError:
            path.unlink()  # else every later start would find an empty file
            raise
    except FileExistsError:
        pass
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror or error}.",
            remedy="Name another folder with --keys.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        ) from error
    secret = read(path, _SECRET_MAX_SIZE, what="secret of the pages").decode("ascii", "replace")
    return secret or secrets.token_urlsafe(32)
