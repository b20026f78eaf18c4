"""Runs the cases of a simulated device side by side, each process with a device of its own."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing.synchronize import Event
from typing import Final

from flasher.conformance.bench_options import BenchOptions, open_bench
from flasher.conformance.catalogue import (
    CASES,
    Selection,
    bench_gaps,
    catalogue_order,
    known_cases,
    missing_requirements,
    why_unsupported,
)
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import FINAL_IMAGE_OK, CaseResult, CaseVerdict, RunReport
from flasher.conformance.runner import RunObserver, SuiteOptions, SuiteRun, check_selection
from flasher.conformance.subject import Subject
from flasher.processes import end_with_parent

_PARTS_A_JOB: Final = 4
"""So that no process is idle while another one has the slow cases."""
_POLL_S: Final = 0.1
_KILLED: Final = "a process of the run was killed"

_is_stopped: Event
"""In the processes."""


def run_in_processes(
    options: BenchOptions,
    subject: Subject,
    profile: ConformanceProfile,
    *,
    jobs: int,
    selection: Selection,
    suite: SuiteOptions,
    observer: RunObserver,
    stopped: Callable[[], bool],
) -> RunReport:
    """Run the selected cases on `jobs` processes, and merge their reports. `subject` and `profile`
    are those of a bench with these options, which runs no case. A seed gives each case the same
    frames as in a single process. Raises UsageError.
    """
    check_selection(selection, profile)
    chosen = selection.chosen()
    count = max(1, min(jobs * _PARTS_A_JOB, len(chosen)))
    parts = [chosen[start::count] for start in range(count)]
    can_run = [
        case_id
        for case_id in chosen
        if case_id in CASES and not why_unsupported(CASES[case_id], subject, profile)
    ]
    observer.run_began(len(can_run) * suite.repeat)
    context = multiprocessing.get_context("spawn")
    event = context.Event()
    with ProcessPoolExecutor(jobs, context, _begin, (event,)) as pool:
        futures = [pool.submit(_run_part, options, part, suite) for part in parts]
        try:
            left = set(futures)
            while left:
                ended, left = wait(left, timeout=_POLL_S, return_when="FIRST_COMPLETED")
                for future in ended:
                    for result in () if future.exception() else future.result().results:
                        observer.case_ended(result)
                if stopped():
                    event.set()
        finally:
            event.set()  # an error of one ends the others
        reports = [
            _report_of(future, part, subject, profile, suite)
            for future, part in zip(futures, parts, strict=True)
        ]
    return _merged(reports, chosen, subject, profile)


def _begin(event: Event) -> None:
    global _is_stopped  # noqa: PLW0603  a process of the pool has no other place
    _is_stopped = event
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent sets the event
    end_with_parent()


def _run_part(options: BenchOptions, cases: Sequence[str], suite: SuiteOptions) -> RunReport:
    from flasher.conformance import cases as _  # noqa: F401, PLC0415  registers the cases

    with open_bench(options) as (subject, profile):
        return SuiteRun(subject, profile, suite, RunObserver(), _is_stopped.is_set).run_all(cases)


def _report_of(
    future: Future[RunReport],
    cases: Sequence[str],
    subject: Subject,
    profile: ConformanceProfile,
    suite: SuiteOptions,
) -> RunReport:
    try:
        return future.result()
    except BrokenProcessPool:
        lost = SuiteRun(subject, profile, suite, RunObserver(), lambda: True)
        results = tuple(CaseResult(each, CaseVerdict.NOT_RUN, note=_KILLED) for each in cases)
        return replace(lost.report(cases), results=results, stopped=_KILLED)


def _merged(
    reports: Sequence[RunReport],
    chosen: Sequence[str],
    subject: Subject,
    profile: ConformanceProfile,
) -> RunReport:
    """Merge the reports of the parts; of different texts the first one counts."""
    order = {case_id: number for number, case_id in enumerate(chosen)}
    results = [result for each in reports for result in each.results]
    texts = {text.id: text for each in reports for text in each.cases}
    ended = [each for each in reports if each.final_image]
    wrong = [each.final_image for each in ended if each.final_image != FINAL_IMAGE_OK]
    seen_by = [each.final_image_seen_by for each in ended]
    return replace(
        reports[0],
        cases=tuple(texts[case_id] for case_id in chosen),
        results=tuple(sorted(results, key=lambda each: (each.repeat, order[each.case_id]))),
        gaps=bench_gaps(missing_requirements(subject, profile), chosen),
        not_selected=tuple(catalogue_order(set(known_cases()).difference(chosen))),
        stopped="; ".join(dict.fromkeys(each.stopped for each in reports if each.stopped)),
        adapter_failed=any(each.adapter_failed for each in reports),
        not_upgradable=next((each.not_upgradable for each in reports if each.not_upgradable), ""),
        killed_by=next((each.killed_by for each in reports if each.killed_by), ""),
        rescues=tuple(rescue for each in reports for rescue in each.rescues),
        final_image=(wrong or [FINAL_IMAGE_OK if ended else ""])[0],
        final_image_seen_by=tuple(
            name for name in (seen_by or [()])[0] if all(name in each for each in seen_by)
        ),
        duration_s=sum(each.duration_s for each in reports),
    )
