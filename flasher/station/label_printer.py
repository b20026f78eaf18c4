"""Prints labels in a thread of its own, one after the other, each within a time limit. Nothing that
a printer does is waited for.
"""

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
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.config import LabelConfig
from flasher.station.label_template import LabelTemplate

BACKLOG_MAX: Final = 100
"""Labels that wait for a printer; more are refused."""
_IS_WINDOWS: Final = os.name == "nt"
"""There a file cannot be waited for."""
Send = Callable[[bytes, float], None]
"""Sends a label to the printer within a time in seconds. Raises NotPrinted."""


class NotPrinted(Exception):  # noqa: N818  a printer that fails is no fault of the station
    """Why a label was not printed, as a sentence."""


@dataclass(frozen=True)
class LabelJob:
    """A label to print."""

    socket: str
    serial: str
    values: dict[str, object]
    is_reprint: bool = False


class LabelPrinter:
    """The printer of a station. `submit` and `take` are called in the station's thread."""

    def __init__(
        self, template: LabelTemplate, send: Send, *, limit_s: float, prints_each: bool = True
    ) -> None:
        self.prints_each = prints_each
        """Every unit that passes gets a label; else only REPRINT prints."""
        self._template = template
        self._send = send
        self._limit_s = limit_s
        self._wake: Callable[[], None] = lambda: None
        self._jobs: queue.Queue[LabelJob | None] = queue.Queue(BACKLOG_MAX)
        self._done: deque[tuple[LabelJob, str]] = deque()
        self._thread = threading.Thread(target=self._work, name="labels", daemon=True)
        self._sending: threading.Thread | None = None

    def start(self, wake: Callable[[], None]) -> None:
        """`wake` is called in the printer's thread when something can be taken."""
        self._wake = wake
        self._thread.start()

    def submit(self, job: LabelJob) -> None:
        """Print it; returns at once."""
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            self._done.append((job, text("Too many labels wait for the printer.")))
            self._wake()

    def take(self) -> list[tuple[LabelJob, str]]:
        """The labels that are done since the last call, each with why it was not printed; "" for
        one that was.
        """
        return [self._done.popleft() for _ in range(len(self._done))]

    def close(self) -> None:
        """Print what waits, as far as one time limit lets it."""
        try:
            self._jobs.put_nowait(None)
        except queue.Full:
            return
        if self._thread.ident is not None:
            self._thread.join(self._limit_s)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            reason = ""
            try:
                self._send_in_time(self._template.fill(job.values))
            except NotPrinted as error:
                reason = error.args[0]
            except Exception as error:  # noqa: BLE001  of a template: a station has to know it
                reason = text("The label cannot be made: {why}.", why=printable(str(error))[:200])
            self._done.append((job, reason))
            self._wake()

    def _send_in_time(self, data: bytes) -> None:
        """Send a label, and give it up after the time limit: Windows knows no limit for a device,
        nor for a program whose own programs go on. While it hangs, nothing else is sent. Raises
        NotPrinted, and whatever sending raises.
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
        """Wait for the label that is sent, if one is. Raises NotPrinted."""
        if self._sending is not None:
            self._sending.join(self._limit_s)
            if self._sending.is_alive():
                raise _too_slow(self._limit_s)
            self._sending = None


# -- printers -------------------------------------------------------------------------------------


def printer_of(config: LabelConfig) -> Send:
    """How labels get to the printer that is configured."""
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
            # A printer that is switched off in between resets it: that is seen here.
            connection.shutdown(socket.SHUT_WR)
    except TimeoutError as error:
        raise _too_slow(limit_s) from error
    except OSError as error:
        raise _unreachable(error) from error


def write_file(path: Path, data: bytes, limit_s: float) -> None:
    """Append to a file, or write to a device. A device that takes nothing is not waited for."""
    until = time.perf_counter() + limit_s
    flags = os.O_WRONLY | os.O_APPEND | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    if not path.is_relative_to("/dev"):  # a device that is unplugged must not become a file
        flags |= os.O_CREAT
    try:
        handle = os.open(path, flags, 0o644)
        try:
            while data:
                left_s = until - time.perf_counter()
                if left_s <= 0 or not (_IS_WINDOWS or select.select([], [handle], [], left_s)[1]):
                    raise _too_slow(limit_s)
                data = data[os.write(handle, data) :]
        finally:
            os.close(handle)
    except OSError as error:
        raise _unreachable(error) from error


def run_command(words: Sequence[str], data: bytes, limit_s: float) -> None:
    """Give the label to a program on its standard input."""
    try:
        done = subprocess.run(  # noqa: S603  the user's own command, without a shell
            list(words), check=False, capture_output=True, timeout=limit_s, input=data
        )
    except subprocess.TimeoutExpired as error:
        raise _too_slow(limit_s) from error
    except OSError as error:
        raise _unreachable(error) from error
    if done.returncode:
        said = printable(done.stderr.decode(errors="replace").strip()[-200:])
        raise NotPrinted(
            text(
                "{command} ended with {code}: {said}.",
                command=printable(shlex.join(words))[:80],
                code=done.returncode,
                said=said,
            )
        )


def _too_slow(limit_s: float) -> NotPrinted:
    return NotPrinted(text("The printer took longer than {limit} s.", limit=f"{limit_s:g}"))


def _unreachable(error: OSError) -> NotPrinted:
    why = printable(error.strerror or str(error))
    return NotPrinted(text("The printer cannot be reached: {why}.", why=why))
