"""An upgrade that has no end, or a bad one: what the next command does, and what is shown."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flasher.bus.detect import DetectedAdapter, DetectionResult
from flasher.errors import ErrorCode, ExitCode
from flasher.events import Phase
from flasher.history import MOCK, Began, Ended, Flash, FlashHistory, Reached, left_open
from flasher.protocol.frame import Frame
from tests.cli.conftest import Flasher
from tests.end_to_end.stage import IMAGE, NEW, Stage
from tests.end_to_end.test_open_session import UPDATE, left_in_session, updates
from tests.loops import each

ADAPTER = "the simulated bus"
BEGAN = Began(
    "2026-05-17T10:31:02+02:00", "flash", "bms", False, ADAPTER, "a.hex", "ab", 3, None,
    again="flasher flash a.hex -t bms -i socketcan -c can0", folder="/bench",
)  # fmt: skip
ENDED = Ended("2026-05-17T10:31:09+02:00", 0, "", None, None, True, True, NEW, False, None)
BROKEN = replace(ENDED, exit_code=7, transferred=False, completed=False, running_version=None,
                 needs_rescue=True)  # fmt: skip
"""Ended, with a device that has no application."""
UNTOUCHED = replace(BROKEN, needs_rescue=False)


def kept(began: Began = BEGAN, ended: Ended | None = None, reached: Reached | None = None) -> None:
    """A flash of a program that is gone."""
    history = FlashHistory()
    name = history.begin(began)
    if reached is not None:
        history.reached(name, reached)
    if ended is not None:
        history.end(name, ended)


@pytest.fixture
def image(tmp_path: Path) -> str:
    path = tmp_path / "image.bin"
    path.write_bytes(IMAGE.data)
    return str(path)


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> Callable[[Stage], Stage]:
    """Puts a device on the bus of every adapter."""

    def on_the_bus(stage: Stage) -> Stage:
        monkeypatch.setattr("flasher.api.connect", stage.connect)
        return stage

    return on_the_bus


WORDS = ("-t", "bms", "-i", "virtual")


# -- which upgrades count --------------------------------------------------------------------------


@pytest.mark.slow
@each("command", ["flash", "rescue"])
@each("ended", [None, BROKEN])
def test_an_upgrade_without_an_end_or_with_a_bad_one_is_finished_by_the_same_command(
    flasher: Flasher,
    put: Callable[[Stage], Stage],
    image: str,
    command: str,
    ended: Ended | None,
) -> None:
    stage = put(left_in_session())
    kept(ended=ended)
    run = flasher(command, image, *WORDS)
    assert run.code == ExitCode.OK, run.err
    assert "a.hex has no end" in run.err or "a.hex left the device without" in run.err
    assert "in an open session, and gets an update command" in run.err
    assert "power-cycle" not in run.err
    assert "boot version: not announced: it sat in an open session" in run.out
    assert stage.has == IMAGE.data
    flashes, _ = FlashHistory().flashes()
    assert left_open(flashes, target="bms", adapter=ADAPTER) is None, "a good one ends it"


def test_json_has_it_as_an_event_and_in_the_outcome(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    put(left_in_session())
    kept()
    run = flasher("flash", image, *WORDS, "--json", "--events")
    lines = [line for line in run.out.splitlines() if "UpgradeLeftOpen" in line]
    assert len(lines) == 1
    assert '"has_end": false' in lines[0]
    assert '"reason": "boot_silent"' in run.out
    assert '"sent_into_silence": true' in run.out


def elsewhere(**changes: Any) -> Callable[[], None]:
    return lambda: kept(replace(BEGAN, **changes))


def healed() -> None:
    kept()
    kept(ended=ENDED)


def seen_running() -> None:
    """Nothing was upgraded, but the application had answered."""
    kept()
    kept(ended=replace(UNTOUCHED, previous_version="V1r0r0_20220512"))


@pytest.mark.slow
@each(
    "remembers",
    [
        lambda: None,
        lambda: kept(ended=UNTOUCHED),
        elsewhere(adapter="socketcan can1"),
        elsewhere(target="wmc"),
        elsewhere(adapter=MOCK, is_virtual=True),
        healed,
        seen_running,
    ],
)
def test_nothing_else_lets_an_update_command_into_silence(
    flasher: Flasher,
    put: Callable[[Stage], Stage],
    image: str,
    data_folder: Path,
    remembers: Callable[[], None],
) -> None:
    (data_folder / "flasher" / "history.jsonl").unlink(missing_ok=True)
    stage = put(left_in_session())
    remembers()
    run = flasher("flash", image, *WORDS)
    assert run.code == ExitCode.NO_ANSWER
    assert updates(stage) == 0
    assert "--in-session" in run.err


def test_a_failure_that_changed_nothing_takes_nothing_back(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    """As of a run whose adapter was not even there."""
    put(left_in_session())
    kept()
    kept(ended=UNTOUCHED)
    assert flasher("flash", image, *WORDS).code == ExitCode.OK


def test_an_upgrade_that_is_still_running_is_not_left_open(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    stage = put(left_in_session())
    history = FlashHistory()
    name = history.begin(BEGAN)
    assert flasher("flash", image, *WORDS).code == ExitCode.NO_ANSWER
    assert updates(stage) == 0
    shown = flasher("history").out
    assert "end      none yet: the flash is still running" in shown
    assert "repair" not in shown
    history.end(name, BROKEN)
    assert flasher("flash", image, *WORDS).code == ExitCode.OK


def test_the_option_needs_no_history(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    stage = put(left_in_session())
    assert flasher("flash", image, *WORDS, "--in-session").code == ExitCode.OK
    assert stage.has == IMAGE.data


def test_a_healthy_device_is_upgraded_the_normal_way(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    stage = put(Stage())
    kept()
    run = flasher("flash", image, *WORDS)
    assert run.code == ExitCode.OK
    assert "boot version: BMS V1.0.0" in run.out
    assert "sat in an open session" not in run.out
    assert stage.has == IMAGE.data


def test_a_mock_knows_of_no_upgrade_of_before(flasher: Flasher, image: str) -> None:
    kept(replace(BEGAN, adapter=MOCK))
    run = flasher("flash", image, "-t", "bms", "--mock", "--mock-speed", "0")
    assert run.code == ExitCode.OK
    assert "has no end" not in run.err


def test_an_adapter_that_was_chosen_by_default_need_not_reach_a_device_that_was_left_there(
    flasher: Flasher,
    put: Callable[[Stage], Stage],
    image: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = put(left_in_session())
    detected = DetectionResult([DetectedAdapter("virtual", "x")])
    monkeypatch.setattr("flasher.cli.adapters.detect_adapters", lambda **_: detected)
    assert flasher("flash", image, "-t", "bms").code == ExitCode.NO_ANSWER
    kept()
    run = flasher("flash", image, "-t", "bms")
    assert run.code == ExitCode.OK, run.err
    assert stage.has == IMAGE.data


def test_a_history_that_cannot_be_read_is_none(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str, data_folder: Path
) -> None:
    stage = put(Stage())
    (data_folder / "flasher" / "history.jsonl").mkdir(parents=True)
    assert flasher("flash", image, *WORDS).code == ExitCode.OK
    assert stage.has == IMAGE.data


# -- what a kill leaves ----------------------------------------------------------------------------


def test_its_begin_is_on_the_disk_before_the_first_update_command(
    flasher: Flasher,
    put: Callable[[Stage], Stage],
    image: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = put(Stage())
    synced: list[int] = []
    found: list[tuple[int, list[Flash]]] = []
    monkeypatch.setattr(os, "fsync", synced.append)

    def look(frame: Frame, _now: float) -> list[Frame]:
        if frame.data.startswith(UPDATE):
            found.append((len(synced), FlashHistory().flashes()[0]))
        return [frame]

    stage.disturb = look
    assert flasher("flash", image, *WORDS).code == ExitCode.OK
    count, (flash,) = found[0]
    assert count == 1
    assert flash.ended is None
    assert flash.is_running


def test_how_far_it_came_is_noted_and_no_later_attempt_takes_it_back() -> None:
    history = FlashHistory()
    name = history.begin(BEGAN)

    def noted(phase: Phase, packet: int = 0) -> Reached | None:
        history.reached(name, Reached(phase.value, packet))
        (flash,), _ = history.flashes()
        return flash.reached

    assert noted(Phase.RESET) is None
    assert noted(Phase.UPDATE) == Reached("update", 0)
    assert noted(Phase.TRANSFER, 1000) == Reached("transfer", 1000)
    assert noted(Phase.RESET) == noted(Phase.BOOT) == Reached("transfer", 1000)
    assert noted(Phase.TRANSFER, 7) == Reached("transfer", 7)
    history.end(name, ENDED)
    (flash,), _ = history.flashes()
    assert flash.reached is None
    assert list((history.path.parent / "running").iterdir()) == []


def test_the_packets_of_an_upgrade_are_noted(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    stage = put(Stage())
    found: list[Reached | None] = []
    stage.at_packet[4] = lambda: found.append(FlashHistory().flashes()[0][0].reached)
    assert flasher("flash", image, *WORDS).code == ExitCode.OK
    assert found == [Reached("transfer", 3)]


def test_history_names_what_is_left_and_the_command_that_ends_it(flasher: Flasher) -> None:
    kept(reached=Reached("transfer", 123))
    run = flasher("history")
    lines = run.out.splitlines()
    assert "  reached  transferring, packet 123 acknowledged" in lines
    assert any(line.startswith("  device   its application is erased") for line in lines)
    assert f"  repair   {BEGAN.again}" in lines
    assert "           (in /bench)" in lines
    document = flasher("history", "--json").document["flashes"][0]
    assert document["reached"] == {"phase": "transfer", "packet": 123}
    assert document["began"]["again"] == BEGAN.again
    kept(ended=ENDED)
    assert "repair" not in flasher("history").out


@each("exit_code", [ExitCode.TRANSFER, ExitCode.REFUSED])
def test_one_that_ended_badly_names_its_command_unless_the_image_was_refused(
    flasher: Flasher, exit_code: ExitCode
) -> None:
    kept(ended=replace(BROKEN, exit_code=int(exit_code)))
    shown = flasher("history", "--limit", "1").out
    assert (f"  repair   {BEGAN.again}" in shown) is (exit_code is ExitCode.TRANSFER)


def test_one_that_was_killed_before_it_erased_reports_it(flasher: Flasher) -> None:
    kept()
    assert "device   as far as is known it received no update" in flasher("history").out


def test_what_is_kept_to_type_again_is_what_was_typed(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    put(Stage())
    flasher("-q", "flash", image, *WORDS, "--bus-kwargs", "url=x://u:secret@h")
    (flash,), _ = FlashHistory().flashes()
    assert flash.began.again.startswith(f"flasher -q flash {image} -t bms -i virtual")
    assert "secret" not in flash.began.again
    assert flash.began.folder == str(Path.cwd())


def test_explain_last_explains_the_upgrade_that_has_no_end(flasher: Flasher) -> None:
    kept(reached=Reached("transfer", 123))
    run = flasher("explain", "--last", "--json")
    error = run.document["error"]
    assert run.code == ExitCode.USAGE
    assert error["code"] == ErrorCode.UNFINISHED
    assert error["what"] == "flash a.hex has no end, and left no bundle."
    assert "BMS on the simulated bus" in error["where"]
    assert "packet 123" in error["where"]
    assert "its application is erased" in error["remedy"]
    assert error["command"] == BEGAN.again


def test_explain_last_goes_by_which_came_later(
    flasher: Flasher, put: Callable[[Stage], Stage], image: str
) -> None:
    put(left_in_session())
    kept()
    failed = flasher("flash", image, *WORDS, "--timeout", "2")
    assert failed.code == ExitCode.NO_ANSWER
    assert flasher("explain", "--last").code == ExitCode.OK
    kept(replace(BEGAN, at="2999-01-01T00:00:00+00:00"))
    assert "has no end" in flasher("explain", "--last").err


def test_explain_last_of_a_mock_that_is_gone_asks_for_no_repair(flasher: Flasher) -> None:
    kept(replace(BEGAN, adapter=MOCK))
    run = flasher("explain", "--last", "--json")
    assert "nothing needs repair" in run.document["error"]["remedy"]
    assert run.document["error"]["command"] == ""


def test_a_history_without_unfinished_upgrades_changes_nothing(flasher: Flasher) -> None:
    kept(ended=BROKEN)
    assert "There is no bundle" in flasher("explain", "--last").err
