"""What the pytest plugin works with once a test needs the device: the run, a bench for each test,
the times of the session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.model import Case, CaseResult, Findings, Measurement, Status, TraceEntry
from flasher.conformance.opening import BenchOptions, open_bench
from flasher.conformance.profile import ConformanceProfile, check_deviations
from flasher.conformance.real import HOST_UNCERTAINTY_S, PowerCommand, ReadbackCommand
from flasher.conformance.report import FINAL_IMAGE_OK
from flasher.conformance.runner import Run, RunOptions, Silent
from flasher.conformance.selection import Selection, known_cases, what_is_missing
from flasher.conformance.subject import Subject
from flasher.conformance.summary import distribution, finding, reason
from flasher.conformance.traces import candump_of
from flasher.errors import FlasherError
from flasher.trace.figures import Distribution

LIMIT_S: Final = 300.0
"""A test of the user's own is ended after this time on the bench's clock."""
_MOCK_TARGET: Final = "bms"


class Measurements:
    """Times by name. `times[name]` are the values in seconds, in order."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def record(self, name: str, value_s: float) -> None:
        """Add a time of one's own."""
        self.times.setdefault(name, []).append(value_s)

    def add(self, measurements: list[Measurement] | tuple[Measurement, ...]) -> None:
        """Add what a case measured."""
        for one in measurements:
            self.record(one.name, one.value_s)

    def of(self, name: str) -> Distribution:
        """How the times of a name are spread. Raises KeyError for one that was not measured."""
        return distribution(Measurement(name, value, 0.0) for value in self.times[name])


class TestTrace:
    """The frames of one test."""

    __test__ = False  # pytest takes a class of this name for tests

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    @property
    def frames(self) -> tuple[TraceEntry, ...]:
        """The newest frames so far, in both directions."""
        return self._bench.trace

    def save(self, path: Path) -> None:
        """Write them as a candump log."""
        path.write_bytes(candump_of(self.frames))


class PluginRun:
    """The run of a pytest session, on one device."""

    def __init__(self, subject: Subject, profile: ConformanceProfile, seed: str) -> None:
        self.subject = subject
        self.profile = profile
        self.measurements = Measurements()
        self._seed = seed
        self._run = Run(
            subject, profile, Selection(), RunOptions(seed), Silent(), stopped=lambda: False
        )
        self._has_begun = False

    def judge(self, case: Case) -> None:
        """Run a case of the suite; its verdict becomes that of the test."""
        missing = what_is_missing(case, self.subject, self.profile)
        if missing:
            pytest.skip(missing)
        self._begin()
        result = self._run.take(case)
        self.measurements.add(result.measurements)
        _conclude(result)

    def bench_for(self, node: pytest.Item) -> Iterator[Bench]:
        """The bench of one test, with the device in the known state before and after it."""
        if node.get_closest_marker("needs_power") and not self.subject.has_power:
            pytest.skip("needs power control")
        self._begin()
        if self._run.stopped:
            pytest.fail(f"not run: {self._run.stopped}", pytrace=False)
        bench = Bench(self.subject, self.profile, limit_s=LIMIT_S, seed=f"{self._seed}/{node.name}")
        yield bench
        self.measurements.add(bench.findings.measurements)
        erased = bench.update_was_sent or node.get_closest_marker("destructive") is not None
        trouble = self._run.restore_after(node.name, bench, flash=erased)
        if trouble or self._run.stopped:
            why = trouble or self._run.stopped
            pytest.fail(f"the device is not reachable afterwards: {why}", pytrace=False)

    def finish(self) -> None:
        """Flash and verify the good image; fails the last test where that fails."""
        if not self._has_begun:
            return
        self._run.finish()
        final = self._run.report().final_image
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


def first_failure(findings: Findings) -> str:
    """What failed in a test's own checks; empty for nothing."""
    bad = [check for check in findings.checks if check.outcome.name == "FAIL"]
    return "\n".join(map(finding, bad))


def _conclude(result: CaseResult) -> None:
    why = reason(result)
    match result.status:
        case Status.PASS | Status.INFO:
            return
        case Status.UNSUPPORTED | Status.INCONCLUSIVE:
            pytest.skip(f"{result.status.value}: {why}")
        case Status.DEVIATION:
            pytest.xfail(f"documented deviation: {result.note}; {why}")
        case _:
            pytest.fail(f"{result.status.value}: {why}\nseed: {result.seed}", pytrace=False)


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
        target=given("target") or _MOCK_TARGET,
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
