"""Two runs compared: what got better, worse, slower, what is new and what is gone.

Reads the files of `--json-report` (or the output of `--json`). A case that was run several times
counts with its worst verdict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from flasher.conformance.json_report import SCHEMA_VERSION, verdict_name
from flasher.conformance.results import CaseVerdict, worst
from flasher.errors import UsageError
from flasher.files import JSON_MAX_SIZE, parse_json, read
from flasher.protocol.text import printable

THRESHOLD_PERCENT: Final = 10.0
"""A median or 95th percentile that grew by more is slower, if it grew by more than what the two
measurements may be off together."""
_NOT_JUDGED: Final = frozenset({CaseVerdict.UNSUPPORTED, CaseVerdict.NOT_RUN})
_RANKS: Final = {verdict: rank for rank, verdict in enumerate(CaseVerdict)} | {CaseVerdict.INFO: 0}
_VERDICTS: Final = {verdict_name(verdict): verdict for verdict in CaseVerdict}
_CONDITIONS: Final = ("target", "bitrate_bps", "seed", "timestamp_source", "profile_source")


@dataclass(frozen=True)
class Times:
    """The times of one name, in seconds."""

    count: int
    median_s: float
    p95_s: float
    uncertainty_s: float


@dataclass(frozen=True)
class Run:
    """What is compared of a report."""

    source: str
    conditions: Mapping[str, str]
    profile: Mapping[str, object]
    titles: Mapping[str, str]
    verdicts: Mapping[str, CaseVerdict]
    reasons: Mapping[str, str]
    times: Mapping[str, Times]


class Change(NamedTuple):
    """A case whose verdict is another one; `before` or `after` is None where it was not run."""

    case_id: str
    title: str
    before: CaseVerdict | None
    after: CaseVerdict | None
    reason: str
    """What the newer run says of it."""


class Slowdown(NamedTuple):
    """A measured time that changed beyond the threshold."""

    name: str
    figure: str
    """"median" or "p95"."""
    before_s: float
    after_s: float

    @property
    def percent(self) -> float:
        """By how much it grew; negative for a faster one."""
        return (self.after_s / self.before_s - 1) * 100 if self.before_s else float("inf")


@dataclass(frozen=True)
class Difference:
    """How the newer run differs from the older one."""

    better: tuple[Change, ...] = ()
    worse: tuple[Change, ...] = ()
    new: tuple[Change, ...] = ()
    gone: tuple[Change, ...] = ()
    """Judged in the older run, and not in the newer one."""
    slower: tuple[Slowdown, ...] = ()
    faster: tuple[Slowdown, ...] = ()
    unchanged: int = 0
    threshold_percent: float = THRESHOLD_PERCENT
    conditions: tuple[str, ...] = ()
    """What else is not the same in both runs."""

    @property
    def is_worse(self) -> bool:
        """True when a case that was judged in both runs got worse, or a new one fails."""
        return bool(self.worse) or any(
            change.after in (CaseVerdict.FAIL, CaseVerdict.ERROR) for change in self.new
        )


def read_run(path: Path) -> Run:
    """Read a report. Raises UsageError for a file that cannot be read or is no report."""
    shown = printable(str(path))
    raw = read(path, JSON_MAX_SIZE, what="report")
    try:
        document = parse_json(raw)
    except ValueError as error:
        raise _no_report(
            shown, f"it is no JSON that can be read ({printable(str(error))})"
        ) from error
    if isinstance(document, dict) and isinstance(document.get("report"), dict):
        document = document["report"]  # what --json prints
    if not isinstance(document, dict) or "report_schema" not in document:
        raise _no_report(shown, "it holds no conformance report")
    if document["report_schema"] != SCHEMA_VERSION:
        raise _no_report(
            shown,
            f"its schema is version {printable(str(document['report_schema'])[:20])}, "
            f"and this program reads {SCHEMA_VERSION}",
        )
    try:
        return _run_of(document, shown)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise _no_report(shown, "a part of it is missing or wrong") from error


def compare(old: Run, new: Run, threshold_percent: float = THRESHOLD_PERCENT) -> Difference:
    """What is different in `new`."""
    better: list[Change] = []
    worse: list[Change] = []
    fresh: list[Change] = []
    gone: list[Change] = []
    unchanged = 0
    for case_id in dict.fromkeys((*new.verdicts, *old.verdicts)):
        before, after = _judged(old, case_id), _judged(new, case_id)
        title = new.titles.get(case_id) or old.titles.get(case_id, "")
        change = Change(case_id, title, before, after, new.reasons.get(case_id, ""))
        if before is None and after is None:
            continue
        if before is None:
            fresh.append(change)
        elif after is None:
            gone.append(change)
        elif _RANKS[after] == _RANKS[before]:
            unchanged += 1
        else:
            (worse if _RANKS[after] > _RANKS[before] else better).append(change)
    moved = _moved(old, new, threshold_percent)
    return Difference(
        tuple(better),
        tuple(worse),
        tuple(fresh),
        tuple(gone),
        tuple(one for one in moved if one.after_s > one.before_s),
        tuple(one for one in moved if one.after_s < one.before_s),
        unchanged,
        threshold_percent,
        tuple(_other_conditions(old, new)),
    )


def _judged(run: Run, case_id: str) -> CaseVerdict | None:
    status = run.verdicts.get(case_id)
    return None if status in _NOT_JUDGED else status


def _moved(old: Run, new: Run, threshold_percent: float) -> list[Slowdown]:
    """Times of both runs whose median or 95th percentile is another one."""
    found = []
    for name, after in new.times.items():
        before = old.times.get(name)
        if before is None:
            continue
        unsure_s = before.uncertainty_s + after.uncertainty_s
        for figure, was_s, is_s in (
            ("median", before.median_s, after.median_s),
            ("p95", before.p95_s, after.p95_s),
        ):
            grown_s = abs(is_s - was_s)
            if grown_s > unsure_s and grown_s > min(was_s, is_s) * threshold_percent / 100:
                found.append(Slowdown(name, figure, was_s, is_s))
                break
    return found


def _other_conditions(old: Run, new: Run) -> list[str]:
    found = [
        f"{key}: {old.conditions[key]}, then {new.conditions[key]}"
        for key in _CONDITIONS
        if old.conditions[key] != new.conditions[key]
    ]
    for key in dict.fromkeys((*old.profile, *new.profile)):
        before, after = old.profile.get(key), new.profile.get(key)
        if before != after:
            shown = (printable(str(value)[:60]) for value in (key, before, after))
            found.append("profile, {}: {}, then {}".format(*shown))
    return found


def _run_of(document: dict[str, Any], source: str) -> Run:
    verdicts: dict[str, list[CaseVerdict]] = {}
    reasons: dict[str, str] = {}
    for result in document["results"]:
        case_id = _shown(result["id"])
        status = _VERDICTS[result["status"]]
        verdicts.setdefault(case_id, []).append(status)
        findings = result["findings"]
        if findings and case_id not in reasons:
            step = f"{findings[0]['step']}: " if findings[0]["step"] else ""
            reasons[case_id] = _shown(
                f"{step}expected {findings[0]['expected']}; got {findings[0]['got']}"
            )
        elif result["note"]:
            reasons.setdefault(case_id, _shown(result["note"]))
    return Run(
        source,
        {key: _shown(document[key]) for key in _CONDITIONS},
        dict(document["profile"]),
        {_shown(case["id"]): _shown(case["title"]) for case in document["cases"]},
        {case_id: worst(found) for case_id, found in verdicts.items()},
        reasons,
        {
            _shown(one["name"]): Times(
                int(one["count"]),
                float(one["median_s"]),
                float(one["p95_s"]),
                float(one["uncertainty_s"]),
            )
            for one in document["times"]
        },
    )


def _shown(text: object) -> str:
    return printable(str(text))


def _no_report(shown: str, why: str) -> UsageError:
    return UsageError(
        f"{shown} is no report of the conformance suite: {why}.",
        remedy="Compare files that `flasher conformance --json-report FILE` wrote.",
    )
