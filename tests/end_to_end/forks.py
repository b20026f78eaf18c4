"""flasher in processes that are forked: each has everything loaded, and starts at once.

For guests with an emulated CPU, where a new interpreter takes half a minute, and where guest time
that only counts instructions runs away while files are read.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import selectors
import signal
import sys
import traceback
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from flasher.cli.main import main
from tests.end_to_end.processes import SERVING, clean_environment

_ONE_PIECE: Final = 65_536
_PACKAGES: Final = ("bus", "cli.look", "host", "image", "mock", "protocol", "settings", "trace")
_MODULES: Final = (
    "cli.bench.mock",
    "cli.upgrade.flash",
    "cli.upgrade.history",
    "export.convert",
    "export.dbc",
    "export.wireshark",
)
"""Parts of flasher that the commands of these tests load."""


def pytest_collection_finish() -> None:
    """As a plugin of pytest (`-p tests.end_to_end.forks`): not in the time of the first test."""
    load_everything()


@cache
def load_everything() -> None:
    """Import what commands load while they run."""
    names = [f"flasher.{name}" for name in _MODULES]
    for name in _PACKAGES:
        path = importlib.import_module(f"flasher.{name}").__path__
        names += [module.name for module in pkgutil.walk_packages(path, f"flasher.{name}.")]
    for name in (*names, "can.interfaces.socketcan"):
        importlib.import_module(name)


class Forked:
    """`flasher ARGUMENTS` in a process of its own."""

    def __init__(self, *arguments: str, folder: Path) -> None:
        load_everything()
        self.stdout = ""
        self.stderr = ""
        out, out_end = os.pipe()
        err, err_end = os.pipe()
        sys.stdout.flush()
        sys.stderr.flush()
        self._pid = os.fork()
        if not self._pid:
            _become(arguments, folder, out_end, err_end)
        os.close(out_end)
        os.close(err_end)
        self._selector = selectors.DefaultSelector()
        self._selector.register(out, selectors.EVENT_READ, "stdout")
        self._selector.register(err, selectors.EVENT_READ, "stderr")
        self._code: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._code is None:
            self.signal(signal.SIGKILL)
            self.end()

    @property
    def reported(self) -> str:
        """All that it has printed so far."""
        return self.stdout + self.stderr

    def until(self, words: str) -> None:
        """Wait until it has printed these words. Fails when it ends before."""
        while words not in self.reported:
            if not self._read():
                raise AssertionError(f"{words!r} never came; what came: {self.reported}")

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        os.kill(self._pid, number)

    def end(self) -> int:
        """Wait until it ends; returns the exit code."""
        if self._code is None:
            while self._read():
                pass
            self._selector.close()
            self._code = os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])
        return self._code

    def _read(self) -> bool:
        """Wait for more; False when no more comes."""
        if not self._selector.get_map():
            return False
        for key, _ in self._selector.select():
            assert isinstance(key.fileobj, int)
            piece = os.read(key.fileobj, _ONE_PIECE)
            if piece:
                setattr(self, key.data, getattr(self, key.data) + piece.decode())
            else:
                self._selector.unregister(key.fileobj)
                os.close(key.fileobj)
        return True


def _become(arguments: tuple[str, ...], folder: Path, out: int, err: int) -> None:
    """The process that was forked: run the command line and end."""
    code = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdin, sys.stdout, sys.stderr = (
            open(number, mode, encoding="utf-8", closefd=False)  # noqa: SIM115
            for number, mode in enumerate("rww")
        )
        os.chdir(folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        environment = clean_environment(NO_COLOR="1")
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = [sys.argv[0], *arguments]  # printed commands begin with `flasher`
        code = main(arguments)
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # noqa: BLE001  nothing of a test's process may run on in its copy
        os.write(2, traceback.format_exc().encode())
    finally:
        os._exit(code)


def run(*arguments: str, folder: Path) -> Forked:
    """Run a command to its end."""
    with Forked(*arguments, folder=folder) as process:
        process.end()
    return process


class Device(Forked):
    """`flasher mock -t bms`, listening once the block is entered, which stores into `out.bin`."""

    def __init__(self, *arguments: str, folder: Path) -> None:
        super().__init__("mock", "-t", "bms", "--save-image", "out.bin", *arguments, folder=folder)

    def __enter__(self) -> Self:
        try:
            self.until(SERVING)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self
