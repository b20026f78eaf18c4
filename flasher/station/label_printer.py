"""Prints labels in a background thread, one at a time, with a time limit for each."""

from __future__ import annotations

import os
import queue
import select
import shlex
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.config import LabelConfig
from flasher.station.label_template import LabelTemplate
from flasher.station.records.model import RunRecord

BACKLOG_MAX: Final = 100
"""Maximum number of waiting labels; more are refused."""
_IS_WINDOWS: Final = os.name == "nt"
"""`select` does not work on files there."""
Send = Callable[[bytes, float], None]
"""Sends a label to the printer within a time in seconds. Raises NotPrinted."""


class NotPrinted(Exception):  # noqa: N818  not an error of the station
    """A label was not printed; the argument is the reason, a sentence."""


@dataclass(frozen=True)
class LabelJob:
    """A label to print for a run that passed, with the values of its template."""

    run: RunRecord
    socket: str
    """Socket that shows the result; empty: none."""
    values: dict[str, object]
    is_reprint: bool = False


class LabelPrinter:
    """The label printer of a station. Call `submit` and `take` in the station's thread."""

    def __init__(
        self, template: LabelTemplate, send: Send, *, limit_s: float, prints_each: bool = True
    ) -> None:
        self.prints_each = prints_each
        """Print a label for every passed unit; else only on REPRINT."""
        self._template = template
        self._send = send
        self._limit_s = limit_s
        self._wake: Callable[[], None] = lambda: None
        self._jobs: queue.SimpleQueue[LabelJob | None] = queue.SimpleQueue()
        self._unfinished: dict[int, LabelJob] = {}
        """Queued labels by `id`. Who removes one reports it."""
        self._done: deque[tuple[LabelJob, str]] = deque()
        self._thread = threading.Thread(target=self._work, name="labels", daemon=True)
        self._sending: threading.Thread | None = None

    def start(self, wake: Callable[[], None]) -> None:
        """Start the thread, which calls `wake` when `take` has results."""
        self._wake = wake
        self._thread.start()

    def submit(self, job: LabelJob) -> None:
        """Queue a label and return at once."""
        self._unfinished[id(job)] = job
        if self._jobs.qsize() < BACKLOG_MAX:
            self._jobs.put(job)
        else:
            self._finished(job, text("Too many labels wait for the printer."))

    def take(self) -> list[tuple[LabelJob, str]]:
        """Labels finished since the last call, each with the reason of a failure, or ""."""
        return [self._done.popleft() for _ in range(len(self._done))]

    def close(self) -> None:
        """Print the queued labels within one time limit, and end the thread. `take` has the others
        as failures.
        """
        self._jobs.put(None)
        if self._thread.ident is not None:
            self._thread.join(self._limit_s)
        for job in tuple(self._unfinished.values()):
            self._finished(job, _too_slow(self._limit_s).args[0])

    def _finished(self, job: LabelJob, reason: str) -> None:
        if self._unfinished.pop(id(job), None) is not None:
            self._done.append((job, reason))
            self._wake()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if id(job) not in self._unfinished:
                continue
            reason = ""
            try:
                self._send_in_time(self._template.fill(job.values))
            except NotPrinted as error:
                reason = error.args[0]
            except Exception as error:  # noqa: BLE001  any error of the template is reported
                reason = text("The label cannot be made: {why}.", why=printable(str(error))[:200])
            self._finished(job, reason)

    def _send_in_time(self, data: bytes) -> None:
        """Send a label in another thread with a time limit, since Windows has none for devices or
        child processes. While one hangs, no other label is sent. Raises NotPrinted, or what sending
        raised.
        """
        self._await_sent()
        failures: list[Exception] = []

        def send() -> None:
            try:
                self._send(data, self._limit_s)
            except Exception as error:  # noqa: BLE001  raised again below
                failures.append(error)

        self._sending = threading.Thread(target=send, name="label", daemon=True)
        self._sending.start()
        self._await_sent()
        if failures:
            raise failures[0]

    def _await_sent(self) -> None:
        """Wait until the label is sent. Raises NotPrinted after the time limit."""
        if self._sending is not None:
            self._sending.join(self._limit_s)
            if self._sending.is_alive():
                raise _too_slow(self._limit_s)
            self._sending = None


# -- printers -------------------------------------------------------------------------------------


def printer_of(config: LabelConfig) -> Send:
    """The function that sends labels to the configured printer."""
    if config.command:
        return lambda data, limit_s: run_command(config.command, data, limit_s)
    kind, _, place = config.printer.partition(":")
    if kind == "file":
        return lambda data, limit_s: write_file(Path(place), data, limit_s)
    host, _, port = place.removeprefix("//").rpartition(":")
    address = (host.removeprefix("[").removesuffix("]"), int(port))
    return lambda data, limit_s: send_tcp(address, data, limit_s)


def send_tcp(address: tuple[str, int], data: bytes, limit_s: float) -> None:
    until = time.perf_counter() + limit_s
    try:
        with socket.create_connection(address, timeout=limit_s) as connection:
            while data:
                connection.settimeout(max(until - time.perf_counter(), 0.001))
                data = data[connection.send(data) :]
            # Raises if the printer was switched off meanwhile and has reset the connection.
            connection.shutdown(socket.SHUT_WR)
    except TimeoutError as error:
        raise _too_slow(limit_s) from error
    except OSError as error:
        raise _unreachable(error) from error


def write_file(path: Path, data: bytes, limit_s: float) -> None:
    """Append a whole label to a file, or write it to a device. Raises NotPrinted after the time
    limit.
    """
    until, size = time.perf_counter() + limit_s, len(data)
    flags = os.O_WRONLY | os.O_APPEND | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    if not path.is_relative_to("/dev"):  # do not create a file for an unplugged device
        flags |= os.O_CREAT
    try:
        handle = os.open(path, flags, 0o644)
        end = os.fstat(handle).st_size
        try:
            while data:
                left_s = until - time.perf_counter()
                if left_s <= 0 or not (_IS_WINDOWS or select.select([], [handle], [], left_s)[1]):
                    raise _too_slow(limit_s)
                written = os.write(handle, data)
                end, data = end + written, data[written:]
        finally:
            with suppress(OSError):  # a device cannot be cut, and another program may add to a file
                if data and os.fstat(handle).st_size == end:
                    os.ftruncate(handle, end - (size - len(data)))
            os.close(handle)
    except OSError as error:
        raise _unreachable(error) from error


def run_command(words: Sequence[str], data: bytes, limit_s: float) -> None:
    """Run a program with the label as its standard input. Raises NotPrinted."""
    try:
        done = subprocess.run(  # noqa: S603  the user's own command, without a shell
            list(words), check=False, capture_output=True, timeout=limit_s, input=data
        )
    except subprocess.TimeoutExpired as error:
        raise _too_slow(limit_s) from error
    except OSError as error:
        raise _unreachable(error) from error
    if done.returncode:
        output = printable(done.stderr.decode(errors="replace").strip()[-200:])
        raise NotPrinted(
            text(
                "{command} failed with exit code {code}: {output}.",
                command=printable(shlex.join(words))[:80],
                code=done.returncode,
                output=output,
            )
        )


def _too_slow(limit_s: float) -> NotPrinted:
    return NotPrinted(text("The printer took longer than {limit} s.", limit=f"{limit_s:g}"))


def _unreachable(error: OSError) -> NotPrinted:
    why = printable(error.strerror or str(error))
    return NotPrinted(text("The printer cannot be reached: {why}.", why=why))
