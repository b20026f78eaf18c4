"""A correct device passes with every choice that the document allows.

`python -m tests.campaigns.right_devices` runs the whole suite on hundreds of them.
"""

from __future__ import annotations

import pytest

from flasher.conformance.catalogue import Selection
from tests.campaigns.right_devices import faults_of, right_device
from tests.loops import each


@pytest.mark.slow
@each("seed", (2, 7))
def test_the_quick_suite_holds_nothing_against_a_right_device(seed: int) -> None:
    assert faults_of(seed, Selection(quick=True)) == []


def test_a_request_for_a_doubled_update_command_may_come_between_two_copies_of_packet_1() -> None:
    assert faults_of(334, Selection(cases=("BU-01",))) == []


def test_a_seed_makes_the_same_device_again() -> None:
    assert str(right_device(5)) == str(right_device(5)) != str(right_device(6))
