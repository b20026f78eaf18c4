"""The bench: faults on the line, waits, and capabilities of the mock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.mock import GOOD_IMAGE, MOCK_PROFILE, SECOND_IMAGE, profile_of_mock
from flasher.conformance.results import CaseLimitReached, CaseStopped
from flasher.conformance.tester import FaultKind, LineFault
from flasher.conformance.wire import RawFrame, Reply, packet_count
from tests.loops import each

from .bench import PROFILE, subject


def made(limit_s: float = 100.0) -> Bench:
    return Bench(subject(), PROFILE, limit_s=limit_s)


def sent(bench: Bench) -> list[int]:
    return [entry.frame.data[0] for entry in bench.tester.trace if entry.sent]


@each(
    "fault, carried",
    [
        (LineFault(FaultKind.DROP, 1), [0, 2, 3]),
        (LineFault(FaultKind.DOUBLE, 1), [0, 1, 1, 2, 3]),
        (LineFault(FaultKind.SWAP, 1), [0, 2, 1, 3]),
        (LineFault(FaultKind.SWAP, 3), [0, 1, 2, 3]),
        (LineFault(FaultKind.DELAY, 1, delay_s=0.05), [0, 1, 2, 3]),
    ],
)
def test_a_fault_befalls_one_frame(fault: LineFault, carried: list[int]) -> None:
    bench = made()
    with bench.disturb(fault):
        done = bench.send([RawFrame(0x7FF, bytes((number,))) for number in range(4)])
    assert sent(bench) == carried
    assert (done.left_at - done.at > 0.05) == (fault.kind is FaultKind.DELAY)


def test_a_frame_of_the_device_can_be_lost_on_its_way() -> None:
    bench = made()
    with bench.disturb(LineFault(FaultKind.DROP, 0, incoming=True)):
        bench.send(bench.encoder.reset())
        replies = bench.collect(0.04)
    assert [one.kind for one in replies] == [Reply.DAMAGED]
    with pytest.raises(ValueError, match="cannot be"):
        LineFault(FaultKind.SWAP, 0, incoming=True)


def test_frames_can_be_sent_with_a_gap_and_at_a_time() -> None:
    bench = made()
    frames = [RawFrame(0x7FF, b"\0")] * 3
    bench.send(frames, gap_s=0.01, at=1.0)
    times = [entry.at_s for entry in bench.tester.trace]
    assert times[0] > 1.0
    assert times[1] - times[0] > 0.01
    assert times[2] - times[1] > 0.01


def test_no_wait_goes_beyond_the_limit_of_the_case() -> None:
    bench = made(limit_s=1.0)
    with pytest.raises(CaseLimitReached):
        bench.collect(100.0)
    assert bench.tester.elapsed_s <= 1.0


def test_what_is_expected_and_does_not_come_ends_the_case() -> None:
    bench = made()
    with pytest.raises(CaseStopped):
        bench.expect(Reply.ACK, within_s=0.1, number=3)
    (check,) = bench.judge.checks
    assert (check.expected, check.got) == ("ACK 3", "nothing within 0.1 s")


@each("lost", [0, 5, 30, 200])
def test_the_patient_host_gets_an_image_through_a_lost_frame(lost: int) -> None:
    bench = made()
    with bench.disturb(LineFault(FaultKind.DROP, lost)):
        ended = bench.upgrade(SECOND_IMAGE)
    assert ended.ok or not lost, ended
    if ended.ok:
        bench.check_application(SECOND_IMAGE)
        bench.check_stored(SECOND_IMAGE)
        assert all(check.outcome.value == "pass" for check in bench.judge.checks)


def test_power_can_be_cut_in_the_middle_of_a_flash_operation() -> None:
    bench = made()
    bench.reset_to_bootloader()
    bench.subject.cut_in_operation(0, 0.5, 0.3)
    bench.send(bench.encoder.update(len(GOOD_IMAGE)))
    # Cut during the erase: no application, so the bootloader announces itself.
    assert bench.wait_for(Reply.REQUEST, within_s=0.2) is None
    assert bench.subject.take_cut()
    assert bench.wait_for(Reply.BOOT_VERSION, within_s=1.0) is not None
    assert bench.application_version() is None
    bench.check_upgrade()
    bench.subject.cut_in_operation(10_000, 0.5, 0.1)
    assert not bench.subject.take_cut()


def test_a_device_that_is_off_the_bus_receives_nothing_for_that_long() -> None:
    bench = made()
    bench.subject.bus_off(0.5)
    assert bench.application_version(0.3) is None
    assert bench.application_version(1.0) is not None


@each("choice", ["nak_expected", "nak_received", "silence"])
def test_a_packet_that_is_rejected_is_judged_by_the_profile(choice: Any) -> None:
    device = replace(MOCK_PROFILE, bad_packet=choice)
    bench = Bench(subject(profile=device), profile_of_mock(device), limit_s=100.0)
    bench.start_transfer(len(GOOD_IMAGE))
    bench.send_packet(GOOD_IMAGE, 4)
    assert bench.check_packet_rejected(wanted=1, named=4)
    bench.send_packet(GOOD_IMAGE, 1)
    assert not bench.check_packet_rejected(wanted=1, named=1)


def test_the_number_of_a_nak_is_open_where_the_packets_is_not_credible_or_none_is_given() -> None:
    device = replace(MOCK_PROFILE, bad_packet="nak_expected")
    stated = profile_of_mock(replace(MOCK_PROFILE, bad_packet="nak_received"))
    bench = Bench(subject(profile=device), stated, limit_s=100.0)
    bench.start_transfer(len(GOOD_IMAGE))
    for named, is_right in ((0, True), (3, False), (None, True)):
        number = 3 if named is None else named
        bench.send(bench.encoder.packet(number, packet_count(len(GOOD_IMAGE)), bytes(128)))
        assert bench.check_packet_rejected(1, named) is is_right
    assert [check.expected for check in bench.judge.checks[-3:]] == [
        "rejected: NAK 0 or 1",
        "rejected: NAK 3",
        "rejected: NAK",
    ]
