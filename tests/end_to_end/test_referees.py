"""The document is the referee: flasher's host against a device, and flasher's device model against
a host, that were written from the document in literal bytes and share no code with flasher."""

from __future__ import annotations

import random

import pytest

from flasher.api import as_target
from flasher.errors import ExitCode
from flasher.host.options import UpgradeOptions
from flasher.host.table import Ending
from flasher.mock.model import MockDevice
from tests.end_to_end.world import IMAGE, Traffic, upgrade
from tests.loops import each
from tests.peers.scripted_device import DeviceScript, ScriptedDevice
from tests.peers.scripted_host import HostScript, ScriptedHost
from tests.peers.virtual_wire import run

SIZES = [1, 127, 128, 129, 1000, 78351]
DONE = Ending.COMPLETED


def some(*numbers: int) -> frozenset[int]:
    return frozenset(numbers)


# -- flasher's host, a device of literal frames -------------------------------------------------


@pytest.mark.slow
@each("size_bytes", SIZES)
@each("target", ["wmc", "bms", "obc"])
def test_the_host_upgrades_a_device_of_literal_frames(target: str, size_bytes: int) -> None:
    image = random.Random(size_bytes).randbytes(size_bytes)
    device = ScriptedDevice(target)
    outcome = upgrade(device, target, image)
    assert outcome.ending is DONE
    assert device.image == image
    assert device.completed
    assert device.state == "application"
    assert device.updates_taken == 1


ALL = frozenset(range(1, 11))
STRAYS_THAT_ARE_OVERCOME = [
    DeviceScript(no_feedback=True),
    DeviceScript(versions_lost=some(1)),
    DeviceScript(versions_lost=some(1, 2, 3)),
    DeviceScript(deaf_to_updates=1),
    DeviceScript(deaf_to_updates=3),
    DeviceScript(request_twice=True),
    DeviceScript(leftover_version=True),
    DeviceScript(drop_ack=some(1)),
    DeviceScript(drop_ack=some(3, 4, 10)),
    DeviceScript(drop_ack=ALL),
    DeviceScript(nak={1: 1}),
    DeviceScript(nak={2: 4, 10: 4}),
    DeviceScript(late_ack={2: 0.4}),
    DeviceScript(late_ack={2: 0.51, 3: 0.52}),
    DeviceScript(late_ack=dict.fromkeys(range(1, 11), 0.505)),
    DeviceScript(double_ack=some(4, 5)),
    DeviceScript(ack_then_nak=some(4)),
    DeviceScript(nak_then_ack=some(4)),
    DeviceScript(future_ack=some(4)),
    DeviceScript(restart_at=1),
    DeviceScript(restart_at=5),
    DeviceScript(restart_at=10),
    DeviceScript(request_at=1),
    DeviceScript(request_at=5),
    DeviceScript(end_nak=1),
    DeviceScript(announce_after_complete=4),
    DeviceScript(foreign_frames=True),
    DeviceScript(foreign_frames=True, drop_ack=some(2), nak={3: 2}),
]


@pytest.mark.slow
@each("script", STRAYS_THAT_ARE_OVERCOME)
def test_the_host_copes_with_a_device_that_strays(script: DeviceScript) -> None:
    device = ScriptedDevice("bms", script)
    outcome = upgrade(device)
    assert outcome.ending is DONE
    assert device.image == IMAGE
    assert device.state == "application"


@pytest.mark.slow
@each(
    "script, ending, code",
    [
        (DeviceScript(deaf_to_reset=True), Ending.NO_BOOT_VERSION, ExitCode.NO_ANSWER),
        (DeviceScript(no_request=True), Ending.NO_REQUEST, ExitCode.NO_ANSWER),
        (DeviceScript(wrong_name=True), Ending.WRONG_DEVICE, ExitCode.WRONG_DEVICE),
        (DeviceScript(bad_version_text=b"\x1b[31mX"), Ending.WRONG_DEVICE, ExitCode.WRONG_DEVICE),
        (
            DeviceScript(version_changes=True, deaf_to_updates=1),
            Ending.TWO_DEVICES,
            ExitCode.WRONG_DEVICE,
        ),
        (DeviceScript(double_ack=ALL), Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (DeviceScript(ack_then_nak=ALL), Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (DeviceScript(nak_then_ack=ALL), Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (DeviceScript(stale_ack=ALL), Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (DeviceScript(future_ack=ALL), Ending.TWO_DEVICES, ExitCode.WRONG_DEVICE),
        (DeviceScript(nak={7: 9999}), Ending.PACKET_FAILED, ExitCode.TRANSFER),
        (DeviceScript(silent_after=0), Ending.PACKET_FAILED, ExitCode.TRANSFER),
        (DeviceScript(silent_after=6), Ending.PACKET_FAILED, ExitCode.TRANSFER),
        (DeviceScript(complete_at=4), Ending.BROKEN_PROTOCOL, ExitCode.TRANSFER),
        (DeviceScript(end_nak=2), Ending.REFUSED, ExitCode.REFUSED),
        (DeviceScript(lose_complete=1), Ending.UNCONFIRMED, ExitCode.UNCONFIRMED),
        (DeviceScript(lose_complete=9), Ending.UNCONFIRMED, ExitCode.UNCONFIRMED),
        (
            DeviceScript(lose_complete=9, announce_after_complete=4),
            Ending.UNCONFIRMED,
            ExitCode.UNCONFIRMED,
        ),
    ],
)
def test_the_host_ends_explicitly_where_a_device_cannot_be_upgraded(
    script: DeviceScript, ending: Ending, code: ExitCode
) -> None:
    outcome = upgrade(ScriptedDevice("bms", script))
    assert outcome.ending is ending
    error = outcome.error()
    assert error is not None
    assert error.exit_code == code


@each("lost", [1, 2])
def test_a_final_answer_that_was_lost_is_asked_for_again(lost: int) -> None:
    """EN-03: the device is still in its bootloader."""
    device = ScriptedDevice("bms", DeviceScript(lose_complete=lost), start_s=60.0)
    outcome = upgrade(device, linger_s=100.0)
    assert outcome.ending is DONE
    assert device.image == IMAGE


def test_a_device_whose_image_check_fails_refuses() -> None:
    device = ScriptedDevice("bms", image_check=lambda _image: False)
    assert upgrade(device).ending is Ending.REFUSED
    assert not device.completed


def test_a_restart_at_every_packet_number_is_overcome() -> None:
    for number in range(1, 11):
        device = ScriptedDevice("bms", DeviceScript(restart_at=number))
        outcome = upgrade(device)
        assert outcome.ending is DONE, number
        assert outcome.statistics.attempts == 2
        assert device.image == IMAGE


def test_nak_n_plus_1_on_a_repeat_needs_the_option() -> None:
    script = DeviceScript(nak_next_on_repeat=True, drop_ack=some(2))
    assert upgrade(ScriptedDevice("bms", script)).ending is Ending.PACKET_FAILED
    device = ScriptedDevice("bms", script)
    assert upgrade(device, options=UpgradeOptions(nak_next_is_ack=True)).ending is DONE
    assert device.image == IMAGE


def test_late_answers_do_not_double_the_packets_that_follow() -> None:
    """R10: one late ACK must cost one repetition, not one for each packet after it."""
    device = ScriptedDevice("bms", DeviceScript(late_ack={2: 0.51}))
    outcome = upgrade(device)
    assert outcome.statistics.repetitions == 1


def test_a_lost_final_answer_never_leads_to_a_second_erase() -> None:
    """R11: the device announces itself on the way into its new application."""
    traffic = Traffic()
    device = ScriptedDevice("bms", DeviceScript(lose_complete=9, announce_after_complete=4))
    outcome = upgrade(device, traffic=traffic)
    assert outcome.ending is Ending.UNCONFIRMED
    assert traffic.update_commands("bms") == 1
    assert device.completed
    assert device.image == IMAGE


# -- a host of literal frames, flasher's device model -------------------------------------------


@pytest.mark.slow
@each("size_bytes", [1, 127, 128, 129, 78351])
@each("target", ["wmc", "bms", "obc"])
def test_a_host_of_literal_frames_upgrades_the_device_model(target: str, size_bytes: int) -> None:
    image = random.Random(size_bytes).randbytes(size_bytes)
    device = MockDevice(as_target(target), bitrate_bps=250_000)
    host = ScriptedHost(target, image)
    run(host, device, linger_s=1.0)
    assert host.outcome == "complete"
    assert device.stored_image == image


@each(
    "script",
    [
        HostScript(no_reset=False, update_on_version=2),
        HostScript(update_on_version=4),
        HostScript(update_twice=True),
        HostScript(update_again_before_packet_1=True),
        HostScript(wrong_crc=some(1, 5, 10)),
        HostScript(wrong_tail=some(3)),
        HostScript(lost_frame={1: 0, 2: 9, 10: 17}),
        HostScript(doubled_frame={1: 0, 4: 8}),
        HostScript(swapped_frame={2: 3, 9: 0}),
        HostScript(head={3: bytes.fromhex("0204000A00")}),
        HostScript(head={3: bytes.fromhex("010400FF00")}),
        HostScript(repeat=some(1, 5, 9)),
        HostScript(other_data_on_repeat=some(2)),
        HostScript(skip=some(2)),
        HostScript(early_end=some(4)),
        HostScript(reset_after=some(4)),
        HostScript(pause_s={3: 4.0}),
        HostScript(filler=0x00),
        HostScript(end_twice=True),
    ],
)
def test_the_device_model_copes_with_a_host_that_strays(script: HostScript) -> None:
    device = MockDevice(as_target("bms"), bitrate_bps=250_000)
    host = ScriptedHost("bms", IMAGE, script)
    run(host, device, linger_s=1.0)
    assert host.outcome == "complete"
    assert device.stored_image == IMAGE
