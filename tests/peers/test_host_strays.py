"""The scripted host strays exactly as set, and a plain device stays right."""

from __future__ import annotations

import pytest

from tests.loops import each

from .dialogue import assert_upgraded, upgrade
from .scripted_device import DeviceScript, ScriptedDevice
from .scripted_host import HostScript, Limits
from .wording import WORDINGS, Frame, literal


@each(
    "script",
    [
        HostScript(update_on_version=4),
        HostScript(update_twice=True),
        HostScript(update_again_before_packet_1=True),
        HostScript(wrong_crc=frozenset({1, 5, 10})),
        HostScript(wrong_tail=frozenset({2})),
        *(HostScript(lost_frame={3: index}) for index in (0, 1, 9, 17)),
        *(HostScript(doubled_frame={3: index}) for index in (0, 1, 9, 17)),
        *(HostScript(swapped_frame={3: index}) for index in (0, 8, 16)),
        HostScript(head={3: bytes.fromhex("01 00 00 0A 00")}),
        HostScript(head={3: bytes.fromhex("01 0B 00 0A 00")}),
        HostScript(head={3: bytes.fromhex("01 03 00 0B 00")}),
        HostScript(head={3: bytes.fromhex("02 03 00 0A 00")}),
        HostScript(repeat=frozenset({1, 9, 10})),
        HostScript(other_data_on_repeat=frozenset({1, 9, 10})),
        HostScript(skip=frozenset({1, 5, 9})),
        HostScript(early_end=frozenset({1, 5, 9})),
        HostScript(update_after=frozenset({1, 5, 10})),
        HostScript(reset_after=frozenset({5})),
        HostScript(pause_s={5: 30.0}),
        HostScript(filler=0x00),
        HostScript(end_twice=True),
    ],
)
def test_a_device_ends_with_the_right_image_whatever_the_host_sent_in_between(
    script: HostScript,
) -> None:
    host, device = upgrade(host=script)
    assert_upgraded(host, device)


@each(
    "script, name, answers",
    [
        (HostScript(repeat=frozenset({3})), "repeat 3", [("ack", 3)]),
        (HostScript(other_data_on_repeat=frozenset({3})), "other data 3", [("ack", 3)]),
        (HostScript(skip=frozenset({3})), "skip 3", [("nak", 4)]),
        (HostScript(early_end=frozenset({3})), "early end 3", [("nak", 4)]),
        (HostScript(update_after=frozenset({3})), "update 3", [("request", 0)]),
        (HostScript(reset_after=frozenset({3})), "reset 3", []),
        (HostScript(pause_s={3: 2.0}), "pause 3", []),
        (HostScript(end_twice=True), "end twice", [("complete", 0)]),
        (HostScript(update_again_before_packet_1=True), "update before 1", [("request", 0)]),
    ],
)
def test_the_answers_to_an_aside_are_collected(
    script: HostScript, name: str, answers: list[tuple[str, int]]
) -> None:
    host, _ = upgrade(host=script)
    assert host.asides == {name: answers}


@each(
    "script, naks",
    [
        (HostScript(wrong_crc=frozenset({3})), [3]),
        (HostScript(wrong_tail=frozenset({3})), [3]),
        (HostScript(swapped_frame={3: 8}), [3]),
        (HostScript(head={3: bytes.fromhex("01 07 00 0A 00")}), [3]),
        (HostScript(lost_frame={3: 8}), []),
    ],
)
def test_a_damaged_first_copy_is_refused_or_not_answered_and_sent_again(
    script: HostScript, naks: list[int]
) -> None:
    host, device = upgrade(host=script)
    assert_upgraded(host, device)
    assert host.numbers("nak") == naks
    assert host.numbers("packet", "sent").count(3) == 2


@each(
    "script",
    [
        HostScript(update_size_bytes=0),
        HostScript(update_size_bytes=2**32 - 1),
        HostScript(update_size_bytes=2049),
        HostScript(update_text=b"WMC_UPD"),
        HostScript(update_text=b"BMS_UP"),
        HostScript(update_text=b"BMS_UPDT"),
    ],
)
def test_an_update_command_that_does_not_fit_leaves_the_old_application(
    script: HostScript,
) -> None:
    host, device = upgrade(host=script, capacity_bytes=2048)
    assert host.outcome == "no request transfer"
    assert device.updates_taken == 0
    assert device.old_application_whole
    assert device.state == "application"


def test_an_image_of_the_devices_whole_capacity_is_taken() -> None:
    host, device = upgrade(image=bytes(2048), capacity_bytes=2048)
    assert_upgraded(host, device, bytes(2048))


def test_a_host_that_stops_before_the_end_leaves_a_device_that_waits() -> None:
    host, device = upgrade(host=HostScript(stop_before_end=True))
    assert host.outcome == "stopped before the end"
    assert device.state == "transfer"
    assert not device.completed


def test_a_running_application_answers_bootloader_writes_and_erases_nothing() -> None:
    device = ScriptedDevice("bms")
    for text in (WORDINGS["bms"].update_128, WORDINGS["bms"].end):
        for payload in literal(text):
            device.receive(Frame(0x752, payload), 0.0)
    reported = []
    while (frame := device.next_frame(0.0)) is not None:
        reported.append(frame.data)
        device.frame_sent(0.0)
    assert reported == literal(WORDINGS["bms"].feedback) * 2
    assert device.old_application_whole


def test_every_limit_of_the_host_is_kept_in_time() -> None:
    limits = Limits(version_s=1.0, request_s=2.0, ack_s=0.1, packet_tries=3)
    ends = []
    for script in (DeviceScript(deaf_to_reset=True), DeviceScript(no_request=True)):
        host, _ = upgrade(script, limits=limits)
        ends.append(host.log[-1].at)
    assert ends == pytest.approx([1.0, 2.03], abs=0.05)
    host, device = upgrade(DeviceScript(silent_after=0), limits=limits)
    assert device.numbers("packet") == [1, 1, 1]
    first, second, third = device.times("packet")
    assert (second - first, third - second) == pytest.approx((0.11, 0.11), abs=0.02)
    assert host.outcome == "no answer to packet 1"
