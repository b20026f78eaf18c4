"""The battery behaves as one: nothing jumps or leaves its range, and it is always the same."""

from __future__ import annotations

import pytest

from flasher.mock.battery import FULL_CAPACITY_MAH, Battery, BatteryReading
from flasher.protocol.contents import BatteryStatus

CYCLE_S = 5 * 3600


def readings(step_s: float, until_s: float, battery: Battery | None = None) -> list[BatteryReading]:
    battery = battery or Battery()
    return [battery.at(100.0 + step_s * index) for index in range(int(until_s / step_s) + 1)]


def test_every_value_stays_in_a_plausible_range_over_days() -> None:
    for reading in readings(61.0, 3 * 86_400.0):
        assert -6000 < reading.current_ma < 6000
        assert 2400 <= reading.remaining_mah <= 8400
        assert 24 <= reading.state_of_charge_percent <= 86
        assert 20 <= reading.temperature_c <= 35
        fitted = reading.cells_mv[:10]
        assert all(3300 < cell < 4150 for cell in fitted)
        assert max(fitted) - min(fitted) <= 12
        assert reading.cells_mv[10:] == (0,) * 6
        assert reading.voltage_mv == sum(fitted)


def test_nothing_jumps_from_one_second_to_the_next() -> None:
    before, *later = readings(1.0, CYCLE_S)
    for after in later:
        assert abs(after.remaining_mah - before.remaining_mah) <= 3
        assert abs(after.temperature_c - before.temperature_c) <= 1
        before = after


def test_the_charge_is_the_integral_of_the_current() -> None:
    step_s = 0.25
    used_mah = sum(reading.current_ma for reading in readings(step_s, 600.0)) * step_s / 3600
    first, *_, last = readings(1.0, 600.0)
    assert last.remaining_mah - first.remaining_mah == pytest.approx(used_mah, abs=3)


def test_it_discharges_while_riding_and_charges_with_the_charger_connected() -> None:
    seen = set()
    for reading in readings(60.0, CYCLE_S):
        is_charging = reading.status == BatteryStatus.CHARGER_CONNECTED
        assert (reading.current_ma > 0) is is_charging
        seen.add(is_charging)
    assert seen == {True, False}


def test_state_of_charge_is_the_share_of_the_full_capacity() -> None:
    for reading in readings(600.0, CYCLE_S):
        share = 100 * reading.remaining_mah / FULL_CAPACITY_MAH
        assert reading.state_of_charge_percent == pytest.approx(share, abs=0.51)


def test_the_same_time_gives_the_same_reading_whenever_the_clock_began() -> None:
    early, late = Battery(), Battery()
    early.at(0.0)
    late.at(5_000_000.0)
    for elapsed_s in (1.0, 777.0, 9_999.0):
        assert early.at(elapsed_s) == late.at(5_000_000.0 + elapsed_s)


def test_another_seed_is_another_battery() -> None:
    assert Battery(seed=1).at(0.0).cells_mv != Battery(seed=2).at(0.0).cells_mv


def test_a_resting_battery_takes_less_than_the_smallest_idle_limit_for_ever() -> None:
    resting = readings(1000.0, 86_400.0, Battery("resting"))
    assert {reading.current_ma for reading in resting} == {-8}
    assert len({reading.remaining_mah for reading in resting}) == 1
