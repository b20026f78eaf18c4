"""Catalogue of the cases: registration by `@case(...)`, selection, and what a bench cannot judge.

`flasher.conformance.cases` explains how to write a case.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

from flasher.conformance.clauses import clause_texts
from flasher.conformance.results import CaseText, Gap
from flasher.conformance.subject import Subject, readback_source
from flasher.conformance.waits import Waits
from flasher.conformance.wire import reported_version
from flasher.errors import UsageError, did_you_mean

if TYPE_CHECKING:  # the profile needs the validation library, which the list of groups does not
    from flasher.conformance.bench import Bench
    from flasher.conformance.profile import ConformanceProfile

BRING_UP: Final = "BR-01"
"""The case that fails, with a diagnosis, when the device cannot be upgraded at all."""
GROUPS: Final = {
    "BR": "bring-up",
    "FR": "framing",
    "CR": "checksum",
    "RS": "reset and boot version",
    "UP": "update command",
    "TX": "transfer",
    "EN": "end of transfer",
    "TM": "timing",
    "BU": "bus",
    "PW": "power",
    "SE": "bad input",
    "CO": "concurrency",
    "SO": "soak",
    "SP": "speed",
}
"""Groups in catalogue order, with their titles."""
WEAR: Final = {"SO-01": 1000, "SP-01": 50, "SP-02": 60}
"""Cases that run only when they or their groups are named, with the default number of upgrades."""
NOT_IMPLEMENTED: Final[dict[str, str]] = {
    "BU-07": "frames with equal ids that start in the same bit time: needs an injector on the line"
}
"""Bootloader cases that software cannot run, with the reason; reported as unsupported."""
HOST_CASES: Final = (
    *("RS-06", "RS-07", "RS-08", "RS-09"),
    "UP-07",
    *("TX-09", "TX-10", "TX-11"),
    *("EN-03", "EN-05", "EN-06"),
    *("TM-01", "TM-03", "TM-04"),
    *("BU-03", "BU-04", "BU-05"),
    "PW-03",
    "SE-02",
    "CO-03",
)
"""Cases of the host, which run against flasher's own host in the project's tests."""
QUICK: Final = (
    BRING_UP,
    *("FR-02", "FR-03", "FR-04", "FR-08", "FR-09"),
    "CR-04",
    *("RS-01", "RS-05"),
    *("UP-03", "UP-05", "UP-08"),
    *("TX-01", "TX-02", "TX-03", "TX-05", "TX-08"),
    *("EN-02", "EN-07", "EN-08"),
    "BU-06",
)
"""Cases of a quick run: those that take the least time on the bus."""


class Requirement(Enum):
    """A need or an effect of a case; reports and options use the value."""

    POWER = "power"
    """Switches the device off and on."""
    READBACK = "readback"
    """Reads the flash by other means than the protocol."""
    IMAGE_READBACK = "image-readback"
    """Compares the flash with the running image, by readback or by memory queries over the bus."""
    BUS_OFF = "bus-off"
    """Forces the device's CAN controller into bus-off."""
    TIMED_CUT = "timed-cut"
    """Cuts the power at the moment of a flash operation or a frame."""
    FAILING_FLASH = "failing-flash"
    """Makes calls of the flash driver fail."""
    SECOND_IMAGE = "second-image"
    """Needs a second good image, smaller than the first one."""
    CHECKSUM = "checksum"
    """Needs images that contain a checksum (profile key en_04)."""
    DESTRUCTIVE = "destructive"
    """May erase the application, which is restored after the case."""
    LONG = "long"
    """Takes more than a few seconds on a real bus."""
    TIMING = "timing"
    """Judges times, so the accuracy of the adapter's time stamps matters."""
    ERROR_FRAMES = "error-frames"
    """Sends error frames."""
    VERSION = "version"
    """Needs an application that reports its version."""
    APPLICATION = "application"
    """Judges an application that runs before the case: without one it cannot fail."""


APPLICATION: Final = Requirement.APPLICATION
DESTRUCTIVE: Final = Requirement.DESTRUCTIVE
LONG: Final = Requirement.LONG
POWER: Final = Requirement.POWER
TIMING: Final = Requirement.TIMING
CaseScript = Callable[["Bench"], None]


@dataclass(frozen=True)
class Case:
    """One case of the catalogue. `clause` names keys of `clauses.CLAUSES`; `choices` are the
    profile keys that decide its verdict.
    """

    id: str
    title: str
    clause: str
    stimulus: str
    expectation: str
    run: CaseScript
    requires: frozenset[Requirement] = frozenset()
    choices: tuple[str, ...] = ()
    limit_s: float = 300.0
    """What the case itself needs on the bench's clock, with a device that answers at once."""
    upgrades: int = 40
    """Adds the time of this many upgrades at the limits of the profile."""
    largest: int = 0
    """Adds the time of this many upgrades to the largest image."""

    def choices_in(self, profile: ConformanceProfile) -> dict[str, str]:
        """The choices that decide its verdict, as this profile states them."""
        return {key: profile.choice(key) for key in self.choices}

    def limit_with(self, profile: ConformanceProfile, subject: Subject) -> float:
        """Time limit of the case for this device, on the bench's clock."""
        waits = Waits(profile, subject.port.bitrate_bps)
        largest_s = waits.upgrade_s(profile.number("largest_image_bytes"))
        own_s = waits.upgrade_s(len(subject.firmware.good))
        return self.limit_s + self.upgrades * own_s + self.largest * largest_s


CASES: Final[dict[str, Case]] = {}
"""All cases by id; filled by importing `flasher.conformance.cases`."""


def case(
    case_id: str, title: str, *, clause: str, requires: Collection[Requirement] = (), **more: Any
) -> Callable[[CaseScript], CaseScript]:
    """Register the decorated function as a case with the fields of `Case`. Raises ValueError for a
    duplicate id or an unknown clause.
    """

    def register(run: CaseScript) -> CaseScript:
        if case_id in CASES:
            raise ValueError(f"duplicate case {case_id}")
        clause_texts(clause)
        needs = frozenset(requires)
        CASES[case_id] = Case(case_id, title, clause, run=run, requires=needs, **more)
        return run

    return register


def group_of(case_id: str) -> str:
    """The group of a case id: "TX" for "TX-03"."""
    return case_id.partition("-")[0]


def known_cases() -> tuple[str, ...]:
    """Ids of all cases, including those not implemented."""
    return (*CASES, *NOT_IMPLEMENTED)


def catalogue_order(case_ids: Iterable[str]) -> list[str]:
    """Sort case ids into catalogue order."""
    groups = list(GROUPS)
    return sorted(case_ids, key=lambda case_id: (groups.index(group_of(case_id)), case_id))


def case_text(case_id: str, profile: ConformanceProfile) -> CaseText:
    """The texts of a case for reports."""
    case = CASES.get(case_id)
    deviation = profile.deviations.get(case_id, "")
    if case is None:
        why = NOT_IMPLEMENTED[case_id]
        return CaseText(case_id, group_of(case_id), why, deviation=deviation)
    return CaseText(
        case_id,
        group_of(case_id),
        case.title,
        case.clause,
        clause_texts(case.clause),
        case.stimulus,
        case.expectation,
        tuple(sorted(need.value for need in case.requires)),
        case.choices_in(profile),
        deviation,
    )


# -- which cases a run has ------------------------------------------------------------------------


@dataclass(frozen=True)
class Selection:
    """Which cases to run: `cases` and `groups`, or all except `WEAR` when both are empty; with
    `quick` only `QUICK` and `cases`; never `excluded` cases or groups.
    """

    cases: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    quick: bool = False
    excluded: tuple[str, ...] = ()

    def has(self, case_id: str) -> bool:
        """True when the case is to be run; a case named in `cases` runs however long it takes."""
        if case_id in self.excluded or group_of(case_id) in self.excluded:
            return False
        if case_id in self.cases:
            return True
        is_named = group_of(case_id) in self.groups
        if not (self.cases or self.groups):
            is_named = case_id not in WEAR
        return is_named and (not self.quick or case_id in QUICK)

    def chosen(self) -> list[str]:
        """Ids of the cases to run, in catalogue order."""
        return [case_id for case_id in catalogue_order(known_cases()) if self.has(case_id)]

    def wears(self, upgrades: int | None = None) -> dict[str, int]:
        """Selected cases of `WEAR`, with their number of upgrades."""
        return {case_id: upgrades or count for case_id, count in WEAR.items() if self.has(case_id)}

    def check(self) -> None:
        """Raise UsageError for a case or group that does not exist."""
        for given, known, what in (
            (self.cases, known_cases(), "case"),
            (self.groups, tuple(GROUPS), "group"),
            (self.excluded, (*GROUPS, *known_cases()), "case or group"),
        ):
            for name in given:
                if name not in known:
                    raise UsageError(
                        f"There is no {what} {name!a}.",
                        remedy=did_you_mean(name, known).rstrip() or "--list shows all of them.",
                    )


# -- what a bench cannot judge --------------------------------------------------------------------

_SIMULATED: Final = "--mock, or --subject"
MISSING_ON_BARE_BENCH: Final = {
    Requirement.POWER: ("power control", "--power-cmd"),
    Requirement.READBACK: ("readback of the flash", "--readback-cmd"),
    Requirement.IMAGE_READBACK: (
        "readback of the running image",
        "--readback-cmd; for a BMS with memory queries, device.application_address in the profile",
    ),
    Requirement.SECOND_IMAGE: ("a second good image", "--second-image"),
    Requirement.BUS_OFF: ("a way to make the device go bus-off", _SIMULATED),
    Requirement.TIMED_CUT: ("power cuts at the moment of a flash operation or a frame", _SIMULATED),
    Requirement.FAILING_FLASH: (
        "flash memory that can be made to fail",
        "--subject, with the current files of `flasher conformance header`",
    ),
    Requirement.ERROR_FRAMES: ("an adapter that sends error frames", _SIMULATED),
}
"""Equipment missing on a bench of device, adapter and good image: text, and the option that adds
it.
"""
_LACKS: Final = {
    **MISSING_ON_BARE_BENCH,
    Requirement.CHECKSUM: (
        "images with their own checksum",
        "a product that has one and en_04 in the profile",
    ),
    Requirement.VERSION: (
        "an application that reports its version",
        "a BMS, and an image that contains one version",
    ),
}
FULL_BENCH: Final = (
    *(Requirement.POWER, Requirement.READBACK, Requirement.IMAGE_READBACK),
    Requirement.SECOND_IMAGE,
)
"""Requirements that can be added to a bench with a real device."""
_IN_PART: Final = {
    Requirement.SECOND_IMAGE: ("EN-01", "EN-07", "SO-01"),
    Requirement.TIMED_CUT: ("PW-01",),
    Requirement.ERROR_FRAMES: ("FR-09",),
    Requirement.READBACK: (
        *("FR-01", "FR-02", "FR-03", "FR-04", "FR-06", "FR-09", "FR-10"),
        *("CR-01", "CR-02", "CR-03"),
        *("TX-07", "TM-02", "PW-01", "SE-04"),
    ),
    Requirement.VERSION: ("SE-01", "SP-01"),
}
"""Cases that are judged only in part without a requirement."""
_WITHOUT_FLASH: Final = ("FR-05", "FR-08", "CR-04", "EN-08", "TM-05", "SE-01", "SP-01")
"""Destructive cases that do not read the flash; all others compare it in some part."""


def missing_requirements(subject: Subject, profile: ConformanceProfile) -> list[Requirement]:
    """Requirements that this bench does not meet."""
    has = {
        Requirement.POWER: subject.has_power,
        Requirement.READBACK: subject.has_readback,
        Requirement.IMAGE_READBACK: bool(readback_source(subject, profile)),
        Requirement.SECOND_IMAGE: subject.second_image is not None,
        Requirement.BUS_OFF: subject.has_bus_off,
        Requirement.TIMED_CUT: subject.has_timed_cuts,
        Requirement.FAILING_FLASH: subject.flash_faults is not None,
        Requirement.ERROR_FRAMES: subject.port.sends_error_frames,
        Requirement.CHECKSUM: profile.choice("en_04") != "none",
        Requirement.VERSION: reported_version(subject.target, subject.good_image) is not None,
    }
    return [need for need, is_there in has.items() if not is_there]


def bench_gaps(lacks: Collection[Requirement], chosen: Iterable[str]) -> tuple[Gap, ...]:
    """List which of the `chosen` cases a bench without `lacks` cannot judge, fully or in part."""
    cases = [CASES[case_id] for case_id in chosen if case_id in CASES]
    run = [case for case in cases if not case.requires.intersection(lacks)]
    found = []
    for need, (name, remedy) in _LACKS.items():
        if need in lacks:
            unsupported = tuple(case.id for case in cases if need in case.requires)
            in_part = tuple(case.id for case in run if need.value in full_verdict_needs(case.id))
            if unsupported or in_part:
                found.append(Gap(need.value, name, remedy, unsupported, in_part))
    return tuple(found)


def full_verdict_needs(case_id: str) -> tuple[str, ...]:
    """Requirements for judging the whole case, in addition to those for running it."""
    case = CASES.get(case_id)
    found = [need for need, case_ids in _IN_PART.items() if case_id in case_ids]
    compares = case is not None and DESTRUCTIVE in case.requires and case_id not in _WITHOUT_FLASH
    if compares and Requirement.READBACK not in found:
        found.append(Requirement.IMAGE_READBACK)
    return tuple(need.value for need in found)


def why_unsupported(case: Case, subject: Subject, profile: ConformanceProfile) -> str:
    """Why this bench cannot run a case; "" when it can."""
    lacks = [
        _LACKS[need][0] for need in missing_requirements(subject, profile) if need in case.requires
    ]
    return f"needs {' and '.join(lacks)}" if lacks else ""
