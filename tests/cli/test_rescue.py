"""`flasher rescue`, and the command that every failed upgrade names for it."""

from __future__ import annotations

import shlex
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from zlib import crc32

import click
import pytest

from flasher import events
from flasher.bus.simulated import SimulatedLink
from flasher.cli.upgrade import acceptance
from flasher.cli.upgrade.choices import repair_command
from flasher.errors import ExitCode
from flasher.events import Phase
from flasher.history import FlashHistory
from flasher.wording import wording
from tests.cli.conftest import SAMPLES, Flasher
from tests.end_to_end.stage import IMAGE, SMALL, Stage


def repair_named_in(reported: str) -> list[str]:
    """The words of the command on the line after "to repair it:", split like a shell does."""
    lines = reported.splitlines()
    words = shlex.split(lines[lines.index("  to repair it:") + 1])
    assert words[:1] == ["flasher"]
    return words[1:]


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    made = Stage()
    monkeypatch.setattr("flasher.api.connect", made.connect)
    return made


def test_the_mock_of_rescue_has_no_application_and_is_rescued(flasher: Flasher) -> None:
    image = SAMPLES / "obc.bin"
    run = flasher("rescue", image, "-t", "obc", "--mock", "--mock-speed", "0")
    assert run.code == ExitCode.OK
    assert ">>> power-cycle the device now (waiting 60 s)" in run.err
    assert "completed:    the device confirmed the complete image" in run.out


def test_no_wait_is_no_wait_and_not_the_default(flasher: Flasher, stage: Stage) -> None:
    stage.cut_power()
    run = flasher("rescue", SAMPLES / "obc.bin", "-t", "obc", "-i", "virtual", "--wait", "0")
    assert ">>> power-cycle the device now (waiting 0 s)" in run.err
    assert run.code == ExitCode.NO_ANSWER


def test_rescue_is_one_json_document_too(flasher: Flasher) -> None:
    image = SAMPLES / "obc.bin"
    run = flasher("rescue", image, "-t", "obc", "--mock", "--mock-speed", "0", "--json")
    assert run.document["command"] == "rescue"
    assert run.document["outcome"]["ending"] == "completed"


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--timeout", "30", "--skip-same-version"),
        ("--timeo=30", "--skip", "--retries", "2", "--verify", "none"),
        ("--bus-kwargs", "a=1", "--bus-kwargs", "b=two"),
    ],
    ids=" ".join,
)
def test_the_command_that_is_named_repairs_as_printed(
    flasher: Flasher,
    stage: Stage,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: Sequence[str],
) -> None:
    """Typed from another folder's shell, with a name that needs quoting."""
    monkeypatch.chdir(tmp_path)
    image = tmp_path / "it's new; v2.bin"
    image.write_bytes(IMAGE.data)
    stage.at_packet[3] = stage.cut_power
    failed = flasher("-q", "flash", image, "-t", "bms", "-i", "virtual", *options)
    assert failed.code == ExitCode.TRANSFER
    assert stage.has is None
    stage.give_power()
    repaired = flasher(*repair_named_in(failed.err))
    assert repaired.code == ExitCode.OK, repaired.err
    assert stage.has == IMAGE.data


def test_the_command_that_repairs_names_the_adapter_as_it_came_back(
    flasher: Flasher, stage: Stage, tmp_path: Path
) -> None:
    """Another adapter may have its old name, and another unit."""
    stage.wrap = lambda link: Renamed(link._bus, link._queue_frames)
    stage.at_packet[2] = lambda: stage.bus.unplug(1.0)
    stage.at_packet[3] = stage.cut_power
    image = tmp_path / "new.bin"
    image.write_bytes(IMAGE.data)
    failed = flasher("flash", image, "-t", "bms", "-i", "virtual", "-c", "can2")
    assert "it is virtual can3 now" in failed.err
    repair = repair_named_in(failed.err)
    assert repair[repair.index("-c") + 1] == "can3"
    assert "can2" not in repair
    (flash,) = FlashHistory().flashes()[0]
    assert flash.began.adapter == "virtual can3"
    assert "-c can3" in flash.began.again


def test_an_adapter_that_gets_its_first_name_back_is_named_by_it(
    flasher: Flasher, stage: Stage, tmp_path: Path
) -> None:
    stage.wrap = lambda link: Renamed(link._bus, link._queue_frames)
    stage.at_packet[2] = stage.at_packet[3] = lambda: stage.bus.unplug(1.0)
    stage.at_packet[4] = stage.cut_power
    image = tmp_path / "new.bin"
    image.write_bytes(IMAGE.data)
    failed = flasher("flash", image, "-t", "bms", "-i", "virtual", "-c", "can2")
    repair = repair_named_in(failed.err)
    assert repair[repair.index("-c") + 1] == "can2"
    (flash,) = FlashHistory().flashes()[0]
    assert flash.began.adapter == "virtual can2"


def test_no_command_names_an_adapter_that_has_the_name_of_the_lost_one(
    flasher: Flasher, stage: Stage, tmp_path: Path
) -> None:
    """The other one may be connected to another unit."""
    stage.wrap = lambda link: TakenOver(link._bus, link._queue_frames)
    stage.at_packet[2] = stage.bus.unplug
    image = tmp_path / "new.bin"
    image.write_bytes(IMAGE.data)
    failed = flasher("flash", image, "-t", "bms", "-i", "virtual", "-c", "can2")
    assert failed.code == ExitCode.BUS
    repair = repair_named_in(failed.err)
    assert repair[repair.index("-c") + 1] == "CHANNEL"
    assert "can2" not in repair
    (flash,) = FlashHistory().flashes()[0]
    assert flash.began.adapter == "virtual"
    assert "can2" not in flash.began.again


class TakenOver(SimulatedLink):
    channel = "can2"

    def reopen(self) -> None:
        self.channel = ""
        super().reopen()

    def __str__(self) -> str:
        return "virtual"


class Renamed(SimulatedLink):
    channel = ""

    def reopen(self) -> None:
        super().reopen()
        self.channel = "can2" if self.channel == "can3" else "can3"

    def __str__(self) -> str:
        return f"virtual {self.channel}"


@pytest.fixture
def repair_of(flasher: Flasher, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """The command that repairs what an upgrade left that was typed like this."""

    def repair(typed: str, *, is_refused: bool = False) -> str:
        def run(*_: object, **__: object) -> int:
            named.append(repair_command(click.get_current_context(), is_refused=is_refused))
            return 0

        named: list[str] = []
        monkeypatch.setattr("flasher.cli.upgrade.flash._Upgrade.run", run)
        assert flasher(*shlex.split(typed)).code == ExitCode.OK
        return named[0]

    return repair


@pytest.mark.parametrize(
    ("typed", "repair"),
    [
        ("flash a.hex -t bms", "rescue a.hex -t bms"),
        ("-v flash a.hex -t bms --json", "-v rescue a.hex -t bms --json"),
        ("-v flash -vt bms a.hex", "-v rescue a.hex -t bms -v"),
        ("rescue a.hex -t bms --wait 300", "rescue a.hex -t bms --wait 300"),
        ("flash -t bms --timeout 5 a.hex", "rescue a.hex -t bms"),
        ("flash -t bms --timeout=5 a.hex", "rescue a.hex -t bms"),
        ("flash -t bms --timing f_clock=8 a.hex", "rescue a.hex -t bms --timing f_clock=8"),
        (
            "flash --bus-kwargs a=1 -t bms a.hex --bus-kwargs b='2 3'",
            "rescue a.hex -t bms --bus-kwargs a=1 --bus-kwargs 'b=2 3'",
        ),
        ("flash --skip-same a.hex -t bms", "rescue a.hex -t bms"),
        ("--log-file flash flash a.hex -t bms", "--log-file flash rescue a.hex -t bms"),
        ("--log flash flash a.hex -t bms", "--log-file flash rescue a.hex -t bms"),
        ("flash -t bms -- --timeout", "rescue -t bms -- --timeout"),
        ("flash flash -t bms", "rescue flash -t bms"),
        # Standard input was read: whoever has the image pipes it in again, or names a file.
        ("flash - -t bms", "rescue IMAGE -t bms"),
        ("flash 'a b.hex' -t bms -c '$x'", "rescue 'a b.hex' -t bms -c '$x'"),
    ],
)
def test_the_repair_is_what_was_typed_without_what_does_not_fit(
    repair_of: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
    repair: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert repair_of(typed) == f"flasher {repair}"


@pytest.mark.parametrize(
    ("typed", "repair"),
    [
        ("flash a.hex -t bms", "rescue OTHER_IMAGE -t bms"),
        ("flash -t bms bms", "rescue OTHER_IMAGE -t bms"),
        ("flash bms -t bms", "rescue OTHER_IMAGE -t bms"),
        ("flash -t bms -- a.hex", "rescue OTHER_IMAGE -t bms"),
        (
            "flash a.hex -t bms --base 0 --range=0:0x9 --man m.toml -f --allow-hardware -b 250000",
            "rescue OTHER_IMAGE -t bms -b 250000",
        ),
    ],
)
def test_a_refused_image_is_not_named_again_nor_what_was_reported_about_it(
    repair_of: Callable[..., str], typed: str, repair: str
) -> None:
    assert repair_of(typed, is_refused=True) == f"flasher {repair}"


def test_a_refused_image_is_not_named_again_by_an_acceptance(
    flasher: Flasher, stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acceptance._Walk, "_look_at_bus", lambda _walk: "")
    stage.device.profile = replace(SMALL, image_checksum="crc32")
    image = tmp_path / "bad.bin"
    image.write_bytes(IMAGE.data)
    words = ("--yes", "--force", "-o", tmp_path / "report.html", "-i", "virtual")
    failed = flasher("acceptance", image, "-t", "bms", *words)
    assert failed.code == ExitCode.REFUSED
    assert repair_named_in(failed.err) == ["rescue", "OTHER_IMAGE", "-t", "bms", "-i", "virtual"]


def test_after_a_refusal_the_one_command_can_be_right_and_spares_the_evidence(
    flasher: Flasher, stage: Stage, tmp_path: Path
) -> None:
    stage.device.profile = replace(SMALL, image_checksum="crc32")
    image, trace = tmp_path / "bad.bin", tmp_path / "evidence.asc"
    image.write_bytes(IMAGE.data)
    words = ("flash", image, "-t", "bms", "-i", "virtual", "--trace-file", trace)
    failed = flasher(*words)
    assert failed.code == ExitCode.REFUSED
    kept = trace.read_bytes()
    command = repair_named_in(failed.err)
    assert command == ["rescue", "OTHER_IMAGE", "-t", "bms", "-i", "virtual"]
    assert failed.err.count("flasher rescue") == 1
    good = tmp_path / "good.bin"
    checked = IMAGE.data + crc32(IMAGE.data).to_bytes(4, "little")
    good.write_bytes(checked)
    repaired = flasher(*(str(good) if word == "OTHER_IMAGE" else word for word in command))
    assert repaired.code == ExitCode.OK, repaired.err
    assert trace.read_bytes() == kept


# -- Ctrl-C ---------------------------------------------------------------------------------------

STAGES = [
    (Phase.IDENTIFY, "this run erased nothing", False),
    (Phase.RESET, "this run erased nothing", False),
    (Phase.BOOT, "this run erased nothing", False),
    (Phase.UPDATE, "the command to erase its application was sent", True),
    (Phase.TRANSFER, "its application is erased, half written or not accepted", True),
    (Phase.END, "it acknowledged every byte of the image", True),
]


@pytest.mark.parametrize(("phase", "state", "needs_repair"), STAGES)
@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_in_every_phase_states_what_the_device_has_and_how_to_repair_it(
    flasher: Flasher,
    stage: Stage,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    phase: Phase,
    state: str,
    *,
    needs_repair: bool,
    times: int,
) -> None:
    """With the first frame of the phase; the second Ctrl-C cuts off what is being sent."""
    pressed: list[Phase] = []

    def show(_progress: object, event: object) -> None:
        if isinstance(event, events.PhaseEntered) and event.phase is phase and not pressed:
            pressed.append(phase)
            stage.at_next_frame = press

    def press() -> None:
        for _ in range(times):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("flasher.cli.upgrade.progress.Progress.__call__", show)
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE.data)
    run = flasher("flash", image, "-t", "bms", "-i", "virtual", "--json")
    assert pressed
    assert run.code == ExitCode.INTERRUPTED, run.err
    error = run.document["error"]
    if phase is not Phase.RESET:
        assert wording(phase) in error["where"]
    if times == 1:
        assert f"State of the device: {state}" in error["remedy"]
        assert error["command"].startswith("flasher rescue ") is needs_repair
    else:
        assert "State of the device: " in error["remedy"]
        assert "Interrupted at once" in error["what"]
    if error["command"]:
        stage.wait(10.0)
        assert flasher("flash", image, "-t", "bms", "-i", "virtual").code == ExitCode.OK
        assert stage.has == IMAGE.data


def test_ctrl_c_while_power_is_awaited_leaves_the_device_as_it_was(
    flasher: Flasher, stage: Stage, tmp_path: Path
) -> None:
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE.data)
    ticks = iter(range(100))

    def press(_moment: float) -> None:
        if next(ticks) == 3:
            signal.raise_signal(signal.SIGINT)

    stage.clock.on_wait = press
    run = flasher("rescue", image, "-t", "bms", "-i", "virtual", "--json")
    assert run.code == ExitCode.INTERRUPTED
    assert "this run erased nothing" in run.document["error"]["remedy"]
    assert stage.clock.now() < 5.0
    assert stage.heard == []


@pytest.mark.usefixtures("stage")
def test_ctrl_c_in_the_verification_states_that_the_image_is_there(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def show(_progress: object, event: object) -> None:
        if isinstance(event, events.VerificationStarted):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("flasher.cli.upgrade.progress.Progress.__call__", show)
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE.data)
    run = flasher("flash", image, "-t", "bms", "-i", "virtual", "--json")
    assert run.code == ExitCode.INTERRUPTED
    error = run.document["error"]
    assert "completed, but interrupted by the user" in error["what"]
    assert error["where"] == "verification by version"
    assert "State of the device: it has the new image." in error["remedy"]
    assert "rescue" not in error["remedy"]


def test_ctrl_c_while_the_adapter_is_awaited_takes_effect_at_once(
    flasher: Flasher, stage: Stage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def show(_progress: object, event: object) -> None:
        if isinstance(event, events.AdapterLost):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("flasher.cli.upgrade.progress.Progress.__call__", show)
    stage.at_packet[2] = stage.bus.unplug
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE.data)
    run = flasher("flash", image, "-t", "bms", "-i", "virtual", "--adapter-wait", "500", "--json")
    assert run.code == ExitCode.INTERRUPTED
    assert stage.clock.now() < 2.0
    error = run.document["error"]
    assert "packet 2 of 4" in error["where"]
    assert "no such device" in error["cause"]
    assert error["command"].startswith("flasher rescue ")
