"""The half of the pytest plugin `pytest_flasher` that is loaded where a device is named: the run on
that device, the bench of each test, and the hooks that collect the suite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import (
    CASES,
    Case,
    Requirement,
    Selection,
    known_cases,
    what_is_missing,
)
from flasher.conformance.opening import BenchOptions, open_bench
from flasher.conformance.profile import ConformanceProfile, check_deviations
from flasher.conformance.real import HOST_UNCERTAINTY_S, PowerCommand, ReadbackCommand
from flasher.conformance.reports import candump, distribution
from flasher.conformance.results import (
    FINAL_IMAGE_OK,
    CaseStopped,
    CaseVerdict,
    CheckOutcome,
    Measurement,
    TraceEntry,
    Unsupported,
)
from flasher.conformance.runner import Run, RunObserver, RunOptions
from flasher.conformance.subject import Subject
from flasher.errors import FlasherError
from flasher.trace.figures import Distribution

LIMIT_S: Final = 300.0
"""A test of the user's own is ended after this time on the bench's clock."""
SUITE: Final = "btl"
"""What the cases stand under: btl::TX-03."""
_MARKS: Final = {
    Requirement.DESTRUCTIVE: "destructive",
    Requirement.POWER: "needs_power",
    Requirement.TIMED_CUT: "needs_power",
    Requirement.TIMING: "timing",
}
_MS: Final = 1000


class Measurements:
    """Times by name. `times[name]` are the values in seconds, in order."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def record(self, name: str, value_s: float) -> None:
        """Add a time of one's own."""
        self.times.setdefault(name, []).append(value_s)

    def add(self, measurements: Iterable[Measurement]) -> None:
        """Add what a case measured."""
        for one in measurements:
            self.record(one.name, one.value_s)

    def of(self, name: str) -> Distribution:
        """How the times of a name are spread. Raises KeyError for one that was not measured."""
        return distribution(Measurement(name, value, 0.0) for value in self.times[name])


class BenchTrace:
    """The frames of one test."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    @property
    def frames(self) -> tuple[TraceEntry, ...]:
        """The newest frames so far, in both directions."""
        return self._bench.tester.trace

    def save(self, path: Path) -> None:
        """Write them as a candump log."""
        path.write_bytes(candump(self.frames))


class PluginRun:
    """The run of a pytest session, on one device."""

    def __init__(self, subject: Subject, profile: ConformanceProfile, seed: str) -> None:
        self.subject = subject
        self.profile = profile
        self.measurements = Measurements()
        self._seed = seed
        options, observer = RunOptions(seed), RunObserver()
        self._run = Run(subject, profile, options, observer, stopped=lambda: False)
        self._has_begun = False

    def judge(self, case: Case) -> None:
        """Run a case of the suite; its verdict becomes that of the test."""
        missing = what_is_missing(case, self.subject, self.profile)
        if missing:
            pytest.skip(missing)
        self._begin()
        result = self._run.take(case)
        self.measurements.add(result.measurements)
        told = f"{result.verdict.text}: {result.reason}"
        match result.verdict:
            case CaseVerdict.PASS | CaseVerdict.PASS_IN_PART | CaseVerdict.INFO:
                return
            case CaseVerdict.UNSUPPORTED | CaseVerdict.INCONCLUSIVE:
                pytest.skip(told)
            case CaseVerdict.DEVIATION:
                pytest.xfail(f"documented deviation: {result.note}; {result.reason}")
            case _:
                pytest.fail(f"{told}\nseed: {result.seed}", pytrace=False)

    def bench_for(self, node: pytest.Item) -> Iterator[Bench]:
        """The bench of one test, with the device in the known state before and after it."""
        if node.get_closest_marker("needs_power") and not self.subject.has_power:
            pytest.skip("needs power control")
        self._begin()
        if self._run.stopped:
            pytest.fail(f"not run: {self._run.stopped}", pytrace=False)
        bench = Bench(self.subject, self.profile, limit_s=LIMIT_S, seed=f"{self._seed}/{node.name}")
        yield bench
        self.measurements.add(bench.judge.measurements)
        erased = node.get_closest_marker("destructive") is not None
        trouble = self._run.restore_after(node.name, bench, flash=erased) or self._run.stopped
        if trouble:
            pytest.fail(f"the device is not reachable afterwards: {trouble}", pytrace=False)

    def finish(self) -> None:
        """Flash and verify the good image; fails the last test where that fails."""
        final = self._run.finish() if self._has_begun else FINAL_IMAGE_OK
        if final != FINAL_IMAGE_OK:
            pytest.fail(f"the good image at the end: {final}", pytrace=False)

    def _begin(self) -> None:
        if not self._has_begun:
            self._has_begun = True
            self._run.begin()


@contextmanager
def opened_run(
    config: pytest.Config,
    power: Callable[[bool], None] | None,
    readback: Callable[[], bytes] | None,
) -> Iterator[PluginRun]:
    """The run on the device that the options name; what is wrong with them fails the tests."""
    try:
        with open_bench(_options(config, power, readback)) as (subject, profile):
            check_deviations(profile, known_cases())
            run = PluginRun(subject, profile, config.getoption("btl_seed"))
            yield run
            run.finish()
    except FlasherError as error:
        pytest.fail(str(error), pytrace=False)


def _options(
    config: pytest.Config,
    power: Callable[[bool], None] | None,
    readback: Callable[[], bytes] | None,
) -> BenchOptions:
    def given(name: str) -> Any:
        return config.getoption(f"btl_{name}")

    bus = dict(pair.partition("=")[::2] for pair in given("bus_kwarg"))
    for name in ("interface", "channel", "bitrate"):
        if given(name) is not None:
            bus[name] = given(name)
    if power is None and given("power_cmd") is not None:
        power = PowerCommand(given("power_cmd"))
    if readback is None and given("readback_cmd") is not None:
        readback = ReadbackCommand(given("readback_cmd"))
    uncertainty_s = given("uncertainty")
    return BenchOptions(
        target=given("target") or "bms",
        is_mock=given("mock"),
        variant=given("variant"),
        choices=given("set"),
        profile=given("profile"),
        good_image=given("good_image"),
        second_image=given("second_image"),
        allow_implausible=given("allow_implausible"),
        bus=bus,
        power=power,
        readback=readback,
        uncertainty_s=HOST_UNCERTAINTY_S if uncertainty_s is None else uncertainty_s,
    )


# -- hooks ----------------------------------------------------------------------------------------


class Hooks:
    """Collects the suite, and lets the checks of a bench decide about its test."""

    def __init__(self, config: pytest.Config) -> None:
        if not config.getoption("btl_mock") and config.getoption("numprocesses", None):
            raise pytest.UsageError("one device cannot be tested by several processes: give -n 0")
        self._run: PluginRun | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Put the cases behind the tests that were found, where -k and -m see them."""
        if config.getoption("btl_suite"):
            chosen = Selection(quick=config.getoption("btl_quick")).chosen()
            suite = _Suite.from_parent(session, name=SUITE, nodeid=SUITE)
            items += [_item(suite, CASES[case_id]) for case_id in chosen if case_id in CASES]

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> Iterator[None]:
        """A test with a bench fails by the checks that failed, whatever else it did."""
        bench = pyfuncitem.funcargs.get("btl_bench")
        run = pyfuncitem.funcargs.get("btl_run")
        self._run = run if isinstance(run, PluginRun) else self._run
        try:
            result = yield
        except CaseStopped:
            result = None
        except Unsupported as ended:
            pytest.skip(str(ended))
        if isinstance(bench, Bench):
            checks = bench.judge.checks
            failed = [str(check) for check in checks if check.outcome is CheckOutcome.FAIL]
            if failed:
                pytest.fail("\n".join(failed), pytrace=False)
        return result

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The times that were measured."""
        if self._run is None or not self._run.measurements.times:
            return
        measurements = self._run.measurements
        terminalreporter.section("times in ms: count, least, median, p95, most")
        width = max(map(len, measurements.times))
        for name in measurements.times:
            found = measurements.of(name)
            values = (found.minimum_s, found.median_s, found.p95_s, found.maximum_s)
            cells = "".join(f"{value * _MS:10.1f}" for value in values)
            terminalreporter.write_line(f"{name:<{width}}{found.count:8}{cells}")


class _Suite(pytest.Collector):
    """The parent of the cases, which the hook makes."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        return []


def _item(suite: _Suite, case: Case) -> pytest.Item:
    def test_case(btl_run: PluginRun) -> None:
        btl_run.judge(case)

    test_case.__doc__ = case.title
    item: pytest.Item = pytest.Function.from_parent(suite, name=case.id, callobj=test_case)
    for name in dict.fromkeys(_MARKS[need] for need in case.requires if need in _MARKS):
        item.add_marker(name)
    return item
