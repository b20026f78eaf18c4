"""A whole bike of three processes: a sample of `python -m tests.campaigns.whole_bike`."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.campaigns.whole_bike import Bike, trial
from tests.end_to_end.test_processes import bus
from tests.loops import each, sample

__all__ = ["bus"]
pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("bus")
@each("act, after_s", sample([("power cut", 2.4)], [("kill", 1.8), ("power cut", 2.4)]))
def test_the_command_is_interrupted_and_given_again(
    tmp_path: Path, act: str, after_s: float
) -> None:
    with Bike(tmp_path, packets=24) as bike:
        made = trial(bike, act, act, after_s)
    assert made.is_good, made.stderr
