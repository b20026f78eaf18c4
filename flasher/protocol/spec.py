"""Protocol constants: nodes, CAN ids, commands, framing, upgrade targets and dialects.

Sources: Welling protocol (BMS) V1.0.0 and MOTINOVA protocol (BMS) V2.7.1, chapters 1 to 3 and
appendix 3. Timings are in `timing`, message layouts in `messages` and `contents`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, IntEnum
from functools import cached_property
from typing import Final

from flasher.errors import UsageError

# -- framing (2.2.1) ---------------------------------------------------------------------------

HEADER: Final = b"\x55\xaa"
TAIL: Final = b"\xf0"
MODE_SIZE: Final = 1
LENGTH_SIZE: Final = 1
COMMAND_SIZE: Final = 2
CRC_SIZE: Final = 4
LENGTH_MIN: Final = COMMAND_SIZE
LENGTH_MAX: Final = 0xFF
PREFIX_SIZE: Final = len(HEADER) + MODE_SIZE + LENGTH_SIZE
"""Number of bytes of a message before its command."""
OVERHEAD_SIZE: Final = PREFIX_SIZE + CRC_SIZE + len(TAIL)
"""Number of bytes of a message that its length field does not count."""
MESSAGE_MAX_SIZE: Final = OVERHEAD_SIZE + LENGTH_MAX
FRAME_DATA_SIZE: Final = 8
"""Data bytes of each CAN frame of a message; the last may be shorter (2.2.3)."""


class Mode(IntEnum):
    """Mode byte of a message (2.2.1)."""

    READ = 0x11
    WRITE = 0x16
    REPORT = 0x0C


# -- nodes and ids (1, 2.2.2) -------------------------------------------------------------------


class Node(Enum):
    """Node on the bus; the value is its digit in CAN ids (2.2.2)."""

    WMC = 1
    BMS = 2
    OBC = 3
    HMI = 4
    CDL = 5


BROADCAST_DIGIT: Final = 0
_ID_BASE: Final = 0x700


def can_id(sender: Node, receiver: Node | None) -> int:
    """CAN id of messages from `sender` to `receiver`; None means broadcast (2.2.2)."""
    receiver_digit = BROADCAST_DIGIT if receiver is None else receiver.value
    return _ID_BASE | sender.value << 4 | receiver_digit


# -- commands (chapter 3, appendix 3) -----------------------------------------------------------


class Command(IntEnum):
    """Command numbers as sent: serial number, then size of the data (2.2.1)."""

    RESET = 0x4205
    GENERAL_FEEDBACK = 0x5503
    BOOT_VERSION = 0xC109
    UPDATE = 0xA10B
    REQUEST_TRANSFER = 0xC402
    PACKET = 0xA385
    ACK = 0xC202
    NAK = 0xC302
    END_OF_TRANSFER = 0xA401
    COMPLETE = 0xC502
    READ_VERSION = 0x3300
    VERSION_INFORMATION = 0x1540


def data_size(command: int) -> int:
    """Size in bytes of a command's data, which is its second byte (2.2.1)."""
    return command & 0xFF


# -- upgrade (appendix 3) -----------------------------------------------------------------------

PACKET_START: Final = 0x01
"""SOH, the first data byte of a packet (table 8)."""
END_OF_TRANSFER_MARK: Final = 0x04
"""EOT, the data byte of end of transfer (table 8)."""
PACKET_DATA_SIZE: Final = 128
PACKET_FILLER: Final = 0xFF
PACKET_COUNT_MAX: Final = 0xFFFF
IMAGE_MAX_SIZE: Final = PACKET_COUNT_MAX * PACKET_DATA_SIZE
"""Largest image in bytes (R9)."""
BOOT_VERSION_BURST: Final = 4
"""Number of boot versions that a bootloader sends after a restart (figure 2)."""
FRAMES_PER_PACKET: Final = (
    OVERHEAD_SIZE + COMMAND_SIZE + data_size(Command.PACKET)
) // FRAME_DATA_SIZE


def packet_count(size_bytes: int) -> int:
    """Number of packets of an image of `size_bytes`; the last one is padded (R9)."""
    return -(-size_bytes // PACKET_DATA_SIZE)


# -- application data that the upgrade needs ------------------------------------------------------

TEXT_END: Final = b"."
TEXT_FILLER: Final = b" "
VERSION_FIELD_SIZE: Final = 16


# -- targets and dialects -------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """Device with an upgradable bootloader, and its names in messages (tables 8, 9)."""

    node: Node
    update_text: str
    boot_name: str
    has_version_query: bool
    """True if the documents have a version query for it: the BMS only (table 7)."""

    @property
    def name(self) -> str:
        return self.node.name.lower()

    @cached_property
    def request_id(self) -> int:
        """CAN id of the tool's messages to this device."""
        return can_id(Node.CDL, self.node)

    @cached_property
    def answer_id(self) -> int:
        """CAN id of this device's messages to the tool."""
        return can_id(self.node, Node.CDL)

    @property
    def broadcast_id(self) -> int:
        """CAN id of this device's broadcasts (2.2.2)."""
        return can_id(self.node, None)


WMC: Final = Target(Node.WMC, "WMC_UPD", "WMC", has_version_query=False)
BMS: Final = Target(Node.BMS, "BMS_UPD", "BMS", has_version_query=True)
OBC: Final = Target(Node.OBC, "OBC_UPD", "PBU", has_version_query=False)

TARGETS: Final = {target.name: target for target in (WMC, BMS, OBC)}
TARGET_ALIASES: Final = {"mc": WMC, "pbu": OBC}
"""Other names of the same devices in the documents."""


def find_target(name: str) -> Target | None:
    """Find a target by name or alias, ignoring case; None if unknown."""
    lower = name.lower()
    return TARGETS.get(lower) or TARGET_ALIASES.get(lower)


def as_target(target: str | Target) -> Target:
    """Return the target of this name or alias. Raises UsageError."""
    found = target if isinstance(target, Target) else find_target(target)
    if found is None:
        raise UsageError(f"There is no target {target!r}; targets are {', '.join(TARGETS)}.")
    return found


@dataclass(frozen=True)
class Dialect:
    """Protocol dialect: one of the two documents, with its bit rate and nodes."""

    name: str
    version: str
    bitrate_bps: int
    nodes: tuple[Node, ...]
    has_upgrade: bool


WELLING: Final = Dialect(
    name="welling",
    version="V1.0.0",
    bitrate_bps=250_000,
    nodes=(Node.WMC, Node.BMS, Node.OBC, Node.CDL),
    has_upgrade=True,
)
MOTINOVA: Final = Dialect(
    name="motinova",
    version="V2.7.1",
    bitrate_bps=125_000,
    nodes=(Node.WMC, Node.BMS, Node.OBC, Node.HMI, Node.CDL),
    has_upgrade=False,
)
DIALECTS: Final = {dialect.name: dialect for dialect in (WELLING, MOTINOVA)}


def as_dialect(dialect: str | Dialect) -> Dialect:
    """Return the dialect of this name. Raises UsageError."""
    found = dialect if isinstance(dialect, Dialect) else DIALECTS.get(dialect.lower())
    if found is None:
        raise UsageError(f"There is no dialect {dialect!r}; dialects are {', '.join(DIALECTS)}.")
    return found
