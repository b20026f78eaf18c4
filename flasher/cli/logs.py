"""Log handlers of a command: to stderr for -v and -vv, and into --log-file.

The log file also contains the output of the command, which is not repeated on stderr. A log that
can no longer be written (the disk is full) never disturbs the command; it is reported at the end.
"""

from __future__ import annotations

import datetime
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Self

from flasher.cli.files import check_not_read, check_writable
from flasher.cli.output import Output
from flasher.errors import ErrorCode, UsageError, hide_passwords
from flasher.files import make_private
from flasher.log import ROOT
from flasher.protocol.text import printable

LOG_FILE: Final = "--log-file"
_PYTHON_CAN: Final = "can"
_ALSO_RAISED: Final = (
    "was not properly shut down",
    "Could not access SocketCAN device",
    "Failed to receive: ",
    "Failed to connect to server: ",
)
"""Texts that python-can logs about a bus that it cannot open or read, besides raising an error: a
command that waits for an adapter tries again."""
_NOWHERE: Final = logging.NullHandler()
_NOTHING: Final = logging.CRITICAL + 1
_ON_STDERR: Final = {
    -1: (_NOTHING, logging.ERROR),
    0: (_NOTHING, logging.WARNING),
    1: (logging.INFO, logging.WARNING),
    2: (logging.DEBUG, logging.INFO),
}
"""Levels of flasher's and of python-can's records on stderr, by verbosity."""
_FILE_CAN_LEVEL: Final = logging.INFO
"""Level of python-can in the log file: at DEBUG it logs every frame, which is slow."""


class Logs:
    """Log handlers of one command, removed at its end, with levels restored."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._file: _LogFile | None = None
        self._restore: list[tuple[logging.Logger, int, logging.Handler]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        # A bus that failed to open logs when it is deleted: not on a bare stderr.
        logging.getLogger(_PYTHON_CAN).addHandler(_NOWHERE)
        while self._restore:
            logger, level, handler = self._restore.pop()
            logger.removeHandler(handler)
            logger.setLevel(level)
        if self._file is not None:
            self._file.close()
            if self._file.failure:
                self._output.say(f"warning: {self._file.failure}")

    def open(self, verbosity: int, log_file: str | None, others: Iterable[object] = ()) -> None:
        """Attach the handlers. Raises UsageError if the log file cannot be written, or is one of
        the `others`: arguments that may name an image.
        """
        self._attach(_Screen(self._output), *_ON_STDERR[max(-1, min(verbosity, 2))])
        if log_file is not None:
            check_not_read(log_file, LOG_FILE, others)
            self._file = _LogFile(Path(log_file))
            self._attach(self._file, logging.DEBUG, _FILE_CAN_LEVEL)

    def _attach(self, handler: logging.Handler, flasher_level: int, can_level: int) -> None:
        levels = {ROOT: flasher_level, _PYTHON_CAN: can_level}
        handler.addFilter(lambda record: record.levelno >= levels[record.name.partition(".")[0]])
        for name, level in levels.items():
            logger = logging.getLogger(name)
            self._restore.append((logger, logger.level, handler))
            logger.addHandler(handler)
            logger.setLevel(min(level, logger.level or level))


class _Screen(logging.Handler):
    """Prints terse lines on stderr, above a progress bar if there is one."""

    def __init__(self, output: Output) -> None:
        super().__init__()
        self._output = output

    def emit(self, record: logging.LogRecord) -> None:
        event = getattr(record, "event", None)
        if getattr(record, "printed", False) or self._output.shows(event):
            return
        if any(words in str(record.msg) for words in _ALSO_RAISED):
            return
        try:
            name = record.name.removeprefix(f"{ROOT}.")
            text = " | ".join(_lines(record))
            self._output.say(f"{record.levelname.lower()}: {name}: {text}")
        except Exception:  # noqa: BLE001, S110  a record of a foreign library never ends the command
            pass


class _LogFile(logging.FileHandler):
    """Appends every record with its time. `failure` explains an incomplete log."""

    def __init__(self, path: Path) -> None:
        check_writable(path, LOG_FILE, is_appended_to=True)
        try:
            make_private(path, is_appended_to=True)
            super().__init__(path, encoding="utf-8", errors="backslashreplace")
        except OSError as error:
            raise UsageError(
                f"{printable(str(path))} cannot be written: {error.strerror}.",
                where=LOG_FILE,
                remedy="Name a file in a folder that exists and has room.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            ) from error
        self._shown = printable(str(path))
        self.failure = ""

    def format(self, record: logging.LogRecord) -> str:
        """Format time with UTC offset, level, logger and text; further lines are indented."""
        at = datetime.datetime.fromtimestamp(record.created, datetime.UTC).astimezone()
        head = f"{at.isoformat(timespec='milliseconds')} {record.levelname:<7} {record.name}: "
        return head + "\n    ".join(_lines(record))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  logging's own name
        """Skip a record that cannot be written."""
        self._fail()

    def close(self) -> None:
        try:
            super().close()
        except OSError:
            self._fail()

    def _fail(self) -> None:
        self.failure = f"the log {self._shown} is incomplete: it could not be written any more"


def _lines(record: logging.LogRecord) -> list[str]:
    """Return the lines of a record. Output of the command was escaped at its source."""
    text = hide_passwords(record.getMessage())
    if record.exc_info:
        text += "\n" + hide_passwords(logging.Formatter().formatException(record.exc_info))
    lines = text.splitlines() or [""]
    return lines if getattr(record, "printed", False) else [printable(line) for line in lines]
