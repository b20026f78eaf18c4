"""Power cuts before, in and after every flash operation, and at every received frame (PW)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from flasher.events import DeviceStateEntered
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.wire import split
from tests.loops import each
from tests.mock.bench import READ_VERSION, SMALL, Bench, image_of, packets_of

OLD = image_of(700, "V1r5r0_20250101", seed=3)
NEW = image_of(600)
# The record's page and three of the application, five packets, the record.
ERASES = 1 + 3
BUSY = {BootloaderState.ERASING, BootloaderState.PROGRAMMING, BootloaderState.CHECKING}
OPERATIONS = ERASES + 5 + 1
MOMENTS = {"before": 0.0, "just begun": 0.01, "in": 0.5, "nearly done": 0.99}
PROFILES = {
    "unit 8": SMALL,
    "unit 1": dataclasses.replace(SMALL, program_unit_bytes=1),
    "unit 128": dataclasses.replace(SMALL, program_unit_bytes=128),
    "all pages": dataclasses.replace(SMALL, erased_pages="all"),
}


def cycle_power(bench: Bench, off_s: float = 1.0) -> None:
    bench.device.power_cut(bench.now)
    assert bench.device.state is BootloaderState.OFF
    bench.run(off_s)
    bench.device.power_on(bench.now)
    bench.take_sent()
    bench._partial = b""


def boots_only_what_is_whole(bench: Bench) -> bytes | None:
    """Let the device come up; what runs afterwards, None when it keeps announcing."""
    bench.run(2.0)
    versions = [row for row in bench.take() if isinstance(row, messages.BootVersion)]
    stored = bench.device.stored_image
    assert stored in {OLD, NEW, None}
    if stored is None:
        assert bench.device.state is BootloaderState.ANNOUNCING
        assert len(versions) > 4
    else:
        assert bench.device.state is BootloaderState.APPLICATION
        assert len(versions) == 4
    return stored


def upgrade_rows(bench: Bench) -> list[messages.UpgradeMessage]:
    return [bench.update_row(len(NEW)), *packets_of(NEW), messages.EndOfTransfer()]


def upgrade_frames(bench: Bench) -> list[Frame]:
    return [
        frame
        for row in upgrade_rows(bench)
        for frame in split(bench.target.request_id, bench.encoded(row))
    ]


def run_until(bench: Bench, reached: Callable[[], bool]) -> None:
    """An upgrade to NEW, left where `reached` says so."""
    for row in upgrade_rows(bench):
        bench.send(row)
        while bench.device.state in BUSY:
            if reached():
                return
            wanted = bench.device.deadline()
            assert wanted is not None
            bench.run_until(wanted)
    pytest.fail("the upgrade was over before")


def bench_with_old(profile: DeviceProfile = SMALL) -> Bench:
    bench = Bench(profile)
    bench.upgrade(OLD)
    bench.send(messages.ResetCommand())
    bench.run_to(BootloaderState.ANNOUNCING)
    bench.take_sent()
    return bench


def cut_at(bench: Bench, operation: int, share: float) -> None:
    """Cut the power when `operation` flash operations are done and `share` of the next one."""
    device = bench.device
    done_before = device.erase_count + device.program_count
    run_until(bench, lambda: device.erase_count + device.program_count - done_before == operation)
    ends_at = device.deadline()
    assert ends_at is not None
    bench.now += share * (ends_at - bench.now)
    cycle_power(bench)


@pytest.mark.slow
@pytest.mark.no_cover
@each("profile", PROFILES.values())
@each("moment", MOMENTS)
@each("operation", range(OPERATIONS))
def test_a_power_cut_at_any_flash_operation_never_leaves_a_mixture_that_boots(
    operation: int, moment: str, profile: DeviceProfile
) -> None:
    """PW-01."""
    bench = bench_with_old(profile)
    cut_at(bench, operation, MOMENTS[moment])
    survivor = boots_only_what_is_whole(bench)
    if operation == 0:
        # The old one is given up by the first operation; hardly begun, it may still be whole.
        assert survivor in {OLD, None}
        assert survivor == OLD or moment != "before"
    elif operation < OPERATIONS - 1:
        assert survivor is None
    else:
        assert survivor in {NEW, None}
        assert survivor is None or moment != "before"
    bench.upgrade(NEW)
    assert bench.device.stored_image == NEW


@pytest.mark.no_cover
@each("share", [0.0, 0.3, 0.7])
@each("second", range(0, OPERATIONS, 3))
@each("first", range(1, OPERATIONS, 4))
def test_a_second_power_cut_during_the_rescue_is_no_worse(
    first: int, second: int, share: float
) -> None:
    """PW-02."""
    bench = bench_with_old()
    cut_at(bench, first, share)
    bench.run_to(BootloaderState.ANNOUNCING)
    cut_at(bench, second, share)
    boots_only_what_is_whole(bench)
    bench.upgrade(NEW)
    assert bench.device.stored_image == NEW


UPDATE_FRAMES = 3
ALL_FRAMES = UPDATE_FRAMES + 5 * 18 + 2


def test_the_upgrade_is_as_many_frames_as_the_cuts_below_go_through() -> None:
    assert len(upgrade_frames(bench_with_old())) == ALL_FRAMES


@pytest.mark.slow
@pytest.mark.no_cover
@each("received", range(ALL_FRAMES + 1))
def test_a_power_cut_at_any_received_frame_leaves_the_old_application_or_none(
    received: int,
) -> None:
    """PW-01. The cut comes 1 ms after the frame: the flash is at work when that frame was the last
    one of a message.
    """
    bench = bench_with_old()
    for frame in upgrade_frames(bench)[:received]:
        if bench.device.state in BUSY:
            bench.run_to(BootloaderState.TRANSFER)
        bench.put(frame)
    assert received < ALL_FRAMES or bench.device.state is BootloaderState.CHECKING
    bench.run(0.001)
    cycle_power(bench)
    assert boots_only_what_is_whole(bench) == (OLD if received < UPDATE_FRAMES else None)
    bench.upgrade(NEW)
    assert bench.device.stored_image == NEW


def test_after_complete_a_power_cut_finds_the_new_application_whole() -> None:
    bench = bench_with_old()
    bench.enter_transfer(len(NEW))
    bench.transfer(*packets_of(NEW))
    bench.end()
    cycle_power(bench)
    assert boots_only_what_is_whole(bench) == NEW


def test_when_the_record_is_written_but_complete_was_never_sent_the_new_application_boots() -> None:
    bench = bench_with_old()
    bench.enter_transfer(len(NEW))
    bench.transfer(*packets_of(NEW))
    bench.send(messages.EndOfTransfer())
    bench.now += 0.002
    cycle_power(bench)
    assert bench.take() == []
    assert boots_only_what_is_whole(bench) == NEW


def test_what_was_being_sent_or_received_is_gone_with_the_power() -> None:
    bench = Bench(SMALL)
    device = bench.device
    bench.accepts_frames = False
    bench.send(messages.ResetCommand())
    assert device.next_frame(bench.now) is not None
    device.power_cut(bench.now)
    device.frame_sent(bench.now)
    assert device.next_frame(bench.now) is None
    assert device.deadline() is None


def test_without_power_nothing_is_received_and_nothing_is_reported() -> None:
    bench = Bench(SMALL)
    bench.device.power_cut(bench.now)
    bench.device.power_cut(bench.now)
    bench.send(messages.ResetCommand(), READ_VERSION)
    bench.run(10.0)
    assert bench.take() == []
    assert bench.device.state is BootloaderState.OFF
    assert [event.state for event in bench.events_of(DeviceStateEntered)] == ["application", "off"]


def test_power_that_is_on_already_changes_nothing() -> None:
    bench = Bench(SMALL)
    bench.device.power_on(bench.now)
    assert bench.device.state is BootloaderState.APPLICATION


@each("flipped_byte", [0, 300, 599])
def test_an_image_that_was_altered_in_the_flash_does_not_boot(flipped_byte: int) -> None:
    """R7: what is stored is compared with its record at every start."""
    bench = Bench(SMALL)
    bench.upgrade(NEW)
    flash = bench.device.store.flash
    byte = flash.read(flash.start + flipped_byte, 1)[0]
    flash._put(flipped_byte, bytes((byte ^ 1,)))
    cycle_power(bench)
    assert boots_only_what_is_whole(bench) is None
    bench.upgrade(NEW)
    assert bench.device.stored_image == NEW


@each("size", [0, 1025, 0xFFFFFFFF])
def test_a_record_with_an_impossible_size_does_not_boot(size: int) -> None:
    bench = Bench(SMALL)
    bench.device.store.flash._put(1024, size.to_bytes(4, "little"))
    assert bench.device.stored_image is None


def test_a_record_without_its_last_bytes_does_not_boot() -> None:
    """A power cut may leave everything of it but those."""
    bench = Bench(SMALL)
    bench.device.store.flash._put(1024 + 8, b"WHOLEAP\xff")
    assert bench.device.stored_image is None


def test_the_record_is_given_up_before_the_application_is_touched() -> None:
    bench = bench_with_old()
    bench.send(bench.update_row(len(NEW)))
    bench.run(0.02)
    assert bench.device.erase_count == ERASES + 1
    assert bench.device.stored_image is None
    assert bench.device.store.read(len(OLD)) == OLD


def test_a_profile_with_one_small_page_has_a_factory_application_too() -> None:
    profile = dataclasses.replace(SMALL, application_area_bytes=128, page_size_bytes=128)
    bench = Bench(profile)
    assert bench.device.stored_image is not None
    assert b"V1r0r0_20220512" in bench.device.stored_image
    bench.upgrade(NEW[:128])
    assert bench.device.stored_image == NEW[:128]
