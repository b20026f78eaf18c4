"""Gives every hostile file of the table to its command; then damages good files of every kind at
random, and reads each with the reader of its kind:
`python -m tests.campaigns.hostile_files --times 20000`.

Whatever was done to a file: it is read, or refused by an error with exit code 2 or 3 and a message
that no terminal is disturbed by; soon; and it is the same file afterwards, with no other beside it.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from flasher.cli.look.explain_text import story_lines
from flasher.cli.station.scans import read_scans
from flasher.conformance import diff
from flasher.conformance import profile as conformance_profile
from flasher.documents import as_json
from flasher.errors import FlasherError
from flasher.image.load import load
from flasher.report.explain_page import render
from flasher.settings.manifest import read_release
from flasher.settings.profile import check_profile
from flasher.station.config import load_config
from flasher.station.recipe_file import load_recipe
from flasher.trace.source import explain_path
from tests.hostile import good
from tests.hostile.files import ROWS, SAMPLES, Row
from tests.hostile.judge import LIMIT_S, fault_of

ROW_LIMIT_S = 4.0
"""Of the processor, for a command. 2 on an idle machine; room for a loaded one."""
ROW_LIMIT_MB = 300
TRACES = (".asc", ".blf", ".csv", ".db", ".log", ".pcapng", ".trc")
WORDS = (
    b"\0", b"\xff", b"\n", b"\r\n", b" ", b'"', b"'", b"[", b"{", b"}", b"]", b"=", b".", b",",
    b"#", b":", b"-", b"nan", b"inf", b"-inf", b"1e999", b"9" * 30, b"9" * 5000,
    b"0x" + b"f" * 5000,
    b"\x1b[2J", "é".encode(), "🚲".encode(), b"\xed\xa0\x80", b"\xff\xfe", b"null", b"LOBJ",
)  # fmt: skip


def state(folder: Path) -> dict[str, tuple[int, int, str]]:
    """Everything in a folder: size, time of change, and the bytes of files that are not huge."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        is_small = path.is_file() and not path.is_symlink() and status.st_size < 1 << 20
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if is_small else ""
        found[str(path)] = (status.st_size, status.st_mtime_ns, digest)
    return found


def run_rows(rows: Sequence[Row], folder: Path) -> list[str]:
    """Run the command of each row on its file; what was wrong with any of them."""
    jobs = []
    for number, row in enumerate(rows):
        place = folder / str(number)
        place.mkdir()
        row.make(place / row.name)
        words = [str(place / row.name) if word == "FILE" else word for word in row.command.split()]
        jobs.append((str(place), words))
    before = state(folder)
    done = subprocess.run(
        [sys.executable, "-m", "tests.hostile.child"],
        input=json.dumps(jobs),
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    wrong = []
    for row, result in zip(rows, json.loads(done.stdout), strict=True):
        code, out, err, seconds, megabytes = result
        faults = [
            f"exit code {code}" if code != row.code else "",
            f"does not print {row.reported!r}" if row.reported not in out + err else "",
            f"{err.count('error: ')} messages" if err.count("error: ") != bool(code) else "",
            f"{seconds:.1f} s" if seconds > ROW_LIMIT_S else "",
            f"{megabytes:.0f} MB" if megabytes > ROW_LIMIT_MB else "",
        ]
        if any(faults):
            wrong.append(f"{row.command} {row.name}: {', '.join(filter(None, faults))}\n{err:.300}")
    if state(folder) != before:
        wrong.append("a folder of a file is not as it was")
    return wrong


def explained(path: Path) -> None:
    """As `flasher explain --html --json` does."""
    story = explain_path(path)
    for line in story_lines(story, packets=True):
        line.encode("ascii")
    json.dumps(as_json(story), allow_nan=False)
    render(story)


READERS: dict[str, Callable[[Path], object]] = {
    "image": load,
    "manifest": read_release,
    "profile": check_profile,
    "conformance profile": conformance_profile.load_profile,
    "recipe": load_recipe,
    "station": load_config,
    "scans": read_scans,
    "report": diff.read_report,
    "trace": explained,
}


class Campaign:
    """The good files, and what became of the bad ones."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder = folder
        self._random = random.Random(seed)
        self._good = list(good_files(folder / "good"))
        self.counts: Counter[str] = Counter()
        self.slowest = (0.0, "")
        self.problems: list[str] = []

    def once(self) -> None:
        """Damage a file, and read it."""
        kind, suffix, data = self._random.choice(self._good)
        for _ in range(self._random.randint(1, 4)):
            data = self._damaged(data)
        if kind == "trace" and suffix != ".db" and self._random.random() < 0.1:
            suffix, data = f"{suffix}.gz", self._damaged(gzip.compress(data))
        place = self._folder / "bad"
        place.mkdir()
        path = place / f"file{suffix}"
        path.write_bytes(data)
        if kind == "recipe":
            for name in ("bms.bin", "bms.bin.toml"):
                shutil.copy(SAMPLES / "station" / name, place)
        before = path.stat()
        names = sorted(os.listdir(place))  # noqa: PTH208  names are all that is asked
        began = time.process_time()
        try:
            READERS[kind](path)
            self.counts[f"{kind}: read"] += 1
        except FlasherError as error:
            self.counts[f"{kind}: refused"] += 1
            if fault := fault_of(error):
                self._keep(kind, path, fault)
        except Exception as error:  # noqa: BLE001  that is what it looks for
            self._keep(kind, path, f"{type(error).__name__}: {error!s:.200}")
        took_s = time.process_time() - began
        self.slowest = max(self.slowest, (took_s, kind))
        if took_s > LIMIT_S:
            self._keep(kind, path, f"{took_s:.1f} s")
        after = path.stat()
        if path.read_bytes() != data or after.st_mtime_ns != before.st_mtime_ns:
            self._keep(kind, path, "it was changed")
        if sorted(os.listdir(place)) != names:  # noqa: PTH208
            self._keep(kind, path, "another file is beside it")
        shutil.rmtree(place)

    def _keep(self, kind: str, path: Path, what: str) -> None:
        kept = self._folder / f"kept-{len(self.problems)}{''.join(path.suffixes)}"
        shutil.copy(path, kept)
        self.problems.append(f"{kind}: {what} ({kept})")

    def _damaged(self, data: bytes) -> bytes:
        chance = self._random
        at = chance.randint(0, len(data))
        end = min(len(data), at + chance.choice((1, 1, 2, 4, 8, 100, 10_000)))
        match chance.randrange(7):
            case 0:
                return data[:at]
            case 1:
                return data[:at] + data[end:]
            case 2:
                return data[:end] + data[at:end] * chance.choice((1, 1, 3, 100)) + data[end:]
            case 3:
                return data[:at] + chance.choice(WORDS) + data[at:]
            case 4:
                return data[:at] + chance.choice(WORDS) + data[end:]
            case 5:
                return data[:at] + bytes(chance.randbytes(end - at)) + data[end:]
            case _:
                other = chance.choice(self._good)[2]
                return data[:at] + other[chance.randint(0, len(other)) :]


def good_files(folder: Path) -> Iterator[tuple[str, str, bytes]]:
    """Kind, suffix and bytes of small good files of every kind."""
    folder.mkdir()
    for name in ("wmc.hex", "wmc.s19", "obc.elf", "obc.bin"):
        yield "image", Path(name).suffix, (SAMPLES / name).read_bytes()
    station = SAMPLES / "station"
    yield "manifest", ".toml", (station / "bms.bin.toml").read_bytes()
    yield "recipe", ".toml", (station / "recipe.toml").read_bytes()
    yield "station", ".toml", (station / "sockets.toml").read_bytes()
    yield "scans", ".txt", (station / "scans.txt").read_bytes()
    yield "profile", ".toml", good.TARGET_PROFILE
    yield "conformance profile", ".toml", good.CONFORMANCE_PROFILE
    yield "report", ".json", good.conformance_report()
    for suffix in TRACES:
        yield "trace", suffix, good.trace(folder / f"trace{suffix}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    logging.getLogger("can").addHandler(logging.NullHandler())
    with tempfile.TemporaryDirectory(prefix="hostile-table-") as table:
        wrong = run_rows(ROWS, Path(table))
    sys.stdout.write("".join(f"{each}\n" for each in (f"{len(ROWS)} files of the table", *wrong)))
    folder = Path(tempfile.mkdtemp(prefix="hostile-"))
    campaign = Campaign(folder, options.seed)
    for _ in range(options.times):
        campaign.once()
    for name, count in sorted(campaign.counts.items()):
        sys.stdout.write(f"{name:30} {count:7,}\n")
    sys.stdout.write(f"slowest: {campaign.slowest[1]}, {campaign.slowest[0]:.2f} s\n")
    for problem in campaign.problems:
        sys.stdout.write(f"{problem}\n")
    if not campaign.problems:
        shutil.rmtree(folder)
    return bool(wrong or campaign.problems)


if __name__ == "__main__":
    sys.exit(main())
