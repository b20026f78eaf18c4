"""`flasher flash --bike`: all devices of a bike by one command, and again after an interruption."""

from __future__ import annotations

import signal
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from flasher import api
from flasher.bike import in_safe_order, open_bike_set
from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.errors import ExitCode
from flasher.history import FlashHistory
from flasher.mock.bms import BmsApplication
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.system import System
from flasher.protocol.contents import SerialNumber
from flasher.protocol.fields import WireText
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, OBC, TARGETS, WELLING, WMC, Target
from flasher.protocol.text import encode_text
from flasher.release import verify
from tests.cli.conftest import Flasher, Run
from tests.cli.test_rescue import Renamed
from tests.end_to_end.stage import NEW, NEWER, OLD, image_of, packet_number
from tests.loops import each

IMAGES = {
    target: image_of(packets, NEW, packets).data
    for packets, target in enumerate(TARGETS.values(), 4)
}
WORDS = ("-i", "virtual")
Act = Callable[[], None]


class BikeOnTheBus:
    """A whole bicycle in the place of every adapter; its clock is virtual."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.bus = SimulatedBus(WELLING.bitrate_bps, self.clock, self._carry)
        small = DeviceProfile(application_area_bytes=16 * 1024)
        self.system = System(profile=small)
        self.bus.attach(self.system)
        self.at: dict[tuple[Target, int], Act] = {}
        """What happens, once, when a packet to a device has begun."""
        self.erased: list[Target] = []
        """Devices in the order of their first packets."""

    def _carry(self, frame: Frame, _now: float) -> Iterable[Frame]:
        number = packet_number(frame)
        for target in TARGETS.values():
            if number is not None and frame.can_id == target.request_id:
                if number == 1:
                    self.erased.append(target)
                self.at.pop((target, number), lambda: None)()
        return (frame,)

    @contextmanager
    def connect(self, *_arguments: Any, **_options: Any) -> Iterator[api.Connection]:
        link, until = self.bus.link(), self.clock.now() + 1.0
        while self.clock.now() < until:  # the last command's queue runs empty
            link.receive(until)
        yield api.Connection(link, self.clock, "the simulated bus")

    def device(self, target: Target) -> MockDevice:
        device = self.system.members[target.node]
        assert isinstance(device, MockDevice)
        return device

    def cycle_power(self) -> None:
        self.system.power_cut(self.clock.now())
        self.system.power_on(self.clock.now())

    @property
    def is_done(self) -> bool:
        return all(self.device(each).stored_image == IMAGES[each] for each in IMAGES)


@pytest.fixture
def bike(monkeypatch: pytest.MonkeyPatch) -> BikeOnTheBus:
    return put(BikeOnTheBus(), monkeypatch)


def put(bike: BikeOnTheBus, monkeypatch: pytest.MonkeyPatch) -> BikeOnTheBus:
    monkeypatch.setattr("flasher.api.connect", bike.connect)
    return bike


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a bike set, `bike.toml`."""
    tables = []
    for target, data in IMAGES.items():
        (tmp_path / f"{target.name}.bin").write_bytes(data)
        tables.append(f'[[target]]\ntarget = "{target.name}"\nimage = "{target.name}.bin"\n')
    (tmp_path / "bike.toml").write_text("\n".join(tables))
    return tmp_path


@pytest.fixture
def upgrade(flasher: Flasher, folder: Path) -> Callable[..., Run]:
    return lambda *more: flasher("flash", "--bike", folder / "bike.toml", *WORDS, *more)


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def interrupt_twice() -> None:
    interrupt()
    interrupt()


# -- one command -----------------------------------------------------------------------------------


def test_all_devices_are_upgraded_and_the_battery_comes_last(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    run = upgrade()
    assert run.code == ExitCode.OK, run.err
    assert bike.is_done
    assert bike.erased == [OBC, WMC, BMS]
    assert run.out.splitlines()[-1].startswith(
        "OK  OBC confirmed its image (no version query); WMC confirmed its image (no version "
        f"query); BMS runs {NEW}  "
    )
    assert "it supplies the others" in run.err


def test_the_history_records_each_device_with_the_command_of_the_bike(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    assert upgrade().code == ExitCode.OK
    assert bike.is_done
    flashes, _ = FlashHistory().flashes()
    assert [flash.began.target for flash in flashes] == ["obc", "wmc", "bms"]
    assert all(flash.ended and flash.ended.completed for flash in flashes)
    assert all(" --bike " in flash.began.again for flash in flashes)


def test_the_history_names_the_adapter_as_it_came_back_for_the_next_devices_too(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An upgrade of them that is interrupted is found by that name."""
    link = Renamed(bike.bus, 10)
    monkeypatch.setattr(bike.bus, "link", lambda: link)
    bike.at[OBC, 2] = lambda: bike.bus.unplug(1.0)
    run = upgrade("-c", "can2")
    assert run.code == ExitCode.OK, run.err
    flashes, _ = FlashHistory().flashes()
    assert [flash.began.adapter for flash in flashes] == ["virtual can3"] * 3
    assert all("-c can3" in flash.began.again for flash in flashes)


@pytest.mark.slow
def test_a_device_that_reports_the_version_of_the_set_is_left_alone_unless_forced(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    assert upgrade().code == ExitCode.OK
    bike.erased.clear()
    again = upgrade("--json")
    assert again.code == ExitCode.OK
    assert bike.erased == [OBC, WMC], "these cannot report what they run"
    states = {each["target"]: each["state"] for each in again.document["devices"]}
    assert states == {"obc": "upgraded", "wmc": "upgraded", "bms": "up_to_date"}
    assert "; BMS was up to date  " in upgrade().out
    bike.erased.clear()
    assert upgrade("--force").code == ExitCode.OK
    assert bike.erased == [OBC, WMC, BMS]


def build_release(flasher: Flasher, path: Path) -> None:
    """Build a release of the images in its folder."""
    images = [
        word
        for target in IMAGES
        for word in ("--image", f"{target.name}={path.with_name(target.name)}.bin")
    ]
    built = flasher("release", "build", path, *images, "--product", "X", "--counter", "1")
    assert built.code == ExitCode.OK, built.err


@pytest.mark.slow
def test_no_images_of_two_releases_are_a_set(
    flasher: Flasher, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A newer release takes the name of the first one, on a share, while that is opened."""
    first, second = folder / "bike.wfw", folder / "second.wfw"
    build_release(flasher, first)
    for target in IMAGES:
        (folder / f"{target.name}.bin").write_bytes(image_of(4, NEWER).data)
    build_release(flasher, second)

    def replace_it(*args: Any, **options: Any) -> object:
        if second.exists():
            second.replace(first)
        return provenance_of(*args, **options)

    provenance_of = verify.provenance_of
    monkeypatch.setattr(verify, "provenance_of", replace_it)
    opened = open_bike_set(first)
    assert not second.exists()
    assert {each.opened.image.version for each in opened} == {NEW}


@pytest.mark.slow
def test_a_release_with_several_images_is_a_set(
    bike: BikeOnTheBus, flasher: Flasher, folder: Path
) -> None:
    release = folder / "bike.wfw"
    build_release(flasher, release)
    run = flasher("flash", "--bike", release, *WORDS, "--without", "bms")
    assert run.code == ExitCode.WRONG_DEVICE, "the release states the version of the battery"
    run = flasher("flash", "--bike", release, *WORDS)
    assert run.code == ExitCode.OK, run.err
    assert bike.is_done
    assert bike.erased == [OBC, WMC, BMS]


def test_a_device_that_is_left_out_and_not_in_the_set_is_named(
    upgrade: Callable[..., Run], folder: Path
) -> None:
    path = folder / "bike.toml"
    tables = path.read_text().split("[[target]]")
    path.write_text("[[target]]".join(each for each in tables if '"obc"' not in each))
    run = upgrade("--without", "obc", "--dry-run")
    assert run.code == ExitCode.OK, run.err
    assert "warning: --without obc changes nothing: the set has no image for it" in run.err


def test_a_dry_run_shows_the_plan_of_each_device_and_opens_no_adapter(
    upgrade: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("flasher.api.connect")
    run = upgrade("--dry-run")
    assert run.code == ExitCode.OK, run.err
    assert run.out.splitlines()[0].startswith("order: OBC, WMC, BMS: ")
    assert run.out.count("  plan:    ") == 3
    document = upgrade("--dry-run", "--json").document
    assert document["dry_run"] is True
    assert {each["state"] for each in document["devices"]} == {"not_begun"}


def test_each_device_has_a_trace_file_of_its_own(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], tmp_path: Path
) -> None:
    assert upgrade("--trace-file", str(tmp_path / "all.log")).code == ExitCode.OK
    assert bike.is_done
    assert {each.name for each in tmp_path.glob("all*")} == {
        "all-obc.log", "all-wmc.log", "all-bms.log",
    }  # fmt: skip


def test_an_error_in_a_set_shows_how_a_set_is_written(flasher: Flasher, folder: Path) -> None:
    for content in ("", 'bms = "bms.bin"\n', "[[target]]\n"):
        (folder / "bike.toml").write_text(content)
        run = flasher("flash", "--bike", folder / "bike.toml", *WORDS)
        assert run.code == ExitCode.USAGE
        assert 'a table [[target]] with target = "bms" and image = "FILE"' in run.err


# -- interrupted -----------------------------------------------------------------------------------


@pytest.mark.slow
@each("act", [interrupt, interrupt_twice])
@each("place", [(OBC, 1), (OBC, 3), (WMC, 2), (WMC, 4), (BMS, 1), (BMS, 5)])
def test_after_an_interruption_the_same_command_goes_on(
    upgrade: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    place: tuple[Target, int],
    act: Act,
) -> None:
    bike = put(BikeOnTheBus(), monkeypatch)
    bike.at[place] = act
    stopped = upgrade()
    assert stopped.code == ExitCode.INTERRUPTED, stopped.err
    assert "it may have no application now" in stopped.err
    assert "--bike" in stopped.err.split("to repair it:")[1]
    bike.erased.clear()
    again = upgrade("--json")
    assert again.code == ExitCode.OK, again.err
    assert bike.is_done
    assert bike.erased[0] is place[0], "a device without an application comes first"
    first = again.document["devices"][0]
    assert (first["target"], first["was_in_bootloader"]) == (place[0].name, True)


@pytest.mark.slow
@each("target", [OBC, WMC, BMS])
def test_the_command_outlives_a_power_cut_of_the_whole_bike(
    upgrade: Callable[..., Run], monkeypatch: pytest.MonkeyPatch, target: Target
) -> None:
    bike = put(BikeOnTheBus(), monkeypatch)
    bike.at[target, 3] = bike.cycle_power
    run = upgrade()
    assert run.code == ExitCode.OK, run.err
    assert bike.is_done


def test_a_stop_between_two_devices_leaves_the_next_one_as_it_was(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = FlashHistory.end

    def end(self: FlashHistory, *arguments: Any) -> None:
        ended(self, *arguments)
        if len(bike.erased) == 1:
            interrupt()

    monkeypatch.setattr(FlashHistory, "end", end)
    run = upgrade("--json")
    assert run.code == ExitCode.INTERRUPTED
    assert bike.erased == [OBC]
    assert run.document["error"]["what"] == "Interrupted before the upgrade of the WMC."
    states = [each["state"] for each in run.document["devices"]]
    assert states == ["upgraded", "not_begun", "not_begun"]
    assert run.err.splitlines()[-1].endswith("; OBC done, WMC not begun, BMS not begun")


@pytest.mark.slow
def test_a_device_that_fails_ends_the_bike_and_the_others_are_not_begun(
    upgrade: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    bike = put(BikeOnTheBus(), monkeypatch)
    bike.at[OBC, 2] = lambda: bike.system.power_cut(bike.clock.now())
    run = upgrade("--timeout", "20")
    assert run.code in (ExitCode.NO_ANSWER, ExitCode.TRANSFER, ExitCode.BUS), run.err
    assert bike.erased == [OBC]
    assert "WMC not begun, BMS not begun" in run.err.splitlines()[-1]
    bike.system.power_on(bike.clock.now())
    assert upgrade().code == ExitCode.OK
    assert bike.is_done


def test_the_repair_of_a_device_loads_its_image_as_the_set_does(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], folder: Path
) -> None:
    path = folder / "bike.toml"
    line = 'image = "obc.bin"\n'
    path.write_text(path.read_text().replace(line, f"{line}base = 0x08004000\n"))
    bike.at[OBC, 2] = interrupt
    assert upgrade().code == ExitCode.INTERRUPTED
    bike.device(OBC).power_cut(bike.clock.now())
    run = upgrade()
    assert bike.erased == [OBC]
    assert run.code == ExitCode.NO_ANSWER, run.err
    command = run.err.split("to repair it:\n")[1].split("\n")[0]
    assert command.split()[1:3] == ["rescue", str(folder / "obc.bin")]
    assert command.endswith(" -t obc --base 0x8004000")


def test_the_repair_after_a_deadline_does_not_repeat_the_deadline(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    bike.at[OBC, 2] = lambda: bike.system.power_cut(bike.clock.now())
    run = upgrade("--timeout", "20")
    assert bike.erased == [OBC]
    command = run.err.split("to repair it:")[1]
    assert "flash" in command
    assert "--bike" in command
    assert "--timeout" not in command


def test_a_silent_device_that_is_left_out_is_not_reported_to_be_reset(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    bike.device(OBC).power_cut(bike.clock.now())
    run = upgrade("--without", "obc")
    assert run.code == ExitCode.OK, run.err
    assert bike.erased == [WMC, BMS]
    assert "the OBC has sent nothing" not in run.err


@pytest.mark.slow
@each("place, erased", [((OBC, 6), [OBC]), ((WMC, 4), [OBC, WMC])])
def test_another_bike_in_the_middle_is_refused_before_its_next_device_is_erased(
    upgrade: Callable[..., Run],
    monkeypatch: pytest.MonkeyPatch,
    place: tuple[Target, int],
    erased: list[Target],
) -> None:
    bike = put(BikeOnTheBus(), monkeypatch)
    battery = bike.device(BMS).application
    assert isinstance(battery, BmsApplication)
    other = SerialNumber(WireText(encode_text("W2605999", 16)))
    bike.at[place] = lambda: battery.kept.update({"serial number": other})
    run = upgrade()
    assert run.code == ExitCode.WRONG_DEVICE, run.err
    assert "The BMS has the serial number W2605999, and had W2605001 before" in run.err
    assert bike.erased == erased
    assert run.err.splitlines()[-1].endswith("BMS not begun")


@each(
    "broken, order",
    [
        ((), (OBC, WMC, BMS)),
        ((WMC,), (WMC, OBC, BMS)),
        ((BMS,), (BMS, OBC, WMC)),
        ((OBC, WMC, BMS), (BMS, WMC, OBC)),
    ],
)
def test_devices_without_an_application_come_first_and_the_battery_before_the_others(
    broken: tuple[Target, ...], order: tuple[Target, ...]
) -> None:
    assert in_safe_order([WMC, BMS, OBC], broken) == list(order)


# -- refused before anything is erased -------------------------------------------------------------


@pytest.mark.slow
def test_a_nearly_empty_battery_refuses_the_whole_bike(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], tmp_path: Path
) -> None:
    limits = tmp_path / "limits.toml"
    limits.write_text("minimum_charge_percent = 86\n")
    run = upgrade("--profile", str(limits))
    assert run.code == ExitCode.WRONG_DEVICE
    assert "[E606]" in run.err
    assert bike.erased == []
    assert FlashHistory().flashes()[0] == [], "no upgrade has begun"
    assert upgrade("--profile", str(limits), "--without", "bms").code == ExitCode.WRONG_DEVICE
    assert bike.erased == [], "the battery supplies the others"
    assert upgrade("--profile", str(limits), "--allow-low-charge").code == ExitCode.OK


def test_a_downgrade_of_the_battery_is_refused_before_the_display_is_erased(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], folder: Path
) -> None:
    (folder / "bms.bin").write_bytes(image_of(4, NEWER).data)
    assert upgrade().code == ExitCode.OK
    bike.erased.clear()
    (folder / "bms.bin").write_bytes(IMAGES[BMS])
    run = upgrade()
    assert run.code == ExitCode.WRONG_DEVICE
    assert "--allow-downgrade" in run.err
    assert bike.erased == []


def test_a_silent_battery_refuses_the_whole_bike(
    bike: BikeOnTheBus, upgrade: Callable[..., Run]
) -> None:
    bike.system.power_cut(bike.clock.now())
    run = upgrade()
    assert run.code == ExitCode.NO_ANSWER
    assert "nothing was changed" in run.err


def test_another_version_than_the_set_states_is_refused(
    upgrade: Callable[..., Run], folder: Path
) -> None:
    state(folder, "wmc", NEWER)
    run = upgrade()
    assert run.code == ExitCode.IMAGE
    assert f"The image for the WMC is not the one of the set: it is {NEW}" in run.err


@pytest.mark.slow
def test_a_device_that_is_left_out_has_to_run_the_version_of_the_set(
    bike: BikeOnTheBus, upgrade: Callable[..., Run], folder: Path
) -> None:
    state(folder, "bms", NEW)
    run = upgrade("--without", "bms")
    assert run.code == ExitCode.WRONG_DEVICE
    assert f"The BMS runs {OLD}, and the versions of the set belong together" in run.err
    assert bike.erased == []
    assert upgrade().code == ExitCode.OK
    bike.erased.clear()
    assert upgrade("--without", "bms").code == ExitCode.OK
    assert bike.erased == [OBC, WMC]


def state(folder: Path, target: str, version: str) -> None:
    """State the version of an image in the set."""
    path = folder / "bike.toml"
    line = f'image = "{target}.bin"\n'
    text = path.read_text().replace(line, f'{line}firmware_version = "{version}"\n')
    assert tomllib.loads(text)
    path.write_text(text)


@each(
    "more, what",
    [
        (("-t", "bms"), "-t is for one image"),
        (("--base", "0x8000"), "--base is for one image"),
        (("--manifest", "x.toml"), "--manifest is for one image"),
        (("--in-session",), "--in-session is for one image"),
        (("--without", "bms", "--without", "wmc", "--without", "obc"), "leaves no device"),
    ],
)
def test_options_for_one_image_are_refused(
    upgrade: Callable[..., Run], more: tuple[str, ...], what: str
) -> None:
    run = upgrade(*more)
    assert run.code == ExitCode.USAGE
    assert what in run.err


@each(
    "text, what",
    [
        ("", "has no target"),
        ("[[target]]\ntarget = 'bms'\n", "has no image"),
        ("[[target]]\ntarget = 'hub'\nimage = 'a'\n", "unknown target"),
        ("[[target]]\ntarget='bms'\nimage='bms.bin'\n" * 2, "is named twice"),
        ("[[target]]\ntarget='bms'\nimage='nix.bin'\n", "no file of this name"),
    ],
)
def test_a_set_that_cannot_be_used_states_why(
    upgrade: Callable[..., Run], folder: Path, text: str, what: str
) -> None:
    (folder / "bike.toml").write_text(text)
    run = upgrade()
    assert run.code in (ExitCode.USAGE, ExitCode.IMAGE)
    assert what in run.err


def test_an_image_is_not_a_set(flasher: Flasher, folder: Path) -> None:
    run = flasher("flash", "--bike", folder / "bms.bin", "--mock")
    assert run.code == ExitCode.USAGE
    assert "is not a set of images" in run.err
    assert flasher("flash", folder / "bms.bin", "--mock", "-t", "bms", "--without", "bms").code == 2
