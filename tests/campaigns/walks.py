"""Random walks on every wrong bootloader and on right devices of other choices: `python -m
tests.campaigns.walks [--seconds 10] [--right-seconds 600] [--seed 1]`.

Tells of each variant what was found, the shortest walk to it, and after what time. Exit code 1 when
less than 60 variants are found, or anything on a right device.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Final, NamedTuple

from flasher.conformance.explore import Explorer
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import ConformanceProfile
from flasher.mock.variants import VARIANTS
from tests.campaigns.right_devices import right_device
from tests.variant_matrix import AREA_BYTES

WANTED: Final = 60
_STEPS_MAX: Final = 10_000_000
_RIGHT_S: Final = 5.0
"""How long one right device is walked on."""
_ABILITIES: Final = ("has_power", "has_readback", "has_bus_off", "has_timed_cuts")


class Walked(NamedTuple):
    """What came of walks on one device."""

    name: str
    seconds: float
    steps: int
    found: str


def walk_on_variant(name: str, seconds: float, seed: str) -> Walked:
    """Walk on a wrong device."""
    changes: dict[str, Any] = {"application_area_bytes": AREA_BYTES, **VARIANTS[name].profile}
    device = dataclasses.replace(MOCK_PROFILE, **changes)
    subject = MockSubject(profile=device, make_device=variant_maker(name))
    return _walk(name, subject, profile_of_mock(device), seconds, seed)


def walk_on_right_device(number: int, profile_name: str, seconds: float, seed: str) -> Walked:
    """Walk on the device of that number, judged by the profile of that name."""
    device = right_device(number)
    subject = MockSubject(device.target, profile=device.choices, make_device=device.make)
    for ability in _ABILITIES if device.is_bare else ():
        setattr(subject, ability, False)
    name = f"{number} {profile_name}: {device}"
    return _walk(name, subject, device.profiles[profile_name], seconds, f"{seed}/{number}")


def _walk(
    name: str, subject: MockSubject, profile: ConformanceProfile, seconds: float, seed: str
) -> Walked:
    """Walk for so many seconds of the computer's time."""
    began_at = time.perf_counter()
    explorer = Explorer(
        subject,
        profile,
        seed=seed,
        stopped=lambda: time.perf_counter() - began_at > seconds,
    )
    explored = explorer.explore(_STEPS_MAX)
    found = ""
    if explored.finding is not None:
        finding = explored.finding
        found = f"{finding.rule}: {finding.text} [{' '.join(finding.steps)}]"
    return Walked(name, time.perf_counter() - began_at, explored.steps, found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--right-seconds", type=float, default=600.0)
    parser.add_argument("--seed", default="1")
    given = parser.parse_args()
    cores = os.cpu_count() or 1
    count = max(1, round(given.right_seconds * cores / (2 * _RIGHT_S)))
    with ProcessPoolExecutor(cores) as pool:
        wrong = [pool.submit(walk_on_variant, name, given.seconds, given.seed) for name in VARIANTS]
        found = [one.result() for one in wrong]
        for each in found:
            sys.stdout.write(f"{each.name:30} {each.seconds:5.1f} s  {each.found or 'NOTHING'}\n")
        caught = sum(bool(each.found) for each in found)
        share = f"{caught} of {len(found)}"
        sys.stdout.write(f"{share} wrong devices within {given.seconds:g} s each\n")
        began = [
            pool.submit(walk_on_right_device, number, profile, _RIGHT_S, given.seed)
            for number in range(1, count + 1)
            for profile in ("fitting", "default")
        ]
        right = [one.result() for one in began]
    blamed = [each for each in right if each.found]
    for each in blamed:
        sys.stdout.write(f"RIGHT DEVICE BLAMED {each.name}\n  {each.found}\n")
    steps = sum(each.steps for each in right)
    sys.stdout.write(f"{count} right devices, by two profiles each, {steps:,} steps: ")
    sys.stdout.write(f"{len(blamed)} times blamed\n")
    return 1 if blamed or caught < WANTED else 0


if __name__ == "__main__":
    sys.exit(main())
