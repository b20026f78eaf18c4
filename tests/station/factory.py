"""Recipes, clocks and records for the station's tests: small images, a stopped clock."""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sqlalchemy import event

from flasher.image.image import Image
from flasher.protocol.spec import BMS, OBC, WMC, Target
from flasher.settings.manifest import release_of, to_toml
from flasher.station.recipe_file import LoadedRecipe, load_checked
from flasher.station.records import database
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    Claim,
    Order,
    RunId,
    RunResult,
    RunState,
    StepState,
    Verified,
)
from flasher.station.records.store import Store
from tests.station.traces import run_messages, write_trace

DAY = date(2026, 5, 17)
SERIAL = "W2605002"
BMS_VERSION = "V1r0r4_20220512"
IMAGES = {
    BMS: Image.from_bytes(b"BMS\0" + BMS_VERSION.encode() + bytes(200)),
    WMC: Image.from_bytes(b"WMC\0" + b"V2r1r0_20230117" + bytes(100)),
    OBC: Image.from_bytes(b"OBC\0" + b"V3r0r1_20230402" + bytes(60)),
}
HEAD = """\
name = "Battery 36 V"
part = "BAT-36"
revision = "4"
"""
SERIAL_NUMBER = """
[serial_number]
pattern = 'W(?P<year>[0-9]{2})(?P<week>[0-9]{2})(?P<number>[0-9]{3})'
example = "W2605002"
"""


def target_table(target: Target, more: str = "") -> str:
    """A `[[target]]` for the image of a target."""
    return (
        f'\n[[target]]\ntarget = "{target.name}"\nimage = "{target.name}.bin"\n'
        f'sha256 = "{IMAGES[target].sha256}"\n{more}'
    )


USUAL = HEAD + SERIAL_NUMBER + target_table(BMS)


def write_recipe(folder: Path, text: str = USUAL) -> Path:
    """A recipe with its images and manifests."""
    for target, image in IMAGES.items():
        (folder / f"{target.name}.bin").write_bytes(image.data)
        manifest = to_toml(release_of(image, target))
        (folder / f"{target.name}.bin.toml").write_text(manifest, encoding="utf-8")
    path = folder / "recipe.toml"
    path.write_text(text, encoding="utf-8")
    return path


def make_recipe(folder: Path, text: str = USUAL) -> LoadedRecipe:
    """A recipe, read and checked."""
    return load_checked(write_recipe(folder, text), DAY)


@dataclass
class FakeClock:
    """Stops until `go_on`."""

    now: datetime = datetime(2026, 5, 17, 9, 0, tzinfo=UTC)
    seconds: float = 100.0

    def utc(self) -> datetime:
        return self.now

    def monotonic_s(self) -> float:
        return self.seconds

    def go_on(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)
        self.seconds += seconds


@dataclass(frozen=True)
class _Grown:
    """What a bench leaves: all files below its folder, its time, and how many traces it made."""

    files: dict[str, bytes]
    clock: FakeClock
    traces: int


@cache
def _grown(grow: Callable[[Bench], object]) -> _Grown:
    """Records that something was done to; done once, since it takes a while."""
    with tempfile.TemporaryDirectory() as made:
        bench = Bench(Path(made))
        grow(bench)
        bench.store.close()
        files = [each for each in bench.folder.rglob("*") if each.is_file()]
        contents = {str(each.relative_to(bench.folder)): each.read_bytes() for each in files}
        return _Grown(contents, bench.clock, bench._traces)


@cache
def _begun_records() -> dict[str, bytes]:
    """A database as a station leaves it that has begun its chain and ended, and its key; made once,
    since tables, rules and keys take a while.
    """
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        path, keys = folder / "records.sqlite", folder / "keys"
        with Store.open(
            str(path), station="line-2", clock=FakeClock(), key_locations=KeyLocations(keys)
        ) as store:
            store.recover()
        return {
            str(file.relative_to(folder)): file.read_bytes() for file in (path, *keys.iterdir())
        }


def _do_not_wait_for_the_disk(connection: Any, _record: object) -> None:
    connection.execute("PRAGMA synchronous = OFF")


@dataclass
class Bench:
    """A station's records with a recipe, and what a good run does to them."""

    folder: Path
    clock: FakeClock = field(default_factory=FakeClock)
    lock_timeout_s: float = 0.02
    heads: tuple[str | Path, ...] = ()
    """Other places than beside the key."""
    grow: Callable[[Bench], object] | None = None
    """What was done to the records before, the same for all tests."""
    _traces: int = 0

    def __post_init__(self) -> None:
        self.recipe = make_recipe(self.folder)
        self.path = self.folder / "records.sqlite"
        self.trace = self.traced(SERIAL)
        self.keys.mkdir()
        files = _begun_records()
        if self.grow is not None:
            grown = _grown(self.grow)
            files, self.clock, self._traces = grown.files, replace(grown.clock), grown.traces
        for name, data in files.items():
            file = self.folder / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch(0o600)
            file.write_bytes(data)
        self.store = self.opened()
        self.store.recover()

    def opened(self, station: str = "line-2", lock_timeout_s: float | None = None) -> Store:
        # These tests pull no plug, and share the disk with each other.
        with patch.object(database, "_SYNCHRONOUS_FULL", 0):
            store = Store.open(
                str(self.path),
                station=station,
                clock=self.clock,
                key_locations=self.key_locations,
                lock_timeout_s=lock_timeout_s or self.lock_timeout_s,
            )
        event.listen(store.database.engine, "connect", _do_not_wait_for_the_disk)
        return store

    @property
    def key_locations(self) -> KeyLocations:
        return KeyLocations(self.keys, tuple(map(str, self.heads)))

    @contextmanager
    def outsider(self) -> Iterator[Any]:
        """A connection of a program that knows nothing of the station, of the plain driver."""
        with closing(sqlite3.connect(self.path)) as connection:
            connection.execute("PRAGMA foreign_keys = ON")
            connection.execute("PRAGMA synchronous = OFF")
            yield connection

    def forge(self, statement: str) -> None:
        """Change what a station protects, as somebody who takes the rules away."""
        with self.outsider() as connection:
            rules = connection.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'")
            for (name,) in rules.fetchall():
                connection.execute(f"DROP TRIGGER {name}")
            connection.execute(statement)
            connection.commit()

    @property
    def keys(self) -> Path:
        """Where the station's key is, and the heads beside it."""
        return self.folder / "keys"

    def traced(self, serial: str) -> Path:
        """The trace of a good run of this unit, another one each time."""
        self._traces += 1
        reported = run_messages(serial, BMS_VERSION, IMAGES[BMS])
        path = self.folder / f"run-{self._traces}.log.gz"
        return write_trace(path, reported, at_s=1_779_000_000.0 + self._traces)

    def use(self, text: str) -> None:
        """Go on with another recipe."""
        self.recipe = make_recipe(self.folder, text)

    def claim(
        self,
        serial: str = SERIAL,
        socket: str = "A",
        *,
        lot: str = "",
        reason: str = "",
        is_virtual: bool = False,
    ) -> Claim:
        order = Order(serial, socket, "jo", lot, reason, is_virtual)
        return self.store.claim(order, self.recipe)

    def work(self, run_id: RunId) -> None:
        """What comes before the end of a good run."""
        write = self.store.intent(run_id, "bms", "flash", BMS_VERSION)
        self.clock.go_on(8.0)
        self.store.verified(write, BMS_VERSION)
        self.store.step(run_id, "flash", StepState.PASS, duration_s=8.0)

    def ending(
        self, state: RunState = RunState.PASS, code: str = "OK", trace: Path | None = None
    ) -> RunResult:
        file = self.store.files.add("trace", trace or self.trace)
        verified = {"bms": Verified.VERSION} if state is RunState.PASS else {}
        return RunResult(state, code, "", 8.0, verified, file.sha256, [file])

    def make(
        self,
        state: RunState = RunState.PASS,
        serial: str = SERIAL,
        socket: str = "A",
        *,
        lot: str = "",
        reason: str = "",
        code: str = "",
        is_virtual: bool = False,
        gets_label: bool = False,
    ) -> RunId:
        """A whole run."""
        claim = self.claim(serial, socket, lot=lot, reason=reason, is_virtual=is_virtual)
        run_id = claim.run_id
        self.work(run_id)
        code = code or ("OK" if state is RunState.PASS else "NO_ANSWER")
        ending = self.ending(state, code, self.traced(serial))
        self.store.finish(run_id, ending, gets_label=gets_label)
        self.clock.go_on(2.0)
        return run_id
