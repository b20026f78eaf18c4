"""An upgrade in words and as JSON, for `flash` and `rescue`."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Annotated, NotRequired, TypedDict

from flasher.cli.documents import (
    ImageDocument,
    OutcomeDocument,
    PlanDocument,
    VerificationDocument,
)
from flasher.cli.output import byte_count, counted, duration
from flasher.cli.plan_text import image_document, plan_document
from flasher.events import CheckMade
from flasher.host.identity import Verdict as Judgement
from flasher.host.outcome import Outcome
from flasher.host.session import Result
from flasher.host.verify import Level, Verdict, Verification, possible_levels
from flasher.image.cortexm import vector_table
from flasher.image.plan import Plan
from flasher.trace.figures import Distribution, LinkReport

_NO_QUERY = ": the document gives this target no query for it"


class CheckDocument(TypedDict):
    """Something that was checked before the first write."""

    check: str
    verdict: Annotated[str, Judgement]
    text: str


class UpgradeDocument(TypedDict):
    """An upgrade. Transferred, completed and running are three claims: see `outcome` for the first
    two, `verification` for the third.
    """

    image: ImageDocument
    plan: PlanDocument
    checks: list[CheckDocument]
    outcome: OutcomeDocument
    verification: VerificationDocument
    shutdown_heard: bool
    """The battery sent SHUTDOWN meanwhile."""
    link: NotRequired[Annotated[dict[str, object], LinkReport]]
    """Times on the line; missing when no packet was answered."""


class DryRunDocument(TypedDict):
    """The plan of an upgrade that was not carried out."""

    dry_run: bool
    image: ImageDocument
    plan: PlanDocument
    checks: list[CheckDocument]


# -- in words -------------------------------------------------------------------------------------


def check_line(check: CheckMade) -> str:
    """A check that was made, in one line."""
    return f"check: {check.verdict}: {check.text}"


def summary_lines(result: Result, plan: Plan) -> list[str]:
    """The final lines of an upgrade that went through: three claims, kept apart."""
    outcome = result.outcome
    figures = outcome.statistics
    transfer_s = figures.transfer_s or 0.0
    sent = f"{byte_count(plan.image.size_bytes)} in {counted(plan.total_packets, 'packet')}"
    faults = f"{figures.repetitions} repeated, {figures.naks} NAK"
    whole = f"{counted(figures.attempts, 'attempt')}, {duration(figures.duration_s)} in all"
    return [
        f"transferred:  {sent}, {duration(transfer_s)}{_rate(plan, transfer_s)}",
        f"              {faults}, {whole}",
        f"boot version: {outcome.boot_version}",
        f"completed:    {outcome.ending.value}",
        f"running:      {_running(result)}",
    ]


def link_lines(report: LinkReport) -> list[str]:
    """How long each end took, as min / median / p95 / p99 / max."""
    return [
        f"{end:<13} {_figures(figures)} ms {doing}"
        for end, figures, doing in (
            ("device took:", report.device_answer, "to answer a packet"),
            ("host took:", report.host_turnaround, "to send the next (min/median/p95/p99/max)"),
        )
        if figures is not None
    ]


def _figures(of: Distribution) -> str:
    times = (of.minimum_s, of.median_s, of.p95_s, of.p99_s, of.maximum_s)
    return " / ".join(f"{each * 1000:.2f}" for each in times)


def _running(result: Result) -> str:
    """What is known of the application that runs now, and how."""
    verification = result.verification
    if verification.verdict is Verdict.NOT_ASKED:
        reason = "" if possible_levels(result.outcome.target) != (Level.NONE,) else _NO_QUERY
        return result.running_version or f"not asked{reason}"
    return f"{result.running_version or 'unknown'} ({verification.verdict.value})"


def _rate(plan: Plan, transfer_s: float) -> str:
    """Bytes per second and how close to the line rate that is."""
    if not transfer_s:
        return ""
    share = plan.transfer_wire_s / transfer_s
    line = f"{plan.bitrate_bps / 1000:g} kbit/s line"
    # A bus in memory or on a network has no bit rate to keep to.
    closeness = f"{share:.0%} of a {line}" if share <= 1.02 else f"faster than a {line}"
    return f" ({plan.image.size_bytes / transfer_s / 1000:.1f} kB/s, {closeness})"


# -- as JSON --------------------------------------------------------------------------------------


def upgrade_document(
    plan: Plan, result: Result, checks: Iterable[CheckMade], link: LinkReport | None
) -> UpgradeDocument:
    """The document of an upgrade, good or bad."""
    document = UpgradeDocument(
        image=image_document(plan.image, vector_table(plan.image)),
        plan=plan_document(plan),
        checks=check_documents(checks),
        outcome=_outcome_document(result.outcome),
        verification=_verification_document(result.verification, result.running_version),
        shutdown_heard=result.shutdown_heard,
    )
    if link is not None:
        document["link"] = dataclasses.asdict(link)
    return document


def dry_run_document(plan: Plan, checks: Iterable[CheckMade]) -> DryRunDocument:
    """The document of a plan that is not carried out."""
    return DryRunDocument(
        dry_run=True,
        image=image_document(plan.image, vector_table(plan.image)),
        plan=plan_document(plan),
        checks=check_documents(checks),
    )


def check_documents(checks: Iterable[CheckMade]) -> list[CheckDocument]:
    """The checks that were made, in order."""
    return [CheckDocument(check=c.check, verdict=c.verdict, text=c.text) for c in checks]


def _outcome_document(outcome: Outcome) -> OutcomeDocument:
    return OutcomeDocument(
        ending=outcome.ending.name.lower(),
        phase=outcome.phase.name.lower(),
        packet=outcome.packet,
        device_left=outcome.device_left.name.lower(),
        boot_version=outcome.boot_version,
        running_version=outcome.running_version,
        detail=outcome.detail,
        statistics=dataclasses.asdict(outcome.statistics),
    )


def _verification_document(of: Verification, running: str | None) -> VerificationDocument:
    return VerificationDocument(
        level=of.level.value,
        verdict=of.verdict.name.lower(),
        running_version=running,
        detail=of.detail,
    )
