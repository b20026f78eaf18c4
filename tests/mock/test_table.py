"""The table is complete, and a pair that cannot happen says so."""

from __future__ import annotations

import pytest

from flasher.errors import FlasherError
from flasher.mock.model import MockDevice
from flasher.mock.table import IGNORED, MESSAGE_EVENTS, TABLE, Event, State
from tests.loops import each
from tests.mock.bench import Bench

DEAF = {State.OFF, State.RESTARTING}


TIMERS = {
    State.RESTARTING: {Event.RESTART_DUE},
    State.ANNOUNCING: {Event.ANNOUNCEMENT_DUE, Event.WINDOW_OVER},
    State.ERASING: {Event.FLASH_DONE},
    State.TRANSFER: {Event.PAUSE_OVER},
    State.PROGRAMMING: {Event.FLASH_DONE},
    State.CHECKING: {Event.FLASH_DONE},
    State.STARTING: {Event.START_DUE, Event.START_BY_RESTART_DUE},
    State.REFUSED: {Event.HOLD_OVER},
}


def test_every_pair_that_can_happen_is_listed_and_no_other() -> None:
    assert set(TABLE) == set(State)
    for state, row in TABLE.items():
        heard = set() if state in DEAF else MESSAGE_EVENTS
        power = {Event.POWER_CUT, Event.POWER_ON}
        assert set(row) == heard | power | TIMERS.get(state, set()), state


@each("state", list(State))
def test_a_power_cut_ends_every_state(state: State) -> None:
    assert (TABLE[state][Event.POWER_CUT].state or state) is State.OFF


@each("state", list(State))
def test_an_ignored_event_does_not_change_the_state(state: State) -> None:
    for action, after in TABLE[state].values():
        if action == IGNORED.action:
            assert after in {None, state}


def test_only_an_update_command_erases_and_never_in_the_application() -> None:
    erasing = {
        (state, event)
        for state, row in TABLE.items()
        for event, move in row.items()
        if move.action == "erase"
    }
    assert {event for _, event in erasing} == {Event.UPDATE}
    assert {state for state, _ in erasing} == {
        State.ANNOUNCING,
        State.ERASING,
        State.TRANSFER,
        State.PROGRAMMING,
        State.REFUSED,
    }


def test_the_application_starts_from_the_bootloader_only() -> None:
    starting = {
        state
        for state, row in TABLE.items()
        if any(
            move.state is State.APPLICATION and state is not State.APPLICATION
            for move in row.values()
        )
    }
    assert starting == {State.ANNOUNCING, State.STARTING}


def test_an_impossible_event_is_an_internal_error_that_names_the_state() -> None:
    device = Bench().device
    with pytest.raises(FlasherError, match="cannot happen") as caught:
        device._handle(Event.FLASH_DONE, 0.0)
    assert caught.value.where == "state application"


def test_every_action_of_the_table_has_its_method() -> None:
    actions = {move.action for row in TABLE.values() for move in row.values()}
    assert [action for action in actions if not hasattr(MockDevice, f"_{action}")] == []
