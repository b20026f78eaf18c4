"""A PASS whose bus trace is that of two units, or of one that restarted for no cause in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pytest

from flasher.mock.faults import AtTime, PowerCut
from flasher.protocol import catalogue
from flasher.protocol.contents import Reset, SerialNumber
from flasher.protocol.fields import WireText
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion, RequestTransfer, UpdateCommand
from flasher.protocol.spec import BMS, WMC, Command, Mode, can_id
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split
from flasher.station.records.model import (
    AFTER_RESTART,
    BY_POWER,
    POWER_CYCLES,
    Measurement,
    RunDetails,
    StepState,
)
from flasher.station.records.proof import traces_of_targets
from flasher.trace.reader import read_trace
from flasher.trace.recorder import Recorder
from tests.station.factory import BMS_VERSION, IMAGES, SERIAL, USUAL, Bench, target_table
from tests.station.traces import run_messages, transfer, version_answer, write_trace
from tests.station.unit_bench import NEW_UNIT, WRITES, UnitBench

BOOT = BootVersion("BMS", "V1.0.0").to_message(BMS.answer_id)
RESET = catalogue.encode(catalogue.BY_KEY[BMS.request_id, Command.RESET], Reset())
UPDATE = UpdateCommand("BMS_UPD", 200).to_message(BMS.request_id)
REQUEST = RequestTransfer().to_message(BMS.answer_id)
NUMBER = catalogue.encode(
    catalogue.BY_KEY[BMS.request_id, 0x4110], SerialNumber(WireText(encode_text(SERIAL, 16)))
)
QUESTION = Message(BMS.request_id, Mode.READ, Command.READ_VERSION, b"")
DATA = Message(can_id(BMS.node, None), Mode.REPORT, 0x1410, bytes(16))
"""Of an application, which does not name itself."""
BLANK = version_answer("NONE", "V1")
OWN = version_answer(SERIAL, "V1")
OTHER = version_answer("MK-2", "V1")


def frames(*reported: tuple[float, Message]) -> Iterator[tuple[float, Frame]]:
    for at_s, message in reported:
        for number, frame in enumerate(split(message.can_id, encode(message))):
            yield 1000.0 + at_s + 0.0005 * number, frame


@pytest.mark.parametrize(
    ("reported", "uncaused"),
    [
        ([(0, BLANK), (1, BOOT)], [1.001]),
        ([(0, BLANK), (1, BOOT), (1.05, BOOT), (2, BLANK), (3, BOOT)], [1.001, 3.001]),
        ([(0, BOOT), (1, BLANK)], []),
        ([(0, BOOT), (1, BOOT)], []),
        ([(0, BLANK), (1, RESET), (6, BOOT), (6.05, BOOT)], []),
        ([(0, BLANK), (1, RESET), (2, BOOT), (3, BOOT)], []),
        ([(0, BLANK), (1, RESET), (2, BOOT), (6, BOOT)], [6.001]),
        ([(0, BLANK), (1, RESET), (1.2, RESET), (2, BOOT), (3, BLANK), (4, BOOT)], [4.001]),
        ([(0, BOOT), (0.1, UPDATE), (0.15, BOOT), (0.2, REQUEST), (0.3, BOOT)], []),
        ([(0, BOOT), (0.1, UPDATE), (0.2, REQUEST), (3, BOOT), (3.05, BOOT)], [3.001]),
        ([(0, BOOT), (0.1, UPDATE), (4, BOOT)], [4.001]),
        ([(0, BOOT), (0.1, UPDATE), (0.6, BOOT)], []),
    ],
)
def test_an_announcement_without_a_cause(
    reported: list[tuple[float, Message]], uncaused: list[float]
) -> None:
    heard = traces_of_targets(["bms"], frames(*reported))["bms"]
    assert heard.restarts.uncaused == pytest.approx(uncaused, abs=1e-6)


@pytest.mark.parametrize(
    ("reported", "uncaused"),
    [
        ([(0, DATA), (1, BOOT), (1.05, BOOT), (2, OWN)], [1.001]),
        ([(0, DATA), (1, QUESTION), (1.5, QUESTION), (2, BOOT), (3, OWN)], [2.001]),
        ([(0, BOOT), (0.05, BOOT), (4, BOOT), (5, OWN)], [4.001]),
        ([(0, BOOT), (0.05, BOOT), (1, DATA), (2, BOOT), (3, OWN), (4, BOOT)], [2.001, 4.001]),
        ([(0, BOOT), (0.05, BOOT), (2, BOOT), (5, OWN)], []),
        ([(0, QUESTION), (4, BOOT), (4.05, BOOT), (5, OWN)], []),
        ([(0, DATA), (0.5, RESET), (1, BOOT), (5, BOOT), (6, OWN)], []),
    ],
    ids=[
        "of a running one", "while it is asked", "of another one in its bootloader",
        "before and after it was identified", "maybe while the computer stood still",
        "the first one", "after a reset",
    ],
)  # fmt: skip
def test_an_announcement_before_the_unit_is_identified(
    reported: list[tuple[float, Message]], uncaused: list[float]
) -> None:
    heard = traces_of_targets(["bms"], frames(*reported))["bms"]
    assert heard.restarts.uncaused == pytest.approx(uncaused, abs=1e-3)


def test_a_burst_after_the_end_of_a_transfer_has_its_cause_and_another_one_has_none() -> None:
    sent = [(0.01 * n, each) for n, each in enumerate(transfer(BMS, IMAGES[BMS]))]
    reported = [*sent, (2.0, BOOT), (2.05, BOOT)]
    assert not traces_of_targets(["bms"], frames(*reported))["bms"].restarts.uncaused
    reported += [(2.5, BLANK), (3.0, BOOT)]
    assert len(traces_of_targets(["bms"], frames(*reported))["bms"].restarts.uncaused) == 1


@pytest.mark.parametrize(
    ("reported", "changes"),
    [
        ([BLANK, BLANK], []),
        ([BLANK, NUMBER, BLANK, NUMBER, OWN, OWN], []),
        ([BLANK, OWN], ["serial number"]),
        ([BLANK, OWN, NUMBER, OWN], ["serial number"]),
        ([BLANK, OTHER, NUMBER, OWN], ["serial number"]),
        ([BLANK, NUMBER, OWN, BLANK], ["serial number"]),
    ],
)
def test_an_identity_that_changes(reported: list[Message], changes: list[str]) -> None:
    heard = traces_of_targets(["bms"], frames(*((n * 0.1, m) for n, m in enumerate(reported))))
    assert heard["bms"].changes == changes


# -- records --------------------------------------------------------------------------------------


def of_two_units(serial: str) -> Iterator[Message]:
    """Identified, then exchanged, and flashed to the end."""
    return chain(
        [version_answer(serial, "V0"), BOOT], run_messages(serial, BMS_VERSION, IMAGES[BMS])
    )


def passed(bench: Bench, measured: Measurement | None = None, text: str = "") -> RunDetails:
    """A PASS with such a trace."""
    run_id = bench.claim().run_id
    bench.work(run_id)
    measurements = () if measured is None else (measured,)
    bench.store.step(
        run_id, "restart", StepState.PASS, duration_s=1.0, text=text, measurements=measurements
    )
    trace = write_trace(bench.folder / "two.log.gz", of_two_units(SERIAL))
    bench.store.finish(run_id, bench.ending(trace=trace))
    return bench.store.read.run(run_id)


def test_records_of_such_a_run_are_reported_by_name(bench: Bench) -> None:
    run_id = passed(bench).run.run_id
    (problem,) = bench.store.examine().problems
    assert problem.where == f"run {run_id}, PASS of {SERIAL}"
    assert "announced its bootloader 0.0 s after the beginning" in problem.what


@pytest.mark.parametrize(
    ("measured", "text"),
    [
        (Measurement(AFTER_RESTART, text="continue"), ""),
        (Measurement(POWER_CYCLES, 1.0), BY_POWER),
        (None, BY_POWER),
    ],
    ids=["held by its socket", "power, counted", "power, before it was counted"],
)
def test_records_that_know_a_cause_are_not(
    bench: Bench, measured: Measurement | None, text: str
) -> None:
    passed(bench, measured, text)
    assert not bench.store.examine().problems


# -- what real runs leave -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"after_complete": "restarts"},
        {"reset_delay_s": 2.0},
        {"reset_in_bootloader": "restarts"},
    ],
    ids=str,
)
def test_nothing_speaks_against_the_trace_of_a_unit_that_stayed(
    tmp_path: Path, change: dict[str, object]
) -> None:
    profile = replace(NEW_UNIT, **change)  # type: ignore[arg-type]
    bench = UnitBench(tmp_path, USUAL + target_table(WMC) + WRITES, profile, targets=(BMS, WMC))
    with Recorder(tmp_path / "run.log") as recorder:
        bench.taps = (recorder,)
        assert bench.run().code == "OK"
    for heard in traces_of_targets(["bms", "wmc"], read_trace(tmp_path / "run.log")).values():
        assert (heard.restarts.uncaused, heard.changes) == ([], [])


def test_the_trace_of_a_unit_that_lost_its_supply_shows_it(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, 'after_restart = "continue"\n' + USUAL + WRITES)
    was_lost = False

    def look() -> bool:
        nonlocal was_lost
        if bench.device.program_count == 1 and not was_lost:
            was_lost = True
            bench.units[BMS].set(PowerCut(0.2), AtTime(bench.clock.now()))
        return False

    bench.is_cancelled = look
    with Recorder(tmp_path / "run.log") as recorder:
        bench.taps = (recorder,)
        assert bench.run().code == "OK"
    heard = traces_of_targets(["bms"], read_trace(tmp_path / "run.log"))["bms"]
    assert len(heard.restarts.uncaused) == 1
