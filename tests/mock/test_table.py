"""The table has what happens, and a pair that cannot happen says so."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import pytest

from flasher.errors import FlasherError
from flasher.mock.model import MockDevice
from flasher.mock.table import IGNORED, TABLE, BootloaderEvent, BootloaderState
from flasher.protocol import messages
from flasher.protocol.spec import OBC
from tests.loops import each
from tests.mock.bench import READ_VERSION, SMALL, Bench, VersionQuery, image_of, packets_of

IMAGE = image_of(300)


def walk(chance: random.Random, steps: int) -> None:
    """Have anything happen to a device of any choices, in any order."""
    choices: dict[str, Any] = {
        "reset_in_bootloader": chance.choice(("ignored", "restarts")),
        "reset_in_transfer": chance.choice(("ignored", "restarts")),
        "update_in_transfer": chance.choice(("starts_over", "ignored")),
        "image_checksum": chance.choice(("none", "none", "crc32")),
        "after_complete": chance.choice(("starts", "restarts")),
        "start_delay_s": 0.5,
        "refused_hold_s": 2.0,
        "program_time_s": 0.02,
    }
    bench = Bench(replace(SMALL, **choices), has_application=chance.random() < 0.8)
    device, packets = bench.device, packets_of(IMAGE)
    update = bench.update_row(len(IMAGE))
    rows: list[messages.UpgradeMessage | VersionQuery] = [
        messages.ResetCommand(),
        messages.UpdateCommand(OBC.update_text, len(IMAGE)),
        bench.update_row(len(IMAGE) - 1),
        bench.update_row(SMALL.image_limit_bytes + 1),
        replace(packets[0], total=9),
        messages.Ack(1),
        READ_VERSION,
    ]
    following: list[messages.UpgradeMessage] = [update, *packets, messages.EndOfTransfer()]
    upcoming = 0
    for _ in range(steps):
        way = chance.random()
        if way < 0.02:
            device.power_cut(bench.now)
        elif way < (0.5 if device.state is BootloaderState.OFF else 0.03):
            device.power_on(bench.now)
        elif way < 0.25:
            bench.run(chance.choice((0.001, 0.02, 0.3, 0.3, 6.0)))
        elif way < 0.45:
            bench.send(chance.choice(rows))
        else:  # most often the upgrade goes on, now and then from another place
            if way > 0.55 and device.state is not BootloaderState.OFF:
                bench.run(0.1)
            upcoming = chance.randrange(len(following)) if way > 0.95 else upcoming
            bench.send(following[upcoming])
            upcoming = (upcoming + (way < 0.93)) % len(following)


@pytest.mark.slow
def test_the_table_has_each_pair_that_happens_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = set()
    handle = MockDevice._handle

    def noting(device: MockDevice, event: BootloaderEvent, now: float) -> None:
        seen.add((device.state, event))
        handle(device, event, now)

    monkeypatch.setattr(MockDevice, "_handle", noting)
    for seed in range(60):
        walk(random.Random(seed), 200)
    assert seen == {(state, event) for state, row in TABLE.items() for event in row}


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
