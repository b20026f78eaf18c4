"""`flasher plant retire`."""

from __future__ import annotations

from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from flasher.cli.bar import Bar
from flasher.cli.output import Output, byte_count, counted
from flasher.cli.plant.documents import PlantRetireDocument
from flasher.errors import UsageError
from flasher.plant.archive import month_after
from flasher.plant.central import Central
from flasher.plant.retire import (
    LIMIT_S,
    ArchiveRefusedError,
    RetiredMonth,
    Retirement,
    month_before,
)
from flasher.protocol.text import printable


def retire(
    output: Output,
    url: str,
    archive: Path,
    before: str | None,
    keep_months: int | None,
    *,
    dry_run: bool,
    with_problems: bool,
) -> int:
    if (before is None) == (keep_months is None):
        raise UsageError(
            "Name either --before or --keep-months.", remedy="Add --before 2024-01, for example."
        )
    if before is None:
        before = month_before(datetime.now(UTC), keep_months or 0)
    month_after(before)  # raises for what is no month
    months: list[RetiredMonth] = []
    look = {"unit": " rows", "desc": "retiring", "unit_scale": True}
    with (
        closing(Central(url, statement_limit_s=LIMIT_S)) as central,
        Bar(output, **look) as bar,
    ):
        work = Retirement(central, archive, bar.move_to)
        if dry_run:
            due = work.months(before)
            for each in due:
                held = f"{counted(each.rows, 'row')}, {counted(each.runs, 'run')}"
                output.result(printable(f"{each.month}: {held}"))
            if not due:
                output.result(f"nothing to retire before {before}")
            return output.document(PlantRetireDocument(before, months, due))
        try:
            for retired in work.retire(before, with_problems=with_problems):
                months.append(retired)
                output.result(printable(_line(retired)))
        except ArchiveRefusedError as error:
            for problem in error.problems:
                output.result(printable(f"PROBLEM  {problem.where}: {problem.what}"))
            raise
    if not months:
        output.result(f"nothing to retire before {before}")
    return output.document(PlantRetireDocument(before, months, []))


def _line(each: RetiredMonth) -> str:
    held = f"{counted(each.rows, 'row')}, {counted(each.runs, 'run')}"
    text = f"{each.month}: {held}, {counted(each.traces, 'trace')} in {each.file}"
    text += f" ({byte_count(each.size_bytes)})"
    return text + (f", WITH {counted(len(each.problems), 'problem')}" if each.problems else "")
