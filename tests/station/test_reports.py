"""Reports and certificates: what the records say, in the forms that others read."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID
from xml.etree import ElementTree as Xml

import pytest
import segno

from flasher.documents import adapter, as_json
from flasher.errors import UsageError
from flasher.plant.activity import Activity
from flasher.plant.deliveries import RunDocument
from flasher.station.certificate import proven, render_certificate
from flasher.station.events import FiguresChanged, RunEnded
from flasher.station.records.errors import RecordsDamagedError
from flasher.station.records.model import (
    Measurement,
    PassedTwice,
    RunFilter,
    RunState,
    StepState,
    UnitLife,
    Units,
    UnitState,
    Verified,
)
from flasher.station.records.newest import PageCursor
from flasher.station.records.overview import Overview
from flasher.station.records.signatures import is_signed
from flasher.station.records.store import Store
from flasher.station.reports import Report
from flasher.station.sealed import plain, sealed_in
from tests.station.factory import SERIAL, USUAL, Bench

HOSTILE = "<script>alert(1)</script>\u202e\x07"
OLD_CERTIFICATE = Path(__file__).with_name("old_certificate.txt")
"""As flasher wrote it when documents had schema 2."""
GOLDEN = '\n[golden]\nserial_numbers = ["W2600001"]\nevery_h = 8\n'


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A golden unit, a good unit, one that failed first and was refused, one in work."""
    bench = Bench(tmp_path_factory.mktemp("plant"))
    bench.use(USUAL + GOLDEN)
    bench.make(serial="W2600001")
    bench.make(lot="=L1")
    bench.make(RunState.FAIL, "W2605003", code="REFUSED")
    bench.make(RunState.PASS, "W2605003")
    run_id = bench.claim("W2605004").run_id
    bench.work(run_id)
    low = [
        Measurement("voltage", 29.5, "V", 30.0, 42.0),
        Measurement("model", text=HOSTILE, expected="M1"),
    ]
    bench.store.step(run_id, "check", StepState.FAIL, duration_s=1.0, measurements=low)
    ending = bench.ending(RunState.FAIL, "LIMIT")
    object.__setattr__(ending, "text", HOSTILE)
    bench.store.finish(run_id, ending)
    bench.claim("W2605005")
    yield bench
    bench.store.close()


@pytest.fixture(scope="module")
def report(plant: Bench) -> Report:
    return Report(plant.store, RunFilter())


def page(bench: Bench, serial: str) -> str:
    life = bench.store.read.unit(serial)
    now = bench.clock.utc()
    return render_certificate(life, now, proven(bench.store, life, now))


@pytest.mark.slow
def test_a_report_s_rows_are_the_runs(plant: Bench, report: Report) -> None:
    with plant.outsider() as connection:
        run_ids = connection.execute("SELECT id FROM run ORDER BY id").fetchall()
    runs = [plant.store.read.run(run_id).run for (run_id,) in run_ids]
    assert report.runs == runs


def test_a_json_report_is_json_with_its_shares(report: Report) -> None:
    document: dict[str, Any] = json.loads(report.to_json())
    assert document["figures"]["yield_share"] == pytest.approx(2 / 3)
    assert document["figures"]["first_pass_share"] == pytest.approx(1 / 3)
    assert document["figures"]["failures"] == {"LIMIT": 1, "REFUSED": 1}
    assert document["figures"]["by_state"] == {"pass": 2, "fail": 2, "running": 1}
    assert [run["state"] for run in document["runs"]].count("running") == 1


FORM = {
    "run_id": 4, "serial": "W2605003", "part": "BAT-36", "lot": None, "kind": "production",
    "is_virtual": False, "state": "pass", "code": "OK", "text": "",
    "begun_at": "2026-05-17T09:00:30.000000Z", "ended_at": "2026-05-17T09:00:38.000000Z",
    "duration_s": 8.0, "station": "line-2", "socket": "A", "operator": "jo",
    "recipe": "Battery 36 V", "recipe_revision": "4", "verified": "version", "reason": "",
    "duplicates": None,
}  # fmt: skip
"""A run as programs read it, without hashes: a change of it needs a new SCHEMA_VERSION."""


def test_a_run_has_one_form_wherever_it_is_written(plant: Bench, report: Report) -> None:
    details = plant.store.read.unit("W2605003").runs[-1]
    run = details.run
    handed_over = adapter(RunDocument).dump_json(RunDocument("key", UUID(int=0), 1, details))
    form = json.loads(report.to_json())["runs"][3]
    assert form == FORM | {"recipe_sha256": run.recipe_sha256, "log_sha256": run.log_sha256}
    assert as_json(run) == form
    assert as_json(UnitLife("", "", UnitState.PASS, (details,)))["runs"][0]["run"] == form
    assert as_json(RunEnded(run, "Take it out."))["run"] == form
    assert as_json(PassedTwice(run, run))["second"] == form
    assert json.loads(handed_over)["run"]["run"] == form
    target = {"required": "version", "reached": "version"}
    assert target.items() <= json.loads(handed_over)["run"]["targets"][0].items()


def test_counts_of_units_have_one_form(report: Report) -> None:
    shares = {"yield_share": pytest.approx(2 / 3), "first_pass_share": pytest.approx(1 / 3)}
    counts = {"units": 3, "passed": 2, "first_passed": 1, **shares}
    assert as_json(Activity(day=Units(3, 2, 1)))["day"] == counts
    assert counts.items() <= as_json(FiguresChanged(report.figures))["figures"].items()


def test_a_certificate_of_an_older_flasher_is_read_as_it_was_signed() -> None:
    """It has levels as numbers and states in capitals, and is not migrated."""
    sealed = sealed_in(OLD_CERTIFICATE.read_text(encoding="ascii"))
    assert sealed.earlier[0]["verified"] == 1
    assert sealed.wrong() == []
    earlier, last = (details.run for details in sealed.life().runs)
    assert (earlier.verified, last.verified) == (Verified.VERSION, Verified.VERSION)
    assert (earlier.state, last.state) == (RunState.PASS, RunState.PASS)
    assert plain(earlier) == sealed.earlier[0], "a new certificate has the same form"


def test_a_value_that_no_station_writes_is_named(bench: Bench) -> None:
    bench.make()
    bench.store.close()
    bench.forge("UPDATE run SET begun_at = 'yesterday'")
    with Store.open(str(bench.path), station="reader", read_only=True) as store:
        with pytest.raises(RecordsDamagedError) as caught:
            Report(store, RunFilter()).to_csv()
        assert caught.value.where == "run 1, begun_at"
        assert "'yesterday'" in caught.value.cause
        with pytest.raises(RecordsDamagedError):
            Overview(store.database).runs(RunFilter(), PageCursor())
        with pytest.raises(RecordsDamagedError) as caught:
            store.read.unit(SERIAL)
        assert caught.value.where == "run 1, run.begun_at"


def test_a_csv_report_has_a_row_a_run_and_no_formula(report: Report) -> None:
    rows = list(csv.DictReader(io.StringIO(report.to_csv())))
    assert len(rows) == len(report.runs)
    words = {"state": "PASS", "verified": "version", "begun_at": "2026-05-17T09:00:30.000000Z"}
    assert words.items() <= rows[3].items()
    assert rows[1]["lot"] == "'=L1"
    assert rows[1]["duration_s"] == "8.000"
    assert rows[-1]["ended_at"] == ""
    assert Report(report.store, RunFilter(serial="nowhere")).to_csv() == ""


def test_a_junit_report_counts_failures_and_leaves_out_golden_units(report: Report) -> None:
    suite = Xml.fromstring(report.to_junit()).find("testsuite")  # noqa: S314  it is ours
    assert suite is not None
    assert {name: suite.get(name) for name in ("tests", "failures", "errors")} == {
        "tests": "4",
        "failures": "2",
        "errors": "0",
    }
    cases = suite.findall("testcase")
    assert [case.get("name") for case in cases] == [SERIAL, "W2605003", "W2605003", "W2605004"]
    failure = cases[-1].find("failure")
    assert failure is not None
    assert failure.get("type") == "LIMIT"
    assert failure.get("message") == "<script>alert(1)</script>\\u202e\\x07"


@pytest.mark.slow
def test_a_report_of_a_filter_names_it(plant: Bench) -> None:
    report = Report(plant.store, RunFilter(lot="=L1"))
    assert len(report.runs) == 1
    assert json.loads(report.to_json())["filter"]["lot"] == "=L1"


def test_the_life_of_a_unit_is_a_document(plant: Bench) -> None:
    document = json.loads(json.dumps(as_json(plant.store.read.unit("W2605003"))))
    assert document["state"] == "pass"
    assert [run["run"]["state"] for run in document["runs"]] == ["fail", "pass"]
    assert document["runs"][1]["targets"][0]["reached"] == "version"
    assert document["runs"][1]["writes"][0]["what"] == "flash"


def test_a_certificate_reports_what_was_written_and_how_far_it_was_verified(plant: Bench) -> None:
    html = page(plant, SERIAL)
    run = plant.store.read.unit(SERIAL).runs[-1].run
    assert run.log_sha256
    target = plant.recipe.targets[0]
    for text in (
        "Flash certificate",
        ">PASS<",
        SERIAL,
        "version read back",
        target.image.sha256,
        target.version,
        plant.recipe.sha256,
        run.log_sha256,
    ):
        assert text in html, text
    assert "Earlier runs" not in html


def test_the_code_on_the_paper_states_record_and_signed_row(
    plant: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[str] = []
    make = segno.make

    def listening(text: str, **options: Any) -> Any:
        reported.append(text)
        return make(text, **options)

    monkeypatch.setattr("segno.make", listening)
    html = page(plant, "W2605003")
    lines = dict(line.split(" ", 1) for line in reported[0].splitlines())
    run_id = plant.store.read.unit("W2605003").runs[-1].run.run_id
    head = plant.store.read.head_of(run_id)
    assert head is not None
    assert lines["unit"] == "W2605003"
    assert lines["record"] == plant.store.read.record_sha256(run_id)
    assert is_signed(lines["hash"], lines["signature"], lines["key"])
    assert lines["hash"] == head.hash
    assert lines["record"] in html
    assert 'class="qr"' in html


@pytest.mark.slow
def test_a_unit_that_did_not_pass_has_no_certificate(plant: Bench) -> None:
    html = page(plant, "W2605004")
    assert "Flash certificate" not in html
    assert ">FAIL<" in html
    assert "did not pass" in html
    assert "outside" in html
    assert "from 30 to 42 V" in html
    for serial, text in (("W2605005", "no verdict yet"), ("W2600001", "golden unit")):
        html = page(plant, serial)
        assert text in html
        assert "Flash certificate" not in html


def test_what_a_device_sent_cannot_act_on_the_page(plant: Bench) -> None:
    html = page(plant, "W2605004")
    assert "<script>" not in html
    assert "\u202e" not in html
    assert "&lt;script&gt;" in html


def test_only_what_has_limits_is_within_them(bench: Bench) -> None:
    run_id = bench.claim().run_id
    bench.work(run_id)
    free, bound = Measurement("model", text="M1"), Measurement("voltage", 36.0, "V", 30.0, 42.0)
    bench.store.step(run_id, "check", StepState.PASS, duration_s=1.0, measurements=[free, bound])
    assert page(bench, SERIAL).count(">within<") == 1


@pytest.mark.slow
def test_a_virtual_unit_has_no_certificate_and_is_marked_everywhere(bench: Bench) -> None:
    run_id = bench.make(is_virtual=True)
    html = page(bench, SERIAL)
    assert "Flash certificate" not in html
    assert ">VIRTUAL PASS<" in html
    assert "it is not a product" in html
    made = Report(bench.store, RunFilter())
    assert made.figures.virtual_runs == 1
    (row,) = csv.DictReader(io.StringIO(made.to_csv()))
    assert row["is_virtual"] == "yes"
    assert "virtual Battery" in made.to_junit()
    assert bench.store.read.run(run_id).run.is_virtual


def test_earlier_runs_are_on_the_page(plant: Bench) -> None:
    html = page(plant, "W2605003")
    assert "Earlier runs" in html
    assert "REFUSED" in html


def test_nothing_is_certified_for_a_unit_without_runs(plant: Bench, tmp_path: Path) -> None:
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="no run to certify"):
        render_certificate(UnitLife("W1", "P", UnitState.NEW, ()), plant.clock.utc(), None)
