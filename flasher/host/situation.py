"""Where an upgrade stands: the facts on which the classification, the timers and the outcome rest.

One attempt has one situation; a new attempt takes over what outlives it. The machine notes in it
what it does, the classification what the answers say.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.events import Phase
from flasher.host.outcome import DeviceLeft
from flasher.host.table import State
from flasher.protocol.engine import Transmitter
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import Command

_NEVER: Final = float("-inf")
_PHASES: Final = {
    State.RESETTING: Phase.RESET,
    State.AWAITING_BOOT: Phase.BOOT,
    State.AWAITING_REQUEST: Phase.UPDATE,
    State.TRANSFERRING: Phase.TRANSFER,
    State.SETTLING: Phase.TRANSFER,
    State.ENDING: Phase.END,
    State.CONFIRMING: Phase.CONFIRM,
}
"""Phases that people are told, by state; the other states leave the phase as it is."""


@dataclass
class Situation:
    """Where one attempt stands; all times in seconds on the engine's clock."""

    tx: Transmitter
    state: State = State.RESETTING
    state_since: float = 0.0
    phase: Phase = Phase.RESET
    attempt: int = 1

    heard_at: float = _NEVER
    """When the device was heard last, or could not be heard as the adapter was away."""
    feedback_came: bool = False
    """The reset was answered: an application runs."""
    silence_was_answered: bool = False
    """An update command was sent into the silence of a device, in any attempt (R26)."""
    boot: BootVersion | None = None
    """The first boot version of the attempt."""
    last_boot: BootVersion | None = None
    """The same, of this or an earlier attempt."""
    update_left_at: float = _NEVER
    """When the last update command left, of this or an earlier attempt."""
    first_update_left_at: float | None = None
    request_at: float = 0.0
    erased: bool = False
    """Request transfer came, in any attempt: the old application is gone."""

    number: int = 0
    """The packet in work, 1-based."""
    tries: int = 0
    """How often it was begun to be sent."""
    copies_unanswered: int = 0
    """Copies of it that have left and were not answered."""
    accepted: bool = False
    """One of its copies was acknowledged."""
    nak_next_seen: bool = False
    """A repeated packet n was answered with NAK n+1, and that was not taken for an ACK (R10)."""

    failed_packet: int | None = None
    """The packet that ended an earlier attempt."""

    end_tries: int = 0
    end_copies_left: int = 0
    end_naks: int = 0
    announced_at: float | None = None
    """When the first of the boot versions came that follow each other since end of transfer."""
    announced_last_at: float = 0.0
    running_version: str | None = None

    second_tool: str = ""
    """What showed that somebody else sends as the tool."""

    @property
    def update_left(self) -> bool:
        """True when an update command was sent: the device may have erased its application."""
        return self.update_left_at > _NEVER

    @property
    def silent_since(self) -> float:
        """Since when the device has been silent, and not been told to update again."""
        return max(self.heard_at, self.update_left_at)

    @property
    def packet(self) -> int | None:
        """The packet in work, 1-based; None outside of the transfer."""
        return self.number if self.phase is Phase.TRANSFER else None

    @property
    def device_left(self) -> DeviceLeft:
        """The state that the device would be left in if nothing more were sent."""
        if self.end_copies_left:
            return DeviceLeft.UNKNOWN
        if self.erased:
            return DeviceLeft.NO_APPLICATION
        return DeviceLeft.PERHAPS_ERASED if self.update_left else DeviceLeft.UNTOUCHED

    def enter(self, state: State, now: float) -> bool:
        """Another state begins; True when another phase does so with it."""
        self.state, self.state_since = state, now
        before, self.phase = self.phase, _PHASES.get(state, self.phase)
        return self.phase is not before

    def message_left(self, command: object, left_at: float) -> None:
        """The last frame of a message with this command has left."""
        match command:
            case Command.UPDATE:
                self.update_left_at = left_at
                if self.first_update_left_at is None:
                    self.first_update_left_at = left_at
            case Command.PACKET:
                self.copies_unanswered += 1
            case Command.END_OF_TRANSFER:
                self.end_copies_left += 1

    def requested(self, now: float) -> None:
        """The device asks for packet 1."""
        self.request_at, self.erased = now, True

    def next_packet(self, number: int) -> None:
        """Begin the work on another packet."""
        self.number, self.tries = number, 0
        self.copies_unanswered, self.accepted = 0, False

    def next_attempt(self, failed_packet: int | None = None) -> Situation:
        """The situation when the upgrade starts over, and the packet that is to blame for it."""
        return Situation(
            tx=self.tx,
            state=self.state,
            state_since=self.state_since,
            phase=self.phase,
            attempt=self.attempt + 1,
            heard_at=self.heard_at,
            silence_was_answered=self.silence_was_answered,
            last_boot=self.last_boot,
            update_left_at=self.update_left_at,
            erased=self.erased,
            failed_packet=failed_packet or self.failed_packet,
            nak_next_seen=self.nak_next_seen,
        )
