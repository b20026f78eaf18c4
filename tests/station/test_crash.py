"""The station process is killed for real, twice: the records are true each time.

The whole campaign is a command: `python -m tests.campaigns.station_kill --times 200`.
"""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from tests.campaigns.station_bench import bus_of, free_port
from tests.campaigns.station_kill import Campaign


def test_after_a_kill_the_records_are_true_and_the_unit_can_be_finished(tmp_path: Path) -> None:
    try:
        with can.Bus(**bus_of(free_port()), ignore_config=True) as probe:
            probe.send(can.Message(arbitration_id=1, is_extended_id=False))
            if probe.recv(1.0) is None:
                pytest.skip("multicast does not come back on this machine")
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast bus here: {error}")
    campaign = Campaign(tmp_path, seed=1, sockets=1)
    try:
        for commit in (6, 8):  # told that the flash may begin, flashed
            assert campaign.kill_after(commit)
        campaign.in_peace()
    finally:
        campaign.close()
    assert campaign.problems == []
    assert campaign.counts["killed"] == 2
    assert campaign.counts["runs INTERRUPTED"] == 2
    assert campaign.counts["runs PASS"] == 1
