"""Capability of measurements with limits: number of values, mean, spread, Cpk and Ppk.

Ppk is the least of (high - mean) / 3s and (mean - low) / 3s, with the standard deviation s of all
values (n - 1). Cpk is the same with the spread of successive values of a socket: their mean
difference, divided by 1.128. With one limit only, its side alone counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from sqlalchemy import Connection, Select, case, func, or_, select

from flasher.station.records import schema
from flasher.station.records.filters import counting
from flasher.station.records.model import RunFilter
from flasher.station.records.rows import beside_index

VALUES_MIN: Final = 30
"""Fewer values, or differences, give no index."""
RANGES_PER_SIGMA: Final = 1.128
"""Mean difference of two values of a normal distribution, in standard deviations (d2)."""


class Basis(StrEnum):
    """Whether an index can be computed."""

    COMPUTED = "computed"
    TOO_FEW = "too few values"
    CONSTANT = "all values are equal"
    """s is 0: there is no spread that could be compared with the limits."""


@dataclass(frozen=True)
class Capability:
    """Values of a measurement with the same limits, of all tries of all runs."""

    part: str
    step: str
    name: str
    unit: str
    low: float | None
    high: float | None
    count: int
    outside: int
    """Values outside the limits."""
    least: float
    mean: float
    most: float
    deviation: float | None
    """Standard deviation s (n - 1); None for one value."""
    cpk: float | None
    """None if there are too few successive values, or these do not differ."""
    ppk: float | None
    """None unless `basis` is "computed"."""
    basis: Basis

    @property
    def limits(self) -> str:
        low, high = (None if each is None else f"{each:,.10g}" for each in (self.low, self.high))
        if low is not None and high is not None:
            return f"{low} to {high}"
        return f"at most {high}" if low is None else f"at least {low}"


def capabilities(connection: Connection, chosen: RunFilter) -> list[Capability]:
    """The measurements with limits of the runs of a filter, without golden units."""
    found = [_capability(**row) for row in connection.execute(_query(chosen)).mappings()]
    return sorted(found, key=_order)


def _order(each: Capability) -> tuple[object, ...]:
    limits = ((limit is None, limit or 0.0) for limit in (each.low, each.high))
    return (each.part, each.step, each.name, each.unit, *limits)


def index(low: float | None, high: float | None, mean: float, sigma: float) -> float:
    """The least distance of the mean from a limit, in units of 3 sigma."""
    sides = [] if low is None else [mean - low]
    sides += [] if high is None else [high - mean]
    return min(sides) / (3 * sigma)


def _query(chosen: RunFilter) -> Select[Any]:
    run, step, measured = schema.run.c, schema.step.c, schema.measurement.c
    key = (schema.recipe.c.part, step.name, measured.name, measured.unit, measured.low,
           measured.high)  # fmt: skip
    value = measured.value
    before = func.lag(value).over(
        partition_by=(*key, run.socket_id), order_by=(step.run_id, measured.id)
    )
    names = ("part", "step", "name", "unit", "low", "high")
    values = (
        counting(chosen, *(each.label(name) for name, each in zip(names, key, strict=True)))
        .add_columns(
            value.label("value"),
            func.avg(value).over(partition_by=key).label("mean"),
            (value - before).label("change"),
        )
        # From the runs to their steps, and not through all measurements.
        .join(schema.step, step.run_id == beside_index(run.id))
        .join(schema.measurement, measured.step_id == beside_index(step.id))
        .join(schema.recipe, schema.recipe.c.id == run.recipe_id)
        .where(value.is_not(None), or_(measured.low.is_not(None), measured.high.is_not(None)))
        .subquery()
        .c
    )
    same = [values[name] for name in names]
    is_outside = or_(values.value < values.low, values.value > values.high)
    return select(
        *same,
        func.count().label("count"),
        func.sum(case((is_outside, 1), else_=0)).label("outside"),
        func.min(values.value).label("least"),
        func.max(values.mean).label("mean"),
        func.max(values.value).label("most"),
        func.sum((values.value - values.mean) * (values.value - values.mean)).label("squares"),
        func.count(values.change).label("changes"),
        func.avg(func.abs(values.change)).label("change"),
    ).group_by(*same)


def _capability(
    *, count: int, mean: float, squares: float, changes: int, change: float | None, **given: Any
) -> Capability:
    low, high = given["low"], given["high"]
    is_constant = given["least"] == given["most"]  # else rounding would leave a tiny spread
    deviation = None if count < 2 else 0.0 if is_constant else math.sqrt(squares / (count - 1))
    cpk = ppk = None
    basis = Basis.TOO_FEW
    if count >= VALUES_MIN:
        basis = Basis.CONSTANT
        if deviation:
            basis = Basis.COMPUTED
            ppk = index(low, high, mean, deviation)
    if changes >= VALUES_MIN and change:
        cpk = index(low, high, mean, change / RANGES_PER_SIGMA)
    return Capability(
        **given | {"outside": int(given["outside"])},
        count=count, mean=given["least"] if is_constant else mean, deviation=deviation, cpk=cpk,
        ppk=ppk, basis=basis,
    )  # fmt: skip
