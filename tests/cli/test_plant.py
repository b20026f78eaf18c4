"""`flasher plant`: database and roles, the state of the stations, sending."""

from __future__ import annotations

import errno
import io
import json
import multiprocessing
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

from flasher.cli.main import main
from flasher.errors import ExitCode
from flasher.plant.process import Sending, sending
from flasher.plant.schema import PLANT_SCHEMA
from flasher.protocol.spec import BMS
from flasher.station.records.errors import RecordError
from flasher.station.records.overview import Overview
from tests.cli.conftest import Flasher
from tests.cli.station_threads import ThreadPort
from tests.cli.test_main import broken_pipe, posix_pipes
from tests.cli.test_schema import hold_output
from tests.loops import each
from tests.plant.conftest import plant, sender
from tests.plant.factory import PASSWORD, Plant, Sender
from tests.plant.old_databases import make_old
from tests.schema_document import SCHEMA
from tests.station.factory import IMAGES, USUAL, write_recipe
from tests.station.postgres import Server

__all__ = ["plant", "sender"]
pytestmark = pytest.mark.slow
BMS_SHA256 = IMAGES[BMS].sha256
BADGES = '[[person]]\nname = "Jo"\ncode = "B1"\nrole = "rework"\n'
STATION = """\
name = "line-2"
plant = "{plant}"

[[socket]]
name = "A"
mock = {{ bad = 0.0, seed = 7 }}
"""


def test_init_creates_what_is_missing_and_prints_the_rest(
    flasher: Flasher, postgres: Server
) -> None:
    url = postgres.url("plant_by_command").replace("+psycopg", "")
    of_role = url.replace("postgres@", "flasher_line_8@")
    run = flasher("plant", "init", "--database", url, "--station", "line 8")
    assert run.code == ExitCode.OK
    assert run.out.splitlines() == [
        "created the database plant_by_command",
        "created the tables",
        "line 8: created its role, flasher_line_8",
        "-- in psql, a password for each new role (stations read theirs from ~/.pgpass):",
        "\\password flasher_line_8",
        "# in pg_hba.conf, above lines that allow more:",
        "hostssl plant_by_command flasher_line_8 samenet scram-sha-256",
        "-- then, in psql:",
        "SELECT pg_reload_conf();",
        "# in the station file of line 8:",
        f'plant = "{of_role}?sslmode=verify-full"',
    ]
    again = flasher("plant", "init", "--database", url, "--station", "line 8", "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), again.out, again.code)
    assert again.document["is_new"] is False
    assert not any("password" in line for line in again.document["to_run"])


def test_init_prints_each_step_from_an_empty_server_on(flasher: Flasher) -> None:
    url = f"postgresql://Owner:{PASSWORD}@plant-db/flasher"
    run = flasher("plant", "init", "--database", url, "--station", "line 8", "--print")
    assert run.out.splitlines()[:11] == [
        "-- as an administrator of the server (psql postgres):",
        'CREATE ROLE "Owner" LOGIN CREATEROLE;',
        '\\password "Owner"',
        'CREATE DATABASE "flasher" OWNER "Owner";',
        "# in pg_hba.conf, above lines that allow more:",
        "hostssl flasher,postgres Owner samenet scram-sha-256",
        "-- then, in psql:",
        "SELECT pg_reload_conf();",
        "# then, which creates the tables and the roles of the stations:",
        "flasher plant init --database postgresql://Owner@plant-db/flasher --station 'line 8'",
        "-- in psql, a password for each new role (stations read theirs from ~/.pgpass):",
    ]
    none = flasher("plant", "init", "--database", "postgresql://x@plant-db", "--print")
    assert none.code == ExitCode.USAGE
    assert "The URL names no database" in none.err


def test_a_database_without_the_plants_tables_is_named(flasher: Flasher, postgres: Server) -> None:
    run = flasher("plant", "status", "--database", postgres.url(postgres.database()))
    assert run.code == ExitCode.USAGE
    assert "a table is not in the database" in run.err
    assert "flasher plant init" in run.err


_READING: dict[str, tuple[str, ...]] = {
    "status": (),
    "report": (),
    "verify": (),
    "units": ("--image", BMS_SHA256),
    "pages": ("--web", "0"),
    "recipes": (),
    "withdraw": ("0123", "--reason", "x"),
    "deliveries": (),
    "claims": (),
    "reconcile": ("list.json", "--receiver", "mes"),
    "deliver": ("--receivers", "receivers.toml", "--once"),
    "retire": ("--archive", "archive", "--before", "2026-06"),
}


@each("action", _READING)
def test_tables_of_another_flasher_are_refused_with_the_next_step(
    flasher: Flasher, plant: Plant, action: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("list.json").write_text("[]", "utf-8")
    receiver = '[[receiver]]\nname = "mes"\nurl = "http://127.0.0.1:1/"\n'
    Path("receivers.toml").write_text(receiver, "utf-8")
    of_this = int(PLANT_SCHEMA)
    for found, step in ((of_this - 1, "flasher plant init"), (of_this + 1, "Update flasher")):
        with plant.connect() as owner:
            owner.execute("UPDATE plant_version SET version_num = %s", [str(found)])
        run = flasher("plant", action, *_READING[action], "--database", plant.url())
        assert (run.code, run.out) == (ExitCode.USAGE, "")
        assert f"has schema {found}; this flasher has schema {PLANT_SCHEMA}" in run.err
        assert "E215" in run.err
        assert step in run.err
        assert "delivers to" not in run.err


def test_init_names_the_schemas_of_an_upgrade(flasher: Flasher, plant: Plant) -> None:
    make_old(plant, 2)
    words = ("plant", "init", "--database", plant.url())
    assert flasher(*words).out == f"upgraded the tables from schema 2 to {PLANT_SCHEMA}\n"
    assert flasher(*words).out == "the tables are up to date\n"


@pytest.mark.parametrize("action", ["report", "verify", "retire", "deliveries"])
def test_an_empty_database_is_no_database_of_another_version(
    flasher: Flasher, postgres: Server, action: str
) -> None:
    url = postgres.url(postgres.database())
    run = flasher("plant", action, *_READING[action], "--database", url)
    assert (run.code, run.out) == (ExitCode.USAGE, "")
    assert "a table is not in the database" in run.err
    assert "flasher plant init" in run.err
    assert "E215" not in run.err


def test_a_wrong_url_of_the_plant_is_refused_before_the_first_unit(
    flasher: Flasher, tmp_path: Path
) -> None:
    file = tmp_path / "station.toml"
    file.write_text('keys = "keys"\n' + STATION.format(plant="mysql://x/y"), encoding="utf-8")
    words = ("--recipe", write_recipe(tmp_path, USUAL), "--sockets", file, "--units", "1")
    run = flasher("station", "run", *words, "--operator", "jo")
    assert run.code == ExitCode.USAGE
    assert "mysql" in run.err


def test_status_and_send(flasher: Flasher, plant: Plant) -> None:
    url = plant.url("flasher_desk")
    never = flasher("plant", "status", "--database", url)
    assert never.out.splitlines() == [
        "line-2: has never connected", "line-3: has never connected",
    ]  # fmt: skip
    made = plant.sender("line-2")
    made.bench.make()
    made.close()
    file = made.folder / "station.toml"
    keys = 'keys = "keys"\n'
    file.write_text(keys + STATION.format(plant=plant.url("flasher_line_2")), encoding="utf-8")
    sent = flasher("plant", "send", "--sockets", file)
    assert (sent.code, sent.out) == (ExitCode.OK, "everything is sent: 4 rows\n")
    run = flasher("plant", "status", "--database", url)
    assert run.code == ExitCode.OK
    first, row, *_ = run.out.splitlines()
    assert first.startswith("line-2: reported ")
    assert row.startswith("  last row:  4, of 2026-05-17T09:00:08")
    both = flasher("plant", "status", "--database", url, "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), both.out, both.code)
    assert PASSWORD not in both.out + run.out + sent.out + sent.err
    station = both.document["stations"][0]
    assert (station["status"]["station"], station["state"]) == ("line-2", "unknown")
    assert station["checks"][0] == {
        "kind": "refused", "state": "ok", "text": "its records are accepted",
    }  # fmt: skip
    assert re.search(r"^  disk:      [0-9.]+ GiB free$", run.out, re.MULTILINE)
    assert "  not known: yield: too few units in this shift: 0 of 20" in run.out.splitlines()
    alert = flasher("plant", "status", "--database", url, "--silent", "0")
    assert alert.code == ExitCode.PARTIAL
    assert alert.out.splitlines()[-1].startswith("ALERT line-2: silent for ")


def test_what_is_wrong_with_the_options_is_found_before_the_server_is_asked(
    flasher: Flasher, tmp_path: Path
) -> None:
    away = ("plant", "report", "--database", "postgresql://desk:s3cr3t@127.0.0.1:1/plant")
    assert "'soon' is not a time" in flasher(*away, "--since", "soon").err
    nowhere = tmp_path / "nowhere" / "m.csv"
    assert "--measurements" in flasher(*away, "--measurements", nowhere).err
    run = flasher(*away)
    assert "where: postgresql://desk:***@127.0.0.1:1/plant" in run.err


def test_a_refused_chain_is_named_by_send_and_by_status(
    flasher: Flasher, plant: Plant, sender: Sender
) -> None:
    sender.bench.make()
    sender.close()
    file = sender.folder / "station.toml"
    text = STATION.format(plant=plant.url("flasher_line_3"))
    file.write_text(text, encoding="utf-8")
    run = flasher("plant", "send", "--sockets", file)
    assert run.code == ExitCode.USAGE
    assert "refuses this station's audit trail, foreign" in run.err
    assert PASSWORD not in run.err
    status = flasher("plant", "status", "--database", plant.url("flasher_desk"))
    assert status.code == ExitCode.VERIFICATION
    assert "  REFUSED: foreign: the user flasher_line_3 is not the user of station line-2" in (
        status.out.splitlines()
    )


def test_a_station_file_without_a_plant_states_what_to_add(
    flasher: Flasher, tmp_path: Path
) -> None:
    file = tmp_path / "station.toml"
    file.write_text(STATION.replace('plant = "{plant}"\n', "").format(), encoding="utf-8")
    run = flasher("plant", "send", "--sockets", file)
    assert run.code == ExitCode.USAGE
    assert "names no plant" in run.err


def test_a_server_that_is_away_is_named_without_the_password(flasher: Flasher) -> None:
    run = flasher("plant", "status", "--database", f"postgresql://x:{PASSWORD}@127.0.0.1:1/plant")
    assert run.code == ExitCode.USAGE
    assert "The plant's database cannot be read" in run.err
    assert PASSWORD not in run.err


@pytest.mark.parametrize(
    ("of", "cause"),
    [
        ("flasher_line_2:wrong", 'password authentication failed for user "flasher_line_2"'),
        ("no-one:x", 'password authentication failed for user "no-one"'),
        ("flasher_line_2", "no password supplied"),
    ],
)
def test_a_server_that_refuses_a_user_is_not_one_that_is_away(
    flasher: Flasher, plant: Plant, of: str, cause: str
) -> None:
    url = f"postgresql://{of}@127.0.0.1:{plant.server.port}/{plant.database}"
    run = flasher("plant", "status", "--database", url)
    assert run.code == ExitCode.USAGE
    assert "the database server refuses the connection" in run.err
    assert cause in run.err
    assert "pg_hba.conf" in run.err


def test_a_database_that_is_not_there_is_named(flasher: Flasher, postgres: Server) -> None:
    url = postgres.url("nowhere").replace("+psycopg", "")
    run = flasher("plant", "status", "--database", url)
    assert "the database server refuses the connection" in run.err
    assert 'database "nowhere" does not exist' in run.err


def test_a_station_sends_while_it_runs(
    flasher: Flasher, plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The forwarder is a real process, which takes its time to start on a busy computer."""
    monkeypatch.setattr("flasher.plant.process._END_S", 60.0)
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    file = tmp_path / "station.toml"
    text = 'keys = "keys"\n' + STATION.format(plant=plant.url("flasher_line_2"))
    file.write_text(text, encoding="utf-8")
    recipe = write_recipe(tmp_path, USUAL)
    words = ("station", "run", "--recipe", recipe, "--sockets", file, "--units", "2")
    run = flasher(*words, "--mock-speed", "0", "--operator", "jo")
    assert run.code == ExitCode.OK, run.err
    assert plant.rows("SELECT state, count(*) FROM run GROUP BY state") == [("PASS", 2)]
    with closing(sqlite3.connect(tmp_path / "records.sqlite")) as records:
        hashes = records.execute("SELECT hash FROM audit ORDER BY number").fetchall()
    assert plant.rows("SELECT hash FROM chain_row ORDER BY number") == hashes


def test_a_station_without_the_server_passes_its_units(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    file = tmp_path / "station.toml"
    text = STATION.format(plant="postgresql://x@127.0.0.1:1/plant")
    file.write_text('keys = "keys"\n' + text, encoding="utf-8")
    recipe = write_recipe(tmp_path, USUAL)
    words = ("station", "run", "--recipe", recipe, "--sockets", file, "--units", "1")
    run = flasher(*words, "--mock-speed", "0", "--operator", "jo")
    assert run.code == ExitCode.OK, run.err


def test_the_process_ends_with_a_station_that_had_no_records(tmp_path: Path) -> None:
    with sending(Sending("postgresql://x@127.0.0.1:1/p", "line-2", str(tmp_path / "no"), None)):
        pass


def test_the_process_leaves_without_a_clean_up_as_the_station_waits_for_it(tmp_path: Path) -> None:
    program = (
        "import atexit, multiprocessing, sys; from flasher.plant.process import Sending, _work;"
        "atexit.register(print, 'cleaned up'); ours, theirs = multiprocessing.Pipe(); ours.close();"
        "_work(theirs, Sending('postgresql://x@127.0.0.1:1/p', 'line-2', sys.argv[1], None))"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "no")]
    ended = subprocess.run(command, check=True, capture_output=True, text=True)
    assert ended.stdout == ""


def test_what_reads_all_stations(flasher: Flasher, plant: Plant, sender: Sender) -> None:
    sender.bench.make()
    sender.send()
    database = ("--database", plant.url("flasher_desk"))
    units = flasher("plant", "units", "--image", "V1r0r4_20220512", *database)
    assert units.out.splitlines()[1:] == [
        "  W2605002, part BAT-36: bms, 2026-05-17, PASS", "1 unit",
    ]  # fmt: skip
    report = flasher("plant", "report", *database)
    assert "1 unit" in report.out
    verify = flasher("plant", "verify", *database)
    assert verify.code == ExitCode.OK
    first, row, last = verify.out.splitlines()
    assert first == ("1 run and 1 trace of runs that passed agree with the signed audit trails")
    assert row.startswith("  line-2: 4 rows to 2026-05-17T09:00:08.000000Z, signed with ")
    assert "flasher station key" in last
    for words in (("units", "--image", BMS_SHA256[:12]), ("report",), ("verify",)):
        run = flasher("plant", *words, *database, "--json")
        hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
    with plant.connect() as owner:
        owner.execute("UPDATE step SET duration_s = 3")
    changed = flasher("plant", "verify", *database)
    assert changed.code == ExitCode.VERIFICATION
    assert changed.out.startswith("line-2, run 1: what reports and pages show differs")
    none = flasher("plant", "units", "--image", "V9", *database)
    assert "No station has used an image V9" in none.err


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_units_are_printed_while_they_are_read(
    flasher: Flasher,
    plant: Plant,
    sender: Sender,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    """The server is lost after two of three pages."""
    for number in range(3):
        sender.bench.make(serial=f"W260500{number}")
    sender.send()
    command = ("plant", "units", "--image", BMS_SHA256, "--database", plant.url("flasher_desk"))
    monkeypatch.setattr("flasher.cli.plant.reading._AT_ONCE", 1)
    schema = json.loads(SCHEMA.read_text("utf-8"))
    whole = flasher(*command, *words)
    if words:
        hold_output(schema, whole.out, whole.code)
        assert len(json.loads(whole.out)["units"]) == 3
    holders, calls = Overview.holders, iter((1, 2))

    def lost(*asked: Any) -> Any:
        if next(calls, None) is None:
            raise RecordError("The plant's database cannot be read: the server ended.")
        return holders(*asked)

    monkeypatch.setattr(Overview, "holders", lost)
    cut = flasher(*command, *words)
    assert cut.code == ExitCode.USAGE
    if words:
        hold_output(schema, cut.out, cut.code)
        document = json.loads(cut.out)
        assert [each["serial"] for each in document["units"]] == ["W2605002", "W2605001"]
        assert document["error"]["what"].endswith("the server ended.")
    else:
        assert cut.out.splitlines() == whole.out.splitlines()[:3]


@posix_pipes
@pytest.mark.parametrize("words", [(), ("--json",)])
def test_units_that_no_reader_wants_are_not_read(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    for number in range(3):
        sender.bench.make(serial=f"W260500{number}")
    sender.send()
    pages: list[object] = []
    holders = Overview.holders

    def counted(*asked: Any) -> Any:
        pages.append(asked)
        return holders(*asked)

    monkeypatch.setattr("flasher.cli.plant.reading._AT_ONCE", 1)
    monkeypatch.setattr(Overview, "holders", counted)
    with broken_pipe() as stream:
        monkeypatch.setattr("sys.stdout", stream)
        command = ("plant", "units", "--image", BMS_SHA256, "--database")
        assert main((*command, plant.url("flasher_desk"), *words)) == ExitCode.OK
    assert len(pages) == 1


def test_a_process_that_cannot_start_now_or_is_killed_is_started_again(
    plant: Plant, sender: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    sender.bench.make()
    sender.end()
    usual, failures = SpawnProcess.start, [OSError(errno.EAGAIN, "no process is free")]

    def start(process: SpawnProcess) -> None:
        if failures:
            raise failures.pop()
        usual(process)

    monkeypatch.setattr(SpawnProcess, "start", start)
    before = set(multiprocessing.active_children())
    with sending(Sending(plant.url("flasher_line_2"), "line-2", str(sender.bench.path), None)):
        first = _appeared(before)
        assert not failures
        first.kill()
        assert _appeared(before | {first}).pid != first.pid
        wait_until(lambda: plant.rows("SELECT count(*) FROM run") == [(1,)])


def wait_until(is_so: Callable[[], bool], limit_s: float = 60.0) -> None:
    end_s = time.perf_counter() + limit_s
    while not is_so():
        assert time.perf_counter() < end_s
        time.sleep(0.1)


def _appeared(before: set[BaseProcess]) -> BaseProcess:
    """The process that appears besides those."""
    wait_until(lambda: bool(set(multiprocessing.active_children()) - before))
    (found,) = set(multiprocessing.active_children()) - before
    return found


# -- connections -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://jo:s3cr3t@{place}/records",
        "postgresql://jo:s3cr3t%40x@{place}/records",
        "postgresql://jo:s3cr3t@x@{place}/records",
        "postgresql://jo:x/s3cr3t@{place}/records",
        "postgresql://j/o:s3cr3t@{place}/records",
        "postgresql://jo:s3cr3t@{place}x/records",
        "postgresql://jo:s3cr3t/records",
        "postgresql://jo@{place}/records?password=s3cr3t",
        "postgresql://jo:s3cr3t@{place}/records?connect_timeout=x",
        "postgresql+none://jo:s3cr3t@{place}/records",
        "postgresql:/jo:s3cr3t@{place}/records",
    ],
)
def test_a_password_is_in_no_message_log_or_document(
    flasher: Flasher, postgres: Server, tmp_path: Path, url: str
) -> None:
    place = f"127.0.0.1:{postgres.port}"
    log = tmp_path / "log"
    for command in (("plant", "status"), ("station", "report")):
        for more in (("--database",), ("--json", "--database")):
            run = flasher("--log-file", log, "-vv", *command, *more, url.format(place=place))
            assert run.code == ExitCode.USAGE
            shown = run.out + run.err + log.read_text(encoding="utf-8")
            assert "s3cr3t" not in shown
            assert "Traceback" not in shown
    assert "station report" in log.read_text(encoding="utf-8")


def test_a_driver_that_is_not_installed_is_named_with_how_to_install_it(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "flasher.station.records.server", raising=False)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    run = flasher("plant", "status", "--database", "postgresql://jo@127.0.0.1/records", "--json")
    assert run.code == ExitCode.USAGE
    assert "'.[plant]'" in run.document["error"]["remedy"]


def test_records_of_a_station_are_not_on_a_server(flasher: Flasher, tmp_path: Path) -> None:
    sockets = tmp_path / "station.toml"
    url = "postgresql://flasher_station@plant-db/flasher"
    text = STATION.format(plant=url).replace(
        'name = "line-2"', f'name = "line-2"\nrecords = "{url}"'
    )
    sockets.write_text(text, encoding="utf-8")
    for words in (
        ("verify", "--sockets", sockets),
        ("upgrade", "--sockets", sockets),
        ("report", "--database", url),
        ("report", "--database", url, "--files", tmp_path),
    ):
        run = flasher("station", *words, "--json")
        assert run.code == ExitCode.USAGE
        assert "in a file on its own PC" in run.document["error"]["what"]
        assert "flasher plant report" in run.document["error"]["remedy"]


# -- a spare PC ------------------------------------------------------------------------------------

PASSPHRASE = "correct horse battery"  # noqa: S105  of an export that the test makes


@dataclass
class Export:
    """A sealed export of line-2, whose plant has a run and an active run."""

    flasher: Flasher
    sender: Sender
    folder: Path
    file: Path = field(init=False)
    """The station file."""

    def __post_init__(self) -> None:
        old = self.sender.bench
        self.file = self.sender.folder / "station.toml"
        url = self.sender.plant.url("flasher_line_2")
        text = f'keys = "keys"\nbadges = "badges.toml"\n{STATION.format(plant=url)}'
        self.file.write_text(text, encoding="utf-8")
        (self.sender.folder / "badges.toml").write_text(BADGES, encoding="utf-8")
        old.make(serial="W2605001")
        old.claim("W2605004", "B")
        self.sender.send()
        old.store.close()
        self.sealed = self.folder / "line-2.sealed"
        self.spare = self.folder / "spare" / "station.toml"

    def secret(self, passphrase: str = PASSPHRASE) -> tuple[str, Path]:
        path = self.folder / "passphrase"
        path.write_text(passphrase, encoding="utf-8")
        return "--passphrase-file", path

    def make(self, *words: object, passphrase: str = PASSPHRASE) -> Any:
        secret = self.secret(passphrase)
        return self.flasher(
            "station", "export", self.sealed, "--sockets", self.file, *words, *secret
        )

    def take_over(self, sockets: Path, *words: object) -> Any:
        url = self.sender.plant.url("flasher_desk")
        place = ("--sockets", sockets, "--database", url, "--reason", "broken")
        return self.flasher("station", "take-over", *place, *words)


@pytest.fixture
def exported(flasher: Flasher, sender: Sender, tmp_path: Path) -> Export:
    return Export(flasher, sender, tmp_path)


def test_an_export_has_the_settings_and_the_key(exported: Export) -> None:
    run = exported.make(passphrase="short")  # noqa: S106  refused
    assert (run.code, exported.sealed.exists()) == (ExitCode.USAGE, False)
    recipe = exported.sender.folder / "recipe.toml"
    run = exported.make("--recipe", recipe, "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, 0)
    assert run.document["members"] == [
        "badges.toml", "bms.bin", "bms.bin.toml", "recipe.toml", "signing.key", "station.toml",
    ]  # fmt: skip
    assert b"PRIVATE KEY" not in exported.sealed.read_bytes()


def test_an_export_that_cannot_be_opened_changes_nothing(exported: Export) -> None:
    exported.make()
    half, other = exported.folder / "half.sealed", exported.folder / "other.sealed"
    half.write_bytes(exported.sealed.read_bytes()[:-1])
    other.write_bytes(b"something else")
    for path, phrase, code in (
        (exported.sealed, "wrong horse battery", ExitCode.VERIFICATION),
        (half, PASSPHRASE, ExitCode.VERIFICATION),
        (other, PASSPHRASE, ExitCode.USAGE),
        (exported.folder / "none", PASSPHRASE, ExitCode.USAGE),
    ):
        run = exported.take_over(exported.spare, "--from", path, *exported.secret(phrase))
        assert run.code == code
        assert not exported.spare.parent.exists()
    assert exported.sender.plant.rows("SELECT count(*) FROM open_run") == [(1,)]


def test_a_takeover_names_the_option_for_retired_months(exported: Export) -> None:
    plant, archive = exported.sender.plant, exported.folder / "archive"
    exported.make()
    place = ("--database", plant.url(), "--archive", archive, "--before", "2026-06")
    assert exported.flasher("plant", "retire", *place).code == ExitCode.OK
    words = (exported.spare, "--from", exported.sealed, *exported.secret())
    run = exported.take_over(*words)
    assert (run.code, "--archive" in run.err) == (ExitCode.USAGE, True)
    run = exported.take_over(*words, "--archive", archive)
    assert (run.code, run.err) == (ExitCode.OK, "")


def test_a_spare_pc_continues_a_station_with_its_export(exported: Export) -> None:
    flasher, schema = exported.flasher, json.loads(SCHEMA.read_text("utf-8"))
    url = exported.sender.plant.url("flasher_desk")
    exported.make("--recipe", exported.sender.folder / "recipe.toml")
    run = exported.take_over(
        exported.spare, "--from", exported.sealed, *exported.secret(), "--json"
    )
    hold_output(schema, run.out, 0)
    assert run.document["active"] == ["W2605004"]
    assert (exported.spare.parent / "recipe.toml").exists()
    assert flasher("station", "verify", "--sockets", exported.spare).code == ExitCode.OK

    assert "taken-over" in flasher("plant", "send", "--sockets", exported.file).err
    shown = flasher("plant", "status", "--database", url)
    assert "another PC, REFUSED" in shown.out
    plain = exported.file.with_name("plain.toml")
    without = exported.file.read_text("utf-8").replace('badges = "badges.toml"', "")
    plain.write_text(without, encoding="utf-8")
    start = ("--recipe", exported.sender.folder / "recipe.toml", "--units", "1")
    run = flasher("station", "run", *start, "--sockets", plain, "--operator", "jo")
    assert (run.code, "another pc" in run.err.lower()) == (ExitCode.USAGE, True)

    back = exported.take_over(exported.file, "--json")
    hold_output(schema, back.out, 0)
    assert back.document["brought_in"] is None
    words = (back.document["set_aside"], "--sockets", exported.file, "--reason", "x", "--json")
    run = flasher("station", "bring-in", *words)
    hold_output(schema, run.out, 0)
    assert "taken-over" in flasher("plant", "send", "--sockets", exported.spare).err
    assert flasher("plant", "verify", "--database", url).code == ExitCode.OK
    assert PASSWORD not in run.out + shown.out + back.out


def test_check_compares_the_clocks(flasher: Flasher, plant: Plant, tmp_path: Path) -> None:
    file = tmp_path / "station.toml"
    words = ("station", "check", write_recipe(tmp_path, USUAL), "--sockets", file)
    file.write_text(STATION.format(plant=plant.url("flasher_line_2")), encoding="utf-8")
    run = flasher(*words, "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
    assert abs(run.document["clock_offset_s"]) < 5.0
    assert "differs by" in flasher(*words).out
    file.write_text(STATION.format(plant="postgresql://x@127.0.0.1:1/plant"), encoding="utf-8")
    run = flasher(*words)
    assert run.code == ExitCode.OK
    assert "warning: the clock was not compared with the plant's" in run.err
    write_recipe(tmp_path, USUAL + '\n[plant]\nclock = "stop"\n')
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "The clock was not compared" in run.err
    write_recipe(tmp_path, USUAL + '\n[plant]\nclock = "stop"\nclock_unknown = "allow"\n')
    assert flasher(*words).code == ExitCode.OK
    file.write_text(STATION.format(plant=plant.url("flasher_line_2")), encoding="utf-8")
    write_recipe(tmp_path, USUAL + '\n[plant]\nclock = "stop"\nclock_offset_max_s = 1e-9\n')
    run = flasher(*words)
    assert run.code == ExitCode.USAGE
    assert "Set the clock" in run.err


def test_status_lists_units_that_passed_twice(
    flasher: Flasher, plant: Plant, sender: Sender
) -> None:
    other = plant.sender("line-3")
    for station in (sender, other):
        station.bench.make()
        station.send()
    other.close()
    run = flasher("plant", "status", "--database", plant.url(), "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
    (found,) = run.document["passed_twice"]
    assert (found["first"]["station"], found["second"]["station"]) == ("line-2", "line-3")
    for action in ("status", "report"):
        shown = flasher("plant", action, "--database", plant.url()).out
        assert "passed at two stations: 1 unit" in shown


def test_expired_claims_are_released_for_a_reason(
    flasher: Flasher, plant: Plant, sender: Sender
) -> None:
    sender.send()
    claim = (
        "INSERT INTO plant_claim (token, station, part, serial, socket, claimed_at, expires_at)"
        " SELECT '{0}', station, 'BAT-36', '{0}', 'A', '2026-05-17 12:00Z',"
        " now() + interval '{1}'"
        " FROM plant_station WHERE name = 'line-2'"
    )
    with plant.connect() as owner:
        owner.execute(f"ALTER DATABASE {plant.database} SET timezone = 'Asia/Shanghai'".encode())
        for serial, left in (("W2605011", "-1 min"), ("W2605012", "1 min")):
            owner.execute(claim.format(serial, left).encode())
    words = ("plant", "claims", "--database", plant.url())
    for mistake in (("--release",), ("--reason", "x"), ("--release", "--reason", "x")):
        run = flasher(*words, *mistake)
        assert run.code == ExitCode.USAGE
        assert "--release" in run.err
    before = flasher(*words).out
    assert [line.split(", ")[0] for line in before.splitlines()] == [
        "BAT-36 W2605011", "BAT-36 W2605012",
    ]  # fmt: skip
    assert before.count("EXPIRED") == 1
    run = flasher(
        *words, "--station", "line-2", "--release", "--reason", "its disk\tbroke", "--json"
    )
    hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
    (left,), (old,) = run.document["claims"], run.document["released"]
    assert (left["serial"], old["serial"]) == ("W2605012", "W2605011")
    lines = flasher(*words).out.splitlines()
    begin = "BAT-36 W2605012, line-2, socket A, claimed 2026-05-17 12:00:00 UTC: valid until "
    assert lines[0].startswith(begin)
    assert lines[1].endswith(" by postgres: its disk\\tbroke")
    again = flasher(*words, "--serial", "W2605012", "--release", "--reason", "impatient")
    assert again.code == ExitCode.USAGE
    assert "nothing was released" in again.err


def test_retire_moves_months_to_files_that_verify_examines(
    flasher: Flasher, plant: Plant, sender: Sender
) -> None:
    sender.bench.make()
    sender.bench.clock.go_on(40 * 86_400.0)
    sender.bench.make(serial="W2605003")
    sender.send()
    folder = plant.folder / "archive"
    words = ("plant", "retire", "--database", plant.url(), "--archive", folder)
    assert "either --before or --keep-months" in flasher(*words).err
    assert "is not a month" in flasher(*words, "--before", "2026").err
    shown = flasher(*words, "--before", "2026-06", "--dry-run")
    assert (shown.code, shown.out) == (ExitCode.OK, "2026-05: 4 rows, 1 run\n")
    due = flasher(*words, "--before", "2026-07", "--dry-run", "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), due.out, due.code)
    # The newest row of a station stays.
    assert due.document["due"] == [
        {"month": "2026-05", "rows": 4, "runs": 1},
        {"month": "2026-06", "rows": 1, "runs": 0},
    ]
    assert not folder.exists()
    reader = (*words[:3], plant.url("flasher_desk"), *words[4:])
    refused = flasher(*reader, "--before", "2026-06")
    assert refused.code == ExitCode.USAGE
    assert "Only the owner" in refused.err
    run = flasher(*words, "--before", "2026-06")
    assert run.code == ExitCode.OK, run.err
    assert run.out.startswith("2026-05: 4 rows, 1 run, 1 trace in flasher-")
    again = flasher(*words, "--before", "2026-06", "--dry-run")
    assert again.out == "nothing to retire before 2026-06\n"
    again = flasher(*words, "--before", "2026-06", "--json")
    hold_output(json.loads(SCHEMA.read_text("utf-8")), again.out, again.code)
    assert again.document["months"] == []
    verify = ("plant", "verify", "--database", plant.url("flasher_desk"))
    assert "1 files of retired months were not examined" in flasher(*verify).err
    both = flasher(*verify, "--archive", folder)
    assert both.code == ExitCode.OK
    assert "  1 file of retired months, too" in both.out.splitlines()
    report = flasher("plant", "report", "--database", plant.url("flasher_desk"))
    assert "runs before 2026-06-01 are retired" in report.err
    units = flasher(
        "plant", "units", "--database", plant.url("flasher_desk"), "--image", BMS_SHA256
    )
    assert units.out.splitlines()[-1] == "2 units"
