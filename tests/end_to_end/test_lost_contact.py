"""Samples of the campaigns: an adapter that is away for a moment, a stranger that asks."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.campaigns.beside_a_flash import on_the_simulated_bus
from tests.campaigns.lost_contact import Fault, trial
from tests.loops import each

pytestmark = pytest.mark.slow

SEEDS = (6, 10, 11, 25)
"""The moments of which lie in the restart, in the erase, in the transfer and at the end."""


@each("fault", Fault)
def test_a_lost_adapter_needs_no_power_cycle_however_stubborn_the_device(fault: Fault) -> None:
    for seed in SEEDS:
        tried = trial(fault, seed)
        assert tried.is_good, tried
        assert tried.is_honest


def test_an_upgrade_survives_queries_in_the_middle_of_its_packets() -> None:
    counts: Counter[str] = Counter()
    assert not on_the_simulated_bus(1, counts, every_s=0.03, packets=150)
    assert counts["messages sent again"] > 10
