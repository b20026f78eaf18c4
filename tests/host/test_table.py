"""The table of the upgrade as data: complete, reachable, and safe by its very shape."""

from __future__ import annotations

import pytest

from flasher.host.outcome import _EXPLANATIONS
from flasher.host.table import BEFORE_THE_START, TABLE, Action, Ending, Event, State
from flasher.host.upgrade import Upgrade

RUNNING = [state for state in State if state not in {State.STOPPING, State.DONE}]


def test_every_pair_of_state_and_event_is_listed() -> None:
    assert set(TABLE) == set(State)
    for state, row in TABLE.items():
        assert set(row) == set(Event), state


def test_every_action_has_its_method_and_is_used() -> None:
    used = {move.action for row in TABLE.values() for move in row.values()}
    actions = set(Action) - {Action.IMPOSSIBLE}
    assert set(Upgrade._ACTIONS) == actions
    assert actions <= used


def test_every_ending_is_reached_and_explained() -> None:
    used = {move.action for row in TABLE.values() for move in row.values()}
    assert set(Ending) - BEFORE_THE_START <= used
    assert not BEFORE_THE_START & used
    good = {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}
    unexplained = {Ending.OUT_OF_TIME, Ending.UP_TO_DATE}
    assert set(_EXPLANATIONS) == set(Ending) - good - unexplained


def test_every_state_is_reached_from_the_first() -> None:
    reached = {State.RESETTING}
    while True:
        more = {
            move.state
            for state in reached
            for move in TABLE[state].values()
            if move.action is not Action.IMPOSSIBLE
        }
        if more <= reached:
            break
        reached |= more
    # STOPPING becomes DONE when the last message has left, which is no event of the table.
    assert reached == set(State) - {State.DONE}


@pytest.mark.parametrize("state", RUNNING)
def test_an_ending_always_leads_to_stopping_and_only_an_ending_does(state: State) -> None:
    for event, move in TABLE[state].items():
        assert isinstance(move.action, Ending) == (move.state is State.STOPPING), event


@pytest.mark.parametrize("state", RUNNING)
def test_the_user_and_the_deadline_end_every_state(state: State) -> None:
    assert TABLE[state][Event.CANCEL].action is Ending.CANCELLED
    assert TABLE[state][Event.OUT_OF_TIME].action is Ending.OUT_OF_TIME


def test_after_end_of_transfer_only_a_device_beyond_its_burst_gets_an_update_command() -> None:
    """R11: an update command would erase a good image."""
    for state in (State.ENDING, State.CONFIRMING):
        sends = {
            event
            for event, move in TABLE[state].items()
            if move.action in {Action.SEND_UPDATE, Action.START_OVER}
        }
        assert sends == {Event.BOOT_RESTARTED}


def test_an_update_command_answers_something_the_device_said_or_one_long_silence() -> None:
    """R2, R26."""
    for row in TABLE.values():
        for event, move in row.items():
            if move.action in {Action.SEND_UPDATE, Action.START_OVER}:
                assert event in {
                    Event.BOOT_VERSION,
                    Event.BOOT_RESTARTED,
                    Event.REQUEST_LATE,
                    Event.BOOT_SILENT,
                }
