"""The page of a conformance run: verdict, matrix of the cases, what went wrong with its trace, and
how the measured times are spread.

Draws what it is given: who runs the suite fills the dataclasses below. What could grow with a run
is cut by them; `render` arranges and draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from flasher.report import chart, spread
from flasher.report.base import Status, render_page
from flasher.trace.figures import Distribution

HISTOGRAM_LEAST: Final = 5
"""Fewer values than this are told by the table alone."""
TRACES_OPEN: Final = 5
"""With more cases that went wrong, their traces are folded; on paper they are then left out."""


class Fact(NamedTuple):
    """A line about the run: a name and its text."""

    name: str
    text: str


class CheckRow(NamedTuple):
    """One thing that was looked at."""

    at_s: float
    step: str
    word: str
    status: Status
    expected: str
    got: str


class TraceRow(NamedTuple):
    """A message of the case, decoded."""

    at_s: float
    sender: str
    receiver: str
    title: str
    text: str
    is_trouble: bool


@dataclass(frozen=True)
class CaseView:
    """A case, with what came of one of its runs."""

    id: str
    title: str
    clause: str
    stimulus: str
    expectation: str
    status: Status
    word: str
    """The verdict in words."""
    note: str
    facts: tuple[Fact, ...]
    """Requirements, choices of the profile, seed, duration, and the like."""
    replay: str
    checks: tuple[CheckRow, ...]
    checks_left_out: int
    infos: tuple[str, ...]
    trace: tuple[TraceRow, ...]
    trace_text: str
    """Which part of the case's frames `trace` is."""


class GroupView(NamedTuple):
    """A group of cases: its row of the matrix, and their details."""

    id: str
    title: str
    cases: tuple[CaseView, ...]


class TimesView(NamedTuple):
    """All measurements of one name."""

    name: str
    values_s: Sequence[float]
    distribution: Distribution
    uncertainty_s: float


@dataclass(frozen=True)
class RunView:
    """A whole run."""

    subject: str
    status: Status
    word: str
    headline: str
    remarks: tuple[str, ...]
    """What a reader must know of how the run went."""
    facts: tuple[Fact, ...]
    groups: tuple[GroupView, ...]
    times: tuple[TimesView, ...]
    times_text: str
    """Who stamped the frames, and what that is worth."""
    profile: tuple[Fact, ...]
    profile_text: str


class Histogram(NamedTuple):
    """A histogram of one name for each width."""

    name: str
    drawings: dict[str, spread.Histogram]


def render(run: RunView) -> str:
    """The whole page as HTML text."""
    troubled = [case for group in run.groups for case in group.cases if case.status is Status.BAD]
    others = [
        GroupView(
            group.id,
            group.title,
            tuple(case for case in group.cases if case.status is not Status.BAD),
        )
        for group in run.groups
    ]
    return render_page(
        "conformance.html",
        run=run,
        troubled=troubled,
        traces_open=TRACES_OPEN,
        others=[group for group in others if group.cases],
        histograms=[
            Histogram(
                times.name,
                {name: spread.histogram(times.values_s, at) for name, at in chart.WIDTHS.items()},
            )
            for times in run.times
            if len(times.values_s) >= HISTOGRAM_LEAST and _differ(times.distribution)
        ],
    )


def _differ(found: Distribution) -> bool:
    """True when there is something to draw: no clock tells apart what differs by less."""
    return found.minimum_s > 0 and found.maximum_s - found.minimum_s > 1e-6
