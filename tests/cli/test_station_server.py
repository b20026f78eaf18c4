"""`flasher station` with records on a PostgreSQL server: its users, its password, its driver."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import psycopg
import pytest

from flasher.cli.station import place as station_place
from flasher.errors import ExitCode
from tests.cli.conftest import Flasher
from tests.cli.station_threads import ThreadPort
from tests.cli.test_schema import hold_output
from tests.schema_document import SCHEMA
from tests.station.factory import USUAL, write_recipe
from tests.station.postgres import Server

pytestmark = pytest.mark.slow

SECRETS = ("s3cr3t", "s3cr3t@x/y:z")
"""The second one is percent-encoded in a URL."""
ENCODED = {"s3cr3t": "s3cr3t", "s3cr3t@x/y:z": "s3cr3t%40x%2Fy%3Az"}


@pytest.fixture(autouse=True)
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """No processes, and nobody at a keyboard."""
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())


def with_password(url: str, user: str, secret: str) -> str:
    return url.replace("//postgres@", f"//{user}:{ENCODED[secret]}@")


def test_a_station_adds_records_and_a_reader_reads_them_and_no_more(
    flasher: Flasher, postgres: Server, tmp_path: Path
) -> None:
    name = postgres.database()
    owner = postgres.url(name)
    run = flasher("station", "roles", "--database", owner, "--json")
    assert run.code == ExitCode.OK
    hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
    assert all(role["is_new"] for role in run.document["roles"])
    again = flasher("station", "roles", "--database", owner)
    assert again.out.splitlines() == [
        "flasher_station: may add records",
        "flasher_reader: may read records",
    ]
    with postgres.connect(name) as admin:
        for role, secret in zip(("station", "reader"), SECRETS, strict=True):
            admin.execute(f"ALTER ROLE flasher_{role} PASSWORD '{secret}'".encode())
    station = with_password(owner, "flasher_station", SECRETS[0])
    reader = with_password(owner, "flasher_reader", SECRETS[1])
    files = ("--files", tmp_path / "files")
    recipe = write_recipe(tmp_path, USUAL)
    mock = ("--mock-sockets", "2", "--mock-bad", "0", "--mock-dead", "0", "--mock-speed", "0")
    words = ("station", "run", "--recipe", recipe, *mock, "--units", "2", *files)
    assert flasher(*words, "--database", station).code == ExitCode.OK
    verified = flasher("station", "verify", "--database", reader, *files)
    assert verified.code == ExitCode.OK
    assert verified.err.startswith("Name another place for the heads")
    run = flasher(*words, "--database", reader)
    assert "this user of the database lacks the right" in run.err
    for url, statements in (
        (station, ("DELETE FROM audit", "TRUNCATE audit", "DROP TRIGGER run_update ON run")),
        (station, ("UPDATE unit SET serial = 'X'", "CREATE TABLE x ()", "CREATE TEMP TABLE x ()")),
        (station, ("INSERT INTO schema_info SELECT 9, created_at FROM schema_info",)),
        (reader, ("INSERT INTO operator (name) VALUES ('x')", "UPDATE run SET text = ''")),
    ):
        for statement in statements:
            with (
                psycopg.connect(url.replace("+psycopg", "")) as connection,
                pytest.raises(psycopg.errors.InsufficientPrivilege),
            ):
                connection.execute(statement.encode())


def test_records_that_somebody_holds_do_not_let_a_station_hang(
    flasher: Flasher, postgres: Server, tmp_path: Path
) -> None:
    url = postgres.records()
    sockets = tmp_path / "sockets.toml"
    lines = (f'records = "{url}"', 'files = "files"', "lock_timeout_s = 0.05")
    sockets.write_text("\n".join((*lines, "[[socket]]", 'name = "A"', "mock = {}")), "utf-8")
    words = ("station", "run", "--recipe", write_recipe(tmp_path), "--sockets", sockets)
    with postgres.connect(url.rpartition("/")[2]) as holder:
        holder.execute("LOCK TABLE audit, schema_info")
        run = flasher(*words, "--units", "1")
    assert run.code == ExitCode.USAGE
    assert "another program holds the database" in run.err
    assert "pg_stat_activity" in run.err


@pytest.mark.parametrize("who", [("postgres", "reader"), ("jo", "jo")])
def test_a_role_that_could_do_more_is_refused(
    flasher: Flasher, postgres: Server, who: tuple[str, str]
) -> None:
    words = ("--station-role", who[0], "--reader-role", who[1])
    run = flasher("station", "roles", "--database", postgres.records(), *words)
    assert run.code == ExitCode.USAGE
    with postgres.connect() as admin:
        known = admin.execute("SELECT 1 FROM pg_roles WHERE rolname IN ('reader', 'jo')")
        assert not known.fetchall()


def test_roles_of_a_file_are_refused_and_no_file_is_made(flasher: Flasher, tmp_path: Path) -> None:
    run = flasher("station", "roles", "--database", tmp_path / "records.sqlite")
    assert run.code == ExitCode.USAGE
    assert not list(tmp_path.iterdir())


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
@pytest.mark.parametrize("is_bug", [False, True])
def test_a_password_is_nowhere_in_what_is_said(
    flasher: Flasher,
    postgres: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    url: str,
    *,
    is_bug: bool,
) -> None:
    place = f"127.0.0.1:{postgres.port}"
    if is_bug:
        wrong = RuntimeError(f"no {url.format(place=place)}")
        monkeypatch.setattr(station_place, "records_of", lambda _: (_ for _ in ()).throw(wrong))
    log = tmp_path / "log"
    words = ("--log-file", log, "-vv", "station", "report", "--files", tmp_path)
    for more in (("--database",), ("--json", "--database"), ("--database", "x")):
        run = flasher(*words, *more, url.format(place=place))
        assert run.code in ({ExitCode.INTERNAL, ExitCode.USAGE} if is_bug else {ExitCode.USAGE})
        said = run.out + run.err + log.read_text(encoding="utf-8")
        assert "s3cr3t" not in said
        assert "Traceback" not in said or is_bug
    assert "station report" in log.read_text(encoding="utf-8")


def test_a_driver_that_is_not_installed_is_named_with_how_to_install_it(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "flasher.station.records.server", raising=False)
    monkeypatch.setitem(sys.modules, "psycopg", None)
    url = "postgresql://jo@127.0.0.1/records"
    run = flasher("station", "report", "--database", url, "--files", tmp_path, "--json")
    assert run.code == ExitCode.USAGE
    error = run.document["error"]
    assert "driver that is not installed" in error["what"]
    assert "pip install -c .ci/constraints.txt '.[station,postgres]'" in error["remedy"]
