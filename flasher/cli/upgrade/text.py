"""Texts and JSON of images, plans and upgrades, for `flash`, `rescue` and `image-info`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from flasher.cli.documents import (
    ImageDocument,
    PlanDocument,
    document_of,
)
from flasher.cli.output import ClosingLine, byte_count, counted, duration, spread_ms
from flasher.errors import FlasherError, InterruptedByUserError
from flasher.events import CheckMade
from flasher.host.options import UpgradeOptions, gaps_s
from flasher.host.outcome import DeviceLeft, Outcome
from flasher.host.session import Result
from flasher.host.table import Ending
from flasher.host.verify import Level, Verdict, Verification, possible_levels
from flasher.image.cortexm import VectorTable, vector_table
from flasher.image.image import Image
from flasher.image.plan import Plan
from flasher.image.release import names_of
from flasher.image.sample import is_sample
from flasher.jobs import Job
from flasher.protocol.spec import DIALECTS
from flasher.protocol.text import printable
from flasher.trace.figures import LinkReport
from flasher.wording import wording

_NO_QUERY = ": the document gives this target no query for it"


@dataclass(frozen=True)
class UpgradeDocument:
    """Result of an upgrade. Transferred, completed and running are three claims: see `outcome` for
    the first two, `verification` for the third.
    """

    image: ImageDocument
    plan: PlanDocument
    checks: list[CheckMade]
    outcome: Outcome
    verification: Verification
    previous_version: str | None
    """Version before the upgrade; null without an answer."""
    shutdown_heard: bool
    """The battery sent SHUTDOWN during the upgrade."""
    link: LinkReport | None
    """Bus usage; null if no packet was sent."""


@dataclass(frozen=True)
class DryRunDocument:
    """Plan of an upgrade that was not run."""

    dry_run: bool
    image: ImageDocument
    plan: PlanDocument
    checks: list[CheckMade]


class DeviceState(Enum):
    """What became of a device of the set."""

    UPGRADED = "upgraded"
    UP_TO_DATE = "up_to_date"
    """It reported the version of the set, and was left alone."""
    FAILED = "failed"
    NOT_BEGUN = "not_begun"
    LEFT_OUT = "left_out"


@dataclass(frozen=True)
class BikeDeviceDocument:
    """A device of the set."""

    target: str
    state: DeviceState
    was_in_bootloader: bool
    """It had no application before, or perhaps none."""
    checks: list[CheckMade]
    """Checks before the first upgrade of the bike."""
    upgrade: UpgradeDocument | None
    """Null for one that was not begun, and after a failure of the adapter."""


@dataclass(frozen=True)
class BikeDocument:
    """Result of an upgrade of a whole bike, its devices in the order of their upgrades."""

    set: str
    order_reason: str
    dry_run: bool
    devices: list[BikeDeviceDocument]


# -- images and plans in words ---------------------------------------------------------------------


def image_lines(image: Image, file_sha256: str = "") -> list[str]:
    """Describe an image file, with its own SHA-256 if that is given."""
    lines = [f"{printable(image.source)}: {image.format}, {byte_count(image.size_bytes)} to send"]
    if image.base is None:
        lines.append("  address: unknown (a raw binary has none; --base sets it)")
    else:
        last = image.base + image.size_bytes - 1
        lines.append(f"  address: 0x{image.base:08X}..0x{last:08X}")
    if len(image.segments) > 1:
        lines += [f"  segment: {segment}" for segment in image.segments]
        lines.append(f"  gaps:    {byte_count(image.filled_bytes)} filled with FF")
    lines.append(f"  version: {image.version or 'none found inside'}")
    lines.append(f"  names:   {names_of(image.named_targets) or 'no target found inside'}")
    lines.append(f"  sha256:  {image.sha256}{' of the bytes to send' if file_sha256 else ''}")
    if file_sha256:
        lines.append(f"           {file_sha256} of the file itself")
    if is_sample(image):
        lines.append("  sample:  a firmware sample of flasher, refused on a physical controller")
    return lines


def vector_lines(table: VectorTable | None) -> list[str]:
    """Describe the vector table of an image, and whether it is plausible for a Cortex-M."""
    if table is None:
        return ["  start:   too short for a vector table"]
    words = f"stack pointer 0x{table.stack_pointer:08X}, reset vector 0x{table.reset_vector:08X}"
    verdict = "plausible for a Cortex-M" if table.plausible else "not plausible for a Cortex-M"
    lines = [f"  start:   {words}: {verdict}"]
    lines += [f"           {problem}" for problem in table.problems]
    lines += [f"           {note}" for note in table.notes]
    return lines


def plan_lines(plan: Plan, options: UpgradeOptions) -> list[str]:
    """Describe the plan: bytes to be sent, target, and time on the bus, with gaps."""
    target = plan.target
    ids = f"CAN ids 0x{target.request_id:03X}, 0x{target.answer_id:03X}"
    document_bps = {dialect.bitrate_bps for dialect in DIALECTS.values() if dialect.has_upgrade}
    foreign = "" if plan.bitrate_bps in document_bps else " (not the document's bit rate)"
    sent = f"{counted(plan.total_packets, 'packet')}, {counted(plan.frames, 'frame')}"
    silence_s = gaps_s(plan, options)
    time = f"{duration(plan.wire_s)} on the wire"
    if silence_s:
        time = f"{duration(plan.wire_s + silence_s)}: {time}, {duration(silence_s)} of gaps"
    return [
        f"  to:      {target.node.name} ({ids}) at {plan.bitrate_bps / 1000:g} kbit/s{foreign}",
        f"  plan:    {sent}, {byte_count(plan.bytes_on_wire)} of frame data",
        f"  time:    {time}, erasing and the device's own time extra",
    ]


def job_lines(job: Job) -> list[str]:
    """Describe an upgrade before it begins: image, origin and plan."""
    image, provenance = job.plan.image, job.identity.provenance
    return [
        *image_lines(image),
        *([f"  origin:  {provenance.text}"] if provenance else []),
        *vector_lines(vector_table(image)),
        *plan_lines(job.plan, job.options),
    ]


# -- upgrades in words ----------------------------------------------------------------------------


def check_line(check: CheckMade) -> str:
    return f"check: {check.verdict}: {check.text}"


_LEFT: Final = {
    DeviceLeft.UNTOUCHED: "nothing was erased",
    DeviceLeft.PERHAPS_ERASED: "its application is perhaps erased",
    DeviceLeft.NO_APPLICATION: "it has no application now",
    DeviceLeft.UNKNOWN: "it took every byte, what it runs is not known",
}


def verdict_of(result: Result, checks: Iterable[CheckMade], took_s: float) -> ClosingLine:
    """Return the last line of an upgrade."""
    outcome, node = result.outcome, result.outcome.target.node.name
    took = f"  {took_s:.1f} s"
    error = result.error()
    if error is not None:
        left = _LEFT.get(outcome.device_left)
        return failed(error, f"; {left}{took}" if left else took)
    if not result.ok:
        return ClosingLine("NOTHING TO DO", f"{node}: {outcome.detail}{took}", "green")
    was = f", was {result.previous_version}" if result.previous_version else ""
    verification = result.verification
    remark = "memory read back" if verification.level is Level.MEMORY else "version read back"
    if verification.verdict is Verdict.NOT_ASKED and result.running_version is None:
        remark = "not asked" if _has_query(result) else "no version query"
    elif verification.verdict is Verdict.VERSION_UNJUDGED:
        remark = "the image names no version to compare with"
    if outcome.ending is Ending.CONFIRMED_BY_VERSION:
        remark += ", but it did not report completion"
    if outcome.unobserved_s:
        remark += f"; unobserved for {duration(outcome.unobserved_s)}"
    warnings = sum(check.verdict in ("warned", "waived") for check in checks)
    remark += f"; {counted(warnings, 'warning')}" if warnings else ""
    if result.running_version is None:
        text = f"{node} confirmed the image{was}; what runs is not known ({remark})"
    else:
        text = f"{node} runs {result.running_version}{was} ({remark})"
    is_sure = verification.verdict in (Verdict.VERSION_RIGHT, Verdict.MEMORY_RIGHT)
    is_sure &= outcome.ending is Ending.COMPLETED and not warnings and not result.shutdown_heard
    is_sure &= not outcome.unobserved_s
    return ClosingLine("OK", text + took, "green" if is_sure else "yellow")


_LINE_MAX: Final = 120
"""Maximum number of characters: a longer text loses its remark in brackets."""
_REMARK: Final = re.compile(r" \((?:[^()]|\([^()]*\))*\)(?![^\s:;,])")


def failed(error: FlasherError, more: str = "") -> ClosingLine:
    """Return the last line of an upgrade that failed; the whole error is printed above it."""
    word = "STOPPED" if isinstance(error, InterruptedByUserError) else "FAILED"
    what = error.what.removesuffix(".")
    if more or len(what) > _LINE_MAX:
        what = _REMARK.sub("", what)
    if error.needs_rescue and not more:
        more = "; it may have no application now"
    return ClosingLine(word, what + more, "red")


def summary_lines(result: Result, plan: Plan) -> list[str]:
    """Return the final lines of a successful upgrade: three separate claims."""
    outcome = result.outcome
    figures = outcome.statistics
    transfer_s = figures.transfer_s or 0.0
    sent = f"{byte_count(plan.image.size_bytes)} in {counted(plan.total_packets, 'packet')}"
    faults = f"{figures.repetitions} repeated, {figures.naks} NAK"
    whole = f"{counted(figures.attempts, 'attempt')}, {duration(figures.duration_s)} in all"
    unobserved: list[str] = []
    if outcome.unobserved_s:
        away = f"{duration(outcome.unobserved_s)}, the adapter was away or this computer suspended"
        advice = "if another tool sent or another unit was connected then, flash it again"
        unobserved = [f"unobserved:   {away}; {advice}"]
    return [
        f"transferred:  {sent}, {duration(transfer_s)}{_rate(plan, transfer_s)}",
        f"              {faults}, {whole}",
        *unobserved,
        f"boot version: {outcome.boot_version or 'not announced: it sat in an open session'}",
        f"completed:    {wording(outcome.ending)}",
        f"running:      {_running(result)}",
    ]


def link_lines(report: LinkReport) -> list[str]:
    """Format the times of both ends as min / median / p95 / p99 / max."""
    return [
        f"{end:<13} {spread_ms(figures)} ms {doing}"
        for end, figures, doing in (
            ("device took:", report.device_answer, "to answer a packet"),
            ("host took:", report.host_turnaround, "to send the next (min/median/p95/p99/max)"),
        )
        if figures is not None
    ]


def adapter_warnings(link: LinkReport) -> Iterator[str]:
    """Describe faults of the adapter, which slow an upgrade down without stopping it."""
    if link.unreadable:
        times = "once" if link.unreadable == 1 else f"{link.unreadable:,} times"
        what = f"{times} the adapter delivered unreadable frames"
        yield f"{what}; try another cable, port or adapter"
    if link.refused:
        what = f"{counted(link.refused, 'frame')} refused by the adapter"
        yield f"{what}; try --frame-gap 0.001, or another port or adapter"


def _running(result: Result) -> str:
    """Describe the application that runs now, and the evidence."""
    verification = result.verification
    if verification.verdict is Verdict.NOT_ASKED:
        no_query = "" if _has_query(result) else _NO_QUERY
        return result.running_version or f"not asked{no_query}"
    return f"{result.running_version or 'unknown'} ({wording(verification.verdict)})"


def _has_query(result: Result) -> bool:
    return possible_levels(result.outcome.target) != (Level.NONE,)


def _rate(plan: Plan, transfer_s: float) -> str:
    """Format bytes per second, and the share of the line rate."""
    if not transfer_s:
        return ""
    share = plan.transfer_wire_s / transfer_s
    line = f"{plan.bitrate_bps / 1000:g} kbit/s line"
    # A bus in memory or on a network has no line rate.
    closeness = f"{min(share, 1):.0%} of a {line}" if share <= 1.02 else f"faster than a {line}"
    return f" ({plan.image.size_bytes / transfer_s / 1000:.1f} kB/s, {closeness})"


# -- as JSON --------------------------------------------------------------------------------------


def image_document(image: Image, table: VectorTable | None) -> ImageDocument:
    return document_of(
        ImageDocument,
        image,
        named_targets=sorted(target.name for target in image.named_targets),
        vector_table=table,
    )


def plan_document(plan: Plan, options: UpgradeOptions) -> PlanDocument:
    return document_of(
        PlanDocument,
        plan,
        target=plan.target.name,
        request_id=plan.target.request_id,
        answer_id=plan.target.answer_id,
        packets=plan.total_packets,
        wire_s=round(plan.wire_s, 6),
        gaps_s=round(gaps_s(plan, options), 6),
    )


def upgrade_document(
    plan: Plan,
    options: UpgradeOptions,
    result: Result,
    checks: Iterable[CheckMade],
    link: LinkReport | None,
) -> UpgradeDocument:
    """Create the document of an upgrade, successful or not."""
    return UpgradeDocument(
        image=image_document(plan.image, vector_table(plan.image)),
        plan=plan_document(plan, options),
        checks=list(checks),
        outcome=result.outcome,
        verification=replace(result.verification, running_version=result.running_version),
        previous_version=result.previous_version,
        shutdown_heard=result.shutdown_heard,
        link=link,
    )
