"""What a received message means to the device: one `Event` a message, and nothing changed yet.

Where the profile decides whether a message changes the state, it is decided here; where it decides
what is answered only, the action does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

from flasher.mock.profile import DeviceProfile
from flasher.mock.table import Event, State
from flasher.protocol import messages
from flasher.protocol.spec import (
    COMMAND_SIZE,
    HEADER,
    LENGTH_SIZE,
    MODE_SIZE,
    PREFIX_SIZE,
    Command,
    Mode,
    Target,
    data_size,
    packet_count,
)
from flasher.protocol.wire import Damage

_PACKET_HEAD: Final = b"".join(
    (
        HEADER,
        Mode.WRITE.to_bytes(MODE_SIZE, "big"),
        (COMMAND_SIZE + data_size(Command.PACKET)).to_bytes(LENGTH_SIZE, "big"),
        Command.PACKET.to_bytes(COMMAND_SIZE, "big"),
    )
)
_NUMBER_AT: Final = PREFIX_SIZE + COMMAND_SIZE + 1
"""Where the packet number lies: behind the start byte."""
_NUMBER_END: Final = _NUMBER_AT + 2
_AFTER_END: Final = frozenset((State.CHECKING, State.STARTING, State.REFUSED))
_WAITS_FOR_UPDATE: Final = frozenset((State.ANNOUNCING, State.REFUSED))
_DURING_END: Final = frozenset((State.CHECKING, State.STARTING))


@dataclass
class Transfer:
    """An image on its way in: its size, and how many of its packets are stored."""

    size_bytes: int
    stored: int = 0

    @property
    def total(self) -> int:
        return packet_count(self.size_bytes)

    @property
    def wanted(self) -> int:
        """Number of the packet that is next; of the last one when all are stored."""
        return min(self.stored + 1, self.total)

    @property
    def is_whole(self) -> bool:
        return self.stored == self.total


class Situation(NamedTuple):
    """What the meaning of a message depends on."""

    target: Target
    profile: DeviceProfile
    state: State
    transfer: Transfer


def classify(row: object, situation: Situation) -> Event:
    """The event that a decoded message is. An image's own checksum is not looked at here."""
    state = situation.state
    match row:
        case messages.Reset():
            return _classify_reset(situation)
        case messages.Unknown():
            return Event.QUERY
        case messages.UpdateCommand() if row.text == situation.target.update_text:
            return _classify_update(row, situation)
        case messages.Packet():
            return _classify_packet(row, situation)
        case messages.EndOfTransfer():
            return _classify_end(situation)
        case messages.Malformed() if state is State.APPLICATION:
            return _classify_malformed(row)
        case messages.UpdateCommand() if state is State.APPLICATION:
            return Event.UPGRADE_IN_APPLICATION
        case messages.Malformed() if row.message.command == Command.PACKET:
            return Event.PACKET_BAD if state is State.TRANSFER else Event.OUT_OF_TURN
    return Event.NO_CONCERN


def is_damaged_packet(damage: Damage) -> bool:
    """True when damaged bytes begin as a packet does, so that a NAK is due (TX-01)."""
    return damage.data.startswith(_PACKET_HEAD)


def named_number(received: bytes) -> int | None:
    """The packet number in the bytes of a packet, damaged or not; None when they end before it."""
    raw = received[_NUMBER_AT:_NUMBER_END]
    return int.from_bytes(raw, "little") if len(raw) == _NUMBER_END - _NUMBER_AT else None


def _classify_malformed(row: messages.Malformed) -> Event:
    """To an application it is a write like others, which may be confirmed (2.2.1(2), R17)."""
    is_write = row.message.mode == Mode.WRITE
    is_upgrade = row.message.command in (Command.UPDATE, Command.PACKET, Command.END_OF_TRANSFER)
    return Event.UPGRADE_IN_APPLICATION if is_write and is_upgrade else Event.QUERY


def _classify_reset(situation: Situation) -> Event:
    profile, state = situation.profile, situation.state
    if state is State.APPLICATION:
        return Event.RESET
    choice = profile.reset_in_bootloader if state is State.ANNOUNCING else profile.reset_in_transfer
    return Event.RESET if choice == "restarts" else Event.RESET_IGNORED


def _classify_update(row: messages.UpdateCommand, situation: Situation) -> Event:
    profile, state, transfer = situation.profile, situation.state, situation.transfer
    if state is State.APPLICATION:
        return Event.UPGRADE_IN_APPLICATION
    if not 0 < row.size_bytes <= profile.image_limit_bytes or state in _DURING_END:
        return Event.UPDATE_REFUSED
    if state in _WAITS_FOR_UPDATE:
        return Event.UPDATE
    # One transfer, however often the host says it before packet 1 (UP-05).
    if (
        state is not State.PROGRAMMING
        and not transfer.stored
        and row.size_bytes == transfer.size_bytes
    ):
        return Event.UPDATE_AGAIN
    return Event.UPDATE if profile.update_in_transfer == "starts_over" else Event.UPDATE_REFUSED


def _classify_packet(row: messages.Packet, situation: Situation) -> Event:
    transfer = situation.transfer
    if situation.state is State.APPLICATION:
        return Event.UPGRADE_IN_APPLICATION
    if situation.state is not State.TRANSFER:
        return Event.OUT_OF_TURN
    if row.total != transfer.total or row.number > row.total:
        return Event.PACKET_BAD
    if row.number == transfer.stored + 1:
        return Event.PACKET_NEXT
    if row.number == transfer.stored:
        return Event.PACKET_REPEATED
    return Event.PACKET_OLDER if row.number < transfer.stored else Event.PACKET_BAD


def _classify_end(situation: Situation) -> Event:
    transfer = situation.transfer
    if situation.state is State.APPLICATION:
        return Event.UPGRADE_IN_APPLICATION
    if situation.state in _AFTER_END:
        return Event.END_AGAIN
    if situation.state is not State.TRANSFER:
        return Event.OUT_OF_TURN
    return Event.END_WHOLE if transfer.is_whole else Event.END_EARLY
