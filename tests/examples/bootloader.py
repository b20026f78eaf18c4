"""The example bootloader in C: builds it, and runs it on an emulated Cortex-M."""

from __future__ import annotations

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "examples" / "bootloader_c"
PROFILE = SOURCE / "profile.toml"
_PACKAGES = {
    "make": "make",
    "patch": "patch",
    "gcc": "gcc libc6-dev",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}


def missing(*programs: str) -> str:
    """Which of these programs are missing, with the packages that provide them; "" for none."""
    absent = [program for program in programs if shutil.which(program) is None]
    if not absent:
        return ""
    packages = " ".join(_PACKAGES[program] for program in absent)
    return f"{', '.join(absent)} not found (Debian: apt-get install {packages})"


def make(what: str, folder: Path, *settings: str, source: Path = SOURCE) -> str:
    """`make host`, `make arm` or one file of the example into a folder; returns the output."""
    made = subprocess.run(
        ["make", "-C", source, what, f"BUILD={folder}", *settings],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return made.stdout


@contextmanager
def emulated(program: Path, monitor: Path) -> Iterator[str]:
    """Run a program on an emulated Cortex-M3 and yield the channel of its slcan line. QEMU takes
    commands at the socket `monitor`.
    """
    with socket.create_server(("127.0.0.1", 0)) as line:
        number = line.fileno()
        command = [
            *("qemu-system-arm", "-M", "mps2-an385", "-kernel", str(program)),
            *("-nographic", "-serial", "chardev:line"),
            *("-monitor", f"unix:{monitor},server=on,wait=off"),
            # No delay, since characters are sent one at a time.
            *("-chardev", f"socket,id=line,fd={number},server=on,wait=off,nodelay=on"),
        ]
        process = subprocess.Popen(command, pass_fds=[number], stdin=subprocess.DEVNULL)
        try:
            yield f"socket://127.0.0.1:{line.getsockname()[1]}"
        finally:
            process.kill()
            process.wait()
