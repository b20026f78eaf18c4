"""The results of a run as data: checks, measurements, verdicts, and the report that holds them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from itertools import islice
from typing import Final, NamedTuple

from flasher.conformance.wire import RawFrame
from flasher.validation import json_keys

FINAL_IMAGE_OK: Final = "verified"
SCHEMA_VERSION: Final = 2
"""Of a report in JSON: counts up when a field changes its meaning or goes away; not for a new
one."""
CHECKS_KEPT: Final = 50
"""Checks of one case that JSON has, those that did not pass; all are counted."""


class CaseVerdict(Enum):
    """The verdict on a case; the members are in order of gravity, the best first."""

    PASS = "pass"  # noqa: S105  no password
    PASS_IN_PART = "pass_in_part"  # noqa: S105
    """What was tried passes, but a part was not tried: it is told which, and why."""
    INFO = "info"
    """Nothing to judge, only measured or observed."""
    UNSUPPORTED = "unsupported"
    """Cannot be judged on this bench, for the reason in the note."""
    DEVIATION = "deviation"
    """Failed, as the profile says that it does."""
    INCONCLUSIVE = "inconclusive"
    """The uncertainty of the measurement is greater than the margin."""
    NOT_RUN = "not_run"
    """The run stopped before it."""
    ERROR = "error"
    """The case itself went wrong: the suite or the adapter, not the device."""
    FAIL = "fail"

    @property
    def text(self) -> str:
        """As reports name it."""
        return self.value.replace("_", " ")


class CheckOutcome(Enum):
    """How one check of a case ended."""

    PASS = "pass"  # noqa: S105  no password
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"
    UNSUPPORTED = "unsupported"


@dataclass(frozen=True)
class Check:
    """One check: the step of the case, what was expected and what was got."""

    step: str
    outcome: CheckOutcome
    expected: str
    got: str
    at_s: float
    """Seconds since the case began."""

    def __str__(self) -> str:
        step = f"{self.step}: " if self.step else ""
        return f"{step}expected {self.expected}; got {self.got}"


@dataclass(frozen=True)
class CheckCounts:
    """How many checks of a case ended how."""

    passed: int
    failed: int
    inconclusive: int
    unsupported: int


@dataclass(frozen=True)
class Measurement:
    """One measured time; the name says from what to what ("packet to ACK")."""

    name: str
    value_s: float
    uncertainty_s: float


@dataclass(frozen=True)
class Histogram:
    """How often values fell into bins of one width: as many counts as edges, less one."""

    edges_s: Sequence[float]
    counts: Sequence[int]


@dataclass(frozen=True)
class Times:
    """How the times of one name are spread. Percentiles are values that were measured."""

    name: str
    count: int
    minimum_s: float
    median_s: float
    p95_s: float
    p99_s: float
    maximum_s: float
    uncertainty_s: float
    """How far a single value may be off: the greatest of them."""
    histogram: Histogram


class TraceEntry(NamedTuple):
    """One frame of a case, in seconds since the case began; `sent` by the suite or received."""

    at_s: float
    sent: bool
    frame: RawFrame


@dataclass(frozen=True)
class CaseText:
    """What a report says about a case beside its result."""

    id: str
    group: str
    title: str
    """For a case that cannot be run, the reason."""
    clause: str = ""
    """What it is judged by, as the documents number it, parted by "; "."""
    clauses: Mapping[str, str] = field(default_factory=dict)
    """Each of these with its content."""
    stimulus: str = ""
    expectation: str = ""
    requires: tuple[str, ...] = ()
    choices: Mapping[str, str] = field(default_factory=dict)
    """Keys of the profile that the case was judged by, with their values."""
    deviation: str = ""
    """The reason in the profile why the device may differ."""


@json_keys(
    "id=case_id repeat status=verdict seed note checks=counts findings not_tried infos"
    " deviation_resolved duration_s replay trace_file"
)
@dataclass(frozen=True)
class CaseResult:
    """What came of one run of a case."""

    case_id: str
    verdict: CaseVerdict
    repeat: int = 1  # from 1; with the case it identifies a result
    seed: str = ""
    note: str = ""
    checks: tuple[Check, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    infos: tuple[str, ...] = ()  # what was observed without being judged
    duration_s: float = 0.0
    trace: tuple[TraceEntry, ...] = ()
    trace_dropped: int = 0
    """Frames that were not kept, as there were too many; the newest ones are kept."""
    deviation_resolved: bool = False
    """The profile documents a deviation, but the case passes."""
    replay: str = ""
    """The command that runs this case alone, with its seed; empty where there is none."""
    trace_file: str = ""
    """Name of the file with its frames; empty without one."""

    @property
    def key(self) -> tuple[str, int]:
        """Case id and repeat."""
        return self.case_id, self.repeat

    @cached_property
    def counts(self) -> CheckCounts:
        outcomes = [check.outcome for check in self.checks]
        return CheckCounts(*map(outcomes.count, CheckOutcome))

    @cached_property
    def findings(self) -> tuple[Check, ...]:
        """The checks that did not pass, the first ones of many."""
        bad = (check for check in self.checks if check.outcome is not CheckOutcome.PASS)
        return tuple(islice(bad, CHECKS_KEPT))

    @cached_property
    def not_tried(self) -> tuple[str, ...]:
        """The parts that this bench could not try, each with the reason."""
        found = (one for one in self.checks if one.outcome is CheckOutcome.UNSUPPORTED)
        return tuple(dict.fromkeys(f"{one.expected} ({one.got})" for one in found))

    @property
    def first_failure(self) -> Check | None:
        """The first check that failed, else the first that was inconclusive; None without any."""
        for outcome in (CheckOutcome.FAIL, CheckOutcome.INCONCLUSIVE):
            for check in self.checks:
                if check.outcome is outcome:
                    return check
        return None

    @property
    def reason(self) -> str:
        """Why the verdict is what it is, in one line: the first failure, what was not tried, or the
        note.
        """
        if self.verdict is CaseVerdict.PASS_IN_PART:
            return f"not tried: {'; '.join(self.not_tried)}"
        return str(self.first_failure or self.note)


@dataclass(frozen=True)
class Gap:
    """What a bench lacks, and what it cannot judge for that."""

    requirement: str
    lacks: str
    remedy: str
    """What adds it: an option, or another kind of device under test."""
    unsupported: tuple[str, ...]
    """Cases that cannot be run."""
    in_part: tuple[str, ...]
    """Cases that are judged in part."""

    def __str__(self) -> str:
        """In one line, without the names of the cases."""
        costs = {"cannot be run": len(self.unsupported), "judged in part": len(self.in_part)}
        said = ", ".join(f"{count} {what}" for what, count in costs.items() if count)
        return f"without {self.lacks}: {said} (it takes {self.remedy})"


@dataclass(frozen=True)
class Rescue:
    """A case after which only power brought the device back."""

    id: str
    how: str


@json_keys(
    "report_schema passed=ok started_at duration_s subject target bitrate_bps timestamp_source"
    " uncertainty_s seed strict profile_source profile stopped adapter_failed killed_by"
    " not_upgradable final_image final_image_seen_by passes passes_in_full not_tried counts cases"
    " results rescues times gaps not_selected host_cases"
)
@dataclass(frozen=True)
class RunReport:
    """A run of the conformance suite."""

    # Times are in seconds, on the bench's clock. What the clock of the computer tells, `times`,
    # and where each result is repeated and traced are added by `reports.completed`.
    subject: str
    target: str
    bitrate_bps: int
    timestamp_source: str
    uncertainty_s: float
    profile_source: str
    profile: Mapping[str, str | int | float]  # every key with its value
    seed: str
    strict: bool
    cases: tuple[CaseText, ...]  # those of `results`, each once, in the order of the catalogue
    results: tuple[CaseResult, ...]
    gaps: tuple[Gap, ...] = ()
    """What this bench could not judge of the selected cases, by what it lacks."""
    not_selected: tuple[str, ...] = ()  # cases that the selection left out
    host_cases: tuple[str, ...] = ()
    """Cases of the catalogue about the tool, which are no part of this suite."""
    stopped: str = ""
    """Why the run ended before its planned end; empty for a whole one."""
    # True when the adapter, or a command for power or readback, is what `stopped` is about.
    adapter_failed: bool = False
    not_upgradable: str = ""
    """Why the good image could not be flashed at first; empty when it could."""
    # The cases were run all the same, as the bootloader could be reached, and those that need an
    # application have none.
    killed_by: str = ""
    """The case after which the device could not be brought back; empty for none."""
    rescues: tuple[Rescue, ...] = ()
    final_image: str = ""
    """"verified", or what came of the good image at the end."""
    final_image_seen_by: tuple[str, ...] = ()  # "version", "readback", "memory over the bus"
    """By what it was verified: version, readback; with neither, some application answers."""
    duration_s: float = 0.0
    started_at: str = ""
    """In UTC."""
    times: tuple[Times, ...] = ()

    @cached_property
    def report_schema(self) -> int:
        """Version of this part."""
        return SCHEMA_VERSION

    @cached_property
    def passes(self) -> int:
        """Cases that passed, in full or in part."""
        return self.passes_in_full + self.count(CaseVerdict.PASS_IN_PART)

    @cached_property
    def passes_in_full(self) -> int:
        return self.count(CaseVerdict.PASS)

    @cached_property
    def counts(self) -> dict[str, int]:
        """How many results have each status."""
        return {verdict.value: self.count(verdict) for verdict in CaseVerdict}

    def count(self, verdict: CaseVerdict) -> int:
        """How many results have that verdict."""
        return sum(result.verdict is verdict for result in self.results)

    @property
    def resolved_deviations(self) -> tuple[str, ...]:
        """Cases that pass although the profile documents a deviation."""
        return tuple(result.case_id for result in self.results if result.deviation_resolved)

    @cached_property
    def ok(self) -> bool:
        """True when nothing failed, nothing was left out by an early end, and the good image is
        back on the device.
        """
        # A strict run has no pass in part, and no deviation that is none any more.
        if self.stopped or self.final_image != FINAL_IMAGE_OK:
            return False
        if self.strict and (self.resolved_deviations or self.count(CaseVerdict.PASS_IN_PART)):
            return False
        bad = (CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.NOT_RUN)
        return not any(result.verdict in bad for result in self.results)

    @property
    def headline(self) -> str:
        """The run in one line."""
        return count_text(self.results) or "no case"

    @property
    def in_full(self) -> str:
        """How many of the passes were judged in full; "" without any pass."""
        full = f"{self.passes_in_full} of {self.passes} passes were judged in full"
        return full if self.passes else ""

    @property
    def final_image_text(self) -> str:
        """What is known of the good image at the end, as people read it."""
        if self.final_image != FINAL_IMAGE_OK:
            return self.final_image or "not flashed: no case was run"
        if not self.final_image_seen_by:
            return "flashed, an application answers; nothing here tells which one it is"
        none = "; no readback was possible" if self.final_image_seen_by == ("version",) else ""
        return f"flashed and verified by {' and '.join(self.final_image_seen_by)}{none}"

    @cached_property
    def not_tried(self) -> dict[str, list[str]]:
        """Reasons why parts were not tried, with the cases that passed without them."""
        found: dict[str, dict[str, None]] = {}
        for _, result in self.by_case():
            for check in result.checks if result.verdict is CaseVerdict.PASS_IN_PART else ():
                if check.outcome is CheckOutcome.UNSUPPORTED:
                    found.setdefault(check.got, {})[result.case_id] = None
        return {why: list(case_ids) for why, case_ids in found.items()}

    def by_case(self) -> list[tuple[CaseText, CaseResult]]:
        """Every result with its case, in the order of the catalogue."""
        return [
            (text, result)
            for text in self.cases
            for result in self.results
            if result.case_id == text.id
        ]

    def by_group(self) -> dict[str, list[tuple[CaseText, CaseResult]]]:
        """The same, by group."""
        found: dict[str, list[tuple[CaseText, CaseResult]]] = {}
        for text, result in self.by_case():
            found.setdefault(text.group, []).append((text, result))
        return found

    def measured(self) -> dict[str, list[Measurement]]:
        """All measurements by name, in the order in which the names came first."""
        found: dict[str, list[Measurement]] = {}
        for result in self.results:
            for measurement in result.measurements:
                found.setdefault(measurement.name, []).append(measurement)
        return found

    def remarks(self) -> list[str]:
        """Remarks about the run itself, such as an early end; empty for a regular one."""
        lines = []
        if self.stopped:
            lines.append(f"the run ended early: {self.stopped}")
        if self.killed_by:
            lines.append(f"{self.killed_by} left a device that could not be brought back")
        if self.not_upgradable:
            lines.append(
                "the good image could not be flashed before the first case, so that cases about a "
                f"running application had none: {self.not_upgradable}"
            )
        lines += [f"after {rescue.id}: {rescue.how}" for rescue in self.rescues]
        if self.strict and self.count(CaseVerdict.PASS_IN_PART):
            lines.append("a pass in part is none, as the run is strict")
        if self.resolved_deviations:
            named = ", ".join(dict.fromkeys(self.resolved_deviations))
            lines.append(f"deviations in the profile that are none any more: {named}")
        return lines


def worst(verdicts: Iterable[CaseVerdict]) -> CaseVerdict:
    """The gravest of some verdicts. Raises ValueError for none."""
    return max(verdicts, key=list(CaseVerdict).index)


def count_text(results: Iterable[CaseResult]) -> str:
    """How many results have each verdict, from the best to the worst; "" for none."""
    verdicts = [result.verdict for result in results]
    return ", ".join(
        f"{verdicts.count(verdict)} {verdict.text}"
        for verdict in CaseVerdict
        if verdict in verdicts
    )


# -- how a case ends early ------------------------------------------------------------------------


class CaseEnded(Exception):  # noqa: N818  most of them are no errors
    """Base of the exceptions that end a case early; the text is the reason."""


class CaseStopped(CaseEnded):
    """A check failed that the rest of the case depends on; the check is recorded."""


class Unsupported(CaseEnded):
    """This bench cannot do what the case needs."""


class CaseLimitReached(CaseEnded):
    """The case took longer than it may."""


class DeviceCrashed(CaseEnded):
    """The device model stopped at something that a real part does not allow."""


class RunStopped(CaseEnded):
    """The run was asked to end."""


@json_keys("rule text steps first_steps replay")
@dataclass(frozen=True)
class WalkFinding:
    """What a walk found."""

    rule: str
    """Which rule was broken: short, and the same from version to version."""
    text: str
    steps: tuple[str, ...]
    """The shortest walk that finds it."""
    first_steps: tuple[str, ...]  # those of the walk that found it first
    trace: tuple[TraceEntry, ...] = ()
    replay: str = ""  # the command that takes `steps` again


@dataclass(frozen=True)
class StepCoverage:
    """How often a step was taken in a phase of the device."""

    phase: str
    step: str
    count: int


@json_keys("subject seed walks steps finding stopped coverage")
@dataclass(frozen=True)
class ExploreResult:
    """What came of the walks."""

    subject: str
    seed: str
    walks: int
    steps: int
    coverage: tuple[StepCoverage, ...]  # every pair of phase and step that a walk may meet
    finding: WalkFinding | None = None
    stopped: str = ""
    """Why it ended before its number of steps; empty when it did not."""

    @property
    def not_covered(self) -> list[tuple[str, str]]:
        """Pairs of phase and step that no walk met."""
        return [(each.phase, each.step) for each in self.coverage if not each.count]
