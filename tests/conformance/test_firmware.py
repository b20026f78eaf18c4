"""Images that look like firmware, and when the device needs no restore after a case."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import Selection
from flasher.conformance.firmware import Firmware, make_firmware
from flasher.conformance.mock import (
    GOOD_IMAGE,
    MOCK_PROFILE,
    SECOND_IMAGE,
    model_image,
    profile_of_mock,
)
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.runner import RunObserver, run
from flasher.conformance.wire import version_in
from flasher.mock.store import checksum_fits
from tests.loops import each

from .bench import subject


def made(sector_bytes: int, area_bytes: int = 256 * 1024) -> Firmware:
    firmware = make_firmware(model_image, sector_bytes, area_bytes)
    assert firmware is not None
    return firmware


@each("sector_bytes", (2048, 4096, 8192))
def test_the_images_span_three_sectors_with_a_blank_one_over_zeros(sector_bytes: int) -> None:
    good, second, _ = made(sector_bytes)
    assert second is not None
    assert (len(good), len(second)) == (3 * sector_bytes, 2 * sector_bytes + 1)
    assert good[sector_bytes : 2 * sector_bytes] == b"\xff" * sector_bytes
    assert set(second[sector_bytes : 2 * sector_bytes - 4]) == {0}
    packets = [good[start : start + 128] for start in range(0, sector_bytes, 128)]
    assert any(one == other for one, other in pairwise(packets))


def test_other_images_have_one_packet_or_end_at_a_sector_before_it_and_after_it() -> None:
    good, second, sizes = made(2048)
    assert [len(image) for image in sizes] == [128, 2048, 2049, 2047]
    images = [good, second or b"", *sizes]
    assert all(map(checksum_fits, images))
    assert len({version_in(image) for image in images}) == len(images)


@each("sector_bytes, size_bytes", ((128, 3 * 1024), (128 * 1024, 3 * 21760)))
def test_small_and_large_sectors_are_bounded(sector_bytes: int, size_bytes: int) -> None:
    assert len(made(sector_bytes).good) == size_bytes


def test_a_device_with_too_little_room_is_tested_with_short_images() -> None:
    assert make_firmware(model_image, 8192, 3 * 8192 - 1) is None
    small = subject(profile=replace(MOCK_PROFILE, application_area_bytes=4096))
    assert small.firmware == (GOOD_IMAGE, SECOND_IMAGE, ())


@each("less_bytes, is_short", ((0, False), (1, True)))
def test_images_are_no_larger_than_the_profile_allows(less_bytes: int, is_short: bool) -> None:
    device = subject()
    largest_bytes = len(device.firmware.good) - less_bytes
    profile = ConformanceProfile({"device.largest_image_bytes": largest_bytes})
    wanted = (GOOD_IMAGE, SECOND_IMAGE, ()) if is_short else device.firmware
    assert Bench(device, profile, limit_s=100.0).firmware == wanted


class Restores(RunObserver):
    """Records when the device is restored."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def preparing(self, what: str) -> None:
        self.seen.append(what)


@pytest.mark.slow
def test_a_case_that_leaves_the_good_image_running_needs_no_restore() -> None:
    device, observer = subject(), Restores()
    selection = Selection(cases=("UP-05", "TX-02", "EN-07"))
    run(device, profile_of_mock(), selection=selection, observer=observer)
    # TX-02 and EN-07 leave another image.
    assert observer.seen == ["before the first case", "after TX-02", "after EN-07", "at the end"]
    assert device.device.stored_image == GOOD_IMAGE


def test_what_is_sent_after_the_check_of_the_image_makes_a_restore_necessary() -> None:
    bench = Bench(subject(), profile_of_mock(), limit_s=100.0)
    seen: list[bool] = []
    for later in (lambda: None, bench.power_cycle, lambda: bench.send(bench.encoder.reset())):
        bench.check_upgrade()
        later()
        seen.append(bench.is_restored)
    bench.check_upgrade(SECOND_IMAGE)
    assert [*seen, bench.is_restored] == [True, False, False, False]
