"""Upgrade jobs: image, signatures, checks and options of an upgrade, prepared without a device."""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from flasher.errors import FlasherError, UsageError, printable
from flasher.host import waivers
from flasher.host.identity import WAIVABLE, CheckResult, Identity, IdentityCheck, judge_image
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import ended_before_start
from flasher.host.verify import Level, as_level, check_level, default_level
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan
from flasher.image.release import Provenance, Release
from flasher.procedures import plan_for
from flasher.protocol.spec import Target
from flasher.settings.manifest import find_release
from flasher.settings.profile import Profile

if TYPE_CHECKING:
    from flasher.release.verify import Package


@dataclass(frozen=True)
class OpenedImage:
    """Image of a file, with what is known of its origin."""

    image: Image
    release: Release | None = None
    """Manifest: beside the image, or of a signed release."""
    provenance: Provenance | None = None
    """Result of checking signatures; None on a computer without a trust file."""


def open_image(
    path: str | os.PathLike[str],
    target: Target,
    *,
    manifest: str | os.PathLike[str] | None = None,
    require_signed: bool = False,
    allow_outside_vector: bool = False,
    **options: Any,
) -> OpenedImage:
    """Load the image for a target from a firmware file or a release (`*.wfw`), and check its
    signatures against the trust file of this computer, if there is one.

    `manifest` and `options`, further ones of `load`, are for firmware files. A refusal by the trust
    file is in the result, and raised by `Job.checked`. Raises ImageError and UsageError for a file
    that cannot be used, WrongDeviceError for a release without an image for the target.
    """
    opened = None
    if "stream" not in options:
        opened = _signed(
            path, target, require_signed=require_signed, allow_outside_vector=allow_outside_vector
        )
    if opened is not None:
        if manifest is not None or options:
            raise UsageError(
                f"{printable(os.fspath(path))} is signed with its manifest, as a whole file.",
                cause="an option that chooses another manifest, or a part of the file",
                remedy="Leave --manifest, --format, --base, --range and --fill-gaps-up-to out.",
            )
        return opened
    has_place = "stream" not in options or manifest is not None
    release = find_release(path, manifest) if has_place else None
    loaded = load(path, allow_outside_vector=allow_outside_vector, **options)
    image = with_release(loaded, release)
    return OpenedImage(image, release, _unsigned(path, require_signed=require_signed))


def _signed(
    path: str | os.PathLike[str],
    target: Target,
    *,
    require_signed: bool = False,
    allow_outside_vector: bool,
) -> OpenedImage | None:
    """Open a release, or the image that one lies beside; None for any other file."""
    from flasher.release.places import release_path  # noqa: PLC0415

    found = release_path(path)
    if found is None:
        return None
    from flasher.release import verify  # noqa: PLC0415  for releases alone

    return image_of_release(
        verify.open_package(found),
        target,
        beside=path if os.fspath(found) != os.fspath(path) else None,
        require_signed=require_signed,
        allow_outside_vector=allow_outside_vector,
    )


def image_of_release(
    package: Package,
    target: Target,
    *,
    beside: str | os.PathLike[str] | None = None,
    require_signed: bool = False,
    allow_outside_vector: bool = False,
) -> OpenedImage:
    """Load the image for a target from an opened release, as `open_image` does. `beside` is the
    image of a detached release.
    """
    from flasher.release import verify  # noqa: PLC0415  for releases alone

    provenance = verify.provenance_of(package, target, _today(), is_required=require_signed)
    image, release = verify.image_of(
        package, target, beside=beside, allow_outside_vector=allow_outside_vector
    )
    return OpenedImage(with_release(image, release), release, provenance)


def check_signatures(
    path: str | os.PathLike[str], target: Target, *, require_signed: bool = False
) -> Provenance | None:
    """Check the signatures of a firmware file or release again, as `open_image` does, without
    loading the image. Raises ImageError and UsageError for a release that cannot be used.
    """
    from flasher.release.places import release_path  # noqa: PLC0415

    found = release_path(path)
    if found is None:
        return _unsigned(path, require_signed=require_signed)
    from flasher.release import verify  # noqa: PLC0415  for releases alone

    package = verify.open_package(found)
    return verify.provenance_of(package, target, _today(), is_required=require_signed)


def _today() -> datetime.date:
    return datetime.datetime.now(datetime.UTC).date()


def _unsigned(path: str | os.PathLike[str], *, require_signed: bool = False) -> Provenance | None:
    from flasher.release.places import has_trust  # noqa: PLC0415

    if not (require_signed or has_trust()):
        return None
    from flasher.release import verify  # noqa: PLC0415  only with a trust file

    return verify.unsigned(os.fspath(path))


@dataclass(frozen=True)
class Job:
    """Upgrade prepared without the device; run by `flash`, the bench page and the station."""

    plan: Plan
    options: UpgradeOptions
    level: Level
    identity: Identity
    waived: tuple[str, ...] = ()
    """Names of the waived checks (flasher.host.waivers)."""

    @cached_property
    def checks(self) -> tuple[CheckResult, ...]:
        """Results of the checks of image and manifest against the target."""
        return tuple(judge_image(self.plan.image, self.plan.target, self.identity))

    def checked(self) -> Job:
        """Return this job. Raises ImageError for an implausible image, and for one that the trust
        file does not allow, WrongDeviceError if the image or its manifest contradicts the target,
        UsageError if the trust file cannot be used, or the upgrade cannot be verified at this
        level.
        """
        provenance = self.identity.provenance
        problem = None if provenance is None else provenance.problem
        if problem is not None and IdentityCheck.UNSIGNED not in self.identity.waived:
            problem.waiver = waivers.UNSIGNED
            raise problem
        for found in self.checks:
            error = refusal(self.plan, found)
            if error is not None:
                raise error
        check_level(self.plan, self.level, self.options)
        return self

    def in_session(self) -> Job:
        """Return this job for a device that may still be in an earlier transfer (R26)."""
        return replace(self, options=replace(self.options, in_session=True))


def prepare(
    image: str | os.PathLike[str] | Image | OpenedImage,
    profile: Profile,
    *,
    bitrate_bps: int | None = None,
    options: UpgradeOptions | None = None,
    verify: Level | str | None = None,
    identity: Identity | None = None,
    at_power_up: bool = False,
    waived: Iterable[str] = (),
    **checks: Any,
) -> Job:
    """Prepare an upgrade without a bus: load, plan, and choose defaults. Call `Job.checked` before
    running it.

    `waived` names checks of flasher.host.waivers, `checks` are fields of `Identity`; `identity` and
    `options` take precedence. Raises ImageError and UsageError.
    """
    names = frozenset(waived)
    outside = waivers.OUTSIDE_VECTOR in names
    if isinstance(image, OpenedImage):
        opened = image
    elif isinstance(image, Image):
        opened = OpenedImage(image)
    elif identity is None:
        opened = open_image(image, profile.target, allow_outside_vector=outside)
    else:
        opened = _signed(image, profile.target, allow_outside_vector=outside) or OpenedImage(
            load(image, allow_outside_vector=outside)
        )
    if identity is None:
        identity = profile.identity(
            release=opened.release,
            waived=frozenset(check for check in WAIVABLE if check.value in names),
            reports_unchecked=at_power_up,
            **checks,
        )
    if identity.provenance is None:
        provenance = opened.provenance or _unsigned(opened.image.source)
        identity = replace(identity, provenance=provenance)
    loaded = opened.image
    release = identity.release
    plan = plan_for(with_release(loaded, release), profile, bitrate_bps)
    chosen = options or profile.upgrade_options(allow_boot_name=waivers.BOOT_NAME in names or None)
    if chosen.minimum_boot_version is None and release and waivers.BOOT_VERSION not in names:
        chosen = replace(chosen, minimum_boot_version=release.minimum_boot_version)
    if at_power_up:
        chosen = replace(chosen, at_power_up=True)
    level = default_level(plan.target, chosen) if verify is None else as_level(verify)
    return Job(plan, chosen, level, identity, tuple(sorted(names)))


def with_release(image: Image, release: Release | None) -> Image:
    """Return the image, with the version of its manifest if it names none itself.

    Raises ImageError if its bytes are not those of the manifest.
    """
    if release is None:
        return image
    release.check_bytes(image)
    return image if image.version else replace(image, version=release.firmware_version)


def refusal(plan: Plan, found: CheckResult) -> FlasherError | None:
    """Create the error for a check that refuses an upgrade; None for any other result."""
    if found.ending is None:
        return None
    refused = ended_before_start(
        plan, found.ending, found.detail, duration_s=0.0, waiver=found.waiver
    ).error()
    if refused is not None:
        refused.where = "before anything was sent"
    return refused
