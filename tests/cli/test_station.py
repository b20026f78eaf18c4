"""`flasher station`: check, run with virtual units, report, unit, backup, verify."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import signal
import sys
import time
from pathlib import Path
from typing import Any, get_args
from xml.etree import ElementTree as Xml

import pytest
from argon2 import PasswordHasher

from flasher.cli.main import main
from flasher.cli.station.run import WAIT_LEFT_S
from flasher.cli.station.views import JsonLines
from flasher.errors import ExitCode
from flasher.settings.toml_reader import TomlTable
from flasher.station.config import StationConfig
from flasher.station.events import SocketState, StationEvent, StepStarted
from flasher.station.export import seal
from flasher.station.messages import AdapterDown
from flasher.station.operators import BadgeTable
from flasher.station.pins import Pin, is_right
from flasher.station.recipe import Recipe
from flasher.station.records.errors import DiskFullError
from flasher.station.records.model import AuditEvent, RunState, StepState
from flasher.station.records.store import Store
from flasher.station.scans import Word
from tests.cli.conftest import SAMPLES, Flasher, Run
from tests.cli.station_threads import ThreadPort
from tests.cli.test_schema import hold, hold_output
from tests.loops import each
from tests.station.factory import SERIAL, USUAL, Bench, write_recipe

RECIPE = SAMPLES / "station" / "recipe.toml"
WRITE = """
[[write]]
target = "bms"
item = "serial-number"
values = ["{serial}"]
manufacturer = true
"""
FAST = ("--mock-speed", "0", "--mock-dead", "0", "--mock-slow", "0")


@pytest.fixture(autouse=True)
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """No processes, and no keyboard."""
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    """A recipe with a small image."""
    folder = tmp_path / "recipe"
    folder.mkdir()
    return write_recipe(folder, USUAL + WRITE)


def lines_of(run: Run) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The events, and the document after them."""
    *lines, document = [json.loads(line) for line in run.out.splitlines()]
    return lines, document


# -- check -----------------------------------------------------------------------------------------


def test_the_sample_recipe_can_be_used(flasher: Flasher) -> None:
    run = flasher("station", "check", RECIPE)
    assert run.code == ExitCode.OK
    assert "version read back" in run.out
    assert "write:    BMS serial-number: BAT2620-0001" in run.out
    document = flasher("station", "check", RECIPE, "--json").document
    assert document["targets"][0]["version"] == "V1r0r5_20230301"


def test_everything_that_is_wrong_with_a_recipe_is_reported(
    flasher: Flasher, recipe: Path, schema: dict[str, Any]
) -> None:
    text = recipe.read_text("utf-8").replace("part =", "parts =").replace("revision", "revison")
    recipe.write_text(text, "utf-8")
    run = flasher("station", "check", recipe)
    assert run.code == ExitCode.USAGE
    assert "Did you mean part?" in run.err
    run = flasher("station", "check", recipe, "--json")
    hold_output(schema, run.out, 2)
    reported = [f"{finding['where']} {finding['what']}" for finding in run.document["findings"]]
    assert reported[:2] == ["parts unknown key.", "revison unknown key."]
    assert "has no part and no revision" in reported[2]


def test_a_changed_image_is_found_before_the_shift(flasher: Flasher, recipe: Path) -> None:
    (recipe.parent / "bms.bin").write_bytes(b"another image")
    run = flasher("station", "check", recipe)
    assert run.code == ExitCode.USAGE
    assert "sha256" in run.err


def test_the_sockets_are_checked_with_the_recipe(
    flasher: Flasher, recipe: Path, tmp_path: Path
) -> None:
    sockets = tmp_path / "sockets.toml"
    sockets.write_text('[[socket]]\nname = "A"\nmock = {}\n', "utf-8")
    assert (
        "socket A: virtual units" in flasher("station", "check", recipe, "--sockets", sockets).out
    )
    beside = {
        '[label]\ntemplate = "label.zpl"\nprinter = "file:x"\n': "cannot be filled in",
        'badges = "badges.toml"\n': "could be a label",
    }
    (tmp_path / "label.zpl").write_text("{{ serail }}", "utf-8")
    badge = f'[[person]]\nname = "Jo"\ncode = "{SERIAL}"\nrole = "operator"\n'
    (tmp_path / "badges.toml").write_text(badge, "utf-8")
    for text, reported in beside.items():
        sockets.write_text(f'{text}[[socket]]\nname = "A"\nmock = {{}}\n', "utf-8")
        run = flasher("station", "check", recipe, "--sockets", sockets)
        assert run.code == ExitCode.USAGE
        assert reported in run.err
    missing = 'interface = "socketcan"\nserial_number = "none-like-this"\n'
    sockets.write_text(f'[[socket]]\nname = "A"\n{missing}', "utf-8")
    run = flasher("station", "check", recipe, "--sockets", sockets)
    assert run.code == ExitCode.BUS
    assert "is plugged in" in run.err


def test_without_the_extra_the_command_for_it_is_named(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "sqlalchemy" else real(name)
    )
    run = flasher("station", "verify")
    assert run.code == ExitCode.USAGE
    assert "sqlalchemy" in run.err
    assert "pip install -c .ci/constraints.txt '.[station]'" in run.err
    assert flasher("station", "--help").code == ExitCode.OK


# -- run -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_virtual_units_are_scanned_and_flashed_until_the_wanted_number(
    flasher: Flasher, recipe: Path, schema: dict[str, Any]
) -> None:
    words = ("--mock-sockets", "2", "--units", "3", "--mock-bad", "0", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.OK, "not a terminal: JSON lines without --json"
    lines = hold_output(schema, run.out, 0)
    _, document = lines_of(run)
    assert [unit["state"] for unit in document["units"]] == ["pass"] * 3
    assert document["figures"]["first_pass_share"] == 1.0
    assert document["is_complete"]
    assert document["records"] == "", "recorded nowhere"
    kinds = [line["event"] for line in lines]
    assert kinds[0] == "StationStarted"
    assert kinds[-1] == "StationStopped"
    assert kinds.count("RunEnded") == 3


@pytest.mark.slow
def test_virtual_units_that_are_exchanged_in_their_runs_pass_in_the_end(
    flasher: Flasher, recipe: Path
) -> None:
    """The label of each stays with its own unit, and the station ends when they are back."""
    words = ("--mock-sockets", "1", "--units", "2", "--mock-bad", "0", "--mock-exchanged", "1")
    run = flasher("station", "run", "--recipe", recipe, *words, *FAST)
    lines, document = lines_of(run)
    ended = [(e["serial"], e["run"]["code"]) for e in lines if e["event"] == "RunEnded"]
    first, second = (unit["serial"] for unit in document["units"])
    assert ended == [(first, "UNIT_CHANGED"), (second, "OK"), (first, "OK")]
    assert run.code == ExitCode.OK


@pytest.mark.slow
@pytest.mark.parametrize("has_badges", [False, True])
def test_a_golden_unit_is_checked_and_releases_the_line(
    flasher: Flasher,
    recipe: Path,
    badges: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    has_badges: bool,
) -> None:
    text = recipe.read_text("utf-8")
    golden = '\n[golden]\nserial_numbers = ["W2605000"]\nevery_h = 100\n'
    recipe.write_text(text + golden, "utf-8")
    file = tmp_path / "station.toml"
    head = 'name = "line-2"\nkeys = "keys"\ngolden_unit = "required"\n'
    head += f'badges = "{badges}"\n' * has_badges
    file.write_text(head + '[[socket]]\nname = "A"\nmock = { bad = 0.0 }\n', "utf-8")
    words = ("station", "check", recipe, "--sockets", file, "--golden")
    wrong = flasher(*words, "W2605003")
    assert wrong.code == ExitCode.USAGE
    assert "it names W2605000" in wrong.err
    if has_badges:
        monkeypatch.setattr(sys, "stdin", io.StringIO("BADGE-9\n"))
        unknown = flasher(*words, "W2605000", "--json")
        assert unknown.code == ExitCode.USAGE
        assert "not in the badge table" in unknown.err
        monkeypatch.setattr(sys, "stdin", io.StringIO("BADGE-1\n"))
    run = flasher(*words, "W2605000", "--json")
    assert run.code == ExitCode.OK, run.err
    assert [unit["state"] for unit in lines_of(run)[1]["units"]] == ["pass"]
    with Store.open(str(tmp_path / "records.sqlite"), station="reader", create=False) as store:
        (row,) = store.read.noted("line-2", AuditEvent.RELEASED)
        (details,) = store.read.unit("W2605000").runs
    assert (row["serial"], row["units"]) == ("W2605000", "virtual")
    assert (details.run.operator == "Sue") is has_badges


@pytest.mark.slow
def test_a_file_of_scans_ends_the_station_and_a_bad_unit_is_exit_code_12(
    flasher: Flasher, recipe: Path, tmp_path: Path
) -> None:
    scans = tmp_path / "scans.txt"
    scans.write_text("# a lot\nOPERATOR Kim\nW2605002\nNO LABEL\nW2605003\n\n", "utf-8")
    database = tmp_path / "plant.sqlite"
    words = ("--recipe", recipe, "--scans", scans, "--database", database, "--mock-bad", "1")
    run = flasher("station", "run", "--mock-sockets", "2", *words, *FAST)
    assert run.code == ExitCode.PARTIAL
    document = lines_of(run)[1]
    assert {unit["serial"] for unit in document["units"]} == {"W2605002", "W2605003"}
    for unit in document["units"]:
        assert unit["state"] == "fail"
        assert unit["code"] in ("WRONG_HARDWARE", "REFUSED")
        assert "Put the unit aside" in unit["text"]
    assert [each["text"] for each in document["refused"]] == ["NO LABEL"]
    with Store.open(str(database), station="reader", create=False) as store:
        (details,) = store.read.unit("W2605002").runs
        assert details.run.operator == "Kim"
        assert details.run.state is RunState.FAIL


@pytest.mark.slow
def test_a_label_of_the_file_that_is_refused_is_exit_code_12(
    flasher: Flasher, recipe: Path, tmp_path: Path
) -> None:
    scans, database = tmp_path / "scans.txt", tmp_path / "plant.sqlite"
    scans.write_text("W2605002\n", "utf-8")
    words = ("--recipe", recipe, "--scans", scans, "--database", database, "--mock-bad", "0")
    assert flasher("station", "run", "--mock-sockets", "1", *words, *FAST).code == ExitCode.OK
    again = flasher("station", "run", "--mock-sockets", "1", *words, *FAST)
    assert again.code == ExitCode.PARTIAL
    _, document = lines_of(again)
    assert document["units"] == []
    assert document["refused"][0]["code"] == "DUPLICATE"


@pytest.mark.slow
def test_new_virtual_units_have_new_numbers(flasher: Flasher, recipe: Path, tmp_path: Path) -> None:
    words = ("--recipe", recipe, "--database", tmp_path / "plant.sqlite", "--mock-bad", "0")
    serials: list[str] = []
    for _ in range(2):
        run = flasher("station", "run", "--mock-sockets", "2", "--units", "2", *words, *FAST)
        assert run.code == ExitCode.OK
        serials += [unit["serial"] for unit in lines_of(run)[1]["units"]]
    assert len(set(serials)) == 4


@pytest.mark.slow
def test_scans_come_from_a_pipe_and_lines_are_for_people(
    flasher: Flasher, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("W2605002\nSOCKET 7\n"))
    words = ("--mock-sockets", "1", "--scan-by-hand", "--mock-bad", "0", "--lines", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.OK
    passed = "W2605002  PASS (virtual unit): bms: version read back. Take the unit out."
    assert f"socket 1  {passed}" in run.out
    assert "refused NO_SUCH_SOCKET" in run.out
    assert "1 unit: 1 passed, 0 failed; yield 100 %" in run.out


@pytest.mark.slow
def test_a_label_that_waits_when_the_pipe_has_ended_is_dropped(
    flasher: Flasher, recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert WAIT_LEFT_S < 5.0
    monkeypatch.setattr("flasher.cli.station.run.WAIT_LEFT_S", 0.2)
    monkeypatch.setattr("flasher.station.presence.SILENCE_S", 0.1)
    monkeypatch.setattr(sys, "stdin", io.StringIO("SOCKET A\nW2605002\n"))
    sockets = tmp_path / "sockets.toml"
    bus = 'interface = "virtual"\nchannel = "no unit is connected"\n'
    sockets.write_text(f'[[socket]]\nname = "A"\n{bus}', "utf-8")
    words = ("--recipe", recipe, "--sockets", sockets, "--database", tmp_path / "r.sqlite")
    began = time.perf_counter()
    run = flasher("station", "run", *words, "--lines")
    assert time.perf_counter() - began < 20.0, "it would be forgotten after two minutes"
    assert run.code == ExitCode.PARTIAL
    printed = "SCANS_ENDED: W2605002: The scans have ended. Scan it again when the station runs."
    assert f"refused {printed}" in run.out
    assert "refused  W2605002: SCANS_ENDED" in run.out


@pytest.mark.slow
def test_records_that_cannot_be_written_stop_the_line_and_nothing_passes(
    flasher: Flasher, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def finish(*_: object, **_more: object) -> None:
        raise DiskFullError("RECORD NOT SAVED: the disk is full.", remedy="Make room.")

    monkeypatch.setattr(Store, "finish", finish)
    words = ("--mock-sockets", "1", "--units", "2", "--mock-bad", "0", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.USAGE
    lines, document = lines_of(run)
    assert document["error"]["kind"] == "RecordError"
    assert document["error"]["remedy"] == "Make room."
    assert document["units"] == []
    shown = {line["state"] for line in lines if line["event"] == "SocketChanged"}
    assert "pass" not in shown
    assert {"RecordNotSaved", "LineStopped"} <= {line["event"] for line in lines}


@pytest.mark.slow
def test_sockets_that_can_never_work_end_the_station(
    flasher: Flasher, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken(ThreadPort):
        reported = False

        def receive(self) -> Any:
            if not self.reported:
                self.reported = True
                return AdapterDown("The recipe was changed.", is_final=True)
            raise EOFError

    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", Broken)
    run = flasher("station", "run", "--recipe", recipe, "--mock-sockets", "1", *FAST)
    assert run.code == ExitCode.BUS
    assert "The recipe was changed." in lines_of(run)[1]["error"]["what"]


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        ((), "either a station file or virtual sockets"),
        (("--mock-sockets", "65"), "1 to 64 sockets"),
        (("--mock-sockets", "2", "--mock-bad", "0.9", "--mock-slow", "0.9"), "up to more than 1"),
        (("--mock-sockets", "2", "--units", "2", "--scans", "scans.txt"), "Remove one of them"),
        (("--mock-sockets", "2", "--scans", "none.txt"), "cannot be read"),
        (("--mock-sockets", "2", "--scans", "empty.txt"), "contains no scans"),
        (("--mock-sockets", "2", "--scans", "other.txt"), "The station has no socket 9"),
        (("--sockets", "real.toml", "--units", "2"), "is for virtual units"),
        (("--mock-sockets", "2", "--badges", "badges.toml", "--operator", "Jo"), "scans a badge"),
        (("--mock-sockets", "2", "--badges", "badges.toml", "--units", "2"), "people scan"),
        (("--mock-sockets", "2", "--badges", "badges.toml"), "could be a label"),
        (("--sockets", "with_badges.toml"), "badges_of_nobody.toml"),
    ],
)
def test_wrong_usage_states_what_is_wrong(
    flasher: Flasher,
    recipe: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    reported: str,
) -> None:
    monkeypatch.chdir(recipe.parent)
    Path("scans.txt").write_text("W2605002\n", "utf-8")
    Path("empty.txt").write_text("# nothing\n", "utf-8")
    Path("other.txt").write_text("SOCKET 9\nW2605002\n", "utf-8")
    Path("real.toml").write_text(
        '[[socket]]\nname = "A"\ninterface = "virtual"\nchannel = "x"\n', "utf-8"
    )
    Path("with_badges.toml").write_text(
        'badges = "badges_of_nobody.toml"\n[[socket]]\nname = "A"\nmock = {}\n', "utf-8"
    )
    Path("badges.toml").write_text(
        '[[person]]\nname = "Jo"\ncode = "W2605002"\nrole = "operator"\n', "utf-8"
    )
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.USAGE
    assert reported in run.err
    assert "Traceback" not in run.err


# -- badges ----------------------------------------------------------------------------------------


@pytest.fixture
def badges(recipe: Path) -> Path:
    """A supervisor with the PIN 470815."""
    made = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash("470815")
    path = recipe.parent / "badges.toml"
    text = f'[[person]]\nname = "Sue"\ncode = "BADGE-1"\nrole = "supervisor"\npin = "{made}"\n'
    path.write_text(text, "utf-8")
    return path


@pytest.mark.slow
def test_with_badges_nothing_begins_before_one_is_scanned(
    flasher: Flasher, recipe: Path, badges: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = "W2605002\nBADGE-1\nW2605002\nREASON x\n470815\n"
    monkeypatch.setattr(sys, "stdin", io.StringIO(scans))
    words = ("--mock-sockets", "1", "--badges", badges, "--mock-bad", "0", "--lines", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert "refused NOBODY: W2605002" in run.out
    assert "W2605002  PASS (virtual unit)" in run.out
    assert ">>> REASON x: type the PIN of Sue within 30 s" in run.out
    assert "No badge table" not in run.out
    assert "470815" not in run.out + run.err


@pytest.mark.slow
def test_without_badges_it_is_reported_once(flasher: Flasher, recipe: Path) -> None:
    words = ("--mock-sockets", "1", "--units", "1", "--mock-bad", "0", "--lines", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.out.count("No badge table: operator names are not checked.") == 1


@pytest.mark.slow
def test_a_badge_in_a_file_of_scans_is_no_label(
    flasher: Flasher, recipe: Path, badges: Path
) -> None:
    scans = recipe.parent / "scans.txt"
    scans.write_text("BADGE-1\nW2605002\n", "utf-8")
    words = ("--mock-sockets", "1", "--badges", badges, "--mock-bad", "0", "--scans", scans, *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.OK
    assert [unit["serial"] for unit in lines_of(run)[1]["units"]] == ["W2605002"]


@pytest.mark.slow
def test_the_hash_of_a_typed_pin_is_printed(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, schema: dict[str, Any]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("470815\n"))
    run = flasher("station", "pin", "--json")
    hold_output(schema, run.out, 0)
    assert is_right(Pin("470815"), run.document["pin"])
    assert "470815" not in run.out + run.err
    monkeypatch.setattr(sys, "stdin", io.StringIO("4708x\n"))
    run = flasher("station", "pin")
    assert run.code == ExitCode.USAGE
    assert "4 to 12 digits" in run.err
    assert "4708x" not in run.out + run.err


@pytest.mark.slow
def test_a_pin_on_a_terminal_is_typed_twice_without_echo(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    typed = iter(["470815", "470816", "470815", "470815"])
    keys = io.StringIO()
    monkeypatch.setattr(keys, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", keys)
    monkeypatch.setattr("getpass.getpass", lambda _prompt: next(typed))
    run = flasher("station", "pin")
    assert run.code == ExitCode.USAGE
    assert "PINs differ" in run.err
    run = flasher("station", "pin")
    assert is_right(Pin("470815"), run.out.strip())


@pytest.mark.slow
def test_a_passphrase_whose_input_ends_is_a_wrong_one(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(_prompt: str) -> str:
        raise EOFError

    sealed = tmp_path / "line-2.sealed"
    seal(sealed, {"station.toml": b""}, "right horse battery")
    keys = io.StringIO()
    monkeypatch.setattr(keys, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stdin", keys)
    monkeypatch.setattr("getpass.getpass", end)
    spare = tmp_path / "spare.toml"
    run = flasher(
        "station", "take-over", "--sockets", spare, "--from", sealed, "--reason", "broken",
        "--database", "postgresql://reader@127.0.0.1:1/flasher",
    )  # fmt: skip
    assert run.code == ExitCode.VERIFICATION
    assert not spare.exists()


# -- records ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records: a unit that failed and then passed, another one that is bad."""
    folder = tmp_path_factory.mktemp("plant")
    bench = Bench(folder)
    bench.make(RunState.FAIL)
    bench.store.step(bench.claim().run_id, "connect", StepState.FAIL, duration_s=1.0)
    bench.store.close()
    # The process of a station died here: the next one finds it.
    bench.store = bench.opened()
    bench.store.recover()
    bench.make()
    bench.make(RunState.FAIL, "W2605003", code="REFUSED")
    bench.store.close()
    return folder / "records.sqlite"


@pytest.mark.slow
def test_a_report_has_figures_on_stdout_and_files_for_others(
    flasher: Flasher, plant: Path, tmp_path: Path
) -> None:
    files = {name: tmp_path / name for name in ("runs.csv", "runs.json", "runs.xml")}
    run = flasher(
        "station", "report", "--database", plant, "--csv", files["runs.csv"],
        "--json-report", files["runs.json"], "--junit", files["runs.xml"],
        "--certificates", tmp_path / "pages",
    )  # fmt: skip
    assert run.code == ExitCode.OK
    assert "2 units: 1 passed, 1 failed; yield 50 %, first pass 0 %" in run.out
    assert "1 INTERRUPTED" in run.out
    assert len(list(csv.DictReader(files["runs.csv"].read_text("utf-8").splitlines()))) == 4
    assert json.loads(files["runs.json"].read_text("utf-8"))["figures"]["units"] == 2
    assert Xml.parse(files["runs.xml"]).getroot().find("testsuite") is not None  # noqa: S314
    pages = sorted(page.name for page in (tmp_path / "pages").iterdir())
    assert pages == [f"{SERIAL}.html", "W2605003.html"]
    assert "Flash certificate" in (tmp_path / "pages" / f"{SERIAL}.html").read_text("utf-8")


@pytest.mark.slow
def test_a_report_can_be_narrowed(flasher: Flasher, plant: Path) -> None:
    words = ("station", "report", "--database", plant, "--json")
    assert len(flasher(*words, "--serial", "W2605003").document["runs"]) == 1
    assert flasher(*words, "--since", "2027-01-01").document["runs"] == []
    assert len(flasher(*words, "--until", "2027-01-01T06:00").document["runs"]) == 4
    wrong = flasher(*words, "--since", "yesterday")
    assert wrong.code == ExitCode.USAGE
    assert wrong.document["error"]["where"] == "--since"
    for until in ("2026-05-16", "2026-05-17"):
        empty = flasher(*words, "--since", "2026-05-17", "--until", until)
        assert (empty.code, empty.document["error"]["where"]) == (ExitCode.USAGE, "--until")


@pytest.mark.slow
def test_the_whole_life_of_a_unit_with_its_traces(
    flasher: Flasher, plant: Path, tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    run = flasher("station", "unit", SERIAL, "--database", plant, "--certificate", page)
    assert run.code == ExitCode.OK
    first, *_ = run.out.splitlines()
    assert first == f"{SERIAL}, part BAT-36: PASS"
    assert [
        line.split(": ")[1].split()[0] for line in run.out.splitlines() if line[:4] == "run "
    ] == [
        "FAIL",
        "INTERRUPTED",
        "PASS",
    ]
    assert "reported complete, and is running version" in run.out
    assert SERIAL in page.read_text("utf-8")
    full = flasher("station", "unit", SERIAL, "--database", plant, "--story")
    assert "  | verdict: completed" in full.out


@pytest.mark.slow
def test_json_of_the_records_is_as_described(
    flasher: Flasher, plant: Path, tmp_path: Path, schema: dict[str, Any]
) -> None:
    for words in (
        ("report",),
        ("unit", SERIAL, "--story"),
        ("verify",),
        ("backup", tmp_path / "copy.sqlite"),
    ):
        run = flasher("station", *words, "--database", plant, "--json")
        hold_output(schema, run.out, 0)
    unit = flasher("station", "unit", SERIAL, "--database", plant, "--json").document
    assert unit["unit"]["runs"][2]["run"]["state"] == "pass"
    assert unit["traces"][0]["cause"] == "completed"


def test_a_backup_is_a_whole_copy(flasher: Flasher, plant: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.sqlite"
    assert flasher("station", "backup", copy, "--database", plant).code == ExitCode.OK
    assert flasher("station", "verify", "--database", copy).code == ExitCode.OK
    nowhere = flasher("station", "backup", tmp_path / "no" / "copy", "--database", plant)
    assert nowhere.code == ExitCode.USAGE


def test_a_changed_attachment_is_found(
    flasher: Flasher, plant: Path, tmp_path: Path, schema: dict[str, Any]
) -> None:
    copy = tmp_path / "copy.sqlite"
    flasher("station", "backup", copy, "--database", plant)
    for trace in tmp_path.glob("copy.sqlite.files/*/*"):
        trace.write_bytes(b"another one")
    run = flasher("station", "verify", "--database", copy)
    assert run.code == ExitCode.VERIFICATION
    assert "its hash differs" in run.out
    printed = flasher("station", "verify", "--database", copy, "--json")
    hold(schema, "document.station", printed.document)
    unit = flasher("station", "unit", SERIAL, "--database", copy)
    assert unit.code == ExitCode.OK
    assert "its hash differs" in unit.out


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (("unit", "W0000000"), "no unit W0000000"),
        (("report", "--database", "none.sqlite"), "no records"),
        (("report", "--csv", "no/folder.csv"), "folder does not exist"),
    ],
)
def test_what_is_not_there_is_reported(
    flasher: Flasher, plant: Path, words: tuple[str, ...], reported: str
) -> None:
    database = () if "--database" in words else ("--database", str(plant))
    run = flasher("station", *words, *database)
    assert run.code == ExitCode.USAGE
    assert reported in run.err


def test_an_action_has_to_be_named() -> None:
    assert main(["station"]) == ExitCode.USAGE


# -- the guide -------------------------------------------------------------------------------------

DOCS = Path(__file__).parents[2] / "docs"


@each("model", [Recipe, StationConfig, BadgeTable])
def test_every_key_states_what_it_is(model: type[TomlTable]) -> None:
    tables = [model]
    for table in tables:
        for name, field in table.model_fields.items():
            tables += [part for part in parts_in(field.annotation) if part not in tables]
            assert field.description or parts_in(field.annotation), f"{table.__name__}.{name}"
    assert len(tables) > 1


def parts_in(annotation: Any) -> list[type[TomlTable]]:
    """The tables of a recipe in the type of a key."""
    if isinstance(annotation, type) and issubclass(annotation, TomlTable):
        return [annotation]
    return [part for argument in get_args(annotation) for part in parts_in(argument)]


def test_the_guide_shows_the_sample_recipe_and_every_word_of_a_socket() -> None:
    assert RECIPE.read_text(encoding="utf-8") in (DOCS / "how-to" / "station_recipe.md").read_text()
    guide = (DOCS / "how-to" / "station_operator.md").read_text(encoding="utf-8")
    assert all(f"| {state.value} |" in guide for state in SocketState)
    assert all(f"`{word.value}" in guide for word in Word)


# -- Ctrl-C ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_ctrl_c_finishes_what_runs_and_begins_no_further_unit(
    flasher: Flasher, recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    press_when(monkeypatch, "RunStarted", times=1)
    words = ("--mock-sockets", "1", "--units", "3", "--mock-bad", "0", *FAST)
    run = flasher("station", "run", "--recipe", recipe, *words)
    assert run.code == ExitCode.INTERRUPTED
    document = lines_of(run)[1]
    assert [unit["state"] for unit in document["units"]] == ["pass"]
    assert not document["is_complete"]
    assert "Ctrl-C again" in run.err


@pytest.mark.slow
def test_a_second_ctrl_c_stops_the_runs_which_are_recorded_as_aborted(
    flasher: Flasher, recipe: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    press_when(monkeypatch, "RunStarted", times=2)
    database = tmp_path / "plant.sqlite"
    slow = ("--mock-sockets", "1", "--mock-bad", "0", "--mock-dead", "0", "--mock-speed", "9")
    run = flasher("station", "run", "--recipe", recipe, *slow, "--database", database)
    assert run.code == ExitCode.INTERRUPTED
    (unit,) = lines_of(run)[1]["units"]
    assert (unit["state"], unit["code"]) == ("aborted", "OPERATOR_ABORT")
    with Store.open(str(database), station="reader", create=False) as store:
        assert [each.state for each in store.read.table()] == [RunState.ABORTED]


def press_when(monkeypatch: pytest.MonkeyPatch, event: str, *, times: int) -> None:
    """Press Ctrl-C after the first event of this class, and again when a later step begins."""
    left = [times]
    seen: list[str] = []
    show, refresh = JsonLines.show, JsonLines.refresh

    def press() -> None:
        if event in seen and left[0]:
            left[0] -= 1
            signal.raise_signal(signal.SIGINT)

    def showing(self: JsonLines, shown: StationEvent) -> None:
        seen.append(type(shown).__name__)
        show(self, shown)
        if left[0] < times and isinstance(shown, StepStarted):
            press()

    def refreshing(self: JsonLines) -> None:
        refresh(self)
        press()

    monkeypatch.setattr(JsonLines, "show", showing)
    monkeypatch.setattr(JsonLines, "refresh", refreshing)


@pytest.mark.slow
def test_virtual_units_stay_out_of_records_of_real_ones(flasher: Flasher, tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.make()
    bench.store.close()
    place = ("--recipe", tmp_path / "recipe.toml", "--database", bench.path)
    words = (*place, "--units", "1", "--mock-bad", "0", *FAST)
    refused = flasher("station", "run", "--mock-sockets", "1", *words)
    assert refused.code == ExitCode.USAGE
    assert "hold real units" in refused.err + refused.out
    asked = flasher("station", "run", "--mock-sockets", "1", "--mix-virtual", *words)
    assert asked.code == ExitCode.OK
    (unit,) = lines_of(asked)[1]["units"]
    assert unit["is_virtual"]
    printed = flasher("station", "unit", unit["serial"], "--database", bench.path)
    assert "PASS, a VIRTUAL unit, no product" in printed.out
    report = flasher("station", "report", "--database", bench.path)
    assert "VIRTUAL:  1 run of virtual units, no products" in report.out
