"""The catalogue: what a case is, which cases there are, and which of them a run has.

A case registers itself with `@case(...)`; how to write one stands in `flasher.conformance.cases`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from flasher.conformance.clauses import contents
from flasher.conformance.results import CaseText
from flasher.conformance.subject import Subject
from flasher.errors import UsageError, did_you_mean

if TYPE_CHECKING:  # the profile needs the validation library, which the list of groups does not
    from flasher.conformance.bench import Bench
    from flasher.conformance.profile import ConformanceProfile

GROUPS: Final = {
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
}
"""The groups in the order of the catalogue, with their titles."""
NOT_IMPLEMENTED: Final[dict[str, str]] = {
    "BU-07": "frames of one id that begin in the same bit time: it takes an injector on the line",
}
"""Case of the bootloader to the reason why software cannot run it; reported as unsupported."""
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
"""Cases of the host: they run against flasher's own host, in the project's tests."""
QUICK: Final = (
    *("FR-02", "FR-03", "FR-04", "FR-08", "FR-09"),
    "CR-04",
    *("RS-01", "RS-05"),
    *("UP-03", "UP-05", "UP-08"),
    *("TX-01", "TX-02", "TX-03", "TX-05", "TX-08"),
    *("EN-02", "EN-07", "EN-08"),
    "BU-06",
)
"""What a quick run has: of every group that needs no minutes, what takes least on the bus."""


class Requirement(Enum):
    """What a case needs, or does; the value is how reports and options name it."""

    POWER = "power"
    """Switches the device off and on."""
    READBACK = "readback"
    """Reads the flash back past the protocol."""
    BUS_OFF = "bus-off"
    """Makes the device's CAN controller go off the bus."""
    TIMED_CUT = "timed-cut"
    """Cuts the power at the very moment of a flash operation or a frame."""
    SECOND_IMAGE = "second-image"
    """Needs a second good image, smaller than the first one."""
    CHECKSUM = "checksum"
    """Needs a product whose images carry a checksum of their own (profile, en_04)."""
    DESTRUCTIVE = "destructive"
    """Erases the application, or may; it is put back after the case."""
    LONG = "long"
    """Takes more than some seconds on a real bus."""
    TIMING = "timing"
    """Judges times: what the adapter's time stamps are worth decides."""


DESTRUCTIVE: Final = Requirement.DESTRUCTIVE
LONG: Final = Requirement.LONG
POWER: Final = Requirement.POWER
TIMING: Final = Requirement.TIMING
CaseScript = Callable[["Bench"], None]


@dataclass(frozen=True)
class Case:
    """One case of the catalogue. `clause` names what it is judged by, as `clauses` lists it;
    `choices` are the keys of the profile that decide.
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
    """The case is ended after this time on the bench's clock."""


CASES: Final[dict[str, Case]] = {}
"""All cases by id; filled by importing `flasher.conformance.cases`."""


def case(
    case_id: str,
    title: str,
    *,
    clause: str,
    stimulus: str,
    expectation: str,
    requires: Collection[Requirement] = (),
    choices: tuple[str, ...] = (),
    limit_s: float = 300.0,
) -> Callable[[CaseScript], CaseScript]:
    """Register the function below as a case. Raises ValueError for an id that is taken and a clause
    that does not exist.
    """

    def register(run: CaseScript) -> CaseScript:
        if case_id in CASES:
            raise ValueError(f"there are two cases {case_id}")
        contents(clause)
        needs = frozenset(requires)
        CASES[case_id] = Case(
            case_id, title, clause, stimulus, expectation, run, needs, choices, limit_s
        )
        return run

    return register


def group_of(case_id: str) -> str:
    """The first part of an id: "TX" of "TX-03"."""
    return case_id.partition("-")[0]


def known_cases() -> tuple[str, ...]:
    """The ids of all cases, implemented or not."""
    return (*CASES, *NOT_IMPLEMENTED)


def in_order(case_ids: Iterable[str]) -> list[str]:
    """Case ids in the order of the catalogue."""
    groups = list(GROUPS)
    return sorted(case_ids, key=lambda case_id: (groups.index(group_of(case_id)), case_id))


def case_text(case_id: str, profile: ConformanceProfile) -> CaseText:
    """What a report says about a case, implemented or not."""
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
        contents(case.clause),
        case.stimulus,
        case.expectation,
        tuple(sorted(need.value for need in case.requires)),
        {key: profile.choice(key) for key in case.choices},
        deviation,
    )


# -- which cases a run has ------------------------------------------------------------------------


@dataclass(frozen=True)
class Selection:
    """Cases to run: those of `cases` and of `groups`, all when both are empty; of a `quick` run,
    those of `QUICK` and of `cases`.
    """

    cases: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    quick: bool = False

    def has(self, case_id: str) -> bool:
        """True for a case that is to be run; one that is named is, however long it takes."""
        if case_id in self.cases:
            return True
        is_named = not (self.cases or self.groups) or group_of(case_id) in self.groups
        return is_named and (not self.quick or case_id in QUICK)

    def chosen(self) -> list[str]:
        """The ids of all cases to be run, in the order of the catalogue."""
        return [case_id for case_id in in_order(known_cases()) if self.has(case_id)]

    def check(self) -> None:
        """Raise UsageError for a case or group that does not exist."""
        for given, known, what in (
            (self.cases, known_cases(), "case"),
            (self.groups, tuple(GROUPS), "group"),
        ):
            for name in given:
                if name not in known:
                    raise UsageError(
                        f"There is no {what} {name!a}.",
                        remedy=did_you_mean(name, known).rstrip() or "--list shows all of them.",
                    )


def what_is_missing(case: Case, subject: Subject, profile: ConformanceProfile) -> str:
    """Why this bench cannot run a case; empty when it can."""
    needs = (
        (Requirement.POWER, subject.has_power, "power control"),
        (Requirement.READBACK, subject.has_readback, "readback of the flash"),
        (Requirement.BUS_OFF, subject.has_bus_off, "a way to make the device go bus-off"),
        (
            Requirement.TIMED_CUT,
            subject.has_timed_cuts,
            "power cuts at the moment of a flash operation or a frame",
        ),
        (Requirement.SECOND_IMAGE, subject.second_image is not None, "a second good image"),
        (
            Requirement.CHECKSUM,
            profile.choice("en_04") != "none",
            "images with a checksum of their own (profile, en_04)",
        ),
    )
    lacks = [name for need, is_there, name in needs if need in case.requires and not is_there]
    return f"needs {' and '.join(lacks)}" if lacks else ""
