"""Times that know the limits of the profile which they come from."""

from __future__ import annotations

import copy
from collections.abc import Callable
from operator import add, mul, sub, truediv

from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.profile_time import ProfileTime, limits_of
from tests.loops import each

_PROFILE = ConformanceProfile({"limits.ack_s": 0.4})


def test_a_time_that_is_calculated_knows_the_limits_in_it() -> None:
    ack_s, pause_s = _PROFILE.limit("ack_s"), _PROFILE.limit("pause_s")
    for calculate in (add, sub, mul, truediv):
        both = {"limits.ack_s": 0.4, "limits.pause_s": 5.0}
        assert limits_of(calculate(ack_s, pause_s)) == both
        assert limits_of(calculate(ack_s, 2.0)) == {"limits.ack_s": 0.4}
    assert limits_of(2.0) == {}


@each("copied", (copy.copy, copy.deepcopy))
def test_a_copy_knows_them_too(copied: Callable[[float], float]) -> None:
    again = copied(_PROFILE.limit("ack_s"))
    assert isinstance(again, ProfileTime)
    assert (again, limits_of(again)) == (0.4, {"limits.ack_s": 0.4})
