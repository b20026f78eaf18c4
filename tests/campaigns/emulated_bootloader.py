"""Builds the example bootloader for a Cortex-M3, and flashes and tests it on QEMU, over slcan:
`python -m tests.campaigns.emulated_bootloader`. Further options go to `flasher conformance`, as
`--case RS-01`; by default the quick cases are run, which takes about a minute and a half.

QEMU's monitor is the bench: it switches the power and reads the memory back. The processor's clock
follows that of the computer, and QEMU may wait for a core: times are off by some 20 ms. The 50 ms
between boot versions (RS-01, RS-05) are inconclusive therefore, and in the whole suite so are the
edges of windows (UP-04, TM-02). What the processor executes is what a chip executes.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.examples.bootloader import PROFILE, emulated, make, missing

_UNCERTAINTY = ("--uncertainty", "0.02")
_APPLICATION_AT = 0x2000
_APPLICATION_BYTES = 118 * 1024
_SECOND = "V0r9r0_20251201"
_MORE = bytes(range(256)) * 4


def main() -> None:
    match sys.argv[1:]:
        case ["order", monitor, *words]:
            _order(Path(monitor), words)
        case options:
            _flash_and_test(options or ["--quick"])


def _flash_and_test(options: list[str]) -> None:
    if why := missing("make", "arm-none-eabi-gcc", "qemu-system-arm"):
        sys.exit(f"skipped: {why}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make("arm", folder, f"APPLICATION_VERSION={_SECOND}")
        second = folder / "second.bin"
        (folder / "application.bin").rename(second)
        sys.stdout.write(make("arm", folder, "--always-make"))
        good = folder / "good.bin"
        # Longer than the second one, by what the program does not use.
        good.write_bytes((folder / "application.bin").read_bytes() + _MORE)
        flasher = (sys.executable, "-m", "flasher")
        monitor = folder / "monitor"
        order = f"{sys.executable} -m tests.campaigns.emulated_bootloader order {monitor}"
        with emulated(folder / "boot.elf", monitor) as channel:
            line = ("-t", "bms", "-i", "slcan", "-c", channel)
            subprocess.run([*flasher, "flash", good, *line, "--base", "0x2000"], check=True)
            bench = ("--power-cmd", f"{order} {{on|off}}", "--readback-cmd", f"{order} {{file}}")
            suite = ("--good-image", good, "--second-image", second, "--profile", PROFILE)
            ran = subprocess.run(
                [*flasher, "conformance", *line, *bench, *suite, *_UNCERTAINTY, *options],
                check=False,
            )
    sys.exit(ran.returncode)


def _order(monitor: Path, words: list[str]) -> None:
    """What the suite asks of a bench: power on, power off, or the application area in a file."""
    orders = {"off": ["stop", "system_reset"], "on": ["cont"]}.get(
        words[0], [f'pmemsave {_APPLICATION_AT} {_APPLICATION_BYTES} "{words[0]}"']
    )
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(monitor))
        for order in ["", *orders]:
            if order:
                line.sendall(order.encode() + b"\n")
            reported = b""
            while not reported.endswith(b"(qemu) "):
                reported += line.recv(4096)


if __name__ == "__main__":
    main()
