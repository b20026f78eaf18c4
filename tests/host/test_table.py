"""The table of the upgrade as data: complete, reachable, and safe by its very shape."""

from __future__ import annotations

from flasher.host.outcome import _EXPLANATIONS
from flasher.host.table import BEFORE_THE_START, TABLE, TIMERS, Ending, Event, State
from flasher.host.upgrade import UpgradeStage
from tests.loops import each

RUNNING = [state for state in State if state not in {State.STOPPING, State.DONE}]
FROM_OUTSIDE = {
    Event.TWO_DEVICES,
    Event.LINK_BACK,
    Event.SECOND_TOOL,
    Event.OUT_OF_TIME,
    Event.CANCEL,
}
FROM_THE_WIRE = {
    Event.FEEDBACK,
    Event.BOOT_VERSION,
    Event.REQUEST,
    Event.ACK,
    Event.NAK,
    Event.COMPLETE,
    Event.UNEXPECTED,
}


def moves() -> list[tuple[State, Event, str, set[State | Ending]]]:
    return [
        (state, event, move.action, set(move.leads_to))
        for state, row in TABLE.items()
        for event, move in row.items()
    ]


def test_every_pair_that_can_happen_is_listed_and_no_other() -> None:
    assert set(TABLE) == set(State)
    for state in RUNNING:
        own = {TIMERS[state]} | ({Event.VERSION} if state is State.CONFIRMING else set())
        assert set(TABLE[state]) == FROM_THE_WIRE | FROM_OUTSIDE | own, state
    assert not TABLE[State.STOPPING]
    assert not TABLE[State.DONE]


def test_every_action_has_its_method() -> None:
    assert [action for _, _, action, _ in moves() if not hasattr(UpgradeStage, f"_{action}")] == []


def test_every_ending_is_reached_and_explained() -> None:
    reached = {each for _, _, _, leads_to in moves() for each in leads_to}
    assert set(Ending) - BEFORE_THE_START <= reached
    assert not BEFORE_THE_START & reached
    good = {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}
    unexplained = {Ending.OUT_OF_TIME, Ending.UP_TO_DATE}
    assert set(_EXPLANATIONS) == set(Ending) - good - unexplained


def test_every_state_is_reached_from_the_first() -> None:
    reached = {State.RESETTING}
    for _ in State:
        reached |= {
            each
            for state, _, _, leads_to in moves()
            if state in reached
            for each in leads_to
            if isinstance(each, State)
        }
    # An ending leads to STOPPING, and the last message that has left from there to DONE.
    assert reached == set(RUNNING)


@each("state", RUNNING)
def test_the_user_the_deadline_and_a_second_tool_end_every_state(state: State) -> None:
    assert TABLE[state][Event.CANCEL].leads_to == (Ending.CANCELLED,)
    assert Ending.OUT_OF_TIME in TABLE[state][Event.OUT_OF_TIME].leads_to
    assert all(isinstance(each, Ending) for each in TABLE[state][Event.OUT_OF_TIME].leads_to)
    assert TABLE[state][Event.SECOND_TOOL].leads_to == (State.YIELDING, Ending.SECOND_TOOL)


def test_after_end_of_transfer_only_a_device_beyond_its_burst_gets_an_update_command() -> None:
    """R11: an update command would erase a good image."""
    updating = {
        event
        for state, event, _, leads_to in moves()
        if state in (State.ENDING, State.CONFIRMING)
        and leads_to & {State.WATCHING, State.AWAITING_REQUEST}
    }
    assert updating == {Event.BOOT_VERSION}
    assert {
        TABLE[state][Event.BOOT_VERSION].action for state in (State.ENDING, State.CONFIRMING)
    } == {"take_boot_after_end"}


def test_an_update_command_answers_something_the_device_said_or_one_long_silence() -> None:
    """R2, R26."""
    for state, event, action, leads_to in moves():
        if State.AWAITING_REQUEST in leads_to and state is not State.AWAITING_REQUEST:
            assert (state, action) in {
                (State.WATCHING, "answer_boot"),
                (State.AWAITING_BOOT, "miss_boot"),
            }
        if State.WATCHING in leads_to and state is not State.WATCHING:
            assert event in {Event.BOOT_VERSION, Event.REQUEST}
