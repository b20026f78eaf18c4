"""JUnit XML writer, for CI servers (the schema that Jenkins publishes)."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from flasher.errors import printable

TEXT_LIMIT: Final = 2000
"""Maximum number of characters of a text; the rest is cut off."""


class JUnitResult(Enum):
    """Result of a test case; the value is its XML element."""

    PASSED = ""
    FAILURE = "failure"
    ERROR = "error"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class JUnitCase:
    """Test case; `message`, `type` and `details` explain why it did not pass."""

    classname: str
    name: str
    time_s: float = 0.0
    result: JUnitResult = JUnitResult.PASSED
    message: str = ""
    type: str = ""
    details: str = ""
    output: str = ""
    """Output of the test case, whatever its result."""
    timestamp: str = ""


@dataclass(frozen=True)
class JUnitSuite:
    """Group of test cases."""

    name: str
    cases: Sequence[JUnitCase]
    timestamp: str = ""
    properties: Mapping[str, object] = field(default_factory=dict)


def junit_xml(name: str, suites: Iterable[JUnitSuite], time_s: float | None = None) -> bytes:
    """Write the suites as XML; `time_s` is the total duration, by default the sum of the cases."""
    root = ET.Element("testsuites", name=_safe(name))
    root.extend(map(_suite, suites))
    # The schema has no "skipped" here.
    for key in ("tests", "failures", "errors"):
        root.set(key, str(sum(int(suite.get(key, "0")) for suite in root)))
    total_s = sum(float(suite.get("time", "0")) for suite in root) if time_s is None else time_s
    root.set("time", f"{total_s:.3f}")
    ET.indent(root)
    xml: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return xml + b"\n"


def _suite(suite: JUnitSuite) -> ET.Element:
    results = [case.result for case in suite.cases]
    element = ET.Element(
        "testsuite",
        name=_safe(suite.name),
        tests=str(len(results)),
        failures=str(results.count(JUnitResult.FAILURE)),
        errors=str(results.count(JUnitResult.ERROR)),
        skipped=str(results.count(JUnitResult.SKIPPED)),
        time=f"{sum(round(case.time_s, 3) for case in suite.cases):.3f}",
    )
    if suite.timestamp:
        element.set("timestamp", suite.timestamp)
        element.set("hostname", "localhost")
    if suite.properties:
        properties = ET.SubElement(element, "properties")
        for key, value in suite.properties.items():
            ET.SubElement(properties, "property", name=key, value=_safe(str(value)))
    element.extend(map(_case, suite.cases))
    return element


def _case(case: JUnitCase) -> ET.Element:
    element = ET.Element(
        "testcase",
        classname=_safe(case.classname),
        name=_safe(case.name),
        time=f"{case.time_s:.3f}",
    )
    if case.timestamp:
        element.set("timestamp", case.timestamp)
    if case.result is not JUnitResult.PASSED:
        why = ET.SubElement(element, case.result.value, message=_safe(case.message))
        if case.type:
            why.set("type", _safe(case.type))
        why.text = _safe(case.details) or None
    if case.output:
        ET.SubElement(element, "system-out").text = _safe(case.output)
    return element


def _safe(text: str) -> str:
    """Truncate a text and escape control characters except line ends, which XML does not allow."""
    return "\n".join(printable(line) for line in text[:TEXT_LIMIT].split("\n"))
