"""Messages that a device has to reject or ignore, by the names of the steps of a walk."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

from flasher.conformance.wire import (
    END,
    PACKET,
    PACKET_BYTES,
    READ,
    REPORT,
    UPDATE,
    WRITE,
    Encoder,
    RawFrame,
    build,
    crc,
    is_intact,
    joined,
    packet_count,
    packet_payload,
    split,
)

_OTHER_MODE: Final = 0x17
_UNKNOWN: Final = 0x6F01
_LONG_UNKNOWN: Final = 0x6F60
_SPOILT_FRAME: Final = 5
_LOAD_FRAMES: Final = 150
_FLOOD_MESSAGES: Final = 60
_SMALL_BYTES: Final = 3 * PACKET_BYTES


@dataclass(frozen=True)
class TransferPosition:
    """A position in a transfer, which need not be running: the image and the next packet."""

    encoder: Encoder
    image: bytes
    wanted: int
    largest_bytes: int
    """Largest image that the device accepts."""

    @property
    def total(self) -> int:
        return packet_count(len(self.image))

    def packet(self, number: int, *, total: int | None = None, start: int = 1) -> bytes:
        """A packet of the image; a number outside the image carries the data of the next packet."""
        inside = number if 1 <= number <= self.total else self.wanted
        payload = packet_payload(self.image, inside)
        total = self.total if total is None else total
        return joined(self.encoder.packet(number, total, payload, start=start))

    @property
    def next_packet(self) -> bytes:
        return self.packet(self.wanted)


class Stimulus(NamedTuple):
    """Frames to send; an intact write may be answered by general feedback (R15)."""

    frames: list[RawFrame]
    is_intact_write: bool


Maker = Callable[[TransferPosition], bytes | list[RawFrame]]
"""Makes bytes, which are sent in frames of 8, or frames."""


# -- packets ---------------------------------------------------------------------------------------


def _with_crc(crc_bytes: Callable[[bytes], bytes]) -> Maker:
    """The next packet with the CRC that `crc_bytes` computes from the bytes before it."""
    return lambda place: (
        place.next_packet[:-5] + crc_bytes(place.next_packet[2:-5]) + place.next_packet[-1:]
    )


def _with_frames(change: Callable[[list[RawFrame]], list[RawFrame]]) -> Maker:
    """The next packet with changed frames."""
    return lambda place: change(place.encoder.frames(place.next_packet))


def _exchanged(frames: list[RawFrame]) -> list[RawFrame]:
    """Exchange two frames, or drop one of them when they are equal."""
    at = _SPOILT_FRAME
    exchanged = [] if frames[at] == frames[at + 1] else [frames[at + 1], frames[at]]
    return [*frames[:at], *exchanged, *frames[at + 2 :]]


def _in_mode(mode: int) -> Maker:
    return lambda place: place.encoder.message(mode, PACKET, place.next_packet[6:-5])


def _crc_mirrored(raw: bytes) -> bytes:
    return raw[:-5] + raw[-5:-1][::-1] + raw[-1:]


PACKETS: Final[dict[str, Maker]] = {
    "packet-crc": _with_crc(lambda _: b"\x12\x34\x56\x78"),
    "packet-crc-zero": _with_crc(lambda _: bytes(4)),
    "packet-crc-ones": _with_crc(lambda _: b"\xff" * 4),
    "packet-crc-no-id": _with_crc(lambda body: crc(b"\x55\xaa" + body).to_bytes(4, "big")),
    "packet-crc-little": lambda place: _crc_mirrored(place.next_packet),
    "packet-tail": lambda place: place.next_packet[:-1] + b"\xf1",
    "packet-read": _in_mode(READ),
    "packet-report": _in_mode(REPORT),
    "packet-mode": _in_mode(_OTHER_MODE),
    "packet-skip": lambda place: place.packet(place.wanted + 1 + (place.wanted == place.total)),
    "packet-far": lambda place: place.packet(place.wanted + 256),
    "packet-zero": lambda place: place.packet(0),
    "packet-beyond": lambda place: place.packet(place.total + 1),
    "packet-total": lambda place: place.packet(place.wanted, total=place.total + 1),
    "packet-total-far": lambda place: place.packet(place.wanted, total=place.total + 256),
    "packet-start": lambda place: place.packet(place.wanted, start=0),
    "packet-lost": _with_frames(lambda all_: all_[:_SPOILT_FRAME] + all_[_SPOILT_FRAME + 1 :]),
    "packet-doubled": _with_frames(lambda all_: all_[:_SPOILT_FRAME] + all_[_SPOILT_FRAME - 1 :]),
    "packet-exchanged": _with_frames(_exchanged),
    "packet-half": _with_frames(lambda all_: all_[: len(all_) // 2]),
    # Length byte and data exceed the command's length by one.
    "packet-long": lambda place: build(
        place.encoder.to_device, WRITE, PACKET, place.next_packet[6:-5] + b"\xff"
    ),
}


# -- update commands, ends -------------------------------------------------------------------------


def _small_update(
    place: TransferPosition, *, mode: int = WRITE, text: bytes = b"", more: bytes = b""
) -> bytes:
    """An update command for a small image; with `more` data its length contradicts the command."""
    data = (text or place.encoder.update_text) + _SMALL_BYTES.to_bytes(4, "little") + more
    return build(place.encoder.to_device, mode, UPDATE, data)


def _update_other_targets(place: TransferPosition) -> list[RawFrame]:
    """Update command and packet 1 to the other targets."""
    packet = (1, packet_count(_SMALL_BYTES), bytes(PACKET_BYTES))
    return [
        frame
        for other in place.encoder.others()
        for frame in (*other.update(_SMALL_BYTES), *other.packet(*packet))
    ]


UPDATES: Final[dict[str, Maker]] = {
    "update-zero": lambda place: place.encoder.update(0),
    "update-huge": lambda place: place.encoder.update(0xFFFF_FFFF),
    "update-large": lambda place: place.encoder.update(place.largest_bytes + 1),
    "update-wraps": lambda place: place.encoder.update(
        (place.largest_bytes & ~0xFFFF) + 0x10000 + _SMALL_BYTES & 0xFFFF_FFFF
    ),
    "update-crc": lambda place: _small_update(place)[:-5] + bytes(4) + b"\xf0",
    "update-tail": lambda place: _small_update(place)[:-1] + b"\0",
    "update-name": lambda place: _small_update(place, text=place.encoder.others()[0].update_text),
    "update-name-end": lambda place: _small_update(
        place, text=place.encoder.update_text[:4] + b"XYZ"
    ),
    "update-long": lambda place: _small_update(place, more=b"\0"),
    "update-read": lambda place: _small_update(place, mode=READ),
    "update-others": _update_other_targets,
}
ENDS: Final[dict[str, Maker]] = {
    "end-mark": lambda place: place.encoder.message(WRITE, END, b"\x05"),
    "end-read": lambda place: place.encoder.message(READ, END, b"\x04"),
    "end-crc": lambda place: _crc_mirrored(joined(place.encoder.end())),
}

# -- no concern ------------------------------------------------------------------------------------


def _reset(mode: int, data: Callable[[Encoder], bytes]) -> Maker:
    return lambda place: place.encoder.message(
        mode, place.encoder.reset_command, data(place.encoder)
    )


def _resets_from_other_nodes(place: TransferPosition) -> list[RawFrame]:
    """Resets to this target sent by every other node."""
    encoder, digit = place.encoder, place.encoder.to_device & 0xF
    ids = [0x700 | sender << 4 | digit for sender in (1, 2, 3, 4) if sender != digit]
    reset = (WRITE, encoder.reset_command, encoder.reset_data)
    return [frame for can_id in ids for frame in split(can_id, build(can_id, *reset))]


def _junk(place: TransferPosition) -> list[RawFrame]:
    chance = random.Random(7)  # noqa: S311  the same at every replay
    data = [bytes((chance.randrange(0x60, 0xF0),)) + chance.randbytes(7) for _ in range(16)]
    return [RawFrame(place.encoder.to_device, each) for each in data]


NO_CONCERN: Final[dict[str, Maker]] = {
    "reset-read": _reset(READ, lambda encoder: encoder.reset_data),
    "reset-text": _reset(WRITE, lambda encoder: bytes(len(encoder.reset_data))),
    "reset-text-end": _reset(WRITE, lambda encoder: encoder.reset_data[:-1] + b"?"),
    "reset-nodes": _resets_from_other_nodes,
    "reset-others": lambda place: [
        frame for other in place.encoder.others() for frame in other.reset()
    ],
    "unknown": lambda place: place.encoder.message(WRITE, _UNKNOWN, b"\0"),
    "unknown-mode": lambda place: place.encoder.message(_OTHER_MODE, _UNKNOWN, b"\0"),
    "report": lambda place: place.encoder.message(REPORT, _UNKNOWN, b"\0"),
    "length-zero": lambda _: b"\x55\xaa\x16\x00\x12\x34\x56\x78\xf0",
    "length-long": lambda _: b"\x55\xaa\x16\xff\x77\xfd\x01\x02",
    "header-only": lambda _: b"\x55\xaa",
    "junk": _junk,
    "flood": lambda place: (
        _FLOOD_MESSAGES * place.encoder.message(READ, _LONG_UNKNOWN, bytes(_LONG_UNKNOWN & 0xFF))
    ),
    "own-id": lambda place: place.encoder.answer(_UNKNOWN, b"\0"),
    "load": lambda _: [RawFrame(0x7A0 + number % 5, bytes(8)) for number in range(_LOAD_FRAMES)],
}
REFUSED: Final = {**PACKETS, **UPDATES, **ENDS, **NO_CONCERN}


def make_stimulus(name: str, place: TransferPosition) -> Stimulus:
    """Build the message of the step `name`."""
    made = REFUSED[name](place)
    frames = place.encoder.frames(made) if isinstance(made, bytes) else made
    raw, can_id = joined(frames), place.encoder.to_device
    is_own = all(frame.can_id == can_id for frame in frames)
    return Stimulus(frames, is_own and is_intact(can_id, raw) and raw[2] == WRITE)
