"""Certificate of a unit: an HTML page for one A4 sheet with an annex, made from the records.

The certificate of a unit that did not pass states that in its first line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

import segno
from markupsafe import Markup

from flasher import __version__
from flasher.errors import UsageError
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.report.base import Status, render_page
from flasher.station.records.errors import UnprovenError
from flasher.station.records.heads import ChainHead
from flasher.station.records.model import (
    Measurement,
    RunDetails,
    RunKind,
    RunState,
    UnitLife,
    UnitState,
)
from flasher.station.records.signatures import fingerprint
from flasher.station.records.store import Store
from flasher.station.sealed import LEFT_OUT, Sealed, as_text, plain

EARLIER_SHOWN: Final = 50
"""Maximum number of earlier runs in the table; the page states how many others there are."""
_WRITES_ON_SHEET: Final = 4
"""Maximum number of writes on the sheet; otherwise the annex lists them."""
_TEXT_ON_SHEET: Final = 40
_TEXT_IN_CODE: Final = 80
_ROW: Final = ("number", "at", "event", "run_id", "data", "previous_hash", "hash")
UNIT_WORDS: Final = {
    UnitState.PASS: (Status.GOOD, text("PASS"), text("This unit passed.")),
    UnitState.FAIL: (Status.BAD, text("FAIL"), text("This unit did not pass.")),
    UnitState.RECHECK: (
        Status.WARNING,
        text("RECHECK"),
        text("The last run of this unit ended without a verdict. It has to be checked."),
    ),
    UnitState.RUNNING: (
        Status.NEUTRAL,
        text("RUNNING"),
        text("A run of this unit is active: no verdict yet."),
    ),
    UnitState.NEW: (Status.NEUTRAL, text("NEW"), text("This unit has no run.")),
}
RUN_WORDS: Final = {
    RunState.RUNNING: (text("RUNNING"), Status.NEUTRAL),
    RunState.PASS: (text("PASS"), Status.GOOD),
    RunState.FAIL: (text("FAIL"), Status.BAD),
    RunState.ERROR: (text("ERROR"), Status.WARNING),
    RunState.ABORTED: (text("ABORTED"), Status.WARNING),
    RunState.INTERRUPTED: (text("INTERRUPTED"), Status.WARNING),
}


@dataclass(frozen=True)
class Proof:
    """Evidence for the last run of a unit."""

    head: ChainHead | None = None
    """The signed audit row; None while the run is active."""
    record_sha256: str = ""
    """SHA-256 over the run with its steps, writes, targets and attachments."""
    is_kept: bool = False
    """The head of its audit row is stored in another place than the key's folder."""
    is_beside: bool = False
    """The head of its audit row is stored in the key's folder."""
    examined_at: str = ""
    """Time of the last examination of all records up to its audit row; "" without one."""
    content: Mapping[str, Any] = field(default_factory=dict)
    """Rows of the run, which the certificate contains."""
    row: Mapping[str, Any] = field(default_factory=dict)
    is_released: bool = False
    """The plant released the claim of the unit before it had the end of the run."""
    seal: str = ""
    """Signed lines of an existing certificate; "" to make them."""


def proven(store: Store, life: UnitLife) -> Proof:
    """Examine the last run of a unit. Raises UnprovenError if its records were changed."""
    last = life.runs[-1].run if life.runs else None
    if last is None or last.state is RunState.RUNNING:
        return Proof()
    found = store.examine_run(last.run_id)
    for problem in found.problems:
        raise UnprovenError(
            text(
                "No certificate for {serial}: its records were changed.",
                serial=printable(life.serial),
            ),
            cause=text("{where}: {what}", where=problem.where, what=problem.what),
            remedy=text("List all problems with flasher station verify."),
        )
    head, record_sha256 = store.read.head_of(last.run_id), store.read.record_sha256(last.run_id)
    content, row = store.read.content_of(last.run_id)
    return Proof(
        head,
        record_sha256,
        bool(found.elsewhere),
        found.is_beside,
        (found.examined_at or "")[:10],
        content,
        row,
        last.run_id in store.read.released(),
    )


def render_certificate(
    life: UnitLife, made_at: datetime, proof: Proof, left_out: int = 0, language: str = "en"
) -> str:
    """Render a certificate as HTML. `left_out`: number of earlier runs that are not in `life`.

    Raises UsageError for a unit without runs.
    """
    return render_page("certificate.html", language, **sheet(life, made_at, proof, left_out))


def sheet(life: UnitLife, made_at: datetime, proof: Proof, left_out: int = 0) -> dict[str, Any]:
    """Values for the template certificate.html. Raises UsageError for a unit without runs."""
    last = life.last
    if last is None:
        raise UsageError(text("{serial} has no run to certify.", serial=life.serial))
    status, word, sentence = UNIT_WORDS[life.state]
    is_unchecked = last.run.is_unchecked or proof.is_released
    if life.is_virtual or is_unchecked:
        status = Status.WARNING  # never the colour of a product that passed
    earlier = life.runs[:-1]
    signatures = {target.signature for target in last.targets}
    return {
        "life": life,
        "last": last,
        "status": status,
        "word": word,
        "sentence": sentence,
        "is_virtual": life.is_virtual,
        "is_unchecked": is_unchecked,
        "head": proof.head,
        "key": fingerprint(proof.head.key) if proof.head else "",
        "is_kept": proof.is_kept,
        "is_beside": proof.is_beside,
        "examined_at": proof.examined_at,
        "seal": proof.seal or _seal(life, made_at, proof),
        "record_sha256": proof.record_sha256,
        "code": "" if proof.head is None else _code(last, proof.record_sha256, proof.head),
        "writes": last.writes[:_WRITES_ON_SHEET],
        "text_limit": _TEXT_ON_SHEET,
        "has_more_writes": len(last.writes) > _WRITES_ON_SHEET
        or any(
            len(text or "") > _TEXT_ON_SHEET
            for write in last.writes
            for text in (write.value, write.read_back)
        ),
        "is_golden": last.run.kind is RunKind.GOLDEN,
        "measurements": [
            (step, each, limits_of(each), verdict_of(each))
            for step in last.steps
            for each in step.measurements
            if each.text is None or each.text not in signatures  # with the images
        ],
        "earlier": [
            (run, RUN_WORDS[run.state][1])
            for run in (details.run for details in earlier[-EARLIER_SHOWN:])
        ],
        "earlier_left_out": max(0, len(earlier) - EARLIER_SHOWN) + left_out,
        "moment": _moment,
        "number": number,
        "made_at": _moment(made_at),
    }


def _seal(life: UnitLife, made_at: datetime, proof: Proof) -> str:
    if proof.head is None or not proof.row:
        return ""
    earlier = [details.run for details in life.runs[:-1]]
    recipe = proof.content["recipe"]
    return as_text(
        Sealed(
            flasher=__version__,
            made_at=made_at.isoformat(),
            is_kept=proof.is_kept,
            is_beside=proof.is_beside,
            examined_at=proof.examined_at,
            content={k: value for k, value in proof.content.items() if k not in LEFT_OUT},
            recipe={name: recipe[name] for name in ("name", "revision", "sha256")},
            row={name: proof.row[name] for name in _ROW},
            station=proof.head.station,
            signature=proof.head.signature,
            key=proof.head.key,
            earlier=tuple(map(plain, earlier[-EARLIER_SHOWN:])),
            earlier_left_out=max(0, len(earlier) - EARLIER_SHOWN),
            is_released=proof.is_released,
        )
    )


def _code(last: RunDetails, record_sha256: str, head: ChainHead) -> Markup:
    """QR code with which a printed certificate can be compared with the records."""
    lines = code_lines(last, record_sha256, head)
    drawn = segno.make("\n".join(lines), error="m", micro=False, boost_error=False)
    return Markup(drawn.svg_inline(omitsize=True, svgclass=None, lineclass=None))  # noqa: S704


def code_lines(last: RunDetails, record_sha256: str, head: ChainHead) -> tuple[str, ...]:
    """Text of the QR code."""
    run = last.run
    return (
        "flasher record 1",
        f"unit {printable(run.serial)[:_TEXT_IN_CODE]}",
        f"part {printable(run.part)[:_TEXT_IN_CODE]}",
        f"run {run.run_id} {run.state.value}{' virtual' if run.is_virtual else ''}",
        f"record {record_sha256}",
        f"row {head.number} {printable(head.station)[:_TEXT_IN_CODE]}",
        f"hash {head.hash}",
        f"signature {head.signature}",
        f"key {head.key}",
    )


def limits_of(each: Measurement) -> str:
    """Limits of a measurement in words."""
    if each.value is None:
        return each.expected if each.expected is not None else text("any")
    bounds = {
        name: round(bound, 3)
        for name, bound in (("low", each.low), ("high", each.high))
        if bound is not None
    }
    if not bounds:
        return text("any")
    unit = f" {each.unit}".rstrip()
    if len(bounds) > 1:
        return text("from {low:,.10g} to {high:,.10g}{unit}", unit=unit, **bounds)
    if "low" in bounds:
        return text("from {low:,.10g}{unit}", unit=unit, **bounds)
    return text("to {high:,.10g}{unit}", unit=unit, **bounds)


def verdict_of(each: Measurement) -> str:
    """Returns "within" or "outside"; "" for a measurement without limits."""
    if not each.is_within:
        return text("outside")
    has_limits = any(limit is not None for limit in (each.low, each.high, each.expected))
    return text("within") if has_limits else ""


def number(value: float) -> str:
    """Format a number with at most three decimals, the precision of measured times."""
    return f"{round(value, 3):,.10g}"


def _moment(moment: datetime | None) -> str:
    return "" if moment is None else f"{moment:%Y-%m-%d %H:%M:%S} UTC"
