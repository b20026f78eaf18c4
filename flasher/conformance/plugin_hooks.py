"""The hooks of the pytest plugin, registered only where a device under test is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import pytest

import flasher.conformance.cases  # noqa: F401  registers the cases
from flasher.conformance.bench import Bench
from flasher.conformance.model import CASES, Case, CaseStopped, Requirement, Unsupported
from flasher.conformance.plugin_bench import PluginRun, first_failure
from flasher.conformance.selection import Selection, in_order

SUITE: Final = "btl"
"""What the cases stand under: btl::TX-03."""
_MARKS: Final = {
    Requirement.DESTRUCTIVE: "destructive",
    Requirement.POWER: "needs_power",
    Requirement.TIMED_CUT: "needs_power",
    Requirement.TIMING: "timing",
}
_MS: Final = 1000


class Hooks:
    """Collects the suite, and lets the checks of a bench decide about its test."""

    def __init__(self, config: pytest.Config) -> None:
        if not config.getoption("btl_mock") and config.getoption("numprocesses", None):
            raise pytest.UsageError("one device cannot be tested by several processes: give -n 0")
        self._config = config
        self._run: PluginRun | None = None

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Put the cases behind the tests that were found, where -k and -m see them."""
        if config.getoption("btl_suite"):
            selection = Selection(quick=config.getoption("btl_quick"))
            suite = _Suite.from_parent(session, name=SUITE, nodeid=SUITE)
            items += [
                _item(suite, CASES[case_id])
                for case_id in in_order(CASES)
                if selection.has(case_id, CASES[case_id].requires)
            ]

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
        failed = first_failure(bench.findings) if isinstance(bench, Bench) else ""
        if failed:
            pytest.fail(failed, pytrace=False)
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
    """The parent of the cases."""

    def collect(self) -> list[pytest.Item | pytest.Collector]:
        """Nothing: the hook makes the cases."""
        return []


def _item(suite: _Suite, case: Case) -> pytest.Item:
    item: pytest.Item = pytest.Function.from_parent(suite, name=case.id, callobj=_test_of(case))
    for name in dict.fromkeys(_MARKS[need] for need in case.requires if need in _MARKS):
        item.add_marker(name)
    return item


def _test_of(case: Case) -> Callable[[PluginRun], None]:
    def test_case(btl_run: PluginRun) -> None:
        btl_run.judge(case)

    test_case.__doc__ = case.title
    return test_case
