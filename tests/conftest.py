"""What holds for every test: what it leaves, it leaves where nobody has to clear it away."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.station.postgres import Server

POSTGRES_REQUIRED = "FLASHER_TEST_POSTGRES"
"""With this variable a missing server is an error, not a reason to skip."""


@pytest.fixture(autouse=True, scope="session")
def no_wait_for_the_disk() -> Iterator[None]:
    """No test of this process pulls the plug, and all share one disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _file: None)
        yield


@pytest.fixture(autouse=True, scope="session")
def files_elsewhere(tmp_path_factory: pytest.TempPathFactory) -> None:
    """For processes that a test starts too."""
    from flasher.cli.recording import BUNDLE_FOLDER  # noqa: PLC0415  not where tests are handed out

    os.environ[BUNDLE_FOLDER] = str(tmp_path_factory.mktemp("bundles"))
    # Signing keys of stations.
    os.environ["XDG_DATA_HOME"] = str(tmp_path_factory.mktemp("data"))
    # Locks of adapters.
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


def pytest_collection_finish() -> None:
    """Where records are tested, they compile each statement once. What is loaded by now stays: the
    collector need not look through it again and again.
    """
    if "flasher.station.records.database" in sys.modules:
        from tests.station import statements  # noqa: PLC0415  needs the extra `postgres`

        statements.share()
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)  # there is memory for some garbage


def pytest_xdist_auto_num_workers() -> int:
    """For `-n auto`: one worker more than there are cores, since tests wait for other processes and
    for buses at real pace a third of their time.
    """
    return (os.cpu_count() or 1) + 1


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """A PostgreSQL server; each process of the tests has its own."""
    from tests.station.postgres import find_programs, running_server  # noqa: PLC0415  as above

    programs = find_programs()
    if programs is None:
        why = "PostgreSQL is not installed (Debian: apt-get install postgresql)"
        if os.environ.get(POSTGRES_REQUIRED):
            pytest.fail(f"{why}, and {POSTGRES_REQUIRED} wants it")
        pytest.skip(why)
    with running_server(programs) as server:
        yield server
