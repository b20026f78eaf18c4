"""Release manifest: target, version, size, hash and rules of an image, and their checks.

Size and SHA-256 are those of `Image.data`, the bytes to send: a range, a base or filled gaps change
them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Annotated, Final

from flasher.errors import ErrorCode, FlasherError, ImageError, WrongDeviceError
from flasher.image.image import Image
from flasher.protocol.spec import IMAGE_MAX_SIZE, TARGETS, Target, find_target
from flasher.protocol.text import (
    BOOT_VERSION_FORM,
    FIRMWARE_VERSION_FORM,
    FirmwareVersion,
    boot_version_number,
    printable,
)
from flasher.validation import NumberRange, Parsed


def _text(value: object) -> str:
    """Check a text that a device may send: printable ASCII, not empty."""
    if not isinstance(value, str):
        raise TypeError
    if not (value and value.isascii() and value.isprintable()):
        raise ValueError
    return value


def _target(value: object) -> Target:
    found = find_target(_text(value))
    if found is None:
        raise ValueError
    return found


def _sha256(value: object) -> str:
    if not re.fullmatch(r"[0-9a-fA-F]{64}", _text(value)):
        raise ValueError
    return _text(value).lower()


def _firmware_version(value: object) -> str:
    if FirmwareVersion.parse(_text(value)) is None:
        raise ValueError
    return _text(value)


def _boot_version(value: object) -> str:
    if boot_version_number(_text(value)) is None:
        raise ValueError
    return _text(value)


DeviceText = Annotated[str, Parsed("a text of printable ASCII", _text)]
TargetName = Annotated[
    Target, Parsed(f"one of {', '.join(TARGETS)}", _target, lambda target: target.name)
]
FirmwareText = Annotated[
    str, Parsed(f"a text of the form {FIRMWARE_VERSION_FORM}", _firmware_version)
]
BootText = Annotated[str, Parsed(f"a text of the form {BOOT_VERSION_FORM}", _boot_version)]


COUNTER_MAX: Final = 0xFFFF_FFFF


@dataclass(frozen=True)
class Comparison:
    """Value of a manifest key, compared with the image."""

    key: str
    stated: str | None
    """None if the manifest has no such key."""
    found: str | None
    """Value in the image; None if unknown."""
    agrees: bool | None
    """None if one of the values is missing."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """Contents of a release manifest. A value to which a rule cannot be applied breaks the rule."""

    target: TargetName
    """Device that the image is for."""
    firmware_version: FirmwareText | None = None
    """Firmware version inside the image."""
    product: DeviceText | None = None
    """Product whose releases share a counter."""
    counter: Annotated[int, NumberRange(ge=1, le=COUNTER_MAX)] | None = None
    """Number of the release: each one of a product is higher than all before."""
    size_bytes: Annotated[int, NumberRange(ge=1, le=IMAGE_MAX_SIZE)]
    """Number of bytes to send."""
    sha256: Annotated[str, Parsed("64 hex digits", _sha256)]
    """SHA-256 of the bytes to send, lower-case hexadecimal."""
    hardware_versions: tuple[DeviceText, ...] = ()
    """Compatible hardware versions, with `*` for any characters; empty for all hardware."""
    minimum_boot_version: BootText | None = None
    """Oldest compatible bootloader version."""
    previous_from: FirmwareText | None = None
    """Oldest firmware version that may be replaced."""
    previous_except: tuple[DeviceText, ...] = ()
    """Firmware versions that must not be replaced."""
    notes: str = ""
    """Release notes for people."""
    source: str
    """File name of the manifest."""

    @property
    def rules_previous(self) -> bool:
        """True if the manifest restricts which firmware versions may be replaced."""
        return self.previous_from is not None or bool(self.previous_except)

    def fits_hardware(self, text: str) -> bool:
        """True if this hardware version is compatible."""
        return not self.hardware_versions or any(
            fnmatchcase(text, _only_stars(pattern)) for pattern in self.hardware_versions
        )

    def fits_previous(self, text: str) -> bool:
        """True if this firmware version may be replaced."""
        if text in self.previous_except:
            return False
        if self.previous_from is None:
            return True
        running, oldest = FirmwareVersion.parse(text), FirmwareVersion.parse(self.previous_from)
        return running is not None and oldest is not None and running >= oldest

    def findings(self, image: Image) -> tuple[Comparison, ...]:
        """Compare size, SHA-256, firmware version and target with those of an image."""
        names = image.named_targets
        return (
            _compared("size_bytes", str(self.size_bytes), str(image.size_bytes)),
            _compared("sha256", self.sha256, image.sha256),
            _compared("firmware_version", self.firmware_version, image.version),
            Comparison(
                "target",
                self.target.node.name,
                names_of(names) or None,
                self.target in names if names else None,
            ),
        )

    def check_bytes(self, image: Image) -> None:
        """Raise ImageError if size, SHA-256 or firmware version differ from those of the image."""
        for finding in self.findings(image):
            if finding.agrees is False and finding.key != "target":
                raise ImageError(
                    f"{printable(image.source)} is not the image of its manifest: {finding.key} "
                    f"is {finding.stated} there.",
                    where=f"{printable(self.source)}; the bytes to send have {finding.found}",
                    cause="another build next to this manifest, a damaged copy, or another "
                    "--range, --base or --fill-gaps-up-to than that of the release",
                    remedy="Take image and manifest from the same release. For your own "
                    "build: `flasher manifest create --force`.",
                    code=ErrorCode.MANIFEST,
                )


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Result of checking an image against the trust file of this computer (`flasher.release`)."""

    text: str
    """The result as a sentence."""
    problem: FlasherError | None = None
    """Refusal; None if the image may be sent."""
    signers: tuple[str, ...] = ()
    """Ids of the trusted keys that signed the image; empty if no signature was checked."""
    threshold: int = 0
    """Number of signatures that the trust file asks for; 0 if none was checked."""
    trust_version: int | None = None
    """Version of the trust file; None without one."""
    warnings: tuple[str, ...] = ()
    highest_counters: Mapping[str, int] = field(default_factory=dict)
    """Highest counter that a device has received, by serial number."""


def _compared(key: str, stated: str | None, found: str | None) -> Comparison:
    agrees = None if stated is None or found is None else stated == found
    return Comparison(key, stated, found, agrees)


def target_problem(image: Image, release: Release | None, target: Target) -> str | None:
    """Describe how manifest or names inside an image contradict `target`; None if they do not."""
    asked = target.node.name
    if release is not None and release.target != target:
        return f"by its manifest the image is for the {release.target.node.name}, not the {asked}"
    if image.named_targets and target not in image.named_targets:
        return f"the image names the {names_of(image.named_targets)} inside, not the {asked}"
    return None


def check_target(image: Image, release: Release | None, target: Target) -> None:
    """Raise WrongDeviceError if an image is for another target."""
    problem = target_problem(image, release, target)
    if problem is not None:
        raise WrongDeviceError(
            f"{problem[0].upper()}{problem[1:]}.",
            where=printable(image.source),
            cause="the image was built for another device",
            remedy="Choose the image for this target, or the target that it was built for.",
            code=ErrorCode.NOT_FOR_DEVICE,
        )


def names_of(targets: frozenset[Target]) -> str:
    """Join target names for messages; may be empty."""
    return " and ".join(sorted(target.node.name for target in targets))


def _only_stars(pattern: str) -> str:
    """Escape a pattern for fnmatch, except `*`."""
    return pattern.replace("[", "[[]").replace("?", "[?]")
