"""The report of a run as JUnit XML, as CI servers read it (the schema that Jenkins publishes).

A group is a test suite. Failed is a failure; an error of the suite or the adapter is an error; what
was not judged (unsupported, inconclusive, not run) is skipped with its reason, but a case that was
not run because the run broke off is an error: a server must not show green for it.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Final

from flasher.conformance.model import CaseResult, Outcome, Status
from flasher.conformance.report import FINAL_IMAGE_OK, CaseText, Report
from flasher.conformance.summary import by_case, end_of_run, finding, group_title, reason
from flasher.protocol.text import printable

_ERRORS: Final = frozenset({Status.ERROR, Status.NOT_RUN})
_SKIPPED: Final = frozenset({Status.UNSUPPORTED, Status.INCONCLUSIVE})
_FINDINGS: Final = 20
_TEXT_LIMIT: Final = 2000
_RUN: Final = "run"
"""The suite of what concerns the run itself: its end, the good image."""

Replays = Mapping[tuple[str, int], str]


def junit_xml(report: Report, *, started_at: str, replays: Replays) -> bytes:
    """The report as an XML file. `started_at` is an ISO time, `replays` by case id and repeat."""
    root = ET.Element("testsuites", name=f"conformance {_safe(report.subject)}")
    groups: dict[str, list[tuple[CaseText, CaseResult]]] = {}
    for text, results in by_case(report):
        groups.setdefault(text.group, []).extend((text, result) for result in results)
    for group, members in groups.items():
        cases = [_case(text, result, report, replays) for text, result in members]
        name = f"{group} {group_title(group)}"
        root.append(_suite(name, cases, report, started_at))
    root.append(_suite(_RUN, _run_cases(report), report, started_at))
    # The schema has no "skipped" here.
    for key in ("tests", "failures", "errors"):
        root.set(key, str(sum(int(suite.get(key, "0")) for suite in root)))
    root.set("time", f"{report.duration_s:.3f}")
    ET.indent(root)
    xml: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return xml + b"\n"


def _suite(name: str, cases: Sequence[ET.Element], report: Report, started_at: str) -> ET.Element:
    suite = ET.Element("testsuite", name=name, tests=str(len(cases)))
    for kind, key in (("failure", "failures"), ("error", "errors"), ("skipped", "skipped")):
        suite.set(key, str(sum(case.find(kind) is not None for case in cases)))
    suite.set("time", f"{sum(float(case.get('time', '0')) for case in cases):.3f}")
    suite.set("timestamp", started_at)
    suite.set("hostname", "localhost")
    properties = ET.SubElement(suite, "properties")
    for key, value in (
        ("subject", report.subject),
        ("target", report.target),
        ("bitrate_bps", report.bitrate_bps),
        ("seed", report.seed),
        ("profile", report.profile_source),
        ("timestamp_source", report.timestamp_source),
        ("uncertainty_s", report.uncertainty_s),
    ):
        ET.SubElement(properties, "property", name=key, value=_safe(str(value)))
    suite.extend(cases)
    return suite


def _case(text: CaseText, result: CaseResult, report: Report, replays: Replays) -> ET.Element:
    repeat = f" (repeat {result.repeat})" if result.repeat > 1 else ""
    case = _element(f"{text.group}", f"{text.id} {text.title}{repeat}", result.duration_s)
    why = _safe(reason(result) or result.status.value)
    if result.status is Status.FAIL:
        failure = ET.SubElement(case, "failure", message=why, type=result.status.value)
        failure.text = _safe("\n".join(_details(text, result, replays)))
    elif result.status in _ERRORS and not (result.status is Status.NOT_RUN and _by_user(report)):
        error = ET.SubElement(case, "error", message=why, type=result.status.value)
        error.text = _safe("\n".join(_details(text, result, replays)))
    elif result.status in _SKIPPED or result.status is Status.NOT_RUN:
        ET.SubElement(case, "skipped", message=f"{result.status.value}: {why}")
    elif report.strict and result.deviation_resolved:
        told = f"the profile says that it deviates ({text.deviation}), but it passes"
        ET.SubElement(case, "failure", message=_safe(told), type="resolved deviation")
    said = [*result.infos]
    if result.status is Status.DEVIATION:
        said.insert(0, f"deviation: {text.deviation}")
    if said:
        ET.SubElement(case, "system-out").text = _safe("\n".join(said))
    return case


def _by_user(report: Report) -> bool:
    """True when somebody ended the run, or its own limit did: nothing is wrong then."""
    return not (report.adapter_failed or report.killed_by) and any(
        result.status is not Status.NOT_RUN and result.checks for result in report.results
    )


def _details(text: CaseText, result: CaseResult, replays: Replays) -> list[str]:
    bad = [check for check in result.checks if check.outcome is Outcome.FAIL]
    lines = [f"clause: {text.clause}", f"stimulus: {text.stimulus}"]
    lines += [finding(check) for check in bad[:_FINDINGS]]
    if len(bad) > _FINDINGS:
        lines.append(f"{len(bad) - _FINDINGS} more failed checks")
    lines.append(f"seed: {result.seed}")
    replay = replays.get((result.case_id, result.repeat))
    return [*lines, f"replay: {replay}"] if replay else lines


def _run_cases(report: Report) -> list[ET.Element]:
    """The run itself as two cases, so that a broken one is not green."""
    whole = _element(_RUN, "the run goes to its planned end", 0.0)
    if report.stopped or report.not_upgradable:
        message = "; ".join(end_of_run(report))
        ET.SubElement(whole, "error", message=_safe(message), type="stopped")
    image = _element(_RUN, "the good image is back on the device", 0.0)
    if not report.final_image:
        ET.SubElement(image, "skipped", message="no case was run")
    elif report.final_image != FINAL_IMAGE_OK:
        ET.SubElement(image, "error", message=_safe(report.final_image), type="final image")
    return [whole, image]


def _element(group: str, name: str, time_s: float) -> ET.Element:
    return ET.Element(
        "testcase",
        classname=f"conformance.{group}",
        name=_safe(name),
        time=f"{time_s:.3f}",
    )


def _safe(text: str) -> str:
    """What XML may hold: no control characters, and nothing without end."""
    lines = (printable(line) for line in text[:_TEXT_LIMIT].split("\n"))
    return "\n".join(lines)
