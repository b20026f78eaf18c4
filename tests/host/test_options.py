"""What may be set for an upgrade: what is refused, and what follows from what was not set."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher.errors import UsageError
from flasher.host.options import (
    PACKET_GAP_MAX_S,
    PATIENT_TRIES,
    UpgradeOptions,
    firmware_version,
    gaps_s,
    overall_timeout_s,
)
from flasher.host.query import Request
from flasher.image.plan import plan
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import CheckCode
from flasher.protocol.spec import BMS, OBC, WMC
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.host.bench import image_of
from tests.loops import each

LONGER = replace(DEFAULT_TIMINGS, inter_frame_timeout_s=1.0)
PLAN = plan(image_of(300), BMS, 250_000)


@each(
    "changes, error",
    [
        ({"frame_gap_s": 0.0}, ""),
        ({"frame_gap_s": 0.08}, ""),
        ({"frame_gap_s": 0.081}, "0.081 s between frames is more than 0.08 s"),
        ({"frame_gap_s": -0.001}, "between frames"),
        ({"frame_gap_s": 0.8, "timings": LONGER}, ""),
        ({"frame_gap_s": 0.81, "timings": LONGER}, "0.81 s between frames is more than 0.8 s"),
        ({"packet_gap_s": 0.0}, ""),
        ({"packet_gap_s": PACKET_GAP_MAX_S}, ""),
        ({"packet_gap_s": 10.1}, "10.1 s before each packet is more than 10 s"),
        ({"packet_gap_s": -0.1}, "before each packet"),
    ],
)
def test_gaps_that_no_upgrade_survives_are_refused(changes: dict[str, float], error: str) -> None:
    if not error:
        UpgradeOptions(**changes)  # type: ignore[arg-type]
        return
    with pytest.raises(UsageError, match=error):
        UpgradeOptions(**changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("minimum", ["1.0.0", "V1.0", "v1.0.0", "V1.0.0 ", "V10.0.0", ""])
def test_an_oldest_bootloader_that_cannot_be_compared_is_refused(minimum: str) -> None:
    with pytest.raises(UsageError, match=r"not a boot version of the form Vx\.x\.x"):
        UpgradeOptions(minimum_boot_version=minimum)


def test_a_reset_whose_data_the_command_does_not_carry_is_refused() -> None:
    UpgradeOptions(reset_command=0x4200, reset_data=b"")
    with pytest.raises(UsageError, match="have 5 bytes, but the command 0x4207 carries 7"):
        UpgradeOptions(reset_command=0x4207)


@each(
    "options, tries",
    [
        (UpgradeOptions(), PATIENT_TRIES),
        (UpgradeOptions(patient_tries=7), 7),
        (UpgradeOptions(timings=replace(DEFAULT_TIMINGS, packet_tries=4)), 4),
        (UpgradeOptions(timings=replace(DEFAULT_TIMINGS, packet_tries=4), patient_tries=7), 7),
    ],
)
def test_a_device_without_an_application_is_sent_a_packet_more_often_unless_tries_are_set(
    options: UpgradeOptions, tries: int
) -> None:
    assert options.tries_without_application == tries


def test_a_boot_version_is_waited_for_longer_at_power_up() -> None:
    assert UpgradeOptions(power_up_timeout_s=30.0).boot_timeout_s == 5.0
    assert UpgradeOptions(power_up_timeout_s=30.0, at_power_up=True).boot_timeout_s == 30.0


def test_the_default_is_three_attempts() -> None:
    assert UpgradeOptions().planned_attempts == 3
    assert UpgradeOptions(attempts=1).planned_attempts == 1


def test_only_a_battery_can_be_asked_for_its_version_unless_a_product_states_how() -> None:
    own = Request(BY_KEY[0x752, 0x3400])
    assert UpgradeOptions().version_request_for(BMS) == Request(BY_KEY[0x752, 0x3300])
    assert UpgradeOptions().version_request_for(OBC) is None
    for target in (BMS, WMC):
        assert UpgradeOptions(version_request=own).version_request_for(target) is own
    assert firmware_version(CheckCode(bytes(12))) == "", "an answer that names none"


def test_a_deadline_that_was_chosen_is_the_deadline() -> None:
    assert overall_timeout_s(PLAN, UpgradeOptions(timeout_s=7.5)) == 7.5
    assert overall_timeout_s(PLAN, UpgradeOptions()) > 60.0


def test_gaps_lie_between_frames_and_before_packets_and_the_end() -> None:
    assert gaps_s(PLAN, UpgradeOptions()) == 0.0
    assert gaps_s(PLAN, UpgradeOptions(packet_gap_s=2.0)) == 8.0
    assert gaps_s(PLAN, UpgradeOptions(frame_gap_s=0.0625)) == 0.0625 * (3 * 17 + 1 + 2 + 1)
