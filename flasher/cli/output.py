"""Where everything that flasher says goes: results to stdout, the rest to stderr, or JSON.

Device text reaches this place escaped (flasher.protocol.text); paths and images are escaped here.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from typing import Any

from flasher.errors import FlasherError


class Output:
    """Prints for one command. `verbosity`: 0 normal, 1 and 2 more, -1 only results and errors."""

    def __init__(self, *, verbosity: int = 0, json_wanted: bool = False) -> None:
        self.verbosity = verbosity
        self.json_wanted = json_wanted
        self.write_stderr: Callable[[str], None] = _plain_stderr
        """Replaced while a progress bar is on the screen."""

    def restore_stderr(self) -> None:
        """Write to stderr directly again."""
        self.write_stderr = _plain_stderr

    @property
    def colour(self) -> bool:
        """True where stderr takes colours (NO_COLOR is honoured)."""
        return sys.stderr.isatty() and not os.environ.get("NO_COLOR")

    def result(self, text: str) -> None:
        """A line of the result; silent when JSON is wanted."""
        if not self.json_wanted:
            print(text, flush=True)

    def document(self, document: Mapping[str, Any]) -> None:
        """The one JSON document of a command, or one line of a stream of them."""
        if self.json_wanted:
            print(json.dumps(document), flush=True)

    def progress(self, text: str, *, level: int = 0) -> None:
        """A line on how it goes."""
        if self.verbosity >= level:
            self.write_stderr(text)

    def error_line(self, text: str) -> None:
        """A line that is never silenced."""
        self.write_stderr(text)

    def failure(self, error: FlasherError, **more: Any) -> None:
        """An error as a person reads it, and as the JSON document of the command."""
        head = "\x1b[1;31merror:\x1b[0m" if self.colour else "error:"
        self.error_line(f"{head} {error}")
        self.document(
            {
                "ok": False,
                "exit_code": int(error.exit_code),
                "error": {
                    "kind": type(error).__name__,
                    "what": error.what,
                    "where": error.where,
                    "cause": error.cause,
                    "remedy": error.remedy,
                },
                **more,
            }
        )


def _plain_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def counted(count: int, noun: str) -> str:
    """A number of things as a person reads it."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def byte_count(count: int) -> str:
    """A number of bytes as a person reads it."""
    return counted(count, "byte")


def duration(seconds: float) -> str:
    """A time as a person reads it."""
    if seconds < 120:
        return f"{seconds:.2f} s"
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
