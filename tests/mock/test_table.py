"""The table is complete, and a pair that cannot happen says so."""

from __future__ import annotations

import pytest

from flasher.errors import FlasherError
from flasher.mock.model import MockDevice
from flasher.mock.table import IGNORED, MESSAGE_EVENTS, TABLE, BootloaderEvent, BootloaderState
from tests.loops import each
from tests.mock.bench import Bench

DEAF = {BootloaderState.OFF, BootloaderState.RESTARTING}


TIMERS = {
    BootloaderState.RESTARTING: {BootloaderEvent.RESTART_DUE},
    BootloaderState.ANNOUNCING: {BootloaderEvent.ANNOUNCEMENT_DUE, BootloaderEvent.WINDOW_OVER},
    BootloaderState.ERASING: {BootloaderEvent.FLASH_DONE},
    BootloaderState.TRANSFER: {BootloaderEvent.PAUSE_OVER},
    BootloaderState.PROGRAMMING: {BootloaderEvent.FLASH_DONE},
    BootloaderState.CHECKING: {BootloaderEvent.FLASH_DONE},
    BootloaderState.STARTING: {BootloaderEvent.START_DUE, BootloaderEvent.START_BY_RESTART_DUE},
    BootloaderState.REFUSED: {BootloaderEvent.HOLD_OVER},
}


def test_every_pair_that_can_happen_is_listed_and_no_other() -> None:
    assert set(TABLE) == set(BootloaderState)
    for state, row in TABLE.items():
        heard = set() if state in DEAF else MESSAGE_EVENTS
        power = {BootloaderEvent.POWER_CUT, BootloaderEvent.POWER_ON}
        assert set(row) == heard | power | TIMERS.get(state, set()), state


@each("state", list(BootloaderState))
def test_a_power_cut_ends_every_state(state: BootloaderState) -> None:
    assert (TABLE[state][BootloaderEvent.POWER_CUT].state or state) is BootloaderState.OFF


@each("state", list(BootloaderState))
def test_an_ignored_event_does_not_change_the_state(state: BootloaderState) -> None:
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
    assert {event for _, event in erasing} == {BootloaderEvent.UPDATE}
    assert {state for state, _ in erasing} == {
        BootloaderState.ANNOUNCING,
        BootloaderState.ERASING,
        BootloaderState.TRANSFER,
        BootloaderState.PROGRAMMING,
        BootloaderState.REFUSED,
    }


def test_the_application_starts_from_the_bootloader_only() -> None:
    starting = {
        state
        for state, row in TABLE.items()
        if any(
            move.state is BootloaderState.APPLICATION and state is not BootloaderState.APPLICATION
            for move in row.values()
        )
    }
    assert starting == {BootloaderState.ANNOUNCING, BootloaderState.STARTING}


def test_an_impossible_event_is_an_internal_error_that_names_the_state() -> None:
    device = Bench().device
    with pytest.raises(FlasherError, match="cannot happen") as caught:
        device._handle(BootloaderEvent.FLASH_DONE, 0.0)
    assert caught.value.where == "state application"


def test_every_action_of_the_table_has_its_method() -> None:
    actions = {move.action for row in TABLE.values() for move in row.values()}
    assert [action for action in actions if not hasattr(MockDevice, f"_{action}")] == []
