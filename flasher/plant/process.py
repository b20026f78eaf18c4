"""The process of a station that sends its records to the plant's database."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Final, NoReturn

from flasher.errors import FlasherError
from flasher.plant.central import Central
from flasher.plant.fetcher import FETCH_S, Fetcher
from flasher.plant.forwarder import Forwarder
from flasher.processes import signals_blocked
from flasher.station.given_recipes import RecipeFolder
from flasher.station.records.database import locate_records, open_read_only
from flasher.station.records.files import FileStore
from flasher.station.records.store import SystemClock

LOOK_S: Final = 1.0
"""Interval at which the station's records are looked at."""
REPORT_S: Final = 10.0
"""Interval at which the state is reported if nothing has to be sent."""
RETRY_MAX_S: Final = 30.0
_END_S: Final = 10.0
"""Time limit for the last batch when the station ends; what is left is sent at the next start."""
_LOOK_AFTER_S: Final = 0.5
_RESTART_S: Final = 2.0
_LOG: Final = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sending:
    """What to send, and where to."""

    url: str
    """The plant's database."""
    station: str
    records: str
    files: Path | None
    recipes_for: tuple[str, ...] = ()
    """Sockets whose recipes come from the plant."""

    def open_fetcher(self) -> Fetcher:
        """Open the folder of the plant's recipes. Raises UsageError, RecordError."""
        location = locate_records(self.records, self.files)
        folder = RecipeFolder.of(location.folder, self.station)
        records = open_read_only(location, SystemClock().utc())
        return Fetcher(Central(self.url), records, folder, self.station, self.recipes_for)

    def open(self) -> Forwarder:
        """Open the station's records for reading. Raises UsageError, RecordError."""
        location = locate_records(self.records, self.files)
        central, files = Central(self.url), FileStore(location.folder)
        clock = SystemClock()
        records = open_read_only(location, clock.utc())
        return Forwarder(records, files, central, self.station, clock)


def keep_sending(forwarder: Forwarder, wait: Callable[[float], bool]) -> None:
    """Send what the station records, until `wait` (seconds) returns True; then what is left."""
    pause_s = LOOK_S
    is_over = False
    while not is_over:
        more = forwarder.forward()
        state = forwarder.state
        if more:
            is_over = wait(0.0)
            continue
        if state.fault or state.refusal:
            pause_s = min(pause_s * 2, RETRY_MAX_S)
            is_over = wait(pause_s)
            continue
        pause_s = waited_s = LOOK_S
        while not (is_over := wait(LOOK_S)) and waited_s < REPORT_S:
            if forwarder.has_new():
                break
            waited_s += LOOK_S
    if not (forwarder.state.fault or forwarder.state.refusal) and forwarder.has_new():
        forwarder.forward()


@contextmanager
def sending(what: Sending) -> Iterator[None]:
    """Send records in a process of its own while the block runs; one that dies is replaced."""
    over = threading.Event()
    watch = threading.Thread(target=_watch, args=(what, over), name="plant", daemon=True)
    watch.start()
    try:
        yield
    finally:
        over.set()
        watch.join()


def _watch(what: Sending, over: threading.Event) -> None:
    context = multiprocessing.get_context("spawn")
    while not over.is_set():
        try:
            _send_in_process(context, what, over)
        except OSError as error:  # no process, memory or file descriptor is free
            _LOG.warning("nothing is sent to the plant: %s", error)
        over.wait(_RESTART_S)


def _send_in_process(context: SpawnContext, what: Sending, over: threading.Event) -> None:
    """Start a process, and return after it died or `over`. Raises OSError."""
    ours, theirs = context.Pipe()
    with ours, theirs:
        process = context.Process(target=_work, args=(theirs, what), name="plant", daemon=True)
        with signals_blocked():
            process.start()
        theirs.close()
        while not over.wait(_LOOK_AFTER_S) and process.exitcode is None:
            pass
    # The closed channel tells it to send what is left.
    process.join(_END_S)
    if process.exitcode is None:
        process.kill()
        process.join()


def _work(channel: Connection, what: Sending) -> NoReturn:
    with suppress(OSError, AttributeError):
        os.nice(10)  # units come first

    def wait(limit_s: float) -> bool:
        """True as soon as the station has ended; a killed one closes the channel too."""
        return channel.poll(limit_s)

    if what.recipes_for:
        threading.Thread(target=_fetch, args=(what,), daemon=True).start()
    is_over = False
    while not is_over:
        try:
            with closing(what.open()) as forwarder:
                keep_sending(forwarder, wait)
            is_over = True
        except FlasherError as error:
            _LOG.warning("nothing is sent to the plant: %s", error)
            is_over = wait(RETRY_MAX_S)
    # Everything is saved and closed. The interpreter's clean-up takes seconds on a busy computer,
    # and the station waits for the end of this process.
    os._exit(0)


def _fetch(what: Sending) -> None:
    """Fetch recipes. The end of the process may cut it off: a recipe is added as a whole."""
    while True:
        try:
            with closing(what.open_fetcher()) as fetcher:
                while True:
                    fetcher.fetch()
                    time.sleep(FETCH_S)
        except FlasherError as error:
            _LOG.warning("no recipe is fetched from the plant: %s", error)
            time.sleep(FETCH_S)
