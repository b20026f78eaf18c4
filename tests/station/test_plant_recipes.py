"""Recipes from the plant: approved by a supervisor's badge, changed between two units."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.protocol.spec import BMS
from flasher.release.store import TrustStore
from flasher.station.events import (
    RecipeChanged,
    RecipesOffered,
    RecordNotSaved,
    RunEnded,
    RunStarted,
    ScanRefused,
    SocketState,
)
from flasher.station.gate import Gate
from flasher.station.given_recipes import (
    Given,
    GivenRecipe,
    RecipeFolder,
    bundle_of,
    parse_bundle,
)
from flasher.station.messages import AdapterReady, Stop
from flasher.station.operators import Crew, Person, Role
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.recipe_offers import RecipeOffers, approved, used
from flasher.station.records.errors import RecordError
from flasher.station.records.model import AuditEvent, RunState
from tests.release.maker import chain_of, first_trust
from tests.station.factory import DAY, HEAD, SERIAL, USUAL, Bench, make_recipe, target_table
from tests.station.line_bench import LineBench
from tests.station.test_gate import _Claims

OTHER = "W2605003"
OTHER_PART = USUAL.replace("Battery 36 V", "Battery 48 V").replace("BAT-36", "BAT-48")
REVISION_5 = USUAL.replace('revision = "4"', 'revision = "5"')
OPERATOR, SUPERVISOR = "BADGE-1", "BADGE-2"


def crew() -> Crew:
    return Crew(
        [
            Person(name="Jo", code=OPERATOR, role=Role.OPERATOR),
            Person(name="Kim", code=SUPERVISOR, role=Role.SUPERVISOR),
        ]
    )


class Plant:
    """The folder as the fetching process leaves it, and the station that watches it."""

    def __init__(
        self, bench: Bench, *, people: Crew | None = None, gate: Gate | None = None
    ) -> None:
        self.folder = RecipeFolder.of(bench.folder, "line-2")
        self.line = LineBench(bench, crew=people or crew(), gate=gate)
        self.offers = RecipeOffers(self.folder, "AB", lambda _recipe: None, self.line.station.offer)
        self._sources = 0

    def give(self, text: str, sockets: str = "AB", withdrawn: frozenset[str] = frozenset()) -> str:
        """Give a recipe to sockets; returns its digest."""
        self._sources += 1
        source = self.folder.folder.parent / f"source-{self._sources}"
        source.mkdir()
        loaded = make_recipe(source, text)
        bundle = bundle_of(loaded)
        files = {sha: (source / name).read_bytes() for name, sha in bundle.files.items()}
        self.folder.add(bundle, lambda sha256: [files[sha256]])
        given = GivenRecipe(bundle.digest, tuple(sockets), "2026-05-17T08:00:00+00:00", "anna")
        self.list_(given, withdrawn=withdrawn)
        return bundle.digest

    def list_(self, *given: GivenRecipe, withdrawn: frozenset[str] = frozenset()) -> None:
        self.folder.save_given(Given(given, withdrawn))
        self.offers.look()
        self.line.turn()

    def approve(self, digest: str, badge: str = SUPERVISOR) -> None:
        self.line.scan(badge)
        self.line.scan(f"RECIPE {digest[:12]}")

    def restart(self, socket: str) -> None:
        """The old process of a socket ends, and the next one is ready."""
        old = self.line.ports[socket]
        assert old.heard[-1] == Stop(ends_process=True)
        old.is_gone = True
        self.line.turn()
        self.line.turn()
        assert self.line.ports[socket] is not old
        self.line.say(socket, AdapterReady(sees_units=True))
        self.line.leave(socket)

    def make(self, socket: str, serial: str) -> None:
        """A whole run of a unit."""
        self.line.arrive(socket)
        self.line.scan(f"SOCKET {socket}")
        self.line.scan(serial)
        self.line.work(socket)
        self.line.end(socket)

    def revision(self, serial: str) -> str:
        (life,) = self.line.bench.store.read.units(serial)
        return life.runs[-1].run.recipe_revision


@pytest.fixture
def plant(bench: Bench) -> Plant:
    return Plant(bench)


# -- approval -------------------------------------------------------------------------------------


def test_a_supervisor_sees_what_changes_and_approves_with_the_badge(plant: Plant) -> None:
    digest = plant.give(REVISION_5)
    (offer,) = plant.line.last(RecipesOffered).offered
    assert (offer.recipe, offer.digest, offer.published_by) == ("Battery 36 V, 5", digest, "anna")
    assert offer.changes == ("revision: 5, was 4",)
    plant.line.scan(SUPERVISOR)
    plant.line.scan(offer.scan)
    assert plant.line.last(RecipesOffered).offered == ()
    (row,) = plant.line.bench.store.read.noted("line-2", AuditEvent.RECIPE_APPROVED)
    assert (row["by"], row["digest"], row["sockets"]) == ("Kim", digest, ["A", "B"])
    assert row["published_by"] == "anna"
    assert {each.socket for each in plant.line.of(RecipeChanged)} == {"A", "B"}
    assert plant.line.bench.store.examine().problems == ()


def test_differences_are_shown_from_the_recipe_of_each_socket(plant: Plant) -> None:
    plant.approve(plant.give(REVISION_5, "B"))
    plant.give(REVISION_5.replace('"5"', '"6"'))
    (offer,) = plant.line.last(RecipesOffered).offered
    assert offer.changes == (
        "socket A, revision: 6, was 4",
        "socket B, revision: 6, was 5",
    )


@pytest.mark.parametrize(
    ("badge", "scan", "code"),
    [
        (OPERATOR, "", "NOT_ALLOWED"),
        (SUPERVISOR, "RECIPE 0123456789ab", "NO_SUCH_RECIPE"),
        (SUPERVISOR, "RECIPE {digest:.4}", "NO_SUCH_RECIPE"),
    ],
)
def test_no_one_else_approves_and_nothing_else_is_approved(
    plant: Plant, badge: str, scan: str, code: str
) -> None:
    digest = plant.give(REVISION_5)
    plant.line.scan(badge)
    plant.line.scan((scan or "RECIPE {digest:.12}").format(digest=digest))
    assert plant.line.last(ScanRefused).code == code
    assert plant.line.of(RecipeChanged) == []
    assert plant.line.bench.store.read.noted("line-2", AuditEvent.RECIPE_APPROVED) == []


def test_without_badges_no_one_approves(bench: Bench) -> None:
    line = LineBench(bench)
    line.scan("RECIPE 0123456789ab")
    assert line.last(ScanRefused).code == "NO_BADGES"


def test_a_recipe_that_does_not_fit_the_station_is_shown_and_not_approved(bench: Bench) -> None:
    plant = Plant(bench)

    def check(_recipe: LoadedRecipe) -> None:
        raise UsageError("A badge could be a label.")

    plant.offers._check = check
    digest = plant.give(REVISION_5)
    (offer,) = plant.line.last(RecipesOffered).offered
    assert (offer.problem, offer.scan) == ("A badge could be a label.", "")
    plant.approve(digest)
    assert plant.line.last(ScanRefused).code == "RECIPE_UNUSABLE"


def test_a_second_approval_states_that_there_is_one(plant: Plant) -> None:
    digest = plant.give(REVISION_5)
    plant.approve(digest)
    plant.approve(digest)
    assert plant.line.last(ScanRefused).code == "RECIPE_APPROVED"
    assert len(plant.line.bench.store.read.noted("line-2", AuditEvent.RECIPE_APPROVED)) == 1


def test_a_recipe_with_a_problem_is_loaded_again_and_offered_once_it_fits(bench: Bench) -> None:
    plant = Plant(bench)
    given = plant.line.of(RecipesOffered)
    problems = iter(["A badge could be a label."] * 2)

    def check(_recipe: LoadedRecipe) -> None:
        for problem in problems:
            raise UsageError(problem)

    plant.offers._check = check
    plant.give(REVISION_5)
    for _ in range(90):
        plant.offers.look()
        plant.line.turn()
    shown = plant.line.of(RecipesOffered)[len(given) :]
    assert [each.offered[0].problem for each in shown] == ["A badge could be a label.", ""]


# -- between two units ----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_finishes_with_the_recipe_that_it_began_with(plant: Plant) -> None:
    line = plant.line
    line.scan(OPERATOR)
    line.scan(SERIAL)
    line.arrive("A")
    digest = plant.give(REVISION_5)
    plant.approve(digest)
    old = line.ports["A"]
    assert not any(isinstance(message, Stop) for message in old.heard)
    plant.restart("B")  # this one was idle
    line.work("A")
    line.end("A")
    assert line.last(RunEnded).run.state is RunState.PASS
    plant.restart("A")
    assert plant.revision(SERIAL) == "4"
    plant.make("A", OTHER)
    assert plant.revision(OTHER) == "5"
    assert line.ports["A"].setup.recipe.is_relative_to(plant.folder.folder / digest)


def test_the_recipe_stays_while_the_plant_is_asked_about_a_unit(bench: Bench) -> None:
    """Its label may come back before the answer, which is about this recipe's part."""
    threads: list[Callable[[], None]] = []
    gate = Gate(bench.recipe.recipe, _Claims(), None, bench.clock.monotonic_s, start=threads.append)
    plant = Plant(bench, gate=gate)
    line = plant.line
    line.scan(OPERATOR)
    line.scan(SERIAL)
    line.arrive("A")
    line.leave("A")
    plant.approve(plant.give(REVISION_5))
    assert [each.socket for each in line.of(RecipeChanged)] == ["B"]
    threads.pop()()
    line.turn()
    line.turn()
    assert [each.socket for each in line.of(RecipeChanged)] == ["B", "A"]


def test_a_change_that_cannot_be_recorded_is_tried_again_after_resume(
    plant: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, store = plant.line, plant.line.bench.store
    note, fault = store.note, RecordError("RECORD NOT SAVED: the disk is full.", remedy="")

    def full(what: AuditEvent, *rest: Any) -> None:
        if what is AuditEvent.RECIPE_USED:
            raise fault
        note(what, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(store, "note", full)
        plant.approve(plant.give(REVISION_5))
        for _ in range(5):
            line.turn()
    assert line.of(RecipeChanged) == []
    assert len(line.of(RecordNotSaved)) == 1, "once, not in each turn of the loop"
    line.scan("RESUME")
    line.turn()
    assert {each.socket for each in line.of(RecipeChanged)} == {"A", "B"}


def test_a_copy_that_is_damaged_in_use_is_named_as_the_plants(plant: Plant) -> None:
    digest = plant.give(REVISION_5)
    plant.approve(digest)
    plant.restart("A")
    plant.restart("B")
    (image,) = (plant.folder.folder / digest).rglob("bms.bin")
    image.write_bytes(b"")
    plant.line.scan(SERIAL)
    plant.line.arrive("A")
    refused = plant.line.last(ScanRefused)
    assert refused.code == "RECIPE_CHANGED"
    assert "fetched again" in refused.remedy


@pytest.mark.slow
def test_sockets_change_on_their_own(plant: Plant) -> None:
    digest = plant.give(REVISION_5, "B")
    plant.approve(digest)
    plant.restart("B")
    assert [each.socket for each in plant.line.of(RecipeChanged)] == ["B"]
    for socket, serial, revision in (("A", SERIAL, "4"), ("B", OTHER, "5")):
        plant.make(socket, serial)
        assert plant.revision(serial) == revision


def test_figures_count_the_runs_of_all_recipes(plant: Plant) -> None:
    plant.approve(plant.give(OTHER_PART, "B"))
    plant.restart("B")
    for socket, serial in (("A", SERIAL), ("B", OTHER)):
        plant.make(socket, serial)
    assert plant.line.station.figures.units == 2


def test_a_label_that_waits_for_its_unit_goes_first(plant: Plant) -> None:
    plant.line.scan(OPERATOR)
    plant.line.scan("SOCKET A")
    plant.line.scan(SERIAL)
    plant.approve(plant.give(REVISION_5))
    assert [each.socket for each in plant.line.of(RecipeChanged)] == ["B"]
    plant.line.arrive("A")
    assert plant.line.state("A") is SocketState.RUNNING


def test_nothing_begins_while_the_process_is_replaced_and_a_hung_one_is_killed(
    plant: Plant,
) -> None:
    plant.approve(plant.give(REVISION_5))
    old = plant.line.ports["A"]
    plant.line.say("A", AdapterReady(sees_units=True))  # still sent by the old one
    assert plant.line.state("A") is SocketState.STARTING
    plant.line.scan("SOCKET A")
    plant.line.scan(SERIAL)
    plant.line.bench.clock.go_on(5.0)
    plant.line.turn()
    plant.line.turn()
    assert old.killed == 1
    assert plant.line.ports["A"] is not old
    assert plant.line.of(RunStarted) == []


def test_serial_numbers_of_the_new_recipe_are_accepted(plant: Plant) -> None:
    text = REVISION_5.replace("'W(?P", "'X(?P").replace('"W2605002"', '"X2605002"')
    plant.approve(plant.give(text, "B"))
    plant.restart("B")
    plant.line.arrive("B")
    plant.line.scan("SOCKET B")
    plant.line.scan(SERIAL)
    assert plant.line.last(ScanRefused).code == "WRONG_SERIAL", "of the recipe of socket A"
    plant.line.scan("SOCKET B")
    plant.line.scan("X2605002")
    assert plant.line.state("B") is SocketState.RUNNING


# -- withdrawn, restart ---------------------------------------------------------------------------


def test_a_withdrawn_recipe_begins_no_unit_until_another_one_is_approved(plant: Plant) -> None:
    line = plant.line
    first = plant.give(REVISION_5)
    plant.approve(first)
    plant.restart("A")
    plant.restart("B")
    plant.list_(withdrawn=frozenset({first}))
    assert line.last(RecipesOffered).withdrawn == ("A", "B")
    line.scan(SERIAL)
    line.arrive("A")
    refused = line.last(ScanRefused)
    assert refused.code == "RECIPE_WITHDRAWN"
    assert line.of(RunStarted) == []
    second = plant.give(REVISION_5.replace('"5"', '"6"'), withdrawn=frozenset({first}))
    plant.approve(second)
    plant.restart("A")
    plant.restart("B")
    assert line.last(RecipesOffered).withdrawn == ()
    line.scan(SERIAL)
    line.arrive("A")
    assert line.state("A") is SocketState.RUNNING


def test_a_recipe_that_was_withdrawn_meanwhile_is_not_approved(plant: Plant) -> None:
    digest = plant.give(REVISION_5)
    given = plant.folder.given().recipes
    plant.list_(*given, withdrawn=frozenset({digest}))
    plant.approve(digest)
    assert plant.line.last(ScanRefused).code == "RECIPE_WITHDRAWN"


def test_an_approval_of_a_recipe_that_is_withdrawn_before_it_is_used_is_dropped(
    plant: Plant,
) -> None:
    line = plant.line
    first = plant.give(REVISION_5)
    plant.approve(first)
    plant.restart("A")
    plant.restart("B")
    line.scan("SOCKET A")
    line.scan(SERIAL)
    second = plant.give(REVISION_5.replace('"5"', '"6"'), withdrawn=frozenset({first}))
    plant.approve(second)
    assert line.last(RecipesOffered).withdrawn == ()
    plant.list_(withdrawn=frozenset({first, second}))
    assert line.last(RecipesOffered).withdrawn == ("A", "B")


def test_after_a_restart_the_approved_one_is_used_without_the_server(plant: Plant) -> None:
    line = plant.line
    line.scan(OPERATOR)
    line.scan(SERIAL)
    line.arrive("A")
    digest = plant.give(REVISION_5)
    plant.approve(digest)  # A is busy, and the station dies before it changes
    store = line.bench.store
    newest = approved(store.read, "line-2")
    assert {name: data["digest"] for name, data in newest.items()} == {"A": digest, "B": digest}
    assert {name: data["digest"] for name, data in used(store.read, "line-2").items()} == {
        "B": digest
    }
    assert plant.folder.load(digest, DAY).recipe.revision == "5"


# -- the folder -----------------------------------------------------------------------------------


def test_a_recipe_from_the_plant_waives_no_signature(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    plant = Plant(bench)
    waived = HEAD + USUAL.removeprefix(HEAD).partition("\n[[target]]")[0]
    digest = plant.give(waived + target_table(BMS, 'signature = "waived"\n'))
    assert plant.folder.load(digest, DAY).digest == digest  # no trust file: hash and badge
    TrustStore().install(chain_of(first_trust()))
    with pytest.raises(UsageError, match="is not signed"):
        plant.folder.load(digest, DAY)


@pytest.mark.parametrize("what", ["recipe.toml", "bms.bin", "bms.bin.toml", "bundle.json"])
def test_a_changed_copy_is_refused(plant: Plant, what: str) -> None:
    digest = plant.give(REVISION_5)
    (file,) = (plant.folder.folder / digest).rglob(what)
    file.write_bytes(file.read_bytes() + b" ")
    with pytest.raises(UsageError, match="damaged"):
        plant.folder.load(digest, DAY)
    assert not plant.folder.is_whole(digest)


def test_two_processes_may_fetch_at_once(plant: Plant) -> None:
    """`flasher plant fetch` by hand, while the station's own process has begun to."""
    bundle = bundle_of(plant.line.bench.recipe)
    files = {sha: plant.line.bench.folder / name for name, sha in bundle.files.items()}
    old = plant.folder.folder / ".part-old"
    old.mkdir(parents=True)
    os.utime(old, (0.0, 0.0))

    def fetch(sha256: str) -> list[bytes]:
        plant.folder.save_given(Given())
        plant.folder.keep(())
        return [files[sha256].read_bytes()]

    plant.folder.add(bundle, fetch)
    assert plant.folder.is_whole(bundle.digest)
    assert not old.exists(), "a process that was killed left it"


def test_a_file_that_was_added_to_a_copy_is_refused(plant: Plant) -> None:
    digest = plant.give(REVISION_5)
    image = plant.folder.folder / digest / "files" / "bms.bin"
    image.with_name("bms.bin.wfw").symlink_to(image)
    with pytest.raises(UsageError):
        plant.folder.load(digest, DAY)


@pytest.mark.parametrize(
    "name", ["../evil", "/etc/evil", "a/../b", "a\\b", ".", "c:evil", "a//b", "RECIPE.toml"]
)
def test_a_manifest_names_files_of_its_folder_only(plant: Plant, name: str) -> None:
    bundle = replace(
        bundle_of(plant.line.bench.recipe), files={"recipe.toml": "0" * 64, name: "0" * 64}
    )
    with pytest.raises(ValueError, match=r"its|outside|no name|two of"):
        parse_bundle(bundle.to_text(), bundle.digest)


@pytest.mark.parametrize("at", ["", "yesterday", "0001-01-01T00:00:00+14:00"])
def test_a_list_with_a_time_that_pages_cannot_show_is_refused(tmp_path: Path, at: str) -> None:
    folder = RecipeFolder(tmp_path)
    folder.save_given(Given((GivenRecipe("0" * 64, ("A",), at, "anna"),)))
    with pytest.raises(RecordError, match="list of recipes from the plant cannot be read"):
        folder.given()
