"""What `flash` checks before it writes anything, each with its own waiver."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ExitCode
from flasher.image.image import Image
from flasher.mock.profile import DeviceProfile
from flasher.protocol.wire import Message, encode, split
from tests.cli.conftest import Flasher, Run
from tests.end_to_end.stage import IMAGE, NEW, OLD, SMALL, Speaker, Stage, image_of
from tests.firmware import VECTORS

UPDATE = bytes.fromhex("55AA160DA10B")
OLDER, BETWEEN = "V0r9r0_20200101", "V1r0r1_20230101"
HARDWARE = SMALL.hardware_version


@dataclass(frozen=True)
class Check:
    """An image and a device that do not belong together, and the option that lets them through."""

    waiver: str
    says: str
    manifest: dict[str, Any] | None = None
    image: Image = IMAGE
    profile: DeviceProfile = SMALL
    is_reported: bool = True
    """False for the bootloader's: they are judged by the upgrade, which says nothing."""


CHECKS = [
    Check("other-target", "by its manifest the image is for the WMC, not the BMS",
          {"target": "wmc"}),
    Check("other-target", "the image names the OBC inside, not the BMS",
          image=Image.from_bytes(IMAGE.data + b"\0OBC_UPD\0")),
    Check("hardware", f"the device's hardware {HARDWARE} is not in the manifest, which lists V9*",
          {"hardware_versions": ["V9*"]}),
    Check("downgrade", f"{OLDER} is older than {OLD}, which runs now", image=image_of(4, OLDER)),
    Check("previous-version", f"the device runs {OLD}: the manifest excludes it",
          {"previous_except": [OLD]}),
    Check("previous-version", f"the device runs {OLD}: the manifest replaces {BETWEEN} and newer",
          {"previous_from": BETWEEN}),
    Check("in-use", "the battery gives", profile=replace(SMALL, battery_use="riding")),
    Check("boot-name", "another device answers", profile=replace(SMALL, boot_version="hello!"),
          is_reported=False),
    Check("boot-version", "its bootloader is older than the image needs",
          {"minimum_boot_version": "V1.0.1"}, is_reported=False),
]  # fmt: skip
WAIVERS = sorted({check.waiver for check in CHECKS})


class Workbench:
    """A device, an image file with its manifest, and `flasher` on that bus."""

    def __init__(self, flasher: Flasher, patch: pytest.MonkeyPatch, folder: Path) -> None:
        self._flasher, self._patch, self._folder = flasher, patch, folder

    def flash(
        self,
        stage: Stage,
        *words: str,
        image: Image = IMAGE,
        manifest: dict[str, Any] | None = None,
        command: str = "flash",
    ) -> Run:
        path = self._folder / "image.bin"
        path.write_bytes(image.data)
        self._write_manifest(image, manifest)
        stage.heard.clear()
        self._patch.setattr("flasher.api.connect", stage.connect)
        return self._flasher(command, path, "-t", stage.target.name, "-i", "virtual", *words)

    def _write_manifest(self, image: Image, keys: dict[str, Any] | None) -> None:
        if keys is None:
            return
        known = {"format": 1, "target": "bms", "size_bytes": image.size_bytes,
                 "sha256": image.sha256}  # fmt: skip
        # Texts and lists of texts are in JSON what they are in TOML.
        lines = [f"{key} = {value!r}".replace("'", '"') for key, value in (known | keys).items()]
        (self._folder / "image.bin.toml").write_text("\n".join(lines))


@pytest.fixture
def bench(flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Workbench:
    return Workbench(flasher, monkeypatch, tmp_path)


def wrote(stage: Stage) -> bool:
    """Whether the device received an update command, which erases."""
    return any(frame.data.startswith(UPDATE) for frame in stage.heard)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.waiver)
def test_what_does_not_belong_together_is_refused_unless_its_own_waiver_is_given(
    bench: Workbench, check: Check
) -> None:
    others = [f"--allow-{name}" for name in WAIVERS if name != check.waiver]
    own = f"--allow-{check.waiver}"
    stage = Stage(profile=check.profile)
    run = bench.flash(stage, *others, image=check.image, manifest=check.manifest)
    assert run.code == ExitCode.WRONG_DEVICE
    assert check.says in run.err
    assert own in run.err
    assert not wrote(stage)
    assert "this run erased nothing" in run.err
    for words in ([own], ["--force"]):
        stage = Stage(profile=check.profile)
        run = bench.flash(stage, *words, image=check.image, manifest=check.manifest)
        assert run.code == ExitCode.OK, run.err
        assert stage.has == check.image.data
        if check.is_reported:
            assert f"warning: {check.says}" in run.err


def test_a_bootloader_that_is_refused_starts_its_application_again(bench: Workbench) -> None:
    """It was reset, and left alone from then on."""
    stage = Stage(profile=replace(SMALL, boot_version="hello!"))
    assert bench.flash(stage).code == ExitCode.WRONG_DEVICE
    stage.wait(3.0)
    assert not wrote(stage)
    assert bench.flash(stage, "--allow-boot-name").code == ExitCode.OK


def test_a_right_manifest_lets_every_check_pass_and_the_result_names_it(bench: Workbench) -> None:
    stage = Stage()
    keys = {
        "hardware_versions": ["V1r2r0_*"],
        "minimum_boot_version": "V1.0.0",
        "previous_from": OLD,
        "firmware_version": NEW,
    }
    assert "check: passed" not in bench.flash(Stage(), manifest=keys).err
    run = bench.flash(stage, "-v", manifest=keys)
    assert run.code == ExitCode.OK
    assert "check: passed: by the manifest the image is for the BMS" in run.err
    assert "check: passed: the manifest lists hardware V1r2r0_20220512" in run.err
    assert f"check: passed: {NEW} is newer than {OLD}, which runs now" in run.err
    (unknown,) = [line for line in run.err.splitlines() if "check: unknown" in line]
    assert "no image of" in unknown, "the way back is no rule of a manifest"


@pytest.mark.parametrize(
    "rule",
    [{"hardware_versions": ["V1r2r0_*"]}, {"previous_from": OLD}],
    ids=str,
)
def test_a_rule_that_cannot_be_checked_refuses_as_one_that_fails(
    bench: Workbench, rule: dict[str, Any]
) -> None:
    """The device is in its bootloader, which answers no query."""
    stage = Stage(has_application=False)
    run = bench.flash(stage, manifest=rule)
    assert run.code == ExitCode.WRONG_DEVICE
    assert "reported no version: the manifest's rule on" in run.err
    assert "cannot be checked; --allow-hardware waives this" in run.err
    assert "flasher rescue goes on without it" in run.err
    assert not wrote(stage)
    run = bench.flash(stage, "--allow-hardware", manifest=rule)
    assert run.code == ExitCode.OK, run.err
    assert "warning: the BMS's application reported no version" in run.err


def test_a_rescue_states_that_it_goes_on_unchecked(bench: Workbench) -> None:
    stage = Stage(has_application=False)
    run = bench.flash(stage, manifest={"hardware_versions": ["V9*"]}, command="rescue")
    assert run.code == ExitCode.OK, run.err
    assert "the manifest's rule on hardware cannot be checked: goes on unchecked" in run.err


def test_where_there_is_nothing_to_check_against_a_line_states_it(bench: Workbench) -> None:
    run = bench.flash(Stage("obc"))
    assert run.code == ExitCode.OK
    unknown = [line for line in run.err.splitlines() if line.startswith("check: unknown: ")]
    assert len(unknown) == 2
    assert "it is unknown whether it is for the OBC" in unknown[0]
    assert "neither hardware nor downgrade can be checked" in unknown[1]


def test_the_manifests_version_replaces_one_that_the_image_does_not_name(
    bench: Workbench,
) -> None:
    nameless = Image.from_bytes(VECTORS + bytes(300))
    stage = Stage()
    run = bench.flash(stage, image=nameless, manifest={"firmware_version": OLDER})
    assert run.code == ExitCode.WRONG_DEVICE
    assert f"{OLDER} is older than {OLD}" in run.err
    run = bench.flash(Stage(), image=nameless)
    assert "names no version to compare" not in run.err


# -- the same version -----------------------------------------------------------------------------


def test_the_same_version_is_noted_and_flashed(bench: Workbench) -> None:
    stage = Stage()
    assert bench.flash(stage).code == ExitCode.OK
    stage.wait(2.0)
    run = bench.flash(stage)
    assert run.code == ExitCode.OK
    assert f"warning: the device already runs {NEW}" in run.err
    assert wrote(stage)


def test_the_same_version_is_skipped_on_request_and_nothing_is_sent_but_questions(
    bench: Workbench,
) -> None:
    stage = Stage()
    assert bench.flash(stage).code == ExitCode.OK
    stage.wait(2.0)
    run = bench.flash(stage, "--skip-same-version")
    assert run.code == ExitCode.NOTHING_TO_DO
    assert run.out.startswith(f"NOTHING TO DO  BMS: the device already runs {NEW}  ")
    assert "completed:" not in run.out
    assert not wrote(stage)
    document = bench.flash(stage, "--skip-same-version", "--json").document
    assert document["exit_code"] == ExitCode.NOTHING_TO_DO
    assert document["outcome"]["ending"] == "up_to_date"
    assert document["checks"][-1]["verdict"] == "skipped"


def test_another_version_is_not_skipped(bench: Workbench) -> None:
    assert bench.flash(Stage(), "--skip-same-version").code == ExitCode.OK


# -- power ----------------------------------------------------------------------------------------


def test_a_low_charge_is_warned_of_and_the_limit_is_the_profiles(
    bench: Workbench, tmp_path: Path
) -> None:
    limits = tmp_path / "limits.toml"
    limits.write_text("low_charge_percent = 90\n")
    run = bench.flash(Stage(), "--profile", str(limits))
    assert run.code == ExitCode.OK
    assert "warning: the battery is at 85 %" in run.err
    assert "the battery is at" not in bench.flash(Stage()).err


def test_a_nearly_empty_battery_is_refused_and_the_limit_is_the_profiles(
    bench: Workbench, tmp_path: Path
) -> None:
    limits = tmp_path / "limits.toml"
    limits.write_text("minimum_charge_percent = 86\n")
    stage = Stage()
    run = bench.flash(stage, "--profile", str(limits))
    assert run.code == ExitCode.WRONG_DEVICE
    assert "the battery is at 85 %, less than 86 %, and no charger is connected" in run.err
    assert "Connect its charger" in run.err
    assert not wrote(stage)
    run = bench.flash(stage, "--profile", str(limits), "--allow-low-charge")
    assert run.code == ExitCode.OK
    assert "warning: the battery is at 85 %, less than 86 %" in run.err
    limits.write_text("minimum_charge_percent = 85\n")
    assert bench.flash(Stage(), "--profile", str(limits)).code == ExitCode.OK


def test_what_counts_as_in_use_is_the_profiles(bench: Workbench, tmp_path: Path) -> None:
    limits = tmp_path / "limits.toml"
    limits.write_text("in_use_ma = 32000\n")
    riding = replace(SMALL, battery_use="riding")
    assert bench.flash(Stage(profile=riding), "--profile", str(limits)).code == ExitCode.OK
    assert bench.flash(Stage(profile=riding)).code == ExitCode.WRONG_DEVICE


@pytest.mark.parametrize("at_packet", [None, 3])
def test_a_battery_that_switches_off_is_named_as_the_cause(
    bench: Workbench, at_packet: int | None
) -> None:
    """Before the reset, and while another device on its supply is upgraded."""
    stage = Stage("obc" if at_packet else "bms")
    shutdown = bytes.fromhex("55AA0C0A1308") + b"SHUTDOWN"

    def switch_off() -> None:
        announce(stage, shutdown)
        stage.cut_power()

    if at_packet is None:
        stage.device.hold_key(stage.clock.now())
    else:
        stage.at_packet[at_packet] = switch_off
    run = bench.flash(stage, "--attempts", "1", "--json")
    assert run.document["shutdown_heard"] is True
    assert "warning: the BMS sent the command SHUTDOWN" in run.err
    if run.code != ExitCode.OK:
        assert "the battery sent SHUTDOWN" in run.document["error"]["cause"]
    assert (run.code == ExitCode.OK) is (at_packet is None)


def announce(stage: Stage, head: bytes) -> None:
    """The battery says something, once."""
    frames = split(0x720, encode(Message(0x720, head[2], int.from_bytes(head[4:6]), head[6:])))
    now = stage.clock.now()
    stage.bus.attach(Speaker(*frames, every_s=0.001, begins_at=now, limit=len(frames)))


# -- what no option waives ------------------------------------------------------------------------


def test_bytes_that_are_not_the_manifests_are_refused_whatever_is_allowed(
    bench: Workbench,
) -> None:
    stage = Stage()
    run = bench.flash(
        stage, "--force", *(f"--allow-{name}" for name in WAIVERS), manifest={"sha256": "0" * 64}
    )
    assert run.code == ExitCode.IMAGE
    assert stage.heard == []


def test_a_dry_run_states_what_the_image_declares_of_the_target_and_asks_no_device(
    bench: Workbench,
) -> None:
    stage = Stage()
    run = bench.flash(stage, "--dry-run", manifest={})
    assert run.code == ExitCode.OK
    assert "check: passed: by the manifest the image is for the BMS" in run.out
    assert stage.heard == []
    run = bench.flash(stage, "--dry-run", manifest={"target": "obc"})
    assert run.code == ExitCode.WRONG_DEVICE


# -- the way back ---------------------------------------------------------------------------------


def test_an_image_to_go_back_to_is_named_before_anything_is_erased(
    bench: Workbench, tmp_path: Path
) -> None:
    run = bench.flash(Stage())
    assert f"check: unknown: no image of {OLD}, which runs now, was found" in run.err
    assert run.err.index("no image of") < run.err.index("resetting the application")
    old = tmp_path / "old.bin"
    old.write_bytes(image_of(4, OLD).data)
    run = bench.flash(Stage())
    assert f"check: passed: {old} on this computer has {OLD}, which runs now" in run.err


def test_the_version_that_is_flashed_again_needs_no_way_back(bench: Workbench) -> None:
    stage = Stage()
    assert bench.flash(stage).code == ExitCode.OK
    assert "which runs now" not in bench.flash(stage).err
