"""A running station: sockets, scans and records brought together. A library with events.

    with Store.open(...) as store:
        station = Station(store, recipe, setups, operator="jo", on_event=print)
        station.run(until=lambda: False)      # station.submit("W2605002") from any thread

One thread does everything: it is the only one that writes records. A run is begun when its claim is
on disk; a socket's process does nothing that cannot be taken back before the intent is on disk; and
`RunEnded`, the one event that says PASS, leaves after the outcome is on disk.

Which socket a label is for: the one that was chosen by SOCKET; else the one socket in which a unit
waits for its label; else the socket into which the next unit comes. Where two units wait, the
station asks for the socket. One label waits at a time.
"""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final

from flasher.log import log_event
from flasher.station.commit import Committing
from flasher.station.desk import Desk
from flasher.station.events import (
    FiguresChanged,
    SocketChanged,
    SocketState,
    StationEvent,
    StationStarted,
    StationStopped,
    UnitArrived,
    UnitRemoved,
    WorkerFailed,
)
from flasher.station.messages import (
    Abort,
    AdapterDown,
    Ask,
    Begin,
    Finished,
    FromWorker,
    Note,
    PresenceChanged,
    Ready,
    WorkerSetup,
)
from flasher.station.options import StationOptions, check_natures
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.errors import RecordError
from flasher.station.records.model import Clock, Figures, RunFilter
from flasher.station.records.store import Store, SystemClock
from flasher.station.socket_line import SocketLine, SocketView
from flasher.station.supervisor import Launch, ProcessPort, Supervisor, WorkerLost

TURN_S: Final = 0.1
"""How long a turn of the loop waits at the most."""
EventHandler = Callable[[StationEvent], None]


class Station:
    """A station with one recipe. Methods raise nothing for what happens on the line: events tell.

    `submit`, `stop` and `abort_all` may be called from any thread, the others from one.
    """

    def __init__(  # noqa: PLR0913  what a station is made of
        self,
        store: Store,
        recipe: LoadedRecipe,
        setups: Iterable[WorkerSetup],
        *,
        operator: str,
        lot: str = "",
        on_event: EventHandler = lambda _event: None,
        options: StationOptions | None = None,
        clock: Clock | None = None,
        launch: Launch = ProcessPort,
    ) -> None:
        self.store = store
        self.recipe = recipe
        self.options = options or StationOptions()
        self.clock: Clock = clock or SystemClock()
        self._on_event = on_event
        setups = tuple(setups)
        self.lines = {
            setup.socket: SocketLine(setup.socket, is_virtual=setup.virtual is not None)
            for setup in setups
        }
        self.supervisor = Supervisor(
            setups, self.clock.monotonic_s, launch=launch, hang_s=self.options.hang_s
        )
        self.committing = Committing(self)
        self._desk = Desk(self, operator=operator, lot=lot)
        self._scans: deque[str] = deque()
        self._wake_receiver, self._wake_sender = multiprocessing.Pipe(duplex=False)
        self._started_at = self.clock.utc()
        self._is_stopping = False
        self._is_aborting = False
        self._is_open = False

    # -- what a program calls ---------------------------------------------------------------------

    def start(self) -> None:
        """Look for runs that a dead station left, then begin.

        Raises RecordError; UsageError for records of the other kind of units.
        """
        check_natures(self.store.read.natures(), self.lines.values(), self.options)
        recovered = self.store.recover()
        self.committing.spool.mkdir(parents=True, exist_ok=True)
        self._is_open = True
        rule = self.recipe.recipe
        self.tell(
            StationStarted(
                self.store.station,
                rule.name,
                rule.revision,
                rule.part,
                tuple(self.lines),
                recovered,
                tuple(line.name for line in self.lines.values() if line.is_virtual),
            )
        )
        for line in self.lines.values():
            self.tell(SocketChanged(line.name, line.state))
        self.turn(0.0)

    def submit(self, text: str) -> None:
        """Something was scanned."""
        self._scans.append(text)
        self._wake()

    def stop(self) -> None:
        """Begin no further unit; `run` returns when the runs that go on have ended."""
        self._is_stopping = True
        self._wake()

    def abort_all(self) -> None:
        """Stop, and stop the runs that go on at their next safe place."""
        self._is_aborting = True
        self.stop()

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Start, and work until `stop` was called or `until` says so; then close.

        Raises RecordError, UsageError when the station cannot begin.
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
        """One turn of the loop: wait up to `limit_s`, then do everything that can be done."""
        if limit_s > 0:
            self.supervisor.wait([self._wake_receiver], limit_s)
        while self._wake_receiver.poll():
            self._wake_receiver.recv_bytes()
        for socket, message in self.supervisor.poll():
            self._hear(self.lines[socket], message)
        while self._scans:
            self._desk.scan(self._scans.popleft())
        if self._is_aborting:
            self._abort_running()
        self._begin_due()

    def close(self) -> None:
        """End all processes. Runs that go on are stopped, and saved if they say their end in time;
        the others are found at the next start.
        """
        if not self._is_open:
            return
        self._is_open = False
        self._is_stopping = True
        self._abort_running()
        give_up_at = self.clock.monotonic_s() + self.options.end_limit_s
        while self.is_running and self.clock.monotonic_s() < give_up_at:
            self.turn(TURN_S)
        self.supervisor.close()
        self.tell(StationStopped(self.store.station))

    @property
    def is_running(self) -> bool:
        """True while a run goes on that has not said its end."""
        return any(
            line.run is not None and line.run.finished is None for line in self.lines.values()
        )

    @property
    def is_line_stopped(self) -> bool:
        """True from `LineStopped` to `LineResumed`."""
        return self.committing.stopped is not None

    @property
    def sockets(self) -> tuple[SocketView, ...]:
        """All sockets as they are now."""
        return tuple(
            SocketView(line.name, line.state, line.text, line.label or line.serial, line.is_there)
            for line in self.lines.values()
        )

    @property
    def figures(self) -> Figures:
        """Totals of this recipe since the station started. Raises RecordError."""
        chosen = RunFilter(
            since=self._started_at, recipe=self.recipe.recipe.name, part=self.recipe.recipe.part
        )
        return self.store.read.figures(chosen)

    # -- for the parts of the station -------------------------------------------------------------

    def tell(self, event: StationEvent) -> None:
        """An event leaves."""
        try:
            self._on_event(event)
        except Exception as error:  # noqa: BLE001  who looks on must not stop the line
            log_event(error)

    def show(self, line: SocketLine, state: SocketState, text: str = "") -> None:
        """A socket shows something else."""
        if (line.state, line.text) != (state, text):
            line.state, line.text = state, text
            self.tell(SocketChanged(line.name, state, line.label or line.serial, text))

    def show_rest(self, line: SocketLine) -> None:
        """Show what a socket without a run waits for."""
        if not line.can_work:
            return
        if self.committing.stopped is not None:
            self.show(line, SocketState.STOPPED, self.committing.stopped.reason)
        elif line.label:
            self.show(line, SocketState.SCAN, f"Connect {line.label}.")
        elif line.is_there:
            self.show(line, SocketState.SCAN, "Scan the label of the unit.")
        else:
            line.serial = ""
            self.show(line, SocketState.EMPTY)

    def tell_figures(self) -> None:
        """The totals may have changed."""
        try:
            self.tell(FiguresChanged(self.figures))
        except RecordError as error:
            log_event(error)

    # -- what the processes say -------------------------------------------------------------------

    def _hear(self, line: SocketLine, message: FromWorker | WorkerLost) -> None:
        match message:
            case Ready(_, sees_units):
                line.can_work, line.sees_units = True, sees_units
                if line.run is None and not line.state.is_verdict:
                    self.show_rest(line)
            case AdapterDown(reason):
                self._lose(line, reason)
            case PresenceChanged():
                self._presence(line, message)
            case Ask(number, what):
                self.committing.answer(line, number, what)
            case Note(note):
                self.committing.pass_on(line, note)
            case Finished():
                self.supervisor.worked(line.name)
                self.committing.end(line, message)
            case WorkerLost(reason, hung, restart_in_s):
                self.committing.end_lost(line, reason, hung=hung)
                self._lose(line, reason)
                self.tell(WorkerFailed(line.name, reason, restart_in_s))
            case _:
                pass  # beats and last words: the supervisor has taken note

    def _lose(self, line: SocketLine, reason: str) -> None:
        """The socket cannot work for now. A verdict stays; a label has to be scanned again."""
        line.can_work = False
        line.label, line.begin_at_s = "", None
        if line.run is None and not line.state.is_verdict:
            self.show(line, SocketState.ERROR, reason)

    def _presence(self, line: SocketLine, change: PresenceChanged) -> None:
        was_there, line.is_there = line.is_there, change.is_there
        if not change.is_there:
            if was_there:
                self.tell(UnitRemoved(line.name))
            if line.run is None and (was_there or not line.state.is_verdict):
                self._desk.forget_unit(line)
                self.show_rest(line)
            return
        if was_there:
            return  # its process is new, the unit is not
        self.tell(UnitArrived(line.name, change.how, change.label))
        if line.run is None:
            # A new unit: the verdict on the one before is read.
            self._desk.arrived(line, change.label if self.options.scans_labels else "")

    # -- beginning and ending ---------------------------------------------------------------------

    def _begin_due(self) -> None:
        if self._is_stopping or self.is_line_stopped:
            return
        now_s = self.clock.monotonic_s()
        for line in self.lines.values():
            is_due = line.begin_at_s is not None and now_s >= line.begin_at_s
            if line.label and line.can_work and line.run is None and (line.is_there or is_due):
                self._desk.claiming.begin(line)

    def send_begin(self, line: SocketLine, begin: Begin) -> bool:
        """Give a process its order; False when it is gone."""
        return self.supervisor.send(line.name, begin)

    def abort(self, line: SocketLine) -> None:
        """Stop the run of a socket at its next safe place."""
        self.supervisor.send(line.name, Abort())

    def _abort_running(self) -> None:
        for line in self.lines.values():
            if line.run is not None and line.run.finished is None:
                self.abort(line)

    def _wake(self) -> None:
        self._wake_sender.send_bytes(b"x")
