"""A release: what its maker states of it, and whether an image, a target and a device fit it.

Size and SHA-256 are of `Image.data`, the very bytes to be sent: a range, a base or filled gaps
change them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from flasher.errors import ImageError, WrongDeviceError
from flasher.image.image import Image
from flasher.image.manifest_keys import read_value
from flasher.protocol.spec import Target
from flasher.protocol.text import FirmwareVersion, printable


@dataclass(frozen=True)
class Finding:
    """One statement of a manifest held against an image."""

    key: str
    stated: str | None
    """None where the manifest does not state it."""
    found: str | None
    """What the image has; None where it does not say it."""
    agrees: bool | None
    """None where one of the two is missing: nothing to check, or nothing to check against."""


@dataclass(frozen=True)
class Release:
    """What a manifest states. The rules for a device hold where they are stated: a text that they
    cannot be applied to does not fit, since nobody knows that it would.
    """

    target: Target
    size_bytes: int
    """Bytes to be sent."""
    sha256: str
    """Of the bytes to be sent, lower-case hex digits."""
    source: str
    """File name of the manifest, for messages."""
    firmware_version: str | None = None
    hardware_versions: tuple[str, ...] = ()
    """Texts and patterns with `*` for any text; empty: not stated."""
    minimum_boot_version: str | None = None
    previous_from: str | None = None
    """The oldest running version from which this release may be installed."""
    previous_except: tuple[str, ...] = ()
    """Running versions from which it must not be installed."""
    notes: str = ""

    @property
    def rules_previous(self) -> bool:
        """True when it states which running versions it may replace."""
        return self.previous_from is not None or bool(self.previous_except)

    def fits_hardware(self, text: str) -> bool:
        """True when a device with this hardware version is listed, or none are stated."""
        return not self.hardware_versions or any(
            fnmatchcase(text, _only_stars(pattern)) for pattern in self.hardware_versions
        )

    def fits_previous(self, text: str) -> bool:
        """True when this may be installed over the running version, or no rule is stated."""
        if text in self.previous_except:
            return False
        if self.previous_from is None:
            return True
        running, oldest = FirmwareVersion.parse(text), FirmwareVersion.parse(self.previous_from)
        return running is not None and oldest is not None and running >= oldest

    def findings(self, image: Image) -> tuple[Finding, ...]:
        """Every statement about the image, held against `image.data`."""
        names = image.named_targets
        return (
            _compared("size_bytes", str(self.size_bytes), str(image.size_bytes)),
            _compared("sha256", self.sha256, image.sha256),
            _compared("firmware_version", self.firmware_version, image.version),
            Finding(
                "target",
                self.target.node.name,
                names_of(names) or None,
                self.target in names if names else None,
            ),
        )

    def check_bytes(self, image: Image) -> None:
        """Raises ImageError when the bytes to be sent are not those of this release: size, SHA-256
        or the firmware version inside differ.
        """
        for finding in self.findings(image):
            if finding.agrees is False and finding.key != "target":
                raise ImageError(
                    f"{printable(image.source)} is not the image of its manifest: {finding.key} "
                    f"is {finding.stated} there.",
                    where=f"{printable(self.source)}; the bytes to be sent have {finding.found}",
                    cause="another build beside this manifest, a damaged copy, or another --range, "
                    "--base or --fill-gaps-up-to than the release was made with",
                    remedy="Take image and manifest from the same release. For a build of your "
                    "own: `flasher manifest create --force`.",
                )


def _compared(key: str, stated: str | None, found: str | None) -> Finding:
    agrees = None if stated is None or found is None else stated == found
    return Finding(key, stated, found, agrees)


def target_problem(image: Image, release: Release | None, target: Target) -> str | None:
    """Why an image is not meant for `target`, by its manifest or by the names inside; None when
    nothing says so.
    """
    asked = target.node.name
    if release is not None and release.target != target:
        return (
            f"the manifest says that the image is for the {release.target.node.name}, not the "
            f"{asked}"
        )
    if image.named_targets and target not in image.named_targets:
        return f"the image names the {names_of(image.named_targets)} inside, not the {asked}"
    return None


def check_target(image: Image, release: Release | None, target: Target) -> None:
    """Raises WrongDeviceError when an image is not meant for `target`."""
    problem = target_problem(image, release, target)
    if problem is not None:
        raise WrongDeviceError(
            f"{problem[0].upper()}{problem[1:]}.",
            where=printable(image.source),
            cause="the image was built for another device",
            remedy="Choose the image for this target, or the target that it was built for.",
        )


def names_of(targets: frozenset[Target]) -> str:
    """Targets as a person reads them; empty when there are none."""
    return " and ".join(sorted(target.node.name for target in targets))


def release_of(  # noqa: PLR0913  one argument for each statement
    image: Image,
    target: Target,
    *,
    source: str = "",
    firmware_version: str | None = None,
    hardware_versions: Sequence[str] = (),
    minimum_boot_version: str | None = None,
    previous_from: str | None = None,
    previous_except: Sequence[str] = (),
    notes: str = "",
) -> Release:
    """The release that an image is; the firmware version is by default the one inside.

    Raises ImageError when the given firmware version is not the one inside, ValueError for a value
    that a manifest cannot hold.
    """
    if firmware_version and image.version and firmware_version != image.version:
        raise ImageError(
            f"The image is version {image.version}, not {printable(firmware_version)}.",
            where=f"the text inside {printable(image.source)}",
            remedy="Leave the version out: the one inside holds.",
        )
    given = {
        "firmware_version": firmware_version or image.version,
        "hardware_versions": list(hardware_versions),
        "minimum_boot_version": minimum_boot_version,
        "previous_from": previous_from,
        "previous_except": list(previous_except),
        "notes": notes,
    }
    values = {key: read_value(key, value) for key, value in given.items() if value is not None}
    return Release(target, image.size_bytes, image.sha256, source, **values)


def _only_stars(pattern: str) -> str:
    """A pattern of fnmatch in which `*` alone has a meaning."""
    return pattern.replace("[", "[[]").replace("?", "[?]")
