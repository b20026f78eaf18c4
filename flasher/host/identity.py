"""Identity checks: whether an image is for this device, before anything is written to it.

`judge_image` checks the image and its manifest, `judge_device` compares them with the answers of
the running application. The upgrade itself checks name and version of the bootloader. Each check
has its own option that waives it. A check that cannot be made has the verdict UNKNOWN.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

from flasher.events import WAY_BACK, CheckMade
from flasher.host.options import firmware_version
from flasher.host.table import Ending
from flasher.i18n import text
from flasher.image.image import Image
from flasher.image.plausible import Cpu, find_doubt
from flasher.image.release import Provenance, Release, target_problem
from flasher.protocol.contents import BatteryStatus, RunningInformation
from flasher.protocol.fields import Content
from flasher.protocol.spec import Target
from flasher.protocol.text import FirmwareVersion, printable

DEFAULT_LOW_CHARGE_PERCENT: Final = 20
DEFAULT_MINIMUM_CHARGE_PERCENT: Final = 5
"""An upgrade takes a minute or two; near 0 % the battery may switch itself off within it."""
DEFAULT_IN_USE_MA: Final = 1000
"""Discharge current in mA: more than lights and displays use, less than the motor."""


class IdentityCheck(Enum):
    """Identity checks; the value is the check's name in events and in the option that waives it."""

    PLAUSIBLE = "implausible"
    TARGET = "other-target"
    HARDWARE = "hardware"
    DOWNGRADE = "downgrade"
    PREVIOUS = "previous-version"
    SAME_VERSION = "same-version"
    IN_USE = "in-use"
    CHARGE = "low-charge"
    WAY_BACK = WAY_BACK
    """An image of the version that runs now."""
    UNSIGNED = "unsigned"
    """Rules of the trust file: signatures before, counters with the device."""

    @property
    def option(self) -> str:
        """Command-line option that waives the check."""
        return f"--allow-{self.value}"


WAIVABLE: Final = (
    IdentityCheck.PLAUSIBLE,
    IdentityCheck.TARGET,
    IdentityCheck.HARDWARE,
    IdentityCheck.DOWNGRADE,
    IdentityCheck.PREVIOUS,
    IdentityCheck.IN_USE,
    IdentityCheck.CHARGE,
    IdentityCheck.UNSIGNED,
)
"""Checks that can refuse an upgrade; the others only warn."""
OF_STATE: Final = frozenset({IdentityCheck.IN_USE, IdentityCheck.CHARGE})
"""Checks of a state that changes from one minute to the next."""
_ENDINGS: Final[Mapping[IdentityCheck, Ending]] = {
    IdentityCheck.PLAUSIBLE: Ending.IMPLAUSIBLE,
    IdentityCheck.IN_USE: Ending.IN_USE,
    IdentityCheck.CHARGE: Ending.LOW_CHARGE,
    IdentityCheck.SAME_VERSION: Ending.UP_TO_DATE,
    IdentityCheck.UNSIGNED: Ending.NOT_TRUSTED,
}
"""Ending of a session by its refused check, if not NOT_FOR_DEVICE."""


class CheckVerdict(Enum):
    """Verdict of an identity check; the value is its name in events."""

    PASSED = "passed"
    UNKNOWN = "unknown"
    """There was no value to compare with."""
    WARNED = "warned"
    WAIVED = "waived"
    REFUSED = "refused"
    SKIPPED = "skipped"
    """The upgrade is skipped, as requested."""


class CheckResult(NamedTuple):
    """Identity check with its verdict and a sentence about it."""

    check: IdentityCheck
    verdict: CheckVerdict
    text: str
    other_waivers: str = ""
    """Other ways to waive the check; continues the sentence that names the option."""
    is_unchecked: bool = False
    """True if a rule of the manifest could not be checked."""
    is_certain: bool = False
    """True if the image is another kind of file: a waiver works, but is not offered."""

    @property
    def event(self) -> CheckMade:
        """Event that reports the result."""
        return CheckMade(self.check.value, self.verdict.value, self.text)

    @property
    def ending(self) -> Ending | None:
        """Ending of the session that the result causes; None if the session continues."""
        if self.verdict not in (CheckVerdict.REFUSED, CheckVerdict.SKIPPED):
            return None
        if self.is_unchecked:
            return Ending.UNCHECKED
        return _ENDINGS.get(self.check, Ending.NOT_FOR_DEVICE)

    @property
    def waiver(self) -> str:
        """Name of the refused check if it can be waived, else empty."""
        is_offered = self.verdict is CheckVerdict.REFUSED and not self.is_certain
        return self.check.value if is_offered and self.check in WAIVABLE else ""

    @property
    def detail(self) -> str:
        """The problem, and the options that waive the check."""
        if not self.waiver:
            return self.text
        return f"{self.text}; {self.check.option} waives this{self.other_waivers}"


@dataclass(frozen=True)
class Identity:
    """Rules and limits for the identity checks of an upgrade."""

    release: Release | None = None
    """Manifest of the image, if any."""
    waived: frozenset[IdentityCheck] = frozenset()
    skip_same_version: bool = False
    low_charge_percent: int = DEFAULT_LOW_CHARGE_PERCENT
    """Warn below this state of charge."""
    minimum_charge_percent: int = DEFAULT_MINIMUM_CHARGE_PERCENT
    """Refuse below this state of charge, unless a charger is connected."""
    in_use_ma: int = DEFAULT_IN_USE_MA
    """Discharge current in mA above which the vehicle counts as in use."""
    reports_unchecked: bool = False
    """Only report rules of the manifest that cannot be checked, because the device runs no
    application (rescue)."""
    cpu: Cpu = Cpu.CORTEX_M
    """Processor type of the device, for the plausibility check."""
    provenance: Provenance | None = None
    """Result of checking the image against the trust file; None without one."""
    images_here: Mapping[str, str] | None = None
    """Files of this computer by the firmware version inside; None where nobody looked."""

    def matches_bytes(self, image: Image) -> bool:
        """True if the manifest contains the SHA-256 of this image."""
        return self.release is not None and self.release.sha256 == image.sha256

    def refusal(self, check: IdentityCheck, text: str, other_waivers: str = "") -> CheckResult:
        """Create the result of a failed check: refused, or waived."""
        verdict = CheckVerdict.WAIVED if check in self.waived else CheckVerdict.REFUSED
        return CheckResult(check, verdict, text, other_waivers)

    def uncheckable(self, check: IdentityCheck, text: str) -> CheckResult:
        """Create the result for a rule of the manifest that cannot be checked. It refuses like a
        failed rule, but --allow-hardware also waives it.
        """
        if self.reports_unchecked:
            return CheckResult(
                IdentityCheck.HARDWARE, CheckVerdict.UNKNOWN, f"{text}: goes on unchecked"
            )
        if check in self.waived:
            return CheckResult(check, CheckVerdict.WAIVED, text)
        return self.refusal(IdentityCheck.HARDWARE, text)._replace(is_unchecked=True)


@dataclass(frozen=True)
class DeviceAnswers:
    """Answers of the running application; None for a missing answer."""

    version: Content | None = None
    running: RunningInformation | None = None

    @property
    def hardware_version(self) -> str | None:
        """Hardware version, escaped; None if not answered."""
        hardware = getattr(self.version, "hardware_version", None)
        return None if hardware is None else str(hardware)

    @property
    def firmware_version(self) -> str | None:
        """Firmware version, escaped; None if not answered."""
        return None if self.version is None else firmware_version(self.version)


def new_version(image: Image, release: Release | None) -> str | None:
    """Firmware version in the image, else in the manifest; None if unknown."""
    return image.version or (release.firmware_version if release else None)


# -- the image by itself ----------------------------------------------------------------------


def judge_image(image: Image, target: Target, identity: Identity) -> Iterator[CheckResult]:
    """Check signatures, that image and manifest are for the target, and that the image can be a
    program.
    """
    if identity.provenance is not None:
        yield _provenance(identity, identity.provenance)
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


def _provenance(identity: Identity, found: Provenance) -> CheckResult:
    if found.problem is not None:
        return identity.refusal(IdentityCheck.UNSIGNED, found.text)
    verdict = CheckVerdict.PASSED if found.signers else CheckVerdict.UNKNOWN
    return CheckResult(IdentityCheck.UNSIGNED, verdict, found.text)


def judge_bytes(image: Image, identity: Identity) -> Iterator[CheckResult]:
    """Check that the image can be a program for the device; no result if it looks like one."""
    found = find_doubt(image)
    if found is None:
        return
    text = f"the image {found.text}"
    if not found.is_certain and identity.cpu is not Cpu.CORTEX_M:
        text += ": the profile names another processor"
        yield CheckResult(IdentityCheck.PLAUSIBLE, CheckVerdict.UNKNOWN, text)
    elif not found.is_certain and identity.matches_bytes(image):
        text += ": the manifest was made for these very bytes"
        yield CheckResult(IdentityCheck.PLAUSIBLE, CheckVerdict.UNKNOWN, text)
    else:
        refused = identity.refusal(IdentityCheck.PLAUSIBLE, text, found.other_waivers)
        yield refused._replace(is_certain=found.is_certain)


# -- the device -------------------------------------------------------------------------------


def judge_device(
    image: Image, target: Target, identity: Identity, answers: DeviceAnswers
) -> Iterator[CheckResult]:
    """Compare image and manifest with the application's answers, which may be missing."""
    if answers.version is None:
        yield _versions_unknown(identity, target)
        yield from _counter(identity, "")
    else:
        yield _hardware(identity, answers.hardware_version)
        yield from _versions(image, identity, answers.firmware_version or "")
        yield from _way_back(image, target, identity, answers.firmware_version or "")
        yield from _counter(identity, str(getattr(answers.version, "serial_number", "")))
    if answers.running is not None:
        yield from _state(identity, answers.running)


def _versions_unknown(identity: Identity, target: Target) -> CheckResult:
    """Result for an application that does not answer, or has no version query."""
    release = identity.release
    hardware = release is not None and bool(release.hardware_versions)
    previous = release is not None and release.rules_previous
    if not hardware and not previous:
        sentence = text(
            "the {node}'s application reported no version: neither hardware nor downgrade can be "
            "checked",
            node=target.node.name,
        )
        return CheckResult(IdentityCheck.HARDWARE, CheckVerdict.UNKNOWN, sentence)
    rules = " and ".join(["hardware"] * hardware + ["the version that is replaced"] * previous)
    sentence = text(
        "the {node}'s application reported no version: the manifest's rule on {rules} cannot "
        "be checked",
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
    """Compare the running version with the new one and with the manifest's rules."""
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


def _way_back(
    image: Image, target: Target, identity: Identity, running: str
) -> Iterator[CheckResult]:
    """Report whether this computer has an image of the version that is replaced."""
    files = identity.images_here
    if files is None or not running or running == new_version(image, identity.release):
        return
    if running in files:
        sentence = text(
            "{file} on this computer has {running}, which runs now",
            file=files[running],
            running=running,
        )
        yield CheckResult(IdentityCheck.WAY_BACK, CheckVerdict.PASSED, sentence)
        return
    sentence = text(
        "no image of {running}, which runs now, was found on this computer: there is no way back",
        running=running,
    )
    if target.has_version_query:
        sentence = text(
            "no image of {running}, which runs now, was found on this computer: a backup of the "
            "{node} before, with its memory, is a way back",
            running=running,
            node=target.node.name,
        )
    yield CheckResult(IdentityCheck.WAY_BACK, CheckVerdict.UNKNOWN, sentence)


def _previous(release: Release, identity: Identity, running: str) -> Iterator[CheckResult]:
    """Check the manifest's rules about the version to be replaced, if any."""
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


def _counter(identity: Identity, serial_number: str) -> Iterator[CheckResult]:
    """Compare the counter of a signed release with the highest that the device received."""
    release, provenance = identity.release, identity.provenance
    if release is None or release.counter is None or provenance is None or not provenance.signers:
        return
    if not serial_number:
        sentence = text(
            "the device reports no serial number: whether it received a newer release is not known"
        )
        yield CheckResult(IdentityCheck.UNSIGNED, CheckVerdict.UNKNOWN, sentence)
        return
    highest = provenance.highest_counters.get(serial_number, 0)
    if release.counter < highest:
        sentence = text(
            "the counter of the release is {counter}, and this device received {highest} before",
            counter=release.counter,
            highest=highest,
        )
        yield identity.refusal(IdentityCheck.UNSIGNED, sentence)


def _state(identity: Identity, running: RunningInformation) -> Iterator[CheckResult]:
    """Check state of charge and current; a discharge current is negative (table 5)."""
    if running.mean_current_ma < -identity.in_use_ma:
        sentence = text(
            "the battery gives {current_ma} mA, more than {limit_ma} mA",
            current_ma=-running.mean_current_ma,
            limit_ma=identity.in_use_ma,
        )
        yield identity.refusal(IdentityCheck.IN_USE, sentence)
    charge = running.state_of_charge_percent
    is_charging = BatteryStatus.CHARGER_CONNECTED in running.status
    if charge < identity.minimum_charge_percent and not is_charging:
        sentence = text(
            "the battery is at {charge} %, less than {minimum} %, and no charger is connected",
            charge=charge,
            minimum=identity.minimum_charge_percent,
        )
        yield identity.refusal(IdentityCheck.CHARGE, sentence)
    elif charge < identity.low_charge_percent:
        sentence = text(
            "the battery is at {charge} %: charge it first, if it can wait", charge=charge
        )
        yield CheckResult(IdentityCheck.CHARGE, CheckVerdict.WARNED, sentence)
