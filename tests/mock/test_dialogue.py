"""The good path, byte by byte as in the document, for every target; and the running application."""

from __future__ import annotations

import dataclasses
import hashlib

import pytest

from flasher.events import DeviceReported, DeviceStateEntered, ImageStored, PacketStored
from flasher.host.duplicates import DuplicateDetector
from flasher.mock.model import NO_VERSION
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, OBC, TARGETS, WMC, Command, Mode, Target
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, encode
from tests.loops import each
from tests.mock.bench import QUICK, READ_VERSION, START_S, Bench, image_of, packets_of
from tests.peers.wording import build
from tests.protocol.cases import case

BOOT_1_2_3 = dataclasses.replace(QUICK, boot_version="V1.2.3")

# For each target, as the document has them: reset, general feedback, boot version V1.2.3, update
# command for 128 bytes, request transfer, ACK 1, end of transfer, complete.
DIALOGUES = {
    WMC: (
        "55aa1607420552455345545fa4a5abf0",
        "55aa0c05550341434b7cecb1d9f0",
        "55aa0c0bc109574d4356312e322e336c4dd358f0",
        "55aa160da10b574d435f5550448000000092324155f0",
        "55aa0c04c402000001ea2f13f0",
        "55aa0c04c202010032bc87eef0",
        "55aa1603a401046636c0fbf0",
        "55aa0c04c5020000e94e7916f0",
    ),
    BMS: (
        "55aa160742055245534554a41da484f0",
        "55aa0c05550341434bb209fc46f0",
        "55aa0c0bc109424d5356312e322e33e657d854f0",
        "55aa160da10b424d535f55504480000000db7167a3f0",
        "55aa0c04c4020000337142f8f0",
        "55aa0c04c20201000027ea05f0",
        "55aa1603a401042c3d8a98f0",
        "55aa0c04c5020000dbd514fdf0",
    ),
    OBC: (
        "55aa160742055245534554f28aa461f0",
        "55aa0c05550341434bf7aac733f0",
        "55aa0c0bc10950425556312e322e333607f7e8f0",
        "55aa160da10b4f42435f555044800000006a8df864f0",
        "55aa0c04c4020000deb892ccf0",
        "55aa0c04c2020100edee3a31f0",
        "55aa1603a40104e98447d4f0",
        "55aa0c04c5020000361cc4c9f0",
    ),
}
ANSWER_IDS = {WMC: 0x715, BMS: 0x725, OBC: 0x735}
TARGET_LIST = list(TARGETS.values())


@each("target", TARGET_LIST)
def test_a_whole_upgrade_is_answered_byte_by_byte_as_in_the_document(target: Target) -> None:
    reset, feedback, version, update, request, ack, end, complete = DIALOGUES[target]
    image = image_of(128)
    bench = Bench(BOOT_1_2_3, target=target)

    bench.put_hex(reset)
    assert bench.take_hex() == [feedback]
    bench.run(0.05)
    assert bench.take_hex() == [version]
    bench.put_hex(update)
    assert bench.take_hex() == [request]
    bench.send(*packets_of(image))
    assert bench.take_hex() == [ack]
    bench.put_hex(end)
    sent = bench.take_sent()
    assert [(item.wire.hex(), item.can_id) for item in sent] == [(complete, ANSWER_IDS[target])]
    bench.run(0.1)

    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.stored_image == image


@each("target", TARGET_LIST)
def test_the_packet_of_the_document_is_acknowledged(target: Target) -> None:
    bench = Bench(target=target)
    bench.enter_bootloader()
    bench.put_wire(case(f"{target.name} update command, 78351 bytes").wire)
    assert bench.take() == [messages.RequestTransfer()]
    bench.put_wire(case(f"{target.name} packet 1/613").wire)
    assert bench.take_hex() == [case(f"{target.name} ACK 1").wire.hex()]


def test_with_no_flash_times_every_answer_comes_at_once() -> None:
    bench = Bench()
    bench.enter_bootloader()
    began_s = bench.now
    bench.send(bench.update_row(300), *packets_of(image_of(300)), messages.EndOfTransfer())
    assert [sent.at_s for sent in bench.take_sent()] == [began_s] * 5


def test_flash_times_delay_request_ack_and_complete_by_their_operations() -> None:
    profile = DeviceProfile(erase_time_s=0.02, program_time_s=0.002, page_size_bytes=256)
    bench = Bench(profile)
    bench.enter_bootloader()
    began_s = bench.now
    bench.send(bench.update_row(300))
    bench.run(1.0)
    # The page of the record, and two pages of the application.
    assert [sent.at_s for sent in bench.take_sent()] == [pytest.approx(began_s + 3 * 0.02)]
    for packet in packets_of(image_of(300)):
        began_s = bench.now
        bench.send(packet)
        bench.run(1.0)
        assert [sent.at_s for sent in bench.take_sent()] == [pytest.approx(began_s + 0.002)]
    began_s = bench.now
    bench.send(messages.EndOfTransfer())
    bench.run(0.05)
    assert [sent.at_s for sent in bench.take_sent()] == [pytest.approx(began_s + 0.002)]
    assert (bench.device.erase_count, bench.device.program_count) == (3, 4)


def test_the_whole_area_is_erased_when_the_profile_sets_it() -> None:
    profile = dataclasses.replace(QUICK, application_area_bytes=8192, erased_pages="all")
    bench = Bench(profile)
    bench.upgrade(image_of(100))
    assert bench.device.erase_count == 1 + 4


def test_events_report_the_story_of_an_upgrade() -> None:
    image = image_of(300)
    bench = Bench(BOOT_1_2_3)
    bench.upgrade(image)
    assert [event.state for event in bench.events_of(DeviceStateEntered)] == [
        "application",
        "restarting",
        "announcing",
        "erasing",
        "transfer",
        "checking",
        "starting",
        "application",
    ]
    details = [event.detail for event in bench.events_of(DeviceStateEntered)]
    assert details[0] == "version V1r0r0_20220512"
    assert details[3] == "for 300 bytes in 3 packets"
    assert details[-1] == "version V2r0r0_20260101"
    assert bench.events_of(PacketStored) == [PacketStored(number, 3) for number in (1, 2, 3)]
    assert bench.events_of(ImageStored) == [ImageStored(300, hashlib.sha256(image).hexdigest())]


# -- application ----------------------------------------------------------------------------------


def test_at_construction_a_whole_application_has_been_running_for_a_while() -> None:
    bench = Bench()
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.deadline() is None
    assert bench.device.stored_image is not None
    assert (bench.device.erase_count, bench.device.program_count) == (0, 0)


def test_the_bms_reports_its_version_information_as_in_the_document() -> None:
    bench = Bench(dataclasses.replace(QUICK, factory_version="V1r2r3_20220512"))
    bench.put_hex("55aa11023300fda6627cf0")
    (sent,) = bench.take_sent()
    golden = case("version: BM36, W2605001, V1r2r0_20220512, V1r2r3_20220512")
    assert (sent.can_id, sent.wire) == (0x720, golden.wire)


@each("target", [WMC, OBC])
def test_wmc_and_obc_do_not_know_the_version_query(target: Target) -> None:
    bench = Bench(target=target)
    bench.send(READ_VERSION)
    assert bench.take() == []


@each(
    "text, field",
    [
        (b"...V2r0r1_20260101..", b"V2r0r1_20260101."),
        (b"...V2r10r1_20260101.", b"V2r10r1_20260101"),
        (b"..V2r10r10_20260101.", b"V2r10r10_2026010"),
        (b"V2r0r1_2026010", NO_VERSION.encode() + b".        "),
        (b"V2r0r1_20260101V9r0r1_20260101", NO_VERSION.encode() + b".        "),
    ],
)
def test_a_new_application_reports_the_version_that_its_image_holds(
    text: bytes, field: bytes
) -> None:
    bench = Bench()
    bench.upgrade(text.ljust(200, b"\x00"))
    bench.take_sent()
    bench.send(READ_VERSION)
    (row,) = bench.take()
    assert isinstance(row, messages.Unknown)
    assert row.message.data[:5] == b"BM36."
    assert row.message.data[48:] == field


def test_no_device_answers_the_version_query_in_the_bootloader() -> None:
    bench = Bench(has_application=False)
    bench.send(READ_VERSION)
    assert bench.take() == []


@each("choice, answers", [("general_feedback", True), ("silence", False)])
def test_the_application_answers_upgrade_messages_with_feedback_or_not_and_erases_nothing(
    choice: str, *, answers: bool
) -> None:
    """UP-03, R17."""
    bench = Bench(DeviceProfile(upgrade_in_application=choice))  # type: ignore[arg-type]
    before = bench.device.stored_image
    rows: list[messages.UpgradeMessage] = [bench.update_row(300), messages.EndOfTransfer()]
    for row in rows + packets_of(image_of(10)):
        bench.send(row)
        bench.run(5.0)
        assert bench.take() == ([messages.GeneralFeedbackMessage()] if answers else [])
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.stored_image == before
    assert (bench.device.erase_count, bench.device.program_count) == (0, 0)


def test_the_update_text_of_another_target_is_a_write_like_others_to_the_application() -> None:
    bench = Bench()
    bench.send(messages.UpdateCommand("OBC_UPD", 300))
    assert bench.take() == [messages.GeneralFeedbackMessage()]
    assert bench.device.state is BootloaderState.APPLICATION


# -- what is not for the device -------------------------------------------------------------------


def test_frames_of_other_ids_and_kinds_between_those_of_a_message_are_nothing() -> None:
    """FR-09, CO-04."""
    bench = Bench()
    first, second = case("bms reset").payloads
    strays = [
        Frame(0x751, first),
        Frame(0x752, b""),
        Frame(0x752, first, is_extended=True),
        Frame(0x752, first, is_remote=True),
        Frame(0x752, first, is_error=True),
    ]
    bench.put(*strays, Frame(0x752, first), *strays, Frame(0x752, second))
    assert bench.take() == [messages.GeneralFeedbackMessage()]


@each("size", range(1, 9))
def test_a_message_is_understood_in_whatever_pieces_it_comes(size: int) -> None:
    """FR-01."""
    bench = Bench()
    wire = case("bms reset").wire
    bench.put(*(Frame(0x752, wire[at : at + size]) for at in range(0, len(wire), size)))
    assert bench.take() == [messages.GeneralFeedbackMessage()]


def test_junk_before_a_message_is_passed_over() -> None:
    """FR-02."""
    bench = Bench()
    bench.put(Frame(0x752, b"\x00\x55"))
    bench.put_wire(b"\x55" + case("bms reset").wire)
    assert bench.take() == [messages.GeneralFeedbackMessage()]


def test_unknown_and_malformed_messages_are_rejected_and_the_malformed_ones_reported() -> None:
    """FR-10."""
    bench = Bench()
    bench.put_wire(build(0x752, 0x11, 0x7702, b"\x00\x00"))
    bench.send(messages.Ack(1))
    assert bench.events_of(DeviceReported) == []
    bench.put_wire(encode(Message(0x752, Mode.READ, Command.RESET, b"RESET")))
    (report,) = bench.events_of(DeviceReported)
    assert report.what == "malformed message 4205: mode is 11, not 16"
    assert bench.take() == []
    assert bench.device.state is BootloaderState.APPLICATION


# -- announcements --------------------------------------------------------------------------------


def test_after_reset_the_version_is_announced_four_times_50_ms_apart_then_the_old_one_starts() -> (
    None
):
    """RS-01, RS-03."""
    bench = Bench(BOOT_1_2_3)
    before = bench.device.stored_image
    bench.send(messages.ResetCommand())
    bench.run(0.39)
    feedback, *versions = bench.take_sent()
    assert feedback.at_s == START_S
    assert {sent.wire.hex() for sent in versions} == {DIALOGUES[BMS][2]}
    expected_s = [START_S + 0.05 + 0.05 * index for index in range(4)]
    assert [sent.at_s for sent in versions] == pytest.approx(expected_s)
    # The window of 0.2 s after the last one, 0.2 s after the reset, is over at 0.4 s.
    assert bench.is_in(BootloaderState.ANNOUNCING)
    bench.run(0.02)
    assert bench.is_in(BootloaderState.APPLICATION)
    assert bench.device.stored_image == before
    assert bench.device.deadline() is None


def test_power_up_passes_through_the_same_announcements() -> None:
    """RS-05."""
    bench = Bench()
    bench.device.power_cut(bench.now)
    bench.run(10.0)
    bench.device.power_on(bench.now)
    began_s = bench.now
    bench.run(1.0)
    sent = bench.take_sent()
    expected_s = [began_s + 0.05 + 0.05 * index for index in range(4)]
    assert [item.at_s for item in sent] == pytest.approx(expected_s)
    assert bench.device.state is BootloaderState.APPLICATION


def test_without_an_application_the_announcements_go_on_at_the_same_pace() -> None:
    """RS-03, R14."""
    bench = Bench(has_application=False)
    assert bench.device.stored_image is None
    bench.run(10.0)
    times_s = [sent.at_s for sent in bench.take_sent()]
    assert times_s[0] == START_S
    assert len(times_s) in {200, 201}
    assert times_s == pytest.approx([START_S + 0.05 * index for index in range(len(times_s))])


def test_without_an_application_a_profile_may_listen_silently_after_the_burst() -> None:
    bench = Bench(dataclasses.replace(QUICK, without_application="listens"), has_application=False)
    bench.run(60.0)
    assert len(bench.take_sent()) == 4
    assert bench.device.state is BootloaderState.ANNOUNCING
    assert bench.device.deadline() is None
    bench.upgrade(image_of(300))
    assert bench.device.stored_image == image_of(300)


def test_a_device_model_whose_computer_stalls_is_not_taken_for_two_bootloaders() -> None:
    bench = Bench(has_application=False)
    bench.run(0.2)
    bench.take_sent()
    detector = DuplicateDetector(DEFAULT_TIMINGS)
    announced = messages.BootVersion(BMS.boot_name, "V1.0.0").to_message(BMS.answer_id)
    for late_s in (0.0, 0.045, 0.045, 0.0, 0.0, 0.0):
        due = bench.device.deadline()
        assert due is not None
        bench.now = due + late_s
        bench.device.tick(bench.now)
        bench.run(0.001)
        assert len(bench.take_sent()) == 1
        detector.received(announced, due + late_s)
    assert detector.evidence == ""


def test_a_late_tick_does_not_make_the_announcements_catch_up() -> None:
    bench = Bench()
    bench.enter_bootloader()
    bench.now += 1.0
    bench.device.tick(bench.now)
    assert len(bench.take_sent()) == 1
    bench.run(0.049)
    assert bench.take_sent() == []
    bench.run(0.002)
    assert len(bench.take_sent()) == 1


def test_a_tick_that_is_a_little_late_does_not_delay_the_next_announcement() -> None:
    bench = Bench()
    bench.enter_bootloader()
    first_s = bench.now
    bench.now += 0.06
    bench.device.tick(bench.now)
    bench.run(0.05)
    assert [sent.at_s - first_s for sent in bench.take_sent()] == pytest.approx([0.06, 0.1])


def test_an_announcement_that_the_bus_did_not_take_is_not_sent_after_the_update_command() -> None:
    bench = Bench()
    bench.send(messages.ResetCommand())
    bench.take()
    bench.accepts_frames = False
    bench.run(0.06)
    assert bench.is_in(BootloaderState.ANNOUNCING)
    bench.send(bench.update_row(128))
    bench.accepts_frames = True
    assert bench.take() == [messages.RequestTransfer()]


def test_an_answer_that_the_bus_did_not_take_is_not_sent_after_a_restart() -> None:
    bench = Bench(dataclasses.replace(QUICK, reset_in_transfer="restarts"))
    bench.enter_bootloader()
    bench.accepts_frames = False
    bench.send(bench.update_row(128), messages.ResetCommand())
    bench.accepts_frames = True
    assert bench.take() == []
    bench.run(0.06)
    assert [type(row) for row in bench.take()] == [messages.BootVersion]


def test_a_bus_that_takes_nothing_does_not_pile_announcements_up() -> None:
    bench = Bench(has_application=False)
    bench.accepts_frames = False
    bench.run(5.0)
    bench.accepts_frames = True
    assert len(bench.take_sent()) == 1
    bench.run(0.06)
    assert len(bench.take_sent()) in {1, 2}


def test_feedback_and_announcement_both_come_when_a_restart_takes_no_time() -> None:
    bench = Bench(dataclasses.replace(QUICK, reset_delay_s=0.0, boot_version="V1.0.0"))
    bench.send(messages.ResetCommand())
    assert bench.take() == [
        messages.GeneralFeedbackMessage(),
        messages.BootVersion("BMS", "V1.0.0"),
    ]
