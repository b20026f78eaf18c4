"""The run of a unit: what it does in which order, and every way in which it can end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from flasher.mock.bms import BmsApplication
from flasher.mock.faults import AtTime, PowerCut
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WMC
from flasher.settings.manifest import release_of, to_toml
from flasher.station.codes import CODES, OF_ENDING
from flasher.station.events import Progressed
from flasher.station.records.model import RunKind, RunState, StepName, StepState, Verified
from flasher.station.records.proof import traces_of_targets
from flasher.trace.reader import read_trace
from flasher.trace.recorder import Recorder
from flasher.trace.source import explain_path
from flasher.trace.story import Cause
from tests.station.factory import BMS_VERSION, IMAGES, SERIAL, USUAL, target_table
from tests.station.unit_bench import NEW_UNIT, WRITES, UnitBench

WITH_WMC = USUAL + target_table(WMC) + WRITES
UNCHANGED = '\n[[unchanged]]\ntarget = "bms"\nitem = "physical-id"\n'
LIMIT = """
[[limit]]
target = "bms"
item = "running-information"
field = "voltage_mv"
low = {low}
high = {high}
"""


def kept(bench: UnitBench, name: str) -> str:
    application = bench.device.application
    assert isinstance(application, BmsApplication)
    return application.kept[name].data().decode("ascii").split(".")[0]


# -- good units -----------------------------------------------------------------------------------


def test_a_good_unit_passes_through_every_step_in_order(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.PASS, "OK"), result.text
    assert result.verified == {"bms": Verified.VERSION}
    steps = ["connect", "identify", "check", "flash bms", "write", "restart", "verify"]
    assert bench.passed_steps == steps
    assert bench.device.stored_image == IMAGES[BMS].data
    assert (kept(bench, "serial number"), kept(bench, "user string 1")) == (
        SERIAL,
        "made 20260517",
    )


def test_the_trace_of_a_good_unit_reports_all_of_it_and_its_restart_is_no_upgrade(
    tmp_path: Path,
) -> None:
    bench = UnitBench(tmp_path)
    with Recorder(tmp_path / "run.log") as recorder:
        bench.taps = (recorder,)
        assert bench.run().outcome is RunState.PASS
    story = explain_path(tmp_path / "run.log")
    assert story.verdict.cause is Cause.COMPLETED
    assert len(story.upgrades) == 1
    heard = traces_of_targets(["bms"], read_trace(tmp_path / "run.log"))["bms"]
    assert heard.sent_sha256 == IMAGES[BMS].sha256
    assert heard.is_complete
    assert (heard.version, heard.serial, heard.written_serial) == (BMS_VERSION, SERIAL, SERIAL)


def test_what_cannot_be_taken_back_is_noted_before_and_after(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    erased_at_intent: list[int] = []
    bench.journal.on_note = lambda: erased_at_intent.append(bench.device.erase_count)
    bench.run()
    acts = [row for row in bench.journal.rows if row[0] != "step"]
    assert acts == [
        ("intent", "bms", "flash"),
        ("verified", BMS_VERSION),
        ("intent", "bms", "serial-number"),
        ("verified", SERIAL),
        ("intent", "bms", "user-string-1"),
        ("verified", "made 20260517"),
    ]
    at_intent = bench.journal.rows.index(("intent", "bms", "flash"))
    assert erased_at_intent[at_intent] == 0
    assert erased_at_intent[at_intent + 1] > 0


@pytest.mark.parametrize("notes", range(13))
def test_nothing_goes_on_when_a_note_cannot_be_saved(tmp_path: Path, notes: int) -> None:
    bench = UnitBench(tmp_path)
    bench.journal.fails_at = notes
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "RECORD_NOT_SAVED")
    assert result.verified == {}
    before_flash = bench.journal.rows.count(("intent", "bms", "flash")) == 0
    assert (bench.device.erase_count == 0) == before_flash


def test_a_target_without_a_version_query_passes_as_completed(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, WITH_WMC, targets=(BMS, WMC))
    result = bench.run()
    assert result.outcome is RunState.PASS, result.text
    assert result.verified == {"bms": Verified.VERSION, "wmc": Verified.COMPLETED}
    assert "wmc: completed, not read back" in bench.step(StepName.VERIFY).text


def test_the_memory_is_read_back_where_the_recipe_asks_for_it(tmp_path: Path) -> None:
    head, table = USUAL.split("\n[[target]]")
    text = f"{head}\n[[target]]{table}base = 0x08008000\nverify = 'memory'\n" + WRITES
    bench = UnitBench(tmp_path, text)
    result = bench.run()
    assert result.verified == {"bms": Verified.MEMORY}, result.text
    shares = [note.share for note in bench.notes if isinstance(note, Progressed)]
    assert shares[-1] == 1.0


def test_a_unit_that_has_just_been_switched_on_is_asked_when_its_bootloader_is_through(
    tmp_path: Path,
) -> None:
    bench = UnitBench(tmp_path, USUAL + WRITES + UNCHANGED)
    bench.device.power_cut(0.0)
    bench.device.power_on(0.0)
    assert bench.run().outcome is RunState.PASS
    assert "V1r0r0_20220512" in bench.step(StepName.IDENTIFY).text


# -- bad units ------------------------------------------------------------------------------------


def test_a_dead_unit_fails_with_no_answer(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.bus.detach(bench.units[BMS])
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "NO_ANSWER")
    assert bench.journal.rows[-1] == ("step", "identify", "FAIL", "NO_ANSWER")


def test_a_unit_that_stays_in_its_bootloader_after_it_confirmed_the_image_fails(
    tmp_path: Path,
) -> None:
    def lose_the_image(frame: Frame, _now: float) -> list[Frame]:
        if frame.data[4:6] == b"\xc5\x02":
            erase_the_record, *_ = bench.device.store.erasing(0)
            bench.device.store.flash.execute(erase_the_record)
        return [frame]

    profile = replace(NEW_UNIT, after_complete="restarts")
    bench = UnitBench(tmp_path, profile=profile, disturbance=lose_the_image)
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "IN_BOOTLOADER")
    assert "stays in its bootloader until an image is flashed" in result.text


def test_a_unit_that_refuses_the_image_fails(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, profile=replace(NEW_UNIT, image_checksum="crc32"))
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "REFUSED")
    assert "bootloader" in result.text


def test_other_hardware_is_not_touched(tmp_path: Path) -> None:
    text = USUAL + 'hardware_versions = ["V9*"]\n' + WRITES
    bench = UnitBench(tmp_path, text)
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "WRONG_HARDWARE")
    assert bench.device.erase_count == 0


def test_other_hardware_than_the_manifest_lists_is_not_touched(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    manifest = to_toml(release_of(IMAGES[BMS], BMS, hardware_versions=["V9*"]))
    (tmp_path / "bms.bin.toml").write_text(manifest, encoding="utf-8")
    loaded = bench.recipe.targets[0]
    release = replace(loaded.release, hardware_versions=("V9*",))
    bench.recipe = replace(bench.recipe, targets=(replace(loaded, release=release),))
    assert bench.run().code == "WRONG_HARDWARE"
    assert bench.device.erase_count == 0


def test_an_old_version_that_the_recipe_does_not_replace_fails(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + 'previous_versions = ["V1r0r3_*"]\n' + WRITES)
    assert bench.run().code == "OLD_VERSION"


def test_a_unit_that_failed_after_its_flash_may_be_done_again(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + 'previous_versions = ["V1r0r0_*"]\n' + WRITES)
    assert bench.run().code == "OK"
    again = bench.run()
    assert again.code == "OK", again.text


@pytest.mark.parametrize(("low", "high", "code"), [(1000, 60000, "OK"), (1, 2, "LIMIT")])
def test_a_measurement_is_compared_with_its_limits(
    tmp_path: Path, low: int, high: int, code: str
) -> None:
    bench = UnitBench(tmp_path, USUAL + WRITES + LIMIT.format(low=low, high=high))
    assert bench.run().code == code
    measured = {m.name: m for m in bench.step(StepName.CHECK).measurements}
    voltage = measured["bms running-information voltage_mv"]
    assert (voltage.low, voltage.high, voltage.unit) == (low, high, "mV")


def test_a_write_that_does_not_stay_fails(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    # The write of the user string never reaches the device.
    bench.device.profile = replace(NEW_UNIT, silent_queries="3A10")
    application = bench.device.application
    assert isinstance(application, BmsApplication)
    application.profile = bench.device.profile
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "WRITE_DIFFERS")


def test_what_must_not_change_is_compared(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + WRITES + UNCHANGED)
    application = bench.device.application
    assert isinstance(application, BmsApplication)
    original = application.kept["physical id"]

    def spoil() -> None:
        if ("step", "flash bms", "PASS", "") in bench.journal.rows:
            application.kept["physical id"] = type(original).from_data(b"X" * 12)

    bench.journal.on_note = spoil
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "CHANGED")


def test_what_must_not_change_but_cannot_be_read_first_is_not_risked(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + UNCHANGED)
    bench.put(MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False))
    assert bench.run().code == "UNCHANGED_UNKNOWN"
    assert bench.device.erase_count == 0


# -- labels ---------------------------------------------------------------------------------------


def test_a_unit_whose_own_number_is_not_the_label_is_not_touched(tmp_path: Path) -> None:
    profile = replace(NEW_UNIT, serial_number="W2605009")
    bench = UnitBench(tmp_path, profile=profile)
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "WRONG_UNIT")
    assert bench.device.erase_count == 0


def test_without_a_new_number_any_other_number_is_the_wrong_unit(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL)
    assert bench.run().code == "WRONG_UNIT"


def test_a_unit_in_its_bootloader_states_its_number_before_anything_is_written(
    tmp_path: Path,
) -> None:
    profile = replace(NEW_UNIT, serial_number="W2605009")
    bench = UnitBench(tmp_path)
    bench.put(MockDevice(BMS, bitrate_bps=250_000, profile=profile, has_application=False))
    assert bench.run().code == "WRONG_UNIT"
    assert ("intent", "bms", "serial-number") not in bench.journal.rows


# -- after an interruption ------------------------------------------------------------------------


def test_a_unit_left_without_an_application_is_flashed_from_the_start(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + WRITES + UNCHANGED)
    first = bench.run()
    assert first.outcome is RunState.PASS
    before = {
        m.name.removeprefix("before "): m.text or ""
        for m in bench.step(StepName.CHECK).measurements
        if m.name.startswith("before ")
    }
    bench.put(MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False))
    result = bench.run(RunKind.RECHECK, known_before=before, flashed_before=frozenset({"bms"}))
    assert result.outcome is RunState.PASS, result.text
    assert bench.journal.rows.count(("intent", "bms", "flash")) == 2


def test_a_flash_that_records_and_device_agree_on_is_not_done_again(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    assert bench.run().outcome is RunState.PASS
    result = bench.run(RunKind.RECHECK, flashed_before=frozenset({"bms"}))
    assert result.outcome is RunState.PASS, result.text
    assert bench.journal.rows.count(("intent", "bms", "flash")) == 1
    assert result.verified == {"bms": Verified.VERSION}


def test_the_device_decides_not_the_journal(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    result = bench.run(RunKind.RECHECK, flashed_before=frozenset({"bms"}))
    assert result.outcome is RunState.PASS, result.text
    assert bench.device.stored_image == IMAGES[BMS].data


# -- only verifying -------------------------------------------------------------------------------


def test_a_run_that_only_verifies_changes_nothing(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.run()
    erased = bench.device.erase_count
    written = {"bms user-string-1": "made 20260101"}
    other_day = bench.run(RunKind.VERIFY_ONLY, written_before=written)
    assert other_day.code == "WRITE_DIFFERS"
    result = bench.run(RunKind.VERIFY_ONLY)
    assert result.outcome is RunState.PASS, result.text
    assert bench.device.erase_count == erased
    skipped = [r.name for r in bench.journal.reports if r.state is StepState.SKIPPED]
    assert skipped[-3:] == ["flash bms", "write", "restart"]


def test_a_target_that_cannot_be_asked_cannot_be_verified_alone(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, WITH_WMC, targets=(BMS, WMC))
    bench.run()
    result = bench.run(RunKind.VERIFY_ONLY)
    assert (result.outcome, result.code) == (RunState.ERROR, "CANNOT_VERIFY")


def test_an_answer_that_is_compared_with_nothing_proves_nothing(tmp_path: Path) -> None:
    head, table = (USUAL + WRITES).split("sha256")
    bench = UnitBench(tmp_path, f"{head}verify = 'completed'\nsha256{table}")
    loaded = bench.recipe.targets[0]
    release = replace(loaded.release, firmware_version=None)
    unnamed = replace(loaded, image=replace(loaded.image, version=None), release=release)
    bench.recipe = replace(bench.recipe, targets=(unnamed,))
    assert bench.run().verified == {"bms": Verified.COMPLETED}
    again = bench.run(RunKind.VERIFY_ONLY)
    assert (again.outcome, again.code) == (RunState.ERROR, "CANNOT_VERIFY")


# -- time, tries, people --------------------------------------------------------------------------


def test_a_step_is_tried_as_often_as_the_recipe_states(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, USUAL + WRITES + "\n[step.identify]\ntries = 3\npause_s = 2\n")
    bench.bus.detach(bench.units[BMS])
    began = bench.clock.now()
    assert bench.run().code == "NO_ANSWER"
    tries = [r.try_number for r in bench.journal.reports if r.step is StepName.IDENTIFY]
    assert tries == [1, 2, 3]
    assert bench.clock.now() - began > 4.0


def test_a_step_that_takes_too_long_fails(tmp_path: Path) -> None:
    text = USUAL + WRITES + "\n[step.flash]\ntime_limit_s = 0.3\n"
    bench = UnitBench(tmp_path, text, profile=replace(NEW_UNIT, erase_time_s=5.0))
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "TOO_SLOW")
    duration = bench.step(StepName.FLASH, "bms").measurements[-1]
    assert (duration.name, duration.high) == ("duration", 0.3)


def test_a_person_stops_the_run_and_learns_what_is_left(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.is_cancelled = lambda: bench.device.program_count >= 1
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ABORTED, "OPERATOR_ABORT")


def test_an_unplugged_adapter_is_the_stations_fault(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.journal.on_note = lambda: bench.bus.unplug() if len(bench.journal.rows) == 4 else None
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "BUS")


def test_a_second_tool_is_the_stations_fault(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    tool = bench.bus.link()
    sent = False

    def speak() -> bool:
        nonlocal sent
        if bench.device.erase_count and not sent:
            sent = True
            tool.send(Frame(BMS.request_id, bytes.fromhex("55AA160B42055245")))
        return False

    bench.is_cancelled = speak
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "SECOND_TOOL")


class SwitchedPower:
    """Power of the bench's unit."""

    def __init__(self, bench: UnitBench) -> None:
        self._bench = bench
        self.cycles = 0

    def begin_cycle(self) -> None:
        self.cycles += 1
        self._bench.units[BMS].set(PowerCut(1.0), AtTime(self._bench.clock.now()))

    def check(self) -> None:
        pass


def test_a_silent_unit_is_reached_by_its_power(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.power = power = SwitchedPower(bench)
    bench.device.power_cut(0.0)
    result = bench.run()
    assert result.outcome is RunState.PASS, result.text
    assert power.cycles == 2  # to reach it, and as its restart
    assert bench.step(StepName.RESTART).text == "by power"


@pytest.mark.parametrize("has_card", [False, True])
def test_a_silent_unit_without_application_is_flashed_only_with_the_card_of_its_socket(
    tmp_path: Path, has_card: bool
) -> None:
    bench = UnitBench(tmp_path)
    bench.power = SwitchedPower(bench)
    device = MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False)
    device.power_cut(0.0)
    bench.put(device)
    result = bench.run(has_card=has_card)
    assert result.code == ("OK" if has_card else "NO_CARD"), result.text
    assert (device.operations_done > 0) == has_card


# -- codes ----------------------------------------------------------------------------------------


def test_every_code_gives_the_operator_one_thing_to_do() -> None:
    for code in CODES.values():
        assert code.action.endswith(".")
        assert code.meaning
        assert code.name == code.name.upper()
    assert set(OF_ENDING.values()) <= set(CODES.values())
