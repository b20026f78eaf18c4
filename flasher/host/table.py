"""The upgrade as a table: what the host does on every event in every state.

A received message or an expired timer is first classified into an `Event` (see `upgrade`); then
`TABLE[state][event]` names the action and the next state. Every pair is listed: what is ignored,
what is reported, and what cannot happen. Anything that changes the state stands here; the state
diagram in the documentation is generated from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple


class State(Enum):
    """Where the host stands; the value is how the documentation names it."""

    RESETTING = "resetting"
    AWAITING_BOOT = "awaiting boot version"
    AWAITING_REQUEST = "awaiting request transfer"
    TRANSFERRING = "transferring"
    SETTLING = "settling"
    ENDING = "ending"
    CONFIRMING = "confirming"
    STOPPING = "stopping"
    DONE = "done"


class Event(Enum):
    """A received message or an expired timer, classified; the value is its name in diagrams."""

    FEEDBACK = "general feedback"
    BOOT_VERSION = "boot version"
    BOOT_TOO_SOON = "boot version too soon after the update command"
    BOOT_WRONG = "boot version of another device"
    BOOT_TOO_OLD = "boot version older than the image needs"
    BOOT_CHANGED = "another boot version in one burst"
    BOOT_UNHEARING = "boot version although told to update for long"
    BOOT_LEFTOVER = "leftover boot version"
    BOOT_RESTARTED = "boot version of a restarted device"
    BOOT_AFTER_END = "boot version after end of transfer"
    RESTARTS_EXHAUSTED = "restarted, no attempt left"
    REQUEST = "request transfer"
    REQUEST_AGAIN = "request transfer before ACK 1"
    REQUEST_LATE = "request transfer in the middle"
    PACKET_DONE = "packet acknowledged"
    LAST_PACKET_DONE = "last packet acknowledged"
    PACKET_REFUSED = "packet refused"
    PACKET_UNANSWERED = "packet not answered"
    PACKET_GIVEN_UP = "packet refused or not answered, no try left, an attempt left"
    PACKET_LOST = "packet refused or not answered, no try and no attempt left"
    COPY_OUTSTANDING = "answered, another copy is not"
    ANSWER_STALE = "stale ACK or NAK"
    ANSWER_UNEXPECTED = "ACK or NAK for another packet"
    COMPLETE = "complete"
    COMPLETE_EARLY = "complete before end of transfer"
    END_NAK = "first NAK after end of transfer"
    END_REFUSED = "second NAK after end of transfer"
    END_UNANSWERED = "end of transfer not answered"
    END_LOST = "end of transfer not answered, no try left"
    END_UNCONFIRMABLE = "final answer lost, target has no version query"
    BURST_ENDED = "boot versions stopped after end of transfer"
    VERSION_RIGHT = "application answers the new version"
    VERSION_OTHER = "application answers another version"
    VERSION_UNJUDGED = "application answers, no version to compare"
    RESET_DUE = "reset not answered yet"
    RESET_UNANSWERED = "reset not answered"
    QUERY_DUE = "version not answered yet"
    QUERY_UNANSWERED = "version not answered"
    BOOT_MISSING = "no boot version in time"
    POWER_UP_MISSING = "no boot version in time, waited for at power-up"
    BOOT_GIVEN_UP = "no boot version of a device that was told to update, an attempt left"
    BOOT_AWAITED = "no boot version, the device may still be erasing"
    BOOT_SILENT = "no boot version and no answer to the reset for the erase limit, an attempt left"
    BOOT_LOST = "no boot version after a lost packet, no attempt left"
    REQUEST_MISSING = "no request transfer in time, no attempt left"
    REQUEST_GIVEN_UP = "no request transfer in time, an attempt left"
    LINK_BACK = "the adapter was lost and is back"
    LINK_BACK_UPDATING = "the adapter was lost and is back, the device was told to update"
    SECOND_TOOL = "somebody else speaks as the tool"
    UNEXPECTED = "message that has no place here"
    OUT_OF_TIME = "overall deadline"
    CANCEL = "cancelled by the user"


class Action(Enum):
    """What to do; each one is a small method of `Upgrade`."""

    NOTHING = "nothing"
    REPORT = "report it"
    IMPOSSIBLE = "cannot happen"
    SEND_RESET = "send reset"
    AWAIT_BOOT = "wait for the boot version"
    AWAIT_ERASE = "wait for the end of the erase limit"
    AWAIT_REQUEST = "wait for request transfer"
    SEND_UPDATE = "send update command"
    START_OVER = "start over: send update command"
    BEGIN_AGAIN = "begin again: send reset"
    SEND_FIRST_PACKET = "send packet 1"
    SEND_NEXT_PACKET = "send the next packet"
    REPEAT_PACKET = "send the packet again"
    AWAIT_QUIET = "wait for quiet"
    SEND_END = "send end of transfer"
    REPEAT_END = "send end of transfer again"
    AWAIT_BURST_END = "wait for the announcements to stop"
    QUERY_VERSION = "ask for the version"


class Ending(Enum):
    """How an upgrade can end; the value completes "the upgrade ended: ..."."""

    COMPLETED = "the device confirmed the complete image"
    CONFIRMED_BY_VERSION = "the final answer was lost, the new application answers its version"
    UNCONFIRMED = "everything was sent and acknowledged, the final answer never came"
    OTHER_VERSION = "another version answers than the one that was sent"
    REFUSED = "the device refused the image at the end"
    NO_BOOT_VERSION = "no boot version came"
    NO_ANNOUNCEMENT = "it did not announce itself"
    NO_REQUEST = "no request transfer came"
    UNHEARING = "the bootloader announces itself but does not take the update command"
    WRONG_DEVICE = "another device answers"
    BOOT_TOO_OLD = "its bootloader is older than the image needs"
    TWO_DEVICES = "two devices answer on the same id"
    NOT_FOR_DEVICE = "the image is not meant for this device"
    IMPLAUSIBLE = "not plausible as firmware"
    UNCHECKED = "it cannot be checked whether the image is meant for this device"
    IN_USE = "the vehicle is in use"
    UP_TO_DATE = "the device already runs this version"
    SECOND_TOOL = "a second tool speaks on the bus"
    PACKET_FAILED = "a packet was not acknowledged"
    RESTARTED = "the device restarted too often"
    BROKEN_PROTOCOL = "the device completed before it was told that the transfer had ended"
    OUT_OF_TIME = "the overall deadline passed"
    CANCELLED = "cancelled by the user"


BEFORE_THE_START: Final = frozenset(
    {
        Ending.IMPLAUSIBLE,
        Ending.NOT_FOR_DEVICE,
        Ending.UNCHECKED,
        Ending.IN_USE,
        Ending.UP_TO_DATE,
    }
)
"""Endings of a session whose upgrade is never begun: the table does not hold them."""


class Transition(NamedTuple):
    """What follows an event: an action, or the ending of the upgrade, and the next state."""

    action: Action | Ending
    state: State


_Row = Mapping[Event, Transition]


def _row(
    state: State,
    moves: dict[Event, tuple[Action | Ending, State]],
    *,
    ignored: tuple[Event, ...] = (),
    reported: tuple[Event, ...] = (),
) -> _Row:
    """A complete row: the moves, what is ignored or reported where it stands, the rest impossible.

    Every state but the last two ends on the deadline, on the user's word and on a second tool.
    Where a lost adapter that is back has no row of its own, the upgrade begins again.
    """
    row = {event: Transition(Action.IMPOSSIBLE, state) for event in Event}
    row.update({event: Transition(Action.NOTHING, state) for event in ignored})
    row.update({event: Transition(Action.REPORT, state) for event in reported})
    row[Event.UNEXPECTED] = Transition(Action.REPORT, state)
    row[Event.OUT_OF_TIME] = Transition(Ending.OUT_OF_TIME, State.STOPPING)
    row[Event.CANCEL] = Transition(Ending.CANCELLED, State.STOPPING)
    row[Event.SECOND_TOOL] = Transition(Ending.SECOND_TOOL, State.STOPPING)
    row[Event.LINK_BACK] = Transition(Action.BEGIN_AGAIN, State.RESETTING)
    row.update({event: Transition(*move) for event, move in moves.items()})
    return row


_BEFORE_UPDATE: Final[dict[Event, tuple[Action | Ending, State]]] = {
    Event.BOOT_VERSION: (Action.SEND_UPDATE, State.AWAITING_REQUEST),
    Event.BOOT_WRONG: (Ending.WRONG_DEVICE, State.STOPPING),
    Event.BOOT_TOO_OLD: (Ending.BOOT_TOO_OLD, State.STOPPING),
}

TABLE: Final[Mapping[State, _Row]] = {
    State.RESETTING: _row(
        State.RESETTING,
        _BEFORE_UPDATE
        | {
            Event.FEEDBACK: (Action.AWAIT_BOOT, State.AWAITING_BOOT),
            Event.RESET_DUE: (Action.SEND_RESET, State.RESETTING),
            # A device that sits in its bootloader does not know the reset (R18): go on.
            Event.RESET_UNANSWERED: (Action.AWAIT_BOOT, State.AWAITING_BOOT),
        },
    ),
    State.AWAITING_BOOT: _row(
        State.AWAITING_BOOT,
        _BEFORE_UPDATE
        | {
            Event.BOOT_MISSING: (Ending.NO_BOOT_VERSION, State.STOPPING),
            Event.POWER_UP_MISSING: (Ending.NO_ANNOUNCEMENT, State.STOPPING),
            Event.BOOT_GIVEN_UP: (Action.BEGIN_AGAIN, State.RESETTING),
            Event.BOOT_AWAITED: (Action.AWAIT_ERASE, State.AWAITING_BOOT),
            # It may sit in a session that never ends and knows no reset: once, and only here, an
            # update command goes into silence (R26).
            Event.BOOT_SILENT: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.BOOT_LOST: (Ending.PACKET_FAILED, State.STOPPING),
        },
        ignored=(Event.FEEDBACK,),
    ),
    State.AWAITING_REQUEST: _row(
        State.AWAITING_REQUEST,
        {
            Event.BOOT_VERSION: (Action.SEND_UPDATE, State.AWAITING_REQUEST),
            Event.BOOT_WRONG: (Ending.WRONG_DEVICE, State.STOPPING),
            Event.BOOT_CHANGED: (Ending.TWO_DEVICES, State.STOPPING),
            Event.BOOT_UNHEARING: (Ending.UNHEARING, State.STOPPING),
            Event.REQUEST: (Action.SEND_FIRST_PACKET, State.TRANSFERRING),
            # Silence is not answered (R2): the device may be erasing.
            Event.LINK_BACK_UPDATING: (Action.AWAIT_REQUEST, State.AWAITING_REQUEST),
            Event.REQUEST_GIVEN_UP: (Action.BEGIN_AGAIN, State.RESETTING),
            Event.REQUEST_MISSING: (Ending.NO_REQUEST, State.STOPPING),
            Event.BOOT_LOST: (Ending.PACKET_FAILED, State.STOPPING),
        },
        ignored=(Event.BOOT_TOO_SOON, Event.FEEDBACK),
    ),
    State.TRANSFERRING: _row(
        State.TRANSFERRING,
        {
            Event.PACKET_DONE: (Action.SEND_NEXT_PACKET, State.TRANSFERRING),
            Event.LAST_PACKET_DONE: (Action.SEND_END, State.ENDING),
            Event.PACKET_REFUSED: (Action.REPEAT_PACKET, State.TRANSFERRING),
            Event.PACKET_UNANSWERED: (Action.REPEAT_PACKET, State.TRANSFERRING),
            Event.PACKET_GIVEN_UP: (Action.BEGIN_AGAIN, State.RESETTING),
            Event.PACKET_LOST: (Ending.PACKET_FAILED, State.STOPPING),
            # A device that has stored the packet answers it all the same (R10).
            Event.LINK_BACK: (Action.REPEAT_PACKET, State.TRANSFERRING),
            Event.COPY_OUTSTANDING: (Action.AWAIT_QUIET, State.SETTLING),
            Event.REQUEST_AGAIN: (Action.REPEAT_PACKET, State.TRANSFERRING),
            Event.REQUEST_LATE: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.BOOT_RESTARTED: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.BOOT_WRONG: (Ending.WRONG_DEVICE, State.STOPPING),
            Event.RESTARTS_EXHAUSTED: (Ending.RESTARTED, State.STOPPING),
            Event.COMPLETE_EARLY: (Ending.BROKEN_PROTOCOL, State.STOPPING),
        },
        ignored=(Event.ANSWER_STALE, Event.FEEDBACK),
        reported=(Event.ANSWER_UNEXPECTED, Event.BOOT_LEFTOVER),
    ),
    # A packet was sent more than once and not every copy is answered: the next message waits, or
    # one late answer would double every later packet (R10).
    State.SETTLING: _row(
        State.SETTLING,
        {
            Event.PACKET_DONE: (Action.SEND_NEXT_PACKET, State.TRANSFERRING),
            Event.LAST_PACKET_DONE: (Action.SEND_END, State.ENDING),
            Event.PACKET_REFUSED: (Action.REPEAT_PACKET, State.TRANSFERRING),
            Event.PACKET_GIVEN_UP: (Action.BEGIN_AGAIN, State.RESETTING),
            Event.PACKET_LOST: (Ending.PACKET_FAILED, State.STOPPING),
            Event.LINK_BACK: (Action.AWAIT_QUIET, State.SETTLING),
            Event.COPY_OUTSTANDING: (Action.AWAIT_QUIET, State.SETTLING),
            Event.REQUEST_AGAIN: (Action.AWAIT_QUIET, State.SETTLING),
            Event.REQUEST_LATE: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.BOOT_RESTARTED: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.BOOT_WRONG: (Ending.WRONG_DEVICE, State.STOPPING),
            Event.RESTARTS_EXHAUSTED: (Ending.RESTARTED, State.STOPPING),
            Event.COMPLETE_EARLY: (Ending.BROKEN_PROTOCOL, State.STOPPING),
            Event.ANSWER_STALE: (Action.AWAIT_QUIET, State.SETTLING),
        },
        ignored=(Event.FEEDBACK,),
        reported=(Event.ANSWER_UNEXPECTED, Event.BOOT_LEFTOVER),
    ),
    # No boot version is answered from here on: an update command would erase a good image (R11).
    State.ENDING: _row(
        State.ENDING,
        {
            Event.COMPLETE: (Ending.COMPLETED, State.STOPPING),
            Event.COMPLETE_EARLY: (Ending.BROKEN_PROTOCOL, State.STOPPING),
            Event.END_NAK: (Action.REPEAT_END, State.ENDING),
            Event.END_REFUSED: (Ending.REFUSED, State.STOPPING),
            Event.END_UNANSWERED: (Action.REPEAT_END, State.ENDING),
            Event.END_LOST: (Action.QUERY_VERSION, State.CONFIRMING),
            Event.END_UNCONFIRMABLE: (Ending.UNCONFIRMED, State.STOPPING),
            Event.BOOT_AFTER_END: (Action.AWAIT_BURST_END, State.ENDING),
            Event.BURST_ENDED: (Action.QUERY_VERSION, State.CONFIRMING),
            # Every packet is acknowledged: whatever was lost, only the end is missing.
            Event.LINK_BACK: (Action.REPEAT_END, State.ENDING),
            Event.BOOT_RESTARTED: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.RESTARTS_EXHAUSTED: (Ending.RESTARTED, State.STOPPING),
        },
        ignored=(Event.ANSWER_STALE, Event.FEEDBACK),
    ),
    State.CONFIRMING: _row(
        State.CONFIRMING,
        {
            Event.COMPLETE: (Ending.COMPLETED, State.STOPPING),
            Event.END_NAK: (Action.REPEAT_END, State.ENDING),
            Event.END_REFUSED: (Ending.REFUSED, State.STOPPING),
            Event.VERSION_RIGHT: (Ending.CONFIRMED_BY_VERSION, State.STOPPING),
            Event.VERSION_OTHER: (Ending.OTHER_VERSION, State.STOPPING),
            Event.VERSION_UNJUDGED: (Ending.UNCONFIRMED, State.STOPPING),
            Event.QUERY_DUE: (Action.QUERY_VERSION, State.CONFIRMING),
            Event.LINK_BACK: (Action.QUERY_VERSION, State.CONFIRMING),
            Event.QUERY_UNANSWERED: (Ending.UNCONFIRMED, State.STOPPING),
            Event.BOOT_AFTER_END: (Action.NOTHING, State.CONFIRMING),
            Event.BOOT_RESTARTED: (Action.START_OVER, State.AWAITING_REQUEST),
            Event.RESTARTS_EXHAUSTED: (Ending.RESTARTED, State.STOPPING),
        },
        ignored=(Event.ANSWER_STALE, Event.FEEDBACK),
    ),
    # The outcome is known; what was begun to be sent is finished, so that the bus is left at a
    # message boundary. Nothing that arrives is looked at any more.
    State.STOPPING: {event: Transition(Action.NOTHING, State.STOPPING) for event in Event},
    State.DONE: {event: Transition(Action.IMPOSSIBLE, State.DONE) for event in Event},
}
