"""Bytes and frames of the cases about framing, most of them no message or not quite one."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probing import stream
from flasher.conformance.wire import (
    END,
    END_MARK,
    PACKET,
    PACKET_BYTES,
    QUERY_VERSION,
    READ,
    WRITE,
    RawFrame,
    build,
    crc,
)

UNKNOWN: Final = 0x77FD
"""A command that nobody has, with as many bytes as a message can hold."""
_FRAME_BYTES: Final = 8
_HEADER: Final = b"\x55\xaa"


def split_by_chance(bench: Bench, raw: bytes) -> Iterator[RawFrame]:
    """The bytes in frames of 1 to 8 bytes, by the seed."""
    at = 0
    while at < len(raw):
        size = bench.random.randint(1, _FRAME_BYTES)
        yield RawFrame(bench.encoder.to_device, raw[at : at + size])
        at += size


def pad(frames: list[RawFrame], filler: int) -> list[RawFrame]:
    """The frames, the last one filled up to 8 bytes."""
    last = frames[-1]
    return [*frames[:-1], last._replace(data=last.data.ljust(_FRAME_BYTES, bytes((filler,))))]


def treacherous_payloads(bench: Bench) -> Iterator[tuple[str, bytes]]:
    """Data that looks like the beginning or the end of messages, whatever the frame boundaries."""
    words, to_device = bench.encoder, bench.encoder.to_device
    yield "55 AA all over", _HEADER * (PACKET_BYTES // 2)
    yield "55 AA all over, odd", (b"\x00" + _HEADER * PACKET_BYTES)[:PACKET_BYTES]
    yield "F0 all over", b"\xf0" * PACKET_BYTES
    yield "F0, then 55 AA", b"\xf0\x55\xaa\xf0" * (PACKET_BYTES // 4)
    whole = {
        "end of transfer": stream(words.end()),
        "update command": stream(words.update(PACKET_BYTES)),
        "reset": stream(words.reset()),
        "head of a packet": build(to_device, WRITE, PACKET, bytes(5 + PACKET_BYTES))[:16],
        "head of the longest message": b"\x55\xaa\x16\xff\x77\xfd",
    }
    # Data begins at byte 11 of a packet: the sixth byte of it is the first one of a frame.
    for name, raw in whole.items():
        for offset in (5, 3):
            where = "at a frame's start" if offset == 5 else "across frames"
            block = bytes(offset) + raw.ljust(24, b"\x00")
            yield f"{name} {where}", block.ljust(64, b"\x00") + block.ljust(64, b"\xf0")


def messages_broken_off(bench: Bench) -> Iterator[tuple[str, bytes]]:
    """Messages, by name, that end before their length is used up."""
    words = bench.encoder
    packet = stream(words.packet(1, 1, bytes(range(PACKET_BYTES))))
    query = build(words.to_device, READ, QUERY_VERSION)
    yield "length 255, two bytes follow", b"\x55\xaa\x16\xff\x77\xfd\x01\x02"
    yield "packet cut off behind frame 1", packet[:8]
    yield "packet cut off behind frame 9", packet[:72]
    yield "packet cut off behind frame 17", packet[:136]
    yield "update command cut off behind frame 1", stream(words.update(PACKET_BYTES))[:8]
    longer = bytes((READ, 3, QUERY_VERSION >> 8, 1))
    yield "length greater by one", _HEADER + longer + query[-5:]


def wrong_lengths(bench: Bench, packet: bytes) -> list[tuple[str, bytes]]:
    """Messages whose length is wrong and whose CRC is right; `packet` is the next one."""
    data = packet[6:-5]
    end = struct.pack(">H", END) + END_MARK
    rows = (
        ("length 0", 0, b""),
        ("length 0, a packet follows", 0, struct.pack(">H", PACKET) + data),
        ("length 0, end of transfer follows", 0, end),
        ("length 1", 1, b"\xa4"),
        ("length 1, a packet follows", 1, struct.pack(">H", PACKET) + data),
        ("packet, length less by one", len(data) + 1, struct.pack(">H", PACKET) + data),
        ("packet, length greater by one", len(data) + 3, struct.pack(">H", PACKET) + data),
        ("packet with a byte more", len(data) + 3, struct.pack(">H", PACKET) + data + b"\xff"),
        ("packet with a byte less", len(data) + 1, struct.pack(">H", PACKET) + data[:-1]),
        ("end of transfer with a byte more", 4, end + b"\x00"),
        ("packet of 253 bytes", 255, struct.pack(">H", PACKET) + data.ljust(253, b"\xff")),
        ("255 with an unknown command", 255, struct.pack(">H", UNKNOWN) + bytes(253)),
        ("255, unknown, with other bytes", 255, struct.pack(">H", UNKNOWN) + data.ljust(253)),
    )
    return [(name, _sealed(bench, length, rest)) for name, length, rest in rows]


def _sealed(bench: Bench, length: int, rest: bytes) -> bytes:
    """A message of any length field, with the CRC over all that is there."""
    body = bytes((WRITE, length)) + rest
    covered = _HEADER + struct.pack(">H", bench.encoder.to_device) + body
    return _HEADER + body + struct.pack(">I", crc(covered)) + b"\xf0"


def strangers(to_device: int) -> Iterator[tuple[str, RawFrame]]:
    """Frames with the device's id that carry no payload, by name."""
    yield "a frame of 0 bytes", RawFrame(to_device, b"")
    yield "a remote frame", RawFrame(to_device, b"", is_remote=True)
    yield "an extended frame", RawFrame(to_device, b"\x12" * 8, is_extended=True)
    yield "an extended frame with a header", RawFrame(to_device, _HEADER, is_extended=True)
    yield (
        "an extended frame of the same first 11 bits",
        RawFrame(to_device << 18, b"\x12" * 8, is_extended=True),
    )
    yield "an error frame", RawFrame(to_device, bytes(8), is_error=True)
