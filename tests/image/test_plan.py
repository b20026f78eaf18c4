"""The plan: packets, frames and exact seconds, and the frames of a packet."""

from __future__ import annotations

import random
from array import array
from pathlib import Path

import pytest

from flasher.errors import ImageError, UsageError
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan, make_plan, plan
from flasher.protocol.bittime import frame_bits
from flasher.protocol.frame import Frame
from flasher.protocol.messages import Packet, decode
from flasher.protocol.spec import BMS, IMAGE_MAX_SIZE, MOTINOVA, OBC, TARGETS, WMC, Target
from flasher.protocol.wire import Message, Reassembler, encode, split
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
BITRATE_BPS = 250_000


def made(size: int, target: Target = BMS) -> Plan:
    data = random.Random(size).randbytes(size)
    return plan(Image.from_bytes(data), target, BITRATE_BPS)


def received(frames: list[Frame]) -> Packet:
    reassembler = Reassembler(frames[0].can_id, 0.1)
    found = [item for frame in frames for item in reassembler.feed(frame.data, 0.0)]
    (message,) = found
    assert isinstance(message, Message)
    packet = decode(message)
    assert isinstance(packet, Packet)
    return packet


def test_the_document_s_own_example_comes_to_613_packets() -> None:
    result = plan(load(SAMPLES / "bms.bin"), BMS, BITRATE_BPS)
    assert result.image.size_bytes == 78_351
    assert result.total_packets == 613
    # reset 2 frames, update command 3, end of transfer 2, each packet 18
    assert result.host_frames == 2 + 3 + 2 + 613 * 18
    # feedback 2, boot version 3, request transfer 2, complete 2, each ACK 2
    assert result.device_frames == 2 + 3 + 2 + 2 + 613 * 2
    assert result.frames == result.host_frames + result.device_frames
    # reset, update command, end of transfer, and the packets
    assert result.host_messages == 3 + 613
    assert sum(result.packet_bits) / BITRATE_BPS < result.transfer_wire_s < result.wire_s
    # the same messages in bytes: 16 + 22 + 12, 14 + 20 + 13 + 13, and 144 + 13 a packet
    assert result.bytes_on_wire == 50 + 60 + 613 * 157
    # 18 full frames of at least 111 and at most 135 bits, and 2 frames of ACK
    assert 613 * 18 * 111 / BITRATE_BPS < result.wire_s < 613 * 20 * 135 / BITRATE_BPS


@each("size, packets", [(1, 1), (127, 1), (128, 1), (129, 2), (256, 2), (257, 3)])
def test_every_128_bytes_begun_are_a_packet(size: int, packets: int) -> None:
    assert made(size).total_packets == packets


def test_the_first_frames_of_a_packet_are_those_of_the_document() -> None:
    image = Image.from_bytes(bytes(range(200)) + bytes(78_151))
    frames = plan(image, BMS, BITRATE_BPS).packet_frames(1)
    assert len(frames) == 18
    assert {frame.can_id for frame in frames} == {0x752}
    assert frames[0].data == bytes.fromhex("55 AA 16 87 A3 85 01 01")
    assert frames[1].data == bytes.fromhex("00 65 02 00 01 02 03 04")
    assert frames[17].data[-1:] == b"\xf0"


def test_a_packet_number_is_little_endian() -> None:
    frames = made(128 * 300).packet_frames(258)
    assert frames[0].data[6:] + frames[1].data[:1] == bytes.fromhex("01 02 01")


@each("target", TARGETS.values())
def test_the_packets_hold_the_image_and_the_last_is_filled_up_with_ff(target: Target) -> None:
    result = made(300, target)
    packets = [received(result.packet_frames(number)) for number in (1, 2, 3)]
    assert b"".join(packet.payload for packet in packets) == result.image.data + b"\xff" * 84
    assert [(packet.number, packet.total) for packet in packets] == [(1, 3), (2, 3), (3, 3)]
    assert {frame.can_id for frame in result.packet_frames(1)} == {target.request_id}


def test_a_packet_s_seconds_are_those_of_its_frames() -> None:
    result = made(128 * 1024 + 700)  # more than one chunk of the calculation
    for number in (1, 2, 1023, 1024, 1025, result.total_packets):
        bits = sum(map(frame_bits, result.packet_frames(number)))
        assert result.packet_wire_s(number) == bits / BITRATE_BPS


@each(
    "target, update, name",
    [(WMC, b"WMC_UPD", b"WMC"), (BMS, b"BMS_UPD", b"BMS"), (OBC, b"OBC_UPD", b"PBU")],
)
def test_the_seconds_of_the_upgrade_are_those_of_every_frame_in_both_directions(
    target: Target, update: bytes, name: bytes
) -> None:
    result = made(1000, target)
    ask, answer = target.request_id, target.answer_id
    messages = [
        Message(ask, 0x16, 0x4205, b"RESET"),
        Message(answer, 0x0C, 0x5503, b"ACK"),
        Message(answer, 0x0C, 0xC109, name + b"V1.0.0"),
        Message(ask, 0x16, 0xA10B, update + b"\xe8\x03\x00\x00"),
        Message(answer, 0x0C, 0xC402, b"\0\0"),
        *(Message(answer, 0x0C, 0xC202, bytes((number, 0))) for number in range(1, 9)),
        Message(ask, 0x16, 0xA401, b"\x04"),
        Message(answer, 0x0C, 0xC502, b"\0\0"),
    ]
    frames = [frame for message in messages for frame in split(message.can_id, encode(message))]
    for number in range(1, 9):
        frames += result.packet_frames(number)
    assert result.wire_s == sum(map(frame_bits, frames)) / BITRATE_BPS
    assert result.frames == len(frames)
    assert result.bytes_on_wire == sum(len(frame.data) for frame in frames)


def test_half_the_bit_rate_takes_twice_as_long() -> None:
    image = Image.from_bytes(bytes(500))
    assert plan(image, BMS, 125_000).wire_s == 2 * plan(image, BMS, 250_000).wire_s


def test_the_bytes_themselves_decide_about_the_time() -> None:
    """Long runs of equal bits are stuffed, so an erased image is slower than a mixed one."""
    mixed = plan(Image.from_bytes(b"\x55" * 12_800), BMS, BITRATE_BPS)
    erased = plan(Image.from_bytes(b"\xff" * 12_800), BMS, BITRATE_BPS)
    assert erased.wire_s > 1.05 * mixed.wire_s


@each("number", [0, -1, 4])
def test_there_are_no_other_packets_than_those(number: int) -> None:
    result = made(300)
    with pytest.raises(IndexError, match="of 3"):
        result.packet_frames(number)
    with pytest.raises(IndexError, match="of 3"):
        result.packet_wire_s(number)


def test_an_empty_and_a_too_large_image_are_refused() -> None:
    with pytest.raises(ImageError, match="empty"):
        plan(Image.from_bytes(b""), BMS, BITRATE_BPS)
    with pytest.raises(ImageError, match="65535 packets"):
        plan(Image.from_bytes(bytes(IMAGE_MAX_SIZE + 1)), BMS, BITRATE_BPS)


@pytest.mark.slow
def test_an_image_of_exactly_the_largest_size_is_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    # The bits of 65,535 packets take a second.
    monkeypatch.setattr("flasher.image.plan._packet_bits", lambda *_: array("H", [2_200]))
    result = plan(Image.from_bytes(bytes(IMAGE_MAX_SIZE)), BMS, BITRATE_BPS)
    assert result.total_packets == 65_535


@each("bitrate_bps", [0, -250_000])
def test_a_bit_rate_is_positive(bitrate_bps: int) -> None:
    with pytest.raises(UsageError, match="not a bit rate"):
        plan(Image.from_bytes(b"a"), BMS, bitrate_bps)


def test_plans_of_the_same_image_are_equal() -> None:
    assert made(300) == made(300)
    assert made(300) != made(300, OBC)


@each("total", [1, 2, 1024, 1025, 1026])
def test_each_packet_has_its_seconds_on_the_wire(total: int) -> None:
    result = made(total * 128)
    seconds = [result.packet_wire_s(number) for number in range(1, total + 1)]
    assert len(result.packet_bits) == total
    assert min(seconds) > 18 * 47 / BITRATE_BPS


def test_one_bit_a_second_is_a_bit_rate() -> None:
    assert plan(Image.from_bytes(b"\1"), BMS, 1).wire_s > 1000


def test_a_plan_by_names_takes_the_bit_rate_of_the_dialect_unless_one_is_given() -> None:
    image = Image.from_bytes(bytes(200))
    assert make_plan(image, "bms") == plan(image, BMS, 250_000)
    assert make_plan(image, "pbu", "welling", bitrate_bps=500_000) == plan(image, OBC, 500_000)
    assert make_plan(image, WMC, MOTINOVA, has_upgrade=True).bitrate_bps == 125_000
    for has_upgrade in (None, False):
        with pytest.raises(UsageError, match="dialect has no upgrade"):
            make_plan(image, "bms", MOTINOVA, has_upgrade=has_upgrade)
    with pytest.raises(UsageError, match="profile says that the device has no upgrade"):
        make_plan(image, "bms", "welling", has_upgrade=False)
