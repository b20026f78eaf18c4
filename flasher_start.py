"""Start of the program: Ctrl-C while it still loads ends it with one line, without a traceback."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any, NoReturn

_INTERRUPTED = 130
"""Exit code for Ctrl-C, which cannot be imported yet."""


def main() -> int:
    """Load and run the command line; return the exit code."""
    default = signal.default_int_handler
    is_default = signal.getsignal(signal.SIGINT) is default  # else Ctrl-C is ignored (nohup, &)
    if is_default:
        signal.signal(signal.SIGINT, _end)
    from flasher.cli.main import main as run  # noqa: PLC0415  what takes the time

    if is_default:
        signal.signal(signal.SIGINT, default)
    return run()


def _end(*_: Any) -> NoReturn:
    if sys.stderr is not None:
        os.write(sys.stderr.fileno(), b"error: Interrupted at once. [E130]\n")
    os._exit(_INTERRUPTED)
