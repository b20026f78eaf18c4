"""Which cases a run has, in which order, and which of them this bench cannot do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from flasher.conformance.cases.elsewhere import NOT_IMPLEMENTED
from flasher.conformance.model import CASES, Case, Requirement
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.subject import Subject
from flasher.errors import UsageError, did_you_mean

GROUPS: Final = ("FR", "CR", "RS", "UP", "TX", "EN", "TM", "BU", "PW", "SE", "CO")
"""The groups in the order of the catalogue."""
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


@dataclass(frozen=True)
class Selection:
    """Cases to run: those of `cases` and of `groups`, all when both are empty; without those that
    need or do what `without` names. Of a `quick` run, those of `QUICK` and of `cases`.
    """

    cases: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    quick: bool = False
    without: frozenset[Requirement] = frozenset()

    def has(self, case_id: str, requires: Iterable[Requirement] = ()) -> bool:
        """True for a case that is to be run."""
        if self.cases or self.groups:
            is_named = case_id in self.cases or case_id.partition("-")[0] in self.groups
        else:
            is_named = True
        # A case that was asked for by its id is run, however long it is.
        is_left_out = self.without.intersection(requires) or (self.quick and case_id not in QUICK)
        return is_named and (case_id in self.cases or not is_left_out)


def check_selection(selection: Selection) -> None:
    """Raise UsageError for a case or group that does not exist."""
    for given, known, what in (
        (selection.cases, (*CASES, *NOT_IMPLEMENTED), "case"),
        (selection.groups, GROUPS, "group"),
    ):
        for name in given:
            if name not in known:
                raise UsageError(
                    f"There is no {what} {name!a}.",
                    remedy=did_you_mean(name, known).rstrip() or "--list shows all of them.",
                )


def known_cases() -> tuple[str, ...]:
    """The ids of all cases, implemented or not."""
    return (*CASES, *NOT_IMPLEMENTED)


def in_order(case_ids: Iterable[str]) -> list[str]:
    """Case ids in the order of the catalogue."""
    return sorted(case_ids, key=lambda case_id: (GROUPS.index(case_id.partition("-")[0]), case_id))


def what_is_missing(case: Case, subject: Subject, profile: ConformanceProfile) -> str:
    """Why this bench cannot run a case; empty when it can."""
    is_there = {
        Requirement.POWER: subject.has_power,
        Requirement.READBACK: subject.has_readback,
        Requirement.BUS_OFF: subject.has_bus_off,
        Requirement.TIMED_CUT: subject.has_timed_cuts,
        Requirement.SECOND_IMAGE: subject.second_image is not None,
        Requirement.CHECKSUM: profile.choice("en_04") != "none",
    }
    lacks = [_LACKS[need] for need in _LACKS if need in case.requires and not is_there[need]]
    return f"needs {' and '.join(lacks)}" if lacks else ""


_LACKS: Final = {
    Requirement.POWER: "power control",
    Requirement.READBACK: "readback of the flash",
    Requirement.BUS_OFF: "a way to make the device go bus-off",
    Requirement.TIMED_CUT: "power cuts at the moment of a flash operation or a frame",
    Requirement.SECOND_IMAGE: "a second good image",
    Requirement.CHECKSUM: "images with a checksum of their own (profile, en_04)",
}
