"""Tries a build of flasher as its users run it, on a computer without a network.

`unshare --user --map-root-user --net --mount -- python3 installers/trial.py CHECKOUT COMMAND...`
with the words that start the build. Ends with 1 and the output of what went wrong. `--core` before
CHECKOUT tries a build without pages and station. Libraries that a build brings are hidden on this
computer: others do not have them.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

LIMIT_S = 120.0
START_LIMIT_S = 1.5
_MS_BIND = 4096
_UP = 0x8914, 0x1  # SIOCSIFFLAGS, IFF_UP: pages are served on the loopback interface


def main() -> int:
    words = sys.argv[1:]
    is_core = words[0] == "--core"
    checkout, *program = words[is_core:]
    samples = Path(checkout).resolve() / "firmware_samples"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as loopback:
        fcntl.ioctl(loopback, _UP[0], struct.pack("16sh", b"lo", _UP[1]))
    _hide_libraries_of(Path(program[0]).parent / "_internal")
    with tempfile.TemporaryDirectory() as home:
        os.chdir(home)
        os.environ |= {"HOME": home, "SHIV_ROOT": f"{home}/shiv"}
        for name in [each for each in os.environ if each.startswith(("XDG_", "CAN_", "PYTHON"))]:
            del os.environ[name]
        trial = Trial(program)
        trial.start_up()
        trial.run("adapters", expects="not seen, even when plugged in")
        trial.run("flash", samples / "bms.hex", "-t", "bms", "--mock", "--mock-speed", "0")
        trial.run("help", "E402", expects="E402")
        trial.run("image-info", samples / "obc.elf")
        cases = ("--case", "TX-02", "--case", "RS-01", "--jobs", "2", "--html", "report.html")
        trial.run("conformance", "-t", "bms", "--mock", *cases)
        trial.run("export", "wireshark")
        # A process for each job; each plants a mistake, and finds it.
        trial.run("simulate", "--runs", "20", "--jobs", "2")
        if not is_core:
            trial.station(samples)
            trial.pages(samples)
    return 0


def _hide_libraries_of(build: Path) -> None:
    system = Path("/usr/lib", f"{os.uname().machine}-linux-gnu")
    for library in build.glob("*.so*"):
        place = system / library.name
        if library.name.startswith("libz."):
            continue  # the program that starts the build is linked to the system's
        if place.exists():
            hidden = ctypes.CDLL(None, use_errno=True).mount(
                b"/dev/null", bytes(place), None, _MS_BIND, None
            )
            if hidden:
                sys.exit(f"{place} cannot be hidden: {os.strerror(ctypes.get_errno())}")


class Trial:
    """Runs of the commands of a build."""

    def __init__(self, program: list[str]) -> None:
        self._program = program

    def run(self, *words: object, expects: str = "") -> float:
        """Run a command; return how long it took, in seconds."""
        began_s = time.perf_counter()
        ran = subprocess.run(
            [*self._program, *map(str, words)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
        if ran.returncode != 0 or expects not in ran.stdout:
            sys.exit(f"{ran.stdout}\n{self._program} {words}: exit code {ran.returncode}")
        return time.perf_counter() - began_s

    def start_up(self) -> None:
        """Measure the start; only the processor's time is the build's own on a busy computer."""
        times = [self._started("--version") for _ in range(4)]
        warm_s = min(wall_s for wall_s, _ in times[1:])
        print(
            f"start-up: first {times[0][0]:.2f} s ({times[0][1]:.2f} s of the processor), then"
            f" {warm_s:.2f} s ({min(cpu_s for _, cpu_s in times[1:]):.2f} s);"
            f" adapters {min(self._started('adapters')[0] for _ in range(3)):.2f} s"
        )
        if min(cpu_s for _, cpu_s in times[1:]) > START_LIMIT_S:
            sys.exit(f"its start takes more than {START_LIMIT_S} s")

    def _started(self, word: str) -> tuple[float, float]:
        before = os.times()
        wall_s = self.run(word)
        after = os.times()
        spent = (after.children_user + after.children_system) - (
            before.children_user + before.children_system
        )
        return wall_s, spent

    def station(self, samples: Path) -> None:
        """Flash one unit at a station, in the process of a socket."""
        records = ("--database", "records.sqlite", "--keys", "keys")
        good = [word for each in ("bad", "dead", "slow") for word in (f"--mock-{each}", "0")]
        self.run(
            *("station", "run", "--recipe", samples / "station" / "recipe.toml", *records),
            *("--mock-sockets", 1, "--units", 1, "--mock-speed", 0, *good),
            expects='"outcome": "pass"',
        )
        self.run("station", "report", *records, "--csv", "runs.csv", "--certificates", "pages")

    def pages(self, samples: Path) -> None:
        """Fetch the page of the bench, as a German browser."""
        self._serve(["ui", "--mock", "--images", str(samples), "--no-browser"], "/", "lang=.de")
        self._serve(["station", "pages", "--web", "8741"], "/runs", "BAT2620-0001")

    def _serve(self, words: list[str], path: str, expects: str) -> None:
        with subprocess.Popen(
            [*self._program, *words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as server:
            try:
                assert server.stdout is not None  # it is piped
                said = ""
                while (found := re.search(r"http://[^\s\"]+", said)) is None:
                    line = server.stdout.readline()
                    said += line
                    if not line:
                        sys.exit(f"{said}\n{words}: served nothing")
                self._fetch(found[0].rstrip("."), path, expects)
            finally:
                server.send_signal(signal.SIGINT)
                server.wait(LIMIT_S)

    def _fetch(self, url: str, path: str, expects: str) -> None:
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
        opener.addheaders = [("Accept-Language", "de")]
        root = re.match(r"http://[^/]+", url)
        assert root is not None
        whole = url if path == "/" else f"{root[0]}{path}"
        page = opener.open(whole, timeout=LIMIT_S).read().decode()
        if re.search(expects, page) is None:
            sys.exit(f"{page}\n{whole}: no {expects}")
        for asset in set(re.findall(r"(?:src|href)=\"(/?static/[^\"]+)\"", page)):
            opener.open(f"{root[0]}/{asset.lstrip('/')}", timeout=LIMIT_S).read()


if __name__ == "__main__":
    sys.exit(main())
