# ruff: noqa: T201
"""A station is taken over by a spare PC in the middle of a shift, and taken back, with processes:

    python -m tests.campaigns.plant_takeover --rounds 3 [--seconds 20]

Each PC is a folder with its own records and keys, and runs `flasher station run` with virtual units
and PostgreSQL beside it. In each round the PC that is not the station takes it over with an export
while the other one runs and sends; that one is then killed with SIGKILL. At the end each PC's runs
have to be in the plant once, each unit that passed on both PCs has to be named, and `flasher plant
verify` and `flasher station verify` find nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import psycopg

from flasher.plant.setup import create_database, role_of, setup
from tests.benchmarks.station_sockets import make_recipe
from tests.station.postgres import find_programs, running_server

FLASHER: Final = str(Path(sys.executable).with_name("flasher"))
PASSWORD: Final = "campaign"  # noqa: S105
STATION: Final = """\
name = "line-2"
keys = "keys"
plant = "{plant}"

[[socket]]
name = "A"
mock = {{}}

[[socket]]
name = "B"
mock = {{}}
"""
_PASSED: Final = (
    "SELECT u.serial, r.begun_at FROM run r JOIN unit u ON u.id = r.unit_id WHERE r.state = 'PASS'"
)


class Pc:
    """A PC that can be the station."""

    def __init__(self, folder: Path, plant: str) -> None:
        folder.mkdir()
        self.folder, self.file = folder, folder / "station.toml"
        self.file.write_text(STATION.format(plant=plant), encoding="utf-8")
        self.recipe = make_recipe(folder).path
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        words = ["station", "run", "--recipe", self.recipe, "--operator", "jo", "--units", "10000"]
        self._process = subprocess.Popen(
            [FLASHER, *map(str, words), "--sockets", self.file],
            start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def kill(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None

    def passed(self) -> list[tuple[str, str]]:
        """Serial number and begin of each PASS of all records that this PC has had."""
        found: set[tuple[str, str]] = set()
        for path in self.folder.glob("records.sqlite*"):
            if path.is_file() and not path.name.endswith(("-wal", "-shm")):
                with closing(sqlite3.connect(path)) as records:
                    found |= set(records.execute(_PASSED).fetchall())
        return sorted(found)


def flasher(*words: object) -> dict[str, Any]:
    run = subprocess.run(
        [FLASHER, *map(str, words), "--json"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    if run.returncode:
        raise SystemExit(f"{words}: exit code {run.returncode}\n{run.stdout}{run.stderr}")
    document: dict[str, Any] = json.loads(run.stdout)
    return document


def judge(wanted: set[tuple[str, str]], arrived: Counter[Any], named: set[str]) -> bool:
    """Print the result; True if there is a fault."""
    missing = [each for each in wanted if each not in arrived]
    twice = [each for each, count in arrived.items() if count > 1]
    units = Counter(serial for serial, _ in arrived)
    unnamed = [serial for serial, count in units.items() if count > 1 and serial not in named]
    print(f"PASS of both PCs: {len(wanted)}; in the plant: {sum(arrived.values())}")
    print(f"missing: {len(missing)}; doubled: {len(twice)}; units that passed on both PCs:"
          f" {sum(count > 1 for count in units.values())}, not named: {len(unnamed)}")  # fmt: skip
    return bool(missing or twice or unnamed)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each PC as the station")
    options = parser.parse_args()
    programs = find_programs()
    if programs is None:
        raise SystemExit("PostgreSQL is not installed.")
    with running_server(programs) as server, tempfile.TemporaryDirectory() as name:
        owner = f"postgresql://postgres@127.0.0.1:{server.port}/plant"
        create_database(owner)
        setup(owner, ["line-2"], datetime.now(UTC))
        with psycopg.connect(owner, autocommit=True) as admin:
            admin.execute(f"ALTER ROLE {role_of('line-2')} PASSWORD '{PASSWORD}'".encode())
        plant = owner.replace("postgres@", f"{role_of('line-2')}:{PASSWORD}@")
        folder = Path(name)
        secret, sealed = folder / "passphrase", folder / "sealed"
        secret.write_text("correct horse battery", encoding="utf-8")
        now, other = Pc(folder / "pc-1", plant), Pc(folder / "pc-2", plant)
        named: set[str] = set()
        now.start()
        try:
            for number in range(options.rounds):
                time.sleep(options.seconds)
                guard = ("--passphrase-file", secret)
                flasher("station", "export", sealed, "--sockets", now.file, *guard)
                done = flasher(
                    "station", "take-over", "--from", sealed, "--sockets", other.file, *guard,
                    "--database", owner, "--reason", "campaign",
                )  # fmt: skip
                named |= set((done["brought_in"] or {}).get("conflicts", ()))
                other.start()
                time.sleep(options.seconds / 4)  # both run
                now.kill()
                print(f"round {number + 1}: {done['rows']} rows, {done['runs']} runs,"
                      f" {len(done['active'])} active")  # fmt: skip
                now, other = other, now
            time.sleep(options.seconds / 4)
        finally:
            now.kill()
            other.kill()
        last = flasher("station", "bring-in", other.folder / "records.sqlite", "--sockets",
                       now.file, "--reason", "campaign")  # fmt: skip
        named |= set((last["brought_in"] or {}).get("conflicts", ()))
        flasher("plant", "send", "--sockets", now.file)
        flasher("station", "verify", "--sockets", now.file)
        flasher("plant", "verify", "--database", owner)
        with psycopg.connect(owner) as admin:
            arrived = Counter(admin.execute(_PASSED).fetchall())
        wanted = {*now.passed(), *other.passed()}
    raise SystemExit(judge(wanted, arrived, named))


if __name__ == "__main__":
    main()
