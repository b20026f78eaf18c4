"""`flasher station run --web`: who may see the pages, and what is refused before a start."""

from __future__ import annotations

import errno
import io
import json
import re
import signal
import socket
import sqlite3
import stat
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, cast

import httpx2
import pytest

from flasher.cli.station import pages
from flasher.cli.station.pages import OperatorView
from flasher.errors import ExitCode, UsageError
from flasher.station.board import Board
from flasher.station.events import StationEvent
from flasher.station.health import HealthWatch
from flasher.station.records.errors import DiskFullError
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import RunKind, RunState
from flasher.station.records.store import Store
from flasher.web.guard import TOKEN_HEADER
from flasher.web.operator import CurrentLot, Screen
from flasher.web.server import Server
from tests.cli.conftest import SAMPLES, Flasher
from tests.cli.station_threads import ThreadPort
from tests.loops import each
from tests.station.factory import USUAL, Bench, make_recipe
from tests.station.line_bench import LineBench
from tests.station.line_inputs import saved
from tests.station.test_question import certificate

pytestmark = pytest.mark.slow

RECIPE = SAMPLES / "station" / "recipe.toml"
RUN = ("station", "run", "--recipe", RECIPE, "--mock-sockets", "2", "--mock-speed", "0")


@pytest.fixture(autouse=True)
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """No processes, and no keyboard."""
    monkeypatch.setattr("flasher.cli.station.run.LAUNCH", ThreadPort)
    monkeypatch.setattr(sys, "stdin", io.StringIO())


@pytest.fixture
def password(tmp_path: Path) -> Path:
    path = tmp_path / "password"
    path.write_text("long enough\n")
    path.chmod(0o640)
    return path


@pytest.fixture
def resumed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The page scans RESUME once the line is stopped; what the page showed by then."""
    reasons: list[str] = []
    threads: list[threading.Thread] = []

    class Watched(Server):
        def __enter__(self) -> Any:
            entered = super().__enter__()
            threads.append(threading.Thread(target=watch, args=(self.url,)))
            threads[0].start()
            return entered

    def watch(url: str) -> None:
        with httpx2.Client(timeout=10) as client:
            token = re.search(
                r'name="flasher-token" content="(.*?)"', client.get(f"{url}line").text
            )
            assert token is not None
            headers = {"origin": url.rstrip("/"), TOKEN_HEADER: token[1]}
            with suppress(httpx2.HTTPError), client.stream("GET", f"{url}line/events") as stream:
                for line in stream.iter_lines():
                    if line.startswith("data: ") and not reasons:
                        message = json.loads(line.removeprefix("data: "))
                        head = message.get("head") or {}
                        if head.get("stopped"):
                            reasons.append(head["stopped"]["reason"])
                            scan = {"text": "RESUME", "shown_at": message["at"]}
                            client.post(f"{url}line/scan", json=scan, headers=headers)

    monkeypatch.setattr(pages, "Server", Watched)
    yield reasons
    for thread in threads:
        thread.join(10)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """What the page and its stream showed while the station ran."""
    found: list[Any] = []
    threads: list[threading.Thread] = []

    class Asked(Server):
        def __enter__(self) -> Any:
            entered = super().__enter__()
            threads.append(threading.Thread(target=look, args=(self.url,)))
            threads[0].start()
            return entered

    def look(url: str) -> None:
        with httpx2.Client(follow_redirects=True, timeout=10) as client:
            found.append(client.get(f"{url}line").text)
            with client.stream("GET", f"{url}line/events") as stream:
                if stream.status_code != httpx2.codes.OK:
                    found.append(stream.status_code)
                    return
                with suppress(httpx2.HTTPError):  # the server has ended
                    data = (line for line in stream.iter_lines() if line.startswith("data: "))
                    found.extend(json.loads(line.removeprefix("data: ")) for line in data)

    monkeypatch.setattr(pages, "Server", Asked)
    yield found
    for thread in threads:
        thread.join(10)


def test_the_page_shows_what_the_station_does(flasher: Flasher, asked: list[Any]) -> None:
    run = flasher(*RUN, "--units", "4", "--web", "0", "--mock-bad", "0", "--mock-dead", "0")
    assert run.code == ExitCode.OK
    assert "The operator page: http://127.0.0.1:" in run.err
    page, first, *rest = asked
    assert "<html" in page
    assert first["all"]
    assert [tile["socket"] for tile in first["tiles"]] == ["1", "2"]
    passed = {
        tile["serial"]
        for message in rest
        for tile in message.get("tiles", ())
        if tile["state"] == "pass"
    }
    lines = [json.loads(line) for line in run.out.splitlines()]
    ended = {each["serial"] for each in lines if each.get("event") == "RunEnded"}
    assert passed
    assert passed <= ended


def test_a_stopped_line_waits_for_the_people_at_its_page(
    flasher: Flasher, resumed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though there is no keyboard."""
    finish, failures = Store.finish, [DiskFullError("The disk is full.", remedy="Make room.")]

    def finish_or_fail(*given: Any, **named: Any) -> Any:
        if failures:
            raise failures.pop()
        return finish(*given, **named)

    monkeypatch.setattr(Store, "finish", finish_or_fail)
    run = flasher(*RUN, "--units", "3", "--web", "0", "--mock-bad", "0", "--mock-dead", "0")
    assert resumed == ["The disk is full."]
    assert run.code == ExitCode.OK, run.err


@each(
    "more, what",
    [
        (("--web", "0.0.0.0:0"), "to other computers without TLS"),
        (("--web", "0.0.0.0:0", "--web-insecure"), "without a password"),
        (("--web", "0", "--web-key", RECIPE), "are needed together"),
        (("--web", "0", "--web-key", RECIPE, "--web-certificate", RECIPE), "read the key of"),
        (("--web", "0", "--web-password", RECIPE), "may read the password of the pages"),
        (("--web", "0", "--web-password", RECIPE.parent / "none"), "none"),
        (("--web", "70000"), "must be PORT"),
        (("--web", "203.0.113.7:0", "--web-insecure"), "without a password"),
    ],
)
def test_pages_that_others_could_read_are_refused(
    flasher: Flasher, more: tuple[object, ...], what: str
) -> None:
    run = flasher(*RUN, "--units", "1", *more)
    assert run.code == ExitCode.USAGE
    assert what in run.err


def test_a_short_password_is_refused(flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "short").write_text("1234\n")
    (tmp_path / "short").chmod(0o640)
    run = flasher(*RUN, "--units", "1", "--web", "0", "--web-password", tmp_path / "short")
    assert run.code == ExitCode.USAGE
    assert "fewer than 8 characters" in run.err


def test_a_key_that_is_none_is_refused(flasher: Flasher, tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.touch(0o600)
    run = flasher(*RUN, "--units", "1", "--web", "0", "--web-key", key, "--web-certificate", RECIPE)
    assert run.code == ExitCode.USAGE
    assert "cannot be used" in run.err


@each("days, words", [(-1, "expired on"), (3, "expires on"), (400, "")])
def test_a_certificate_that_has_expired_or_soon_will_is_reported(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int, words: str
) -> None:
    watches: list[HealthWatch] = []

    class Kept(HealthWatch):
        def __init__(self, *given: Any, **named: Any) -> None:
            super().__init__(*given, **named)
            watches.append(self)

    monkeypatch.setattr(pages, "HealthWatch", Kept)
    pem = certificate(tmp_path, f"line{days}", days)
    pem.chmod(0o600)
    run = flasher(*RUN, "--units", "1", "--web", "0", "--web-key", pem, "--web-certificate", pem)
    assert (f"The certificate of the pages {words} 20" in run.err) is bool(words)
    found = [check.text for check in watches[0].look(Board()) if check.name == "certificate"]
    assert [text.startswith(words) for text in found] == [True] * bool(words)


def test_a_port_that_is_taken_is_reported(flasher: Flasher) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        run = flasher(*RUN, "--units", "1", "--web", other.getsockname()[1])
    assert run.code == ExitCode.USAGE
    assert "another program uses it" in run.err


def test_a_station_that_cannot_begin_names_no_page(flasher: Flasher, tmp_path: Path) -> None:
    records = ("--database", tmp_path / "records.sqlite")
    bench = Bench(tmp_path)
    bench.store.close()
    with closing(bench.opened("mock")) as held:
        held.become_station()
        run = flasher(*RUN, "--units", "1", "--web", "127.0.0.1:0", *records)
    assert run.code == ExitCode.USAGE
    assert "[E219]" in run.err
    assert "page" not in run.err


def test_a_password_is_asked_for(flasher: Flasher, asked: list[Any], password: Path) -> None:
    run = flasher(*RUN, "--units", "1", "--web", "0", "--web-password", password)
    assert run.code in (ExitCode.OK, ExitCode.PARTIAL)
    page, refused = asked
    assert "the password of this station" in page
    assert refused == httpx2.codes.UNAUTHORIZED


def test_who_signs_in_at_a_page_is_in_the_audit_trail(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    badges = tmp_path / "badges.toml"
    badges.write_text('[[person]]\nname = "Sue"\ncode = "BADGE-2"\nrole = "supervisor"\n')
    threads: list[threading.Thread] = []
    answers: list[tuple[int, str]] = []

    class Used(Server):
        def __enter__(self) -> Any:
            entered = super().__enter__()
            threads.append(threading.Thread(target=use, args=(self.url,)))
            threads[0].start()
            return entered

    def use(url: str) -> None:
        with httpx2.Client(timeout=30, base_url=url, headers={"origin": url.rstrip("/")}) as client:

            def post(path: str, **fields: str) -> None:
                found = re.search(r'name="token" value="(.*?)"', client.get("/login").text)
                assert found is not None
                answer = client.post(path, data={"token": found[1], **fields})
                answers.append((answer.status_code, answer.headers.get("location", "")))

            client.get("/runs")
            post("/login", badge="BADGE-9", pin="0000")
            post("/login", badge="BADGE-2")
            page = client.get("/runs").text
            answers.append((page.count('action="/sign-out"'), ""))
            post("/sign-out")
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(pages, "Server", Used)
    records = ("--database", tmp_path / "records.sqlite", "--keys", tmp_path / "keys")
    flasher(*RUN, "--web", "0", "--badges", badges, *records)
    threads[0].join(10)
    assert answers == [(403, ""), (303, "/runs"), (1, ""), (303, "/")]
    with closing(sqlite3.connect(tmp_path / "records.sqlite")) as connection:
        rows = connection.execute("SELECT event, data FROM audit ORDER BY id").fetchall()
    printed = [(event, json.loads(data)) for event, data in rows if "sign" in event]
    address = {"address": "127.0.0.1"}
    sue = {"number": "1", "name": "Sue", **address}
    assert printed == [
        ("refused sign-in", {"name": "", "why": "unknown badge", **address}),
        ("sign-in", {**sue, "role": "supervisor"}),
        ("sign-out", sue),
    ]


def test_the_secret_of_the_sessions_is_kept_for_this_user_alone(tmp_path: Path) -> None:
    key_locations = KeyLocations(tmp_path / "keys")
    first = pages.kept_secret(key_locations)
    assert len(first) > 30
    assert pages.kept_secret(key_locations) == first
    (path,) = (tmp_path / "keys").iterdir()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_full_disk_leaves_no_half_secret(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_words: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    key_locations = KeyLocations(tmp_path / "keys")
    with monkeypatch.context() as patched:
        patched.setattr("secrets.token_urlsafe", full)
        with pytest.raises(UsageError, match="No space left"):
            pages.kept_secret(key_locations)
    assert list((tmp_path / "keys").iterdir()) == []
    assert len(pages.kept_secret(key_locations)) > 30


def test_the_lot_counts_as_the_recipes_of_all_sockets_do(tmp_path: Path) -> None:
    """The smallest quantity is in force first; golden units are no part of a lot."""
    bench = Bench(tmp_path)
    line = LineBench(bench)
    station, seen = line.station, Lots()
    view = OperatorView(cast("Screen", seen), station, Board())
    station.line.lot = "L17"
    for quantity, name in ((20, "A"), (10, "B")):
        text = f"{USUAL}\n[lot]\nquantity_max = {quantity}\n"
        station.recipes[name] = make_recipe(bench.folder, text)
    view.turn()
    ends = [("W2605002", RunKind.PRODUCTION), ("W2605003", RunKind.GOLDEN)]
    for serial, kind in ends:
        view.show(saved("A", RunState.PASS, serial=serial, kind=kind))
    view.turn()
    assert seen.lots == [CurrentLot("L17", 10, 0), CurrentLot("L17", 10, 1)]


class Lots:
    """A screen that keeps the lots that it is given."""

    def __init__(self) -> None:
        self.lots: list[CurrentLot] = []

    def show(self, event: StationEvent, board: Board) -> None:
        pass

    def turn(self, _board: Board, *, operator: str, lot: CurrentLot) -> None:
        self.lots.append(lot)
