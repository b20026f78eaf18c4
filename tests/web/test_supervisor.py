"""The supervisor pages: what they find in the records, and that nothing in these does harm."""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields
from datetime import UTC, datetime, time, timedelta
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
from starlette.testclient import TestClient

from flasher.protocol.spec import BMS as TARGET
from flasher.station.records import chain
from flasher.station.records.keys import KeyLocations
from flasher.station.records.model import (
    Measurement,
    RunFilter,
    RunId,
    RunState,
    StepState,
)
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import By, InstalledUnit, Overview
from flasher.station.records.yields import Span
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web import supervisor
from flasher.web.query_processes import Answer, Question
from flasher.web.supervisor import SupervisorPages, open_supervisor, shifts_of, spans_of
from tests.loops import each
from tests.station.factory import BMS_VERSION, IMAGES, Bench
from tests.web.answering import app_of, app_with, client_of
from tests.zones import in_zone

IMAGE = IMAGES[TARGET].sha256
HOSTILE = "<script>alert(1)</script>\u202e\x07" + "W" * 150


def _units(bench: Bench) -> None:
    """Twelve units: every third fails first; units 4 and 8 at another socket and in a lot."""
    for number in range(1, 13):
        serial = f"W26050{number:02}"
        socket, lot = ("B", "L2") if number % 4 == 0 else ("A", "L1")
        if number % 3 == 0:
            code = "NO_ANSWER" if number < 7 else "REFUSED"
            bench.make(RunState.FAIL, serial, socket, lot=lot, code=code)
        bench.make(RunState.PASS, serial, socket, lot=lot)


@pytest.fixture(scope="module")
def plant() -> Iterator[Bench]:
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        _units(bench)
        yield bench
        bench.store.close()


@pytest.fixture(scope="module")
def overview(plant: Bench) -> Overview:
    return Overview(plant.store.database)


@pytest.fixture(scope="module")
def client(plant: Bench) -> TestClient:
    return client_of(app_of(plant.path, plant.keys))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.store.close()


class _Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: dict[str, str] = {}
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._href = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._href = dict(attrs).get("href") or "" if tag == "a" else ""

    def handle_data(self, data: str) -> None:
        if self._href and data.strip():
            self.found[data.strip()] = self._href


def _links(html: str) -> dict[str, str]:
    parser = _Links()
    parser.feed(html)
    return parser.found


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/runs.csv", "/runs.csv?lot=L2", f"/images.csv?sha256={IMAGE}"])
def test_a_file_in_parts_is_the_whole_file(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    whole = client.get(path)
    monkeypatch.setattr(supervisor, "PART_SIZE", 2)
    in_parts = client.get(path)
    assert in_parts.text == whole.text
    assert len(whole.text.splitlines()) > 3
    assert in_parts.headers["content-disposition"] == whole.headers["content-disposition"]


def test_a_file_breaks_off_where_a_part_cannot_be_read(
    plant: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "PART_SIZE", 2)
    pages = open_supervisor(
        str(plant.path), plant.store.files.folder, KeyLocations(plant.keys), DEFAULT_SHIFTS
    )
    asked: list[Question] = []
    usual = supervisor.SupervisorPages.answer

    def answer(self: SupervisorPages, question: Question) -> Answer:
        asked.append(question)
        return Answer(status=503) if len(asked) == 3 else usual(self, question)

    monkeypatch.setattr(supervisor.SupervisorPages, "answer", answer)
    with closing(pages.store), pytest.raises(RuntimeError, match="cannot be read"):
        client_of(app_with(pages)).get("/runs.csv")
    assert [question.fields.get("after") for question in asked] == [None, "2", "4"]


# -- runs ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chosen", "count"),
    [
        (RunFilter(), 16),
        (RunFilter(search="w260500"), 12),
        (RunFilter(search="%"), 0),
        (RunFilter(lot="L2"), 4),
        (RunFilter(socket="B", state=RunState.FAIL), 1),
        (RunFilter(state=RunState.FAIL), 4),
        (RunFilter(code="REFUSED"), 2),
        (RunFilter(recipe="Battery 36 V", part="BAT-36"), 16),
        (RunFilter(recipe="another"), 0),
        (RunFilter(until=datetime(2026, 5, 17, 9, 0, 25, tzinfo=UTC)), 3),
        (RunFilter(since=datetime(2026, 5, 17, 9, 0, 25, tzinfo=UTC)), 13),
    ],
)
def test_a_filter_finds_its_runs(overview: Overview, chosen: RunFilter, count: int) -> None:
    assert len(overview.runs(chosen, PageCursor()).rows) == count


@pytest.mark.parametrize("size", [1, 5, 16, 20])
def test_pages_hold_every_run_once_in_both_directions(overview: Overview, size: int) -> None:
    every = [run.run_id for run in overview.runs(RunFilter(), PageCursor(), 100).rows]
    assert every == sorted(every, reverse=True)
    page = overview.runs(RunFilter(), PageCursor(), size)
    down = [[run.run_id for run in page.rows]]
    assert page.newer is None
    while page.older is not None:
        page = overview.runs(RunFilter(), page.older, size)
        down.append([run.run_id for run in page.rows])
    assert [run for some in down for run in some] == every
    up = [down[-1]]
    while page.newer is not None:
        page = overview.runs(RunFilter(), page.newer, size)
        up.append([run.run_id for run in page.rows])
    assert sorted({run for some in up for run in some}, reverse=True) == every


@pytest.mark.slow
def test_the_form_of_the_runs_narrows_them_and_its_files_are_of_the_same(
    client: TestClient,
) -> None:
    html = client.get("/runs?outcome=FAIL&lot=L1").text
    assert "NO_ANSWER" in html
    assert html.count('class="text first"') == 3
    files = _links(html)
    rows = list(csv.DictReader(io.StringIO(client.get(files["CSV"]).text)))
    assert [row["state"] for row in rows] == ["FAIL"] * 3
    noted = json.loads(client.get(files["JSON"]).text)
    assert noted["filter"]["state"] == "fail"
    assert [run["serial"] for run in noted["runs"]] == [row["serial"] for row in rows]
    suite = ElementTree.fromstring(client.get(files["JUnit"]).content)  # noqa: S314  our own
    assert len(list(suite.iter("failure"))) == 3


@pytest.mark.parametrize(
    "query",
    [
        "from=yesterday",
        "outcome=GREAT",
        "to=2026-13-01",
        "to=0001-01-05",
        "from=0001-01-02&by=shift",
        "to=9999-12-31T23:59",
        "from=2026-05-17&to=9026-05-17&by=shift",
    ],
)
@pytest.mark.parametrize("page", ["/runs", "/yield"])
def test_a_form_that_cannot_be_is_refused_with_the_reason(
    client: TestClient, page: str, query: str
) -> None:
    answer = client.get(f"{page}?{query}")
    assert answer.status_code == 400
    assert 'role="alert"' in answer.text


@pytest.mark.parametrize("number", ["9" * 19, "9" * 5000])
@pytest.mark.parametrize("page", ["", "/trace"])
def test_a_number_that_no_run_can_have_is_no_page(
    client: TestClient, number: str, page: str
) -> None:
    assert client.get(f"/runs/{number}{page}").status_code == 404


@pytest.mark.parametrize("cut", ["before=x", "before=-1", "before=" + "9" * 30, "after=\u0663"])
def test_a_cut_that_cannot_be_is_none(client: TestClient, cut: str) -> None:
    assert client.get(f"/runs?{cut}").status_code == 200


# -- units -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_leads_to_its_unit_with_its_trace_explained(client: TestClient) -> None:
    answer = client.get(client.get("/runs/4").headers["location"])
    assert answer.status_code == 200
    assert "W2605003" in answer.text
    assert "V1r0r4_20220512" in answer.text
    assert 'aria-label="Messages of the upgrade"' in answer.text
    story = client.get(
        _links(answer.text)["the whole story: phases, answer times, packets with trouble"]
    )
    assert "Link report" in story.text
    assert "unsafe-inline" not in story.text


def test_steps_and_measurements_of_a_unit_are_shown(bench: Bench) -> None:
    run_id = bench.claim().run_id
    out = Measurement("voltage", 29.0, "V", 30.0, 42.0)
    bench.store.step(
        run_id, "check", StepState.FAIL, duration_s=0.5, measurements=[out], code="LIMIT"
    )
    bench.store.finish(run_id, bench.ending(RunState.FAIL, "LIMIT"))
    html = client_of(app_of(bench.path, bench.keys)).get("/units?serial=W2605002").text
    assert "29 V" in html
    assert "from 30 to 42 V" in html
    assert "LIMIT" in html


def test_a_part_of_a_number_finds_its_runs(client: TestClient) -> None:
    assert client.get("/units?serial=260500").headers["location"] == "/runs?search=260500"


@pytest.mark.parametrize("path", ["/runs/999", "/runs/999/trace", "/units/certificate?serial=W1"])
def test_what_is_not_there_is_reported(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


@pytest.mark.slow
def test_the_certificate_is_refused_for_changed_records(bench: Bench) -> None:
    bench.make()
    client = client_of(app_of(bench.path, bench.keys))
    assert "Flash certificate" in client.get("/units/certificate?serial=W2605002").text
    bench.forge("UPDATE unit SET serial = 'W2605009'")
    refused = client.get("/units/certificate?serial=W2605009")
    assert refused.status_code == 400
    assert "changed" in refused.text


# -- images ----------------------------------------------------------------------------------------


def _flash(bench: Bench, serial: str, state: RunState, *, is_confirmed: bool = True) -> RunId:
    run_id = bench.claim(serial).run_id
    write = bench.store.intent(run_id, "bms", "flash", BMS_VERSION)
    if is_confirmed:
        bench.store.verified(write, BMS_VERSION)
    flashed = StepState.PASS if is_confirmed else StepState.FAIL
    bench.store.step(run_id, "flash", flashed, duration_s=8.0)
    ending = bench.ending(
        state, "OK" if state is RunState.PASS else "REFUSED", bench.traced(serial)
    )
    bench.store.finish(run_id, ending)
    return run_id


@pytest.mark.slow
def test_the_units_that_hold_an_image_are_those_it_was_last_sent_to(bench: Bench) -> None:
    overview = Overview(bench.store.database)
    _flash(bench, "W2605001", RunState.PASS)
    _flash(bench, "W2605002", RunState.FAIL, is_confirmed=False)
    bench.make(RunState.FAIL, "W2605003")
    untouched = bench.claim("W2605004").run_id
    bench.store.finish(
        untouched, bench.ending(RunState.FAIL, "NO_ANSWER", bench.traced("W2605004"))
    )
    first = {each.serial: each.is_confirmed for each in overview.holders(IMAGE, PageCursor()).rows}
    assert first == {"W2605001": True, "W2605002": False, "W2605003": True}
    assert overview.holder_count(IMAGE) == 3

    data = IMAGES[TARGET].data + b"newer"
    _other_image(bench, data)
    newer = bench.recipe.targets[0].image.sha256
    _flash(bench, "W2605002", RunState.PASS)
    assert {each.serial for each in overview.holders(newer, PageCursor()).rows} == {"W2605002"}
    assert {each.serial for each in overview.holders(IMAGE, PageCursor()).rows} == {
        "W2605001",
        "W2605003",
    }

    client = client_of(app_of(bench.path, bench.keys))
    html = client.get(f"/images?image={newer[:12].upper()}").text
    assert "W2605002" in html
    assert "W2605001" not in html
    rows = list(csv.DictReader(io.StringIO(client.get(f"/images.csv?sha256={IMAGE}").text)))
    assert [row["serial"] for row in rows] == ["W2605001", "W2605003"]
    assert list(rows[0]) == [each.name for each in fields(InstalledUnit)]


def _other_image(bench: Bench, data: bytes) -> None:
    """Go on with a recipe that has another image."""
    from tests.station import factory  # noqa: PLC0415

    before = dict(factory.IMAGES)
    factory.IMAGES[TARGET] = type(before[TARGET]).from_bytes(data)
    try:
        bench.use(factory.USUAL.replace(before[TARGET].sha256, factory.IMAGES[TARGET].sha256)
                  .replace('revision = "4"', 'revision = "5"'))  # fmt: skip
    finally:
        factory.IMAGES.update(before)


def test_holders_come_in_pages(overview: Overview) -> None:
    found, cut = [], PageCursor()
    while True:
        page = overview.holders(IMAGE, cut, 5)
        found += [each.serial for each in page.rows]
        if page.older is None:
            break
        cut = page.older
    assert len(found) == len(set(found)) == overview.holder_count(IMAGE) == 12


# -- figures ---------------------------------------------------------------------------------------

BEGIN = datetime(2026, 5, 17, 9, 0, tzinfo=UTC)


def test_yield_counts_units_by_their_last_and_first_runs_in_each_span(overview: Overview) -> None:
    spans = [Span(BEGIN + timedelta(seconds=80 * at), BEGIN + timedelta(seconds=80 * (at + 1)))
             for at in range(3)]  # fmt: skip
    found, _ = overview.yields(RunFilter(), spans)
    hour = [Span(BEGIN, BEGIN + timedelta(hours=1))]
    (_, whole) = overview.yields(RunFilter(), hour)
    assert (whole.units, whole.passed, whole.first_passed) == (12, 12, 8)
    assert (found[0].units, found[0].passed, found[0].first_passed) == (6, 6, 4)
    assert (found[2].units, found[2].passed) == (0, 0)
    (_, lot) = overview.yields(RunFilter(lot="L2"), hour)
    assert (lot.units, lot.first_passed) == (3, 2)


@pytest.mark.slow
def test_more_spans_than_one_query_takes(overview: Overview) -> None:
    spans = [Span(BEGIN + timedelta(seconds=at), BEGIN + timedelta(seconds=at + 1))
             for at in range(900)]  # fmt: skip
    found, whole = overview.yields(RunFilter(), spans)
    assert (sum(each.units for each in found), whole.units) == (16, 12)


@pytest.mark.parametrize(
    ("by", "groups"),
    [
        (By.SOCKET, {"A": 3, "B": 1}),
        (By.LOT, {"L1": 3, "L2": 1}),
        (By.RECIPE, {"Battery 36 V, 4": 4}),
        (By.SHIFT, {"06:00": 4}),
    ],
)
def test_causes_are_counted_by_what_is_asked(
    overview: Overview, by: By, groups: dict[str, int]
) -> None:
    shifts = [(Span(BEGIN - timedelta(hours=3), BEGIN + timedelta(hours=5)), "06:00")]
    found = overview.causes(RunFilter(), by, shifts)
    assert {code: counts.total() for code, counts in found.items()} == {
        "NO_ANSWER": 2, "REFUSED": 2,
    }  # fmt: skip
    assert sum(found.values(), start=type(found["REFUSED"])()) == groups


def test_times_of_steps(overview: Overview) -> None:
    assert overview.step_times(RunFilter()) == {"flash": {8.0: 16}}


@pytest.mark.parametrize(("days", "count"), [(1, 24), (30, 30), (70, 10), (700, 23)])
def test_spans_cover_a_time_without_gaps(days: int, count: int) -> None:
    whole = Span(BEGIN, BEGIN + timedelta(days=days))
    spans = list(spans_of(whole))
    assert spans[0].begin <= whole.begin
    assert spans[-1].end >= whole.end
    assert all(one.end == other.begin for one, other in pairwise(spans))
    assert count <= len(spans) <= count + 2


@each(
    "zone, begin, hours",
    [
        ("Europe/Berlin", "2026-03-28T23:00Z", "00 01 03"),
        ("Europe/Berlin", "2026-10-24T22:00Z", "00 01 02"),
        ("Australia/Lord_Howe", "2026-10-03T13:30Z", "00 01 02 03"),
        ("America/Santiago", "2026-09-06T03:00Z", "23 01 02"),
    ],
)
def test_hours_and_days_in_which_the_clock_is_changed(zone: str, begin: str, hours: str) -> None:
    with in_zone(zone):
        at = datetime.fromisoformat(begin)
        spans = list(spans_of(Span(at, at + timedelta(hours=3))))
        assert " ".join(f"{span.begin.astimezone():%H}" for span in spans) == hours
        assert all(one.end == other.begin for one, other in pairwise(spans))
        days = list(spans_of(Span(at, at + timedelta(days=5))))
        assert len({span.begin.astimezone().date() for span in days}) == len(days)


def test_shifts_cover_a_time_and_are_named_by_their_begin() -> None:
    whole = Span(BEGIN, BEGIN + timedelta(days=2))
    found = list(shifts_of(whole, [time(22), time(6), time(14)]))
    assert found[0][0].begin <= whole.begin
    assert found[-1][0].end >= whole.end
    assert {name for _, name in found} == {"06:00", "14:00", "22:00"}


@pytest.mark.slow
def test_figures_are_of_the_last_days_that_have_runs(client: TestClient) -> None:
    html = client.get("/yield").text
    assert "2026-05-17 09:0" in html
    assert "100.0 %" in html
    assert "66.6 %" in html


@pytest.mark.parametrize("by", ["socket", "recipe", "lot", "shift", "nonsense"])
def test_charts_need_nothing_that_the_policy_forbids(client: TestClient, by: str) -> None:
    answer = client.get(f"/yield?by={by}")
    parser = _Links()
    parser.feed(answer.text)
    assert answer.text.count("<svg") >= 4
    assert not [tag for tag, _ in parser.tags if tag in ("style", "script")]
    assert not [
        attrs for _, attrs in parser.tags if any(n.startswith(("style", "on")) for n in attrs)
    ]


# -- the audit trail -------------------------------------------------------------------------------


def test_the_audit_trail_in_pages(client: TestClient, overview: Overview) -> None:
    html = client.get("/audit?event=finished").text
    assert html.count('<td class="keep first">finished') == 16
    first = overview.audit(PageCursor(), size=10)
    assert first.older is not None
    second = overview.audit(first.older, size=10)
    assert first.rows[-1].number == second.rows[0].number + 1
    assert "begun" in client.get("/audit?event=begun").text


@pytest.mark.parametrize("period", ["from=2099-01-01", "to=2000-01-02"])
def test_a_period_without_audit_rows_is_an_empty_page(client: TestClient, period: str) -> None:
    answer = client.get(f"/audit?{period}")
    assert answer.status_code == 200
    assert '<td class="keep first">' not in answer.text


def test_every_event_of_the_trail_can_be_chosen(overview: Overview) -> None:
    assert {row.event for row in overview.audit(PageCursor(), size=500).rows} <= set(chain.EVENTS)


# -- what must not do harm -------------------------------------------------------------------------


@pytest.mark.slow
def test_hostile_texts_stay_texts(bench: Bench) -> None:
    lot = HOSTILE[:100]
    claim = bench.claim(lot=lot)
    bench.work(claim.run_id)
    bench.store.step(claim.run_id, "<b>step</b>", StepState.FAIL, duration_s=0.1, text=HOSTILE)
    bench.store.finish(claim.run_id, bench.ending(RunState.FAIL, "<i>CODE</i>"))
    client = client_of(app_of(bench.path, bench.keys))
    for path in ("/runs", "/units?serial=W2605002", "/yield?by=lot", "/times", "/audit", "/images",
                 "/runs?search=<script>", "/units?serial=<script>&part=<b>"):  # fmt: skip
        text = client.get(path).text
        assert "<script>" not in text, path
        assert "<b>" not in text, path
        assert "\u202e" not in text, path


@pytest.mark.slow
@pytest.mark.parametrize("language", ["en", "de", "zh"])
@pytest.mark.parametrize(
    "path", ["/runs", "/units", "/units?serial=W2605003", "/images", "/yield", "/times", "/audit"]
)
def test_every_page_in_every_language_also_of_empty_records(
    client: TestClient, path: str, language: str
) -> None:
    answer = client.get(path, params={"lang": language})
    assert answer.status_code == 200
    assert f'lang="{language}"' in answer.text


@pytest.mark.parametrize("path", ["/runs", "/units", "/images", "/yield", "/times", "/audit"])
def test_empty_records_have_pages_too(bench: Bench, path: str) -> None:
    assert client_of(app_of(bench.path, bench.keys)).get(path).status_code == 200


@pytest.mark.slow
def test_pages_change_nothing_and_wait_for_no_one(bench: Bench) -> None:
    bench.make()
    client = client_of(app_of(bench.path, bench.keys))
    with bench.outsider() as writer:
        writer.execute("BEGIN IMMEDIATE")
        before = bench.path.read_bytes()
        for path in ("/runs", "/yield", "/images", "/audit", "/units?serial=W2605002"):
            assert client.get(path).status_code == 200
        assert bench.path.read_bytes() == before
        writer.execute("ROLLBACK")


def test_damaged_records_are_reported(bench: Bench) -> None:
    bench.make()
    client = client_of(app_of(bench.path, bench.keys))
    bench.store.close()
    for file in bench.folder.glob("records.sqlite*"):
        if file.is_file():
            file.write_bytes(b"no database" * 1000)
    answer = client.get("/runs")
    assert answer.status_code == 503
    assert 'role="alert"' in answer.text
