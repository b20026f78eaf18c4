"""An adapter that is away for a moment, and a tool that asks, end no upgrade: plans of `flasher
simulate`, of which a campaign only demands that the device is brought back.
"""

from __future__ import annotations

import pytest

from flasher.simulate.plan import Plan
from flasher.simulate.play import Player, play
from tests.loops import each

pytestmark = pytest.mark.slow

STUBBORN = "mock pause_in_transfer=waits reset_in_bootloader=ignored reset_in_transfer=ignored"
MOMENTS = [
    f"@{message}+{after_s}"
    for message in ("reset", "update", "packet1", "packet20", "packet40", "end")
    for after_s in (0.001, 0.06, 0.2, 0.5)
]
"""In the restart, in the erase, in the transfer and at the end."""


@each("moment", MOMENTS)
@each("fault", ["unplug", "busoff"])
def test_a_lost_adapter_needs_no_power_cycle_however_stubborn_the_device(
    moment: str, fault: str
) -> None:
    plan = f"job packets=40 ; {STUBBORN} erase_time_s=0.02 ; {moment} {fault} seconds=0.3"
    verdict = play(Plan.parse(plan))
    assert (verdict.is_good, verdict.violations) == (True, ())


def test_an_upgrade_survives_queries_in_the_middle_of_its_packets() -> None:
    lines: list[str] = []
    plan = Plan.parse("job packets=150 ; mock ; @packet1 tool does=asks count=400 every=0.03")
    verdict = Player(plan, log=lines.append).play()
    assert (verdict.is_good, verdict.violations) == (True, ())
    assert sum("MessageRepeated" in line for line in lines) > 10
