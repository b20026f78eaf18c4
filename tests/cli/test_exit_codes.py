"""Every exit code of the contract, each reached by its real failure on the real command line."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from flasher.bus.simulated import SimulatedLink
from flasher.errors import ExitCode, TransmitBlockedError
from flasher.host.upgrade import UpgradeStage
from flasher.protocol.frame import Frame
from tests.cli.conftest import SAMPLES, Flasher
from tests.end_to_end.stage import IMAGE, SMALL, Speaker, Stage

Words = Sequence[str]
OTHER_TOOL = Frame(0x752, bytes.fromhex("55AA16123A107A11"))
COMPLETE = bytes.fromhex("55AA0C04C5020000")
ON_THE_BUS = ("-i", "virtual", "-c", "stage")


@dataclass(frozen=True)
class Scene:
    """What a failure is made from."""

    stage: Stage
    patch: pytest.MonkeyPatch
    folder: Path

    @property
    def image(self) -> str:
        path = self.folder / "image.bin"
        path.write_bytes(IMAGE.data)
        return str(path)

    def flash(self, *words: str) -> Words:
        return ("flash", self.image, "-t", self.stage.target.name, *ON_THE_BUS, *words)


@dataclass(frozen=True)
class Case:
    """A failure: how it comes about, the code, and words of where, cause and remedy."""

    name: str
    code: ExitCode
    make: Callable[[Scene], Words]
    where: str = ""
    cause: str = ""
    remedy: str = ""


# -- how each comes about -------------------------------------------------------------------------


def bug(scene: Scene) -> Words:
    def broken(*_arguments: object) -> None:
        raise ZeroDivisionError("injected")

    scene.patch.setattr(UpgradeStage, "_send_packet", broken)
    return scene.flash()


def manifest_of_another_build(scene: Scene) -> Words:
    (scene.folder / "image.bin.toml").write_text(
        f'format = 1\ntarget = "bms"\nsize_bytes = {IMAGE.size_bytes}\nsha256 = "{"0" * 64}"\n'
    )
    return scene.flash("--force")


def no_adapter(scene: Scene) -> Words:
    scene.patch.undo()
    return ("flash", scene.image, "-t", "bms", "-i", "socketcan", "-c", "nocan7")


def unplugged(scene: Scene) -> Words:
    scene.stage.at_packet[2] = scene.stage.bus.unplug
    return scene.flash()


def bus_off(scene: Scene) -> Words:
    scene.stage.at_packet[2] = scene.stage.bus.bus_off
    return scene.flash()


def bus_off_from_the_beginning(scene: Scene) -> Words:
    scene.stage.bus.bus_off()
    return scene.flash()


def alone(scene: Scene) -> Words:
    scene.stage.bus.is_unacknowledged = True
    return scene.flash()


def blocked(scene: Scene) -> Words:
    """Somebody with a lower id babbles all the time."""
    scene.stage.bus.attach(Speaker(Frame(0x001, bytes(8)), every_s=0.0001))
    scene.stage.queue_frames = 10  # as SocketCAN's is
    return scene.flash()


def refused_by_the_driver(scene: Scene) -> Words:
    """As python-can's back ends do: the queue is full from some frame on, for ever."""
    real, left = SimulatedLink.send, 60

    def send(link: SimulatedLink, frame: Frame) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise TransmitBlockedError(
                "The adapter took no frame for 2 s.", where="can0", cause="no room", remedy="Look."
            )
        real(link, frame)

    scene.patch.setattr(SimulatedLink, "send", send)
    return scene.flash("--attempts", "3")


def second_tool(scene: Scene) -> Words:
    stage = scene.stage

    def speak() -> None:
        stage.bus.attach(Speaker(OTHER_TOOL, every_s=60.0, begins_at=stage.clock.now()))

    stage.at_packet[2] = speak
    return scene.flash("--attempts", "1")


def second_tool_forced(scene: Scene) -> Words:
    return (*second_tool(scene), "--force")


def silent(scene: Scene) -> Words:
    scene.stage.cut_power()
    return scene.flash()


def no_one_cycles_the_power(scene: Scene) -> Words:
    words = scene.flash("--wait", "5")
    return ("rescue", *words[1:])


def other_boot_name(scene: Scene) -> Words:
    scene.stage.device.profile = replace(SMALL, boot_version="hello!")
    return scene.flash()


def other_target(_scene: Scene) -> Words:
    return ("flash", str(SAMPLES / "bms.bin"), "-t", "wmc", *ON_THE_BUS)


def loses_power(scene: Scene) -> Words:
    scene.stage.at_packet[3] = scene.stage.cut_power
    return scene.flash("--retries", "2")


def restarts(scene: Scene) -> Words:
    def again() -> None:
        scene.stage.at_packet[3] = again
        scene.stage.cycle_power()

    scene.stage.at_packet[3] = again
    return scene.flash("--attempts", "3")


def refuses(scene: Scene) -> Words:
    scene.stage.device.profile = replace(SMALL, image_checksum="crc32")
    return scene.flash()


def lose_complete(frame: Frame, _now: float) -> list[Frame]:
    return [] if frame.data == COMPLETE else [frame]


def silent_since_the_end(scene: Scene) -> Words:
    """Nothing that the device sends from its end on arrives."""
    stage = scene.stage
    is_over = False

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        nonlocal is_over
        is_over = is_over or frame.data == COMPLETE
        return [] if is_over and frame.can_id != stage.target.request_id else [frame]

    stage.disturb = disturb
    return scene.flash()


def application_is_silent(scene: Scene) -> Words:
    """It completes, and then does not answer."""
    stage = scene.stage
    is_over = False

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        nonlocal is_over
        is_over = is_over or frame.data == COMPLETE
        return [] if is_over and frame.can_id == stage.target.broadcast_id else [frame]

    stage.disturb = disturb
    return scene.flash()


def stays_in_its_bootloader(scene: Scene) -> Words:
    stage = scene.stage
    device = stage.device
    device.profile = replace(SMALL, after_complete="restarts")

    def disturb(frame: Frame, _now: float) -> list[Frame]:
        if frame.data == COMPLETE:
            erase_the_record, *_ = device.store.erasing(0)
            device.store.flash.execute(erase_the_record)
        return [frame]

    stage.disturb = disturb
    return scene.flash()


def up_to_date(scene: Scene) -> Words:
    assert scene.stage.flash().ok
    scene.stage.wait(2.0)
    return scene.flash("--skip-same-version")


def interrupted(scene: Scene) -> Words:
    scene.stage.at_packet[3] = lambda: signal.raise_signal(signal.SIGINT)
    return scene.flash()


def interrupted_twice(scene: Scene) -> Words:
    def both() -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    scene.stage.at_packet[3] = both
    return scene.flash()


def unknown_option(scene: Scene) -> Words:
    return scene.flash("--nonsense")


def damaged_file(_scene: Scene) -> Words:
    return ("flash", str(SAMPLES / "bad" / "no_end.hex"), "-t", "bms", *ON_THE_BUS)


P3 = "transferring, packet 3 of 4"
CASES = [
    Case("done", ExitCode.OK, Scene.flash),
    Case("a bug", ExitCode.INTERNAL, bug, cause="a bug in flasher", remedy="report it"),
    Case("wrong usage", ExitCode.USAGE, unknown_option, remedy="--help"),
    Case("damaged file", ExitCode.IMAGE, damaged_file, "line 3", " ", "again"),
    Case("not the manifest's bytes", ExitCode.IMAGE, manifest_of_another_build,
         "image.bin.toml", "another build", "same release"),
    Case("no adapter", ExitCode.BUS, no_adapter, "nocan7", " ", " "),
    Case("unplugged", ExitCode.BUS, unplugged, "packet 2 of 4", "not plugged in", "Plug it in"),
    Case("bus-off", ExitCode.BUS, bus_off, "transferring", "bus-off", "bit rate"),
    Case("bus-off at once", ExitCode.BUS, bus_off_from_the_beginning,
         "before anything was sent; the simulated bus", "bus-off", "bit rate"),
    Case("no node acknowledges", ExitCode.BUS, alone,
         "boot version; the simulated bus", "termination", "Check power"),
    Case("bus taken", ExitCode.BUS, blocked, "resetting", "whole bus", "State of"),
    Case("queue full", ExitCode.BUS, refused_by_the_driver, "packet 3 of 4", "no room", "Look."),
    Case("second tool", ExitCode.BUS, second_tool, "packet", "another program", "End the other"),
    Case("second tool, forced", ExitCode.BUS, second_tool_forced,
         "packet", "another program", "End the other"),
    Case("silent", ExitCode.NO_ANSWER, silent, "boot version", "no power", "Check supply"),
    Case("not power-cycled", ExitCode.NO_ANSWER, no_one_cycles_the_power,
         "boot version", "it was not switched off", "--wait"),
    Case("another device", ExitCode.WRONG_DEVICE, other_boot_name,
         "boot version", "reports BMS", "--allow-boot-name"),
    Case("for another target", ExitCode.WRONG_DEVICE, other_target,
         "before anything was sent", "another file", "image-info"),
    Case("loses power", ExitCode.TRANSFER, loses_power, P3, "lost power", "rescue"),
    Case("restarts", ExitCode.TRANSFER, restarts, f"{P3}, attempt 3", "supply", "Check the"),
    Case("refuses", ExitCode.REFUSED, refuses, "final answer", "checksum", "accepts"),
    Case("no final answer", ExitCode.UNCONFIRMED, silent_since_the_end,
         "new application", "answer was lost", "Unconfirmed"),
    Case("does not run", ExitCode.VERIFICATION, application_is_silent,
         "verification by version", "starts slowly", "power-cycle"),
    Case("stays in its bootloader", ExitCode.VERIFICATION, stays_in_its_bootloader,
         "verification by version", "second device", "one BMS alone"),
    Case("up to date", ExitCode.NOTHING_TO_DO, up_to_date),
    Case("Ctrl-C", ExitCode.INTERRUPTED, interrupted, P3, "", "seconds to time out"),
    Case("Ctrl-C twice", ExitCode.INTERRUPTED, interrupted_twice,
         P3, "middle of a message", "State of the device"),
]  # fmt: skip
NOT_YET = {12}
"""Exit codes that no command has yet: failed units of a batch."""


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_each_failure_has_its_exit_code_and_states_where_why_and_what_to_do(
    flasher: Flasher, tmp_path: Path, case: Case
) -> None:
    stage = Stage()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flasher.api.connect", stage.connect)
        run = flasher(*case.make(Scene(stage, patch, tmp_path)), "--json")
    document = run.document
    assert run.code == document["exit_code"] == case.code, run.err
    assert document["ok"] is (case.code == ExitCode.OK)
    if case.code in (ExitCode.OK, ExitCode.NOTHING_TO_DO):
        assert "error" not in document
        return
    error = document["error"]
    assert error["what"]
    for part in ("where", "cause", "remedy"):
        wanted = getattr(case, part)
        assert wanted in error[part]
        assert bool(wanted) == bool(error[part]), (part, error[part])
        assert error[part] in run.err
    assert "error: " in run.err
    assert ("Traceback" in run.err) is (case.code == ExitCode.INTERNAL)


def test_every_exit_code_that_exists_has_a_failure_here() -> None:
    assert {case.code for case in CASES} == set(ExitCode) - NOT_YET


@pytest.mark.parametrize(
    "case", [case for case in CASES if "packet 2" in case.where], ids=lambda case: case.name
)
def test_a_failure_in_the_transfer_states_what_the_device_is_left_with_and_leaves_a_bundle(
    flasher: Flasher, tmp_path: Path, case: Case
) -> None:
    stage = Stage()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flasher.api.connect", stage.connect)
        run = flasher(*case.make(Scene(stage, patch, tmp_path)))
    assert "State of the device: its application is erased, half written or not accepted" in run.err
    assert "  to repair it:\n    flasher rescue " in run.err
    assert "bundle: " in run.err
    assert "no bundle" not in run.err


@pytest.mark.parametrize("name", ["missing", "."])
def test_a_missing_file_and_a_directory_are_the_same_kind_of_mistake(
    flasher: Flasher, tmp_path: Path, name: str
) -> None:
    wrong, image = tmp_path / name, SAMPLES / "bms.bin"
    mock = ("--mock", "--mock-speed", "0")
    for words in (
        ("flash", wrong, "-t", "bms", *mock),
        ("flash", image, "-t", "bms", "--manifest", wrong, *mock),
        ("flash", image, "-t", "bms", "--profile", wrong, *mock),
        ("image-info", wrong),
        ("manifest", "check", wrong),
        ("explain", wrong),
        ("monitor", wrong),
        ("conformance", "-t", "bms", "--mock", "--good-image", wrong),
        ("conformance", "diff", wrong, wrong),
        ("station", "check", wrong),
    ):
        run = flasher(*words)
        assert run.code == ExitCode.USAGE, (words, run.err)
