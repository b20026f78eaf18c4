"""The upgrade as a table, seen from the device: what it does on every event in every state.

A received message or an expired timer is first classified into an `Event` (see `classify`; a choice
of the profile that changes the state is made there). Then `TABLE[state][event]` names the action
and the next state. Every pair is listed: what is ignored, and what cannot happen.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final, NamedTuple


class State(Enum):
    """Where the device stands; the value is how the documentation names it."""

    OFF = "off"
    APPLICATION = "application"
    RESTARTING = "restarting"
    ANNOUNCING = "announcing"
    ERASING = "erasing"
    TRANSFER = "transfer"
    PROGRAMMING = "programming"
    CHECKING = "checking"
    STARTING = "starting"
    REFUSED = "refused"


class Event(Enum):
    """A received message or an expired timer, classified; the value is its name in diagrams."""

    # Messages.
    RESET = "reset"
    RESET_IGNORED = "reset that the bootloader ignores"
    QUERY = "query or write of the application"
    UPGRADE_IN_APPLICATION = "upgrade message for the running application"
    UPDATE = "update command"
    UPDATE_AGAIN = "update command repeated"
    UPDATE_REFUSED = "update command that is refused"
    PACKET_NEXT = "packet that is next"
    PACKET_REPEATED = "packet stored last"
    PACKET_OLDER = "packet stored before"
    PACKET_BAD = "damaged or impossible packet"
    END_WHOLE = "end of transfer, image right"
    END_WRONG = "end of transfer, image checksum wrong"
    END_EARLY = "end of transfer, packets missing"
    END_AGAIN = "end of transfer repeated"
    OUT_OF_TURN = "packet or end of transfer out of turn"
    NO_CONCERN = "message of no concern"
    # Timers.
    RESTART_DUE = "restart delay over"
    ANNOUNCEMENT_DUE = "announcement due"
    WINDOW_OVER = "window over, application whole"
    FLASH_DONE = "flash operations done"
    PAUSE_OVER = "pause too long"
    HOLD_OVER = "refusal held"
    START_DUE = "start delay over"
    START_BY_RESTART_DUE = "start delay over, starts through the bootloader"
    # Power.
    POWER_CUT = "power cut"
    POWER_ON = "power on"


MESSAGE_EVENTS: Final = frozenset(Event) - {
    Event.RESTART_DUE,
    Event.ANNOUNCEMENT_DUE,
    Event.WINDOW_OVER,
    Event.FLASH_DONE,
    Event.PAUSE_OVER,
    Event.HOLD_OVER,
    Event.START_DUE,
    Event.START_BY_RESTART_DUE,
    Event.POWER_CUT,
    Event.POWER_ON,
}
"""The events that a message on the bus can be."""


class Action(Enum):
    """What to do; each one is a small method of `MockDevice`."""

    NOTHING = "nothing"
    IMPOSSIBLE = "cannot happen"
    CONFIRM_RESET = "send general feedback, restart"
    RESTART = "restart"
    SEND_FEEDBACK = "send general feedback"
    ANSWER = "answer it"
    BOOT = "look for a whole application"
    ANNOUNCE = "send boot version"
    START = "start the application"
    REFUSE_UPDATE = "refuse the update command"
    ERASE = "erase: record first, then pages"
    REQUEST = "send request transfer"
    STORE = "program the packet"
    ACKNOWLEDGE = "send ACK"
    ANSWER_REPEATED = "answer the repeated packet"
    ANSWER_OLDER = "answer the older packet"
    ANSWER_BAD = "answer the bad packet"
    RECORD = "program the record"
    COMPLETE = "send complete"
    COMPLETE_AGAIN = "answer again"
    REFUSE_END = "send NAK"
    REFUSE_END_AGAIN = "send NAK again"
    SWITCH_OFF = "lose everything but the flash"


class Transition(NamedTuple):
    """What follows an event."""

    action: Action
    state: State


Row = Mapping[Event, Transition]


def _row(
    state: State,
    moves: dict[Event, tuple[Action, State]],
    *,
    ignores: frozenset[Event] = MESSAGE_EVENTS,
) -> Row:
    """A complete row: the moves; messages without one are ignored, the rest cannot happen."""
    row = {event: Transition(Action.IMPOSSIBLE, state) for event in Event}
    row |= {event: Transition(Action.NOTHING, state) for event in ignores}
    row[Event.POWER_CUT] = Transition(Action.SWITCH_OFF, State.OFF)
    row[Event.POWER_ON] = Transition(Action.NOTHING, state)
    row |= {event: Transition(*move) for event, move in moves.items()}
    return row


_DURING_UPGRADE: Final[dict[Event, tuple[Action, State]]] = {
    Event.RESET: (Action.RESTART, State.RESTARTING),
    Event.UPDATE: (Action.ERASE, State.ERASING),
}

TABLE: Final[Mapping[State, Row]] = {
    # No power, no reception.
    State.OFF: _row(
        State.OFF,
        {
            Event.POWER_ON: (Action.RESTART, State.RESTARTING),
            Event.POWER_CUT: (Action.NOTHING, State.OFF),
        },
        ignores=frozenset(),
    ),
    # Nothing here erases (UP-03).
    State.APPLICATION: _row(
        State.APPLICATION,
        {
            Event.RESET: (Action.CONFIRM_RESET, State.RESTARTING),
            Event.QUERY: (Action.ANSWER, State.APPLICATION),
            Event.UPGRADE_IN_APPLICATION: (Action.SEND_FEEDBACK, State.APPLICATION),
        },
    ),
    # Deaf: a second reset does not restart it twice (RS-02).
    State.RESTARTING: _row(
        State.RESTARTING,
        {Event.RESTART_DUE: (Action.BOOT, State.ANNOUNCING)},
        ignores=frozenset(),
    ),
    # Announces and listens, then listens for the window.
    State.ANNOUNCING: _row(
        State.ANNOUNCING,
        {
            Event.RESET: (Action.RESTART, State.RESTARTING),
            Event.UPDATE: (Action.ERASE, State.ERASING),
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.ANNOUNCING),
            Event.ANNOUNCEMENT_DUE: (Action.ANNOUNCE, State.ANNOUNCING),
            Event.WINDOW_OVER: (Action.START, State.APPLICATION),
        },
    ),
    State.ERASING: _row(
        State.ERASING,
        _DURING_UPGRADE
        | {
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.ERASING),
            Event.FLASH_DONE: (Action.REQUEST, State.TRANSFER),
        },
    ),
    State.TRANSFER: _row(
        State.TRANSFER,
        _DURING_UPGRADE
        | {
            Event.UPDATE_AGAIN: (Action.REQUEST, State.TRANSFER),
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.TRANSFER),
            Event.PACKET_NEXT: (Action.STORE, State.PROGRAMMING),
            Event.PACKET_REPEATED: (Action.ANSWER_REPEATED, State.TRANSFER),
            Event.PACKET_OLDER: (Action.ANSWER_OLDER, State.TRANSFER),
            Event.PACKET_BAD: (Action.ANSWER_BAD, State.TRANSFER),
            Event.END_EARLY: (Action.REFUSE_END, State.TRANSFER),
            Event.END_WHOLE: (Action.RECORD, State.CHECKING),
            Event.END_WRONG: (Action.REFUSE_END, State.REFUSED),
            Event.PAUSE_OVER: (Action.BOOT, State.ANNOUNCING),
        },
    ),
    State.PROGRAMMING: _row(
        State.PROGRAMMING,
        _DURING_UPGRADE
        | {
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.PROGRAMMING),
            Event.FLASH_DONE: (Action.ACKNOWLEDGE, State.TRANSFER),
        },
    ),
    State.CHECKING: _row(
        State.CHECKING,
        {
            Event.RESET: (Action.RESTART, State.RESTARTING),
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.CHECKING),
            Event.FLASH_DONE: (Action.COMPLETE, State.STARTING),
        },
    ),
    # On its way to the application: an update command would erase what was just completed.
    State.STARTING: _row(
        State.STARTING,
        {
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.STARTING),
            Event.END_AGAIN: (Action.COMPLETE_AGAIN, State.STARTING),
            Event.START_DUE: (Action.START, State.APPLICATION),
            Event.START_BY_RESTART_DUE: (Action.BOOT, State.ANNOUNCING),
        },
    ),
    # Repeats its answer for a host that asks once more (R6), then can be rescued (EN-04).
    State.REFUSED: _row(
        State.REFUSED,
        _DURING_UPGRADE
        | {
            Event.UPDATE_REFUSED: (Action.REFUSE_UPDATE, State.REFUSED),
            Event.END_AGAIN: (Action.REFUSE_END_AGAIN, State.REFUSED),
            Event.HOLD_OVER: (Action.BOOT, State.ANNOUNCING),
        },
    ),
}
