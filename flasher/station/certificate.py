"""The certificate of a unit: one HTML page to print on one A4 sheet, and an annex, made of the
records and nothing else.

A unit that did not pass gets a page as well, and the page says so in its first line.
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
"""Earlier runs in the table; the page says how many more there are."""
_WRITES_ON_SHEET: Final = 4
"""With more of them, or longer ones, all stand in the annex in full."""
_TEXT_ON_SHEET: Final = 40
_TEXT_IN_CODE: Final = 80
_ROW: Final = ("number", "at", "event", "run_id", "data", "previous_hash", "hash")
UNIT_WORDS: Final = {
    UnitState.PASS: (Status.GOOD, text("PASS"), text("This unit passed.")),
    UnitState.FAIL: (Status.BAD, text("FAIL"), text("This unit did not pass: it is no good unit.")),
    UnitState.RECHECK: (
        Status.WARNING,
        text("RECHECK"),
        text("The last run of this unit did not come to a result. It has to be checked."),
    ),
    UnitState.RUNNING: (
        Status.NEUTRAL,
        text("RUNNING"),
        text("This unit is being made: no result yet."),
    ),
    UnitState.NEW: (Status.NEUTRAL, text("NEW"), text("Nothing was done to this unit.")),
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
    """The signed audit row; None while the run goes on."""
    record_sha256: str = ""
    """Over the run and all that belongs to it."""
    is_kept: bool = False
    """The head of its row is kept in another place than beside the key."""
    is_beside: bool = False
    """It was compared with those beside the key."""
    examined_at: str = ""
    """When all records up to its row were examined; empty where they were not since."""
    content: Mapping[str, Any] = field(default_factory=dict)
    """The rows of the run, which the page carries."""
    row: Mapping[str, Any] = field(default_factory=dict)
    """The signed audit row."""
    seal: str = ""
    """What a page carries that was made before; empty to make it."""


def proven(store: Store, life: UnitLife) -> Proof:
    """Evidence for the last run. Raises UnprovenError when its records were changed."""
    last = life.runs[-1].run if life.runs else None
    if last is None or last.state is RunState.RUNNING:
        return Proof()
    found = store.examine_run(last.run_id)
    if found.problems:
        raise UnprovenError(
            f"No certificate for {printable(life.serial)}: its records were changed.",
            cause=f"{found.problems[0].where}: {found.problems[0].what}",
            remedy="Look at all of it with flasher station verify.",
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
    )


def render_certificate(
    life: UnitLife, made_at: datetime, proof: Proof, left_out: int = 0, language: str = "en"
) -> str:
    """The page. Raises UsageError for a unit without any run. `left_out`: how many earlier runs are
    not in `life`.
    """
    return render_page("certificate.html", language, **sheet(life, made_at, proof, left_out))


def sheet(life: UnitLife, made_at: datetime, proof: Proof, left_out: int = 0) -> dict[str, Any]:
    """What the template of the page needs. Raises UsageError for a unit without any run."""
    last = life.last
    if last is None:
        raise UsageError(f"Nothing was done to {life.serial}: there is nothing to certify.")
    status, word, sentence = UNIT_WORDS[life.state]
    if life.is_virtual:
        status = Status.WARNING  # never the colour of a product that passed
    earlier = life.runs[:-1]
    return {
        "life": life,
        "last": last,
        "status": status,
        "word": word,
        "sentence": sentence,
        "is_virtual": life.is_virtual,
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
        )
    )


def _code(last: RunDetails, record_sha256: str, head: ChainHead) -> Markup:
    """What a reader of the paper can compare with the records, as a QR code."""
    lines = code_lines(last, record_sha256, head)
    drawn = segno.make("\n".join(lines), error="m", micro=False, boost_error=False)
    return Markup(drawn.svg_inline(omitsize=True, svgclass=None, lineclass=None))  # noqa: S704


def code_lines(last: RunDetails, record_sha256: str, head: ChainHead) -> tuple[str, ...]:
    """The text of the QR code."""
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
    """What a measurement may be, in words."""
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
    """Whether it is within its limits, where it has any."""
    if not each.is_within:
        return text("outside")
    has_limits = any(limit is not None for limit in (each.low, each.high, each.expected))
    return text("within") if has_limits else ""


def number(value: float) -> str:
    """To a thousandth: times are not measured closer."""
    return f"{round(value, 3):,.10g}"


def _moment(moment: datetime | None) -> str:
    return "" if moment is None else f"{moment:%Y-%m-%d %H:%M:%S} UTC"
