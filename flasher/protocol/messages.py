"""Typed messages of the upgrade (appendix 3).

Each class is one row of the document; `to_message` encodes it for a CAN id, `decode` is the
inverse. Decoding is strict: mode, size and every constant byte must match the document. Mismatches
are returned as `Malformed`, unlisted commands as `Unknown`.
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
    """Number of a packet, or total of packets: 1 or more."""

    size_bytes: int = 2


@dataclass(frozen=True)
class UpdateText(LatinField):
    """Text that names a target."""

    KNOWN: ClassVar[frozenset[str]] = frozenset(each.update_text for each in TARGETS.values())


@dataclass(frozen=True)
class Malformed:
    """Message with a known command whose mode or data break the document."""

    message: Message
    problem: str


@dataclass(frozen=True)
class Unknown:
    """Intact message with a command outside the upgrade."""

    message: Message


@dataclass(frozen=True)
class _UpgradeMessage:
    """Base of the upgrade messages."""

    MODE: ClassVar[Mode]
    COMMAND: ClassVar[Command]
    LAYOUT: ClassVar[tuple[tuple[str, Codec], ...]]
    """Name and codec of every field, in wire order."""

    _STRUCT: ClassVar[Struct]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if hasattr(cls, "LAYOUT"):
            cls._STRUCT = Struct("<" + "".join(_struct_format(codec) for _, codec in cls.LAYOUT))
        if hasattr(cls, "COMMAND"):
            assert cls._STRUCT.size == data_size(cls.COMMAND)

    def data(self) -> bytes:
        raise NotImplementedError

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        """Decode `data` of the command's size. Raises ValueError with the problem."""
        raise NotImplementedError

    def to_message(self, can_id: int) -> Message:
        return Message(can_id, self.MODE, self.COMMAND, self.data())


def _struct_format(codec: Codec) -> str:
    if isinstance(codec, NumberField):
        return {1: "B", 2: "H", 4: "I"}[codec.size_bytes]
    return f"{codec.size_bytes}s"


@dataclass(frozen=True)
class _Constant(_UpgradeMessage):
    """Message with constant data."""

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
    """Message with one packet number (little-endian, R4)."""

    LAYOUT = (("number", NumberField(2)),)

    number: int

    def data(self) -> bytes:
        return self._STRUCT.pack(self.number)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        return cls(*cls._STRUCT.unpack(data))


@dataclass(frozen=True)
class ResetCommand(_Constant):
    """Tool to application: restart into the bootloader."""

    MODE = Mode.WRITE
    COMMAND = Command.RESET
    DATA = b"RESET"


@dataclass(frozen=True)
class GeneralFeedbackMessage(_Constant):
    """Application to tool: the write was received."""

    MODE = Mode.REPORT
    COMMAND = Command.GENERAL_FEEDBACK
    DATA = b"ACK"


@dataclass(frozen=True)
class BootVersion(_UpgradeMessage):
    """Bootloader to tool: its name and version, kept as received, well formed or not (SE-02)."""

    MODE = Mode.REPORT
    COMMAND = Command.BOOT_VERSION
    LAYOUT = (("name", LatinField(3)), ("version", LatinField(6)))

    name: str
    version: str

    @property
    def is_version(self) -> bool:
        """True when the version has the form Vx.x.x."""
        return boot_version_number(self.version) is not None

    def data(self) -> bytes:
        return b"".join(codec.encode(getattr(self, name)) for name, codec in self.LAYOUT)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        parts = zip(cls.LAYOUT, cls._STRUCT.unpack(data), strict=True)
        return cls(*(codec.decode(raw) for (_, codec), raw in parts))


@dataclass(frozen=True)
class UpdateCommand(_UpgradeMessage):
    """Tool to bootloader: prepare for an image of `size_bytes`; the text names the target."""

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
    """Bootloader to tool: ready for packet 1."""

    MODE = Mode.REPORT
    COMMAND = Command.REQUEST_TRANSFER
    DATA = b"\x00\x00"


@dataclass(frozen=True)
class Packet(_UpgradeMessage):
    """Tool to bootloader: packet `number` of `total`, 128 bytes of the image."""

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
    """Bootloader to tool: packet received."""

    MODE = Mode.REPORT
    COMMAND = Command.ACK


@dataclass(frozen=True)
class Nak(_Numbered):
    """Bootloader to tool: packet not received; after the end of transfer: image refused (R6)."""

    MODE = Mode.REPORT
    COMMAND = Command.NAK


@dataclass(frozen=True)
class EndOfTransfer(_Constant):
    """Tool to bootloader: that was the last packet."""

    MODE = Mode.WRITE
    COMMAND = Command.END_OF_TRANSFER
    DATA = bytes((END_OF_TRANSFER_MARK,))


@dataclass(frozen=True)
class Complete(_Constant):
    """Bootloader to tool: the image is whole."""

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
"""All upgrade messages by command."""


def decode(message: Message) -> UpgradeMessage | Malformed | Unknown:
    """Decode an intact message. Never raises."""
    row = UPGRADE_MESSAGES.get(message.command)
    if row is None:
        return Unknown(message)
    if message.mode != row.MODE:
        return Malformed(message, f"mode is {message.mode:02X}, not {row.MODE:02X}")
    try:
        return row.from_data(message.data)
    except ValueError as error:
        return Malformed(message, str(error))
