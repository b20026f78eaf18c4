"""The upgrade's messages as CAN payloads, typed from the documents' tables.

Nothing here comes from flasher: literals where the documents leave nothing open, and a
transcription of appendix 1 for those that hold a number or image bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple


class Frame(NamedTuple):
    """A CAN frame, field by field what a simulated bus looks at."""

    can_id: int
    data: bytes
    is_extended: bool = False
    is_remote: bool = False
    is_error: bool = False

    @property
    def is_payload(self) -> bool:
        """True for a standard data frame with bytes."""
        return bool(self.data) and not any(self[2:])


@dataclass(frozen=True)
class Wording:
    """One target's messages. Payloads are hex, a CAN frame each, parted by spaces."""

    to_device: int
    to_tool: int
    reset: str
    feedback: str
    boot_version: str
    """Name and V1.2.3."""
    update_text: bytes
    update_78351: str
    update_128: str
    request: str
    ack_1: str
    nak_1: str
    end: str
    complete: str


WORDINGS: Final = {
    "wmc": Wording(
        to_device=0x751,
        to_tool=0x715,
        reset="55AA160742055245 5345545FA4A5ABF0",
        feedback="55AA0C0555034143 4B7CECB1D9F0",
        boot_version="55AA0C0BC109574D 4356312E322E336C 4DD358F0",
        update_text=b"WMC_UPD",
        update_78351="55AA160DA10B574D 435F5550440F3201 007B315327F0",
        update_128="55AA160DA10B574D 435F555044800000 0092324155F0",
        request="55AA0C04C4020000 01EA2F13F0",
        ack_1="55AA0C04C2020100 32BC87EEF0",
        nak_1="55AA0C04C3020100 DA18D1EBF0",
        end="55AA1603A4010466 36C0FBF0",
        complete="55AA0C04C5020000 E94E7916F0",
    ),
    "bms": Wording(
        to_device=0x752,
        to_tool=0x725,
        reset="55AA160742055245 534554A41DA484F0",
        feedback="55AA0C0555034143 4BB209FC46F0",
        boot_version="55AA0C0BC109424D 5356312E322E33E6 57D854F0",
        update_text=b"BMS_UPD",
        update_78351="55AA160DA10B424D 535F5550440F3201 00327275D1F0",
        update_128="55AA160DA10B424D 535F555044800000 00DB7167A3F0",
        request="55AA0C04C4020000 337142F8F0",
        ack_1="55AA0C04C2020100 0027EA05F0",
        nak_1="55AA0C04C3020100 E883BC00F0",
        end="55AA1603A401042C 3D8A98F0",
        complete="55AA0C04C5020000 DBD514FDF0",
    ),
    "obc": Wording(
        to_device=0x753,
        to_tool=0x735,
        reset="55AA160742055245 534554F28AA461F0",
        feedback="55AA0C0555034143 4BF7AAC733F0",
        boot_version="55AA0C0BC1095042 5556312E322E3336 07F7E8F0",
        update_text=b"OBC_UPD",
        update_78351="55AA160DA10B4F42 435F5550440F3201 00838EEA16F0",
        update_128="55AA160DA10B4F42 435F555044800000 006A8DF864F0",
        request="55AA0C04C4020000 DEB892CCF0",
        ack_1="55AA0C04C2020100 EDEE3A31F0",
        nak_1="55AA0C04C3020100 054A6C34F0",
        end="55AA1603A40104E9 8447D4F0",
        complete="55AA0C04C5020000 361CC4C9F0",
    ),
}

READ: Final = 0x11
WRITE: Final = 0x16
REPORT: Final = 0x0C


def _table_entry(index: int) -> int:
    register = index << 24
    for _ in range(8):
        register = (register << 1) ^ (0x104C11DB7 if register & 0x80000000 else 0)
    return register


_TABLE: Final = [_table_entry(index) for index in range(256)]


@lru_cache(maxsize=16384)  # the same images are sent again and again
def crc(data: bytes) -> int:
    """Appendix 1: a byte into the low end of the register, then four table steps."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(4):
            register = (register << 8 & 0xFFFFFFFF) ^ _TABLE[register >> 24]
    return register


def build(can_id: int, mode: int, command: int, data: bytes) -> bytes:
    """A message, header to tail."""
    body = struct.pack(">BBH", mode, 2 + len(data), command) + data
    covered = b"\x55\xaa" + struct.pack(">H", can_id) + body
    return b"\x55\xaa" + body + struct.pack(">I", crc(covered)) + b"\xf0"


def payloads(wire: bytes) -> list[bytes]:
    """A message's CAN payloads: eight bytes each and a rest."""
    return [wire[start : start + 8] for start in range(0, len(wire), 8)]


def literal(text: str) -> list[bytes]:
    """The CAN payloads of a literal above."""
    return [bytes.fromhex(payload) for payload in text.split()]


def numbered(can_id: int, command: int, number: int) -> list[bytes]:
    """An ACK (C202) or NAK (C302) for a packet."""
    return payloads(build(can_id, REPORT, command, struct.pack("<H", number)))


def intact(can_id: int, wire: bytes) -> bool:
    """True when tail and CRC of a message are right."""
    covered = b"\x55\xaa" + struct.pack(">H", can_id) + wire[2:-5]
    return wire[-1:] == b"\xf0" and struct.pack(">I", crc(covered)) == wire[-5:-1]
