"""Time computed from limits of a profile, which it keeps, so that a failure can name them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_NONE: Final[Mapping[str, float]] = MappingProxyType({})


class ProfileTime(float):
    """A time in seconds, and the limits that it comes from: key of the profile to seconds. Sums,
    differences, products and quotients keep the limits of both sides.
    """

    limits: Mapping[str, float]

    def __new__(cls, value_s: float, limits: Mapping[str, float]) -> ProfileTime:
        found = super().__new__(cls, value_s)
        found.limits = limits
        return found

    def __reduce__(self) -> tuple[type[ProfileTime], tuple[float, dict[str, float]]]:
        # For reports of other processes, and for copies.
        return ProfileTime, (float(self), dict(self.limits))

    def _computed(self, value_s: float, other: float) -> ProfileTime:
        return ProfileTime(value_s, {**self.limits, **limits_of(other)})

    def __add__(self, other: float) -> ProfileTime:
        return self._computed(float(self) + float(other), other)

    __radd__ = __add__

    def __sub__(self, other: float) -> ProfileTime:
        return self._computed(float(self) - float(other), other)

    def __rsub__(self, other: float) -> ProfileTime:
        return self._computed(float(other) - float(self), other)

    def __mul__(self, other: float) -> ProfileTime:
        return self._computed(float(self) * float(other), other)

    __rmul__ = __mul__

    def __truediv__(self, other: float) -> ProfileTime:
        return self._computed(float(self) / float(other), other)


def limits_of(*times_s: float) -> Mapping[str, float]:
    """The limits of the profile that these times come from; none for a plain number."""
    found: dict[str, float] = {}
    for time_s in times_s:
        found |= getattr(time_s, "limits", _NONE)
    return found
