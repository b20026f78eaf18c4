"""The process of one socket: opens the adapter, detects units, and runs them.

A driver that crashes or hangs thus affects one socket only. `multiprocessing` starts the processes
with "spawn" on every system: a station can wait for all pipes together, on Windows too, and output
that a driver prints does no harm.

The process writes no records. It asks the station to save everything that must be on disk (`Ask`),
and waits for the reply. If the pipe breaks because the station died, the current message is
finished and no further one is sent.
"""

from __future__ import annotations

import gzip
import hashlib
import logging
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

from flasher.api import Connection, connect
from flasher.bus.link import suspended_s
from flasher.errors import BusError, FlasherError, TransmitBlockedError, UsageError
from flasher.files import make_private
from flasher.i18n import text
from flasher.log import log_event
from flasher.protocol.text import printable
from flasher.station.adapters import detect, resolve
from flasher.station.codes import Code
from flasher.station.events import StepEnded
from flasher.station.messages import (
    AdapterDown,
    AdapterReady,
    Ask,
    Beat,
    FromWorker,
    JournalError,
    JournalWrite,
    PresenceChanged,
    RunEvent,
    Stop,
    ToWorker,
    WorkerSetup,
    WriteReply,
    packed,
)
from flasher.station.power import PowerCommand, PowerControl
from flasher.station.presence import BLIND_S, PAUSE_S, Presence
from flasher.station.recipe_file import DAMAGED_COPY, LoadedRecipe, load_recipe
from flasher.station.records.model import Claim, Measurement, RunResult, RunState
from flasher.station.unit_run import UnitRun
from flasher.station.virtual_units import VirtualSocket
from flasher.trace.recorder import Recorder

REOPEN_S: Final = 1.0
"""Interval between attempts to reopen a failed adapter."""
RELOAD_S: Final = 5.0
"""Interval between attempts to load the plant's recipe again, which reads all of its files."""
BEAT_S: Final = 0.5
"""Interval between heartbeats."""
IDLE_S: Final = 0.05
REPLY_LIMIT_S: Final = 60.0
"""Time limit for the station to save something to disk."""
_LOOK_S: Final = 0.1
"""Interval between polls of the pipe during a run, so that they do not delay frames."""


class Channel(Protocol):
    """Pipe to the station, for example a `multiprocessing.connection.Connection`."""

    def send(self, obj: Any, /) -> None:
        """Send a message. Raises OSError if the station has ended."""

    def recv(self) -> Any:
        """Receive a message. Raises EOFError if the station has ended."""

    def poll(self, timeout: float = 0.0) -> bool:
        """True if a message waits or the station has ended."""


class StationGoneError(Exception):
    """The station has ended, so nothing can be recorded."""


class StationPipe:
    """The pipe to the station, with heartbeats and queued messages."""

    def __init__(self, channel: Channel, now: Callable[[], float]) -> None:
        self._channel = channel
        self._now = now
        self._asked = 0
        self._looked_at = float("-inf")
        self._beat_at = float("-inf")
        self._claim: Claim | None = None
        self._replies: dict[int, WriteReply] = {}
        self.meanwhile: Callable[[], None] = lambda: None
        """Called repeatedly while waiting for the station."""
        self.is_aborted = False
        self.is_over = False
        """True if the station has ended or has asked the process to end."""
        self.is_gone = False

    def send(self, message: FromWorker) -> None:
        """Send a message. Raises StationGoneError."""
        try:
            self._channel.send(message)
        except (OSError, ValueError) as error:
            self.is_gone = self.is_over = True
            raise StationGoneError from error

    def send_progress(self, event: RunEvent) -> None:
        """Send progress; `look` detects a dead station."""
        with suppress(StationGoneError):
            self.send(event)

    def look(self, wait_s: float = 0.0) -> None:
        """Receive waiting messages, and send a heartbeat if due."""
        now = self._now()
        self._looked_at = now
        if now - self._beat_at >= BEAT_S and not self.is_gone:
            self._beat_at = now
            with suppress(StationGoneError):
                self.send(Beat())
        try:
            while not self.is_gone and self._channel.poll(wait_s):
                wait_s = 0.0
                self._take(self._channel.recv())
        except (EOFError, OSError):
            self.is_gone = self.is_over = True

    def wait(self, limit_s: float) -> None:
        """Wait up to `limit_s`, or until the process has to end."""
        until = self._now() + limit_s
        while self._now() < until and not self.is_over:
            self.look(IDLE_S)

    def is_stopped(self) -> bool:
        """True if a person aborted the run or the station has ended; called between frames."""
        if self._now() - self._looked_at >= _LOOK_S:
            self.look()
        return self.is_aborted or self.is_over

    def take_claim(self) -> Claim | None:
        """The claimed run, returned once; None without one."""
        claim, self._claim = self._claim, None
        if claim is not None:
            self.is_aborted = False
        return claim

    # -- `Journal` of a run ------------------------------------------------------------------------

    def intent(self, target: str, what: str, value: str) -> JournalWrite:
        write = JournalWrite(target, what, value)
        write_id = self._ask(write).write_id
        if write_id is None:
            raise JournalError("The station did not confirm the saved record.")
        return replace(write, write_id=write_id)

    def verified(self, write: JournalWrite, read_back: str | None) -> None:
        self._ask(replace(write, read_back=read_back))

    def step(self, ended: StepEnded, measurements: Sequence[Measurement] = ()) -> None:
        self._ask(ended, measurements)

    def _ask(
        self, what: JournalWrite | StepEnded, measurements: Sequence[Measurement] = ()
    ) -> WriteReply:
        """Wait until the station has saved it. Raises StationGoneError, JournalError."""
        self._asked += 1
        self.send(Ask(self._asked, what, tuple(measurements)))
        give_up_at = self._now() + REPLY_LIMIT_S
        while self._asked not in self._replies:
            if self.is_gone:
                raise StationGoneError
            if self._now() >= give_up_at:
                raise JournalError(f"The station did not save within {REPLY_LIMIT_S:g} s.")
            self.look(IDLE_S)
            self.meanwhile()
        reply = self._replies.pop(self._asked)
        if reply.error:
            raise JournalError(reply.error)
        return reply

    def _take(self, message: ToWorker) -> None:
        match message:
            case Claim():
                self._claim = message
            case WriteReply():
                self._replies[message.number] = message
            case Stop(ends_process):
                self.is_aborted = True
                self.is_over = self.is_over or ends_process


class Worker:
    """Main loop of a socket's process, on an open connection."""

    def __init__(
        self,
        setup: WorkerSetup,
        recipe: LoadedRecipe,
        pipe: StationPipe,
        connection: Connection,
        virtual: VirtualSocket | None = None,
    ) -> None:
        self._recipe = recipe
        self._pipe = pipe
        self._connection = connection
        self._virtual = virtual
        self._power: PowerControl | None = PowerCommand(setup.power) if setup.power else virtual
        self._presence = Presence([each.profile for each in recipe.targets])
        self._listened_at = connection.clock.now()
        self._suspended_s = suspended_s()
        self._down = ""
        """Reported reason while the adapter has failed; "" while it works."""
        self._is_blocked = False
        """True while the adapter's transmit queue is full."""
        self._reopen_at = 0.0

    def work(self) -> None:
        """Work until the station ends the process or has ended itself."""
        sees = self._virtual is not None or self._presence.sees_units
        self._pipe.send(AdapterReady(sees))
        if self._virtual is not None:
            self._pipe.send(PresenceChanged(is_there=False, is_certain=True))
        while not self._pipe.is_over:
            self._pipe.look()
            claim = self._pipe.take_claim()
            if claim is not None:
                self._run(claim)
            else:
                self._watch()

    # -- idle -------------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Watch the bus for units for a moment."""
        if self._down or self._is_blocked:
            self._reopen()
            return
        link, clock = self._connection.link, self._connection.clock
        try:
            if self._virtual is None:
                for request in self._presence.probe(clock.now()):
                    link.send(request)
            until = clock.now() + IDLE_S
            frame = link.receive(until)
            while frame is not None:
                self._listened()
                self._presence(frame, sent=False, now=clock.now())
                frame = link.receive(until) if clock.now() < until else None
        except TransmitBlockedError:
            # No unit acknowledges: queued frames must not reach the next one.
            self._is_blocked = True
            self._reopen()
        except BusError as error:
            self._fail(error.what)
        self._listened()
        virtual = self._virtual
        if virtual is None and not self._down and self._was_suspended():
            # No frame was received meanwhile: the unit may be another one.
            self._fail(text("This computer was suspended."))
            return
        change = self._presence.change(clock.now()) if virtual is None else virtual.step()
        if change is not None:
            self._pipe.send(change)

    def _restart_watching(self) -> None:
        self._presence.begin()
        self._listened_at = self._connection.clock.now()

    def _listened(self) -> None:
        """Note that the bus was observed up to now, unless this computer stalled."""
        now, blind_s = self._connection.clock.now(), BLIND_S * self._connection.clock.speed
        if now - self._listened_at > blind_s:
            self._presence.miss(now - self._listened_at, now)
        self._listened_at = now

    def _was_suspended(self) -> bool:
        """True if this computer was suspended since the last call."""
        before, self._suspended_s = self._suspended_s, suspended_s()
        return self._suspended_s - before > PAUSE_S

    def _reopen(self) -> None:
        clock = self._connection.clock
        if clock.now() < self._reopen_at:
            self._pipe.look(IDLE_S)
            return
        self._reopen_at = clock.now() + REOPEN_S * clock.speed
        try:
            self._connection.link.reopen()
        except BusError as error:
            self._fail(_why_closed(error))
            return
        self._is_blocked = False
        if self._down:
            self._down = ""
            self._restart_watching()
            self._pipe.send(AdapterReady(self._presence.sees_units))

    def _fail(self, reason: str) -> None:
        """Report a failure of the adapter, and then why it cannot be opened."""
        if reason != self._down:
            self._down = reason
            self._pipe.send(AdapterDown(reason))

    # -- a run ------------------------------------------------------------------------------------

    def _run(self, claim: Claim) -> None:
        recorder: Recorder | None = None
        self._connection = self._connection.renamed()
        try:
            with Recorder(claim.trace) as recorder:
                recorder.channel = self._connection.channel
                watchers, was_exchanged, was_missed, was_silent = None, False, False, False
                if self._virtual is None:
                    self._listened()
                    presence = self._presence
                    if (change := presence.change(self._connection.clock.now())) is not None:
                        self._pipe.send(change)
                    watchers = presence.watchers
                    was_exchanged = presence.exchanged_number > claim.presence
                    was_missed = presence.missed_number > claim.presence or self._was_suspended()
                    was_silent = presence.is_there is False
                run = UnitRun(
                    claim,
                    self._recipe,
                    self._connection,
                    self._pipe,
                    taps=(recorder,),
                    send_progress=self._pipe.send_progress,
                    cancelled=self._pipe.is_stopped,
                    power=self._power,
                    watchers=watchers,
                    was_exchanged=was_exchanged,
                    was_missed=was_missed,
                    was_silent=was_silent,
                )
                self._pipe.meanwhile = run.listen_meanwhile
                result = run.run()
        except StationGoneError:
            return
        except FlasherError as error:
            result = _error_result(Code.TRACE_NOT_SAVED, error.what)
        except Exception as error:  # noqa: BLE001  a bug must not end the socket's process
            log_event(error)
            result = _error_result(Code.INTERNAL, f"{type(error).__name__}: {error}")
        if recorder is not None and recorder.failure is None:
            with suppress(OSError):
                result = replace(result, trace_sha256=pack(claim.trace))
        if result.trace_sha256 is None and result.outcome is RunState.PASS:
            why = "" if recorder is None or recorder.failure is None else f": {recorder.failure}"
            words = f"The trace of the bus is not complete{why}."
            result = _error_result(Code.TRACE_NOT_SAVED, words)
        self._pipe.send(result)
        if self._virtual is not None:
            self._virtual.run_ended()
        # Queued frames date from the run and do not show which unit is there now.
        with suppress(BusError):
            self._connection.link.drain()
        self._restart_watching()


def pack(path: Path) -> str:
    """Compress a trace file, delete the plain one, and return its SHA-256. Raises OSError."""
    made = packed(path)
    make_private(made)
    with path.open("rb") as plain, made.open("wb") as raw:
        # No name and time in the header, so that equal traces are equal files.
        with gzip.GzipFile(filename="", mode="wb", compresslevel=6, fileobj=raw, mtime=0) as out:
            shutil.copyfileobj(plain, out)
        raw.flush()
    path.unlink()
    return hashlib.sha256(made.read_bytes()).hexdigest()


def _error_result(code: Code, what: str) -> RunResult:
    return RunResult(code.outcome, code.name, printable(what), 0.0)


Opened = AbstractContextManager[tuple[Connection, VirtualSocket | None]]
"""Connection of a socket, and its virtual units if any."""


@contextmanager
def open_socket(
    setup: WorkerSetup, recipe: LoadedRecipe
) -> Iterator[tuple[Connection, VirtualSocket | None]]:
    """Open the connection of a socket. Raises UsageError, BusError."""
    if setup.adapter is None:
        if setup.virtual is None:
            raise UsageError(f"Socket {setup.socket} has neither an adapter nor virtual units.")
        virtual = VirtualSocket(recipe, setup.virtual)
        yield virtual.connection, virtual
        return
    holder = f"flasher station, socket {setup.socket}"
    dialect = recipe.targets[0].profile.dialect
    (socket,) = resolve([setup.adapter], detect([setup.adapter]))
    by_place = bool(setup.adapter.usb_path)
    with connect(dialect, holder=holder, by_place=by_place, **(socket.bus or {})) as connection:
        yield connection, None


def load_same(setup: WorkerSetup) -> LoadedRecipe:
    """Load the recipe. Raises UsageError if it differs from the station's."""
    recipe = load_recipe(setup.recipe, may_waive=not setup.is_from_plant)
    if {str(path): sha256 for path, sha256 in recipe.files.items()} != dict(setup.files):
        changed = "The recipe, or a file that it names, was changed."
        raise UsageError(DAMAGED_COPY if setup.is_from_plant else changed)
    return recipe


def load_when_whole(pipe: StationPipe, setup: WorkerSetup) -> LoadedRecipe | None:
    """Load the recipe; None if the socket cannot work, or the process has to end. The plant's is
    tried again: its copy is fetched again.

    Raises StationGoneError.
    """
    is_down = False
    while not pipe.is_over:
        try:
            return load_same(setup)
        except FlasherError as error:
            if not setup.is_from_plant:
                pipe.send(AdapterDown(error.what, is_final=True))
                return None
            if not is_down:
                pipe.send(AdapterDown(error.what))
            is_down = True
            with suppress(OSError):  # so that the process that fetches reads its files again
                os.utime(setup.recipe)
            pipe.wait(RELOAD_S)
    return None


def _why_closed(error: BusError) -> str:
    """Why an adapter cannot be opened, and what helps."""
    return f"{error.what} {error.remedy}".rstrip()


def work_on(
    pipe: StationPipe, setup: WorkerSetup, recipe: LoadedRecipe, opened: Callable[[], Opened]
) -> None:
    """Work in a socket until the station ends the process; an adapter that cannot be opened is
    tried again.

    Raises StationGoneError.
    """
    reported = ""
    while not pipe.is_over:
        try:
            with opened() as (connection, virtual):
                Worker(setup, recipe, pipe, connection, virtual).work()
        except UsageError as error:
            pipe.send(AdapterDown(error.what, is_final=True))
            return
        except BusError as error:
            if (reason := _why_closed(error)) != reported:
                pipe.send(AdapterDown(reason))
            reported = reason
            pipe.wait(REOPEN_S)


def worker_main(channel: Channel, setup: WorkerSetup) -> None:
    # The station handles Ctrl-C, a closed terminal and SIGTERM, which service managers send to all
    # processes of a service at once, and ends its processes itself.
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):  # some lack one of the last two
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    # Else python-can prints each failed opening into the station's table; `AdapterDown` reports it.
    logging.getLogger("can").addHandler(logging.NullHandler())
    pipe = StationPipe(channel, time.perf_counter)
    with suppress(StationGoneError):
        recipe = load_when_whole(pipe, setup)
        if recipe is not None:
            work_on(pipe, setup, recipe, partial(open_socket, setup, recipe))
