"""Runs cases one after another, each from the known state, and builds the report.

Restores the device after each case. A device that cannot be restored ends the run: the report names
the case and lists the rest as not run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Final, NamedTuple

import flasher.conformance.cases  # noqa: F401  registers the cases
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import (
    APPLICATION,
    BRING_UP,
    CASES,
    DESTRUCTIVE,
    HOST_CASES,
    NOT_IMPLEMENTED,
    WEAR,
    Case,
    Selection,
    bench_gaps,
    case_text,
    catalogue_order,
    known_cases,
    missing_requirements,
    why_unsupported,
)
from flasher.conformance.profile import ConformanceProfile, check_deviations, profile_keys
from flasher.conformance.restore import (
    BY_POWER,
    RestoreResult,
    is_reachable,
    may_need_power,
    restore,
)
from flasher.conformance.results import (
    FINAL_IMAGE_OK,
    CaseEnded,
    CaseLimitReached,
    CaseResult,
    CaseStopped,
    CaseVerdict,
    Check,
    CheckOutcome,
    DeviceCrashed,
    Rescue,
    RunReport,
    RunStopped,
    Unsupported,
)
from flasher.conformance.subject import Subject, readback_source
from flasher.conformance.wire import reported_version
from flasher.errors import BusError


@dataclass(frozen=True)
class SuiteOptions:
    """Options of a run: `seed` determines all random values, each case runs `repeat` times,
    `limit_s` ends the run on the bench's clock, `strict` fails on resolved deviations, `upgrades`
    is the number of upgrades in a case that wears the device (None: `WEAR`).
    """

    seed: str = "1"
    repeat: int = 1
    limit_s: float | None = None
    strict: bool = False
    upgrades: int | None = None


_EVERYTHING: Final = Selection()
_PLAIN: Final = SuiteOptions()


class RunObserver:
    """Receives the progress of a run; the methods do nothing and are meant to be overridden."""

    def run_began(self, count: int) -> None:
        """The run starts with `count` case runs."""

    def preparing(self, what: str) -> None:
        """The device is being restored; `what` is the reason."""

    def case_began(self, case: Case, repeat: int) -> None: ...

    def case_ended(self, result: CaseResult) -> None: ...


def run(
    subject: Subject,
    profile: ConformanceProfile,
    *,
    selection: Selection = _EVERYTHING,
    options: SuiteOptions = _PLAIN,
    observer: RunObserver | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> RunReport:
    """Run the selected cases on a device and return the report; polls `stopped` meanwhile.

    Raises UsageError for an unknown case, group or deviation. A failing adapter ends the run and is
    in the report.
    """
    check_selection(selection, profile)
    return SuiteRun(subject, profile, options, observer or RunObserver(), stopped).run_all(
        selection.chosen()
    )


def check_selection(selection: Selection, profile: ConformanceProfile) -> None:
    """Raises UsageError for an unknown case, group or deviation."""
    selection.check()
    check_deviations(profile, known_cases())


class CaseEnd(NamedTuple):
    """How a case ended; `stop` is the reason when it also ends the run."""

    verdict: CaseVerdict
    note: str = ""
    stop: str = ""


def execute(case: Case, bench: Bench) -> CaseEnd:
    """Run a case and return its end; never raises."""
    try:
        case.run(bench)
        bench.judge.conclude()
    except CaseStopped:
        return CaseEnd(bench.judge.verdict)
    except Unsupported as ended:
        bench.unsupported("the rest of the case", str(ended))
        bench.judge.conclude()
        return CaseEnd(bench.judge.verdict, str(ended))
    except RunStopped as ended:
        return CaseEnd(CaseVerdict.NOT_RUN, str(ended), str(ended))
    except (CaseLimitReached, DeviceCrashed) as ended:
        with bench.step(bench.judge.ended_in):
            bench.check(False, "the case is completed", ended, by={})  # noqa: FBT003
        return CaseEnd(CaseVerdict.FAIL, str(ended))
    except BusError as error:
        stop = f"the adapter failed in {case.id}: {error.what}"
        return CaseEnd(CaseVerdict.ERROR, error.what, stop)
    except Exception as error:  # noqa: BLE001  a bug of one case must not hide the others
        why = f"error in the case: {type(error).__name__}: {error}"
        return CaseEnd(CaseVerdict.ERROR, why)
    verdict = bench.judge.verdict
    return CaseEnd(verdict, "the case judged nothing" if verdict is CaseVerdict.ERROR else "")


class SuiteRun:
    """A run, either case by case (`begin`, `run_case`, `finish`, `report`) or all (`run_all`)."""

    def __init__(
        self,
        subject: Subject,
        profile: ConformanceProfile,
        options: SuiteOptions,
        observer: RunObserver,
        stopped: Callable[[], bool],
    ) -> None:
        self.stopped = ""
        """Why no further case is run; "" while the run continues."""
        self._subject = subject
        self._profile = profile
        self._options = options
        self._observer = observer
        self._began_at = subject.port.now()
        self._ends_at = self._began_at + (inf if options.limit_s is None else options.limit_s)
        self._asked_to_stop = stopped
        self._results: list[CaseResult] = []
        self._rescues: list[Rescue] = []
        self._adapter_failed = False
        self._not_upgradable = ""
        self._killed_by = ""
        self._no_bring_up: RestoreResult | None = None
        """Why the good image could not be flashed before the first case."""
        self._final_image = ""
        self._final_image_seen_by: tuple[str, ...] = ()

    def run_all(self, chosen: Sequence[str]) -> RunReport:
        """Run these cases; those that the bench cannot run are reported at once."""
        cases: list[Case] = []
        for case_id in chosen:
            case = CASES.get(case_id)
            missing = NOT_IMPLEMENTED.get(case_id, "")
            if case is not None:
                missing = why_unsupported(case, self._subject, self._profile)
            if case is not None and not missing:
                cases.append(case)
            else:
                self.skip_case(case_id, missing)
        self._observer.run_began(len(cases) * self._options.repeat)
        if cases:
            self.begin()
            for repeat in range(1, self._options.repeat + 1):
                for case in cases:
                    self.run_case(case, repeat)
            self.finish()
        return self.report(chosen)

    @property
    def judged(self) -> set[str]:
        """Ids of the cases with a result."""
        return {result.case_id for result in self._results}

    def skip_case(self, case_id: str, why: str) -> None:
        """Report a case as unsupported."""
        self._add(CaseResult(case_id, CaseVerdict.UNSUPPORTED, note=why))

    def begin(self) -> None:
        """Flash the good image before the first case."""
        self._restore("before the first case", flash=True)

    def run_case(self, case: Case, repeat: int = 1) -> CaseResult:
        """Run a case unless the run has ended."""
        if not self.stopped and self._subject.port.now() >= self._ends_at:
            self.stopped = "the run's time limit is over"
        if not self.stopped and self._asked_to_stop():
            self.stopped = "the run was stopped"
        if case.id == BRING_UP and self._no_bring_up is not None:
            return self._add(self._failed_bring_up(self._no_bring_up, repeat))
        if self.stopped:
            return self._add(CaseResult(case.id, CaseVerdict.NOT_RUN, repeat, note=self.stopped))
        self._observer.case_began(case, repeat)
        result, stall = self._run_once(case, repeat)
        if result.verdict is CaseVerdict.FAIL and stall and not self.stopped:
            again, _ = self._run_once(case, repeat)
            result = _of_two_runs(result, again, stall)
        return self._add(result)

    def _run_once(self, case: Case, repeat: int) -> tuple[CaseResult, str]:
        """Run a case and restore the device. Returns the result, and how this program stalled when
        the case failed, or "".
        """
        seed = f"{self._options.seed}/{case.id}/{repeat}"
        bench = Bench(
            self._subject,
            self._profile,
            limit_s=case.limit_with(self._profile, self._subject),
            seed=seed,
            stopped=self._must_stop,
            upgrades=self._options.upgrades or WEAR.get(case.id, 0),
            choices=case.choices_in(self._profile),
        )
        lacks_application = APPLICATION in case.requires and self._lacks_application()
        verdict, note, self.stopped = execute(case, bench)
        self._adapter_failed = bool(self.stopped) and verdict is CaseVerdict.ERROR
        duration_s, checks = bench.tester.elapsed_s, list(bench.judge.checks)
        if lacks_application and verdict is CaseVerdict.FAIL:
            verdict, unsure = CaseVerdict.INCONCLUSIVE, CheckOutcome.INCONCLUSIVE
            note = f"none: the good image could not be flashed ({self._not_upgradable})"
            lacking = Check("", unsure, "an application that runs before the case", note, 0.0)
            checks = [
                replace(check, outcome=unsure) if check.outcome is CheckOutcome.FAIL else check
                for check in (lacking, *checks)
            ]
        if not self.stopped:
            trouble = self.restore_after(case.id, bench, flash=DESTRUCTIVE in case.requires)
            if trouble:
                verdict, wanted = CaseVerdict.FAIL, "the device is reachable afterwards"
                checks.append(Check("", CheckOutcome.FAIL, wanted, trouble, duration_s))
        is_known = case.id in self._profile.deviations
        if verdict is CaseVerdict.FAIL and is_known:
            verdict, note = CaseVerdict.DEVIATION, self._profile.deviations[case.id]
        result = CaseResult(
            case.id,
            verdict,
            repeat,
            seed,
            note,
            tuple(checks),
            tuple(bench.judge.measurements),
            tuple(bench.judge.infos),
            duration_s,
            bench.tester.trace,
            bench.tester.trace_dropped,
            deviation_resolved=is_known and verdict in (CaseVerdict.PASS, CaseVerdict.PASS_IN_PART),
        )
        return result, bench.judge.stall

    def restore_after(self, what: str, bench: Bench, *, flash: bool) -> str:
        """Restore the device after a case or a user's test that used `bench`, unless that left it
        restored; flashes the good image if `flash` is set or it may have been erased. Returns what
        was wrong with the device, or "".
        """
        if bench.is_restored:
            return ""
        erased = flash or bench.tester.update_was_sent
        return self._restore(f"after {what}", flash=erased, case_id=what, is_off=bench.is_off)

    def finish(self) -> str:
        """Flash the good image again and verify it by version and flash content where possible.
        Returns `FINAL_IMAGE_OK` or what failed.
        """
        if self._killed_by:
            self._final_image = "not flashed: the device could not be restored"
            return self._final_image
        self._observer.preparing("at the end")
        try:
            done = restore(self._subject, self._profile, flash=True)
            self._final_image = FINAL_IMAGE_OK if done.ok else done.reason
            if done.ok:
                self._compare_final_image()
        except (BusError, CaseEnded) as error:
            self._final_image = error.what if isinstance(error, BusError) else str(error)
        return self._final_image

    def _compare_final_image(self) -> None:
        """Verify the flashed good image with what the bench has."""
        subject, image = self._subject, self._subject.good_image
        seen_by = [] if reported_version(subject.target, image) is None else ["version"]
        limit_s = CASES[BRING_UP].limit_with(self._profile, subject)
        bench = Bench(subject, self._profile, limit_s=limit_s, seed=self._options.seed)
        try:
            if bench.difference(image, runs=True) is not None:
                self._final_image = "the flash differs from the good image"
                return
            seen_by.append(readback_source(subject, self._profile))
        except Unsupported:  # final_image_text says that it was not
            pass
        self._final_image_seen_by = tuple(seen_by)

    def report(self, chosen: Sequence[str]) -> RunReport:
        """Results so far; `chosen` are the ids of the cases of the run."""
        self._results.sort(key=lambda result: (result.repeat, chosen.index(result.case_id)))
        port = self._subject.port
        return RunReport(
            subject=self._subject.name,
            target=self._subject.target,
            bitrate_bps=port.bitrate_bps,
            timestamp_source=port.timestamp_source,
            uncertainty_s=port.uncertainty_s,
            profile_source=self._profile.source,
            profile={path: self._profile.value(path) for path in profile_keys()},
            seed=self._options.seed,
            strict=self._options.strict,
            cases=tuple(case_text(case_id, self._profile) for case_id in chosen),
            results=tuple(self._results),
            gaps=bench_gaps(missing_requirements(self._subject, self._profile), chosen),
            not_selected=tuple(catalogue_order(set(known_cases()).difference(chosen))),
            host_cases=HOST_CASES,
            stopped=self.stopped,
            adapter_failed=self._adapter_failed,
            not_upgradable=self._not_upgradable,
            killed_by=self._killed_by,
            rescues=tuple(self._rescues),
            final_image=self._final_image,
            final_image_seen_by=self._final_image_seen_by,
            duration_s=port.now() - self._began_at,
        )

    def _lacks_application(self) -> bool:
        """True when the good image could not be flashed, and no earlier application answers."""
        if not self._not_upgradable:
            return False
        subject, stopped = self._subject, self._must_stop
        limit_s = CASES[BRING_UP].limit_with(self._profile, subject)
        bench = Bench(subject, self._profile, limit_s=limit_s, stopped=stopped)
        try:
            return not bench.application_runs(bench.waits.burst_s + bench.limit("start_s"))
        except (BusError, CaseEnded):
            return False  # the case meets the same

    def _failed_bring_up(self, failed: RestoreResult, repeat: int) -> CaseResult:
        """The result of a failed bring-up, with its diagnosis."""
        at_s = failed.trace[-1].at_s if failed.trace else 0.0
        got = "; ".join((*failed.diagnosis, failed.reason))
        check = Check("", CheckOutcome.FAIL, "the device can be upgraded", got, at_s)
        return CaseResult(
            BRING_UP, CaseVerdict.FAIL, repeat, checks=(check,), duration_s=at_s, trace=failed.trace
        )

    def _must_stop(self) -> bool:
        return self._asked_to_stop() or self._subject.port.now() >= self._ends_at

    def _add(self, result: CaseResult) -> CaseResult:
        self._results.append(result)
        self._observer.case_ended(result)
        return result

    # -- the known state --------------------------------------------------------------------------

    def _restore(self, when: str, *, flash: bool, case_id: str = "", is_off: bool = False) -> str:
        self._observer.preparing(when)
        try:
            if is_off:
                self._subject.power(on=True)
            done = self._bring_back(flash=flash, at_first=not case_id)
        except (BusError, CaseEnded) as error:
            self._adapter_failed = isinstance(error, BusError)
            self.stopped = f"{when}: {error.what if isinstance(error, BusError) else error}"
            return ""
        if not done.ok:
            likely = "".join(f"; {each}" for each in done.diagnosis if not case_id)
            self.stopped = f"{when}, the device could not be restored: {done.reason}{likely}"
            self._killed_by = case_id
            return done.reason
        if case_id and done.how == BY_POWER and not may_need_power(self._profile):
            self._rescues.append(Rescue(case_id, done.how))
            return "only a power cycle restored the device"
        return ""

    def _bring_back(self, *, flash: bool, at_first: bool) -> RestoreResult:
        """Restore the known state; a device that could not be upgraded at first only has to be
        reachable. Raises BusError and RunStopped.
        """
        subject, profile, stopped = self._subject, self._profile, self._asked_to_stop
        if self._not_upgradable:
            is_there = is_reachable(subject, profile, stopped)
            return RestoreResult("reset" if is_there else "", "no boot version")
        done = restore(subject, profile, flash=flash, stopped=stopped)
        if not done.ok and at_first:
            self._no_bring_up = done
            if is_reachable(subject, profile, stopped):
                self._not_upgradable = done.reason
                return RestoreResult("reset", done.reason)
        return done


def _of_two_runs(first: CaseResult, second: CaseResult, stall: str) -> CaseResult:
    """The result of a case that failed while this program stalled, and was run once more. Both are
    in it; when they differ, neither counts.
    """
    failed = [
        replace(check, step=", ".join(filter(None, ("first run", check.step))))
        for check in first.checks
        if check.outcome is not CheckOutcome.PASS
    ]
    checks = (*failed, *second.checks)
    if second.verdict is first.verdict:
        return replace(second, checks=checks, note=f"failed twice; in the first run {stall}")
    got = (
        f"first run: {first.verdict.text}, while {stall}; second run: {second.verdict.text}. "
        "Run the case again on a computer that has less to do"
    )
    differs = Check("", CheckOutcome.INCONCLUSIVE, "the same result twice", got, second.duration_s)
    return replace(
        second,
        verdict=CaseVerdict.INCONCLUSIVE,
        note=got,
        checks=(differs, *checks),
        trace=first.trace,
        trace_dropped=first.trace_dropped,
    )
