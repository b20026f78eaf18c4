"""Text output of `flasher explain`: verdict, phases, steps, packets and bus figures."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from flasher.cli.output import byte_count, counted, duration, spread_ms
from flasher.trace.figures import Distribution, LinkReport
from flasher.trace.story import (
    BusFigures,
    PacketRun,
    PacketStory,
    Story,
    StoryLine,
    Talker,
    TraceVerdict,
    UpgradeStory,
)
from flasher.wording import wording

_TALKERS_SHOWN: Final = 12


def story_lines(story: Story, *, packets: bool = False) -> Iterator[str]:
    """Format a whole story; `packets` adds a line for each packet."""
    at = ""
    if story.started_at is not None:
        at = time.strftime(", from %Y-%m-%d %H:%M:%S", time.localtime(story.started_at))
    yield f"{story.source}: {counted(story.frames, 'frame')} in {duration(story.duration_s)}{at}"
    if story.damage:
        yield f"warning: the file cannot be read to its end; {story.damage}"
    yield from _verdict_lines(story.verdict)
    yield from _recorded_lines(story)
    for upgrade in story.upgrades:
        yield ""
        yield from _upgrade_lines(upgrade, packets=packets, is_only=len(story.upgrades) == 1)
    if story.steps:
        yield ""
        yield "outside of upgrades" if story.upgrades else "messages"
        yield from _step_lines(story.steps, story.steps_left_out)
    yield ""
    yield from _bus_lines(story.bus, story.bitrate_bps)
    yield from _talker_lines(story.talkers, story.talkers_left_out)


def _verdict_lines(verdict: TraceVerdict, indent: str = "") -> Iterator[str]:
    where = [] if verdict.phase is None else [wording(verdict.phase)]
    where += [f"packet {verdict.packet}"] if verdict.packet else []
    where += [f"attempt {verdict.attempt}"] if verdict.attempt > 1 else []
    at = f" ({', '.join(where)})" if where and not verdict.cause.is_good else ""
    yield f"{indent}verdict: {wording(verdict.cause)}{at}"
    yield f"{indent}  {verdict.text}"
    if verdict.likely:
        yield f"{indent}  likely cause: {verdict.likely}"
    if verdict.remedy:
        yield f"{indent}  what to do: {verdict.remedy}"


def _recorded_lines(story: Story) -> Iterator[str]:
    if story.recorded is None:
        return
    code = story.recorded.exit_code
    yield f"reported then: {'no exit code' if code is None else f'exit code {code}'}"
    if story.recorded.command:
        yield f"  {story.recorded.command}"
    for part in story.recorded.error.split(" | "):
        yield f"  {part}"


def _upgrade_lines(upgrade: UpgradeStory, *, packets: bool, is_only: bool) -> Iterator[str]:
    took = duration(upgrade.end_s - upgrade.begin_s)
    attempts = f", {counted(upgrade.attempts, 'attempt')}" if upgrade.attempts > 1 else ""
    yield f"upgrade of the {upgrade.target}: at {upgrade.begin_s:.3f} s, {took}{attempts}"
    if not is_only:
        yield from _verdict_lines(upgrade.verdict, "  ")
    size = upgrade.image_size_bytes
    total = upgrade.total_packets
    packets_text = "" if total is None else f", {counted(total, 'packet')}"
    yield f"  image:         {'size unknown' if size is None else byte_count(size)}{packets_text}"
    yield f"  boot version:  {upgrade.boot_version or 'never announced'}"
    yield f"  running:       {upgrade.running_version or 'no version answer'}"
    for remark in upgrade.remarks:
        yield f"  remark:        {remark}"
    yield "  phases"
    for span in upgrade.phases:
        attempt = f" (attempt {span.attempt})" if upgrade.attempts > 1 else ""
        took = f"{span.end_s - span.begin_s:9.3f} s"
        yield f"    {span.begin_s:10.3f}  {took}  {wording(span.phase)}{attempt}"
    yield "  steps"
    yield from _step_lines(upgrade.steps, upgrade.steps_left_out, "  ")
    if packets:
        yield from _packet_lines(upgrade.packets)
    if upgrade.link is not None:
        yield from _link_lines(upgrade.link)


def _step_lines(steps: tuple[StoryLine, ...], left_out: int, indent: str = "") -> Iterator[str]:
    half = len(steps) // 2
    for index, line in enumerate(steps):
        if left_out and index == half:
            yield f"{indent}              ... {counted(left_out, 'line')} left out ..."
        yield f"{indent}  {_step_text(line)}"


def _step_text(line: StoryLine) -> str:
    if isinstance(line, PacketRun):
        which = f"packets {line.first} to {line.last}" if line.count > 1 else f"packet {line.first}"
        took = f"{line.end_s - line.begin_s:.3f} s"
        return f"{line.begin_s:10.3f}  {'CDL > ':<9}  {which}, acknowledged in {took}"
    route = f"{line.sender} > {line.receiver}" if line.sender else ""
    mark = "! " if line.is_trouble else ""
    text = f": {line.text}" if line.text else ""
    return f"{line.at_s:10.3f}  {route:<9}  {mark}{line.title}{text}"


def _packet_lines(packets: tuple[PacketStory, ...]) -> Iterator[str]:
    yield "  packets"
    yield "    attempt  packet        sent  tries  NAKs     answer"
    for packet in packets:
        answer = "none" if packet.answer_s is None else f"{packet.answer_s * 1000:.2f} ms"
        yield (
            f"    {packet.attempt:7}  {packet.number:6}  {packet.sent_at_s:10.3f}  "
            f"{packet.tries:5}  {packet.naks:4}  {answer:>9}"
        )


def _link_lines(link: LinkReport) -> Iterator[str]:
    yield "  link"
    faults = f"{link.repetitions} repeated, {counted(link.naks, 'NAK')}"
    yield f"    packets:     {link.acknowledged:,} of {link.packets:,} acknowledged, {faults}"
    share = link.share_of_line_rate
    rate = "" if share is None else f", {_share(share, 0)} of the line rate"
    line = f"{duration(link.line_s)} at line rate{rate}"
    yield f"    time:        {duration(link.transfer_s)}, {line}"
    yield _times("device", link.device_answer)
    yield _times("host", link.host_turnaround)


def _times(name: str, figures: Distribution | None) -> str:
    if figures is None:
        return f"    {name + ':':<12} nothing to measure"
    return f"    {name + ':':<12} {spread_ms(figures)} ms (min / median / p95 / p99 / max)"


def _bus_lines(bus: BusFigures, bitrate_bps: int) -> Iterator[str]:
    if not bus.frames and not bus.error_frames:
        yield "bus load: none, the trace has no frames"
        return
    load = "unknown" if bus.load is None else _share(bus.load, 1)
    peak = "" if bus.peak_load is None else f", {_share(bus.peak_load, 1)} in the busiest second"
    yield f"bus load: {load} of {bitrate_bps / 1000:g} kbit/s{peak}"
    gap = f"{bus.longest_gap_s:.3f} s at {bus.longest_gap_at_s:.3f} s"
    yield f"  longest silence: {gap}"
    yield (
        f"  error frames: {bus.error_frames:,}, damaged pieces: {bus.damaged:,}, "
        f"malformed or unknown messages: {bus.malformed:,}"
    )


def _share(share: float, digits: int) -> str:
    """Format a share of the line's capacity in percent. Far above 100 %, the trace was not recorded
    on such a line; slightly above, its time stamps are inaccurate.
    """
    return f"{min(share, 1):.{digits}%}" if share <= 1.02 else "more than all"


def _talker_lines(talkers: tuple[Talker, ...], left_out: int) -> Iterator[str]:
    if not talkers:
        return
    yield "others on the bus"
    for talker in talkers[:_TALKERS_SHOWN]:
        can_id = f"{talker.can_id:08X}" if talker.is_extended else f"{talker.can_id:03X}"
        name = talker.name or wording(talker.kind)
        yield f"  {can_id:<8}  {name:<10}  {counted(talker.frames, 'frame')}"
    more = len(talkers[_TALKERS_SHOWN:]) + left_out
    if more:
        yield f"  and {counted(more, 'id')} more"
