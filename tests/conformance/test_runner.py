"""Runs of the suite: verdicts, known state, rescue, and early ends."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import pytest

from flasher.bus.simulated import SimulatedBus
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import CASES, HOST_CASES, NOT_IMPLEMENTED, Requirement, Selection
from flasher.conformance.mock import MockSubject, device_maker
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.reports import completed, to_bytes
from flasher.conformance.results import CaseVerdict, CheckOutcome, RunReport, Unsupported
from flasher.conformance.runner import SuiteOptions, run
from flasher.conformance.simulated import SimulatedPort
from flasher.conformance.wire import RawFrame
from flasher.errors import UsageError
from flasher.mock.model import MockDevice
from flasher.mock.store import AREA_START
from flasher.protocol.frame import Frame
from tests.loops import each

from .bench import (
    PROFILE,
    Babbler,
    DeafDevice,
    Log,
    RestlessDevice,
    one,
    run_case,
    status_of,
    subject,
)

APPLICATION_ADDRESS: Final = "device.application_address"


def passes(bench: Bench) -> None:
    bench.check(True, "something", "something")


def fails(bench: Bench) -> None:
    with bench.step("first"):
        bench.check(True, "one", "one")
    with bench.step("second"):
        bench.check(False, "two", "three")


def hang(bench: Bench) -> None:
    """The fatal action of a case."""
    assert isinstance(bench.subject, MockSubject)
    assert isinstance(bench.subject.device, DeafDevice)
    bench.subject.device.hangs = True
    passes(bench)


# -- verdicts -------------------------------------------------------------------------------------


def test_a_case_passes_when_its_checks_do() -> None:
    report = run_case(passes)
    assert one(report, "FR-00").verdict is CaseVerdict.PASS
    assert report.ok
    assert report.final_image == "verified"


def test_a_failed_check_is_in_the_result_with_its_step() -> None:
    report = run_case(fails)
    result = one(report, "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    failure = result.first_failure
    assert failure is not None
    assert (failure.step, failure.expected, failure.got) == ("second", "two", "three")
    assert not report.ok


def test_a_required_check_ends_the_case() -> None:
    def stops(bench: Bench) -> None:
        bench.require(False, "a", "b")
        raise AssertionError

    result = one(run_case(stops), "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    assert len(result.checks) == 1


def test_a_case_that_judges_nothing_is_an_error_of_the_suite() -> None:
    assert status_of(lambda _bench: None) is CaseVerdict.ERROR


def test_a_case_that_only_observes_is_information() -> None:
    assert status_of(lambda bench: bench.info("seen")) is CaseVerdict.INFO
    assert status_of(lambda bench: bench.measure("a time", 0.1)) is CaseVerdict.INFO


def test_a_case_that_raises_is_an_error_and_the_run_goes_on() -> None:
    def breaks(_bench: Bench) -> None:
        raise ZeroDivisionError("division by zero")

    report = run_case(breaks, before_others=True)
    result = one(report, "FR-00")
    assert result.verdict is CaseVerdict.ERROR
    assert "ZeroDivisionError" in result.note
    assert one(report, "RS-04").verdict is CaseVerdict.PASS


def test_a_part_that_the_bench_cannot_do_is_reported_and_the_rest_judged() -> None:
    def partly(bench: Bench) -> None:
        bench.unsupported("a thing", "no tool")
        passes(bench)

    def not_to_its_end(bench: Bench) -> None:
        passes(bench)
        raise Unsupported("no tool")

    def only_sent(bench: Bench) -> None:
        bench.unsupported("a thing", "no tool")

    report = run_case(partly)
    assert one(report, "FR-00").verdict is CaseVerdict.PASS_IN_PART
    assert one(report, "FR-00").not_tried == ("a thing (no tool)",)
    assert report.in_full == "0 of 1 passes were judged in full"
    assert report.ok
    strict = run_case(partly, strict=True)
    assert not strict.ok
    (remark,) = strict.remarks()
    assert "strict" in remark
    assert status_of(not_to_its_end) is CaseVerdict.PASS_IN_PART
    assert status_of(only_sent) is CaseVerdict.UNSUPPORTED


@pytest.mark.slow
def test_the_good_image_is_verified_by_what_there_is_and_the_report_states_how() -> None:
    def seen(target: str, *, readback: bool = False, address: int = 0) -> str:
        device = MockSubject(target)
        device.has_readback = readback
        profile = replace(PROFILE, given={**PROFILE.given, APPLICATION_ADDRESS: address})
        return run_case(passes, device=device, profile=profile).final_image_text

    by_version = "flashed and verified by version"
    not_read = f"{by_version}; no readback was possible"
    assert seen("bms", readback=True) == f"{by_version} and readback"
    assert seen("bms") == not_read
    assert seen("bms", address=AREA_START) == f"{by_version} and memory over the bus"
    assert seen("bms", address=0x1000) == not_read  # it tells nothing from there
    assert seen("bms", address=AREA_START + 128) != not_read
    assert seen("wmc", readback=True) == "flashed and verified by readback"
    assert seen("wmc", address=AREA_START).startswith("flashed, an application answers")


def test_an_application_without_a_version_is_known_by_the_flash_once_it_may_be_another() -> None:
    def restarted(bench: Bench) -> None:
        bench.reset_to_bootloader()
        bench.check_application()

    def upgraded(bench: Bench) -> None:
        bench.upgrade(bench.good_image)
        bench.check_application()

    def without_readback(action: Callable[[Bench], None]) -> CaseVerdict:
        device = MockSubject("wmc")
        device.has_readback = False
        return one(run_case(action, device=device), "FR-00").verdict

    assert without_readback(restarted) is CaseVerdict.PASS
    assert without_readback(upgraded) is CaseVerdict.PASS_IN_PART
    report = run_case(upgraded, device=MockSubject("wmc"))
    assert one(report, "FR-00").verdict is CaseVerdict.PASS
    assert "the flash holds the image" in [one.expected for one in report.results[0].checks]


def test_a_time_at_its_limit_is_inconclusive_within_the_uncertainty() -> None:
    def timed(value_s: float) -> CaseVerdict:
        device = subject()
        device.port.uncertainty_s = 0.002
        action = lambda bench: bench.check_time("t", value_s, low_s=0.1, high_s=0.2)  # noqa: E731
        return one(run_case(action, device=device), "FR-00").verdict

    assert timed(0.15) is CaseVerdict.PASS
    assert timed(0.199) is CaseVerdict.INCONCLUSIVE
    assert timed(0.101) is CaseVerdict.INCONCLUSIVE
    assert timed(0.21) is CaseVerdict.FAIL
    assert timed(0.05) is CaseVerdict.FAIL


def test_a_documented_deviation_is_no_failure() -> None:
    profile = ConformanceProfile(PROFILE.given, deviations={"FR-00": "by design"})
    report = run_case(fails, profile=profile)
    result = one(report, "FR-00")
    assert (result.verdict, result.note) == (CaseVerdict.DEVIATION, "by design")
    assert report.ok


def test_a_deviation_that_passes_is_reported_and_fails_a_strict_run() -> None:
    profile = ConformanceProfile(PROFILE.given, deviations={"FR-00": "by design"})
    report = run_case(passes, profile=profile)
    assert one(report, "FR-00").verdict is CaseVerdict.PASS
    assert report.resolved_deviations == ("FR-00",)
    assert report.ok
    assert not run_case(passes, profile=profile, strict=True).ok


# -- what a bench cannot do -----------------------------------------------------------------------


def test_a_case_whose_requirement_is_missing_is_unsupported_with_the_reason() -> None:
    device = subject()
    device.has_power = False
    report = run_case(passes, device=device, requires=frozenset({Requirement.POWER}))
    result = one(report, "FR-00")
    assert (result.verdict, result.note) == (CaseVerdict.UNSUPPORTED, "needs power control")


def test_a_case_that_software_cannot_do_is_in_the_report_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(NOT_IMPLEMENTED, "BU-99", "needs an injector")
    report = run(subject(), PROFILE, selection=Selection(cases=("BU-99",)))
    result = one(report, "BU-99")
    assert result.verdict is CaseVerdict.UNSUPPORTED
    assert "injector" in result.note


def test_no_case_is_both_implemented_and_not() -> None:
    assert not set(CASES) & set(NOT_IMPLEMENTED)
    assert not set(HOST_CASES) & set(NOT_IMPLEMENTED)


def test_what_is_not_selected_is_named() -> None:
    report = run(subject(), PROFILE, selection=Selection(cases=("RS-04",)))
    assert {case_id for case_id in CASES if case_id != "RS-04"} <= set(report.not_selected)


def test_a_quick_run_leaves_out_what_is_long_unless_it_is_named() -> None:
    assert not Selection(quick=True).has("UP-01")
    assert Selection(quick=True, cases=("UP-01",)).has("UP-01")
    assert Selection(groups=("UP",)).has("UP-01")
    assert not Selection(groups=("UP",)).has("RS-01")


@each(
    "selection, reported",
    [
        (Selection(cases=("RS-1",)), "Did you mean RS-0"),
        (Selection(groups=("XX",)), "There is no group"),
    ],
)
def test_a_case_or_group_that_does_not_exist_is_refused(
    selection: Selection, reported: str
) -> None:
    with pytest.raises(UsageError) as raised:
        run(subject(), PROFILE, selection=selection)
    assert reported in str(raised.value)


# -- the known state ------------------------------------------------------------------------------


def test_the_device_has_the_good_image_before_a_case_and_after_it() -> None:
    device = subject()

    def erases(bench: Bench) -> None:
        assert device.device.stored_image == device.good_image
        bench.start_transfer(len(bench.good_image))
        assert device.device.stored_image is None

    report = run_case(erases, device=device)
    assert device.device.stored_image == device.good_image
    assert report.rescues == ()


def test_a_case_that_leaves_the_power_off_is_tidied_up_after() -> None:
    def leaves_off(bench: Bench) -> None:
        bench.power_off()
        passes(bench)

    report = run_case(leaves_off, before_others=True)
    assert one(report, "FR-00").verdict is CaseVerdict.PASS
    assert one(report, "RS-04").verdict is CaseVerdict.PASS


def test_a_device_that_only_a_power_cycle_brings_back_fails_the_case_and_the_run_goes_on() -> None:
    report = run_case(hang, device=subject(DeafDevice), before_others=True)
    result = one(report, "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    assert "power cycle" in (result.first_failure.got if result.first_failure else "")
    assert [rescue.id for rescue in report.rescues] == ["FR-00"]
    assert one(report, "RS-04").verdict is CaseVerdict.PASS
    assert report.final_image == "verified"


@each("has_power", [False, True])
def test_a_device_that_is_killed_ends_the_run_and_names_the_case(has_power: bool) -> None:
    device = subject(DeafDevice)
    assert isinstance(device.device, DeafDevice)
    device.device.hangs_for_good = True
    device.has_power = has_power
    report = run_case(hang, device=device, before_others=True)
    assert report.killed_by == "FR-00"
    assert "could not be restored" in report.stopped
    assert one(report, "FR-00").verdict is CaseVerdict.FAIL
    assert one(report, "RS-04").verdict is CaseVerdict.NOT_RUN
    assert not report.ok
    assert "not flashed" in report.final_image


def test_a_device_that_is_deaf_from_the_start_ends_the_run_in_bounded_time() -> None:
    device = subject(DeafDevice)
    assert isinstance(device.device, DeafDevice)
    device.device.hangs = device.device.hangs_for_good = True
    report = run(device, PROFILE)
    assert "before the first case" in report.stopped
    assert one(report, "BR-01").verdict is CaseVerdict.FAIL
    assert {result.verdict for result in report.results if result.case_id != "BR-01"} <= {
        CaseVerdict.NOT_RUN,
        CaseVerdict.UNSUPPORTED,
    }
    assert report.killed_by == ""
    assert report.duration_s < 600


def test_a_device_that_cannot_be_upgraded_is_judged_all_the_same() -> None:
    report = run(
        MockSubject("bms", good_image=bytes(300 * 1024)),
        PROFILE,
        selection=Selection(groups=("RS",)),
    )
    assert report.not_upgradable
    assert report.stopped == ""
    assert one(report, "RS-04").verdict in (CaseVerdict.PASS, CaseVerdict.FAIL)
    assert not report.ok


def test_a_case_about_a_running_application_is_inconclusive_where_none_could_be_flashed() -> None:
    empty = device_maker(partial(MockDevice, has_application=False))
    report = run(
        MockSubject("bms", good_image=bytes(300 * 1024), make_device=empty),
        PROFILE,
        selection=Selection(cases=("BR-01", "RS-01", "RS-04", "UP-03", "UP-05")),
    )
    assert one(report, "BR-01").verdict is CaseVerdict.FAIL
    assert one(report, "UP-05").verdict is CaseVerdict.FAIL
    for case_id in ("RS-01", "RS-04", "UP-03"):
        result = one(report, case_id)
        assert result.verdict is CaseVerdict.INCONCLUSIVE, case_id
        assert "the good image could not be flashed" in result.reason
        assert report.not_upgradable in result.reason
    assert not report.ok


class LateDevice(MockDevice):
    """Receives no packet in the first minutes, as by a loose contact."""

    def receive(self, frame: Frame, now: float) -> None:
        if now > 200.0 or frame.data[4:6] != b"\xa3\x85":
            super().receive(frame, now)


@pytest.mark.slow
def test_a_run_whose_first_upgrade_failed_is_not_ok_although_its_last_one_did_not() -> None:
    empty = device_maker(partial(LateDevice, has_application=False))
    report = run_case(
        fails,
        device=MockSubject("bms", make_device=empty),
        requires=frozenset({Requirement.APPLICATION}),
    )
    assert one(report, "FR-00").verdict is CaseVerdict.INCONCLUSIVE
    assert (report.final_image, report.stopped) == ("verified", "")
    assert report.not_upgradable
    assert not report.ok


def test_an_application_that_still_runs_is_judged_although_the_good_image_is_refused() -> None:
    device = MockSubject("bms", good_image=bytes(300 * 1024))
    report = run(device, PROFILE, selection=Selection(cases=("RS-01", "RS-04")))
    assert report.not_upgradable
    assert {result.verdict for result in report.results} == {CaseVerdict.PASS}


def test_an_adapter_that_is_unplugged_ends_the_run_with_a_true_report() -> None:
    device = subject()

    def unplug(bench: Bench) -> None:
        device.bus.unplug()
        bench.wait(1.0)

    report = run_case(unplug, device=device, before_others=True)
    assert one(report, "FR-00").verdict is CaseVerdict.ERROR
    assert "adapter failed in FR-00" in report.stopped
    assert one(report, "RS-04").verdict is CaseVerdict.NOT_RUN
    assert not report.ok


@pytest.mark.slow
def test_a_node_that_babbles_beside_the_device_is_no_failure_of_it() -> None:
    device = MockSubject("bms", others=[Babbler(0.002)])
    report = run(device, PROFILE, selection=Selection(cases=("RS-01", "RS-04", "UP-05")))
    assert report.ok


@pytest.mark.slow
@pytest.mark.no_cover
def test_a_bus_that_is_taken_ends_the_run_in_bounded_time() -> None:
    short = {f"limits.{name}_s": 0.02 for name in ("first_version", "pause", "erase", "silence")}
    profile = ConformanceProfile({**PROFILE.given, **short})
    device = MockSubject("bms", others=[Babbler(0.0)])
    report = run(device, profile, selection=Selection(cases=("RS-01", "RS-04")))
    assert "before the first case" in report.stopped
    assert report.duration_s < 60


@pytest.mark.slow
def test_a_device_that_resets_at_random_is_not_taken_for_a_good_one() -> None:
    report = run(
        subject(RestlessDevice), PROFILE, selection=Selection(cases=("RS-01", "RS-04", "UP-05"))
    )
    assert not report.ok
    assert report.duration_s < 1800


# -- limits ---------------------------------------------------------------------------------------


def test_a_case_that_does_not_end_is_ended() -> None:
    def waits(bench: Bench) -> None:
        while True:
            bench.wait(10.0)

    result = one(run_case(waits, limit_s=60.0), "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    assert result.note.startswith("not finished after 60 s")
    assert result.duration_s <= 61


def test_a_run_that_takes_too_long_reports_the_rest_as_not_run() -> None:
    report = run(
        subject(),
        PROFILE,
        selection=Selection(groups=("RS",)),
        options=SuiteOptions(limit_s=5.0),
    )
    assert report.stopped
    statuses = [result.verdict for result in report.results]
    assert statuses[0] is CaseVerdict.PASS
    assert statuses[-1] is CaseVerdict.NOT_RUN
    assert report.final_image == "verified"


def test_somebody_can_stop_the_run() -> None:
    report = run(
        subject(), PROFILE, selection=Selection(cases=("RS-01", "RS-04")), stopped=lambda: True
    )
    assert {result.verdict for result in report.results} == {CaseVerdict.NOT_RUN}
    assert report.stopped


# -- the report -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_gives_the_same_report_and_chance_differs_by_case_and_repeat() -> None:
    drawn: list[int] = []

    def draws(bench: Bench) -> None:
        drawn.append(bench.random.getrandbits(64))
        passes(bench)

    reports = [run_case(draws) for _ in range(2)]
    assert reports[0] == reports[1]
    assert drawn[0] == drawn[1]

    def twice(seed: str) -> object:
        options = SuiteOptions(seed=seed, repeat=2)
        return run(subject(), PROFILE, selection=Selection(cases=("UP-01",)), options=options)

    assert twice("7") == twice("7")


@pytest.mark.slow
def test_a_message_that_is_delivered_in_one_go_takes_the_same_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And each answer and frame of another node: as if its frames were delivered one by one."""
    cases = ("TX-02", "PW-02")  # also power cuts
    trace: list[tuple[object, float]] = []
    record = SimulatedPort._record

    def noted(port: SimulatedPort, frame: Frame, at: float) -> Sequence[Frame]:
        trace.append((frame, at))
        return record(port, frame, at)

    monkeypatch.setattr(SimulatedPort, "_record", noted)

    def judged() -> tuple[RunReport, list[tuple[object, float]]]:
        trace.clear()
        device = MockSubject("bms", others=[Babbler(0.017)])
        return run(device, PROFILE, selection=Selection(cases=cases)), [*trace]

    in_one_go = judged()
    monkeypatch.setattr(SimulatedBus, "advance_message", SimulatedBus.advance)
    assert judged() == in_one_go
    assert {result.verdict for result in in_one_go[0].results} == {CaseVerdict.PASS}


def test_a_case_is_repeated_with_a_seed_of_its_own() -> None:
    report = run(
        subject(), PROFILE, selection=Selection(cases=("RS-04",)), options=SuiteOptions(repeat=3)
    )
    assert [result.repeat for result in report.results] == [1, 2, 3]
    assert len({result.seed for result in report.results}) == 3


def test_a_listener_gets_events_in_order() -> None:
    log = Log()
    run_case(passes, log=log)
    assert log.lines == [
        "run of 1",
        "preparing before the first case",
        "begins FR-00 1",
        "preparing after FR-00",
        "ends FR-00 pass",
        "preparing at the end",
    ]


def test_the_report_is_json_with_everything_in_it() -> None:
    report = run(subject(), PROFILE, selection=Selection(cases=("RS-01",)))
    document = json.loads(to_bytes(completed(report, started_at="")))
    assert document["passed"] is True
    (result,) = document["results"]
    assert result["status"] == "pass"
    first = report.results[0].trace[0]
    assert (first.sent, first.frame.can_id) == (True, 0x752)
    assert first.frame.data.hex() == "55aa160742055245"
    assert [text["id"] for text in document["cases"]] == ["RS-01"]
    assert document["profile"]["tx_02"] == "ack"


def test_the_trace_keeps_the_newest_frames_and_counts_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.conformance.tester.TRACE_FRAMES", 10)

    def talks(bench: Bench) -> None:
        for number in range(25):
            bench.send([RawFrame(0x7FF, bytes((number,)))])
        passes(bench)

    result = one(run_case(talks), "FR-00")
    assert [entry.frame.data[0] for entry in result.trace] == list(range(15, 25))
    assert result.trace_dropped == 15


# -- stalls of this program ------------------------------------------------------------------------


def _stand_still(bench: Bench, for_s: float) -> None:
    """Let time pass while the suite does nothing."""
    bus, until = bench.subject.port.bus, bench.now + for_s  # type: ignore[attr-defined]
    while bench.now < until:
        bus.advance(until)


class _Stalls:
    """A case that sends packet 1, and stalls for 0.3 s in it in its first `times` runs."""

    def __init__(self, times: int) -> None:
        self.runs = 0
        self._times = times

    def __call__(self, bench: Bench) -> None:
        self.runs += 1
        image = bench.filler(10)
        bench.start_transfer(len(image))
        port, send = bench.subject.port, bench.subject.port.send
        stalls_due = [self.runs <= self._times]

        def stalling(frame: RawFrame) -> None:
            send(frame)
            if stalls_due.pop() if stalls_due else False:
                _stand_still(bench, 0.3)

        vars(port)["send"] = stalling
        try:
            bench.packet(image, 1)
        finally:
            del vars(port)["send"]


class _NeverAcknowledges(MockDevice):
    def _acknowledge(self, now: float) -> str:
        self._transfer.stored += 1
        return ""


def test_a_failure_while_this_program_stalled_is_run_again_and_is_inconclusive() -> None:
    case = _Stalls(times=1)
    report = run_case(case)
    result = one(report, "FR-00")
    assert result.verdict is CaseVerdict.INCONCLUSIVE
    assert case.runs == 2
    assert "first run: fail, while this program stalled for 300 ms" in result.note
    assert "second run: pass" in result.note
    failed = [check.step for check in result.checks if check.outcome is CheckOutcome.FAIL]
    assert failed == ["first run"]
    assert not report.ok


def test_a_failure_in_both_runs_is_a_failure() -> None:
    case = _Stalls(times=2)
    result = one(run_case(case), "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    assert case.runs == 2
    assert "failed twice" in result.note


def test_a_failure_without_a_stall_is_not_run_again() -> None:
    case = _Stalls(times=0)
    result = one(run_case(case, device=subject(_NeverAcknowledges)), "FR-00")
    assert result.verdict is CaseVerdict.FAIL
    assert case.runs == 1


def test_a_stall_that_harms_nothing_is_not_run_again() -> None:
    def stalls_before(bench: Bench) -> None:
        _stand_still(bench, 0.3)
        bench.check_application()

    assert one(run_case(stalls_before), "FR-00").verdict is CaseVerdict.PASS
