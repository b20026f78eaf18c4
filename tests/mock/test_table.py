"""The table is complete, and a pair that cannot happen says so."""

from __future__ import annotations

import pytest

from flasher.errors import FlasherError
from flasher.mock.table import MESSAGE_EVENTS, TABLE, Action, Event, State
from tests.mock.bench import Bench

DEAF = {State.OFF, State.RESTARTING}


def test_every_event_is_listed_in_every_state() -> None:
    assert set(TABLE) == set(State)
    assert all(set(row) == set(Event) for row in TABLE.values())


@pytest.mark.parametrize("state", [state for state in State if state not in DEAF])
def test_no_message_is_impossible_where_the_device_hears(state: State) -> None:
    impossible = {event for event, move in TABLE[state].items() if move.action is Action.IMPOSSIBLE}
    assert not impossible & MESSAGE_EVENTS


@pytest.mark.parametrize("state", [State.OFF, State.RESTARTING])
def test_every_message_is_impossible_where_it_is_deaf(state: State) -> None:
    assert {TABLE[state][event].action for event in MESSAGE_EVENTS} == {Action.IMPOSSIBLE}


@pytest.mark.parametrize("state", list(State))
def test_a_power_cut_ends_every_state(state: State) -> None:
    assert TABLE[state][Event.POWER_CUT].state is State.OFF


@pytest.mark.parametrize("state", list(State))
def test_an_ignored_or_impossible_event_does_not_change_the_state(state: State) -> None:
    for action, after in TABLE[state].values():
        if action in {Action.NOTHING, Action.IMPOSSIBLE}:
            assert after is state


def test_only_an_update_command_erases_and_never_in_the_application() -> None:
    erasing = {
        (state, event)
        for state, row in TABLE.items()
        for event, move in row.items()
        if move.action is Action.ERASE
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
    assert set(Bench().device._actions) == set(Action)
