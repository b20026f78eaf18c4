"""The messages that the tool sends in an upgrade, and how long the answer to each is waited for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from flasher.host.options import UpgradeOptions
from flasher.host.situation import Situation
from flasher.host.table import State
from flasher.image.plan import Plan
from flasher.protocol import catalogue
from flasher.protocol.frame import Frame
from flasher.protocol.messages import EndOfTransfer, Row, UpdateCommand
from flasher.protocol.spec import Command, Mode
from flasher.protocol.wire import Message, encode, split


class Outgoing(NamedTuple):
    """One message, ready to be sent."""

    frames: Sequence[Frame]
    command: Command
    """By it the message is known again when it has left."""
    wire_s: float | None = None
    """Its time on the wire, where it is known already."""


class OutgoingMessages:
    """Makes the messages of one plan."""

    def __init__(self, plan: Plan, options: UpgradeOptions) -> None:
        self._plan = plan
        self._options = options
        self._request_id = plan.target.request_id

    def reset(self) -> Outgoing:
        """What makes the application restart into the bootloader; a product may have its own."""
        options = self._options
        reset = Message(self._request_id, Mode.WRITE, options.reset_command, options.reset_data)
        return Outgoing(split(self._request_id, encode(reset)), Command.RESET)

    def update(self) -> Outgoing:
        """The update command with the size of the image."""
        return self._from_row(
            UpdateCommand(self._plan.target.update_text, self._plan.image.size_bytes)
        )

    def packet(self, number: int) -> Outgoing:
        """The packet of that number, 1-based."""
        wire_s = self._plan.packet_wire_s(number)
        return Outgoing(self._plan.packet_frames(number), Command.PACKET, wire_s)

    def end(self) -> Outgoing:
        """End of transfer."""
        return self._from_row(EndOfTransfer())

    def version_query(self) -> Outgoing:
        """The question for the new application's version. Raises RuntimeError for a target that
        has none.
        """
        request = self._options.version_request_for(self._plan.target)
        if request is None:
            raise RuntimeError("the table asks for a version that nobody can be asked for")
        query = catalogue.encode(request.item, request.content)
        return Outgoing(split(query.can_id, encode(query)), Command.READ_VERSION)

    def _from_row(self, row: Row) -> Outgoing:
        frames = split(self._request_id, encode(row.to_message(self._request_id)))
        return Outgoing(frames, row.COMMAND)


def answer_wait_s(command: object, at: Situation, options: UpgradeOptions) -> float | None:
    """How long, in seconds, the state waits for an answer to the message with `command` that has
    just left; None when the message belongs to an earlier state.
    """
    timings = options.timings
    match command, at.state:
        case (Command.RESET, State.RESETTING) | (Command.READ_VERSION, State.CONFIRMING):
            return timings.command_repeat_s
        case Command.RESET, State.AWAITING_BOOT:
            return options.boot_timeout_s
        case Command.UPDATE, State.AWAITING_REQUEST:
            return timings.request_transfer_timeout_s
        case Command.PACKET, State.TRANSFERRING:
            return timings.ack_timeout_s
        case Command.PACKET, State.SETTLING:
            return timings.quiet_after_repeat_s
        case Command.END_OF_TRANSFER, State.ENDING if at.announced_at is None:
            return timings.complete_timeout_s
        case _:
            return None
