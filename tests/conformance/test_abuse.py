"""Misbehaving devices: every run ends in bounded time with a correct report."""

from __future__ import annotations

import random

import pytest

from flasher.cli.bench.conformance import exit_code
from flasher.conformance.catalogue import Case, Selection
from flasher.conformance.html_report import html_page
from flasher.conformance.mock import MockSubject, device_maker
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.reports import completed, junit_report, to_bytes
from flasher.conformance.results import CaseVerdict, RunReport
from flasher.conformance.runner import RunObserver, run
from flasher.errors import ExitCode
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from tests.loops import each

from .bench import PROFILE, Babbler, DeafDevice

CASES = ("RS-01", "RS-03", "RS-04", "UP-05", "EN-01", "EN-02")
SELECTION = Selection(cases=CASES)
BOUND_S = 600.0 + 72 * 60
"""A healthy run of these cases takes about 20 s of bus time, beside the 72 min of RS-03."""
IMPATIENT = ConformanceProfile(
    {
        **PROFILE.given,
        **{
            f"limits.{name}": 0.06
            for name in (
                "first_version_s",
                "pause_s",
                "erase_s",
                "complete_s",
                "start_s",
                "silence_s",
            )
        },
    }
)
"""A babbling node is simulated frame by frame: short limits keep that cheap."""


class MoodyDevice(MockDevice):
    """Loses its power briefly at random times, with a fixed seed."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[arg-type]
        self._chance = random.Random(5)

    def receive(self, frame: Frame, now: float) -> None:
        super().receive(frame, now)
        if self._chance.random() < 0.01:
            self.power_cut(now)
            self.power_on(now)


class Unplugger(RunObserver):
    """Unplugs the adapter when a case begins."""

    def __init__(self, subject: MockSubject, case_id: str) -> None:
        self._subject = subject
        self._case_id = case_id

    def case_began(self, case: Case, repeat: int) -> None:
        if case.id == self._case_id:
            self._subject.bus.unplug()


def assert_true_report(report: RunReport) -> None:
    """The run is bounded, every selected case has a verdict, and all reports can be written."""
    assert report.duration_s < BOUND_S
    assert {result.case_id for result in report.results} == {text.id for text in report.cases}
    assert all(
        result.first_failure or result.note
        for result in report.results
        if result.verdict
        in (CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.NOT_RUN, CaseVerdict.UNSUPPORTED)
    )
    assert not report.ok
    for make in (html_page, junit_report, to_bytes):
        assert make(completed(report, started_at=""))


def test_a_deaf_device_was_never_judged() -> None:
    subject = MockSubject("bms", make_device=device_maker(DeafDevice))
    assert isinstance(subject.device, DeafDevice)
    subject.device.hangs = subject.device.hangs_for_good = True
    report = run(subject, PROFILE, selection=SELECTION)
    assert_true_report(report)
    assert report.count(CaseVerdict.PASS) == report.count(CaseVerdict.FAIL) == 0
    assert "before the first case" in report.stopped
    assert report.final_image != "verified"
    assert exit_code(report, was_stopped=False) is ExitCode.NO_ANSWER


@pytest.mark.slow
def test_a_device_that_resets_at_random_fails_and_the_run_goes_on() -> None:
    report = run(
        MockSubject("bms", make_device=device_maker(MoodyDevice)), PROFILE, selection=SELECTION
    )
    assert_true_report(report)
    assert report.count(CaseVerdict.FAIL) > 0
    assert exit_code(report, was_stopped=False) is ExitCode.PARTIAL


@pytest.mark.slow
@pytest.mark.no_cover
def test_beside_a_node_that_takes_the_whole_bus_nothing_can_be_judged() -> None:
    report = run(MockSubject("bms", others=[Babbler(0.0)]), IMPATIENT, selection=SELECTION)
    assert_true_report(report)
    assert report.count(CaseVerdict.NOT_RUN) == len(CASES)
    assert exit_code(report, was_stopped=False) in (ExitCode.NO_ANSWER, ExitCode.BUS)


class BabblingDevice(MockDevice):
    """Sends boot versions all the time on its own id."""

    def next_frame(self, now: float) -> Frame | None:
        return Frame(0x725, b"\x55\xaa\x0c\x0bBMSV")

    def deadline(self) -> float | None:
        return 0.0


@pytest.mark.slow
def test_a_device_that_babbles_on_its_own_id_does_not_keep_the_run_from_its_end() -> None:
    report = run(
        MockSubject("bms", make_device=device_maker(BabblingDevice)), IMPATIENT, selection=SELECTION
    )
    assert_true_report(report)
    assert report.count(CaseVerdict.PASS) == 0


@pytest.mark.slow
@each("case_id", ["RS-01", "RS-03", "EN-01"])
def test_an_adapter_unplugged_midway_leaves_the_verdicts_so_far(case_id: str) -> None:
    subject = MockSubject("bms")
    report = run(subject, PROFILE, selection=SELECTION, observer=Unplugger(subject, case_id))
    assert_true_report(report)
    assert f"the adapter failed in {case_id}" in report.stopped
    order = [result.case_id for result in report.results]
    for result in report.results:
        if result.verdict is CaseVerdict.PASS:
            assert order.index(result.case_id) < order.index(case_id)
        elif result.case_id == case_id:
            assert result.verdict is CaseVerdict.ERROR
    assert exit_code(report, was_stopped=False) is ExitCode.BUS
