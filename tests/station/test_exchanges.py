"""A run belongs to one unit: units that change places while it goes on, and one that stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.image.image import Image
from flasher.mock.bms import BmsApplication
from flasher.mock.faults import AtTime, PowerCut
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, WMC, Target
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.settings.manifest import release_of
from flasher.station.events import OperatorPrompted
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import RunKind, RunResult, RunState, StepName
from tests.station.factory import BMS_VERSION, HEAD, SERIAL_NUMBER, USUAL, target_table
from tests.station.unit_bench import NEW_UNIT, WRITES, UnitBench

BLANK = ("NONE", "NONE")
OF_MAKER = ("MK-00001", "MK-00002")
BOTH_KINDS = pytest.mark.parametrize("numbers", [BLANK, OF_MAKER], ids=["blank", "maker"])
BOTH_GAPS = pytest.mark.parametrize("gap_s", [0.5, 3.5])
ONLY_WMC = HEAD + SERIAL_NUMBER + target_table(WMC)
TWO_TARGETS = USUAL + target_table(WMC) + WRITES
CONTINUE = 'after_restart = "continue"\n'
PACKETS = 20


def with_larger_image(recipe: LoadedRecipe) -> LoadedRecipe:
    """The recipe with 20 packets for its first target."""
    loaded, *others = recipe.targets
    image = Image.from_bytes(loaded.image.data.ljust(PACKETS * 128, b"\0"))
    image = replace(image, version=loaded.image.version)
    release = release_of(image, loaded.target)
    return replace(recipe, targets=(replace(loaded, image=image, release=release), *others))


class Exchange:
    """A bench whose first unit is pulled when `when()` becomes true, and another one put in after
    `gap_s`.
    """

    def __init__(
        self,
        folder: Path,
        numbers: tuple[str, str] = BLANK,
        *,
        text: str = USUAL + WRITES,
        target: Target = BMS,
        gap_s: float = 0.5,
        first: DeviceProfile = NEW_UNIT,
        second: DeviceProfile = NEW_UNIT,
        is_announced: bool = True,
    ) -> None:
        first = replace(first, serial_number=numbers[0])
        second = replace(second, serial_number=numbers[1])
        self.bench = UnitBench(folder, text, first, targets=(target,))
        self.bench.recipe = with_larger_image(self.bench.recipe)
        self.target = target
        self.gap_s = gap_s
        self.first = self.bench.device
        self.second = MockDevice(target, bitrate_bps=WELLING.bitrate_bps, profile=second)
        self.is_announced = is_announced
        if is_announced:
            self.second.power_cut(0.0)
        self.when: Callable[[], bool] = lambda: False
        self.pulled_at: float | None = None
        self.is_done = False
        self.bench.is_cancelled = self.look

    def look(self) -> bool:
        """What happens beside the run, as time goes on."""
        now = self.bench.clock.now()
        if self.pulled_at is None and self.when():
            self.pulled_at = now
            self.bench.bus.detach(self.bench.units.pop(self.target))
        if self.pulled_at is not None and not self.is_done and now >= self.pulled_at + self.gap_s:
            self.is_done = True
            if self.is_announced:
                self.second.power_on(now)
            self.bench.put(self.second)
        return False

    def at_note(self, *note: str) -> None:
        """Pull the first unit as soon as the records have this."""
        self.when = lambda: note in self.bench.journal.rows
        self.bench.journal.on_note = self._look_on

    def _look_on(self) -> None:
        self.look()

    def while_the_record_is_saved(self, *note: str) -> None:
        """The same, and saving takes time: the run receives nothing meanwhile."""
        self.at_note(*note)

        def save_slowly() -> None:
            if note != self.bench.journal.rows[-1]:
                return
            clock = self.bench.clock
            self.look()
            for wait_s in (self.gap_s, 1.5):
                until = clock.now() + wait_s
                while clock.now() < until:
                    self.bench.bus.advance(until)
                self.look()

        self.bench.journal.on_note = save_slowly

    def at_share(self, share: float) -> None:
        """Pull the first unit when so much of its image is stored."""
        self.when = lambda: self.first.program_count >= share * PACKETS

    def check_caught(self, *, is_untouched: bool = True) -> RunResult:
        """The run ends for this, and the second unit is as it was."""
        result = self.bench.run()
        assert (result.outcome, result.code) == (RunState.ERROR, "UNIT_CHANGED"), result
        assert result.verified == {}
        assert self.is_done or self.gap_s > 2
        if is_untouched:
            self.check_untouched()
        return result

    def check_untouched(self) -> None:
        assert (self.second.erase_count, self.second.program_count) == (0, 0)
        if self.target is BMS:
            assert self.kept("serial number") == self.second.profile.serial_number
            assert self.kept("user string 1") == ""

    def kept(self, name: str) -> str:
        application = self.second.application
        assert isinstance(application, BmsApplication)
        return application.kept[name].data().decode("ascii").split(".")[0]


# -- units that change places ---------------------------------------------------------------------


@pytest.mark.slow
@BOTH_KINDS
@BOTH_GAPS
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_unit_that_is_exchanged_while_it_is_flashed(
    tmp_path: Path, numbers: tuple[str, str], gap_s: float, share: float
) -> None:
    world = Exchange(tmp_path, numbers, gap_s=gap_s)
    world.at_share(share)
    result = world.check_caught()
    assert "its application is erased, half written or not accepted" in result.text, (
        "the first one is left so"
    )


@pytest.mark.slow
@BOTH_GAPS
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_a_controller_that_is_exchanged_while_it_is_flashed(
    tmp_path: Path, gap_s: float, share: float
) -> None:
    world = Exchange(tmp_path, text=ONLY_WMC, target=WMC, gap_s=gap_s)
    world.at_share(share)
    world.check_caught()


@BOTH_GAPS
@pytest.mark.parametrize("tries", [1, 3])
def test_a_unit_whose_announcement_is_not_received_in_the_transfer(
    tmp_path: Path, gap_s: float, tries: int
) -> None:
    """Its contacts closed late: its application runs, where the first one has none."""
    text = f"{USUAL}{WRITES}\n[step.flash]\ntries = {tries}\n"
    world = Exchange(tmp_path, text=text, gap_s=gap_s, is_announced=False)
    world.at_share(0.5)
    result = world.check_caught()
    assert "runs an application in the middle of its transfer" in result.text


BETWEEN = [
    ("step", "identify", "PASS", ""),
    ("step", "check", "PASS", ""),
    ("intent", "bms", "flash"),
    ("step", "flash bms", "PASS", ""),
    ("intent", "bms", "serial-number"),
    ("intent", "bms", "user-string-1"),
    ("step", "write", "PASS", ""),
    ("step", "restart", "PASS", ""),
]


@pytest.mark.slow
@BOTH_KINDS
@pytest.mark.parametrize("gap_s", [0.5, 3.5])
@pytest.mark.parametrize("note", BETWEEN, ids=" ".join)
def test_a_unit_that_is_exchanged_between_two_steps(
    tmp_path: Path, numbers: tuple[str, str], gap_s: float, note: tuple[str, ...]
) -> None:
    """The second one runs the new version already: only who it is tells them apart."""
    second = replace(NEW_UNIT, factory_version=BMS_VERSION)
    world = Exchange(tmp_path, numbers, gap_s=gap_s, second=second)
    world.at_note(*note)
    world.check_caught()


def test_a_write_is_not_repeated_to_the_unit_that_came_meanwhile(tmp_path: Path) -> None:
    world = Exchange(tmp_path, gap_s=0.15)
    begun = bytes.fromhex("55AA16124110")

    # A person does not end a write, so `cancelled` is not asked: the exchange is looked after as
    # the write is sent, and repeated.
    def look(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001
        if sent and frame.data.startswith(begun):
            world.when = lambda: True
            world.look()

    world.bench.taps = (look,)
    world.check_caught()
    assert world.is_done


@pytest.mark.slow
@pytest.mark.parametrize(("numbers", "gap_s"), [(BLANK, 3.5), (OF_MAKER, 3.5), (OF_MAKER, 0.3)])
@pytest.mark.parametrize("note", BETWEEN, ids=" ".join)
def test_a_unit_that_keeps_its_supply_and_announces_nothing(
    tmp_path: Path, numbers: tuple[str, str], gap_s: float, note: tuple[str, ...]
) -> None:
    """It is another one by its number, or because nothing answered for a while."""
    second = replace(NEW_UNIT, factory_version=BMS_VERSION)
    world = Exchange(tmp_path, numbers, gap_s=gap_s, second=second, is_announced=False)
    world.at_note(*note)
    world.check_caught()


@pytest.mark.parametrize("gap_s", [0.3, 60.0])
def test_a_unit_that_is_exchanged_at_once_or_much_later(tmp_path: Path, gap_s: float) -> None:
    world = Exchange(tmp_path, gap_s=gap_s, second=replace(NEW_UNIT, factory_version=BMS_VERSION))
    world.at_note("step", "flash bms", "PASS", "")
    world.check_caught()


@pytest.mark.slow
@pytest.mark.parametrize("note", BETWEEN, ids=" ".join)
def test_a_unit_that_is_exchanged_while_no_one_listens(
    tmp_path: Path, note: tuple[str, ...]
) -> None:
    second = replace(NEW_UNIT, factory_version=BMS_VERSION)
    world = Exchange(tmp_path, second=second)
    world.while_the_record_is_saved(*note)
    world.check_caught()


@BOTH_KINDS
def test_a_unit_that_is_exchanged_while_the_run_waits_for_another_try(
    tmp_path: Path, numbers: tuple[str, str]
) -> None:
    """Long after the pause has begun: there is no other reason to ask."""
    limit = '\n[[limit]]\ntarget = "bms"\nitem = "running-information"\nfield = "voltage_mv"\n'
    text = f"{USUAL}{WRITES}{limit}low = 1\nhigh = 2\n[step.check]\ntries = 3\npause_s = 60\n"
    world = Exchange(tmp_path, numbers, text=text, gap_s=20)
    world.when = lambda: world.bench.clock.now() > 30
    world.check_caught(is_untouched=False)
    assert 30 < world.bench.clock.now() < 40


def lose_power_once(bench: UnitBench, off_s: float) -> None:
    """In the middle of the transfer."""
    bench.recipe = with_larger_image(bench.recipe)
    was_lost = False

    def look() -> bool:
        nonlocal was_lost
        if bench.device.program_count == PACKETS // 2 and not was_lost:
            was_lost = True
            bench.units[BMS].set(PowerCut(off_s), AtTime(bench.clock.now()))
        return False

    bench.is_cancelled = look


def test_the_power_of_one_unit_that_fails_is_no_different(tmp_path: Path) -> None:
    """It is the same one, but that cannot be known."""
    bench = UnitBench(tmp_path)
    lose_power_once(bench, 1.0)
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "UNIT_CHANGED"), result


@pytest.mark.parametrize("has_application", [True, False])
def test_units_in_their_bootloaders_that_change_places(
    tmp_path: Path, *, has_application: bool
) -> None:
    """The first one cannot be identified; that another one came is noticed all the same."""
    world = Exchange(tmp_path)
    first = MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False)
    world.bench.put(first)
    if not has_application:
        second = MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False)
        second.power_cut(0.0)
        world.second = second
    world.when = lambda: first.program_count > PACKETS // 2
    world.check_caught()


# -- at the moment of the run's own restart -------------------------------------------------------


@pytest.mark.parametrize("step", ["flash bms", "restart"])
@pytest.mark.parametrize("gap_s", [0.3, 1.0])
def test_a_burst_too_many_around_an_own_restart(tmp_path: Path, gap_s: float, step: str) -> None:
    """The first unit announces itself as it should, and then the second one does."""
    world = Exchange(tmp_path, gap_s=gap_s, second=replace(NEW_UNIT, factory_version=BMS_VERSION))
    before = {"flash bms": 0, "restart": 1}[step]
    resets = 0
    was_announcing = False

    def announces() -> bool:
        nonlocal resets, was_announcing
        is_announcing = world.first.state.value == "announcing"
        resets += was_announcing and not is_announcing
        was_announcing = is_announcing
        return resets > before

    world.when = announces
    world.check_caught()


@pytest.mark.slow
@BOTH_KINDS
@pytest.mark.parametrize("gap_s", [0.3, 1.0, 3.5, 8.0])
@pytest.mark.parametrize("resets", [0, 1], ids=["before the flash", "after the writes"])
def test_a_reset_that_the_first_unit_did_not_receive(
    tmp_path: Path, numbers: tuple[str, str], gap_s: float, resets: int
) -> None:
    """It is pulled just then, and what follows is the announcement of the second one."""
    second = replace(NEW_UNIT, factory_version=BMS_VERSION)
    world = Exchange(tmp_path, numbers, gap_s=gap_s, second=second)
    seen = 0

    def see(frame: Frame, *, sent: bool, now: float) -> None:  # noqa: ARG001  a tap
        nonlocal seen
        seen += sent and frame.can_id == BMS.request_id and frame.data[4:6] == b"\x42\x05"

    world.bench.taps = (see,)
    world.when = lambda: seen > resets
    world.check_caught()


@BOTH_KINDS
@pytest.mark.parametrize("gap_s", [0.3, 1.0, 3.5])
def test_a_unit_that_is_pulled_before_it_confirms_its_image(
    tmp_path: Path, numbers: tuple[str, str], gap_s: float
) -> None:
    """The second one runs the new version already, as the first one would."""
    first = replace(NEW_UNIT, program_time_s=0.25)
    second = replace(NEW_UNIT, factory_version=BMS_VERSION)
    world = Exchange(tmp_path, numbers, gap_s=gap_s, first=first, second=second)
    world.when = lambda: world.first.state.value == "checking"
    world.check_caught()


@pytest.mark.parametrize("reset_delay_s", [0.0, 0.1])
def test_a_confirmation_of_the_reset_may_be_lost(tmp_path: Path, reset_delay_s: float) -> None:
    """A restart that follows so soon is that of the same unit."""
    lost = 0

    def lose(frame: Frame, _now: float) -> tuple[Frame, ...]:
        nonlocal lost
        is_feedback = frame.can_id == BMS.answer_id and frame.data[4:6] == b"\x55\x03"
        is_lost = is_feedback and lost < 1
        lost += is_lost
        return () if is_lost else (frame,)

    profile = replace(NEW_UNIT, reset_delay_s=reset_delay_s)
    bench = UnitBench(tmp_path, profile=profile, disturbance=lose)
    result = bench.run()
    assert lost
    assert result.outcome is RunState.PASS, result


@pytest.mark.parametrize(
    ("numbers", "change"),
    [
        (OF_MAKER, {}),
        (("MK-00001", ""), {}),
        (("", "MK-00002"), {}),
        (BLANK, {"hardware_version": "V1r3r0_20220512"}),
        (BLANK, {"model": "BM48"}),
    ],
    ids=["number", "number gone", "number come", "hardware", "model"],
)
def test_another_identity_after_a_restart_at_the_very_moment_of_the_exchange(
    tmp_path: Path, numbers: tuple[str, str], change: dict[str, str]
) -> None:
    """The reset reaches the first unit, and the announcement is that of the second one: it is
    flashed, but gets no number of the label's, and does not pass.
    """
    second = replace(NEW_UNIT, factory_version=BMS_VERSION, **change)  # type: ignore[arg-type]
    world = Exchange(tmp_path, numbers, gap_s=0.02, second=second)
    world.when = lambda: world.first.state.value == "restarting"
    world.check_caught(is_untouched=False)
    assert world.kept("serial number") == numbers[1]


def test_another_bootloader_after_the_second_restart(tmp_path: Path) -> None:
    first = replace(NEW_UNIT, boot_version="V1.0.0")
    second = replace(NEW_UNIT, factory_version=BMS_VERSION, boot_version="V1.0.1")
    world = Exchange(tmp_path, gap_s=0.02, first=first, second=second)

    def restarts() -> bool:
        has_written = ("step", "write", "PASS", "") in world.bench.journal.rows
        return has_written and world.first.state.value == "restarting"

    world.when = restarts
    result = world.check_caught()
    assert "V1.0.0 before, and V1.0.1 now" in result.text


@pytest.mark.slow
@pytest.mark.parametrize("pulled_after_s", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("gap_s", [0.3, 1.0, 3.5])
def test_a_unit_that_comes_while_the_one_in_its_bootloader_is_erased(
    tmp_path: Path, gap_s: float, pulled_after_s: float
) -> None:
    """The first one ignored the reset, which is no cause for the announcement of the second one."""
    world = Exchange(tmp_path, gap_s=gap_s)
    profile = replace(NEW_UNIT, erase_time_s=1.0)
    first = MockDevice(BMS, bitrate_bps=250_000, profile=profile, has_application=False)
    world.bench.put(first)
    began_at = None

    def when() -> bool:
        nonlocal began_at
        if began_at is None and first.state.value == "erasing":
            began_at = world.bench.clock.now()
        return began_at is not None and world.bench.clock.now() > began_at + pulled_after_s

    world.when = when
    world.check_caught()


def test_a_blank_unit_exactly_alike_at_the_very_moment_cannot_be_distinguished_from_the_first(
    tmp_path: Path,
) -> None:
    """The limit that the documents name."""
    world = Exchange(tmp_path, gap_s=0.02)
    world.when = lambda: world.first.state.value == "restarting"
    assert world.bench.run().outcome is RunState.PASS
    assert world.second.erase_count


# -- one session ----------------------------------------------------------------------------------


def test_a_device_that_falls_silent_in_its_transfer_is_not_reset(tmp_path: Path) -> None:
    world = Exchange(tmp_path, gap_s=60, text=USUAL + WRITES + "\n[step.flash]\ntries = 3\n")
    world.at_share(0.5)
    result = world.bench.run()
    assert (result.outcome, result.code) == (RunState.FAIL, "TRANSFER_FAILED"), result
    tries = [each for each in world.bench.journal.reports if each.step is StepName.FLASH]
    assert len(tries) == 1


@pytest.mark.parametrize("tries", [1, 2])
def test_a_unit_that_was_not_erased_states_who_it_is_and_may_be_tried_again(
    tmp_path: Path, tries: int
) -> None:
    """It did not receive the update command, and has started its application."""
    lost = 0

    def lose(frame: Frame, _now: float) -> tuple[Frame, ...]:
        nonlocal lost
        is_announcing = frame.can_id == BMS.answer_id and frame.data[4:6] == b"\xc1\x09"
        is_update = frame.can_id == BMS.request_id and frame.data[4:6] == b"\xa1\x0b"
        is_lost = (is_update and lost == 0) or (is_announcing and lost in range(1, 4))
        lost += is_lost
        return () if is_lost else (frame,)

    text = f"{USUAL}{WRITES}\n[step.flash]\ntries = {tries}\n"
    bench = UnitBench(tmp_path, text, disturbance=lose)
    result = bench.run()
    assert lost == 4
    assert result.code == ("OK" if tries > 1 else "ERASE_FAILED"), result


def test_an_adapter_that_is_lost_in_the_transfer_may_come_back(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.recipe = with_larger_image(bench.recipe)
    was_lost = False

    def look() -> bool:
        nonlocal was_lost
        if bench.device.program_count == PACKETS // 2 and not was_lost:
            was_lost = True
            bench.bus.unplug(0.5)
        return False

    bench.is_cancelled = look
    result = bench.run()
    assert was_lost
    assert result.outcome is RunState.PASS, result
    assert "unobserved for" in bench.step(StepName.FLASH, "bms").text


def test_a_unit_that_is_exchanged_while_the_adapter_is_away_is_not_gone_on_with(
    tmp_path: Path,
) -> None:
    world = Exchange(tmp_path, second=replace(NEW_UNIT, factory_version=BMS_VERSION), gap_s=0.1)
    was_lost = False

    def lose() -> bool:
        nonlocal was_lost
        if world.first.program_count >= PACKETS // 2 and not was_lost:
            was_lost = True
            world.bench.bus.unplug(3.0)
        return was_lost

    world.when = lose
    world.check_caught()


@pytest.mark.parametrize("is_held", [False, True], ids=["end", "continue"])
def test_who_holds_the_unit_may_go_on_after_a_restart(tmp_path: Path, is_held: bool) -> None:
    bench = UnitBench(tmp_path, (CONTINUE if is_held else "") + USUAL + WRITES)
    lose_power_once(bench, 0.2)
    result = bench.run()
    assert result.code == ("OK" if is_held else "UNIT_CHANGED"), result
    if is_held:
        measured = {m.name: m.text for m in bench.step(StepName.IDENTIFY).measurements}
        assert measured["after restart"] == "continue"
        measured = {m.name: m.text for m in bench.step(StepName.VERIFY).measurements}
        assert measured["bms continuity"] == "not observed"


def test_another_identity_ends_the_run_even_where_the_unit_is_held(tmp_path: Path) -> None:
    world = Exchange(tmp_path, OF_MAKER, text=CONTINUE + USUAL + WRITES)
    world.at_note("step", "flash bms", "PASS", "")
    world.check_caught()


@pytest.mark.parametrize("is_held", [False, True], ids=["end", "continue"])
def test_only_where_the_unit_is_held_a_person_is_asked_to_switch_it(
    tmp_path: Path, is_held: bool
) -> None:
    bench = UnitBench(tmp_path, (CONTINUE if is_held else "") + USUAL + WRITES)
    bench.device.power_cut(0.0)

    def switch_on() -> bool:
        is_asked = any(isinstance(note, OperatorPrompted) for note in bench.notes)
        if is_asked and not bench.device.has_power:
            bench.device.power_on(bench.clock.now())
        return False

    bench.is_cancelled = switch_on
    result = bench.run(RunKind.RECHECK)
    assert result.code == ("OK" if is_held else "NO_ANSWER"), result.text


def test_a_battery_that_bears_another_label_costs_nothing_but_its_own_flash(tmp_path: Path) -> None:
    """In its bootloader it could not say so; after its flash it does, and the controller beside it
    is not touched.
    """
    bench = UnitBench(tmp_path, USUAL + target_table(WMC), targets=(BMS, WMC))
    bench.put(without_application(serial_number="W2605009"))
    result = bench.run()
    assert (result.outcome, result.code) == (RunState.ERROR, "WRONG_UNIT"), result
    assert bench.units[WMC].device.erase_count == 0


# -- what is recorded -----------------------------------------------------------------------------


def test_the_record_of_a_unit_that_stayed_states_it(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path, TWO_TARGETS, targets=(BMS, WMC))
    result = bench.run()
    assert result.outcome is RunState.PASS, result
    measured = {m.name: m.text for m in bench.step(StepName.VERIFY).measurements}
    assert measured["bms continuity"] == "observed"
    assert measured["wmc continuity"] == "not observed"


def test_a_unit_in_its_bootloader_is_not_identified_before_flashing(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.put(MockDevice(BMS, bitrate_bps=250_000, profile=NEW_UNIT, has_application=False))
    assert bench.run().outcome is RunState.PASS
    identified = bench.step(StepName.IDENTIFY)
    assert identified.text == "bms: in its bootloader V1.0.0, not identified before flashing"
    measured = {m.name: m.text for m in identified.measurements}
    assert measured == {"bms identity": "not identified before flashing"}


@pytest.mark.parametrize("is_supplied", [True, False])
def test_a_controller_may_restart_while_the_battery_does(
    tmp_path: Path, *, is_supplied: bool
) -> None:
    """The battery supplies it. Later, another one may have come."""
    text = HEAD + SERIAL_NUMBER + target_table(WMC) + target_table(BMS) + WRITES
    bench = UnitBench(tmp_path, text, targets=(WMC, BMS))
    battery = bench.units[BMS].device
    was_cut = False

    def wait(wait_s: float) -> None:
        until = bench.clock.now() + wait_s
        while bench.clock.now() < until:
            bench.bus.advance(until)

    def look() -> bool:
        nonlocal was_cut
        is_over = ("step", "write", "PASS", "") in bench.journal.rows
        if not was_cut and (battery.program_count > 0 if is_supplied else is_over):
            was_cut = True
            bench.units[WMC].set(PowerCut(0.1), AtTime(bench.clock.now()))
        return False

    def save() -> None:
        if not is_supplied:
            wait(6.0)
            look()
            wait(1.0)

    bench.is_cancelled = look
    bench.journal.on_note = save
    result = bench.run()
    assert was_cut
    assert result.code == ("OK" if is_supplied else "UNIT_CHANGED"), result


# -- a unit that stays ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"reset_delay_s": 3.0},
        {"reset_in_bootloader": "restarts"},
        {"after_complete": "restarts"},
        {"after_complete": "restarts", "start_delay_s": 3.0, "reset_delay_s": 1.0},
        {"window_s": 2.0},
        {"reset_in_transfer": "restarts"},
        {"upgrade_in_application": "silence"},
        {"faults": 1},
        {"erase_time_s": 1.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("text", [USUAL + WRITES, TWO_TARGETS], ids=["bms", "bms and wmc"])
def test_a_unit_that_stays_passes(tmp_path: Path, text: str, change: dict[str, object]) -> None:
    profile = replace(NEW_UNIT, **change)  # type: ignore[arg-type]
    targets = (BMS, WMC) if text is TWO_TARGETS else (BMS,)
    bench = UnitBench(tmp_path, text, profile, targets=targets)
    bench.recipe = with_larger_image(bench.recipe)
    result = bench.run()
    assert result.outcome is RunState.PASS, result


@pytest.mark.slow
@pytest.mark.parametrize("reset_delay_s", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("reset", ["ignored", "restarts"])
@pytest.mark.parametrize("has_application", [True, False])
def test_a_unit_that_stays_passes_however_long_the_records_take(
    tmp_path: Path, *, has_application: bool, reset: str, reset_delay_s: float
) -> None:
    """One without an application announces itself all the time."""
    profile = replace(NEW_UNIT, reset_in_bootloader=reset, reset_delay_s=reset_delay_s)  # type: ignore[arg-type]
    bench = UnitBench(tmp_path)
    bench.put(
        MockDevice(BMS, bitrate_bps=250_000, profile=profile, has_application=has_application)
    )

    bench.save_slowly(2.0, listens=True)
    result = bench.run()
    assert result.outcome is RunState.PASS, result


def without_application(**profile: object) -> MockDevice:
    profile_of_it = replace(NEW_UNIT, **profile)  # type: ignore[arg-type]
    return MockDevice(BMS, bitrate_bps=250_000, profile=profile_of_it, has_application=False)


@pytest.mark.slow
@pytest.mark.parametrize("stall_s", [0.1, 0.14, 0.16, 0.2, 0.23, 0.24])
@pytest.mark.parametrize("kind", [RunKind.PRODUCTION, RunKind.RECHECK])
def test_a_computer_that_stalls_for_a_moment_is_no_pause_of_a_bootloader(
    tmp_path: Path, kind: RunKind, stall_s: float
) -> None:
    bench = UnitBench(tmp_path)
    bench.put(without_application())
    bench.save_slowly(stall_s, listens=False)
    result = bench.run(kind)
    assert result.outcome is RunState.PASS, result


@pytest.mark.slow
@pytest.mark.parametrize("stall_s", [0.4, 1.0, 10.0])
@pytest.mark.parametrize("reset", ["ignored", "restarts"])
@pytest.mark.parametrize("has_application", [True, False])
def test_what_a_computer_that_stalls_did_not_see_does_not_accuse_the_unit(
    tmp_path: Path, *, has_application: bool, reset: str, stall_s: float
) -> None:
    """An application says who it is; a bootloader could be another one."""
    bench = UnitBench(tmp_path)
    profile = replace(NEW_UNIT, reset_in_bootloader=reset)  # type: ignore[arg-type]
    bench.put(
        MockDevice(BMS, bitrate_bps=250_000, profile=profile, has_application=has_application)
    )
    bench.save_slowly(stall_s, listens=False)
    result = bench.run()
    assert result.code == ("OK" if has_application else "NOT_OBSERVED"), result
    if not has_application:
        assert f"did not listen to the bms for {stall_s:.1f} s" in result.text
        assert bench.device.erase_count == 0
        bench.journal.on_note = lambda: None
        assert bench.run().code == "OK"


@pytest.mark.slow
@pytest.mark.parametrize("gap_s", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("note", BETWEEN[:3], ids=" ".join)
def test_units_in_their_bootloaders_that_change_places_while_no_one_listens(
    tmp_path: Path, note: tuple[str, ...], gap_s: float
) -> None:
    """Nothing shows another one, but nothing shows that it is the same."""
    world = Exchange(tmp_path, gap_s=gap_s)
    world.bench.put(without_application())
    world.second = without_application()
    world.second.power_cut(0.0)
    world.while_the_record_is_saved(*note)
    result = world.bench.run()
    assert result.code == "NOT_OBSERVED", result
    world.check_untouched()


def test_a_unit_that_is_exchanged_after_the_reset_while_no_one_listens(tmp_path: Path) -> None:
    world = Exchange(tmp_path, gap_s=0.3)
    bench, stalls = world.bench, 0

    def stand_still_after_the_reset(frame: Frame, *, sent: bool, now: float) -> None:
        nonlocal stalls
        is_feedback = frame.can_id == BMS.answer_id and frame.data[4:6] == b"\x55\x03"
        if sent or stalls or not is_feedback:
            return
        stalls, until = 1, now + 1.0
        world.when = lambda: True
        while bench.clock.now() < until:
            bench.bus.advance(min(until, bench.clock.now() + 0.01))
            world.look()

    bench.taps = (stand_still_after_the_reset,)
    result = bench.run()
    assert stalls
    assert result.code == "NOT_OBSERVED", result
    world.check_untouched()


@pytest.mark.parametrize("spacing_s", [0.2, 0.4, 0.9])
def test_a_bootloader_may_announce_itself_at_a_pace_of_its_own(
    tmp_path: Path, spacing_s: float
) -> None:
    bench = UnitBench(tmp_path)
    timings = replace(DEFAULT_TIMINGS, boot_version_spacing_s=spacing_s)
    bench.put(
        MockDevice(
            BMS, bitrate_bps=250_000, profile=NEW_UNIT, timings=timings, has_application=False
        )
    )
    result = bench.run()
    assert result.outcome is RunState.PASS, result


@pytest.mark.slow
@pytest.mark.parametrize("gap_s", [0.3, 1.0, 3.5])
@pytest.mark.parametrize("pulled_after_s", [0.0, 0.02, 0.05, 0.1, 0.15, 0.2])
def test_a_unit_in_its_bootloader_that_is_exchanged_as_its_flash_begins(
    tmp_path: Path, pulled_after_s: float, gap_s: float
) -> None:
    """It is not reset, so that no announcement after a pause is its own."""
    world = Exchange(tmp_path, gap_s=gap_s)
    world.bench.put(without_application())
    begins_at: list[float] = []

    def is_time() -> bool:
        now = world.bench.clock.now()
        if ("intent", "bms", "flash") in world.bench.journal.rows:
            begins_at.append(now)
        return bool(begins_at) and now >= begins_at[0] + pulled_after_s

    world.when = is_time
    world.check_caught()


def test_a_unit_in_its_bootloader_is_flashed_without_a_prompt(tmp_path: Path) -> None:
    bench = UnitBench(tmp_path)
    bench.put(without_application())
    resets: list[float] = []

    def see(frame: Frame, *, sent: bool, now: float) -> None:
        if sent and frame.can_id == BMS.request_id and frame.data[4:6] == b"\x42\x05":
            resets.append(now)

    bench.taps = (see,)
    assert bench.run().outcome is RunState.PASS
    assert not any(isinstance(each, OperatorPrompted) for each in bench.notes)
    assert len(resets) == 1, "the restart after the writes"


def test_an_application_beside_a_bootloader_ends_the_run_before_anything_is_sent(
    tmp_path: Path,
) -> None:
    bench = UnitBench(tmp_path)
    bench.put(without_application())
    beside = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=NEW_UNIT)
    bench.bus.attach(beside)
    assert bench.run().outcome is RunState.ERROR
    assert (bench.device.erase_count, beside.erase_count) == (0, 0)
