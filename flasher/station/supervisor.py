"""Starts, watches and restarts the processes of the sockets, each on its own."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Final, Protocol

from flasher.processes import signals_blocked
from flasher.station.messages import AdapterDown, FromWorker, Stop, ToWorker, WorkerSetup
from flasher.station.worker import worker_main

HANG_S: Final = 10.0
"""Silence after which a process counts as hung: it sends a heartbeat every half second, and a call
of an adapter takes at most some seconds."""
START_S: Final = 60.0
"""Silence after which a starting process counts as hung; it loads the driver of its adapter."""
RESTART_MIN_S: Final = 1.0
RESTART_MAX_S: Final = 30.0
_QUIT_S: Final = 5.0
_MESSAGES_AT_ONCE: Final = 1000
"""Maximum number of messages read from one process before the next one."""


class WorkerPort(Protocol):
    """The station's side of one process."""

    @property
    def waitable(self) -> Any:
        """Argument for `multiprocessing.connection.wait`; None if it cannot be waited for."""

    def send(self, message: ToWorker) -> bool:
        """Send a message. False if the process has ended."""

    def receive(self) -> FromWorker | None:
        """The next message, or None. Raises EOFError or OSError if the process has ended."""

    def kill(self) -> None:
        """Kill the process, and wait for its end."""

    def join(self, limit_s: float) -> bool:
        """Wait until the process ends. False after the time limit."""


class ProcessPort:
    """A process started with "spawn", so that it shares no state with the station."""

    def __init__(self, setup: WorkerSetup) -> None:
        context = multiprocessing.get_context("spawn")
        self._channel, theirs = context.Pipe()
        self._process = context.Process(
            target=worker_main, args=(theirs, setup), name=f"socket {setup.socket}", daemon=True
        )
        with signals_blocked():
            self._process.start()
        # The end of the process is only detected after this side has closed the other end.
        theirs.close()

    @property
    def waitable(self) -> Connection[Any, Any]:
        return self._channel

    def send(self, message: ToWorker) -> bool:
        try:
            self._channel.send(message)
        except (OSError, ValueError):
            return False
        return True

    def receive(self) -> FromWorker | None:
        if not self._channel.poll():
            return None
        message: FromWorker = self._channel.recv()
        return message

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        self._channel.close()

    def join(self, limit_s: float) -> bool:
        self._process.join(limit_s)
        return self._process.exitcode is not None


@dataclass(frozen=True)
class WorkerLost:
    """A process ended or hung. It is restarted after `restart_in_s`; None: never."""

    reason: str
    hung: bool
    restart_in_s: float | None


Launch = Callable[[WorkerSetup], WorkerPort]


class _Slot:
    """State of one socket's process."""

    def __init__(self, setup: WorkerSetup) -> None:
        self.setup = setup
        self.port: WorkerPort | None = None
        self.received_at = 0.0
        self.is_new = True
        self.start_at: float | None = 0.0
        """Time of its next start; None if it is not due to start."""
        self.pause_s = RESTART_MIN_S
        self.reason = ""
        """Reason that it reported for not working."""
        self.replace_by: float | None = None
        """Time at which a process that `replace` ended is killed; None without one."""


class WorkerSupervisor:
    """The processes of all sockets. `now` is a monotonic clock in seconds."""

    def __init__(
        self,
        setups: Iterable[WorkerSetup],
        now: Callable[[], float],
        launch: Launch = ProcessPort,
    ) -> None:
        self._slots = {setup.socket: _Slot(setup) for setup in setups}
        self._now = now
        self._launch = launch

    @property
    def ports(self) -> Mapping[str, WorkerPort]:
        return {name: slot.port for name, slot in self._slots.items() if slot.port is not None}

    def send(self, socket: str, message: ToWorker) -> bool:
        """Send a message to a socket's process. False if none is running."""
        port = self._slots[socket].port
        return port is not None and port.send(message)

    def wait(self, extra: Sequence[Any], limit_s: float) -> None:
        """Wait for a message, up to `limit_s`."""
        ports = [port.waitable for port in self.ports.values()]
        waitables = [*filter(None, ports), *extra]
        if waitables:
            with suppress(OSError):
                wait(waitables, timeout=limit_s)

    def poll(self) -> list[tuple[str, FromWorker | WorkerLost]]:
        """Read the messages of all processes, and start due ones. Returns messages, or
        `WorkerLost`, with their sockets.
        """
        news: list[tuple[str, FromWorker | WorkerLost]] = []
        for name, slot in self._slots.items():
            if slot.replace_by is not None and not self._has_ended(slot, slot.replace_by):
                continue
            if slot.port is None:
                if slot.start_at is not None and self._now() >= slot.start_at:
                    slot.port = self._launch(slot.setup)
                    slot.received_at = self._now()
                    slot.is_new, slot.start_at, slot.reason = True, None, ""
                continue
            messages, is_gone = self._receive(slot)
            news += [(name, message) for message in messages]
            # Checked after all waiting messages were read: a busy station must not look like a hung
            # process.
            limit_s = START_S if slot.is_new else HANG_S
            if is_gone:
                news.append((name, self._lose(slot, "its process ended", hung=False)))
            elif self._now() - slot.received_at > limit_s:
                slot.port.kill()
                reason = f"its process sent nothing for {limit_s:g} s, and was killed"
                news.append((name, self._lose(slot, reason, hung=True)))
        return news

    def replace(self, setup: WorkerSetup) -> None:
        """End the process of a socket, and start it with other settings. It must have no run."""
        slot = self._slots[setup.socket]
        slot.setup = setup
        if slot.port is None:
            slot.start_at = self._now()  # it waited before a restart, or could not work
        else:
            slot.port.send(Stop(ends_process=True))
            slot.replace_by = self._now() + _QUIT_S

    def close(self) -> None:
        """Ask all processes to end; kill those that do not end in time."""
        ports = list(self.ports.values())
        for port in ports:
            port.send(Stop(ends_process=True))
        give_up_at = self._now() + _QUIT_S
        for port in ports:
            port.join(max(0.0, give_up_at - self._now()))
            port.kill()
        for slot in self._slots.values():
            slot.port = slot.start_at = None

    # -- one process ------------------------------------------------------------------------------

    def _receive(self, slot: _Slot) -> tuple[list[FromWorker], bool]:
        """The waiting messages of a process, and whether it has ended."""
        messages: list[FromWorker] = []
        port = slot.port
        if port is None:
            return messages, True
        try:
            while len(messages) < _MESSAGES_AT_ONCE and (message := port.receive()) is not None:
                messages.append(message)
                if isinstance(message, AdapterDown) and message.is_final:
                    slot.reason = message.reason
        except (EOFError, OSError):
            return messages, True
        finally:
            if messages:
                slot.received_at = self._now()
                slot.is_new = False
        return messages, False

    def _has_ended(self, slot: _Slot, kill_at: float) -> bool:
        """True after the end of a process that was asked to end, and is killed at a time. Its last
        messages are dropped: they are about a unit that the next process identifies again.
        """
        _, is_gone = self._receive(slot)
        if not is_gone and self._now() < kill_at:
            return False
        if slot.port is not None:
            slot.port.kill()
        slot.port, slot.replace_by, slot.reason = None, None, ""
        slot.start_at, slot.pause_s = self._now(), RESTART_MIN_S
        return True

    def _lose(self, slot: _Slot, reason: str, *, hung: bool) -> WorkerLost:
        if slot.port is not None and not hung:
            slot.port.kill()
        slot.port = None
        if slot.reason:
            # A new process would fail for the same reason.
            return WorkerLost(slot.reason, hung, None)
        pause_s = slot.pause_s
        slot.start_at = self._now() + pause_s
        slot.pause_s = min(2 * pause_s, RESTART_MAX_S)
        return WorkerLost(reason, hung, pause_s)

    def worked(self, socket: str) -> None:
        """Reset the pause before restarts: the process of this socket completed a run."""
        self._slots[socket].pause_s = RESTART_MIN_S
