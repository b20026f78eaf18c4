"""A recipe from the plant in a whole `flasher station run`."""

from __future__ import annotations

import hashlib
import io
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

import pytest

from flasher.cli.station.setup import gate_of
from flasher.errors import ExitCode
from flasher.plant.central import Central
from flasher.plant.setup import PUBLISHERS
from flasher.station.config import MockUnits, mock_config
from flasher.station.records.model import AuditEvent, RunState
from tests.cli.conftest import Flasher
from tests.cli.station_threads import ThreadPort
from tests.plant.conftest import plant
from tests.plant.factory import PASSWORD, Plant
from tests.station.factory import USUAL, Bench, make_recipe, write_recipe

__all__ = ["plant"]
pytestmark = pytest.mark.slow
BADGES = """\
[[person]]
name = "Jo"
code = "BADGE-1"
role = "operator"

[[person]]
name = "Kim"
code = "BADGE-2"
role = "supervisor"
"""
STATION = """\
name = "line-2"
plant = "{plant}"
plant_recipes = true
badges = "badges.toml"
keys = "keys"

[[socket]]
name = "A"
mock = {{ bad = 0.0, seed = 7 }}
"""
PUBLISHER: Final = "flasher_bert"
_LIMIT_S: Final = 60.0


class People:
    """Both pipes of a station: reads the events that it prints, and answers with scans."""

    def __init__(self, scans: Callable[[People], Iterator[str]]) -> None:
        self._scans = scans
        self._events: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._line = self.label = ""
        self._offered: list[dict[str, Any]] = []

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            self._events.put(json.loads(line))
        return len(text)

    def flush(self) -> None:
        pass

    def isatty(self) -> bool:
        return False

    def __iter__(self) -> Iterator[str]:
        return self._scans(self)

    def see(self, name: str, **values: object) -> None:
        """Wait for the next event of this name and these values."""
        while True:
            event = self._next()
            if event.get("event") == name and values.items() <= event.items():
                return

    def offered(self) -> dict[str, Any]:
        """The recipe that the plant offers, when it does."""
        while not self._offered:
            self._next()
        return self._offered[0]

    def _next(self) -> dict[str, Any]:
        event = self._events.get(timeout=_LIMIT_S)
        self._offered = event.get("offered", self._offered)
        self.label = event.get("label", self.label)
        return event


@pytest.fixture
def station(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], tuple[str | Path, ...]]:
    """Words of the command that runs a station of a plant with this URL."""
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    with plant.connect() as admin:
        admin.execute(f"CREATE ROLE {PUBLISHER} LOGIN PASSWORD '{PASSWORD}'".encode())
        admin.execute(f"GRANT {PUBLISHERS} TO {PUBLISHER}".encode())
    folder = tmp_path / "station"
    folder.mkdir()
    file, recipe = folder / "station.toml", write_recipe(folder, USUAL)
    (folder / "badges.toml").write_text(BADGES, encoding="utf-8")

    def words(url: str) -> tuple[str | Path, ...]:
        file.write_text(STATION.format(plant=url), encoding="utf-8")
        return "station", "run", "--recipe", recipe, "--sockets", file, "--mock-speed", "0"

    return words


def test_a_published_recipe_is_fetched_approved_and_used_from_the_next_unit_on(
    flasher: Flasher,
    plant: Plant,
    station: Callable[[str], tuple[str | Path, ...]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published = write_recipe(tmp_path, USUAL.replace('revision = "4"', 'revision = "5"'))
    database = ("--database", plant.url(PUBLISHER))
    words = ("--station", "line-2", *database, "--json")
    digest = flasher("plant", "publish", published, *words).document["digest"]
    serials = []

    def scans(people: People) -> Iterator[str]:
        yield "BADGE-1"
        for is_new in (False, True):
            if is_new:
                scan = people.offered()["scan"]
                yield from ("BADGE-2", scan)
                people.see("RecipeChanged", socket="A", digest=digest)
            people.see("UnitArrived")
            serials.append(people.label)
            yield serials[-1]
            people.see("RunEnded", action="Take the unit out.")

    people = People(scans)
    with monkeypatch.context() as patch:
        patch.setattr("flasher.plant.process._END_S", 60.0)
        patch.setattr(sys, "stdin", people)
        patch.setattr(sys, "stdout", people)
        run = flasher(*station(plant.url("flasher_line_2")))
    assert run.code == ExitCode.OK, run.err
    with closing(plant.store()) as store:
        runs = [life.runs[-1].run for each in serials for life in store.read.units(each)]
        used = [row["digest"] for row in store.read.noted("line-2", AuditEvent.RECIPE_USED)]
        (approval,) = store.read.noted("line-2", AuditEvent.RECIPE_APPROVED)
    facts = [(run.state, run.recipe, run.recipe_revision) for run in runs]
    assert facts == [(RunState.PASS, "Battery 36 V", "4"), (RunState.PASS, "Battery 36 V", "5")]
    assert runs[1].recipe_sha256 == hashlib.sha256(published.read_bytes()).hexdigest()
    assert used == ["", digest]
    assert (approval["by"], approval["published_by"]) == ("Kim", PUBLISHER)
    (status,) = plant.status().recipes
    assert (status.socket, status.digest) == ("A", digest)
    monkeypatch.setattr("flasher.plant.process._END_S", 0.0)  # nothing to send, and nowhere
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    again = flasher(*station("postgresql://x@127.0.0.1:1/plant"))
    assert json.loads(again.out.splitlines()[-1])["revision"] == "5", "without the server"
    assert "--ignore-approved" in again.err
    withdrawn = flasher("plant", "withdraw", digest[:12], "--reason", "wrong limits", *database)
    assert withdrawn.out.splitlines()[0].endswith(f"{digest[:16]}: wrong limits")
    listed = flasher("plant", "recipes", *database).out.splitlines()
    assert [line.split()[2:6] for line in listed] == [
        ["UTC", "published", "by", f"{PUBLISHER}:"], ["UTC", "withdrawn", "by", f"{PUBLISHER}:"],
    ]  # fmt: skip


def test_the_database_is_given_the_longest_time_limit_of_the_recipes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gate applies the limit of each socket's recipe."""
    limits: list[float] = []

    class Limits(Central):
        def __init__(self, url: str, **limits_s: float) -> None:
            super().__init__(url)
            limits.append(limits_s["statement_limit_s"])

    monkeypatch.setattr("flasher.plant.central.Central", Limits)
    plant = {"plant": "postgresql://x@127.0.0.1:1/plant"}
    config = mock_config(2, MockUnits()).model_copy(update=plant)
    bench = Bench(tmp_path)
    recipes = {
        name: make_recipe(tmp_path, f"{USUAL}\n[plant]\ntime_limit_s = {limit_s}\n")
        for name, limit_s in (("1", 1.0), ("2", 9.0))
    }
    gate = gate_of(config, recipes, bench.store)
    assert gate is not None
    gate.close()
    bench.store.close()
    assert limits == [9.0]


def test_a_withdrawal_needs_a_reason(flasher: Flasher) -> None:
    run = flasher("plant", "withdraw", "0" * 16, "--reason", " ", "--database", "postgresql://x/y")
    assert run.code == ExitCode.USAGE
    assert "--reason: must not be empty" in run.err
