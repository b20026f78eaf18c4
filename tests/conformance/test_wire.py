"""The suite's own framing, compared with independently computed messages."""

from __future__ import annotations

from flasher.conformance import wire
from flasher.conformance.wire import (
    DeviceDecoder,
    Encoder,
    RawFrame,
    Received,
    Reply,
    build,
    describe,
    split,
)
from tests.loops import each

BMS = Encoder("bms")


def listen(payloads: str, can_id: int = 0x725, gap_s: float = 0.001) -> list[Received]:
    """Decode frames given in hexadecimal."""
    listener = DeviceDecoder(BMS)
    return [
        reply
        for index, payload in enumerate(payloads.split())
        for reply in listener.feed(RawFrame(can_id, bytes.fromhex(payload)), index * gap_s)
    ]


def reported(frames: list[RawFrame]) -> str:
    return " ".join(frame.data.hex().upper() for frame in frames)


def test_the_crc_is_that_of_the_documents_example() -> None:
    assert wire.message_crc(0x712, bytes.fromhex("1103220100")) == bytes.fromhex("01295122")


@each(
    "target, reset, update, end",
    [
        (
            "wmc",
            "55AA160742055245 5345545FA4A5ABF0",
            "55AA160DA10B574D 435F5550440F3201 007B315327F0",
            "55AA1603A4010466 36C0FBF0",
        ),
        (
            "bms",
            "55AA160742055245 534554A41DA484F0",
            "55AA160DA10B424D 535F5550440F3201 00327275D1F0",
            "55AA1603A401042C 3D8A98F0",
        ),
        (
            "obc",
            "55AA160742055245 534554F28AA461F0",
            "55AA160DA10B4F42 435F5550440F3201 00838EEA16F0",
            "55AA1603A40104E9 8447D4F0",
        ),
    ],
)
def test_what_the_tool_sends_is_byte_exact(target: str, reset: str, update: str, end: str) -> None:
    words = Encoder(target)
    assert reported(words.reset()) == reset
    assert reported(words.update(78351)) == update
    assert reported(words.end()) == end


def test_a_packet_is_18_whole_frames() -> None:
    frames = BMS.packet(0x102, 0x304, bytes(128))
    assert [len(frame.data) for frame in frames] == [8] * 18
    assert frames[0].data == bytes.fromhex("55AA1687A3850102")
    assert frames[1].data[:3] == bytes.fromhex("010403")


@each(
    "payloads, kind, shown",
    [
        ("55AA0C0555034143 4BB209FC46F0", Reply.FEEDBACK, "general feedback"),
        (
            "55AA0C0BC109424D 5356312E322E33E6 57D854F0",
            Reply.BOOT_VERSION,
            "boot version 'BMSV1.2.3'",
        ),
        ("55AA0C04C4020000 337142F8F0", Reply.REQUEST, "request transfer"),
        ("55AA0C04C2020100 0027EA05F0", Reply.ACK, "ACK 1"),
        ("55AA0C04C3020100 E883BC00F0", Reply.NAK, "NAK 1"),
        ("55AA0C04C5020000 DBD514FDF0", Reply.COMPLETE, "complete"),
    ],
)
def test_what_the_device_sends_is_named(payloads: str, kind: Reply, shown: str) -> None:
    (heard,) = listen(payloads)
    assert heard.kind is kind
    assert str(heard) == shown
    assert (heard.first_at, heard.at) == (0.0, 0.001 * payloads.count(" "))


@each(
    "payloads",
    [
        "55AA0C04C2020100 0027EA05F1",  # tail
        "55AA0C04C2020100 0027EA04F0",  # CRC
        "11AA0C04C2020100",  # no header
    ],
)
def test_what_is_damaged_is_called_damaged(payloads: str) -> None:
    assert [reply.kind for reply in listen(payloads)] == [Reply.DAMAGED]


def test_a_message_that_stops_midway_is_damaged_once_another_begins() -> None:
    whole = "55AA0C04C2020100 0027EA05F0"
    replies = listen(f"55AA0C04C2020100 {whole}", gap_s=0.2)
    assert [one.kind for one in replies] == [
        Reply.DAMAGED,
        Reply.DAMAGED,
        Reply.DAMAGED,
    ]
    listener = DeviceDecoder(BMS)
    frames = split(0x725, bytes.fromhex(whole.replace(" ", "")))
    times = [(frames[0], 0.0), (frames[0], 0.2), (frames[1], 0.201)]
    found = [one for frame, at in times for one in listener.feed(frame, at)]
    assert [one.kind for one in found] == [Reply.DAMAGED, Reply.ACK]


@each(
    "can_id, command, kinds",
    [
        (0x720, wire.ACK, [Reply.OTHER]),  # a wrong id of the same sender
        (0x720, 0x1402, [Reply.APPLICATION]),
        (0x715, wire.ACK, []),  # another sender
        (0x725, 0x1402, [Reply.OTHER]),
    ],
)
def test_what_counts_depends_on_the_id(can_id: int, command: int, kinds: list[Reply]) -> None:
    message = split(can_id, build(can_id, wire.REPORT, command, b"\1\0"))
    assert [reply.kind for reply in listen(reported(message), can_id=can_id)] == kinds


def test_an_answer_with_other_data_is_another_message() -> None:
    request = split(0x725, build(0x725, wire.REPORT, wire.REQUEST, b"\0\1"))
    assert [reply.kind for reply in listen(reported(request))] == [Reply.OTHER]


def test_frames_that_are_no_payload_are_nothing() -> None:
    listener = DeviceDecoder(BMS)
    for frame in (
        RawFrame(0x725, b""),
        RawFrame(0x725, b"\x55\xaa", is_extended=True),
        RawFrame(0x725, b"\x55\xaa", is_remote=True),
        RawFrame(0x725, b"\x55\xaa", is_error=True),
    ):
        assert list(listener.feed(frame, 0.0)) == []


def test_many_messages_are_described_in_a_line() -> None:
    (ack,) = listen("55AA0C04C2020100 0027EA05F0")
    assert describe([ack] * 3) == "ACK 1 (3 times)"
    assert describe([]) == "nothing"


def test_an_image_that_names_two_versions_names_none() -> None:
    assert wire.version_in(b"..V1r0r4_20220512..") == "V1r0r4_20220512"
    assert wire.version_in(b"V1r0r4_20220512 V1r0r5_20220512") is None


def test_a_message_is_intact_where_length_command_crc_and_tail_fit() -> None:
    right = wire.build(0x752, wire.WRITE, 0x6F03, b"abc")
    assert wire.is_intact(0x752, right)
    longer = wire.build(0x752, wire.WRITE, 0x6F02, b"abc")
    others = (b"", right[:-1], right + b"\0", right[:-1] + b"\xf1", longer, right + right)
    damaged = bytes((*right[:7], right[7] ^ 1, *right[8:]))
    assert not any(wire.is_intact(0x752, raw) for raw in (*others, damaged))
    assert not wire.is_intact(0x751, right)
