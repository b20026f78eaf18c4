"""HTML page of `flasher explain --html`: the story of a trace.

Python arranges, the templates print. Lists that grow with the trace (steps, packets with trouble,
senders, upgrades) are limited, and the page shows how much was left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any, Final, NamedTuple

from flasher.i18n import text
from flasher.protocol.spec import Node
from flasher.report import chart, sequence
from flasher.report.base import Status, render_page
from flasher.report.scale import duration_text
from flasher.trace.figures import Distribution
from flasher.trace.story import (
    Cause,
    PacketRun,
    PacketStory,
    Step,
    StepKind,
    Story,
    StoryLine,
    UpgradeStory,
)
from flasher.translation import ENGLISH, Translator
from flasher.wording import wording

UPGRADES_SHOWN: Final = 8
"""Maximum number of upgrades shown in full; the others have a line in a table."""
ATTEMPTS_DRAWN: Final = 3
"""Number of last attempts with a chart of answer times; 1 with several upgrades."""
PACKETS_SHOWN: Final = 200
"""Maximum number of listed packets with trouble, over all upgrades."""
TALKERS_SHOWN: Final = 100
REMARKS_SHOWN: Final = 40
_LIFELINES: Final = 4
_HISTOGRAM_LEAST: Final = 20
_ITEMS_LEAST: Final = 60
_OTHERS: Final = "others"
_BROADCAST: Final = "all"
_TOOL: Final = Node.CDL.name
_UNKNOWN: Final = frozenset({Cause.UNCONFIRMED, Cause.RECORDING_ENDS})
_WORDS: Final = {
    Status.GOOD: "went well",
    Status.WARNING: "outcome not known",
    Status.BAD: "went wrong",
    Status.NEUTRAL: "no upgrade",
}

Drawings = dict[str, chart.LatencyChart]
"""Drawings by width."""


class PhaseRow(NamedTuple):
    """Phase of an upgrade, with its position as shares of the upgrade."""

    name: str
    attempt: int
    begin_s: float
    length_s: float
    begin_share: float
    length_share: float


class SpreadRow(NamedTuple):
    """Distribution of the link report, with its drawings; None without data."""

    name: str
    distribution: Distribution | None
    drawings: dict[str, chart.Spread] | None


class _Limits(NamedTuple):
    """Limits for each upgrade on the page."""

    items: int
    attempts: int
    packets: int

    @classmethod
    def for_upgrades(cls, count: int) -> _Limits:
        """Create the limits for a page with `count` upgrades."""
        if count <= 1:
            return cls(sequence.ITEMS_SHOWN, ATTEMPTS_DRAWN, PACKETS_SHOWN)
        items = max(_ITEMS_LEAST, sequence.ITEMS_SHOWN // count)
        return cls(items, 1, PACKETS_SHOWN // count)


def render(story: Story) -> str:
    """Render the page as HTML text."""
    return render_page("explain.html", **story_context(story, ENGLISH))


def story_context(story: Story, translate: Translator) -> dict[str, Any]:
    """Create the template data of the page. `translate` is for texts that are laid out here."""
    shown = story.upgrades[:UPGRADES_SHOWN]
    limits = _Limits.for_upgrades(len(shown))
    status = status_of(story.verdict.cause)
    return {
        "story": story,
        "status": status,
        "word": _WORDS[status],
        "started": _wall_text(story.started_at),
        "upgrades": [_view(upgrade, limits, translate) for upgrade in shown],
        "more_upgrades": [
            (upgrade, status_of(upgrade.verdict.cause))
            for upgrade in story.upgrades[UPGRADES_SHOWN:]
        ],
        "outside": _diagrams(story.steps, "", limits.items, translate),
        "talkers": story.talkers[:TALKERS_SHOWN],
        "talkers_left_out": story.talkers_left_out + max(0, len(story.talkers) - TALKERS_SHOWN),
    }


def status_of(cause: Cause) -> Status:
    """Rate the result of an upgrade."""
    if cause.is_good:
        return Status.GOOD
    if not cause.is_upgrade:
        return Status.NEUTRAL
    return Status.WARNING if cause in _UNKNOWN else Status.BAD


def _wall_text(seconds: float | None) -> str:
    """Format wall time; empty for None, and for times outside the calendar."""
    if seconds is None:
        return ""
    try:
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError, OSError):
        return ""


def _view(upgrade: UpgradeStory, limits: _Limits, translate: Translator) -> dict[str, Any]:
    """Create the template data of an upgrade."""
    status = status_of(upgrade.verdict.cause)
    troubled = [each for each in upgrade.packets if not each.is_clean or each.answered_at_s is None]
    more = len(upgrade.remarks) - REMARKS_SHOWN
    remarks = upgrade.remarks[:REMARKS_SHOWN]
    return {
        "story": upgrade,
        "status": status,
        "word": _WORDS[status],
        "phases": list(_phases(upgrade)),
        "sequence": _diagrams(upgrade.steps, upgrade.target, limits.items, translate),
        "latencies": list(_latencies(upgrade.packets, limits.attempts)),
        "spreads": list(_spreads(upgrade)),
        "histogram": _histogram(upgrade.packets),
        "troubled": troubled[: limits.packets],
        "troubled_count": len(troubled),
        "remarks": (*remarks, f"{more:,} more remarks") if more > 0 else remarks,
    }


# -- the parts of an upgrade ----------------------------------------------------------------------


def _phases(upgrade: UpgradeStory) -> Iterable[PhaseRow]:
    whole_s = max((span.end_s for span in upgrade.phases), default=0.0) - upgrade.begin_s
    for span in upgrade.phases:
        length_s = span.end_s - span.begin_s
        begin, length = span.begin_s - upgrade.begin_s, length_s
        if whole_s > 0:
            begin, length = begin / whole_s, length / whole_s
        yield PhaseRow(
            wording(span.phase), span.attempt, span.begin_s, length_s, _share(begin), _share(length)
        )


def _share(value: float) -> float:
    return min(1.0, max(0.0, value))


def _latencies(packets: Sequence[PacketStory], most: int) -> Iterable[tuple[int, Drawings]]:
    """Yield each of the last attempts with packets, with a chart of its answer times."""
    by_attempt: dict[int, list[chart.Sample]] = {}
    for packet in packets:
        sample = chart.Sample(packet.number, packet.answer_s, packet.tries - 1, packet.naks)
        by_attempt.setdefault(packet.attempt, []).append(sample)
    for attempt, samples in list(by_attempt.items())[-most:]:
        drawings = {name: chart.latency_chart(samples, at) for name, at in chart.WIDTHS.items()}
        yield attempt, drawings


def _histogram(packets: Iterable[PacketStory]) -> dict[str, chart.HistogramChart] | None:
    values = [one.answer_s for one in packets if one.tries == 1 and one.answer_s is not None]
    if len(values) < _HISTOGRAM_LEAST:
        return None
    return {name: chart.histogram(values, width) for name, width in chart.WIDTHS.items()}


def _spreads(upgrade: UpgradeStory) -> Iterable[SpreadRow]:
    if upgrade.link is None:
        return
    for name, found in (
        ("the device's answer to a packet", upgrade.link.device_answer),
        ("the tool's next packet after an ACK", upgrade.link.host_turnaround),
    ):
        drawings = (
            None
            if found is None or found.maximum_s <= 0
            else {width: chart.spread(found, at) for width, at in chart.WIDTHS.items()}
        )
        yield SpreadRow(name, found, drawings)


# -- steps as a sequence diagram ------------------------------------------------------------------


def _diagrams(
    lines: Sequence[StoryLine], target: str, most: int, translate: Translator
) -> dict[str, list[sequence.Part]]:
    """Lay out the sequence diagram of steps for each width."""
    participants = _participants(lines, target)
    items = sequence.thinned([_item(line, participants, translate) for line in lines], most)
    return {
        name: sequence.diagram(items, participants, width, translate)
        for name, width in chart.WIDTHS.items()
    }


def _participants(lines: Sequence[StoryLine], target: str) -> list[str]:
    """Return tool, target, and the most frequent names; the rest are combined."""
    named = Counter(
        name
        for line in lines
        if isinstance(line, Step)
        for name in (line.sender, line.receiver)
        if name and name not in (_BROADCAST, _TOOL, target)
    )
    tool = any(isinstance(line, Step) and _TOOL in (line.sender, line.receiver) for line in lines)
    first = [_TOOL, target] if target else [_TOOL] * (tool or not named)
    free = _LIFELINES - len(first)
    others = [name for name, _ in named.most_common(free)]
    if len(named) > free:
        others[-1:] = [_OTHERS]
    return [*first, *others]


def _item(
    line: StoryLine, participants: Sequence[str], translate: Translator
) -> sequence.DiagramItem:
    if isinstance(line, PacketRun):
        some = f"packet {line.first}" if line.count == 1 else f"packets {line.first} to {line.last}"
        return sequence.DiagramItem(
            line.begin_s,
            f"{some} acknowledged",
            translate(text("in {time}", time=duration_text(line.end_s - line.begin_s))),
            end_s=line.end_s,
        )
    if not line.sender or line.kind not in (StepKind.MESSAGE, StepKind.DAMAGED):
        return sequence.DiagramItem(
            line.at_s,
            line.title,
            line.text,
            is_trouble=line.is_trouble,
            end_s=None if line.kind is StepKind.GAP else line.at_s,
        )
    return sequence.DiagramItem(
        line.at_s,
        line.title,
        ", ".join(_field(part, translate) for part in line.text.split(", ")),
        _place(line.sender, participants),
        line.receiver if line.receiver == _BROADCAST else _place(line.receiver, participants),
        line.is_trouble,
    )


def _field(text: str, translate: Translator) -> str:
    """Translate the label of a field: "size 219 B"."""
    words = text.split(" ")
    for count in range(len(words), 0, -1):
        label = " ".join(words[:count])
        if (translated := translate(label)) != label:
            return " ".join([translated, translate(" ".join(words[count:]))]).rstrip()
    return text


def _place(name: str, participants: Sequence[str]) -> str:
    return name if name in participants else _OTHERS
