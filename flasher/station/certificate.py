"""Certificate of a unit: an HTML page for one A4 sheet with an annex, made from the records.

The certificate of a unit that did not pass states that in its first line.
"""

from __future__ import annotations

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


def proven(store: Store, life: UnitLife, made_at: datetime) -> Sealed | None:
    """Examine the last run of a unit, and seal it; None while it is active. Raises UnprovenError if
    its records were changed.
    """
    last = life.runs[-1].run if life.runs else None
    if last is None or last.state is RunState.RUNNING:
        return None
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
    head = store.read.head_of(last.run_id)
    if head is None:
        return None
    content, row = store.read.content_of(last.run_id)
    earlier = [details.run for details in life.runs[:-1]]
    return Sealed(
        flasher=__version__,
        made_at=made_at.isoformat(),
        is_kept=bool(found.elsewhere),
        is_beside=found.is_beside,
        examined_at=(found.examined_at or "")[:10],
        content={k: value for k, value in content.items() if k not in LEFT_OUT},
        recipe={name: content["recipe"][name] for name in ("name", "revision", "sha256")},
        row={name: row[name] for name in _ROW},
        station=head.station,
        signature=head.signature,
        key=head.key,
        earlier=tuple(map(plain, earlier[-EARLIER_SHOWN:])),
        earlier_left_out=max(0, len(earlier) - EARLIER_SHOWN),
        is_released=last.run_id in store.read.released(),
    )


def render_certificate(
    life: UnitLife, made_at: datetime, sealed: Sealed | None, language: str = "en"
) -> str:
    """Render a certificate as HTML. Raises UsageError for a unit without runs."""
    return render_page("certificate.html", language, **sheet(life, made_at, sealed))


def sheet(life: UnitLife, made_at: datetime, sealed: Sealed | None) -> dict[str, Any]:
    """Values for the template certificate.html. Raises UsageError for a unit without runs."""
    last = life.last
    if last is None:
        raise UsageError(text("{serial} has no run to certify.", serial=life.serial))
    status, word, sentence = UNIT_WORDS[life.state]
    is_unchecked = last.run.is_unchecked or (sealed is not None and sealed.is_released)
    if life.is_virtual or is_unchecked:
        status = Status.WARNING  # never the colour of a product that passed
    earlier = life.runs[:-1]
    left_out = max(0, len(earlier) - EARLIER_SHOWN)
    signatures = {target.signature for target in last.targets}
    head = None if sealed is None else sealed.head
    return {
        "life": life,
        "last": last,
        "status": status,
        "word": word,
        "sentence": sentence,
        "is_virtual": life.is_virtual,
        "is_unchecked": is_unchecked,
        "sealed": sealed,
        "head": head,
        "key": fingerprint(head.key) if head else "",
        "seal": as_text(sealed) if sealed else "",
        "code": _code(last, sealed) if sealed else "",
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
        "earlier_left_out": sealed.earlier_left_out if sealed else left_out,
        "moment": _moment,
        "number": number,
        "made_at": _moment(made_at),
    }


def _code(last: RunDetails, sealed: Sealed) -> Markup:
    """QR code with which a printed certificate can be compared with the records."""
    lines = code_lines(last, sealed.record_sha256, sealed.head)
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
