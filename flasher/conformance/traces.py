"""The frames of a case as a candump log, which `flasher explain`, candump's friends and python-can
read; through python-can's own writer.
"""

from __future__ import annotations

import io
from collections.abc import Iterable

import can

from flasher.conformance.model import CaseResult, Status, TraceEntry
from flasher.protocol.frame import Frame
from flasher.trace.recorder import ONE_TOOL_CHANNEL, message_of

SUFFIX = ".log"
TRACED = frozenset({Status.FAIL, Status.ERROR, Status.INCONCLUSIVE, Status.DEVIATION})
"""Verdicts whose frames are worth a file."""


def file_name(result: CaseResult) -> str:
    """The name of a result's trace file: "TX-03.log", from its second repeat on "TX-03-2.log"."""
    repeat = f"-{result.repeat}" if result.repeat > 1 else ""
    return f"{result.case_id}{repeat}{SUFFIX}"


def is_traced(result: CaseResult) -> bool:
    """True for a result that gets a trace file."""
    return result.status in TRACED and bool(result.trace)


def candump(result: CaseResult) -> bytes:
    """The kept frames of a case."""
    return candump_of(result.trace)


def candump_of(trace: Iterable[TraceEntry]) -> bytes:
    """Frames as a log; times count from the beginning of the case, what the suite sent is `T`."""
    text = io.StringIO()
    # By its channel `flasher explain` knows it again: one tool, whatever it sends.
    writer = can.CanutilsLogWriter(text, channel=ONE_TOOL_CHANNEL)
    for entry in trace:
        writer.on_message_received(
            message_of(
                Frame(*entry.frame), sent=entry.sent, at_s=entry.at_s, channel=ONE_TOOL_CHANNEL
            )
        )
    return text.getvalue().encode("ascii")
