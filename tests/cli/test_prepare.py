"""`prepare` settles an upgrade once: for `flasher flash`, the bench page, the station, programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import flasher
from flasher import api, jobs, procedures
from flasher.errors import ErrorCode, FlasherError, ImageError, UsageError, WrongDeviceError
from flasher.host.identity import WAIVABLE, IdentityCheck
from flasher.host.waivers import BOOT_VERSION, OF_DEVICE, OUTSIDE_VECTOR, WAIVERS
from flasher.image.load import load
from flasher.image.release import Release
from flasher.protocol.spec import BMS, WELLING, WMC
from flasher.settings.manifest import find_release
from flasher.settings.profile import Profile
from tests.cli.conftest import Flasher
from tests.firmware import VECTORS

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
RELEASED = SAMPLES / "station" / "bms.bin"
PROFILE = Profile(BMS, WELLING, has_upgrade=True)
IMAGE = flasher.Image.from_bytes(VECTORS + bytes(range(256)))


def refused(job: jobs.Job) -> FlasherError:
    with pytest.raises(FlasherError) as caught:
        job.checked()
    return caught.value


def test_what_speaks_against_an_image_is_in_the_job_and_raised_by_its_check() -> None:
    for_wmc = flasher.Image.from_bytes(VECTORS + b"WMC_UPD" + bytes(100))
    job = jobs.prepare(for_wmc, PROFILE)
    assert [found.check for found in job.checks if found.ending is not None] == [
        IdentityCheck.TARGET
    ]
    assert isinstance(refused(job), WrongDeviceError)
    assert refused(job).where == "before anything was sent"
    text = flasher.Image.from_bytes(b"some text\n" * 40)
    job = jobs.prepare(text, PROFILE)
    assert refused(job).code is ErrorCode.IMAGE_IMPLAUSIBLE
    assert jobs.prepare(text, PROFILE, waived=["implausible"]).checked().checks
    good = jobs.prepare(IMAGE, PROFILE)
    assert good.checked() is good


def test_a_level_that_is_not_possible_is_refused_by_the_check_of_the_job() -> None:
    job = jobs.prepare(IMAGE, PROFILE, verify="memory")  # a raw binary without a base
    assert "without addresses" in refused(job).what
    wmc = jobs.prepare(IMAGE, Profile(WMC, WELLING, has_upgrade=True), verify="version")
    assert isinstance(refused(wmc), UsageError)


def test_an_upgrade_that_cannot_be_verified_is_refused_before_the_bus_is_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(api, "connect", lambda *_, **__: pytest.fail("the bus was opened"))
    bus: dict[str, Any] = {"interface": "virtual", "channel": "prepare"}
    with pytest.raises(UsageError, match="without addresses"):
        flasher.flash(IMAGE, "bms", verify="memory", **bus)
    with pytest.raises(UsageError, match="cannot be verified by version"):
        flasher.flash(IMAGE, "wmc", verify="version", **bus)


@pytest.mark.slow
def test_an_image_is_loaded_and_planned_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "app.bin"
    path.write_bytes(IMAGE.data)
    called: list[str] = []

    def counted(module: Any, name: str) -> None:
        real = getattr(module, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            called.append(name)
            return real(*args, **kwargs)

        monkeypatch.setattr(module, name, call)

    counted(jobs, "load")
    for module in (api, procedures):
        counted(module, "make_plan")
    assert flasher.flash(path, "bms", mock=True).ok
    assert called == ["load", "make_plan"]


def test_the_manifest_gives_the_version_and_the_oldest_bootloader_unless_waived() -> None:
    release = find_release(RELEASED)
    assert isinstance(release, Release)
    asking = replace(release, minimum_boot_version="V3.0.0")
    identity = PROFILE.identity(release=asking)
    image = load(RELEASED)
    job = jobs.prepare(image, PROFILE, identity=identity)
    assert job.options.minimum_boot_version == "V3.0.0"
    chosen = PROFILE.upgrade_options(minimum_boot_version="V2.0.0")
    job = jobs.prepare(image, PROFILE, identity=identity, options=chosen)
    assert job.options.minimum_boot_version == "V2.0.0"
    job = jobs.prepare(image, PROFILE, identity=identity, waived=[BOOT_VERSION])
    assert job.options.minimum_boot_version is None
    nameless = replace(image, version=None)
    assert jobs.prepare(nameless, PROFILE, identity=identity).plan.image.version == (
        release.firmware_version
    )
    with pytest.raises(ImageError, match="is not the image of its manifest"):
        jobs.prepare(IMAGE, PROFILE, identity=identity)


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--force"], ["--allow-downgrade", "--allow-boot-name"]])
@pytest.mark.parametrize("command", ["flash", "rescue"])
def test_the_command_line_runs_what_a_program_prepares(
    command: str, options: list[str], flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page of a bench calls it as a program does."""
    made: list[jobs.Job] = []
    real = jobs.prepare

    def noted(*args: Any, **kwargs: Any) -> jobs.Job:
        made.append(real(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(jobs, "prepare", noted)
    flasher(command, RELEASED, "-t", "bms", "--mock", "--mock-speed", "0", *options)
    waived = {
        0: [],
        1: [*OF_DEVICE, OUTSIDE_VECTOR],
        2: ["downgrade", "boot-name"],
    }[len(options)]
    own = real(
        RELEASED,
        Profile(BMS, WELLING, has_upgrade=True),
        bitrate_bps=WELLING.bitrate_bps,
        at_power_up=command == "rescue",
        waived=waived,
    ).checked()
    (job,) = made
    # The command line looks for images to go back to as well, where a running version is reported.
    assert (job.identity.images_here is not None) is (command == "flash")
    job = replace(job, identity=replace(job.identity, images_here=None))
    assert job == own
    assert job.checks == own.checks
    assert job.waived == tuple(sorted(waived))
    assert set(job.identity.waived) == {each for each in WAIVABLE if each.value in waived}
    assert set(waived) <= set(WAIVERS)
