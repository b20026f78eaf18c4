"""Traffic for the tests, typed from the document's tables; nothing here is made by flasher but the
frames that hold it.
"""

from __future__ import annotations

from flasher.protocol.frame import Frame
from tests.peers.wording import READ, REPORT, WORDINGS, build, literal, payloads

RUNNING_DATA = bytes.fromhex("A08C 18FC 2823 A028 41 50 01 62 00000000")
"""36000 mV, -1000 mA, 9000 mAh of 10400 mAh, 25 degrees, 80 %, charger connected, 98 % healthy."""


def frames(can_id: int, mode: int, command: int, data: bytes) -> list[Frame]:
    """The frames of one message."""
    return [Frame(can_id, payload) for payload in payloads(build(can_id, mode, command, data))]


def running(data: bytes = RUNNING_DATA) -> list[Frame]:
    """The BMS's running information."""
    return frames(0x720, REPORT, 0x1010, data)


def faults(flags: bytes) -> list[Frame]:
    """The BMS's faults."""
    return frames(0x720, REPORT, 0x1204, flags)


def handshake() -> list[Frame]:
    """The WMC asks for the BMS."""
    return frames(0x712, READ, 0x3009, b"HANDSHAKE")


def reset(target: str = "bms") -> list[Frame]:
    """The tool's reset, a literal with its CRC."""
    words = WORDINGS[target]
    return [Frame(words.to_device, payload) for payload in literal(words.reset)]


def nak(target: str = "bms") -> list[Frame]:
    """The bootloader's NAK 1, a literal with its CRC."""
    words = WORDINGS[target]
    return [Frame(words.to_tool, payload) for payload in literal(words.nak_1)]
