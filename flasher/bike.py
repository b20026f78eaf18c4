"""Upgrade of a whole bike: images by target, the order of the upgrades, and the checks before them.

The documents give one device that supplies the others, and that reports its version and its charge:
the battery. So a device without an application comes first, the battery before the others, and of
devices that run the battery comes last: it supplies the others as long as one of them may have to
be rescued.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Unpack

from flasher.api import CallOptions, Connection, Profile
from flasher.errors import (
    ErrorCode,
    FlasherError,
    ImageError,
    NoAnswerError,
    UsageError,
    WrongDeviceError,
)
from flasher.history import Flash, FlashHistory, left_open
from flasher.host.identity import CheckResult, DeviceAnswers, judge_device, new_version
from flasher.host.options import serial_number
from flasher.jobs import Job, OpenedImage, image_of_release, open_image, refusal
from flasher.procedures import check_no_other_tool, two_devices_error
from flasher.protocol.contents import RunningInformation, VersionInformation
from flasher.protocol.spec import BMS, OBC, WMC, Dialect, Target
from flasher.protocol.text import printable
from flasher.release.places import is_container
from flasher.settings.bike_set import read_bike_set

ORDER: Final = (OBC, WMC, BMS)
ORDER_REASON: Final = (
    "a device without an application first, then OBC and WMC, the battery last: it supplies the "
    "others, and has to work as long as one of them may need a rescue"
)


@dataclass(frozen=True)
class SetImage:
    """Image of a set."""

    target: Target
    path: Path
    """The image, or the release with it."""
    opened: OpenedImage
    firmware_version: str | None
    """Version that the set states; None if it states none."""
    options: tuple[str, ...] = ()
    """Options of the command line that load this image alone in the same way."""


def open_bike_set(
    path: Path, *, require_signed: bool = False, allow_outside_vector: bool = False
) -> list[SetImage]:
    """Load the images of a release (`*.wfw`) or a bike set; options as in `open_image`.

    Raises ImageError and UsageError for a set that cannot be used, and for images whose versions or
    products are not those that belong together.
    """
    images: list[SetImage] = []
    if is_container(path):
        from flasher.release.verify import open_package  # noqa: PLC0415  for releases alone

        package = open_package(path)  # once: another release may take its name meanwhile
        for target in package.targets:
            opened = image_of_release(
                package,
                target,
                require_signed=require_signed,
                allow_outside_vector=allow_outside_vector,
            )
            version = opened.release.firmware_version if opened.release else None
            images.append(SetImage(target, path, opened, version))
    elif path.suffix.lower() != ".toml":
        raise UsageError(
            f"{printable(str(path))} is not a set of images.",
            cause="it is neither a release nor a TOML file; an image alone is flashed without "
            "--bike",
            remedy="Name a release (*.wfw), or a TOML file with a table [[target]] for each image.",
            code=ErrorCode.FILE_NOT_READ,
        )
    else:
        for each in read_bike_set(path).target:
            file = path.parent / each.image
            manifest = path.parent / each.manifest if each.manifest else None
            base: dict[str, Any] = {} if each.base is None else {"base": each.base}
            options = [] if each.base is None else ["--base", hex(each.base)]
            options += [] if manifest is None else ["--manifest", str(manifest)]
            opened = open_image(
                file,
                each.device,
                manifest=manifest,
                require_signed=require_signed,
                allow_outside_vector=allow_outside_vector,
                **base,
            )
            images.append(
                SetImage(each.device, file, opened, each.firmware_version, tuple(options))
            )
    _check_belongs_together(path, images)
    return sorted(images, key=lambda each: ORDER.index(each.target))


def _check_belongs_together(path: Path, images: Iterable[SetImage]) -> None:
    products: dict[str, str] = {}
    for each in images:
        name, release = each.target.node.name, each.opened.release
        version = new_version(each.opened.image, release)
        if each.firmware_version is not None and version != each.firmware_version:
            raise ImageError(
                f"The image for the {name} is not the one of the set: it is "
                f"{version or 'without a version'}, and the set states {each.firmware_version}.",
                where=f"{printable(str(path))}; {printable(each.opened.image.source)}",
                cause="another build, or a set that was not brought up to date",
                remedy="Take set and images from the same release.",
                code=ErrorCode.MANIFEST,
            )
        if release is not None and release.product:
            products.setdefault(release.product, name)
    if len(products) > 1:
        (one, first), (other, second) = list(products.items())[:2]
        raise ImageError(
            f"The images of the set are of different products: {printable(one)} for the {first}, "
            f"{printable(other)} for the {second}.",
            where=f"{printable(str(path))}; the manifests of its images",
            remedy="Take all images from the release of one product.",
            code=ErrorCode.MANIFEST,
        )


def in_safe_order(targets: Collection[Target], broken: Collection[Target]) -> list[Target]:
    """Return the targets in the order of `ORDER_REASON`; `broken` have no application."""
    first = [each for each in reversed(ORDER) if each in targets and each in broken]
    return [*first, *(each for each in ORDER if each in targets and each not in first)]


@dataclass(frozen=True)
class BikeFound:
    """State of the bike before its upgrade."""

    broken: frozenset[Target]
    """Devices in their bootloaders, and those that an upgrade left in its transfer."""
    versions: Mapping[Target, str]
    """Versions that the devices reported."""
    answers: Mapping[Target, DeviceAnswers]
    silent: tuple[Target, ...]
    """Devices that sent nothing, and that reported no version."""

    def ready(self, job: Job) -> Job:
        """Return the upgrade of a device, without rules that no application can answer for one in
        its bootloader.
        """
        if job.plan.target not in self.broken:
            return job
        return replace(job, identity=replace(job.identity, reports_unchecked=True))


def look_at_bike(
    connection: Connection,
    dialect: Dialect,
    profiles: Mapping[Target, Profile],
    **watch: Unpack[CallOptions],
) -> BikeFound:
    """Listen for all devices, and ask those that can be asked; nothing is written.

    Raises BusError for another tool, WrongDeviceError for two batteries.
    """
    survey = connection.scan(dialect, **watch)
    check_no_other_tool(survey)
    if survey.duplicates.evidence:
        raise two_devices_error(BMS, survey.duplicates.evidence, "Nothing was written.")
    found = [query.answer for query in survey.queries]
    battery = DeviceAnswers(
        next((each for each in found if isinstance(each, VersionInformation)), None),
        next((each for each in found if isinstance(each, RunningInformation)), None),
    )
    answers = {BMS: battery}
    announced = {
        target
        for target in ORDER
        if (heard := survey.heard.get(target.node)) is not None and heard.boot_version
    }
    for target, profile in profiles.items():
        request = profile.upgrade_options().version_request
        if request is not None and target not in announced:
            with suppress(NoAnswerError):
                version = connection.device(profile=profile, **watch).ask(request)
                running = battery.running if target is BMS else None
                answers[target] = DeviceAnswers(version, running)
    versions = {
        target: answer.firmware_version
        for target, answer in answers.items()
        if answer.firmware_version
    }
    flashes: list[Flash] = []
    with suppress(FlasherError, OSError):  # the flash warns of a history that cannot be read
        flashes, _ = FlashHistory().flashes()
    adapter = printable(connection.name)
    left = {
        target
        for target in ORDER
        if target not in versions and left_open(flashes, target=target.name, adapter=adapter)
    }
    broken = frozenset(announced | left)
    silent = tuple(
        target
        for target in profiles
        if target.node not in survey.heard and target not in broken and target not in versions
    )
    return BikeFound(broken, versions, answers, silent)


def judge_bike(
    found: BikeFound, jobs: Mapping[Target, Job], left_out: Iterable[SetImage]
) -> list[tuple[Target, CheckResult]]:
    """Check all upgrades of a bike before the first one; return the results.

    Raises the error of the first check that refuses, NoAnswerError for a silent battery, and
    WrongDeviceError for a device that is left out and runs another version than the set states.
    """
    if BMS in jobs and BMS in found.silent:
        raise NoAnswerError(
            "The BMS did not answer, and does not announce its bootloader: nothing was changed.",
            cause="the bike is off or asleep, or the adapter is on another bus",
            remedy="Wake the bike with its key; flasher doctor checks adapter and bus.",
            code=ErrorCode.NOBODY_HEARD,
        )
    for each in left_out:
        version = found.versions.get(each.target)
        if each.firmware_version and version and version != each.firmware_version:
            name = each.target.node.name
            raise WrongDeviceError(
                f"The {name} runs {version}, and the versions of the set belong together: "
                f"{each.firmware_version} for the {name}.",
                remedy=f"Upgrade the {name} as well: leave --without {each.target.name} out. A "
                "device alone is upgraded by flasher flash IMAGE -t T.",
                code=ErrorCode.NOT_FOR_DEVICE,
            )
    results: list[tuple[Target, CheckResult]] = []
    state = None if BMS in jobs else found.answers[BMS].running
    for target, job in jobs.items():
        answers = found.answers.get(target, DeviceAnswers())
        if state is not None:
            answers, state = DeviceAnswers(answers.version, state), None
        identity = found.ready(job).identity
        for result in judge_device(job.plan.image, target, identity, answers):
            results.append((target, result))
            # The upgrade itself skips a device that runs the version already.
            error = None if result.ending is None else refusal(job.plan, result)
            if error is not None:
                raise error
    return results


def check_same_battery(
    connection: Connection, profile: Profile, serial: str, **watch: Unpack[CallOptions]
) -> None:
    """Raise WrongDeviceError if the battery is another one than before; `serial` is its serial
    number then, "" if unknown, `profile` that of the battery.
    """
    request = profile.upgrade_options().version_request_for(BMS)
    if not serial or request is None:
        return
    with suppress(NoAnswerError):  # the upgrade judges a silent device
        now = serial_number(connection.device(profile=profile, **watch).ask(request))
        if now and now != serial:
            raise WrongDeviceError(
                f"The BMS has the serial number {now}, and had {serial} before.",
                cause="another bike is connected, or another battery",
                remedy="Connect the first bike with its battery and run the same command, then "
                "run it for the other one.",
                code=ErrorCode.NOT_FOR_DEVICE,
            )


def silence_text(target: Target) -> str:
    """Describe a device whose presence cannot be checked."""
    return (
        f"the {target.node.name} has sent nothing, and the documents give no query for it: its "
        "reset will show whether it is there"
    )
