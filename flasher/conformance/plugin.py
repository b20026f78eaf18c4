"""Pytest plugin, as far as it is loaded only when a device is given (see `pytest_flasher`).

The run on the device, the bench of each test, the collection of the suite.
"""

from __future__ import annotations

import re
import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.bench_options import BenchOptions, open_bench
from flasher.conformance.catalogue import (
    CASES,
    Case,
    Requirement,
    Selection,
    case_text,
    catalogue_order,
    known_cases,
    why_unsupported,
)
from flasher.conformance.profile import ConformanceProfile, check_deviations
from flasher.conformance.real import HOST_UNCERTAINTY_S, DevicePowerCommand, ReadbackCommand
from flasher.conformance.reports import (
    TRACED,
    candump,
    completed,
    distribution,
    failure_details,
    is_traced,
    to_bytes,
    trace_file_name,
)
from flasher.conformance.results import (
    FINAL_IMAGE_OK,
    CaseResult,
    CaseStopped,
    CaseVerdict,
    CheckOutcome,
    MeasuredTime,
    RunReport,
    TraceEntry,
    Unsupported,
)
from flasher.conformance.runner import RunObserver, SuiteOptions, SuiteRun
from flasher.conformance.subject import Subject
from flasher.conformance.trace_excerpt import excerpt, frame_lines
from flasher.errors import FlasherError, printable, without_password
from flasher.files import make_private
from flasher.trace.figures import Distribution
from pytest_flasher import BENCH_OPTIONS

LIMIT_S: Final = 300.0
"""Time limit of a user's own test on the bench's clock."""
SUITE: Final = "btl"
"""Parent of the cases in test ids: btl::TX-03."""
_MARKS: Final = {
    Requirement.DESTRUCTIVE: "destructive",
    Requirement.POWER: "needs_power",
    Requirement.TIMED_CUT: "needs_power",
    Requirement.TIMING: "timing",
}
_MS: Final = 1000
_MESSAGES: Final = 20
_FRAMES: Final = 40
"""Messages and frames of a failed test that pytest's report shows."""
_NO_FILE_NAME: Final = re.compile(r"[^\w.-]+")


class Measurements:
    """Times by name; `times[name]` lists them in seconds."""

    def __init__(self) -> None:
        self.times: dict[str, list[float]] = {}

    def record(self, name: str, value_s: float) -> None:
        """Add a time of the user's own."""
        self.times.setdefault(name, []).append(value_s)

    def add(self, measurements: Iterable[MeasuredTime]) -> None:
        for one in measurements:
            self.record(one.name, one.value_s)

    def of(self, name: str) -> Distribution:
        """Distribution of the times of a name. Raises KeyError when none was measured."""
        return distribution(MeasuredTime(name, value, 0.0) for value in self.times[name])


class BenchTrace:
    """The frames of one test."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    @property
    def frames(self) -> tuple[TraceEntry, ...]:
        """The newest frames so far, in both directions."""
        return self._bench.tester.trace

    def save(self, path: Path) -> None:
        """Write the frames as a candump log."""
        make_private(path)
        path.write_bytes(candump(self.frames))


class PluginRun:
    """The run of a pytest session on one device."""

    def __init__(
        self, subject: Subject, profile: ConformanceProfile, config: pytest.Config
    ) -> None:
        self.subject = subject
        self.profile = profile
        self.measurements = Measurements()
        self._config = config
        self._seed: str = config.getoption("btl_seed")
        self._is_strict: bool = config.getoption("btl_strict")
        options = SuiteOptions(self._seed, strict=self._is_strict)
        self._started_at = datetime.now(UTC).isoformat(timespec="seconds")
        self._run = SuiteRun(subject, profile, options, RunObserver(), stopped=lambda: False)
        self._traces: dict[tuple[str, int], str] = {}
        self._has_begun = False

    def run_case(self, case: Case, node: pytest.Item) -> None:
        """Run a case of the suite; its verdict becomes that of the test."""
        missing = why_unsupported(case, self.subject, self.profile)
        if missing:
            self._run.skip_case(case.id, missing)
            pytest.skip(missing)
        self._begin()
        result = self._run.run_case(case)
        self.measurements.add(result.measurements)
        if is_traced(result):
            self._traces[result.key] = trace_file_name(result)
            self._write("trace_dir", lambda: candump(result.trace), self._traces[result.key])
        _report(node, result)
        verdict = f"{result.verdict.text}: {result.reason}"
        text = case_text(case.id, self.profile)
        details = failure_details(text, replace(result, replay=self._replay(case.id)))
        match result.verdict:
            case CaseVerdict.PASS_IN_PART if self._is_strict:
                pytest.fail(verdict, pytrace=False)
            case CaseVerdict.PASS | CaseVerdict.PASS_IN_PART | CaseVerdict.INFO:
                if self._is_strict and result.deviation_resolved:
                    pytest.fail(
                        f"passes, but the profile documents a deviation: {text.deviation}",
                        pytrace=False,
                    )
            case CaseVerdict.UNSUPPORTED | CaseVerdict.INCONCLUSIVE:
                pytest.skip(verdict)
            case CaseVerdict.DEVIATION:
                pytest.xfail(f"documented deviation: {result.note}; {result.reason}")
            case _:
                pytest.fail(f"{verdict}\n{details}", pytrace=False)

    def report(self) -> RunReport:
        """Report of the suite's cases so far."""
        return self._run.report(catalogue_order(self._run.judged))

    def bench_for(self, node: pytest.Item) -> Iterator[Bench]:
        """The bench of one test; restores the device before and after it."""
        if node.get_closest_marker("needs_power") and not self.subject.has_power:
            pytest.skip("needs power control")
        self._begin()
        if self._run.stopped:
            pytest.fail(f"not run: {self._run.stopped}", pytrace=False)
        seed = f"{self._seed}/{node.name}"
        bench = Bench(self.subject, self.profile, limit_s=LIMIT_S, seed=seed)
        yield bench
        self.measurements.add(bench.judge.measurements)
        erased = node.get_closest_marker("destructive") is not None
        trouble = self._run.restore_after(node.name, bench, flash=erased) or self._run.stopped
        if trouble:
            pytest.fail(f"the device is not reachable afterwards: {trouble}", pytrace=False)

    def save_failed(self, node: pytest.Item, bench: Bench) -> None:
        """Save the frames of a user's own test that failed."""
        result = CaseResult(
            node.name,
            CaseVerdict.FAIL,
            checks=tuple(bench.judge.checks),
            trace=bench.tester.trace,
            trace_dropped=bench.tester.trace_dropped,
        )
        name = f"{_NO_FILE_NAME.sub('-', node.name)}.log"
        self._write("trace_dir", lambda: candump(result.trace), name)
        _report(node, result)

    def finish(self) -> None:
        """Flash and verify the good image and write the reports. Fails the last test when the image
        could not be restored.
        """
        final = self._run.finish() if self._has_begun else FINAL_IMAGE_OK
        report = self.report()
        report = completed(
            report,
            started_at=self._started_at,
            replays={one.key: self._replay(one.case_id) for one in report.results},
            trace_files=self._traces,
        )

        def page() -> bytes:
            from flasher.conformance.html_report import html_page  # noqa: PLC0415  loads jinja2

            return html_page(report).encode("utf-8")

        self._write("json_report", lambda: to_bytes(report))
        self._write("html", page)
        if final != FINAL_IMAGE_OK:
            pytest.fail(f"the good image at the end: {final}", pytrace=False)

    def _write(self, option: str, made: Callable[[], bytes], name: str = "") -> None:
        """Write the content to the file of an option, or to file `name` in its directory."""
        given = self._config.getoption(f"btl_{option}")
        if given is None:
            return
        path = Path(given, name)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if name:  # a trace
                make_private(path)
            path.write_bytes(made())
        except OSError as error:
            pytest.fail(f"{path} cannot be written: {error.strerror}", pytrace=False)

    def _replay(self, case_id: str) -> str:
        """Command line that repeats a case."""
        words = ["pytest"]
        for name, (_, _, more) in BENCH_OPTIONS.items():
            value = self._config.getoption(name[2:].replace("-", "_"))
            if value is True:
                words.append(name)
            elif isinstance(value, list):
                words += [f"{name}={one}" for one in value]
            elif value not in (None, False, more.get("default")):
                words.append(f"{name}={value}")
        return shlex.join([*map(without_password, words), "--btl-suite", "-k", case_id])

    def _begin(self) -> None:
        if not self._has_begun:
            self._has_begun = True
            self._run.begin()


@contextmanager
def open_run(
    config: pytest.Config,
    power: Callable[[bool], None] | None,
    readback: Callable[[], bytes] | None,
) -> Iterator[PluginRun]:
    """Open the run on the device of the options; invalid options fail the tests."""
    try:
        with open_bench(_options(config, power, readback)) as (subject, profile):
            check_deviations(profile, known_cases())
            run = PluginRun(subject, profile, config)
            yield run
            run.finish()
    except FlasherError as error:
        pytest.fail(str(error), pytrace=False)


def _report(node: pytest.Item, result: CaseResult) -> None:
    """Add untried parts, and the frames of a failure, to the report of a test."""
    parts = [f"not tried: {part}" for part in result.not_tried]
    if parts:
        node.add_report_section("call", "conformance", "\n".join([result.verdict.text, *parts]))
    if result.verdict in TRACED:
        part = excerpt(result, _MESSAGES, _FRAMES)
        lines = [part.text, *map(str, part.messages), *frame_lines(part.frames)]
        node.add_report_section("call", "frames", "\n".join(map(printable, lines)))


def _options(
    config: pytest.Config,
    power: Callable[[bool], None] | None,
    readback: Callable[[], bytes] | None,
) -> BenchOptions:
    def given(name: str) -> Any:
        return config.getoption(f"btl_{name}")

    bus = dict(pair.partition("=")[::2] for pair in given("bus_kwarg"))
    named = {name: given(name) for name in ("interface", "channel", "bitrate")}
    bus |= {name: value for name, value in named.items() if value is not None}
    if power is None and given("power_cmd") is not None:
        power = DevicePowerCommand(given("power_cmd"))
    if readback is None and given("readback_cmd") is not None:
        readback = ReadbackCommand(given("readback_cmd"))
    uncertainty_s = given("uncertainty")
    same = ("subject", "variant", "profile", "good_image", "second_image", "allow_implausible")
    return BenchOptions(
        **{name: given(name) for name in same},
        target=given("target") or "bms",
        is_mock=given("mock"),
        choices=given("set"),
        bus=bus,
        power=power,
        readback=readback,
        uncertainty_s=HOST_UNCERTAINTY_S if uncertainty_s is None else uncertainty_s,
    )


# -- hooks ----------------------------------------------------------------------------------------


class Hooks:
    """Collects the suite and fails tests whose bench recorded failed checks."""

    def __init__(self, config: pytest.Config) -> None:
        if config.getoption("numprocesses", None):
            if not (config.getoption("btl_mock") or config.getoption("btl_subject")):
                why = "one device cannot be tested by several processes"
                raise pytest.UsageError(f"{why}: give -n 0")
            if config.getoption("btl_json_report") or config.getoption("btl_html"):
                raise pytest.UsageError("a report needs a single process: give -n 0")
        self._run: PluginRun | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Append the cases to the collected tests, so that -k and -m apply to them."""
        if config.getoption("btl_suite"):
            chosen = Selection(quick=config.getoption("btl_quick")).chosen()
            suite = _Suite.from_parent(session, name=SUITE, nodeid=SUITE)
            items += [_item(suite, CASES[case_id]) for case_id in chosen if case_id in CASES]

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> Iterator[None]:
        """Fail a test by the failed checks of its bench, even if the test continued after them."""
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
                if isinstance(run, PluginRun):
                    run.save_failed(pyfuncitem, bench)
                pytest.fail("\n".join(failed), pytrace=False)
        return result

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Report the final state of the device, what the bench could not judge, and the times."""
        if self._run is None:
            return
        report, measurements = self._run.report(), self._run.measurements
        lines = [report.in_full, *(f"this bench is {gap}" for gap in report.gaps)]
        lines += [f"good image at the end: {report.final_image_text}"] if report.final_image else []
        if any(lines):
            terminalreporter.section("bootloader under test")
        for line in filter(None, lines):
            terminalreporter.write_line(printable(line))
        if not measurements.times:
            return
        terminalreporter.section("times in ms: count, min, median, p95, max")
        width = max(map(len, measurements.times))
        for name in measurements.times:
            found = measurements.of(name)
            values = (found.minimum_s, found.median_s, found.p95_s, found.maximum_s)
            cells = "".join(f"{value * _MS:10.1f}" for value in values)
            terminalreporter.write_line(f"{name:<{width}}{found.count:8}{cells}")


class _Suite(pytest.Collector):
    """Parent of the cases, which the hook creates."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        return []


def _item(suite: _Suite, case: Case) -> pytest.Item:
    def test_case(btl_run: PluginRun, request: pytest.FixtureRequest) -> None:
        node: Any = request.node
        with warnings.catch_warnings(action="ignore"):  # that the fixture is experimental
            request.getfixturevalue("record_xml_attribute")("name", f"{case.id} {case.title}")
        btl_run.run_case(case, node)

    test_case.__doc__ = case.title
    item: pytest.Item = pytest.Function.from_parent(suite, name=case.id, callobj=test_case)
    item.user_properties.append(("title", case.title))
    for name in dict.fromkeys(_MARKS[need] for need in case.requires if need in _MARKS):
        item.add_marker(name)
    return item
