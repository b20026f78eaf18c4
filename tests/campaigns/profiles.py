"""Profiles that `flasher conformance init` writes, on right devices of other choices: `python -m
tests.campaigns.profiles [--count 100] [--seed 1]`.

Each device is asked, and the whole suite is run on it with the profile that came of it. Exit code 1
when a choice is written that is not the device's, or a case does not pass.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import random
import sys
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Final

from flasher.conformance.catalogue import Selection
from flasher.conformance.init import ask_device
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import FINAL_IMAGE_OK, CaseVerdict
from flasher.conformance.runner import run
from flasher.mock.profile import DeviceProfile

AREA_BYTES: Final = 34 * 1024
"""More than 255 packets, and soon sent."""
_CHOICES: Final[dict[str, tuple[Any, ...]]] = {
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
_FIGURES: Final[dict[str, tuple[Any, ...]]] = {
    "window_s": (0.05, 0.2, 1.0),
    "reset_delay_s": (0.01, 0.05, 0.8),
    "transfer_timeout_s": (2.0, 5.0, 12.0),
    "start_delay_s": (0.05, 0.1, 2.0),
    "erase_time_s": (0.001, 0.002, 0.05),
    "program_time_s": (0.0001, 0.001, 0.03),
    "largest_image_bytes": (None, 20001, 30000),
}
_TARGETS: Final = ("bms", "bms", "wmc", "obc")
_HELD: Final = frozenset(
    {CaseVerdict.PASS, CaseVerdict.PASS_IN_PART, CaseVerdict.INFO, CaseVerdict.UNSUPPORTED}
)
_OWN: Final = ("en_04",)
"""Choices that nobody sees from outside."""


def some_device(seed: str) -> tuple[str, DeviceProfile]:
    """A right device by chance: its target and its choices."""
    chance = random.Random(seed)
    given = {key: chance.choice(values) for key, values in {**_CHOICES, **_FIGURES}.items()}
    device = dataclasses.replace(MOCK_PROFILE, application_area_bytes=AREA_BYTES, **given)
    return chance.choice(_TARGETS), device


def faults(seed: str, selection: Selection = Selection()) -> list[str]:  # noqa: B008  frozen
    """What is wrong with the profile that this device's answers give, by these cases."""
    target, device = some_device(seed)
    asked = ask_device(MockSubject(target, profile=device), ConformanceProfile())
    if asked.stopped:
        return [asked.stopped]
    own = profile_of_mock(device)
    found = [
        f"{one.key} is {own.value(one.key)}, not {one.value} ({one.seen})"
        for one in asked.answers
        if "." not in one.key
        and one.key not in _OWN
        and one.key in own.given
        and one.value != own.value(one.key)
    ]
    subject, profile = MockSubject(target, profile=device), asked.profile(ConformanceProfile())
    report = run(subject, profile, selection=selection)
    found += [
        f"{result.case_id} {result.verdict.text}: {result.reason}"
        for result in report.results
        if result.verdict not in _HELD
    ]
    if report.final_image != FINAL_IMAGE_OK:
        found.append(report.final_image)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", default="1")
    given = parser.parse_args()
    seeds = [f"{given.seed}/{index}" for index in range(given.count)]
    wrong = 0
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for seed, found in zip(seeds, pool.map(faults, seeds), strict=True):
            wrong += bool(found)
            for one in found:
                sys.stdout.write(f"{seed}: {one}\n")
    sys.stdout.write(f"{given.count} devices, {wrong} with a profile that does not fit\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
