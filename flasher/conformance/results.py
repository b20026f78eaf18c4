"""Results of a run as data: checks, measurements, verdicts, and the report that contains them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from flasher.conformance.wire import RawFrame
from flasher.validation import json_keys

if TYPE_CHECKING:
    from flasher.conformance.profile import ConformanceProfile

FINAL_IMAGE_OK: Final = "verified"
SCHEMA_VERSION: Final = 2
"""Version of the JSON report; incremented when a field changes its meaning or is removed."""
LINE_JOINT: Final = " | "
"""Joins the lines that a bootloader printed before it crashed, such as a sanitizer's report."""
CHECKS_KEPT: Final = 50
"""Largest number of failed checks of a case in JSON; all are counted."""


class CaseVerdict(Enum):
    """Verdict on a case; the members are ordered from best to worst."""

    PASS = "pass"  # noqa: S105  no password
    PASS_IN_PART = "pass_in_part"  # noqa: S105
    """The tried parts pass; reports list the parts that were not tried, with reasons."""
    INFO = "info"
    """Only measured or observed, nothing to judge."""
    UNSUPPORTED = "unsupported"
    """This bench cannot judge it; the note gives the reason."""
    DEVIATION = "deviation"
    """Failed in the way that the profile documents."""
    INCONCLUSIVE = "inconclusive"
    """The uncertainty of a measurement exceeds the margin, no stimulus was received, or two runs
    differ.
    """
    NOT_RUN = "not_run"
    """The run ended before it."""
    ERROR = "error"
    """The case itself failed: an error of the suite or the adapter, not of the device."""
    FAIL = "fail"

    @property
    def text(self) -> str:
        """Name in reports."""
        return self.value.replace("_", " ")


class CheckOutcome(Enum):
    """Result of one check."""

    PASS = "pass"  # noqa: S105  no password
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"
    UNSUPPORTED = "unsupported"


@dataclass(frozen=True)
class Check:
    """One check: the step of the case, the expected and the actual result."""

    step: str
    outcome: CheckOutcome
    expected: str
    got: str
    at_s: float
    judged_by: Mapping[str, str | float] = field(default_factory=dict)
    """Profile keys that decide a check which did not pass, with their values: the choices of its
    case, and the limits of a wait without an answer or of a time.
    """

    @property
    def expected_by(self) -> str:
        """The expected result, with the profile keys that decide it."""
        values = {
            key: value if isinstance(value, str) else f"{value:g}"
            for key, value in self.judged_by.items()
        }
        keys = ", ".join(f"{key} = {value}" for key, value in values.items())
        return f"{self.expected} (profile: {keys})" if keys else self.expected

    def __str__(self) -> str:
        step = f"{self.step}: " if self.step else ""
        return f"{step}expected {self.expected_by}; got {self.got}"


@dataclass(frozen=True)
class CheckCounts:
    """Number of checks of a case by outcome."""

    passed: int
    failed: int
    inconclusive: int
    unsupported: int


@dataclass(frozen=True)
class MeasuredTime:
    """One measured time; its name states both ends ("packet to ACK")."""

    name: str
    value_s: float
    uncertainty_s: float


@dataclass(frozen=True)
class Histogram:
    """Histogram with bins of equal width: one count less than edges."""

    edges_s: Sequence[float]
    counts: Sequence[int]


@dataclass(frozen=True)
class Times:
    """Distribution of the times of one name. Percentiles are measured values."""

    name: str
    count: int
    minimum_s: float
    median_s: float
    p95_s: float
    p99_s: float
    maximum_s: float
    uncertainty_s: float
    """Largest uncertainty of a single value."""
    histogram: Histogram


class TraceEntry(NamedTuple):
    """One frame of a case, in seconds since its start; `sent` by the suite or received."""

    at_s: float
    sent: bool
    frame: RawFrame


@dataclass(frozen=True)
class CaseText:
    """Texts of a case for reports."""

    id: str
    group: str
    title: str
    """The reason, for a case that cannot be run."""
    clause: str = ""
    """Labels of its clauses, separated by "; "."""
    clauses: Mapping[str, str] = field(default_factory=dict)
    """Label to text of each clause."""
    stimulus: str = ""
    expectation: str = ""
    requires: tuple[str, ...] = ()
    choices: Mapping[str, str] = field(default_factory=dict)
    """Profile keys that decided the verdict, with their values."""
    deviation: str = ""
    """Reason from the profile why the product may differ."""


@json_keys(
    "id=case_id repeat status=verdict seed note checks=counts findings not_tried infos"
    " deviation_resolved duration_s replay trace_file"
)
@dataclass(frozen=True)
class CaseResult:
    """Result of one run of a case."""

    case_id: str
    verdict: CaseVerdict
    repeat: int = 1  # from 1; with the case it identifies a result
    seed: str = ""
    note: str = ""
    checks: tuple[Check, ...] = ()
    measurements: tuple[MeasuredTime, ...] = ()
    infos: tuple[str, ...] = ()  # what was observed without being judged
    duration_s: float = 0.0
    trace: tuple[TraceEntry, ...] = ()
    trace_dropped: int = 0
    """Number of older frames that were dropped from the trace."""
    deviation_resolved: bool = False
    """The case passes although the profile documents a deviation."""
    replay: str = ""
    """Command that runs this case alone with its seed; empty without one."""
    trace_file: str = ""
    """Name of its trace file; empty without one."""

    @property
    def key(self) -> tuple[str, int]:
        return self.case_id, self.repeat

    @cached_property
    def counts(self) -> CheckCounts:
        outcomes = [check.outcome for check in self.checks]
        return CheckCounts(*map(outcomes.count, CheckOutcome))

    @cached_property
    def findings(self) -> tuple[Check, ...]:
        """The checks that did not pass, up to a maximum number."""
        bad = (check for check in self.checks if check.outcome is not CheckOutcome.PASS)
        return tuple(islice(bad, CHECKS_KEPT))

    @cached_property
    def not_tried(self) -> tuple[str, ...]:
        """Distinct checks of the case that this bench could not make, with reasons."""
        found = (one for one in self.checks if one.outcome is CheckOutcome.UNSUPPORTED)
        return tuple(dict.fromkeys(f"{one.expected} ({one.got})" for one in found))

    @property
    def first_failure(self) -> Check | None:
        """The first failed check, else the first inconclusive one, else None."""
        for outcome in (CheckOutcome.FAIL, CheckOutcome.INCONCLUSIVE):
            for check in self.checks:
                if check.outcome is outcome:
                    return check
        return None

    @property
    def reason(self) -> str:
        """Reason of the verdict in one line: the first failure, the untried parts, or the note."""
        if self.verdict is CaseVerdict.PASS_IN_PART:
            return f"not tried: {'; '.join(self.not_tried)}"
        return str(self.first_failure or self.note)


@dataclass(frozen=True)
class Gap:
    """Something the bench lacks, and the cases that it therefore cannot judge."""

    requirement: str
    lacks: str
    remedy: str
    """How to add it: an option, or another kind of device under test."""
    unsupported: tuple[str, ...]
    """Cases that cannot be run."""
    in_part: tuple[str, ...]
    """Cases that are judged only in part."""

    def __str__(self) -> str:
        """One line without the names of the cases."""
        costs = {"cannot be run": len(self.unsupported), "judged in part": len(self.in_part)}
        counts = ", ".join(f"{count} {what}" for what, count in costs.items() if count)
        return f"without {self.lacks}: {counts} (needs {self.remedy})"


@dataclass(frozen=True)
class Rescue:
    """A case after which only a power cycle restored the device."""

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

    # Times are in seconds on the bench's clock. `reports.completed` adds the start time, the
    # distribution of times, replay commands and trace files.
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
    """Selected cases that this bench could not judge, by what it lacks."""
    not_selected: tuple[str, ...] = ()  # cases that the selection left out
    host_cases: tuple[str, ...] = ()
    """Cases of the catalogue that concern the tool and are not part of this suite."""
    stopped: str = ""
    """Why the run ended early; empty for a complete run."""
    # True when `stopped` is a failure of the adapter, or of a power or readback command.
    adapter_failed: bool = False
    not_upgradable: str = ""
    """Why the good image could not be flashed at first; empty when it could."""
    # The cases ran anyway, as the bootloader was reachable, but without an application.
    killed_by: str = ""
    """The case after which the device could not be restored; empty for none."""
    rescues: tuple[Rescue, ...] = ()
    final_image: str = ""
    """"verified", or what is wrong with the good image at the end."""
    final_image_seen_by: tuple[str, ...] = ()  # "version", "readback", "memory over the bus"
    """How it was verified: version, readback; with neither, some application answers."""
    duration_s: float = 0.0
    started_at: str = ""
    """In UTC."""
    times: tuple[Times, ...] = ()

    @cached_property
    def report_schema(self) -> int:
        """Version of this report format."""
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
        """Number of results by status."""
        return {verdict.value: self.count(verdict) for verdict in CaseVerdict}

    def count(self, verdict: CaseVerdict) -> int:
        return sum(result.verdict is verdict for result in self.results)

    @property
    def resolved_deviations(self) -> tuple[str, ...]:
        """Cases that pass although the profile documents a deviation."""
        return tuple(result.case_id for result in self.results if result.deviation_resolved)

    @cached_property
    def ok(self) -> bool:
        """True when nothing failed, the good image could be flashed before the first case and is
        back on the device, and the run was not stopped early.
        """
        # A strict run also fails on a pass in part and on a resolved deviation.
        if self.stopped or self.not_upgradable or self.final_image != FINAL_IMAGE_OK:
            return False
        if self.strict and (self.resolved_deviations or self.count(CaseVerdict.PASS_IN_PART)):
            return False
        # A case that failed in one of two runs is inconclusive, and no reason to be content.
        bad = (CaseVerdict.FAIL, CaseVerdict.ERROR, CaseVerdict.NOT_RUN)
        unsure = CaseVerdict.INCONCLUSIVE
        return not any(
            result.verdict in bad or (result.verdict is unsure and result.counts.failed)
            for result in self.results
        )

    @property
    def headline(self) -> str:
        """The run in one line."""
        return count_text(self.results) or "no case"

    @property
    def in_full(self) -> str:
        """How many passes were judged in full; "" without any pass."""
        full = f"{self.passes_in_full} of {self.passes} passes were judged in full"
        return full if self.passes else ""

    @property
    def final_image_text(self) -> str:
        """State of the good image at the end, as text."""
        if self.final_image != FINAL_IMAGE_OK:
            return self.final_image or "not flashed: no case was run"
        if not self.final_image_seen_by:
            return "flashed, an application answers, but its version is unknown"
        none = "; no readback was possible" if self.final_image_seen_by == ("version",) else ""
        return f"flashed and verified by {' and '.join(self.final_image_seen_by)}{none}"

    @cached_property
    def not_tried(self) -> dict[str, list[str]]:
        """Reasons why checks were not made, with the cases that passed without them."""
        found: dict[str, dict[str, None]] = {}
        for _, result in self.by_case():
            for check in result.checks if result.verdict is CaseVerdict.PASS_IN_PART else ():
                if check.outcome is CheckOutcome.UNSUPPORTED:
                    found.setdefault(check.got, {})[result.case_id] = None
        return {why: list(case_ids) for why, case_ids in found.items()}

    def by_case(self) -> list[tuple[CaseText, CaseResult]]:
        """Every result with its case, in catalogue order."""
        return [
            (text, result)
            for text in self.cases
            for result in self.results
            if result.case_id == text.id
        ]

    def by_group(self) -> dict[str, list[tuple[CaseText, CaseResult]]]:
        found: dict[str, list[tuple[CaseText, CaseResult]]] = {}
        for text, result in self.by_case():
            found.setdefault(text.group, []).append((text, result))
        return found

    def measured(self) -> dict[str, list[MeasuredTime]]:
        """All measurements by name, in order of first occurrence."""
        found: dict[str, list[MeasuredTime]] = {}
        for result in self.results:
            for measurement in result.measurements:
                found.setdefault(measurement.name, []).append(measurement)
        return found

    def remarks(self) -> list[str]:
        """Remarks about the run itself, such as an early end; empty for a normal run."""
        lines = []
        if self.stopped:
            lines.append(f"the run ended early: {self.stopped}")
        if self.killed_by:
            lines.append(f"{self.killed_by} left a device that could not be restored")
        if self.not_upgradable:
            lines.append(
                "the good image could not be flashed before the first case, so that cases about a "
                f"running application had none: {self.not_upgradable}"
            )
        lines += [f"after {rescue.id}: {rescue.how}" for rescue in self.rescues]
        if self.strict and self.count(CaseVerdict.PASS_IN_PART):
            lines.append("the run is strict, so a pass in part fails it")
        if self.resolved_deviations:
            named = ", ".join(dict.fromkeys(self.resolved_deviations))
            lines.append(f"resolved deviations in the profile: {named}")
        return lines


def worst(verdicts: Iterable[CaseVerdict]) -> CaseVerdict:
    """The worst verdict. Raises ValueError for none."""
    return max(verdicts, key=list(CaseVerdict).index)


def count_text(results: Iterable[CaseResult]) -> str:
    """Count results by verdict, from best to worst; "" for none."""
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
    """A check failed that the rest of the case depends on; it is recorded."""


class Unsupported(CaseEnded):
    """This bench cannot do what the case needs."""


class CaseLimitReached(CaseEnded):
    """The case exceeded its time limit."""


class DeviceCrashed(CaseEnded):
    """The device model was used in a way that real hardware does not allow."""


class RunStopped(CaseEnded):
    """The run was asked to end."""


@json_keys("rule text steps first_steps replay")
@dataclass(frozen=True)
class WalkFinding:
    """A violation found by a walk."""

    rule: str
    """The violated rule: a short name that is stable between versions."""
    text: str
    steps: tuple[str, ...]
    """The shortest walk that reproduces it."""
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
    """Result of a series of walks."""

    subject: str
    seed: str
    walks: int
    steps: int
    coverage: tuple[StepCoverage, ...]  # every pair of phase and step that a walk may meet
    finding: WalkFinding | None = None
    stopped: str = ""
    """Why it ended early; empty when it did not."""

    @property
    def not_covered(self) -> list[tuple[str, str]]:
        """Pairs of phase and step that no walk reached."""
        return [(each.phase, each.step) for each in self.coverage if not each.count]


@dataclass(frozen=True)
class KeyAnswer:
    """Value determined for a profile key."""

    key: str
    value: str | int | float | None
    """None (null) for an open key."""
    seen: str
    """Observation, or why the key stays open."""


@json_keys("subject target answers report toml file stopped")
@dataclass(frozen=True)
class InitResult:
    """Profile determined from a device."""

    subject: str
    target: str
    answers: tuple[KeyAnswer, ...]  # every key of the profile, in order
    stopped: str = ""
    """Why it ended early; empty when it did not."""
    # An interrupted run must not be used.
    was_brought_up: bool = True
    """False when the good image could not be flashed before the first question."""
    report: RunReport | None = None
    """The quick cases, judged by this profile; null when they were not run."""
    toml: str = ""
    """The profile file's content; empty when none is written."""
    file: str = ""
    """Path of the profile file; empty when none was written."""

    def profile(self, start: ConformanceProfile) -> ConformanceProfile:
        """Make a profile of the answers; open keys keep their values of `start`."""
        from flasher.conformance.profile import ConformanceProfile  # noqa: PLC0415  loads pydantic

        found = {one.key: one for one in self.answers if one.value is not None}
        given = {key: one.value for key, one in found.items() if one.value is not None}
        why = {key: one.seen for key, one in found.items()}
        return ConformanceProfile(
            {**start.given, **given}, {**start.rationales, **why}, start.deviations
        )

    @property
    def open_keys(self) -> dict[str, str]:
        """Keys that stay open, with the reason."""
        return {one.key: one.seen for one in self.answers if one.value is None}
