"""The device against the scripted host, which shares no code with it: two readings of one document
have to meet.
"""

from __future__ import annotations

import dataclasses

from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol.spec import BMS, TARGETS, WELLING, Target
from flasher.settings.device_model import describe_options, set_option
from tests.loops import each
from tests.mock.bench import image_of
from tests.peers.scripted_host import HostScript, ScriptedHost
from tests.peers.virtual_wire import run

IMAGE = image_of(10 * 128 - 3)
CHOICES = [(key, value) for key, allowed, _ in describe_options() for value in allowed.split(" | ")]


def upgrade(
    script: HostScript | None = None,
    *,
    profile: DeviceProfile | None = None,
    target: Target = BMS,
) -> tuple[ScriptedHost, MockDevice]:
    """One upgrade on the virtual wire, and a second more so that the application can start."""
    device = MockDevice(target, bitrate_bps=WELLING.bitrate_bps, profile=profile or DeviceProfile())
    host = ScriptedHost(target.name, IMAGE, script)
    run(host, device, linger_s=1.0)
    return host, device


def assert_upgraded(host: ScriptedHost, device: MockDevice) -> None:
    assert host.outcome == "complete"
    assert device.stored_image == IMAGE
    assert device.state is BootloaderState.APPLICATION


@each("target", TARGETS.values())
def test_a_plain_upgrade_of_every_target_completes(target: Target) -> None:
    assert_upgraded(*upgrade(target=target))


@each("key, value", [choice for choice in CHOICES if choice != ("image_checksum", "crc32")])
def test_a_plain_upgrade_completes_with_every_choice_of_the_profile(key: str, value: str) -> None:
    assert_upgraded(*upgrade(profile=set_option(DeviceProfile(), key, value)))


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
        HostScript(update_after=frozenset({1, 5, 10})),
        HostScript(pause_s={5: 30.0}),
        HostScript(filler=0x00),
    ],
)
def test_a_host_that_strays_ends_with_the_right_image(script: HostScript) -> None:
    assert_upgraded(*upgrade(script))


@each(
    "script, choice, answers",
    [
        (HostScript(repeat=frozenset({3})), "repeated_packet=ack", [("ack", 3)]),
        (HostScript(repeat=frozenset({3})), "repeated_packet=nak_next", [("nak", 4)]),
        (HostScript(other_data_on_repeat=frozenset({3})), "repeated_packet=ack", [("ack", 3)]),
        (HostScript(skip=frozenset({3})), "bad_packet=nak_expected", [("nak", 4)]),
        (HostScript(skip=frozenset({3})), "bad_packet=nak_received", [("nak", 5)]),
        (HostScript(skip=frozenset({3})), "bad_packet=silence", []),
        (HostScript(early_end=frozenset({3})), "repeated_end=same_answer", [("nak", 4)]),
        (
            HostScript(update_after=frozenset({3})),
            "update_in_transfer=starts_over",
            [("request", 0)],
        ),
        (HostScript(update_after=frozenset({3})), "update_in_transfer=ignored", []),
        (HostScript(reset_after=frozenset({3})), "reset_in_transfer=ignored", []),
        (HostScript(pause_s={3: 9.0}), "pause_in_transfer=waits", []),
        (HostScript(end_twice=True), "repeated_end=same_answer", [("complete", 0)]),
        (HostScript(end_twice=True), "repeated_end=silence", []),
        (
            HostScript(update_again_before_packet_1=True),
            "update_in_transfer=ignored",
            [("request", 0)],
        ),
    ],
)
def test_what_is_sent_out_of_turn_is_answered_as_the_profile_states(
    script: HostScript, choice: str, answers: list[tuple[str, int]]
) -> None:
    host, device = upgrade(script, profile=set_option(DeviceProfile(), *choice.split("=")))
    assert list(host.asides.values()) == [answers]
    assert_upgraded(host, device)


@each(
    "script",
    [
        HostScript(update_size_bytes=0),
        HostScript(update_size_bytes=2**32 - 1),
        HostScript(update_text=b"WMC_UPD"),
        HostScript(update_text=b"BMS_UP"),
        HostScript(update_text=b"BMS_UPDT"),
    ],
)
def test_an_update_command_that_does_not_fit_leaves_the_old_application(script: HostScript) -> None:
    host, device = upgrade(script)
    assert host.outcome == "no request transfer"
    assert device.state is BootloaderState.APPLICATION
    assert device.erase_count == 0


def test_a_host_that_stops_before_the_end_leaves_no_application_that_could_boot() -> None:
    host, device = upgrade(HostScript(stop_before_end=True))
    assert host.outcome == "stopped before the end"
    assert device.state is BootloaderState.TRANSFER
    assert device.stored_image is None


def test_the_wrong_checksum_of_an_image_is_refused() -> None:
    profile = dataclasses.replace(DeviceProfile(), image_checksum="crc32")
    host, device = upgrade(profile=profile)
    assert host.outcome
    assert host.outcome != "complete"
    assert device.stored_image is None
