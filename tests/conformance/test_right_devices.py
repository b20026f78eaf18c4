"""A correct device passes with every choice that the document allows, and with every time at its
limit.

`python -m tests.campaigns.right_devices` runs the whole suite on hundreds of them.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import pytest

from flasher.conformance.catalogue import Selection
from flasher.conformance.explore import Explorer
from flasher.conformance.firmware import GOOD, SECOND, Firmware
from flasher.conformance.mock import MOCK_PROFILE, model_image, profile_of_mock
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.conformance.wire import WRITE
from flasher.mock.memory import Operation
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.variants.ending import RecordErasedLast
from flasher.mock.variants.entering import AnyTargetName, ErasesBeforeCheck
from flasher.mock.variants.framing import PaddingFatal
from flasher.protocol import messages
from flasher.protocol.wire import Message
from tests.campaigns.dual_bank import (
    CopiesImage,
    CopyingStore,
    JournalStore,
    KeepsJournal,
    SwapsBanks,
)
from tests.campaigns.right_devices import (
    HELD,
    AsksBeyondTheEnd,
    CountsFromPackets,
    ListensAfterBurst,
    RefusesByNak,
    RefusesInBurst,
    StartsSlowly,
    answers_late,
    faults_of,
    right_device,
    strained_device,
)
from tests.conformance.bench import answers, subject
from tests.loops import each

_SMALL_FIRMWARE: Final = dataclasses.replace(MOCK_PROFILE, page_size_bytes=1024)
"""Images of whole sectors have half the usual size."""


def blamed(
    *case_ids: str,
    kind: type[MockDevice] = MockDevice,
    device: DeviceProfile = MOCK_PROFILE,
    given: dict[str, Value] | None = None,
    images: tuple[bytes, bytes] | None = None,
) -> list[str]:
    """Failures of these cases on a device, judged by its own profile and `given`, with these
    `images`, a good and a second one.
    """
    profile = ConformanceProfile({**profile_of_mock(device).given, **(given or {})})
    made = subject(kind, device)
    if images is not None:
        made.good_image, made.second_image = images
        made.firmware = Firmware(*images)
    report = run(made, profile, selection=Selection(cases=case_ids))
    found = [
        f"{result.case_id} {result.verdict.value}: {result.reason}"
        for result in report.results
        if result.verdict not in HELD
    ]
    assert len(report.results) == len(case_ids)
    assert all(result.verdict is not CaseVerdict.UNSUPPORTED for result in report.results), report
    return found


@pytest.mark.slow
def test_the_quick_suite_holds_nothing_against_a_right_device() -> None:
    assert faults_of(2, Selection(quick=True)) == []


@pytest.mark.slow
def test_a_request_for_a_doubled_update_command_may_come_between_two_copies_of_packet_1() -> None:
    assert faults_of(334, Selection(cases=("BU-01",))) == []


def test_a_seed_makes_the_same_device_again() -> None:
    assert str(right_device(5)) == str(right_device(5)) != str(right_device(6))


class AlsoSendsFeedback(MockDevice):
    """Its bootloader sends general feedback to every write, too (R15)."""

    def _take_message(self, message: Message, now: float) -> None:
        if not self._runs_application and message.mode == WRITE:
            self._send(messages.GeneralFeedbackMessage())
        super()._take_message(message, now)


@pytest.mark.slow
def test_general_feedback_to_a_reset_is_no_application_where_a_bootloader_sends_it() -> None:
    waits = dataclasses.replace(MOCK_PROFILE, pause_in_transfer="waits")
    stated = profile_of_mock(waits).given
    profile = ConformanceProfile(
        {**stated, **dict.fromkeys(("rs_02", "rs_03_old", "tx_12", "fr_10"), "either")}
    )
    made = subject(AlsoSendsFeedback, waits, target="wmc")
    report = run(made, profile, selection=Selection(cases=("RS-03", "TX-12")))
    assert [result.verdict for result in report.results] == [CaseVerdict.PASS] * 2


# -- times at their limits -------------------------------------------------------------------------


@pytest.mark.slow
def test_many_updates_in_a_row_may_erase_to_the_limit_each() -> None:
    slow = dataclasses.replace(MOCK_PROFILE, erase_time_s=9.9 / 4)  # a record and three pages
    assert blamed("UP-08", device=slow, given={"up_08": "either"}) == []


@pytest.mark.slow
@each("late_s", (0.3, 0.45, 0.498))
def test_damage_may_be_answered_as_late_as_a_packet(late_s: float) -> None:
    cases = ("FR-04", "FR-06", "CR-02", "CR-03")
    assert blamed(*cases, kind=answers_late(Nak=late_s)) == []


@pytest.mark.slow
def test_bit_flips_may_be_answered_late() -> None:
    assert blamed("CR-01", kind=answers_late(Nak=0.498)) == []


@pytest.mark.slow
def test_damage_may_be_answered_late_where_an_update_command_began_the_transfer_anew() -> None:
    """Without power control: the pause counts from the last request transfer."""
    assert faults_of(2013, Selection(cases=("CR-02",)), make=strained_device) == []


@pytest.mark.slow
@each("case_id", ("TX-01", "TX-03", "TX-04", "TX-06", "SE-04", "EN-02", "CO-04"))
@each("bad_packet", ("silence", "nak_received"))
def test_the_suite_makes_no_pause_of_its_own(case_id: str, bad_packet: Any) -> None:
    device = dataclasses.replace(MOCK_PROFILE, bad_packet=bad_packet, transfer_timeout_s=3.0)
    late = answers_late(Nak=0.45)
    kind = type("Hasty", (CountsFromPackets, late), {})
    assert blamed(case_id, kind=kind, device=device) == []


@pytest.mark.slow
@each("case_id", ("UP-08", "TX-13", "CO-02", "CO-04"))
def test_silence_in_a_transfer_is_no_pause(case_id: str) -> None:
    """The suite waits for silence as long as general feedback may take (limits.feedback_s)."""
    device = dataclasses.replace(MOCK_PROFILE, update_in_transfer="ignored", transfer_timeout_s=2.5)
    assert blamed(case_id, device=device, given={"limits.feedback_s": 3.0}) == []


def test_an_update_command_that_comes_in_an_erase_may_be_confirmed_after_it() -> None:
    assert faults_of(21, Selection(cases=("UP-05",)), make=strained_device) == []


@pytest.mark.slow
@each("case_id", ("BU-01", "BU-02"))
def test_request_transfer_may_come_while_a_reset_that_restarts_is_being_sent(case_id: str) -> None:
    assert faults_of(2017, Selection(cases=(case_id,)), make=strained_device) == []


@pytest.mark.slow
@each("case_id", ("CR-01", "CR-03"))
def test_waits_for_late_answers_to_damage_add_up_to_no_pause(case_id: str) -> None:
    """Two of them take longer than the pause, one does not."""
    device = dataclasses.replace(MOCK_PROFILE, transfer_timeout_s=2.5, bad_packet="nak_received")
    given: dict[str, Value] = {"limits.ack_s": 1.5, "limits.inter_frame_s": 0.14, "tx_01": "either"}
    kind = type("Right", (CountsFromPackets, answers_late(Nak=0.488)), {})
    assert blamed(case_id, kind=kind, device=device, given=given) == []


@pytest.mark.slow
def test_an_application_starts_after_the_announcements_also_without_a_bus() -> None:
    device = dataclasses.replace(MOCK_PROFILE, reset_delay_s=3.0)
    assert blamed("BU-02", device=device, given={"limits.start_s": 1.0}) == []


@pytest.mark.slow
@each("choice", ("once", "either"))
@each("request_s, ack_s", ((0.3, 0.2), (0.05, 0.45), (2.4, 0.49)))
def test_a_repeated_update_command_may_be_answered_late(
    choice: str, request_s: float, ack_s: float
) -> None:
    kind = answers_late(RequestTransfer=request_s, Ack=ack_s)
    assert blamed("UP-05", kind=kind, given={"up_05": choice}) == []


@pytest.mark.slow
@each("choice", ("either", "restarts"))
@each("delay_s", (1.0, 4.0, 4.9))
def test_a_restart_of_the_bootloader_may_take_as_long_as_one_of_the_application(
    choice: str, delay_s: float
) -> None:
    device = dataclasses.replace(
        MOCK_PROFILE, reset_in_bootloader="restarts", reset_delay_s=delay_s
    )
    assert blamed("RS-02", device=device, given={"rs_02": choice}) == []


@pytest.mark.slow
@each("choice", ("either", "restarts"))
@each("pause", ("announces", "waits"))
def test_a_restart_in_a_transfer_may_take_longer_than_a_pause(choice: str, pause: Any) -> None:
    device = dataclasses.replace(
        MOCK_PROFILE,
        reset_in_transfer="restarts",
        reset_delay_s=4.0,
        transfer_timeout_s=2.5,
        pause_in_transfer=pause,
    )
    given: dict[str, Value] = {"tx_13": choice, "tx_12": "either"}
    assert blamed("TX-13", device=device, given=given) == []


@pytest.mark.slow
def test_an_application_may_start_at_the_end_of_its_limit() -> None:
    device = dataclasses.replace(_SMALL_FIRMWARE, start_delay_s=4.99)
    assert blamed("BR-01", "EN-01", "EN-02", "EN-07", device=device) == []


@pytest.mark.slow
def test_an_update_command_in_the_burst_may_be_answered_by_nak() -> None:
    kind = type("Right", (RefusesInBurst, answers_late(Nak=0.3)), {})
    given: dict[str, Value] = {"up_04_burst": "rejected", "up_02": "nak"}
    device = dataclasses.replace(_SMALL_FIRMWARE, window_s=0.9)
    assert blamed("CR-04", "UP-02", "EN-01", "TX-13", kind=kind, device=device, given=given) == []


@each("step", ("packet-beyond", "packet-skip", "packet-total", "packet-zero"))
def test_a_nak_after_all_packets_may_name_any_number(step: str) -> None:
    explorer = Explorer(subject(AsksBeyondTheEnd), profile_of_mock(), seed="1")
    walk = ["reset", "update=384", "packets=all", step, step]
    assert explorer.replay(walk).finding is None


# -- reception ------------------------------------------------------------------------------------


class _RecordLast(MockDevice):
    store_type = RecordErasedLast


_AFTER_BURST: dict[str, Value] = {"up_04_burst": "rejected"}


@pytest.mark.slow
@each("case_id", ("UP-02", "UP-06", "SE-04"))
def test_wrong_update_commands_are_sent_when_the_device_listens(case_id: str) -> None:
    kind = type("Right", (ListensAfterBurst, RefusesByNak), {})
    assert blamed(case_id, kind=kind, given={**_AFTER_BURST, "up_02": "nak"}) == []


@pytest.mark.slow
@each("case_id", ("FR-06", "FR-10", "CR-03", "PW-01", "PW-02"))
def test_a_device_may_listen_only_after_its_announcements(case_id: str) -> None:
    assert blamed(case_id, kind=ListensAfterBurst, given=_AFTER_BURST) == []


@pytest.mark.slow
@each(
    "case_id, flaw",
    (("UP-06", AnyTargetName), ("UP-02", ErasesBeforeCheck), ("PW-01", _RecordLast)),
)
def test_a_flaw_is_found_in_a_device_that_listens_only_after_its_announcements(
    case_id: str, flaw: type[MockDevice]
) -> None:
    kind = type("Wrong", (ListensAfterBurst, flaw), {})
    assert blamed(case_id, kind=kind, given={**_AFTER_BURST, "up_02": "silence"})


def test_a_case_without_a_stimulus_that_was_received_does_not_pass() -> None:
    # In the middle of what the profile takes for its window, its application starts.
    stated: dict[str, Value] = {"limits.window_s": 0.9, "up_02": "silence"}
    (found,) = blamed("UP-02", kind=StartsSlowly, given=stated)
    assert found.startswith("UP-02 inconclusive")
    assert "were received" in found


@pytest.mark.slow
@each("case_id", ("UP-02", "UP-06", "FR-04", "TX-04", "RS-04", "UP-03"))
def test_a_case_states_how_many_of_its_stimuli_were_received(case_id: str) -> None:
    report = run(subject(), profile_of_mock(), selection=Selection(cases=(case_id,)))
    (result,) = report.results
    (text,) = [info for info in result.infos if "stimuli were received" in info]
    heard, _, sent, *_ = text.split()
    assert heard == sent
    assert int(sent) > 1


# -- dual bank -------------------------------------------------------------------------------------

_KEPT: dict[str, Value] = {"rs_03_old": "kept"}


@pytest.mark.slow
@each("kind, old", ((SwapsBanks, "kept"), (CopiesImage, "either")))
@each(
    "case_ids",
    (
        ("EN-04",),
        ("RS-03", "TX-12", "TX-13", "SE-01"),
        ("UP-08", "FR-07", "TX-03", "EN-01", "EN-02", "EN-07"),
    ),
)
def test_a_dual_bank_device_may_keep_its_old_application(
    kind: type[MockDevice], old: str, case_ids: tuple[str, ...]
) -> None:
    device = dataclasses.replace(
        _SMALL_FIRMWARE, image_checksum="crc32", after_complete="restarts", transfer_timeout_s=3.0
    )
    assert blamed(*case_ids, kind=kind, device=device, given={"rs_03_old": old}) == []


_SMALL_PAGES: Final = dataclasses.replace(
    MOCK_PROFILE, after_complete="restarts", page_size_bytes=256
)
_TWO_PAGES: Final = model_image(GOOD[0], 300), model_image(SECOND[0], 384)
"""Power is cut in every frame and operation of an upgrade."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", [SwapsBanks, CopiesImage, KeepsJournal])
def test_power_cuts_leave_a_dual_bank_device_its_old_or_new_application(
    kind: type[MockDevice],
) -> None:
    found = blamed("PW-01", "PW-02", kind=kind, device=_SMALL_PAGES, given=_KEPT, images=_TWO_PAGES)
    assert found == []


class _ForgetsCopy(CopiesImage):
    """Erases the record of the image that waits before it is copied."""

    class _Store(CopyingStore):
        def copying(self, image: bytes) -> list[Operation]:
            *first, done = super().copying(image)
            return [done, *first]

    store_type = _Store


class _TriesOnce(CopiesImage):
    """Gives up an image whose copying was interrupted twice."""

    _tries = 0
    in_ram = ("_is_copying",)

    def _copies(self, now: float) -> bool:
        if not self._is_copying and self.store.waiting is not None:
            self._tries += 1
            if self._tries > 2:
                self.store.flash.erase_page(
                    self.store.bank(1) + self.profile.application_area_bytes
                )
        is_left = super()._copies(now)
        if not is_left:
            self._tries = 0
        return is_left


class _ErasesJournal(KeepsJournal):
    """Erases its only page of journal before it writes the entry of a new image."""

    class _Store(JournalStore):
        pages = 1

    store_type = _Store


@pytest.mark.slow
@pytest.mark.parametrize("kind", [_ForgetsCopy, _TriesOnce, _ErasesJournal])
def test_a_device_that_loses_an_image_to_a_power_cut_after_complete_fails(
    kind: type[MockDevice],
) -> None:
    (found,) = blamed("PW-01", kind=kind, device=_SMALL_PAGES, given=_KEPT, images=_TWO_PAGES)
    assert "flash operation" in found


class _StartsRefused(MockDevice):
    """Starts an image whose checksum it rejected."""

    def _boot(self, now: float) -> str:
        if self._transfer.stored and self._transfer.stored == self._transfer.total:
            self.store.flash.execute(self.store.recording(self._transfer.size_bytes))
        return super()._boot(now)


class _SwapsAnyway(SwapsBanks, _StartsRefused):
    """Swaps the banks although the image was rejected."""


@each("kind, old", ((_StartsRefused, "erased"), (_SwapsAnyway, "kept"), (_SwapsAnyway, "either")))
def test_a_refused_image_must_not_run(kind: type[MockDevice], old: str) -> None:
    device = dataclasses.replace(MOCK_PROFILE, image_checksum="crc32")
    (found,) = blamed("EN-04", kind=kind, device=device, given={"rs_03_old": old})
    assert found.startswith("EN-04 fail")


def test_a_device_that_is_stated_to_erase_its_application_must_not_run_it() -> None:
    device = dataclasses.replace(MOCK_PROFILE, image_checksum="crc32")
    found = blamed("EN-04", kind=SwapsBanks, device=device, given={"rs_03_old": "erased"})
    assert found


@pytest.mark.slow
@each("kind, value", ((MockDevice, "erased"), (SwapsBanks, "kept"), (CopiesImage, "kept")))
def test_init_finds_whether_the_old_application_is_kept(kind: type[MockDevice], value: str) -> None:
    device = dataclasses.replace(MOCK_PROFILE, after_complete="restarts")
    wanted = {"rs_03_old": value, "device.largest_image_bytes": device.image_limit_bytes}
    assert answers(subject(kind, device), wanted, profile_of_mock(device).given) == wanted


@pytest.mark.slow
@each("old", ("kept", "either"))
def test_walks_on_a_dual_bank_device_find_nothing(old: str) -> None:
    profile = ConformanceProfile({**profile_of_mock().given, "rs_03_old": old})
    assert Explorer(subject(SwapsBanks), profile, seed="4").explore(400).finding is None


@pytest.mark.slow
@each("target", ("bms", "wmc"))
def test_an_application_may_take_its_time_to_listen(target: str) -> None:
    report = run(
        subject(StartsSlowly, _SMALL_FIRMWARE, target),
        profile_of_mock(_SMALL_FIRMWARE),
        selection=Selection(cases=("BR-01", "RS-01", "RS-03", "UP-02", "UP-03", "EN-01", "EN-07")),
    )
    assert [result.reason for result in report.results if result.verdict not in HELD] == []


def test_an_update_command_that_is_not_accepted_may_let_the_old_application_start() -> None:
    kind = type("Right", (SwapsBanks,), {"reassembler_type": PaddingFatal})
    device = dataclasses.replace(MOCK_PROFILE, update_in_transfer="ignored", window_s=0.06)
    given: dict[str, Value] = {**_KEPT, "fr_07": "rejected"}
    assert blamed("FR-07", kind=kind, device=device, given=given) == []


def test_walks_wait_for_late_answers_to_damage() -> None:
    explorer = Explorer(subject(answers_late(Nak=0.488)), profile_of_mock(), seed="1")
    walk = ["reset", "update=128", "packet-doubled", "end"]
    assert explorer.replay(walk).finding is None


def test_walks_know_that_a_pause_may_count_from_the_last_packet_stored() -> None:
    device = dataclasses.replace(MOCK_PROFILE, transfer_timeout_s=2.5)
    explorer = Explorer(subject(CountsFromPackets, device), profile_of_mock(device), seed="1")
    steps = ["reset", "update=128", "packet", "wait=1", "packet-again", "wait=1"]
    assert explorer.replay([*steps, "packet-mode"]).finding is None


def test_walks_know_that_a_pause_may_end_while_they_wait() -> None:
    device = dataclasses.replace(MOCK_PROFILE, transfer_timeout_s=2.5)
    explorer = Explorer(subject(CountsFromPackets, device), profile_of_mock(device), seed="1")
    steps = ["reset", "update=128", "packet", "wait=1", "wait=0.3", "wait=2"]
    assert explorer.replay(steps).finding is None


@pytest.mark.slow
def test_a_reset_may_come_before_anything_is_erased() -> None:
    device = strained_device(2006)
    given: dict[str, Value] = {**device.profiles["fitting"].given, "rs_03_old": "erased"}
    given |= {"limits.version_spacing_tolerance_s": 0.005}
    given |= {"limits.window_s": 0.0512, "limits.window_tolerance_s": 0.001}
    with device.subject() as made:
        report = run(made, ConformanceProfile(given), selection=Selection(cases=("TX-13",)))
    assert report.results[0].verdict in HELD
