"""Upgrade plan: number of packets and CAN frames of an image, and their time on the bus.

Times are exact bit times of the actual frames with stuff bits, without idle time. Restart, erasing
and answer times of the device are not included.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from flasher.errors import UsageError
from flasher.image.image import Image
from flasher.image.segments import empty_error, too_large_error
from flasher.protocol.bittime import message_bits, stream_bits
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.spec import (
    FRAME_DATA_SIZE,
    FRAMES_PER_PACKET,
    IMAGE_MAX_SIZE,
    PACKET_DATA_SIZE,
    PACKET_FILLER,
    Dialect,
    Target,
    as_dialect,
    as_target,
    packet_count,
)
from flasher.protocol.wire import Message, encode, split

_FILLER: Final = bytes((PACKET_FILLER,))
_NOMINAL_BOOT_VERSION: Final = "V1.0.0"
"""Other versions differ by a few stuff bits."""
_CHUNK_PACKETS: Final = 1024
"""Packets encoded at once, as a compromise between speed and memory."""


@dataclass(frozen=True)
class Plan:
    """Traffic of an upgrade without errors: each message of tool and device once."""

    image: Image
    target: Target
    bitrate_bps: int
    total_packets: int
    host_frames: int
    """CAN frames sent by the tool: reset, update command, packets, end of transfer."""
    device_frames: int
    """CAN frames sent by the device: general feedback, one boot version, request transfer, an ACK
    for each packet, complete."""
    host_messages: int
    """Messages sent by the tool."""
    bytes_on_wire: int
    """Data bytes of all frames."""
    wire_s: float
    """Seconds of all frames on the bus, without idle time."""
    transfer_wire_s: float
    """Seconds of the packets and their ACKs on the bus."""
    packet_bits: array[int] = field(repr=False, compare=False)
    """Bit times of each packet, packet 1 first."""

    @property
    def frames(self) -> int:
        """CAN frames of both directions."""
        return self.host_frames + self.device_frames

    def packet_frames(self, number: int) -> list[Frame]:
        """CAN frames of packet `number`, from 1. Raises IndexError for any other."""
        return split(self.target.request_id, self._packet_wire(number))

    def packet_wire_s(self, number: int) -> float:
        """Seconds of packet `number`, from 1, on the bus. Raises IndexError for any other."""
        self._check(number)
        return self.packet_bits[number - 1] / self.bitrate_bps

    def _packet_wire(self, number: int) -> bytes:
        self._check(number)
        return _packet_wire(self.image.data, number, self.total_packets, self.target.request_id)

    def _check(self, number: int) -> None:
        if not 1 <= number <= self.total_packets:
            raise IndexError(f"there is no packet {number} of {self.total_packets}")


def make_plan(
    image: Image,
    target: str | Target,
    dialect: str | Dialect = "welling",
    *,
    bitrate_bps: int | None = None,
    has_upgrade: bool | None = None,
) -> Plan:
    """Plan an upgrade, at the dialect's bit rate unless another one is given.

    Raises UsageError for a dialect without upgrade, unless `has_upgrade` enables it, and for an
    unknown target or dialect; ImageError and UsageError like `plan`.
    """
    chosen = as_dialect(dialect)
    if chosen.has_upgrade and has_upgrade is False:
        raise UsageError(
            "The profile says that the device has no upgrade (has_upgrade).",
            remedy="Use the profile of the device that the image is for.",
        )
    if not (chosen.has_upgrade or has_upgrade):
        raise UsageError(
            f"The {chosen.name.upper()} dialect has no upgrade: its document cancelled it.",
            remedy="Use --dialect welling if the device speaks it; a profile can enable it.",
        )
    rate = chosen.bitrate_bps if bitrate_bps is None else bitrate_bps
    return plan(image, as_target(target), rate)


def plan(image: Image, target: Target, bitrate_bps: int) -> Plan:
    """Plan the upgrade of `target` with `image` at `bitrate_bps`.

    Raises ImageError for an empty image or one of more than 65535 packets (R9), UsageError for an
    invalid bit rate.
    """
    if bitrate_bps <= 0:
        raise UsageError(f"{bitrate_bps} bit/s is not a bit rate")
    if not image.size_bytes:
        raise empty_error(image.source)
    if image.size_bytes > IMAGE_MAX_SIZE:
        raise too_large_error(image.source, image.size_bytes)
    total = packet_count(image.size_bytes)
    packet_bits = _packet_bits(image.data, total, target.request_id)
    acks = _Traffic()
    acks.add(Ack(number).to_message(target.answer_id) for number in range(1, total + 1))
    host = _Traffic()
    host.add(
        row.to_message(target.request_id)
        for row in (
            ResetCommand(),
            UpdateCommand(target.update_text, image.size_bytes),
            EndOfTransfer(),
        )
    )
    device = _Traffic()
    device.add(
        row.to_message(target.answer_id)
        for row in (
            GeneralFeedbackMessage(),
            BootVersion(target.boot_name, _NOMINAL_BOOT_VERSION),
            RequestTransfer(),
            Complete(),
        )
    )
    transfer_bits = sum(packet_bits) + acks.bits
    packet_frames = total * FRAMES_PER_PACKET
    packet_bytes = packet_frames * FRAME_DATA_SIZE
    return Plan(
        image=image,
        target=target,
        bitrate_bps=bitrate_bps,
        total_packets=total,
        host_frames=host.frames + packet_frames,
        device_frames=device.frames + acks.frames,
        host_messages=host.messages + total,
        bytes_on_wire=packet_bytes + host.size_bytes + device.size_bytes + acks.size_bytes,
        wire_s=(transfer_bits + host.bits + device.bits) / bitrate_bps,
        transfer_wire_s=transfer_bits / bitrate_bps,
        packet_bits=packet_bits,
    )


class _Traffic:
    """Sums of messages, CAN frames, bytes and bit times."""

    def __init__(self) -> None:
        self.messages = 0
        self.frames = 0
        self.size_bytes = 0
        self.bits = 0

    def add(self, messages: Iterable[Message]) -> None:
        for message in messages:
            wire = encode(message)
            frames = split(message.can_id, wire)
            self.messages += 1
            self.frames += len(frames)
            self.size_bytes += len(wire)
            self.bits += message_bits(frames)


def _packet_wire(data: bytes, number: int, total: int, can_id: int) -> bytes:
    """Encode packet `number`; the last one is padded with FF (R9)."""
    end = number * PACKET_DATA_SIZE
    payload = data[end - PACKET_DATA_SIZE : end].ljust(PACKET_DATA_SIZE, _FILLER)
    return encode(Packet(number, total, payload).to_message(can_id))


def _packet_bits(data: bytes, total: int, can_id: int) -> array[int]:
    """Bit times of each packet. A packet is 18 full frames, so that packets form one stream."""
    bits = array("H")
    for first in range(1, total + 1, _CHUNK_PACKETS):
        numbers = range(first, min(first + _CHUNK_PACKETS, total + 1))
        stream = b"".join(_packet_wire(data, number, total, can_id) for number in numbers)
        frame_bits = stream_bits(can_id, stream)
        bits.extend(
            sum(frame_bits[at : at + FRAMES_PER_PACKET])
            for at in range(0, len(frame_bits), FRAMES_PER_PACKET)
        )
    return bits
