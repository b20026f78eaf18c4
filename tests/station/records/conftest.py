from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.station.factory import Bench
from tests.station.postgres import Server

BACK_ENDS = ("sqlite", "postgresql")


@pytest.fixture(params=BACK_ENDS)
def any_bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    """Records on each back end."""
    url = None
    if request.param == "postgresql":
        server: Server = request.getfixturevalue("postgres")
        url = server.records()
    made = Bench(tmp_path, url=url)
    yield made
    made.store.close()


@pytest.fixture
def server_bench(postgres: Server, tmp_path: Path) -> Iterator[Bench]:
    """Records on a PostgreSQL server."""
    made = Bench(tmp_path, url=postgres.records())
    yield made
    made.store.close()
