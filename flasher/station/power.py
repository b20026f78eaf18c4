"""Switches a unit's power by a command of the station file, such as `relay 3 {on|off}`.

A power cycle runs in a thread: the bootloader announces itself for 0.2 s after power-up, and the
caller has to receive meanwhile.
"""

from __future__ import annotations

import shlex
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, Protocol

from flasher.errors import BusError, ErrorCode, FlasherError
from flasher.protocol.text import printable
from flasher.station.config import power_command

OFF_S: Final = 1.0
"""Time that the power stays off, so that the capacitors of a controller discharge."""
COMMAND_LIMIT_S: Final = 10.0
Run = Callable[[Sequence[str]], None]


class PowerControl(Protocol):
    """Switches a unit off and on."""

    def begin_cycle(self) -> None:
        """Start a power cycle and return at once. Raises BusError if the previous one failed."""

    def check(self) -> None:
        """Raises BusError if the last power cycle failed."""


class PowerCommand:
    """Switches a socket's power. `run` runs an argument list, and raises BusError."""

    def __init__(
        self,
        template: str,
        *,
        off_s: float = OFF_S,
        run: Run | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._on = power_command(template, on=True)
        self._off = power_command(template, on=False)
        self._off_s = off_s
        self._run = run or run_command
        self._sleep = sleep
        self._thread: threading.Thread | None = None
        self._failure: FlasherError | None = None

    def begin_cycle(self) -> None:
        """Switch off, and on again after `off_s`, in a thread; waits for the end of a running
        cycle. Raises BusError if the previous one failed.
        """
        self.check()
        self._thread = threading.Thread(target=self._cycle, daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Wait for the end of a cycle. Raises BusError if it failed."""
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _cycle(self) -> None:
        try:
            self._run(self._off)
            self._sleep(self._off_s)
            self._run(self._on)
        except FlasherError as error:
            self._failure = error


def run_command(words: Sequence[str]) -> None:
    """Run a power command. Raises BusError if it fails or takes too long."""
    where = printable(shlex.join(words))
    remedy = "Try the command by hand; correct `power` in the station file."
    try:
        done = subprocess.run(  # noqa: S603  the user's own command, without a shell
            list(words),
            check=False,
            capture_output=True,
            timeout=COMMAND_LIMIT_S,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired as error:
        what = f"The power command took longer than {COMMAND_LIMIT_S:g} s."
        raise BusError(what, where=where, remedy=remedy, code=ErrorCode.COMMAND_FAILED) from error
    except OSError as error:
        what = f"The power command cannot be run: {error.strerror}."
        raise BusError(what, where=where, remedy=remedy, code=ErrorCode.COMMAND_FAILED) from error
    if done.returncode:
        output = printable(done.stderr.decode(errors="replace").strip()[-300:])
        raise BusError(
            f"The power command failed with exit code {done.returncode}.",
            where=where,
            cause=output,
            remedy=remedy,
            code=ErrorCode.COMMAND_FAILED,
        )
