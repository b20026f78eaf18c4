"""Battery model: charge, cell voltages, temperature and current as functions of time.

Deterministic: the same time, counted from the first call, gives the same values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

from flasher.protocol.contents import CELLS, BatteryStatus

CELLS_FITTED: Final = 10
DESIGN_CAPACITY_MAH: Final = 10_000
DESIGN_VOLTAGE_V: Final = 36
FULL_CAPACITY_MAH: Final = 9_800
"""Less than the design capacity, by ageing."""
STATE_OF_HEALTH_PERCENT: Final = 98
RESTING_CURRENT_MA: Final = -8
"""Consumption of the battery's electronics: below either dialect's limit for an idle bus."""

Use = Literal["riding", "resting"]

_RIDE_S: Final = 2 * 3600
_CHARGE_S: Final = 3 * 3600
_RIDES_FROM, _RIDES_TO = 0.85, 0.25
"""Share of the full capacity at the beginning and the end of a ride."""
_SWAY_S: Final = 20.0
"""Period of the current's variation in seconds, as on hills."""
_SWAY: Final = 0.6
_FIRST_RIDE_AT_S: Final = 900.0
"""The first call is a quarter of an hour into a ride."""
_EMPTY_CELL_MV: Final = 3250.0
_FULL_CELL_MV: Final = 4150.0
_CELL_RESISTANCE_OHM: Final = 0.02
_CELL_SPREAD_MV: Final = 6
_AMBIENT_C: Final = 22.0
_WARMING_C: Final = 11.0


@dataclass(frozen=True)
class BatteryReading:
    """State of the battery at one time; a discharge current is negative."""

    elapsed_s: float
    current_ma: int
    remaining_mah: int
    temperature_c: int
    status: BatteryStatus
    cells_mv: tuple[int, ...]
    """Cell voltages; absent cells are 0."""

    @property
    def voltage_mv(self) -> int:
        """Sum of the cell voltages."""
        return sum(self.cells_mv)

    @property
    def state_of_charge_percent(self) -> int:
        """Remaining charge in percent of the full capacity."""
        return round(100 * self.remaining_mah / FULL_CAPACITY_MAH)


class Battery:
    """Battery that is ridden and charged alternately, or rests; `seed` varies its cells."""

    def __init__(self, use: Use = "riding", seed: int = 1) -> None:
        self._use = use
        self._spread_mv = _spread(seed)
        self._began_at: float | None = None

    def at(self, now: float) -> BatteryReading:
        """Return the state of the battery at `now` (seconds)."""
        if self._began_at is None:
            self._began_at = now
        elapsed_s = now - self._began_at
        if self._use == "resting":
            return self._reading(elapsed_s, RESTING_CURRENT_MA, _RIDES_FROM, 0.0, BatteryStatus(0))
        at_s = (elapsed_s + _FIRST_RIDE_AT_S) % (_RIDE_S + _CHARGE_S)
        share = _RIDES_FROM - _RIDES_TO
        if at_s < _RIDE_S:
            mean_ma = share * FULL_CAPACITY_MAH * 3600 / _RIDE_S
            phase = 2 * math.pi * at_s / _SWAY_S
            current_ma = -mean_ma * (1 + _SWAY * math.sin(phase))
            # The integral of that current, so that charge and current belong together.
            used_s = at_s + _SWAY * _SWAY_S / (2 * math.pi) * (1 - math.cos(phase))
            charge = _RIDES_FROM - share * used_s / _RIDE_S
            warmth = math.sin(math.pi * at_s / _RIDE_S)
            return self._reading(elapsed_s, current_ma, charge, warmth, BatteryStatus(0))
        charging_s = at_s - _RIDE_S
        current_ma = share * FULL_CAPACITY_MAH * 3600 / _CHARGE_S
        charge = _RIDES_TO + share * charging_s / _CHARGE_S
        return self._reading(elapsed_s, current_ma, charge, 0.0, BatteryStatus.CHARGER_CONNECTED)

    def _reading(
        self,
        elapsed_s: float,
        current_ma: float,
        charge: float,
        warmth: float,
        status: BatteryStatus,
    ) -> BatteryReading:
        open_mv = _EMPTY_CELL_MV + (_FULL_CELL_MV - _EMPTY_CELL_MV) * charge
        cell_mv = open_mv + _CELL_RESISTANCE_OHM * current_ma
        cells_mv = [round(cell_mv) + spread_mv for spread_mv in self._spread_mv]
        return BatteryReading(
            elapsed_s=elapsed_s,
            current_ma=round(current_ma),
            remaining_mah=round(charge * FULL_CAPACITY_MAH),
            temperature_c=round(_AMBIENT_C + _WARMING_C * warmth),
            status=status,
            cells_mv=(*cells_mv, *(0,) * (CELLS - CELLS_FITTED)),
        )


def _spread(seed: int) -> list[int]:
    """Deviation of each cell from the mean in mV, determined by the seed."""
    spread_mv, state = [], seed
    for _ in range(CELLS_FITTED):
        state = (state * 1_103_515_245 + 12_345) % 2**31
        spread_mv.append((state >> 16) % (2 * _CELL_SPREAD_MV + 1) - _CELL_SPREAD_MV)
    return spread_mv
