"""The station is killed for real while an operator works: what was shown is true of the units, and
every unit gets through.

The whole campaign is a command, with kills of a socket's process:
`python -m tests.campaigns.station_kill --times 60`.
"""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from tests.campaigns.scripted_units import bus_of, free_port
from tests.campaigns.station_kill import campaign

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def multicast() -> None:
    """A bus that other processes hear."""
    try:
        with can.Bus(**bus_of(free_port()), ignore_config=True) as probe:
            probe.send(can.Message(arbitration_id=1, is_extended_id=False))
            if probe.recv(1.0) is None:
                pytest.skip("multicast does not come back on this machine")
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast bus here: {error}")


@pytest.mark.timeout(240)
def test_after_a_kill_all_that_was_shown_is_true_and_every_unit_gets_through(
    tmp_path: Path,
) -> None:
    with campaign(tmp_path, seed=2, sockets=1, image_bytes=1500) as made:
        made.kill_once(worker=False)
        made.in_peace()
    assert made.problems == []
    assert made.counts["kills of the station"] == 1
    assert made.operator.passed
