"""Profiles that `flasher conformance init` writes, on right devices of other choices: `python -m
tests.campaigns.profiles [--count 100] [--seed 1]`.

Each is a device of `right_devices`, with times at their limits. It is asked, and the whole suite is
run on it with the profile that came of it. Exit code 1 when a choice is written that is not the
device's, a key stays open that could be determined, or a case does not pass.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Final

from flasher.conformance.catalogue import Selection
from flasher.conformance.init import NOT_ASKED, ask_device
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import FINAL_IMAGE_OK, InitResult
from flasher.conformance.runner import run
from tests.campaigns.right_c_devices import RightCDevice, right_c_device
from tests.campaigns.right_devices import HELD, RightDevice, strained_device

_OF_A_BURST: Final = (
    "up_04_burst",
    "limits.version_spacing_s",
    "limits.version_spacing_tolerance_s",
)
AREA_BYTES: Final = 34 * 1024
"""More than 255 packets, and soon sent."""


def faults(
    seed: int,
    selection: Selection = Selection(),  # noqa: B008  frozen
    *,
    make: Callable[[int], RightDevice | RightCDevice] = strained_device,
) -> list[str]:
    """What is wrong with the profile that this device's answers give, by these cases."""
    device = make(seed)
    with device.subject() as subject:
        asked = ask_device(subject, ConformanceProfile())
    if asked.stopped:
        return [asked.stopped]
    found = list(_wrong_answers(device, asked))
    profile = asked.profile(ConformanceProfile())
    with device.subject() as subject:
        report = run(subject, profile, selection=selection)
    found += [
        f"{result.case_id} {result.verdict.text}: {result.reason}"
        for result in report.results
        if result.verdict not in HELD
    ]
    if report.final_image != FINAL_IMAGE_OK:
        found.append(report.final_image)
    return found


def _wrong_answers(device: RightDevice | RightCDevice, asked: InitResult) -> Iterator[str]:
    """Answers that are not the device's, and keys that stay open without need."""
    own = device.profiles["fitting"]
    can_leave = own.choice("tx_12") == "announces" or own.choice("tx_13") == "restarts"
    keeps_old = own.given["rs_03_old"] != "erased"
    may_be_open = {
        *NOT_ASKED,
        *(("limits.pause_s",) if own.choice("tx_12") == "waits" else ()),
        *(("rs_03", "device.buffer_bytes") if keeps_old else ()),
        *(("rs_03_old",) if keeps_old and device.is_bare else ()),
        *(("device.buffer_bytes",) if device.is_bare else ()),
        *(_OF_A_BURST if own.number("versions") == 1 else ()),
        *(("rs_03", "rs_03_old") if device.is_bare and not can_leave else ()),
    }
    for one in asked.answers:
        if one.value is None:
            if one.key not in may_be_open:
                yield f"{one.key} stays open: {one.seen}"
        elif "." not in one.key or one.key == "device.largest_image_bytes":
            true = own.value(one.key)
            if (one.key, true) == ("up_04", "accepted"):
                continue  # its window is found to be longer instead
            if one.key in own.given and true not in (one.value, "either"):
                yield f"{one.key} is {true}, not {one.value} ({one.seen})"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--c", action="store_true", help="bootloaders in C, not the device model")
    given = parser.parse_args()
    seeds = range(given.seed, given.seed + given.count)
    wrong = 0
    judge = partial(faults, make=right_c_device) if given.c else faults
    with ProcessPoolExecutor(given.jobs) as pool:
        for seed, found in zip(seeds, pool.map(judge, seeds), strict=True):
            wrong += bool(found)
            for one in found:
                sys.stdout.write(f"{seed}: {one}\n")
            sys.stdout.write(f"up to seed {seed}: {wrong} wrong\n")
            sys.stdout.flush()
    sys.stdout.write(f"{given.count} devices, {wrong} with a profile that does not fit\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
