"""Keeps what `flash` and `rescue` do in this computer's history. Nothing that goes wrong here
changes what they do: it is said in a warning.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from flasher.api import Job
from flasher.bus.detect import BUILT_IN, SOCKETCAN
from flasher.bus.inspect_interface import VIRTUAL_KINDS
from flasher.cli.output import Output
from flasher.cli.recording import Recording
from flasher.errors import ExitCode, FlasherError, InterruptedByUserError
from flasher.events import QueryAnswered
from flasher.history import Began, Ended, History
from flasher.host.session import Result
from flasher.protocol.contents import VersionInformation
from flasher.protocol.text import printable

MOCK: Final = "the built-in mock"


class Keeper:
    """The record of one flash; `began` opens it, and what is not known by then is filled in."""

    def __init__(self, output: Output, history: History) -> None:
        self._output = output
        self._history = history
        self._name: str | None = None
        self._serial_number: str | None = None
        self.result: Result | None = None
        self.record: Recording | None = None
        """Knows the bundle."""
        self.warning = ""
        """Why it is not kept; empty where it is."""

    def began(self, command: str, job: Job, adapter: str, *, is_mock: bool) -> None:
        """The upgrade begins on this adapter."""
        plan = job.plan
        began = Began(
            at=_now(),
            command=command,
            target=plan.target.name,
            is_virtual=is_mock or _is_virtual(adapter),
            adapter=MOCK if is_mock else printable(adapter),
            image=printable(plan.image.source),
            image_sha256=plan.image.sha256,
            image_size_bytes=plan.image.size_bytes,
            image_version=plan.image.version,
            waived=", ".join(job.waived),
        )

        def write() -> None:
            self._name = self._history.begin(began)

        self._carefully(write)

    def heard(self, event: object) -> None:
        """Take the serial number out of what the device answers."""
        if isinstance(event, QueryAnswered) and isinstance(event.content, VersionInformation):
            self._serial_number = printable(str(event.content.serial_number)) or None

    def ended(self, failure: BaseException | None) -> None:
        """It is over, with this exception or without one."""
        name, result = self._name, self.result
        if name is None:
            return
        error = result.error() if failure is None and result is not None else failure
        bundle = None if self.record is None else self.record.bundle
        outcome = None if result is None else result.outcome
        left = outcome.device_left.needs_rescue if outcome else getattr(error, "needs_rescue", True)
        ended = Ended(
            at=_now(),
            exit_code=int(result.exit_code if result and not failure else _exit_code(error)),
            what=_words(error),
            serial_number=self._serial_number,
            previous_version=result.previous_version if result else None,
            transferred=None if outcome is None else outcome.is_transferred,
            completed=None if outcome is None else outcome.is_completed,
            running_version=result.running_version if result else None,
            needs_rescue=left,
            bundle=None if bundle is None else printable(str(bundle)),
        )
        self._carefully(lambda: self._history.end(name, ended))

    def _carefully(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as problem:  # noqa: BLE001  the flash is what matters
            reason = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
            path = self._history.path
            self.warning = printable(f"no history in {path}: {reason}")
            self._output.error_line(f"warning: {self.warning}")


@contextmanager
def kept(output: Output) -> Iterator[Keeper]:
    """Keep the flash of the block, once it has begun, whatever its end is."""
    keeper = Keeper(output, History())
    try:
        yield keeper
    except BaseException as failure:
        keeper.ended(failure)
        raise
    keeper.ended(None)


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _is_virtual(adapter: str) -> bool:
    """A bus of python-can, or of the kernel, without hardware."""
    interface, _, channel = adapter.partition(" ")
    is_vcan = interface == SOCKETCAN and channel.startswith(tuple(VIRTUAL_KINDS))
    return interface in BUILT_IN or is_vcan


def _exit_code(error: BaseException | None) -> ExitCode:
    match error:
        case FlasherError():
            return error.exit_code
        case KeyboardInterrupt():
            return InterruptedByUserError.exit_code
        case None:
            return ExitCode.OK
        case _:
            return ExitCode.INTERNAL


def _words(error: BaseException | None) -> str:
    if error is None:
        return ""
    said = "Interrupted at once." if isinstance(error, KeyboardInterrupt) else str(error)
    return printable(error.what if isinstance(error, FlasherError) else said)
