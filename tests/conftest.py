"""Fixtures and hooks of all tests: files in temporary folders, lanes, no waits for the disk."""

from __future__ import annotations

import functools
import gc
import importlib
import os
import sys
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

# Before all others are imported: what they make stays (`pytest_collection_finish`).
gc.disable()
# Without a cache each process of the tests would compile all modules again, for 10 s.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import hypothesis  # noqa: E402
import pytest  # noqa: E402

ENGINE_COVERAGE = "FLASHER_TEST_COVERAGE"
"""With this variable the engines' own tests run under coverage, as in the gate."""
if ENGINE_COVERAGE in os.environ:  # before flasher is imported
    from tests.engine_coverage import EngineCoverage

    _engine_coverage = EngineCoverage()

from flasher.python_can import can  # noqa: E402  before a test imports python-can

if TYPE_CHECKING:
    from tests.station.postgres import Server

_Report = TypeVar("_Report", pytest.TestReport, pytest.CollectReport)

NO_SKIPS = "FLASHER_TEST_NO_SKIPS"
"""With this variable a skipped test has failed: nothing that it needs may be missing."""
_SLOW_FIXTURES = frozenset({"browser", "postgres"})


def pytest_configure(config: pytest.Config) -> None:
    """`pytest` alone runs the first lane; `pytest -m slow` the second; what is named runs whole."""
    if config.args_source is not pytest.Config.ArgsSource.ARGS and not config.option.markexpr:
        config.option.markexpr = "not slow and not kernel"
    if ENGINE_COVERAGE in os.environ:
        config.pluginmanager.register(_engine_coverage)
    # How long an example may take depends on the computer, and on what else it does.
    hypothesis.settings.register_profile("any computer", deadline=None)
    hypothesis.settings.load_profile("any computer")


def pytest_collection(session: pytest.Session) -> None:
    """On a fresh computer the workers share the work to compile: the second one begins with the
    last module, and each finds what the other has compiled by then.
    """
    config = session.config
    if config.args_source is pytest.Config.ArgsSource.ARGS:
        return
    if os.environ.get("PYTEST_XDIST_WORKER") == "gw1":
        for path in sorted(Path(__file__).parent.rglob("test_*.py"), reverse=True):
            name = ".".join(path.relative_to(config.rootpath).with_suffix("").parts)
            with suppress(Exception, pytest.skip.Exception):  # pytest will report it
                importlib.import_module(name)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        needed = getattr(item, "fixturenames", ())
        if not _SLOW_FIXTURES.isdisjoint(needed) or "postgresql" in item.nodeid:
            item.add_marker(pytest.mark.slow)


def _fail_if_skipped(report: _Report) -> _Report:
    if report.skipped and os.environ.get(NO_SKIPS) and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return _fail_if_skipped((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return _fail_if_skipped((yield))


@pytest.fixture(autouse=True, scope="session")
def no_wait_for_the_disk() -> Iterator[None]:
    """No test of this process pulls the plug, and all share one disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _file: None)
        yield


@pytest.fixture(autouse=True, scope="session")
def plugins_of_python_can_are_found_once() -> Iterator[None]:
    """It looks for them in all installed packages, for each trace that is opened."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (can.io.logger, can.io.player):
            patch.setattr(module, "read_entry_points", functools.cache(module.read_entry_points))
        yield


@pytest.fixture(autouse=True, scope="session")
def a_library_reads_the_same_sample_once() -> Iterator[None]:
    """The second reading takes most of the time of loading a sample, which hundreds of tests do.
    Short files, of tests of the reading itself, are read each time.
    """
    from flasher.image import records  # noqa: PLC0415  not where tests are handed out

    read = records._by_intelhex
    once = functools.lru_cache(64)(read)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            records, "_by_intelhex", lambda lines: (once if len(lines) > 10_000 else read)(lines)
        )
        yield


@pytest.fixture(autouse=True, scope="session")
def files_elsewhere(tmp_path_factory: pytest.TempPathFactory) -> None:
    """For processes that a test starts too."""
    from flasher.cli.recording import BUNDLE_FOLDER  # noqa: PLC0415  not where tests are handed out

    os.environ[BUNDLE_FOLDER] = str(tmp_path_factory.mktemp("bundles"))
    # Signing keys of stations.
    os.environ["XDG_DATA_HOME"] = str(tmp_path_factory.mktemp("data"))
    # Trust files: of this user and of this computer, if somebody tests there.
    os.environ["XDG_CONFIG_HOME"] = str(tmp_path_factory.mktemp("config"))
    os.environ["XDG_CONFIG_DIRS"] = str(tmp_path_factory.mktemp("system"))
    # Locks of adapters.
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


def pytest_collection_finish() -> None:
    """Where records are tested, they compile each statement once. What is loaded by now stays: the
    collector need not look through it again and again.
    """
    if "flasher.station.records.database" in sys.modules:
        from tests.station import statements  # noqa: PLC0415  needs the extra `plant`

        statements.share()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)  # there is memory for some garbage
    gc.enable()


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """For `-n auto`: a worker for each core, and two more for the second lane, whose tests wait for
    other processes and for buses at real pace nearly half of their time.
    """
    # Of a computer with many cores a container may have two.
    affinity = getattr(os, "sched_getaffinity", lambda _process: range(os.cpu_count() or 1))
    return len(affinity(0)) + 2 * int(config.option.markexpr == "slow")


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """A PostgreSQL server; each process of the tests has its own."""
    from tests.station.postgres import find_programs, running_server  # noqa: PLC0415  as above

    programs = find_programs()
    if programs is None:
        pytest.skip("PostgreSQL is not installed (Debian: apt-get install postgresql)")
    with running_server(programs, in_memory=True) as server:
        yield server
