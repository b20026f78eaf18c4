"""A station without plant settings loads nothing of a plant."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.station.factory import write_recipe

_RUN = """
import json, sys
from flasher.cli.main import main
code = main(sys.argv[1:])
names = ("psycopg", "http.client", "flasher.plant", "flasher.station.question")
print(json.dumps([code, [name for name in names if name in sys.modules]]))
"""


@pytest.mark.slow
def test_a_station_without_a_plant_loads_nothing_of_it(tmp_path: Path) -> None:
    words = ("station", "run", "--recipe", str(write_recipe(tmp_path)), "--mock-sockets", "1")
    more = ("--units", "1", "--mock-speed", "0", "--operator", "jo")
    done = subprocess.run(
        [sys.executable, "-c", _RUN, *words, *more],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert json.loads(done.stdout.splitlines()[-1]) == [0, []]
