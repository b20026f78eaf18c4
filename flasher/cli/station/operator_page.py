"""The operator page of `flasher station run --web`: what the options say, made into a server."""

from __future__ import annotations

import os
import secrets
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Final

from flasher.cli.station.commands import Address, RunOptions
from flasher.errors import UsageError
from flasher.files import read
from flasher.said import say
from flasher.station.board import Board
from flasher.station.config import StationConfig
from flasher.station.events import RunEnded, StationEvent
from flasher.station.health import Watch
from flasher.station.records.keys import Keeping
from flasher.station.records.model import RunFilter, RunState, utc_moment
from flasher.station.station import Station
from flasher.station.tally import EndedRun, Tally
from flasher.web.guard import application
from flasher.web.operator import Lot, OperatorPage, Screen
from flasher.web.pages import Pages
from flasher.web.server import LOOPBACK, Server, Tls

PASSWORD_MIN: Final = 8
_PASSWORD_FILE_MAX_SIZE: Final = 4096
"""In bytes."""
_ANY: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104  compared, not bound
_SECRET_MAX_SIZE: Final = 200


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
    options: RunOptions,
    address: Address,
    station: Station,
    board: Board,
    config: StationConfig,
    *,
    keeping: Keeping | None,
) -> Iterator[tuple[OperatorView, str]]:
    """Serve the page while the block runs; gives its view and its address. `keeping`: where the
    secret of the sessions is kept, so that pages go on after a restart; None for no place.

    Raises UsageError.
    """
    password, tls = _password(options), _tls(options)
    _check_open(options, address, has_password=bool(password), has_tls=tls is not None)
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
    app = application(
        OperatorPage(pages, screen.feed, station.submit, sound_volume=config.sound_volume).routes,
        pages=pages,
        hosts=_hosts(address),
        secret=secrets.token_urlsafe(32) if keeping is None else kept_secret(keeping),
        now=time.monotonic,
        password=password,
        is_tls=tls is not None,
    )
    view = OperatorView(screen, station, board)
    with Server(app, address.host, address.port, tls) as server:
        try:
            yield view, server.url
        finally:
            screen.feed.close()


def _hosts(address: Address) -> set[str]:
    """Names by which a browser may call this server."""
    hosts = {address.host, *LOOPBACK, "[::1]"}
    if address.host not in LOOPBACK:
        hosts |= {socket.gethostname(), socket.getfqdn(), f"[{address.host}]"}
    if address.host in _ANY:
        hosts |= {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None)}
    return hosts


def _check_open(
    options: RunOptions, address: Address, *, has_password: bool, has_tls: bool
) -> None:
    """Raises UsageError for pages that other computers could reach without TLS or password."""
    if address.host in LOOPBACK:
        return
    if not (has_tls or options.web_insecure):
        raise UsageError(
            f"Other computers could reach the pages on {address.host}, and read along.",
            remedy="Give --web-certificate and --web-key; --web-insecure does without.",
        )
    if not has_password:
        raise UsageError(
            f"Other computers could reach the pages on {address.host}, without a password.",
            remedy="Give --web-password FILE.",
        )


def _tls(options: RunOptions) -> Tls | None:
    certificate, key = options.web_certificate, options.web_key
    if (certificate is None) != (key is None):
        raise UsageError("--web-certificate and --web-key belong together.", remedy="Give both.")
    return None if certificate is None or key is None else Tls(certificate, key)


def _password(options: RunOptions) -> str:
    path = options.web_password
    if path is None:
        return ""
    data = read(path, _PASSWORD_FILE_MAX_SIZE, what="file of the password")
    text = data.decode("utf-8", "replace").partition("\n")[0].strip()
    if len(text) < PASSWORD_MIN:
        raise UsageError(
            f"The password of the pages has less than {PASSWORD_MIN} characters.",
            where="--web-password",
            remedy="Write a longer one into the first line of the file.",
        )
    return text


def kept_secret(keeping: Keeping) -> str:
    """What signs the sessions of the pages, for this user alone; made where there is none."""
    path: Path = keeping.keys_folder / "pages.secret"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        pass
    except OSError as error:
        raise UsageError(
            f"{path} cannot be written: {error.strerror or error}.",
            remedy="Give another place with --keys.",
        ) from error
    else:
        with os.fdopen(handle, "w", encoding="ascii") as file:
            file.write(secrets.token_urlsafe(32))
    found = read(path, _SECRET_MAX_SIZE, what="secret of the pages").decode("ascii", "replace")
    return found or secrets.token_urlsafe(32)
