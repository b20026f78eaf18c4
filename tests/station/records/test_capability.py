"""Cpk and Ppk of measurements, against values that were computed by hand."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable

import pytest

from flasher.report.scale import figure_text
from flasher.station.records.capability import VALUES_MIN, Basis, Capability
from flasher.station.records.model import Measurement, RunFilter, RunState, StepState
from flasher.station.reports import Report
from tests.station.factory import Bench

VALUES = (9.0, 10.0, 11.0, 10.0) * 10
"""Mean 10; squares 20; each differs from the one before by 1."""
DEVIATION = math.sqrt(20 / 39)


def measure(
    bench: Bench,
    values: Iterable[float],
    *,
    low: float | None = 7.0,
    high: float | None = 14.0,
    serial: str = "W2605002",
    socket: str = "A",
) -> None:
    """A run with all these values."""
    made = [Measurement("voltage", value, "V", low, high) for value in values]
    is_good = all(each.is_within for each in made)
    claim = bench.claim(serial, socket, reason="another recipe")
    bench.work(claim.run_id)
    bench.store.step(
        claim.run_id,
        "check",
        StepState.PASS if is_good else StepState.FAIL,
        duration_s=1.0,
        measurements=made,
    )
    state, code = (RunState.PASS, "OK") if is_good else (RunState.FAIL, "OUT_OF_LIMITS")
    bench.store.finish(claim.run_id, bench.ending(state, code, bench.traced(serial)))
    bench.clock.go_on(2.0)


def only(bench: Bench, chosen: RunFilter = RunFilter()) -> Capability:  # noqa: B008  frozen
    (found,) = bench.store.read.capabilities(chosen)
    return found


@pytest.mark.slow
def test_no_figure_is_rounded_to_an_exponent(bench: Bench) -> None:
    measure(bench, (1_499_999.0, 1_500_001.0), low=1_234_567.0, high=99_999_999.5)
    found = only(bench)
    assert (found.limits, figure_text(found.mean)) == ("1,234,567 to 99,999,999.5", "1,500,000")
    values = (99_999.7, -123_456.7, 40_153.4, 2.874168, 0.0001234567)
    shown = ["100,000", "-123,457", "40,153", "2.8742", "0.00012346"]
    assert [figure_text(value) for value in values] == shown


def test_both_limits(bench: Bench) -> None:
    measure(bench, VALUES)
    found = only(bench)
    assert (found.part, found.step, found.name, found.unit) == ("BAT-36", "check", "voltage", "V")
    assert (found.count, found.outside, found.basis) == (40, 0, Basis.COMPUTED)
    assert (found.least, found.mean, found.most) == (9.0, 10.0, 11.0)
    assert found.deviation == pytest.approx(DEVIATION, rel=1e-12)
    assert found.ppk == pytest.approx(3 / (3 * DEVIATION), rel=1e-12)  # the low limit is nearer
    assert found.cpk == pytest.approx(3 / (3 * 1 / 1.128), rel=1e-12)


@pytest.mark.parametrize(("low", "high", "distance"), [(7.0, None, 3.0), (None, 14.0, 4.0)])
def test_one_limit_counts_its_side_alone(
    bench: Bench, low: float | None, high: float | None, distance: float
) -> None:
    measure(bench, VALUES, low=low, high=high)
    assert only(bench).ppk == pytest.approx(distance / (3 * DEVIATION), rel=1e-12)


def test_values_outside_give_a_negative_index(bench: Bench) -> None:
    measure(bench, VALUES, low=10.5)
    found = only(bench)
    assert found.outside == 30
    assert found.ppk == pytest.approx(-0.5 / (3 * DEVIATION), rel=1e-12)


@pytest.mark.slow
def test_too_few_values_have_no_index(bench: Bench) -> None:
    measure(bench, VALUES[: VALUES_MIN - 1])
    found = only(bench)
    assert (found.basis, found.cpk, found.ppk) == (Basis.TOO_FEW, None, None)
    measure(bench, [10.0], serial="W2605003", socket="B")
    found = only(bench)
    assert found.basis is Basis.COMPUTED
    assert found.cpk is None  # 28 differences
    measure(bench, [10.5, 11.0], serial="W2605004")
    assert only(bench).cpk is not None


def test_one_value_has_no_deviation(bench: Bench) -> None:
    measure(bench, [10.0])
    assert only(bench).deviation is None


def test_equal_values_are_not_infinitely_capable(bench: Bench) -> None:
    measure(bench, [0.1] * 40, low=0.0)  # ten times 0.1 is not 1
    found = only(bench)
    assert (found.basis, found.deviation) == (Basis.CONSTANT, 0.0)
    assert (found.mean, found.cpk, found.ppk) == (0.1, None, None)


def test_successive_values_are_those_of_a_socket(bench: Bench) -> None:
    """Two sockets that each measure nearly the same, but far from each other."""
    for low_value, serial, socket in ((8.0, "W2605002", "A"), (13.0, "W2605003", "B")):
        values = [low_value + number % 2 / 10 for number in range(31)]
        measure(bench, values, serial=serial, socket=socket)
    found = only(bench)
    assert found.cpk == pytest.approx((14 - found.mean) / (3 * 0.1 / 1.128))
    assert found.ppk is not None
    assert found.ppk < 1
    assert only(bench, RunFilter(socket="B")).mean == pytest.approx(13 + 15 / 310)


def test_other_limits_are_another_row(bench: Bench) -> None:
    measure(bench, [10.0])
    measure(bench, [10.0], high=15.0, serial="W2605003")
    found = bench.store.read.capabilities()
    assert [each.high for each in found] == [14.0, 15.0]


def test_without_limits_there_is_none(bench: Bench) -> None:
    measure(bench, VALUES[:3], low=None, high=None)
    assert bench.store.read.capabilities() == []


@pytest.mark.slow
def test_json_and_csv_have_the_same_numbers(bench: Bench) -> None:
    measure(bench, [value - 12 for value in VALUES], low=-9.0)
    report = Report(bench.store, RunFilter(station="line-2"))
    found = only(bench)
    (row,) = csv.DictReader(io.StringIO(report.to_measurements_csv()))
    assert float(row["mean"]) == found.mean == -2.0
    assert float(row["ppk"]) == pytest.approx(found.ppk, rel=1e-8)
    assert json.loads(report.to_json())["measurements"] == [vars(found)]
    assert Report(bench.store, RunFilter(station="line-3")).measurements == []
