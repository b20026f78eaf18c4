"""Bootloaders in C that are right, each with its own choices, pass. `python -m
tests.campaigns.right_devices --c` runs the whole suite on hundreds of them.
"""

from __future__ import annotations

import dataclasses
import shutil
import sys

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import Selection
from flasher.conformance.dut.process import BootloaderProcess
from flasher.conformance.explore import Explorer
from flasher.conformance.init.answers import Trial
from flasher.conformance.init.session import InitSession
from flasher.conformance.init.transfer_questions import padded
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.restore import restore
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.conformance.wire import Reply
from tests.campaigns.profiles import faults as profile_faults
from tests.campaigns.right_c_devices import right_c_device
from tests.campaigns.right_c_in_process import LoadedBootloader
from tests.campaigns.right_devices import HELD, faults_of
from tests.conformance.bench import answers, interview
from tests.loops import each

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]


def test_the_quick_suite_passes() -> None:
    assert faults_of(1, Selection(quick=True), make=right_c_device) == []


def test_a_seed_makes_the_same_device_again() -> None:
    assert str(right_c_device(5)) == str(right_c_device(5)) != str(right_c_device(6))


@each(
    "seed, case_id",
    (
        (1, "FR-01"),  # an update command in the burst is processed after it
        (6, "FR-07"),
        (3, "RS-02"),  # a burst of one
        (3, "TX-13"),  # its restart ends when request transfer may follow versions
        (8, "TX-01"),
        (4, "TX-13"),  # deaf in a burst of two
        (21, "EN-07"),  # it takes longer to announce itself than the reset is repeated
        (9, "EN-07"),  # a bootloader that starts its application confirms a reset
        (10, "UP-01"),  # an update command before packet 1 is ignored
        (24, "BU-01"),  # a lost end of transfer was awaited for longer than its pause
        (2, "FR-09"),  # an empty frame splits a message
        (32, "CO-04"),  # a burst of one, and deaf before it
        (54, "TX-12"),  # after a pause it takes its time to announce itself
        (91, "CR-02"),  # its request transfer waits for NAKs, the pause counts from the command
        (73, "EN-01"),  # its largest image is smaller than its application area
        (33, "BU-01"),  # what came soon after half an end of transfer belonged to that
    ),
)
def test_a_freedom_of_the_document_passes(seed: int, case_id: str) -> None:
    assert faults_of(seed, Selection(cases=(case_id,)), make=right_c_device) == []


def test_an_update_command_that_comes_last_in_the_burst_is_answered_after_it() -> None:
    """By a bootloader that processes it after its burst, and listens there without application."""
    device = right_c_device(66)
    with device.subject() as subject:
        bench = Bench(subject, device.profiles["fitting"], limit_s=100.0)
        bench.start_transfer(len(bench.good_image))
        bench.await_message(Reply.BOOT_VERSION, within_s=2 * bench.limit("pause_s"))
        bench.wait(bench.limit("version_spacing_s") / 2)
        bench.send(bench.encoder.update(len(bench.good_image)))
        bench.next_version()
        bench.await_message(Reply.REQUEST)


def test_the_start_of_an_application_counts_from_the_end_of_the_window_in_walks() -> None:
    device = right_c_device(56)
    for profile in device.profiles.values():
        with device.subject() as subject:
            explorer = Explorer(subject, profile, seed="56")
            assert explorer.replay(["reset", "cut=0", "reset"]).finding is None


@pytest.mark.skipif(sys.platform != "linux", reason="needs a linker that wraps calls")
def test_a_bootloader_that_is_loaded_into_this_process_behaves_as_its_program() -> None:
    device, found = right_c_device(19), []
    cases = ("FR-02", "RS-01", "TX-01", "EN-07", "BU-06")
    for kind in (LoadedBootloader, BootloaderProcess):
        with device.subject(kind) as subject:
            report = run(subject, device.profiles["fitting"], selection=Selection(cases=cases))
        found.append([(result.verdict, result.trace) for result in report.results])
    assert found[0] == found[1]


def test_an_early_end_may_end_the_upgrade_and_start_the_old_application() -> None:
    device = right_c_device(9)
    times = {"NAK_US": 356_220, "REFUSED_US": 0, "FIRST_US": 0, "SPACING_US": 50_000}
    times |= {"WINDOW_US": 200_000, "START_US": 795_000}
    device = dataclasses.replace(device, choices={**device.choices, **times})
    assert faults_of(9, Selection(cases=("EN-02",)), make=lambda _: device) == []


def test_a_babbling_node_and_the_wait_for_an_ack_make_no_pause() -> None:
    device = right_c_device(18)
    given: dict[str, Value] = {"limits.pause_s": 2.3, "limits.ack_s": 1.5, "en_04": "none"}
    given |= {"device.largest_image_bytes": device.choices["LARGEST_BYTES"]}
    assert verdict(18, "CO-01", given) in HELD


def test_a_reset_that_waited_for_the_end_of_an_erase_may_restart_the_bootloader() -> None:
    """It announces itself once, so soon after request transfer that this looks like a leftover."""
    given: dict[str, Value] = {"limits.erase_s": 27.0, "limits.ack_s": 0.54, "limits.start_s": 4.5}
    given |= {"limits.first_version_s": 0.5, "limits.feedback_s": 0.2, "limits.window_s": 0.1514}
    given |= {"tx_13": "restarts", "tx_12": "waits", "up_04": "rejected", "rs_02": "restarts"}
    assert verdict(23, "BU-01", given) in HELD


def test_noise_comes_when_one_that_is_deaf_in_its_burst_erases() -> None:
    """It starts its old application so slowly that the reset after the noise was lost."""
    given: dict[str, Value] = {"limits.first_version_s": 0.5, "limits.ack_s": 1.5}
    given |= {"limits.erase_s": 0.61, "rs_03_old": "kept", "up_08": "rejected"}
    assert verdict(49, "SE-03", given) in HELD


def verdict(seed: int, case_id: str, given: dict[str, Value]) -> CaseVerdict:
    """Of that case with the sizes of the device, and `given`."""
    device = right_c_device(seed)
    profile = ConformanceProfile({**device.profiles["default"].given, **given})
    with device.subject() as subject:
        report = run(subject, profile, selection=Selection(cases=(case_id,)))
    return report.results[0].verdict


def test_an_early_end_may_be_refused_so_late_that_the_bootloader_has_just_restarted() -> None:
    assert verdict(5, "EN-02", {"limits.ack_s": 1.5}) is CaseVerdict.PASS_IN_PART


def test_a_transfer_may_last_though_a_padded_update_command_is_rejected() -> None:
    given: dict[str, Value] = {"up_08": "starts_over", "limits.erase_s": 4.8}
    given |= {"limits.pause_s": 8.6, "fr_07": "rejected", "device.versions": 6}
    assert verdict(13, "FR-07", given) in (CaseVerdict.PASS, CaseVerdict.PASS_IN_PART)


def test_an_application_may_start_later_than_an_erase_ends() -> None:
    given: dict[str, Value] = {"fr_01": "rejected", "limits.erase_s": 0.61, "limits.start_s": 17}
    assert verdict(14, "FR-01", given | {"up_04_burst": "rejected"}) in HELD


@each(
    "seed, changed, wanted",
    (
        # An update command before packet 1 is ignored.
        (1, {"BEFORE_FIRST": 0}, {"device.largest_image_bytes": 5824}),
        # The old application is erased with the first full page, of four packets.
        (3, {}, {"rs_03_old": "either", "rs_03": "listens", "device.buffer_bytes": 384}),
        # A packet is written after its ACK.
        (14, {}, {"device.buffer_bytes": 128}),
        # The whole image is one page, written at end of transfer.
        (3, {"PAGE_BYTES": 8448}, {"rs_03_old": "either", "rs_03": None}),
        # The old application is kept until packet 1.
        (5, {}, {"rs_03_old": "either", "rs_03": "announces", "device.largest_image_bytes": 4098}),
        # An update command in the burst is answered after it.
        (6, {}, {"up_04_burst": "accepted"}),
        # Before packet 1, it ignores an update command for another size.
        (
            10,
            {"APPLICATION_BYTES": 8192, "LARGEST_BYTES": 7000, "PAGE_BYTES": 8192, "ERASE_US": 0},
            {"up_08": "starts_over", "device.largest_image_bytes": 7000},
        ),
        # Only a lost frame is answered by NAK, late.
        (12, {}, {"tx_01_lost_frame": "nak", "limits.ack_s": 1.5}),
        # The wait for its answer to a lost frame becomes a pause, and it is deaf in its burst.
        (66, {"BURST_HEARS": 0}, {"tx_01_lost_frame": "silence", "up_04_burst": "rejected"}),
        # After a pause of 9 s it takes another 1.4 s to announce itself.
        (13, {}, {"limits.pause_s": 8.6}),
    ),
)
def test_init_finds(seed: int, changed: dict[str, int], wanted: dict[str, Value | None]) -> None:
    device = right_c_device(seed)
    device = dataclasses.replace(device, choices={**device.choices, **changed})
    with device.subject() as subject:
        assert answers(subject, wanted, device.profiles["fitting"].given) == wanted


@each(
    "seed, wanted, earlier",
    (
        # It still writes packet 1 when packet 2 begins.
        (
            11,
            {"limits.inter_frame_s": 0.16, "tx_01_lost_frame": "silence"},
            ("device.versions", "en_03", "limits.window_s", "tx_12"),
        ),
        # The larger image that the cases use is larger than any that it accepts.
        (
            73,
            {"en_03": "starts", "device.largest_image_bytes": 5005},
            ("device.versions", "limits.window_s", "tx_12"),
        ),
    ),
)
def test_init_finds_by_its_answers_to_earlier_questions(
    seed: int, wanted: dict[str, Value], earlier: tuple[str, ...]
) -> None:
    with right_c_device(seed).subject() as subject:
        asked = interview(subject, *wanted, *earlier)
    found = {one.key: one.value for one in asked.answers}
    assert {key: found[key] for key in wanted} == wanted


def test_limits_may_be_longer_than_the_pause() -> None:
    given = dict(right_c_device(89).profiles["fitting"].given)
    # The wait for the last answer to damaged packets.
    given |= {"limits.pause_s": 1.1, "limits.ack_s": 1.5, "limits.inter_frame_s": 0.09}
    assert verdict(89, "CR-03", given) in HELD
    given = dict(right_c_device(24).profiles["fitting"].given)
    # What is left of a packet that lost a frame.
    given |= {"limits.pause_s": 1.0, "limits.ack_s": 1.5}
    assert verdict(24, "CR-02", given) in HELD
    given = dict(right_c_device(73).profiles["fitting"].given)
    # The wait for the answer to a packet that is damaged right after request transfer.
    given |= {"limits.pause_s": 1.7, "limits.ack_s": 1.5}
    assert verdict(73, "CR-02", given) in HELD
    given = dict(right_c_device(86).profiles["fitting"].given)
    # Off the bus it misses end of transfer, and makes a pause while complete may still come.
    given |= {"limits.complete_s": 29.0, "limits.ack_s": 0.87, "limits.inter_frame_s": 0.09}
    assert verdict(86, "BU-02", given) in HELD


def test_a_pause_that_counts_from_a_packet_ends_sooner_after_a_late_ack() -> None:
    """`init` sees it after 2.0 to 2.5 s, and its own waits become one (tx_01_lost_frame)."""
    assert profile_faults(24, Selection(cases=("TX-12",)), make=right_c_device) == []


def test_a_restart_after_a_pause_may_end_later_than_complete_would_come() -> None:
    """It rejects a padded end of transfer, and after 9 s takes 2 s to announce itself."""
    device = right_c_device(99)
    profile = device.profiles["fitting"]
    with device.subject() as subject:
        assert restore(subject, profile, flash=True).ok
        session = InitSession(subject, profile, lambda: False)
        found = list(padded(session))
    assert {one.value for one in found if isinstance(one, Trial)} == {"rejected"}


def test_init_leaves_open_whether_end_of_transfer_erases_the_application_without_power() -> None:
    device = right_c_device(3)
    choices = {**device.choices, "PAGE_BYTES": 8448, "PAUSE_US": 2_500_000}
    device = dataclasses.replace(device, choices=choices, is_bare=True)
    with device.subject() as subject:
        asked = interview(subject, "device.versions", "en_03", "tx_12", "tx_13", "rs_03_old")
    answer = next(one for one in asked.answers if one.key == "rs_03_old")
    assert answer.value is None
    assert answer.seen.endswith("can only be seen with power control")


@each(
    "seed, profile, steps",
    (
        (1, "fitting", "reset update=128 update=good"),  # ignored until the transfer is given up
        (2, "fitting", "reset update=384 packet-between"),
        (2, "fitting", "reset update=good packet-open=fr_04-1"),  # NAK to the damaged query
        (9, "fitting", "power update=300 end"),
        (9, "fitting", "reset cut=1 update=384 packet"),
        (18, "fitting", "reset update-reset update=384 packets=all"),
        # A pause counts from the packet, whose ACK comes 0.5 s later.
        (24, "fitting", "reset update=good packet update=good update=300 update=good"),
        (24, "default", "reset update=128 packets=4 packet-zero end-mark packet-start"),
        # A reset in its announcements restarts it, and it takes 2 s to announce itself again.
        (27, "fitting", "reset"),
    ),
)
def test_a_walk_finds_nothing(seed: int, profile: str, steps: str) -> None:
    device = right_c_device(seed)
    with device.subject() as subject:
        result = Explorer(subject, device.profiles[profile], seed="1").replay(steps.split())
    assert result.finding is None


@each("first_us", (958_000, 1_200_000, 4_900_000))
@each("profile", ("fitting", "default"))
def test_a_bootloader_that_resets_restart_may_use_its_times_to_the_limit(
    first_us: int, profile: str
) -> None:
    device = right_c_device(27)
    times = {"FIRST_US": first_us, "START_US": 4_900_000}
    device = dataclasses.replace(device, choices={**device.choices, **times})
    with device.subject() as subject:
        result = Explorer(subject, device.profiles[profile], seed="1").replay(["reset"])
    assert result.finding is None
