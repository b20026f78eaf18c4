"""Start of the program: Ctrl-C while it still loads ends it with one line, without a traceback.

A build that contains flasher whole begins here too, and so do its processes.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any, NoReturn

_INTERRUPTED = 130
"""Exit code for Ctrl-C, which cannot be imported yet."""
_PROCESSES = ("flasher.bus.detect", "flasher.trace.mf4")
"""Modules that are programs of their own; Python runs them with `-m`, a whole build with this."""


def main() -> int:
    """Load and run the command line; return the exit code."""
    if sys.argv[1:2] == ["-m"] and sys.argv[2:3] and sys.argv[2] in _PROCESSES:
        import runpy  # noqa: PLC0415  seldom needed

        name = sys.argv[2]
        del sys.argv[1:3]
        runpy.run_module(name, run_name="__main__", alter_sys=True)
        return 0
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


def _start_frozen() -> NoReturn:
    """Start, or become a process of `multiprocessing`, in the folder that PyInstaller makes."""
    from multiprocessing import freeze_support  # noqa: PLC0415  it takes 10 ms

    # What is started from here (relays, compilers, printers) gets the libraries of the system.
    before = os.environ.pop("LD_LIBRARY_PATH_ORIG", None)
    os.environ.pop("LD_LIBRARY_PATH", None)
    if before is not None:
        os.environ["LD_LIBRARY_PATH"] = before
    # But its own processes get those of the folder again, as they did not inherit them.
    os.environ["PYINSTALLER_RESET_ENVIRONMENT"] = "1"
    freeze_support()
    sys.exit(main())


if __name__ == "__main__":
    _start_frozen()
