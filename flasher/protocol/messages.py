"""Upgrade messages: reset, update command, packets, ACK, NAK, completion (appendix 3).

`to_message` encodes for a CAN id, `decode` is the inverse. Decoding is strict: mode, size and every
constant byte must match the document. Mismatches are returned as `Malformed`, other commands as
`Unknown`.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import ClassVar, Final, Self

from flasher.protocol.fields import BytesField, Codec, ConstantField, LatinField, NumberField
from flasher.protocol.spec import (
    END_OF_TRANSFER_MARK,
    PACKET_DATA_SIZE,
    PACKET_START,
    TARGETS,
    Command,
    Mode,
    data_size,
)
from flasher.protocol.text import boot_version_number
from flasher.protocol.wire import Message


@dataclass(frozen=True)
class PacketNumber(NumberField):
    """Packet number or number of packets, at least 1."""

    size_bytes: int = 2


@dataclass(frozen=True)
class UpdateText(LatinField):
    """Text of the update command: `WMC_UPD`, `BMS_UPD` or `OBC_UPD` for the target (table 8)."""

    KNOWN: ClassVar[frozenset[str]] = frozenset(each.update_text for each in TARGETS.values())


@dataclass(frozen=True)
class Malformed:
    """Message with an upgrade command, but another mode or other data than documented."""

    message: Message
    problem: str


@dataclass(frozen=True)
class Unknown:
    """Intact message whose command is not of the upgrade."""

    message: Message


@dataclass(frozen=True)
class _UpgradeMessage:
    """Base of the upgrade messages."""

    MODE: ClassVar[Mode]
    COMMAND: ClassVar[Command]
    LAYOUT: ClassVar[tuple[tuple[str, Codec], ...]]
    """Name and codec of each field, in wire order."""

    _STRUCT: ClassVar[Struct]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if hasattr(cls, "LAYOUT"):
            cls._STRUCT = Struct("<" + "".join(_struct_format(codec) for _, codec in cls.LAYOUT))
        if hasattr(cls, "COMMAND"):
            assert cls._STRUCT.size == data_size(cls.COMMAND)

    def data(self) -> bytes:
        return self._STRUCT.pack(*vars(self).values())

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        """Decode message data. Raises ValueError for data that differ from the document."""
        return cls(*cls._STRUCT.unpack(data))

    def to_message(self, can_id: int) -> Message:
        return Message(can_id, self.MODE, self.COMMAND, self.data())


def _struct_format(codec: Codec) -> str:
    if isinstance(codec, NumberField):
        return {1: "B", 2: "H", 4: "I"}[codec.size_bytes]
    return f"{codec.size_bytes}s"


@dataclass(frozen=True)
class _Constant(_UpgradeMessage):
    """Base of messages with constant data."""

    DATA: ClassVar[bytes]

    def __init_subclass__(cls) -> None:
        cls.LAYOUT = (("data", ConstantField(cls.DATA)),)
        super().__init_subclass__()

    def data(self) -> bytes:
        return self.DATA

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        if data != cls.DATA:
            raise ValueError(f"data are {data.hex(' ')}, not {cls.DATA.hex(' ')}")
        return cls()


@dataclass(frozen=True)
class _Numbered(_UpgradeMessage):
    """Base of messages with one packet number (little-endian, R4)."""

    LAYOUT = (("number", NumberField(2)),)

    number: int


@dataclass(frozen=True)
class ResetCommand(_Constant):
    """Tool to application: restart into the bootloader (chapter 3)."""

    MODE = Mode.WRITE
    COMMAND = Command.RESET
    DATA = b"RESET"


@dataclass(frozen=True)
class GeneralFeedbackMessage(_Constant):
    """Application to tool: acknowledges a write (chapter 3)."""

    MODE = Mode.REPORT
    COMMAND = Command.GENERAL_FEEDBACK
    DATA = b"ACK"


@dataclass(frozen=True)
class BootVersion(_UpgradeMessage):
    """Bootloader to tool: its name and version after a restart, well formed or not (table 9)."""

    MODE = Mode.REPORT
    COMMAND = Command.BOOT_VERSION
    LAYOUT = (("name", LatinField(3)), ("version", LatinField(6)))

    name: str
    version: str

    @property
    def is_version(self) -> bool:
        """True for a version of the form Vx.x.x."""
        return boot_version_number(self.version) is not None

    def data(self) -> bytes:
        return b"".join(codec.encode(getattr(self, name)) for name, codec in self.LAYOUT)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        parts = zip(cls.LAYOUT, cls._STRUCT.unpack(data), strict=True)
        return cls(*(codec.decode(raw) for (_, codec), raw in parts))


@dataclass(frozen=True)
class UpdateCommand(_UpgradeMessage):
    """Tool to bootloader: start an upgrade with `size_bytes`; `text` names the target (table 8)."""

    MODE = Mode.WRITE
    COMMAND = Command.UPDATE
    LAYOUT = (("text", UpdateText(7)), ("size_bytes", NumberField(4, "B")))

    text: str
    size_bytes: int

    def data(self) -> bytes:
        return self._STRUCT.pack(self.text.encode("ascii"), self.size_bytes)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        raw, size_bytes = cls._STRUCT.unpack(data)
        text = raw.decode("latin-1")
        if text not in UpdateText.KNOWN:
            raise ValueError(f"no target has the update text {text!a}")
        return cls(text, size_bytes)


@dataclass(frozen=True)
class RequestTransfer(_Constant):
    """Bootloader to tool: flash is erased, send packet 1 (table 9)."""

    MODE = Mode.REPORT
    COMMAND = Command.REQUEST_TRANSFER
    DATA = b"\x00\x00"


@dataclass(frozen=True)
class Packet(_UpgradeMessage):
    """Tool to bootloader: packet `number` of `total`, 128 bytes of the image (table 8)."""

    MODE = Mode.WRITE
    COMMAND = Command.PACKET
    LAYOUT = (
        ("start", ConstantField(bytes((PACKET_START,)))),
        ("number", PacketNumber()),
        ("total", PacketNumber()),
        ("payload", BytesField(PACKET_DATA_SIZE)),
    )

    number: int
    total: int
    payload: bytes

    def data(self) -> bytes:
        return self._STRUCT.pack(bytes((PACKET_START,)), self.number, self.total, self.payload)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        start, number, total, payload = cls._STRUCT.unpack(data)
        if start[0] != PACKET_START:
            raise ValueError(f"a packet starts with {PACKET_START:02X}, not {start[0]:02X}")
        if not number or not total:
            raise ValueError(f"packet {number} of {total}: numbers start at 1")
        return cls(number, total, payload)


@dataclass(frozen=True)
class Ack(_Numbered):
    """Bootloader to tool: packet `number` was received (table 9)."""

    MODE = Mode.REPORT
    COMMAND = Command.ACK


@dataclass(frozen=True)
class Nak(_Numbered):
    """Bootloader to tool: packet not received; after end of transfer: image refused (R6)."""

    MODE = Mode.REPORT
    COMMAND = Command.NAK


@dataclass(frozen=True)
class EndOfTransfer(_Constant):
    """Tool to bootloader: all packets were sent (table 8)."""

    MODE = Mode.WRITE
    COMMAND = Command.END_OF_TRANSFER
    DATA = bytes((END_OF_TRANSFER_MARK,))


@dataclass(frozen=True)
class Complete(_Constant):
    """Bootloader to tool: the image passed the integrity check (table 9)."""

    MODE = Mode.REPORT
    COMMAND = Command.COMPLETE
    DATA = b"\x00\x00"


UpgradeMessage = (
    ResetCommand
    | GeneralFeedbackMessage
    | BootVersion
    | UpdateCommand
    | RequestTransfer
    | Packet
    | Ack
    | Nak
    | EndOfTransfer
    | Complete
)

UPGRADE_MESSAGES: Final[dict[int, type[UpgradeMessage]]] = {
    row.COMMAND: row
    for row in (
        ResetCommand,
        GeneralFeedbackMessage,
        BootVersion,
        UpdateCommand,
        RequestTransfer,
        Packet,
        Ack,
        Nak,
        EndOfTransfer,
        Complete,
    )
}
"""Upgrade message classes by command."""


def decode(message: Message) -> UpgradeMessage | Malformed | Unknown:
    """Decode an upgrade message. Never raises."""
    row = UPGRADE_MESSAGES.get(message.command)
    if row is None:
        return Unknown(message)
    if message.mode != row.MODE:
        return Malformed(message, f"mode is {message.mode:02X}, not {row.MODE:02X}")
    try:
        return row.from_data(message.data)
    except ValueError as error:
        return Malformed(message, str(error))
