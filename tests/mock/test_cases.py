"""The cases RS, UP, TX, EN and SE for a bootloader, with every choice of the profile."""

from __future__ import annotations

import dataclasses
import random
import zlib
from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.events import BytesDamaged, DeviceReported, PacketStored
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol import messages
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Ack, Complete, EndOfTransfer, Nak, Packet, RequestTransfer
from flasher.protocol.spec import BMS, IMAGE_MAX_SIZE, WELLING, Command, Mode
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Message, encode
from tests.loops import each
from tests.mock.bench import QUICK, READ_VERSION, SMALL, Bench, VersionQuery, image_of, packets_of

IMAGE = image_of(600)
PACKETS = packets_of(IMAGE)


def profile_with(**choices: Any) -> DeviceProfile:
    return dataclasses.replace(QUICK, **choices)


def bench_in_transfer(
    profile: DeviceProfile = QUICK, *, stored: int = 0, image: bytes = IMAGE
) -> Bench:
    """A device in the middle of a transfer, `stored` packets of it done."""
    bench = Bench(profile)
    bench.enter_bootloader()
    bench.enter_transfer(len(image))
    bench.transfer(*packets_of(image)[:stored])
    return bench


def finish(bench: Bench, packets: list[Packet], image: bytes) -> None:
    """Send what is left; the image must be whole and run."""
    bench.transfer(*packets)
    bench.end()
    bench.run_to(BootloaderState.APPLICATION)
    assert bench.device.stored_image == image


# -- RS: reset ------------------------------------------------------------------------------------


def test_a_second_reset_during_the_restart_makes_one_clean_restart() -> None:
    """RS-02."""
    bench = Bench()
    bench.send(messages.ResetCommand())
    bench.run(0.02)
    bench.send(messages.ResetCommand())
    bench.run(0.3)
    assert [type(row) for row in bench.take()] == [messages.GeneralFeedbackMessage] + 4 * [
        messages.BootVersion
    ]


def test_half_a_message_from_before_the_restart_does_not_spoil_the_first_one_after_it() -> None:
    bench = Bench()
    reset = bench.encoded(messages.ResetCommand())
    bench.put_wire(reset[:8])
    bench.put(Frame(0x752, reset[8:15]))
    bench.put(Frame(0x752, reset[15:] + bench.encoded(PACKETS[0])[:7]))
    bench.put_wire(bench.encoded(PACKETS[0])[7:64])
    assert bench.device.state is BootloaderState.RESTARTING
    bench.run(0.051)
    bench.send(bench.update_row(600))
    assert bench.is_in(BootloaderState.TRANSFER)


def test_a_reset_during_the_announcements_is_ignored_by_default() -> None:
    """RS-02, R18."""
    bench = Bench()
    bench.enter_bootloader()
    bench.run(0.06)
    bench.send(messages.ResetCommand())
    bench.run(0.12)
    assert [type(row) for row in bench.take()] == 3 * [messages.BootVersion]
    bench.run(1.0)
    assert bench.take() == []


def test_a_reset_during_the_announcements_may_restart_them_without_feedback() -> None:
    bench = Bench(profile_with(reset_in_bootloader="restarts"))
    bench.enter_bootloader()
    bench.run(0.06)
    bench.take()
    bench.send(messages.ResetCommand())
    assert bench.device.state is BootloaderState.RESTARTING
    bench.run(1.0)
    assert [type(row) for row in bench.take()] == 4 * [messages.BootVersion]


def test_what_follows_a_reset_in_the_same_bytes_is_not_received() -> None:
    """A message that is found inside of a damaged one counts, and the device restarts on it."""
    bench = Bench()
    inner = bench.encoded(messages.ResetCommand()) + bench.encoded(READ_VERSION)
    bench.put_wire(bench.encoded(Packet(1, 1, inner.ljust(128, b"\xff")))[:-1] + b"\x00")
    bench.run(0.04)
    assert bench.take() == [messages.GeneralFeedbackMessage()]
    assert bench.device.state is BootloaderState.RESTARTING


@each(
    "can_id, mode, data",
    [
        (0x752, Mode.WRITE, b"RESEt"),
        (0x752, Mode.READ, b"RESET"),
        (0x752, Mode.REPORT, b"RESET"),
        (0x751, Mode.WRITE, b"RESET"),
        (0x725, Mode.WRITE, b"RESET"),
    ],
)
def test_a_reset_that_is_none_is_ignored(can_id: int, mode: Mode, data: bytes) -> None:
    """RS-04."""
    bench = Bench()
    bench.put_wire(encode(Message(can_id, mode, Command.RESET, data)), can_id)
    bench.run(1.0)
    # 2.2.1(2): an application confirms every write.
    is_write = (can_id, mode) == (0x752, Mode.WRITE)
    assert bench.take() == ([messages.GeneralFeedbackMessage()] if is_write else [])
    assert bench.device.state is BootloaderState.APPLICATION


# -- UP: update command ---------------------------------------------------------------------------


@each("size", [1, 127, 128, 129, 78351, 256 * 1024])
def test_images_from_one_byte_to_the_whole_area_are_taken_and_stored_exactly(size: int) -> None:
    """UP-01, TX-07: numbers pass 255 and 256 on the way."""
    bench = Bench(profile_with(application_area_bytes=256 * 1024))
    image = image_of(size)
    bench.upgrade(image)
    assert bench.device.stored_image == image


def test_the_largest_image_of_the_protocol_is_taken_where_it_fits() -> None:
    """TX-07. Its first and its last packet only: the way between is the same for every number."""
    bench = Bench(profile_with(application_area_bytes=16 << 20, page_size_bytes=1 << 20))
    bench.enter_bootloader()
    bench.enter_transfer(IMAGE_MAX_SIZE)
    bench.transfer(Packet(1, 65535, b"\x11" * 128))
    bench.device._transfer.stored = 65534
    bench.transfer(Packet(65535, 65535, b"\x22" * 128))
    bench.end()
    stored = bench.device.stored_image
    assert stored is not None
    assert len(stored) == IMAGE_MAX_SIZE
    assert (stored[:1], stored[-1:]) == (b"\x11", b"\x22")


@each(
    "choices, size",
    [
        ({}, 0),
        ({"application_area_bytes": 256 * 1024}, 256 * 1024 + 1),
        ({}, 0xFFFFFFFF),
        ({"application_area_bytes": 16 << 20}, IMAGE_MAX_SIZE + 1),
        ({"largest_image_bytes": 1000}, 1001),
    ],
)
def test_an_impossible_size_is_refused_before_erasing_and_the_old_application_starts(
    choices: dict[str, Any], size: int
) -> None:
    """UP-02, SE-04."""
    bench = Bench(profile_with(**choices))
    before = bench.device.stored_image
    bench.enter_bootloader()
    bench.send(bench.update_row(size))
    assert bench.take() == []
    (report,) = bench.events_of(DeviceReported)
    assert f"{size} bytes refused while announcing" in report.what
    bench.run(1.0)
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.stored_image == before
    assert bench.device.erase_count == 0


@each("received", [1, 2, 3, 4])
def test_the_update_command_is_taken_at_each_of_the_announcements(received: int) -> None:
    """UP-04."""
    bench = Bench()
    bench.enter_bootloader()
    bench.run(0.05 * (received - 1) + 0.001)
    bench.take()
    bench.send(bench.update_row(600))
    assert bench.take() == [RequestTransfer()]
    bench.run(1.0)
    assert bench.take() == []


@each("offset_s, taken", [(-0.001, True), (0.001, False)])
@each("window_s", [0.0, 0.05, 1.0])
def test_the_window_ends_when_the_profile_states(
    offset_s: float, window_s: float, *, taken: bool
) -> None:
    """UP-04. The last announcement is 0.15 s after the first."""
    bench = Bench(profile_with(window_s=window_s, upgrade_in_application="silence"))
    bench.enter_bootloader()
    bench.run(0.15 + window_s + offset_s)
    bench.take()
    bench.send(bench.update_row(600))
    assert bench.take() == ([RequestTransfer()] if taken else [])
    assert bench.device.state is (
        BootloaderState.TRANSFER if taken else BootloaderState.APPLICATION
    )


def test_messages_that_were_held_up_are_taken_before_the_window_closes() -> None:
    bench = Bench()
    bench.enter_bootloader()
    bench.run(0.16)
    bench.now += 10.0
    bench.send(READ_VERSION, bench.update_row(600))
    assert bench.device.state is BootloaderState.TRANSFER


def test_a_repeated_update_command_before_request_transfer_makes_one_transfer() -> None:
    """UP-05."""
    bench = Bench(SMALL)
    bench.enter_bootloader()
    bench.send(bench.update_row(600))
    bench.run(0.03)
    bench.send(bench.update_row(600))
    bench.run(1.0)
    assert bench.take() == [RequestTransfer()]
    assert bench.device.erase_count == 1 + 3
    finish(bench, PACKETS, IMAGE)


def test_a_repeated_update_command_before_packet_1_is_answered_again_without_erasing() -> None:
    """UP-05, R16."""
    bench = bench_in_transfer()
    erased = bench.device.erase_count
    bench.send(bench.update_row(600))
    assert bench.take() == [RequestTransfer()]
    assert bench.device.erase_count == erased
    finish(bench, PACKETS, IMAGE)


def test_another_size_while_erasing_erases_for_that_size_and_requests_once() -> None:
    bench = Bench(SMALL)
    bench.enter_bootloader()
    bench.send(bench.update_row(1024))
    bench.run(0.03)
    bench.send(bench.update_row(600))
    bench.run(1.0)
    assert bench.take() == [RequestTransfer()]
    finish(bench, PACKETS, IMAGE)


@each(
    "text, command, mode",
    [
        (b"WMC_UPD\x58\x02\0\0", Command.UPDATE, Mode.WRITE),
        (b"OBC_UPD\x58\x02\0\0", Command.UPDATE, Mode.WRITE),
        (b"bms_upd\x58\x02\0\0", Command.UPDATE, Mode.WRITE),
        (b"BMS_UPD\x58\x02\0\0", Command.UPDATE, Mode.READ),
        (b"BMS_UPD\x58\x02\0", 0xA10A, Mode.WRITE),
        (b"BMS_UPD\x58\x02\0\0\0", 0xA10C, Mode.WRITE),
    ],
)
def test_an_update_command_for_another_target_or_of_another_shape_is_rejected(
    text: bytes, command: int, mode: Mode
) -> None:
    """UP-06."""
    bench = Bench()
    bench.enter_bootloader()
    bench.put_wire(encode(Message(0x752, mode, command, text)))
    assert bench.take() == []
    bench.run(1.0)
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.erase_count == 0


@each("size", [600, 300])
@each("stored", [1, 5])
def test_an_update_command_in_the_middle_starts_over_cleanly(stored: int, size: int) -> None:
    """UP-08."""
    bench = bench_in_transfer(stored=stored)
    other = image_of(size, seed=11)
    bench.enter_transfer(size)
    finish(bench, packets_of(other), other)


@each("stored", [0, 2])
def test_an_update_command_while_a_packet_is_programmed_starts_over_cleanly(stored: int) -> None:
    bench = bench_in_transfer(SMALL, stored=stored)
    bench.send(PACKETS[stored])
    bench.run(0.001)
    assert bench.device.state is BootloaderState.PROGRAMMING
    bench.enter_transfer(600)
    finish(bench, PACKETS, IMAGE)


def test_an_update_command_in_the_middle_may_be_ignored_and_the_transfer_goes_on() -> None:
    """UP-08."""
    bench = bench_in_transfer(profile_with(update_in_transfer="ignored"), stored=2)
    erased = bench.device.erase_count
    for size in (600, 300):
        bench.send(bench.update_row(size))
        assert bench.take() == []
    assert bench.device.erase_count == erased
    finish(bench, PACKETS[2:], IMAGE)


def test_while_programming_an_update_command_may_be_ignored_too() -> None:
    profile = dataclasses.replace(SMALL, update_in_transfer="ignored")
    bench = bench_in_transfer(profile, stored=2)
    bench.send(PACKETS[2], bench.update_row(600))
    bench.run(1.0)
    assert bench.take() == [Ack(3)]
    finish(bench, PACKETS[3:], IMAGE)


# -- TX: transfer ---------------------------------------------------------------------------------


def damaged_wires(packet: Packet) -> dict[str, bytes]:
    """One packet with damage of each kind."""
    wire = bytearray(encode(packet.to_message(BMS.request_id)))
    flipped = wire.copy()
    flipped[60] ^= 0x04
    crc = wire.copy()
    crc[-2] ^= 0x01
    tail = wire.copy()
    tail[-1] = 0xF1
    return {"data": bytes(flipped), "crc": bytes(crc), "tail": bytes(tail)}


@each("kind", ["data", "crc", "tail"])
@each(
    "choice, answer",
    [("nak_expected", [Nak(3)]), ("nak_received", [Nak(3)]), ("silence", [])],
)
def test_a_damaged_packet_is_answered_as_the_profile_states_and_taken_when_sent_again(
    choice: str, answer: list[Nak], kind: str
) -> None:
    """TX-01."""
    bench = bench_in_transfer(profile_with(bad_packet=choice), stored=2)
    bench.put_wire(damaged_wires(PACKETS[2])[kind])
    assert bench.take() == answer
    assert len(bench.events_of(BytesDamaged)) == 1
    finish(bench, PACKETS[2:], IMAGE)


@each("lost", [1, 9, 17])
def test_a_lost_frame_is_answered_by_nak_once_the_rest_does_not_come(lost: int) -> None:
    """TX-01."""
    bench = bench_in_transfer(stored=2)
    frames = [Frame(0x752, bench.encoded(PACKETS[2])[at : at + 8]) for at in range(0, 144, 8)]
    del frames[lost]
    bench.put(*frames)
    assert bench.take() == []
    bench.run(0.11)
    assert bench.take() == [Nak(3)]
    finish(bench, PACKETS[2:], IMAGE)


def test_without_its_first_frame_nothing_shows_that_it_was_a_packet() -> None:
    """TX-01: silence where it cannot tell."""
    bench = bench_in_transfer()
    bench.put_wire(bench.encoded(PACKETS[0])[8:])
    bench.run(1.0)
    assert bench.take() == []
    finish(bench, PACKETS, IMAGE)


def test_every_single_bit_flip_of_a_packet_is_rejected() -> None:
    """CR-01."""
    bench = bench_in_transfer(profile_with(pause_in_transfer="waits"))
    wire = bench.encoded(PACKETS[0])
    for bit in range(8 * len(wire)):
        flipped = bytearray(wire)
        flipped[bit // 8] ^= 1 << bit % 8
        bench.put_wire(bytes(flipped))
        bench.run(0.2)
    assert bench.events_of(PacketStored) == []
    assert set(bench.take()) == {Nak(1)}
    finish(bench, PACKETS, IMAGE)


def test_damage_outside_of_a_transfer_is_reported_but_not_answered() -> None:
    bench = Bench()
    bench.enter_bootloader()
    bench.put_wire(damaged_wires(PACKETS[0])["data"])
    assert bench.take() == []
    assert len(bench.events_of(BytesDamaged)) == 1


def test_damage_that_does_not_begin_like_a_packet_is_not_answered() -> None:
    bench = bench_in_transfer()
    wire = bytearray(bench.encoded(EndOfTransfer()))
    wire[-2] ^= 1
    bench.put_wire(bytes(wire))
    assert bench.take() == []
    bench.put_wire(b"\x12" * 11)
    bench.run(1.0)
    assert bench.take() == []


@each("choice, answer", [("ack", Ack(2)), ("nak_next", Nak(3))])
def test_a_repeated_packet_is_answered_as_the_profile_states_and_nothing_is_written_twice(
    choice: str, answer: messages.UpgradeMessage
) -> None:
    """TX-02, R10."""
    bench = bench_in_transfer(profile_with(repeated_packet=choice), stored=2)
    programmed = bench.device.program_count
    bench.send(PACKETS[1])
    assert bench.take() == [answer]
    assert bench.device.program_count == programmed
    finish(bench, PACKETS[2:], IMAGE)


def test_a_repeated_packet_with_other_data_leaves_the_first() -> None:
    """TX-05."""
    bench = bench_in_transfer(stored=2)
    bench.send(Packet(2, 5, b"\x00" * 128))
    assert bench.take() == [Ack(2)]
    finish(bench, PACKETS[2:], IMAGE)


def test_the_number_after_the_largest_one_is_not_asked_for() -> None:
    """R10: there is no NAK n+1 for packet 65535."""
    profile = profile_with(
        repeated_packet="nak_next", application_area_bytes=16 << 20, page_size_bytes=1 << 20
    )
    bench = Bench(profile)
    bench.enter_bootloader()
    bench.enter_transfer(IMAGE_MAX_SIZE)
    bench.device._transfer.stored = 65535
    bench.send(Packet(65535, 65535, b"\x22" * 128))
    assert bench.take() == [Nak(65535)]


def test_a_packet_after_the_last_one_is_rejected() -> None:
    """TX-03."""
    bench = bench_in_transfer(stored=5)
    bench.send(Packet(6, 5, b"\x22" * 128))
    assert bench.take() == [Nak(5)]
    finish(bench, [], IMAGE)


@each("choice, answer", [("ack", [Ack(1)]), ("nak", [Nak(4)]), ("silence", [])])
def test_an_older_packet_is_answered_as_the_profile_states(
    choice: str, answer: list[messages.UpgradeMessage]
) -> None:
    """TX-03."""
    bench = bench_in_transfer(profile_with(older_packet=choice), stored=3)
    bench.send(PACKETS[0])
    assert bench.take() == answer
    finish(bench, PACKETS[3:], IMAGE)


def raw_packet(start: int, number: int, total: int, mode: Mode = Mode.WRITE) -> bytes:
    data = bytes((start,)) + number.to_bytes(2, "little") + total.to_bytes(2, "little")
    return encode(Message(0x752, mode, Command.PACKET, data + b"\x5a" * 128))


IMPOSSIBLE_PACKETS = {
    "skipped": raw_packet(1, 4, 5),
    "number 0": raw_packet(1, 0, 5),
    "beyond total": raw_packet(1, 6, 5),
    "other total": raw_packet(1, 3, 6),
    "total 0": raw_packet(1, 3, 0),
    "wrong start": raw_packet(2, 3, 5),
    "read mode": raw_packet(1, 3, 5, Mode.READ),
}


@each("kind", IMPOSSIBLE_PACKETS)
@each("choice, answer", [("nak_expected", [Nak(3)]), ("silence", [])])
def test_an_impossible_packet_is_rejected_and_the_transfer_goes_on(
    kind: str, choice: str, answer: list[Nak]
) -> None:
    """TX-03, TX-04, TX-06."""
    bench = bench_in_transfer(profile_with(bad_packet=choice), stored=2)
    bench.put_wire(IMPOSSIBLE_PACKETS[kind])
    assert bench.take() == answer
    finish(bench, PACKETS[2:], IMAGE)


def test_the_nak_of_an_impossible_packet_may_carry_its_own_number_where_it_has_one() -> None:
    """TX-01: the number is the profile's choice."""
    bench = bench_in_transfer(profile_with(bad_packet="nak_received"), stored=2)
    bench.put_wire(IMPOSSIBLE_PACKETS["skipped"])
    assert bench.take() == [Nak(4)]
    bench.put_wire(IMPOSSIBLE_PACKETS["wrong start"])
    assert bench.take() == [Nak(3)]
    bench.put_wire(damaged_wires(PACKETS[4])["data"])
    assert bench.take() == [Nak(5)]
    bench.put_wire(bench.encoded(PACKETS[4])[:8])
    bench.run(0.2)
    assert bench.take() == [Nak(3)]


def test_bytes_after_the_end_of_the_image_are_ignored_whatever_they_are() -> None:
    """TX-08."""
    bench = bench_in_transfer(stored=4)
    last = Packet(5, 5, IMAGE[512:].ljust(128, b"\x00"))
    finish(bench, [last], IMAGE)
    assert bench.device.store.read(608)[600:] == b"\xff" * 8


def test_a_long_pause_may_be_waited_out() -> None:
    """TX-12."""
    bench = bench_in_transfer(profile_with(pause_in_transfer="waits"), stored=2)
    bench.run(3600.0)
    assert bench.take() == []
    finish(bench, PACKETS[2:], IMAGE)


def test_a_long_pause_may_end_the_transfer_and_the_device_is_reachable_again() -> None:
    """TX-12."""
    bench = bench_in_transfer(profile_with(transfer_timeout_s=2.0), stored=2)
    bench.run(1.9)
    bench.transfer(PACKETS[2])
    bench.run(1.9)
    bench.send(Packet(9, 9, b"\x00" * 128))
    bench.run(1.9)
    bench.send(EndOfTransfer())
    bench.run(1.99)
    assert bench.take() == [Nak(4)] * 2
    bench.run(0.02)
    assert bench.device.state is BootloaderState.ANNOUNCING
    assert isinstance(bench.take()[0], messages.BootVersion)
    bench.run(60.0)
    assert bench.device.state is BootloaderState.ANNOUNCING
    bench.upgrade(IMAGE)
    assert bench.device.stored_image == IMAGE


def test_a_reset_during_the_transfer_is_ignored_by_default() -> None:
    """TX-13."""
    bench = bench_in_transfer(SMALL, stored=2)
    bench.send(messages.ResetCommand())
    bench.run(1.0)
    assert bench.take() == []
    bench.send(PACKETS[2], messages.ResetCommand())
    bench.run(1.0)
    assert bench.take() == [Ack(3)]
    finish(bench, PACKETS[3:], IMAGE)


@each(
    "state",
    [
        BootloaderState.ERASING,
        BootloaderState.TRANSFER,
        BootloaderState.PROGRAMMING,
        BootloaderState.CHECKING,
    ],
)
def test_a_reset_during_the_upgrade_may_restart_and_the_device_is_rescuable(
    state: BootloaderState,
) -> None:
    """TX-13."""
    bench = Bench(dataclasses.replace(SMALL, reset_in_transfer="restarts"))
    bench.enter_bootloader()
    bench.send(bench.update_row(600))
    if state is not BootloaderState.ERASING:
        bench.run_to(BootloaderState.TRANSFER)
        bench.take()
        bench.transfer(*PACKETS[:-1])
    if state is BootloaderState.CHECKING:
        bench.transfer(PACKETS[-1])
        bench.send(EndOfTransfer())
    elif state is BootloaderState.PROGRAMMING:
        bench.send(PACKETS[-1])
    assert bench.device.state is state
    bench.run(0.001)
    bench.send(messages.ResetCommand())
    assert bench.device.state is BootloaderState.RESTARTING
    bench.run(0.2)
    assert {type(row) for row in bench.take()} == {messages.BootVersion}
    assert bench.device.stored_image is None
    bench.upgrade(IMAGE)
    assert bench.device.stored_image == IMAGE


def test_messages_while_a_packet_is_programmed_are_out_of_turn() -> None:
    bench = bench_in_transfer(SMALL)
    bench.send(PACKETS[0], PACKETS[0], PACKETS[1], EndOfTransfer())
    bench.put_wire(IMPOSSIBLE_PACKETS["wrong start"])
    bench.run(1.0)
    assert bench.take() == [Ack(1)]
    finish(bench, PACKETS[1:], IMAGE)


def test_packets_and_end_without_an_update_command_are_rejected() -> None:
    bench = Bench()
    bench.enter_bootloader()
    bench.send(PACKETS[0], EndOfTransfer())
    assert bench.take() == []
    bench.run(1.0)
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.program_count == 0


# -- EN: end --------------------------------------------------------------------------------------


@each("stored", [0, 1, 4])
def test_an_early_end_is_answered_by_nak_with_the_packet_wanted_and_the_transfer_goes_on(
    stored: int,
) -> None:
    """EN-02."""
    bench = bench_in_transfer(stored=stored)
    bench.send(EndOfTransfer(), EndOfTransfer())
    assert bench.take() == [Nak(stored + 1)] * 2
    finish(bench, PACKETS[stored:], IMAGE)


@each("choice, answer", [("same_answer", [Complete()]), ("silence", [])])
def test_a_second_end_is_answered_as_the_profile_states(
    choice: str, answer: list[Complete]
) -> None:
    """EN-02."""
    bench = bench_in_transfer(profile_with(repeated_end=choice), stored=5)
    bench.end()
    bench.send(EndOfTransfer())
    assert bench.take() == answer
    bench.run_to(BootloaderState.APPLICATION)
    bench.send(EndOfTransfer())
    assert bench.take() == [messages.GeneralFeedbackMessage()]


def test_an_update_command_or_a_reset_after_complete_does_not_touch_the_new_image() -> None:
    """EN-03, R11."""
    bench = bench_in_transfer(profile_with(reset_in_transfer="restarts"), stored=5)
    bench.end()
    erased = bench.device.erase_count
    bench.send(bench.update_row(600), messages.ResetCommand(), PACKETS[0])
    assert bench.take() == []
    (report,) = bench.events_of(DeviceReported)
    assert "600 bytes refused while starting" in report.what
    bench.run(0.11)
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.erase_count == erased
    assert bench.device.stored_image == IMAGE


def test_the_new_application_may_start_through_the_bootloader() -> None:
    """EN-03."""
    bench = bench_in_transfer(profile_with(after_complete="restarts"), stored=5)
    bench.end()
    bench.run(1.0)
    assert [type(row) for row in bench.take()] == 4 * [messages.BootVersion]
    assert bench.device.state is BootloaderState.APPLICATION
    assert bench.device.stored_image == IMAGE


def with_checksum(body: bytes) -> bytes:
    return body + zlib.crc32(body).to_bytes(4, "little")


def test_an_image_with_a_right_checksum_is_taken() -> None:
    """EN-04, R7."""
    bench = Bench(profile_with(image_checksum="crc32"))
    image = with_checksum(image_of(596))
    bench.upgrade(image)
    assert bench.device.stored_image == image


@each(
    "image",
    [
        image_of(600),
        with_checksum(image_of(596))[::-1],
        b"\x00" * 4,
        zlib.crc32(b"").to_bytes(4, "little"),
    ],
)
def test_an_image_with_a_wrong_checksum_is_refused_never_runs_and_the_device_is_rescuable(
    image: bytes,
) -> None:
    """EN-04, R6."""
    bench = Bench(profile_with(image_checksum="crc32"))
    bench.enter_bootloader()
    bench.enter_transfer(len(image))
    packets = packets_of(image)
    bench.transfer(*packets)
    bench.send(EndOfTransfer(), EndOfTransfer())
    assert bench.take() == [Nak(len(packets))] * 2
    assert bench.device.stored_image is None
    bench.run(0.99)
    assert bench.take() == []
    bench.run(5.0)
    assert bench.device.state is BootloaderState.ANNOUNCING
    assert len(bench.take()) > 4
    bench.upgrade(with_checksum(image_of(300)))
    assert bench.device.stored_image == with_checksum(image_of(300))


def test_after_a_refusal_the_second_end_may_meet_silence_and_an_update_command_starts_over() -> (
    None
):
    bench = Bench(profile_with(image_checksum="crc32", repeated_end="silence"))
    bench.enter_bootloader()
    bench.enter_transfer(600)
    bench.transfer(*PACKETS)
    bench.send(EndOfTransfer(), EndOfTransfer(), messages.ResetCommand())
    assert bench.take() == [Nak(5)]
    bench.send(bench.update_row(0))
    assert bench.device.state is BootloaderState.REFUSED
    good = with_checksum(image_of(596))
    bench.enter_transfer(600)
    finish(bench, packets_of(good), good)


def test_upgrades_in_a_row_also_to_a_smaller_image_are_each_right() -> None:
    """EN-07, EN-08."""
    bench = Bench()
    for size, version in (
        (5000, "V2r0r0_20260101"),
        (300, "V3r0r0_20260102"),
        (9000, "V4r0r0_20260103"),
    ):
        image = image_of(size, version)
        bench.upgrade(image)
        assert bench.device.stored_image == image
        bench.take()
        bench.send(READ_VERSION)
        (row,) = bench.take()
        assert isinstance(row, messages.Unknown)
        assert row.message.data[48:] == version.encode() + b"."


def test_an_end_while_the_record_is_written_is_answered_once() -> None:
    bench = bench_in_transfer(SMALL, stored=5)
    bench.send(EndOfTransfer(), EndOfTransfer(), bench.update_row(600))
    bench.run(0.05)
    assert bench.take() == [Complete()]
    assert bench.device.stored_image == IMAGE


# -- SE: anything at all --------------------------------------------------------------------------


@pytest.mark.slow
@each("seed", range(20))
def test_random_traffic_leaves_the_device_reachable_and_an_application_old_or_none(
    seed: int,
) -> None:
    """SE-03. Random messages in any state; then a rescue."""
    source = random.Random(seed)
    profile = dataclasses.replace(
        SMALL, reset_in_transfer="restarts", reset_in_bootloader="restarts"
    )
    bench = Bench(profile)
    factory = bench.device.stored_image
    rows: list[messages.UpgradeMessage | VersionQuery] = [
        messages.ResetCommand(),
        READ_VERSION,
        bench.update_row(600),
        bench.update_row(100),
        bench.update_row(0),
        EndOfTransfer(),
        Ack(1),
        *PACKETS[:4],
    ]
    for _ in range(300):
        if source.random() < 0.3:
            bench.put(Frame(0x752, source.randbytes(source.randint(0, 8))))
        else:
            bench.send(source.choice(rows))
        bench.run(source.choice([0.0, 0.001, 0.03, 0.3]))
        # Packet 5 of 5 never comes, and packet 1 of 1 does not exist.
        assert bench.device.stored_image in {factory, None}
    bench.run(5.0)
    if bench.device.state not in {BootloaderState.APPLICATION, BootloaderState.ANNOUNCING}:
        bench.send(messages.ResetCommand())
    bench.upgrade(IMAGE)
    assert bench.device.stored_image == IMAGE


def test_endless_junk_is_held_in_bounded_memory() -> None:
    """SE-01."""
    bench = Bench()
    for _ in range(2000):
        bench.put(Frame(0x752, b"\x55\xaa\x16\x87\xa3\x85\x01\x01"))
    assert bench.device._reassemblers[0x752].buffered_bytes < 1000
    bench.run(1.0)
    assert bench.device._reassemblers[0x752].buffered_bytes == 0


# -- the engine -----------------------------------------------------------------------------------


def test_a_device_is_an_engine() -> None:
    engine: Engine = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps)
    assert not engine.done


def test_cancelled_it_finishes_the_message_under_way_and_is_done() -> None:
    bench = Bench()
    bench.accepts_frames = False
    bench.send(messages.ResetCommand(), messages.ResetCommand())
    device = bench.device
    first = device.next_frame(bench.now)
    assert first is not None
    device.frame_sent(bench.now)
    device.cancel(bench.now)
    finished_early = device.done
    assert device.deadline() is not None
    bench.accepts_frames = True
    bench._partial = first.data
    assert bench.take() == [messages.GeneralFeedbackMessage()]
    assert (finished_early, device.done) == (False, True)
    assert device.deadline() is None


def test_cancelled_it_receives_and_does_nothing_any_more() -> None:
    bench = Bench(has_application=False)
    bench.run(0.01)
    bench.take()
    bench.device.cancel(bench.now)
    assert bench.device.done
    bench.send(bench.update_row(600))
    bench.device.tick(bench.now + 10.0)
    assert bench.take() == []
    assert bench.device.erase_count == 0


def test_announcing_without_a_pause_is_no_timing() -> None:
    with pytest.raises(UsageError, match="greater than 0"):
        MockDevice(BMS, bitrate_bps=250_000, timings=Timings(boot_version_spacing_s=0.0))
