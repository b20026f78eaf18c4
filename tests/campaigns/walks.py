"""Random walks on every wrong bootloader and on right devices of other choices: `python -m
tests.campaigns.walks [--seconds 10] [--right-seconds 600] [--seed 1]`.

Tells of each variant what was found, the shortest walk to it, and after what time. Exit code 1 when
less than 60 variants are found, or anything on a right device.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import os
import random
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Final, NamedTuple

from flasher.conformance.explore import Explorer
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.mock.variants import VARIANTS
from tests.variant_matrix import AREA_BYTES

WANTED: Final = 60
_STEPS_MAX: Final = 10_000_000
CHOICES: Final[dict[str, tuple[Any, ...]]] = {
    "reset_in_bootloader": ("ignored", "restarts"),
    "without_application": ("announces", "listens"),
    "update_in_transfer": ("starts_over", "ignored"),
    "bad_packet": ("nak_expected", "nak_received", "silence"),
    "repeated_packet": ("ack", "nak_next"),
    "older_packet": ("ack", "nak", "silence"),
    "pause_in_transfer": ("announces", "waits"),
    "reset_in_transfer": ("ignored", "restarts"),
    "image_checksum": ("none", "crc32"),
    "repeated_end": ("same_answer", "silence"),
    "after_complete": ("starts", "restarts"),
    "upgrade_in_application": ("general_feedback", "silence"),
}


class Walked(NamedTuple):
    """What came of walks on one device."""

    name: str
    seconds: float
    steps: int
    found: str


def walk(name: str, variant: str, choices: dict[str, Any], seconds: float, seed: str) -> Walked:
    """Walk on a variant, or on a right device, for so many seconds of the computer's time."""
    device = dataclasses.replace(MOCK_PROFILE, **choices)
    subject = MockSubject(profile=device, make_device=variant_maker(variant) if variant else None)
    began_at = time.monotonic()
    explorer = Explorer(
        subject,
        profile_of_mock(device),
        seed=seed,
        stopped=lambda: time.monotonic() - began_at > seconds,
    )
    explored = explorer.explore(_STEPS_MAX)
    found = ""
    if explored.finding is not None:
        finding = explored.finding
        found = f"{finding.rule}: {finding.text} [{' '.join(finding.steps)}]"
    return Walked(name, time.monotonic() - began_at, explored.steps, found)


def right_choices(seed: str) -> Iterator[dict[str, Any]]:
    """Right devices: every choice by chance."""
    chance = random.Random(seed)
    while True:
        yield {key: chance.choice(values) for key, values in CHOICES.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--right-seconds", type=float, default=600.0)
    parser.add_argument("--seed", default="1")
    given = parser.parse_args()
    cores = os.cpu_count() or 1
    share_s = 5.0
    count = max(1, round(given.right_seconds * cores / share_s))
    with ProcessPoolExecutor(cores) as pool:
        wrong = [
            pool.submit(
                walk,
                name,
                name,
                {"application_area_bytes": AREA_BYTES, **VARIANTS[name].profile},
                given.seconds,
                given.seed,
            )
            for name in VARIANTS
        ]
        found = [one.result() for one in wrong]
        for each in found:
            sys.stdout.write(f"{each.name:30} {each.seconds:5.1f} s  {each.found or 'NOTHING'}\n")
        caught = sum(bool(each.found) for each in found)
        sys.stdout.write(
            f"{caught} of {len(found)} wrong devices within {given.seconds:g} s each\n"
        )
        choices = itertools.islice(right_choices(given.seed), count)
        right = [
            one.result()
            for one in [
                pool.submit(walk, str(each), "", each, share_s, f"{given.seed}/{index}")
                for index, each in enumerate(choices)
            ]
        ]
    blamed = [each for each in right if each.found]
    for each in blamed:
        sys.stdout.write(f"RIGHT DEVICE BLAMED {each.name}\n  {each.found}\n")
    steps = sum(each.steps for each in right)
    sys.stdout.write(f"{len(right)} right devices, {steps:,} steps: {len(blamed)} blamed\n")
    return 1 if blamed or caught < WANTED else 0


if __name__ == "__main__":
    sys.exit(main())
