"""flasher as processes: a mock that serves, and commands that run against it."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import pytest

from flasher.cli.main import main

FLASHER = (sys.executable, "-m", "flasher")
SERVING = "Ctrl-C ends it"
"""What the mock says once it listens."""


def clean_environment(**more: str) -> dict[str, str]:
    """The environment without python-can's variables."""
    return {key: text for key, text in os.environ.items() if not key.startswith("CAN_")} | more


def lines_until(stream: IO[str], wanted: str) -> list[str]:
    """Read lines to the one that holds `wanted`; fails when the stream ends before.

    It blocks as long as the process says nothing: the timeout of the test is the limit.
    """
    lines: list[str] = []
    for line in stream:
        lines.append(line)
        if wanted in line:
            return lines
    raise AssertionError(f"{wanted!r} never came; what came: {''.join(lines)}")


class MockProcess:
    """`flasher mock ...` in a process of its own, listening once the block is entered."""

    def __init__(self, *arguments: str, folder: Path) -> None:
        self._process = subprocess.Popen(
            [*FLASHER, "mock", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=clean_environment(),
        )

    def __enter__(self) -> Self:
        assert self._process.stderr is not None
        try:
            lines_until(self._process.stderr, SERVING)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with self._process:
            self._process.kill()

    def wait_for(self, wanted: str) -> list[str]:
        """Lines of its result up to the one that holds `wanted`."""
        assert self._process.stdout is not None
        return lines_until(self._process.stdout, wanted)

    def end(self) -> int:
        """Wait until it ends by itself; returns the exit code."""
        self._process.communicate()
        return self._process.returncode


def run_flasher(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [*FLASHER, *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env=clean_environment(),
        check=False,
    )


def run_here(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Like `run_flasher`, in this process, which need not be started: the other one is the device.
    Not for several threads.
    """
    out, err = StringIO(), StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        patch.chdir(folder)
        for name in [name for name in os.environ if name.startswith("CAN_")]:
            patch.delenv(name)
        code = main(arguments)
    return subprocess.CompletedProcess(arguments, code, out.getvalue(), err.getvalue())


def transfer(
    mock: MockProcess, folder: Path, image: bytes, *bus: str, name: str = "image.bin"
) -> subprocess.CompletedProcess[str]:
    """Flash `image` to `mock` and see that it stored the same bytes, as `out.bin`."""
    (folder / name).write_bytes(image)
    done = run_here("flash", "-t", "bms", *bus, name, folder=folder)
    assert done.returncode == 0, done.stderr
    mock.wait_for("image:")
    assert (folder / "out.bin").read_bytes() == image
    return done
