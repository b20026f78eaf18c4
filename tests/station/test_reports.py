"""Reports and certificates: what the records say, in the forms that others read."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as Xml

import pytest
import segno

from flasher.cli.documents import as_json
from flasher.errors import UsageError
from flasher.station.certificate import proven, render_certificate
from flasher.station.records.model import (
    Measurement,
    RunFilter,
    RunState,
    StepState,
    UnitLife,
    UnitState,
    Verified,
)
from flasher.station.records.signatures import is_signed
from flasher.station.reports import Report
from tests.station.factory import SERIAL, USUAL, Bench

HOSTILE = "<script>alert(1)</script>\u202e\x07"
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
    return Report(plant.store.read, RunFilter())


def page(bench: Bench, serial: str) -> str:
    life = bench.store.read.unit(serial)
    now = bench.clock.utc()
    return render_certificate(life, now, proven(bench.store, life, now))


def test_a_report_s_rows_are_the_runs(plant: Bench, report: Report) -> None:
    with plant.outsider() as connection:
        run_ids = connection.execute("SELECT id FROM run ORDER BY id").fetchall()
    runs = [plant.store.read.run(run_id).run for (run_id,) in run_ids]
    assert [row.run_id for row in report.runs] == [run.run_id for run in runs]
    for row, run in zip(report.runs, runs, strict=True):
        same = vars(row).keys() - {"begun_at", "ended_at", "verified"}
        assert {name: getattr(row, name) for name in same} == {
            name: getattr(run, name) for name in same
        }
        verified = None if run.verified is None else run.verified.name.lower()
        assert row.verified == verified


def test_a_json_report_is_json_with_its_shares(report: Report) -> None:
    document: dict[str, Any] = json.loads(json.dumps(report.to_dict()))
    assert document["figures"]["yield_share"] == pytest.approx(2 / 3)
    assert document["figures"]["first_pass_share"] == pytest.approx(1 / 3)
    assert document["figures"]["failures"] == {"LIMIT": 1, "REFUSED": 1}
    assert document["runs"][1]["begun_at"].endswith("Z")
    assert [run["state"] for run in document["runs"]].count("RUNNING") == 1


def test_a_csv_report_has_a_row_a_run_and_no_formula(report: Report) -> None:
    rows = list(csv.DictReader(io.StringIO(report.to_csv())))
    assert len(rows) == len(report.runs)
    assert rows[1]["lot"] == "'=L1"
    assert rows[1]["duration_s"] == "8.000"
    assert rows[-1]["ended_at"] == ""
    assert Report(report.records, RunFilter(serial="nowhere")).to_csv() == ""


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


def test_a_report_of_a_filter_names_it(plant: Bench) -> None:
    report = Report(plant.store.read, RunFilter(lot="=L1"))
    assert len(report.runs) == 1
    assert report.to_dict()["filter"]["lot"] == "=L1"


def test_the_life_of_a_unit_is_a_document(plant: Bench) -> None:
    document = json.loads(json.dumps(as_json(plant.store.read.unit("W2605003"))))
    assert document["state"] == "pass"
    assert [run["run"]["state"] for run in document["runs"]] == ["fail", "pass"]
    assert document["runs"][1]["targets"][0]["reached"] == Verified.VERSION
    assert document["runs"][1]["writes"][0]["what"] == "flash"


def test_a_certificate_tells_what_was_written_and_how_far_it_was_verified(plant: Bench) -> None:
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


def test_the_code_on_the_paper_says_record_and_signed_row(
    plant: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    make = segno.make

    def listening(text: str, **options: Any) -> Any:
        said.append(text)
        return make(text, **options)

    monkeypatch.setattr("segno.make", listening)
    html = page(plant, "W2605003")
    lines = dict(line.split(" ", 1) for line in said[0].splitlines())
    run_id = plant.store.read.unit("W2605003").runs[-1].run.run_id
    head = plant.store.read.head_of(run_id)
    assert head is not None
    assert lines["unit"] == "W2605003"
    assert lines["record"] == plant.store.read.record_sha256(run_id)
    assert is_signed(lines["hash"], lines["signature"], lines["key"])
    assert lines["hash"] == head.hash
    assert lines["record"] in html
    assert 'class="qr"' in html


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


def test_a_virtual_unit_has_no_certificate_and_is_marked_everywhere(bench: Bench) -> None:
    run_id = bench.make(is_virtual=True)
    html = page(bench, SERIAL)
    assert "Flash certificate" not in html
    assert ">VIRTUAL PASS<" in html
    assert "it is not a product" in html
    made = Report(bench.store.read, RunFilter())
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
