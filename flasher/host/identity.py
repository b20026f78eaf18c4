"""Identity checks: whether an image is meant for a device, before the first write to it.

`judge_image` checks the image and its manifest alone, `judge_device` compares them with the answers
of the running application. The upgrade itself checks name and version of the bootloader when it
announces itself. Each check has its own option to waive it. An impossible check has the verdict
UNKNOWN.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from flasher.events import CheckMade
from flasher.host.options import firmware_version
from flasher.host.table import Ending
from flasher.i18n import text
from flasher.image.image import Image
from flasher.image.plausible import Cpu, find_doubt
from flasher.image.release import Release, target_problem
from flasher.protocol.contents import RunningInformation
from flasher.protocol.fields import Content
from flasher.protocol.spec import Target
from flasher.protocol.text import FirmwareVersion, printable

DEFAULT_LOW_CHARGE_PERCENT: Final = 20
DEFAULT_IN_USE_MA: Final = 1000
"""More than lights and displays use, less than the motor."""


class IdentityCheck(Enum):
    """Checks; the value is the name of the check and of the option that waives it."""

    PLAUSIBLE = "implausible"
    TARGET = "other-target"
    HARDWARE = "hardware"
    DOWNGRADE = "downgrade"
    PREVIOUS = "previous-version"
    SAME_VERSION = "same-version"
    IN_USE = "in-use"
    CHARGE = "low-charge"

    @property
    def option(self) -> str:
        """Option that waives it."""
        return f"--allow-{self.value}"


WAIVABLE: Final = (
    IdentityCheck.PLAUSIBLE,
    IdentityCheck.TARGET,
    IdentityCheck.HARDWARE,
    IdentityCheck.DOWNGRADE,
    IdentityCheck.PREVIOUS,
    IdentityCheck.IN_USE,
)
"""Checks that can refuse an upgrade; the others only report."""
_ENDINGS: Final[Mapping[IdentityCheck, Ending]] = {
    IdentityCheck.PLAUSIBLE: Ending.IMPLAUSIBLE,
    IdentityCheck.IN_USE: Ending.IN_USE,
    IdentityCheck.SAME_VERSION: Ending.UP_TO_DATE,
}
"""How a refused check ends the session, if not with NOT_FOR_DEVICE."""


class CheckVerdict(Enum):
    """Result of a check; the value is its name in events."""

    PASSED = "passed"
    UNKNOWN = "unknown"
    """Nothing to compare with."""
    WARNED = "warned"
    WAIVED = "waived"
    REFUSED = "refused"
    SKIPPED = "skipped"
    """Not upgraded, as requested."""


class CheckResult(NamedTuple):
    """A check with its result in one sentence."""

    check: IdentityCheck
    verdict: CheckVerdict
    text: str
    other_ways: str = ""
    """Alternatives to the option; continues the sentence that names the option."""
    is_unchecked: bool = False
    """True if nothing contradicts, but a rule could not be checked."""

    @property
    def event(self) -> CheckMade:
        """The event that reports it."""
        return CheckMade(self.check.value, self.verdict.value, self.text)

    @property
    def ending(self) -> Ending | None:
        """How it ends the session; None if it does not."""
        if self.verdict not in (CheckVerdict.REFUSED, CheckVerdict.SKIPPED):
            return None
        if self.is_unchecked:
            return Ending.UNCHECKED
        return _ENDINGS.get(self.check, Ending.NOT_FOR_DEVICE)

    @property
    def waiver(self) -> str:
        """Name of the check if it can be waived."""
        return self.check.value if self.check in WAIVABLE else ""

    @property
    def detail(self) -> str:
        """The problem, and the option that waives it."""
        if not self.waiver:
            return self.text
        return f"{self.text}; {self.check.option} waives this{self.other_ways}"


@dataclass(frozen=True)
class Identity:
    """Requirements and limits for the checks before an upgrade."""

    release: Release | None = None
    """Release of the image's manifest, if any."""
    waived: frozenset[IdentityCheck] = frozenset()
    skip_same_version: bool = False
    low_charge_percent: int = DEFAULT_LOW_CHARGE_PERCENT
    """Warn below this state of charge."""
    in_use_ma: int = DEFAULT_IN_USE_MA
    """A larger discharge current means that the vehicle is in use."""
    goes_on_unchecked: bool = False
    """Only report rules of the manifest that cannot be checked: for a rescue, because the device
    runs no application."""
    cpu: Cpu = Cpu.CORTEX_M
    """Processor type of the device; an image is expected to look like a program for it."""

    def vouches_for(self, image: Image) -> bool:
        """True if the manifest is of these exact bytes."""
        return self.release is not None and self.release.sha256 == image.sha256

    def refusal(self, check: IdentityCheck, text: str, other_ways: str = "") -> CheckResult:
        """Create the result of a failed check: refused or waived."""
        verdict = CheckVerdict.WAIVED if check in self.waived else CheckVerdict.REFUSED
        return CheckResult(check, verdict, text, other_ways)

    def uncheckable(self, check: IdentityCheck, text: str) -> CheckResult:
        """Create the result for a rule of the manifest that cannot be checked. It refuses like a
        failed rule, but --allow-hardware also waives it.
        """
        if self.goes_on_unchecked:
            return CheckResult(
                IdentityCheck.HARDWARE, CheckVerdict.UNKNOWN, f"{text}: goes on unchecked"
            )
        if check in self.waived:
            return CheckResult(check, CheckVerdict.WAIVED, text)
        return self.refusal(IdentityCheck.HARDWARE, text)._replace(is_unchecked=True)


@dataclass(frozen=True)
class DeviceAnswers:
    """Answers of the running application; None if it did not answer or was not asked."""

    version: Content | None = None
    running: RunningInformation | None = None

    @property
    def hardware_version(self) -> str | None:
        """Escaped."""
        hardware = getattr(self.version, "hardware_version", None)
        return None if hardware is None else str(hardware)

    @property
    def firmware_version(self) -> str | None:
        """Escaped."""
        return None if self.version is None else firmware_version(self.version)


def new_version(image: Image, release: Release | None) -> str | None:
    """Version of the image: the one inside it, else the manifest's."""
    return image.version or (release.firmware_version if release else None)


# -- the image by itself ----------------------------------------------------------------------


def judge_image(image: Image, target: Target, identity: Identity) -> Iterator[CheckResult]:
    """Check whether image and manifest match the target, and whether it can be a program."""
    yield from judge_bytes(image, identity)
    problem = target_problem(image, identity.release, target)
    wanted = target.node.name
    if problem is not None:
        yield identity.refusal(IdentityCheck.TARGET, problem)
    elif identity.release is not None or image.named_targets:
        has_release = identity.release is not None
        source = text("the manifest") if has_release else text("a name inside the image")
        yield CheckResult(
            IdentityCheck.TARGET,
            CheckVerdict.PASSED,
            text("by {source} the image is for the {wanted}", source=source, wanted=wanted),
        )
    else:
        sentence = text(
            "no manifest, and the image names no device: it is unknown whether it is for the "
            "{wanted}",
            wanted=wanted,
        )
        yield CheckResult(IdentityCheck.TARGET, CheckVerdict.UNKNOWN, sentence)


def judge_bytes(image: Image, identity: Identity) -> Iterator[CheckResult]:
    """Check whether the bytes can be a program for the device; no result if they look like one."""
    found = find_doubt(image)
    if found is None:
        return
    text = f"the image {found.text}"
    if not found.is_certain and identity.cpu is not Cpu.CORTEX_M:
        text += ": the profile names another processor"
        yield CheckResult(IdentityCheck.PLAUSIBLE, CheckVerdict.UNKNOWN, text)
    elif not found.is_certain and identity.vouches_for(image):
        text += ": the manifest was made for these very bytes"
        yield CheckResult(IdentityCheck.PLAUSIBLE, CheckVerdict.UNKNOWN, text)
    else:
        yield identity.refusal(IdentityCheck.PLAUSIBLE, text, found.other_waivers)


# -- the device -------------------------------------------------------------------------------


def judge_device(
    image: Image, target: Target, identity: Identity, seen: DeviceAnswers
) -> Iterator[CheckResult]:
    """Compare the image with the application's answers; `seen` is empty without any."""
    if seen.version is None:
        yield _versions_unknown(identity, target)
    else:
        yield _hardware(identity, seen.hardware_version)
        yield from _versions(image, identity, seen.firmware_version or "")
    if seen.running is not None:
        yield from _state(identity, seen.running)


def _versions_unknown(identity: Identity, target: Target) -> CheckResult:
    """Result when the application does not answer, or has no query for its versions."""
    release = identity.release
    hardware = release is not None and bool(release.hardware_versions)
    previous = release is not None and release.rules_previous
    if not hardware and not previous:
        sentence = text(
            "the {node}'s application does not report its versions: neither hardware nor downgrade "
            "can be checked",
            node=target.node.name,
        )
        return CheckResult(IdentityCheck.HARDWARE, CheckVerdict.UNKNOWN, sentence)
    rules = " and ".join(["hardware"] * hardware + ["the version that is replaced"] * previous)
    sentence = text(
        "the {node}'s application does not report its versions: the manifest's rule on {rules} "
        "cannot be checked",
        node=target.node.name,
        rules=rules,
    )
    return identity.uncheckable(
        IdentityCheck.HARDWARE if hardware else IdentityCheck.PREVIOUS, sentence
    )


def _hardware(identity: Identity, hardware: str | None) -> CheckResult:
    release = identity.release
    if release is None or not release.hardware_versions:
        sentence = text("no manifest states which hardware the image fits")
        return CheckResult(IdentityCheck.HARDWARE, CheckVerdict.UNKNOWN, sentence)
    fits = ", ".join(printable(each) for each in release.hardware_versions)
    if hardware is None:
        sentence = text(
            "the device does not report its hardware; the manifest lists {fits}", fits=fits
        )
        return identity.uncheckable(IdentityCheck.HARDWARE, sentence)
    if release.fits_hardware(hardware):
        return CheckResult(
            IdentityCheck.HARDWARE,
            CheckVerdict.PASSED,
            text("the manifest lists hardware {hardware}", hardware=hardware),
        )
    sentence = text(
        "the device's hardware {hardware} is not in the manifest, which lists {fits}",
        hardware=hardware,
        fits=fits,
    )
    return identity.refusal(IdentityCheck.HARDWARE, sentence)


def _versions(image: Image, identity: Identity, running: str) -> Iterator[CheckResult]:
    """Compare the running version with the new one and with the manifest's rule."""
    release = identity.release
    if release is not None:
        yield from _previous(release, identity, running)
    new = new_version(image, release)
    if new is None:
        sentence = text(
            "the image names no version to compare with the running {running}", running=running
        )
        yield CheckResult(IdentityCheck.DOWNGRADE, CheckVerdict.UNKNOWN, sentence)
        return
    if new == running:
        skipped = CheckVerdict.SKIPPED if identity.skip_same_version else CheckVerdict.WARNED
        sentence = text("the device already runs {running}", running=running)
        yield CheckResult(IdentityCheck.SAME_VERSION, skipped, sentence)
        return
    before, after = FirmwareVersion.parse(running), FirmwareVersion.parse(new)
    if before is None or after is None:
        sentence = text(
            "{running} and {new} cannot be compared: not both follow the naming rule",
            running=running,
            new=new,
        )
        yield CheckResult(IdentityCheck.DOWNGRADE, CheckVerdict.UNKNOWN, sentence)
    elif after < before:
        sentence = text("{new} is older than {running}, which runs now", new=new, running=running)
        yield identity.refusal(IdentityCheck.DOWNGRADE, sentence)
    else:
        sentence = text("{new} is newer than {running}, which runs now", new=new, running=running)
        yield CheckResult(IdentityCheck.DOWNGRADE, CheckVerdict.PASSED, sentence)


def _previous(release: Release, identity: Identity, running: str) -> Iterator[CheckResult]:
    """Check the manifest's rule about the replaced version, if any."""
    if not release.rules_previous:
        return
    if release.fits_previous(running):
        sentence = text("the manifest lets {running} be replaced", running=running)
        yield CheckResult(IdentityCheck.PREVIOUS, CheckVerdict.PASSED, sentence)
    else:
        excluded = running in release.previous_except or release.previous_from is None
        sentence = text("the device runs {running}: the manifest excludes it", running=running)
        if not excluded:
            sentence = text(
                "the device runs {running}: the manifest replaces {oldest} and newer",
                running=running,
                oldest=release.previous_from,
            )
        yield identity.refusal(IdentityCheck.PREVIOUS, sentence)


def _state(identity: Identity, running: RunningInformation) -> Iterator[CheckResult]:
    """Check charge and current; a discharging current is negative (5.1)."""
    if running.mean_current_ma < -identity.in_use_ma:
        sentence = text(
            "the battery gives {current_ma} mA, more than {limit_ma} mA",
            current_ma=-running.mean_current_ma,
            limit_ma=identity.in_use_ma,
        )
        yield identity.refusal(IdentityCheck.IN_USE, sentence)
    if running.state_of_charge_percent < identity.low_charge_percent:
        sentence = text(
            "the battery is at {charge} %: charge it first, if it can wait",
            charge=running.state_of_charge_percent,
        )
        yield CheckResult(IdentityCheck.CHARGE, CheckVerdict.WARNED, sentence)
