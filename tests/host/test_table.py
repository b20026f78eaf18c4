"""The table of the upgrade as data: complete, reachable, and safe by its very shape."""

from __future__ import annotations

from flasher.host.outcome import _EXPLANATIONS
from flasher.host.table import TABLE, TIMERS, Ending, UpgradeEvent, UpgradeState
from flasher.host.upgrade import UpgradeStage
from tests.loops import each

RUNNING = [
    state for state in UpgradeState if state not in {UpgradeState.STOPPING, UpgradeState.DONE}
]
FROM_OUTSIDE = {
    UpgradeEvent.TWO_DEVICES,
    UpgradeEvent.LINK_BACK,
    UpgradeEvent.SECOND_TOOL,
    UpgradeEvent.OUT_OF_TIME,
    UpgradeEvent.CANCEL,
}
FROM_THE_WIRE = {
    UpgradeEvent.FEEDBACK,
    UpgradeEvent.BOOT_VERSION,
    UpgradeEvent.REQUEST,
    UpgradeEvent.ACK,
    UpgradeEvent.NAK,
    UpgradeEvent.COMPLETE,
    UpgradeEvent.UNEXPECTED,
}
ENDED_BEFORE_START = {
    Ending.IMPLAUSIBLE,
    Ending.NOT_FOR_DEVICE,
    Ending.NOT_TRUSTED,
    Ending.IN_USE,
    Ending.LOW_CHARGE,
    Ending.UP_TO_DATE,
}
"""Endings of a session before its upgrade begins, which are not in the table."""


def moves() -> list[tuple[UpgradeState, UpgradeEvent, str, set[UpgradeState | Ending]]]:
    return [
        (state, event, move.action, set(move.leads_to))
        for state, row in TABLE.items()
        for event, move in row.items()
    ]


def test_every_pair_that_can_happen_is_listed_and_no_other() -> None:
    assert set(TABLE) == set(UpgradeState)
    for state in RUNNING:
        own = {TIMERS[state]} | (
            {UpgradeEvent.VERSION} if state is UpgradeState.CONFIRMING else set()
        )
        assert set(TABLE[state]) == FROM_THE_WIRE | FROM_OUTSIDE | own, state
    assert not TABLE[UpgradeState.STOPPING]
    assert not TABLE[UpgradeState.DONE]


def test_every_action_has_its_method() -> None:
    assert [action for _, _, action, _ in moves() if not hasattr(UpgradeStage, f"_{action}")] == []


def test_every_ending_is_reached_and_explained() -> None:
    reached = {each for _, _, _, leads_to in moves() for each in leads_to}
    assert set(Ending) - ENDED_BEFORE_START <= reached
    assert not ENDED_BEFORE_START & reached
    good = {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}
    unexplained = {Ending.OUT_OF_TIME, Ending.UP_TO_DATE}
    assert set(_EXPLANATIONS) == set(Ending) - good - unexplained


def test_every_state_is_reached_from_the_first() -> None:
    reached = {UpgradeState.RESETTING}
    for _ in UpgradeState:
        reached |= {
            each
            for state, _, _, leads_to in moves()
            if state in reached
            for each in leads_to
            if isinstance(each, UpgradeState)
        }
    # An ending leads to STOPPING, and the last message that has left from there to DONE.
    assert reached == set(RUNNING)


@each("state", RUNNING)
def test_the_user_the_deadline_and_a_second_tool_end_every_state(state: UpgradeState) -> None:
    assert TABLE[state][UpgradeEvent.CANCEL].leads_to == (Ending.CANCELLED,)
    assert Ending.OUT_OF_TIME in TABLE[state][UpgradeEvent.OUT_OF_TIME].leads_to
    assert all(isinstance(each, Ending) for each in TABLE[state][UpgradeEvent.OUT_OF_TIME].leads_to)
    assert TABLE[state][UpgradeEvent.SECOND_TOOL].leads_to == (
        UpgradeState.YIELDING,
        Ending.SECOND_TOOL,
    )


def test_after_end_of_transfer_only_a_device_beyond_its_burst_gets_an_update_command() -> None:
    """R11: an update command would erase a good image."""
    updating = {
        event
        for state, event, _, leads_to in moves()
        if state in (UpgradeState.ENDING, UpgradeState.CONFIRMING)
        and leads_to & {UpgradeState.WATCHING, UpgradeState.AWAITING_REQUEST}
    }
    assert updating == {UpgradeEvent.BOOT_VERSION}
    assert {
        TABLE[state][UpgradeEvent.BOOT_VERSION].action
        for state in (UpgradeState.ENDING, UpgradeState.CONFIRMING)
    } == {"take_boot_after_end"}


def test_an_update_command_answers_a_message_of_the_device_or_one_long_silence() -> None:
    """R2, R26."""
    for state, event, action, leads_to in moves():
        if UpgradeState.AWAITING_REQUEST in leads_to and state is not UpgradeState.AWAITING_REQUEST:
            assert (state, action) in {
                (UpgradeState.WATCHING, "answer_boot"),
                (UpgradeState.AWAITING_BOOT, "miss_boot"),
            }
        if UpgradeState.WATCHING in leads_to and state is not UpgradeState.WATCHING:
            assert event in {UpgradeEvent.BOOT_VERSION, UpgradeEvent.REQUEST}
