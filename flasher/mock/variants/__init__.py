"""Deliberately wrong bootloaders: each violates one clause and is otherwise correct.

They measure a conformance suite: every case has a bootloader that fails it. `make` creates one like
a `MockDevice`; `VARIANTS` contains all by name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from flasher.errors import UsageError, did_you_mean
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.variants import (  # noqa: F401  each declares its variants
    ending,
    entering,
    framing,
    surroundings,
    transfer,
)
from flasher.mock.variants.base import DECLARED, HangingDevice, Variant
from flasher.protocol.spec import Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

__all__ = ["VARIANTS", "HangingDevice", "Variant", "find", "make"]

_GROUPS: Final = ("FR", "CR", "RS", "UP", "TX", "EN", "PW", "TM", "BU", "SE", "CO")
VARIANTS: Final[Mapping[str, Variant]] = MappingProxyType(
    {
        variant.name: variant
        for variant in sorted(DECLARED, key=lambda one: (_GROUPS.index(one.clause[:2]), one.clause))
    }
)
"""Variants by name, in the order of the clauses."""
_DEFAULT_PROFILE: Final = DeviceProfile()


def find(name: str) -> Variant:
    """Find a variant by name. Raises UsageError with the closest name."""
    if name in VARIANTS:
        return VARIANTS[name]
    hint = did_you_mean(name, VARIANTS)
    raise UsageError(
        f"There is no variant {name!a} of the device model.",
        where="--variant",
        remedy=f"{hint}`flasher mock --list-variants` lists them.",
    )


def make(
    variant: Variant | str,
    target: Target,
    *,
    profile: DeviceProfile = _DEFAULT_PROFILE,
    timings: Timings = DEFAULT_TIMINGS,
    **others: Any,
) -> MockDevice:
    """Create a variant with the keywords of `MockDevice`. Its own profile options and timings
    override the given ones. Raises UsageError for an unknown name and for an invalid profile.
    """
    chosen = find(variant) if isinstance(variant, str) else variant
    choices: dict[str, Any] = dict(chosen.profile)
    faults: dict[str, Any] = dict(chosen.timings)
    return chosen.device_type(
        target,
        profile=dataclasses.replace(profile, **choices),
        timings=dataclasses.replace(timings, **faults),
        **others,
    )
