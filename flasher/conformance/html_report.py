"""From a report to the page that `flasher.report` draws: verdicts as colours and words, checks,
and the frames of a case decoded, as far as a person reads them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Final

from flasher.conformance.model import CaseResult, Check, Outcome, TraceEntry
from flasher.conformance.model import Status as Verdict
from flasher.conformance.report import CaseText, Report
from flasher.conformance.summary import (
    by_case,
    distribution,
    end_of_run,
    group_title,
    headline,
    times,
)
from flasher.protocol.frame import Frame
from flasher.report.base import Status
from flasher.report.conformance_page import (
    CaseView,
    CheckRow,
    Fact,
    GroupView,
    RunView,
    TimesView,
    TraceRow,
    render,
)
from flasher.report.scale import duration_text
from flasher.trace.decoder import Decoder, Seen

CHECKS_SHOWN: Final = 12
"""Checks of a case that have a line: those that did not pass first."""
MESSAGES_BAD: Final = 80
"""Messages that a case that went wrong shows, the last ones before its first failed check."""
MESSAGES_GOOD: Final = 20
"""Messages that another case shows, from its beginning."""
_FRAMES_A_MESSAGE: Final = 20
_AFTER_S: Final = 0.02
"""What came so shortly after a failed check belongs to it."""
_INFOS_SHOWN: Final = 20

_COLOURS: Final[Mapping[Verdict, Status]] = {
    Verdict.PASS: Status.GOOD,
    Verdict.FAIL: Status.BAD,
    Verdict.ERROR: Status.BAD,
    Verdict.DEVIATION: Status.WARNING,
    Verdict.INCONCLUSIVE: Status.WARNING,
    Verdict.UNSUPPORTED: Status.NEUTRAL,
    Verdict.INFO: Status.NEUTRAL,
    Verdict.NOT_RUN: Status.NEUTRAL,
}
_CHECK_COLOURS: Final[Mapping[Outcome, Status]] = {
    Outcome.PASS: Status.GOOD,
    Outcome.FAIL: Status.BAD,
    Outcome.INCONCLUSIVE: Status.WARNING,
    Outcome.UNSUPPORTED: Status.NEUTRAL,
}
_BAD_FIRST: Final = (Outcome.FAIL, Outcome.INCONCLUSIVE, Outcome.UNSUPPORTED, Outcome.PASS)

Texts = Mapping[tuple[str, int], str]


def html_page(report: Report, *, started_at: str, replays: Texts, trace_files: Texts) -> str:
    """The page of a run. `replays` and `trace_files` are by case id and repeat."""
    cases: dict[str, list[CaseView]] = {}
    for text, results in by_case(report):
        for result in results:
            key = (result.case_id, result.repeat)
            view = _case(text, result, replays.get(key, ""), trace_files.get(key, ""))
            cases.setdefault(text.group, []).append(view)
    return render(
        RunView(
            subject=report.subject,
            status=Status.GOOD if report.ok else Status.BAD,
            word="passed" if report.ok else "not passed",
            headline=headline(report),
            remarks=tuple(end_of_run(report)),
            facts=tuple(_facts(report, started_at)),
            groups=tuple(
                GroupView(group, group_title(group), tuple(views)) for group, views in cases.items()
            ),
            times=tuple(
                TimesView(
                    name,
                    [one.value_s for one in found],
                    distribution(found),
                    max(one.uncertainty_s for one in found),
                )
                for name, found in times(report).items()
            ),
            times_text=_times_text(report),
            profile=tuple(Fact(key, str(value)) for key, value in report.profile.items()),
            profile_text=f"Judged by: {report.profile_source}.",
        )
    )


def _facts(report: Report, started_at: str) -> Sequence[Fact]:
    facts = [
        Fact("target", f"{report.target}, at {report.bitrate_bps // 1000} kbit/s"),
        Fact("started", started_at),
        Fact("time on the bus", duration_text(report.duration_s)),
        Fact("seed", report.seed + (", strict" if report.strict else "")),
        Fact("good image at the end", report.final_image or "not flashed: no case was run"),
    ]
    if report.not_selected:
        facts.append(Fact("not selected", f"{len(report.not_selected)} cases"))
    if report.host_cases:
        told = f"{len(report.host_cases)} cases of the catalogue are about the tool, not the device"
        facts.append(Fact("no part of this", told))
    return facts


def _times_text(report: Report) -> str:
    source = f"Time stamps: {report.timestamp_source}"
    if not report.uncertainty_s:
        return f"{source}, exact."
    return (
        f"{source}; one of them may be off by {duration_text(report.uncertainty_s)}. A time that "
        "is nearer to its limit than that is inconclusive."
    )


def _case(text: CaseText, result: CaseResult, replay: str, trace_file: str) -> CaseView:
    colour = _COLOURS[result.status]
    trace, trace_text = _trace(result, is_bad=colour is not Status.GOOD)
    repeat = f" (repeat {result.repeat})" if result.repeat > 1 else ""
    checks = sorted(result.checks, key=lambda check: _BAD_FIRST.index(check.outcome))
    return CaseView(
        id=text.id,
        title=f"{text.title}{repeat}",
        clause=text.clause,
        stimulus=text.stimulus,
        expectation=text.expectation,
        status=colour,
        word=result.status.value,
        note=result.note,
        facts=tuple(_case_facts(text, result, trace_file)),
        replay=replay if colour in (Status.BAD, Status.WARNING) else "",
        checks=tuple(map(_check, checks[:CHECKS_SHOWN])),
        checks_left_out=max(0, len(checks) - CHECKS_SHOWN),
        infos=result.infos[:_INFOS_SHOWN],
        trace=trace,
        trace_text=trace_text,
    )


def _case_facts(text: CaseText, result: CaseResult, trace_file: str) -> Sequence[Fact]:
    facts = []
    if text.requires:
        facts.append(Fact("requirements", ", ".join(text.requires)))
    if text.choices:
        told = ", ".join(f"{key} = {value}" for key, value in text.choices.items())
        facts.append(Fact("profile", told))
    if text.deviation:
        still = "; it passes all the same" if result.deviation_resolved else ""
        facts.append(Fact("documented deviation", text.deviation + still))
    if result.seed:
        facts.append(Fact("seed, time", f"{result.seed}, {duration_text(result.duration_s)}"))
    if trace_file:
        facts.append(Fact("trace file", trace_file))
    return facts


def _check(check: Check) -> CheckRow:
    colour = _CHECK_COLOURS[check.outcome]
    word = check.outcome.value
    return CheckRow(check.at_s, check.step, word, colour, check.expected, check.got)


# -- frames ---------------------------------------------------------------------------------------


def _trace(result: CaseResult, *, is_bad: bool) -> tuple[tuple[TraceRow, ...], str]:
    """The messages that are shown, and which part of the case they are."""
    if not result.trace:
        return (), ""
    failure = result.first_failure
    if is_bad and failure is not None:
        entries = [one for one in result.trace if one.at_s <= failure.at_s + _AFTER_S]
        rows = _decoded(entries[-MESSAGES_BAD * _FRAMES_A_MESSAGE :])[-MESSAGES_BAD:]
        text = f"up to the first failed check, {len(rows)} messages"
    else:
        found = _decoded(result.trace[: MESSAGES_GOOD * _FRAMES_A_MESSAGE])
        rows = found[:MESSAGES_GOOD]
        whole = len(rows) == len(found) and len(result.trace) <= MESSAGES_GOOD * _FRAMES_A_MESSAGE
        text = f"{'all' if whole else 'the first'} {len(rows)} messages"
    frames = len(result.trace) + result.trace_dropped
    return tuple(rows), f"{text}; {frames:,} frames in the whole case"


def _decoded(entries: Sequence[TraceEntry]) -> list[TraceRow]:
    """What these frames say, in order; bytes that no message was made of too."""
    decoder = Decoder()
    rows: list[TraceRow] = []
    for entry in entries:
        due = decoder.deadline()
        if due is not None and due <= entry.at_s:
            rows += map(_row, decoder.tick(due))
        rows += map(_row, decoder.feed(Frame(*entry.frame), entry.at_s))
    due = decoder.deadline()
    if due is not None:
        rows += map(_row, decoder.tick(due))
    return rows


def _row(seen: Seen) -> TraceRow:
    text = ", ".join(f"{field.label} {field.text}" for field in islice(seen.fields, 8))
    sender = seen.sender or f"{seen.can_id:03X}"
    return TraceRow(seen.at, sender, seen.receiver, seen.title, text, seen.is_trouble)
