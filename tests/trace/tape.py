"""Traces written message by message, with times, in the words of the documents: what `explain` has
to understand. Nothing here is made by flasher but the frames that hold it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import can

from flasher.protocol.frame import Frame
from tests.peers.wording import REPORT, WORDINGS, WRITE, build, payloads

FRAME_S: Final = 0.0005
START_S: Final = 1_700_000_000.0
TEXTS: Final = {"wmc": b"WMC", "bms": b"BMS", "obc": b"PBU"}


class Tape:
    """A trace that grows. Every message returns the tape; every frame takes half a millisecond."""

    def __init__(self, target: str = "bms") -> None:
        self.target = target
        self.now = START_S
        self.frames: list[tuple[float, Frame]] = []
        self._words = WORDINGS[target]

    def __iter__(self) -> Iterator[tuple[float, Frame]]:
        return iter(self.frames)

    # -- anything ------------------------------------------------------------------------------

    def wait(self, seconds: float) -> Tape:
        self.now += seconds
        return self

    def frame(self, frame: Frame) -> Tape:
        self.now += FRAME_S
        self.frames.append((self.now, frame))
        return self

    def wire(self, can_id: int, wire: bytes) -> Tape:
        for payload in payloads(wire):
            self.frame(Frame(can_id, payload))
        return self

    def message(self, can_id: int, mode: int, command: int, data: bytes) -> Tape:
        return self.wire(can_id, build(can_id, mode, command, data))

    def error(self, times: int = 1) -> Tape:
        for _ in range(times):
            self.frame(Frame(0, b"", is_error=True))
        return self

    # -- the tool ------------------------------------------------------------------------------

    def tool(self, command: int, data: bytes, mode: int = WRITE) -> Tape:
        return self.message(self._words.to_device, mode, command, data)

    def reset(self, times: int = 1) -> Tape:
        self.tool(0x4205, b"RESET")
        for _ in range(times - 1):
            self.wait(0.2).tool(0x4205, b"RESET")
        return self

    def update(self, size_bytes: int = 1277) -> Tape:
        return self.tool(0xA10B, self._words.update_text + struct.pack("<I", size_bytes))

    def packet_wire(self, number: int, total: int, payload: bytes) -> bytes:
        data = b"\x01" + struct.pack("<HH", number, total) + payload.ljust(128, b"\xff")
        return build(self._words.to_device, WRITE, 0xA385, data)

    def packet(self, number: int, total: int = 10, payload: bytes = b"") -> Tape:
        return self.wire(self._words.to_device, self.packet_wire(number, total, payload))

    def damaged_packet(self, number: int, total: int = 10) -> Tape:
        wire = bytearray(self.packet_wire(number, total, b""))
        wire[-2] ^= 1
        return self.wire(self._words.to_device, bytes(wire))

    def end(self) -> Tape:
        return self.tool(0xA401, b"\x04")

    # -- the device ----------------------------------------------------------------------------

    def device(self, command: int, data: bytes) -> Tape:
        return self.message(self._words.to_tool, REPORT, command, data)

    def feedback(self) -> Tape:
        return self.device(0x5503, b"ACK")

    def boot(self, version: bytes = b"V1.2.3", name: bytes | None = None) -> Tape:
        return self.device(0xC109, (name or TEXTS[self.target]) + version)

    def request(self) -> Tape:
        return self.device(0xC402, bytes(2))

    def ack(self, number: int) -> Tape:
        return self.device(0xC202, struct.pack("<H", number))

    def nak(self, number: int) -> Tape:
        return self.device(0xC302, struct.pack("<H", number))

    def complete(self) -> Tape:
        return self.device(0xC502, bytes(2))

    def version(self, firmware: bytes, serial: bytes = b"W2605001") -> Tape:
        texts = (b"BM36", serial, b"V1r2r0_20220512", firmware)
        fields = b"".join((text + b".").ljust(16) for text in texts)
        return self.message(0x720, REPORT, 0x1540, fields)

    def shutdown(self) -> Tape:
        return self.message(0x720, REPORT, 0x1308, b"SHUTDOWN")

    # -- whole stretches -----------------------------------------------------------------------

    def to_boot(self) -> Tape:
        return self.reset().feedback().wait(0.03).boot()

    def to_request(self) -> Tape:
        return self.to_boot().update().wait(0.02).request()

    def packets(self, first: int, last: int, total: int = 10) -> Tape:
        for number in range(first, last + 1):
            self.packet(number, total).wait(0.001).ack(number)
        return self

    def to_packet(self, number: int, total: int = 10) -> Tape:
        """Up to the ACK of the packet before this one."""
        return self.to_request().packets(1, number - 1, total)

    def to_end(self, total: int = 10) -> Tape:
        return self.to_packet(total + 1, total).end()

    # -- files ---------------------------------------------------------------------------------

    def save(self, path: Path) -> Path:
        """Written by python-can; the suffix chooses the format."""
        with can.Logger(path) as writer:
            for at, frame in self.frames:
                writer(
                    can.Message(
                        timestamp=at,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=frame.is_extended,
                        is_remote_frame=frame.is_remote,
                        is_error_frame=frame.is_error,
                        channel=0,
                    )
                )
        return path
