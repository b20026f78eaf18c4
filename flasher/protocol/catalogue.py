"""Message catalogue: sender, receiver, command and answer of each message of chapter 3.

CAN ids and content sizes follow from each row. The upgrade messages of appendix 3 are in
`messages`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

from flasher.protocol import contents
from flasher.protocol.fields import Content
from flasher.protocol.spec import (
    DIALECTS,
    MOTINOVA,
    WELLING,
    Command,
    Dialect,
    Mode,
    Node,
    can_id,
    data_size,
)
from flasher.protocol.wire import Message


@dataclass(frozen=True)
class Item:
    """Message definition: one row of the documents' message tables (tables 4 to 7)."""

    sender: Node
    receiver: Node | None
    """None means broadcast."""
    mode: Mode
    command: int
    content: type[Content]
    title: str
    answer_command: int | None = None
    """Command of the BMS's answer; None for reports."""
    dialects: tuple[Dialect, ...] = tuple(DIALECTS.values())
    manufacturer_only: bool = False
    """True for an optional write that only the manufacturer may use (table 7)."""

    @cached_property
    def can_id(self) -> int:
        return can_id(self.sender, self.receiver)

    @property
    def key(self) -> tuple[int, int]:
        """CAN id and command, which identify a message."""
        return self.can_id, self.command

    @property
    def name(self) -> str:
        """CAN id and command in hexadecimal, such as "752 3300"."""
        return f"{self.can_id:03X} {self.command:04X}"


_WELLING: Final = (WELLING,)
_MOTINOVA: Final = (MOTINOVA,)
_R, _W, _P = Mode.READ, Mode.WRITE, Mode.REPORT
_WMC, _BMS, _OBC, _HMI, _CDL = Node.WMC, Node.BMS, Node.OBC, Node.HMI, Node.CDL
_FEEDBACK: Final = Command.GENERAL_FEEDBACK
_VERSION: Final = Command.VERSION_INFORMATION
_ASK_VERSION: Final = Command.READ_VERSION

ITEMS: Final = (
    # 5.1, sent by the BMS.
    Item(_BMS, None, _P, 0x1010, contents.RunningInformation, "running information"),
    Item(_BMS, None, _P, 0x1120, contents.CellVoltages, "cell voltages"),
    Item(_BMS, None, _P, 0x1204, contents.Faults, "faults"),
    Item(_BMS, None, _P, 0x1308, contents.Shutdown, "SHUTDOWN"),
    Item(_BMS, None, _P, 0x1410, contents.DesignInformation, "design information"),
    Item(_BMS, None, _P, _VERSION, contents.VersionInformation, "version information"),
    Item(_BMS, None, _P, 0x160C, contents.PhysicalId, "physical id"),
    Item(_BMS, None, _P, 0x170C, contents.CheckCode, "check code"),
    Item(_BMS, _WMC, _P, 0x3005, contents.Ready, "handshake answered"),
    Item(_BMS, _CDL, _P, 0x5028, contents.History, "history"),
    Item(_BMS, _CDL, _P, 0x5120, contents.ProductionInformation, "production information"),
    Item(_BMS, _CDL, _P, 0x5210, contents.UserString, "user string 1"),
    Item(_BMS, _CDL, _P, 0x5310, contents.UserString, "user string 2"),
    Item(_BMS, _CDL, _P, 0x5410, contents.UserString, "user string 3"),
    Item(_BMS, _CDL, _P, _FEEDBACK, contents.GeneralFeedback, "general feedback"),
    Item(_BMS, _CDL, _P, 0x5688, contents.Memory, "memory"),
    # 5.2, sent by the others.
    Item(_WMC, None, _P, 0x1305, contents.Ready, "ready for shutdown"),
    Item(_WMC, None, _P, 0x1808, contents.Shutdown, "SHUTDOWN", dialects=_WELLING),
    Item(_WMC, _BMS, _R, 0x3009, contents.Handshake, "handshake", 0x3005),
    Item(_WMC, _BMS, _R, 0x3100, contents.Empty, "read physical id", 0x160C),
    Item(_WMC, _BMS, _R, 0x3200, contents.Empty, "read check code", 0x170C),
    Item(_WMC, _BMS, _R, 0x3300, contents.Empty, "read design information", 0x1410),
    Item(_OBC, None, _P, 0x1405, contents.Ready, "ready for shutdown"),
    Item(_OBC, _BMS, _R, 0x5000, contents.Empty, "read running information", 0x1010),
    Item(_OBC, _BMS, _R, 0x5100, contents.Empty, "read version information", _VERSION),
    Item(_OBC, _BMS, _R, 0x5200, contents.Empty, "read design information", 0x1410),
    Item(_OBC, _BMS, _R, 0x5300, contents.Empty, "read cell voltages", 0x1120),
    Item(_HMI, None, _P, 0x1305, contents.Ready, "ready for shutdown", dialects=_MOTINOVA),
    Item(_HMI, _BMS, _R, 0x5000, contents.Empty, "read version information", _VERSION, _MOTINOVA),
    Item(_HMI, _BMS, _R, 0x5100, contents.Empty, "read design information", 0x1410, _MOTINOVA),
    Item(_HMI, _BMS, _R, 0x5200, contents.Empty, "read cell voltages", 0x1120, _MOTINOVA),
    Item(_CDL, _BMS, _R, 0x3000, contents.Empty, "read physical id", 0x160C),
    Item(_CDL, _BMS, _R, 0x3100, contents.Empty, "read check code", 0x170C),
    Item(_CDL, _BMS, _W, 0x320C, contents.CheckCode, "write check code", _FEEDBACK),
    Item(_CDL, _BMS, _R, _ASK_VERSION, contents.Empty, "read version information", _VERSION),
    Item(_CDL, _BMS, _R, 0x3400, contents.Empty, "read running information", 0x1010),
    Item(_CDL, _BMS, _R, 0x3500, contents.Empty, "read cell voltages", 0x1120),
    Item(_CDL, _BMS, _R, 0x3600, contents.Empty, "read design information", 0x1410),
    Item(_CDL, _BMS, _R, 0x3700, contents.Empty, "read production information", 0x5120),
    Item(_CDL, _BMS, _R, 0x3800, contents.Empty, "read history", 0x5028),
    Item(_CDL, _BMS, _R, 0x3900, contents.Empty, "read user string 1", 0x5210),
    Item(_CDL, _BMS, _W, 0x3A10, contents.UserString, "write user string 1", _FEEDBACK),
    Item(_CDL, _BMS, _R, 0x3B00, contents.Empty, "read user string 2", 0x5310),
    Item(_CDL, _BMS, _W, 0x3C10, contents.UserString, "write user string 2", _FEEDBACK),
    Item(_CDL, _BMS, _R, 0x3D00, contents.Empty, "read user string 3", 0x5410),
    Item(_CDL, _BMS, _W, 0x3E10, contents.UserString, "write user string 3", _FEEDBACK),
    Item(
        _CDL, _BMS, _W, 0x3F20, contents.ProductionInformation, "write production information",
        _FEEDBACK, manufacturer_only=True,
    ),
    Item(
        _CDL, _BMS, _W, 0x4010, contents.Model, "write model",
        _FEEDBACK, manufacturer_only=True,
    ),
    Item(
        _CDL, _BMS, _W, 0x4110, contents.SerialNumber, "write serial number",
        _FEEDBACK, manufacturer_only=True,
    ),
    Item(_CDL, _BMS, _W, Command.RESET, contents.Reset, "reset", _FEEDBACK),
    Item(_CDL, _BMS, _R, 0x4308, contents.ReadMemory, "read memory", 0x5688),
)  # fmt: skip

UPGRADE_COMMANDS: Final = frozenset(Command) - {item.command for item in ITEMS}
"""Commands of the upgrade messages (appendix 3)."""
BY_KEY: Final = {item.key: item for item in ITEMS}


def answer_of(item: Item) -> Item | None:
    """Return the catalogue row of the answer to a query or write; None for reports."""
    if item.answer_command is None:
        return None
    for receiver in (None, item.sender):
        answer = BY_KEY.get((can_id(_BMS, receiver), item.answer_command))
        if answer is not None:
            return answer
    raise LookupError(f"{item.name} has no answering row")


@dataclass(frozen=True)
class Decoded:
    """Decoded application message with its catalogue row."""

    item: Item
    content: Content


def decode(message: Message, dialect: Dialect | None = None) -> Decoded | None:
    """Decode an application message (chapter 3). Return None if the dialect, or either one if None,
    has no message with its CAN id, mode and command. Never raises.
    """
    item = BY_KEY.get((message.can_id, message.command))
    if item is None or item.mode != message.mode:
        return None
    if dialect is not None and dialect not in item.dialects:
        return None
    if len(message.data) != data_size(item.command):
        return None
    return Decoded(item, item.content.from_data(message.data))


def has_message(dialect: Dialect, message: Message) -> bool:
    """Return False for a documented message that this dialect lacks: one of the other dialect, or
    an upgrade message in a dialect without upgrade.
    """
    item = BY_KEY.get((message.can_id, message.command))
    if item is not None:
        return dialect in item.dialects
    return dialect.has_upgrade or message.command not in UPGRADE_COMMANDS


def encode(item: Item, content: Content) -> Message:
    """Encode an application message (chapter 3). Raises ValueError for the content type of another
    message and for a value that does not fit its field.
    """
    if type(content) is not item.content:
        wrong = type(content).__name__
        raise ValueError(f"{item.title} ({item.name}) carries {item.content.__name__}, not {wrong}")
    return Message(item.can_id, item.mode, item.command, content.data())
