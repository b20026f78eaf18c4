"""SO and SP: run only by name, list failed upgrades, and detect slower answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flasher.conformance.catalogue import CASES, WEAR, Selection
from flasher.conformance.diff import compare
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, device_maker, profile_of_mock
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.reports import completed
from flasher.conformance.results import CaseVerdict, RunReport
from flasher.conformance.runner import SuiteOptions, run
from flasher.mock.model import MockDevice
from tests.cli.conftest import Flasher
from tests.conformance.bench import one
from tests.loops import each


class TiredDevice(MockDevice):
    """Never acknowledges packet 3 of its fourth and seventh upgrade."""

    erasures = 0

    def _erase(self, now: float) -> str:
        self.erasures += 1
        return super()._erase(now)

    def _acknowledge(self, now: float) -> str:
        reported = super()._acknowledge(now)
        # The first upgrade is the suite's own, before the case.
        if self.erasures in (5, 9) and self._transfer.stored == 3:
            self._transmitter.drop_unstarted()
        return reported


def worn(
    case_id: str,
    upgrades: int,
    *,
    kind: type[MockDevice] = MockDevice,
    profile: ConformanceProfile | None = None,
    **choices: Any,
) -> RunReport:
    device = replace(MOCK_PROFILE, **choices)
    return run(
        MockSubject(profile=device, make_device=device_maker(kind)),
        profile or profile_of_mock(device),
        selection=Selection((case_id,)),
        options=SuiteOptions(upgrades=upgrades),
    )


def test_they_run_only_when_they_are_named() -> None:
    assert set(WEAR) <= set(CASES)
    assert not set(WEAR) & set(Selection().chosen())
    assert not Selection(quick=True, groups=("SO",)).chosen()
    assert Selection(groups=("SP",)).chosen() == ["SP-01", "SP-02"]
    assert Selection(cases=("SO-01",), quick=True).has("SO-01")
    assert Selection(cases=("SO-01",)).wears() == {"SO-01": 1000}
    assert Selection(groups=("SP",)).wears(7) == {"SP-01": 7, "SP-02": 7}


def test_upgrades_that_fail_are_named_by_their_number() -> None:
    result = one(worn("SO-01", 8, kind=TiredDevice), "SO-01")
    assert result.verdict is CaseVerdict.FAIL
    steps = [check.step for check in result.checks if check.step]
    assert steps == ["upgrade 4", "upgrade 7"]
    assert result.checks[-1].got == "6 of 8; failed: number 4, 7"
    assert "erased and written 8 times" in result.infos[-1]


@pytest.mark.slow
def test_what_passes_is_reported_in_one_check() -> None:
    result = one(worn("SO-01", 30), "SO-01")
    assert [str(check) for check in result.checks] == [
        "expected 30 upgrades, each one verified; got 30 of 30"
    ]


@pytest.mark.slow
def test_a_slower_bootloader_is_seen_in_the_comparison_and_fails_a_limit() -> None:
    before, after = (worn("SP-01", 5, program_time_s=time_s) for time_s in (0.001, 0.004))
    reports = [completed(each, started_at="") for each in (before, after)]
    assert {one(each, "SP-01").verdict for each in (before, after)} == {CaseVerdict.PASS}
    slower = {change.name: change for change in compare(reports[0], reports[1]).slower}
    assert set(slower) == {"packet to ACK", "end of transfer to complete"}
    assert slower["packet to ACK"].after_s > 0.004
    tight = replace(profile_of_mock(), given={**profile_of_mock().given, "limits.ack_s": 0.003})
    late = one(worn("SP-01", 5, program_time_s=0.004, profile=tight), "SP-01")
    assert late.verdict is CaseVerdict.FAIL
    assert "packet to ACK at most 3 ms" in str(late.first_failure)


@pytest.mark.slow
@each(
    "window_s, verdict",
    [(0.2, CaseVerdict.PASS), (0.15, CaseVerdict.FAIL), (0.22, CaseVerdict.FAIL)],
)
def test_a_window_that_ends_elsewhere_is_found(window_s: float, verdict: CaseVerdict) -> None:
    report = worn("SP-02", 30, profile=profile_of_mock(), window_s=window_s)
    assert one(report, "SP-02").verdict is verdict
    (end,) = report.measured()["last boot version to the window's end"]
    # The model's window starts when it queues the last announcement, 1.2 ms before it arrives.
    assert end.value_s == pytest.approx(window_s - 0.0012, abs=0.02)
    taken = report.measured()["last boot version to an update command that is taken"]
    assert max(time.value_s for time in taken) < window_s


def test_a_device_on_a_bus_is_asked_about(flasher: Flasher) -> None:
    bench = ("-t", "bms", "-i", "virtual", "-c", "wear", "--good-image", "README.md")
    ran = flasher("conformance", *bench, "--group", "SO", "--case", "SP-02", "--upgrades", "70")
    assert ran.code == 2
    assert "erased and written: SO-01 70 times, SP-02 70 times" in ran.err
    assert "Add --yes." in ran.err


@pytest.mark.slow
def test_the_text_draws_how_times_are_spread(flasher: Flasher) -> None:
    ran = flasher("conformance", "-t", "bms", "--mock", "--group", "SP", "--upgrades", "40")
    assert ran.code == 0
    line = next(line for line in ran.out.splitlines() if "that is taken" in line)
    assert line.endswith("|")
    assert "@" in line
    assert "SO-01" not in flasher("conformance", "-t", "bms", "--list", "--group", "SP").out
    assert "only when named" in flasher("conformance", "--list").out
