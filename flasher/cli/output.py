"""Output of commands: results to stdout, the rest to stderr, or JSON; all of it to the log file.

Device text and file names arrive here escaped (flasher.protocol.text). A closed pipe (`| head`) or
a lost terminal changes nothing about a running upgrade: output that cannot be printed is dropped,
and the exit code reports the result.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TextIO

from flasher.cli.documents import (
    Envelope,
    ErrorDocument,
    document_of,
    to_json,
)
from flasher.cli.terminal import columns, painted, takes_colour, unpainted, wrapped
from flasher.documents import SCHEMA_VERSION, as_json
from flasher.errors import ErrorCode, ExitCode, FlasherError, UsageError

if TYPE_CHECKING:
    from flasher.trace.figures import Distribution

_LOG: Final = logging.getLogger("flasher.cli")
PRINTED: Final = {"printed": True}
"""Marks log records of printed output, so that -v does not print it twice."""


CHANGING: Final = frozenset(
    {"flash", "rescue", "write", "conformance", "station", "ui", "acceptance"}
)
"""Commands that change a device."""


class ClosingLine(NamedTuple):
    """Last line of a command; its text is complete without its colour."""

    word: str
    text: str
    colour: Literal["green", "yellow", "red"]


class Output:
    """Prints for one command. `verbosity`: 0 normal, 1 and 2 more, -1 only results and errors."""

    def __init__(
        self,
        *,
        verbosity: int = 0,
        json_wanted: bool = False,
        program: str = "flasher",
        commands: Iterable[str] = (),
    ) -> None:
        """`program` replaces "flasher" in printed command lines, which begin with one of
        `commands`, so that they run as printed.
        """
        self._program = program
        self._command_line = re.compile(rf"(?<![\w./-])flasher (?=(?:{'|'.join(commands)})\b)")
        self.verbosity = verbosity
        self.json_wanted = json_wanted
        self.events_wanted = False
        """True if each event is printed as a JSON line."""
        self.command: str | None = None
        """Name of the running command; None before it is known."""
        self.has_opened = False
        """True once the command may have opened an adapter."""
        self.shows: Callable[[object], bool] = lambda _event: False
        """True for an event that the command prints itself, so that -v does not log it again."""
        self.ending: Callable[[FlasherError], ClosingLine] | None = None
        """Formats the last line for an error, in a command that ends with a verdict."""
        self.write_stderr: Callable[[str], None] = _plain_stderr
        """Writes a text to stderr; replaced while a progress bar is on the screen."""
        self._is_stdout_lost = False
        self.is_stdout_closed = False
        """True once the program that reads stdout has ended (`| head`)."""
        self._has_begun = False
        """True after `begin_document`, until `document`."""
        # A lost terminal no longer reports that it is one.
        self._terminals = [each for each in (sys.stdout, sys.stderr) if each.isatty()]

    def leave_terminal(self, why: str) -> None:
        """Print nothing more to a terminal; files and pipes still get everything."""
        _LOG.warning("%s", why, extra=PRINTED)
        for stream in self._terminals:
            _give_up(stream)

    def say(self, text: str) -> None:
        """Write to stderr, wrapped at the window's width."""
        self.write_stderr(self.as_started(wrapped(text, sys.stderr)))

    def as_started(self, text: str) -> str:
        """Replace the program in command lines by how it was started."""
        if self._program == "flasher":
            return text
        return self._command_line.sub(lambda _: f"{self._program} ", text)

    def restore_stderr(self) -> None:
        """Write to stderr directly again."""
        self.write_stderr = _plain_stderr

    @property
    def colour(self) -> bool:
        """True if stderr shows colours (NO_COLOR is honoured)."""
        return takes_colour(sys.stderr)

    def result(self, text: str) -> None:
        """Print a line of the result; silent with --json."""
        if not self.json_wanted:
            _LOG.info("%s", unpainted(text), extra=PRINTED)
            if self._is_stdout_lost:
                self.say(text)
            else:
                self._print(self.as_started(wrapped(text, sys.stdout)))

    def results(self, lines: Iterable[str]) -> None:
        """Print lines of the result."""
        for line in lines:
            self.result(line)

    def table(self, rows: Iterable[Sequence[str]], *, indent: int = 0) -> None:
        """Print rows of the result, in columns."""
        if not self.json_wanted:
            self.results(columns(rows, indent=indent))

    def text(self, text: str) -> None:
        """Print a whole file as the result, unchanged; silent with --json."""
        if not self.json_wanted:
            self._print(text.removesuffix("\n"))

    def data(self, data: bytes) -> None:
        """Write a file to stdout, unchanged."""
        self._to_stdout(lambda: sys.stdout.buffer.write(data), "")

    def print_help(self, text: str) -> None:
        """Print help, laid out for the window; also with --json."""
        self._print("\n".join(line.rstrip() for line in text.rstrip().splitlines()))

    def document(
        self,
        document: object,
        *,
        exit_code: ExitCode = ExitCode.OK,
        error: ErrorDocument | None = None,
    ) -> ExitCode:
        """Print the JSON document of a command, the last line of its output, in its envelope.
        Return the exit code.
        """
        if self.json_wanted:
            around = Envelope(SCHEMA_VERSION, self.command, exit_code == ExitCode.OK, exit_code)
            known = {} if document is None else as_json(document)
            failed = {} if error is None else {"error": as_json(error)}
            self.line({**as_json(around), **known, **failed})
        return exit_code

    def begin_document(self, document: object, name: str, rows: Iterable[object]) -> None:
        """Begin the JSON document with what is known and the rows of its last list, which are too
        many to keep; silent without --json. The method `document` ends it, also after an error.
        """
        if not self.json_wanted:
            return
        self._has_begun = True
        known = {key: value for key, value in as_json(document).items() if key != name}
        self._write(json.dumps({**known, name: []}).removesuffix("]}"))
        try:
            for number, row in enumerate(rows):
                self._write(f"{', ' if number else ''}{json.dumps(as_json(row))}")
        finally:
            self._write("], ")

    def line(self, line: object) -> None:
        """Print a JSON line before the document; silent without --json. It has the key `event`."""
        if self.json_wanted:
            fields = line if isinstance(line, Mapping) else as_json(line)
            text = json.dumps({"schema": SCHEMA_VERSION, **fields})
            _LOG.debug("%s", text, extra=PRINTED)
            self._print(text[1:] if self._has_begun else text)
            self._has_begun = False

    def _write(self, part: str) -> None:
        self._to_stdout(lambda: sys.stdout.write(part), "")

    def _print(self, text: str) -> None:
        self._to_stdout(lambda: print(text), text)

    def _to_stdout(self, write: Callable[[], object], text: str) -> None:
        """Write to stdout. Where that fails, a command that changes a device continues on stderr,
        and its exit code reports the device; any other raises UsageError.
        """
        try:
            write()
            sys.stdout.flush()
        except BrokenPipeError:
            self.is_stdout_closed = True
            _give_up(sys.stdout)
        except OSError as error:
            _give_up(sys.stdout)
            if error.errno == errno.EIO:  # the terminal is gone
                return
            lost = UsageError(
                f"Standard output cannot be written: {error.strerror}.",
                cause="the disk that it is redirected to is full",
                remedy="Redirect it elsewhere. All work before this message is complete.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            )
            if self.command not in CHANGING:
                raise lost from error
            self._is_stdout_lost = True
            where = "the document is lost" if self.json_wanted else "the results follow here"
            self.error_line(f"warning: {lost.what[:-1]}; {where}.")
            self.result(text)

    def event(self, event: object) -> None:
        """Print an event of flasher.events as a JSON line, with --events."""
        if self.events_wanted:
            self.line(to_json(event))

    def progress(self, text: str, *, level: int = 0) -> None:
        """Print a line of progress."""
        _LOG.log(logging.INFO if level < 2 else logging.DEBUG, "%s", text, extra=PRINTED)
        if self.verbosity >= level:
            self.say(text)

    def error_line(self, text: str) -> None:
        """Print a line that -q does not silence."""
        _LOG.error("%s", unpainted(text), extra=PRINTED)
        self.say(text)

    def verdict(self, verdict: ClosingLine) -> None:
        """Print the last line of a command, in its colour: as a result, or on stderr after a
        failure (also with --json).
        """
        is_good = verdict.colour != "red"
        stream = sys.stdout if is_good else sys.stderr
        word = painted(verdict.word, verdict.colour) if takes_colour(stream) else verdict.word
        say = self.result if is_good else self.error_line
        say(f"{word}  {verdict.text}")

    def failure(self, error: FlasherError, known: object = None) -> ExitCode:
        """Print an error as text, and as the JSON document of the command, with the document
        `known` so far. Return its exit code.
        """
        failure = self.error(error)
        if self.ending is not None:
            self.verdict(self.ending(error))
        return self.document(known, exit_code=error.exit_code, error=failure)

    def error(self, error: FlasherError) -> ErrorDocument:
        """Print an error as text. Return it as a part of a document."""
        what, *others = str(error).splitlines()
        text = "\n".join((f"{what} [{error.code}]", *others))
        _LOG.error("error: %s", text, extra=PRINTED)
        head = painted("error:", "red") if self.colour else "error:"
        self.say(f"{head} {text}")
        words = {name: self.as_started(getattr(error, name)) for name in ("remedy", "command")}
        return document_of(ErrorDocument, error, kind=type(error).__name__, **words)


def _plain_stderr(text: str) -> None:
    try:
        print(text, file=sys.stderr, flush=True)
    except OSError:
        _give_up(sys.stderr)


def _give_up(stream: TextIO) -> None:
    """Discard all further output: a full buffer would fail again at exit, and replace the exit
    code.
    """
    with contextlib.suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def counted(count: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def byte_count(count: int) -> str:
    return counted(count, "byte")


def duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.2f} s"
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def utc_time(moment: datetime) -> str:
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"


def spread_ms(of: Distribution) -> str:
    """Format times in milliseconds: minimum, median, 95th and 99th percentile, maximum."""
    times_s = (of.minimum_s, of.median_s, of.p95_s, of.p99_s, of.maximum_s)
    return " / ".join(f"{each * 1000:.2f}" for each in times_s)
