"""The matrix of wrong bootloaders and cases: which case catches which.

    python -m tests.variant_matrix            runs the suite on every variant, writes the table
    python -m tests.variant_matrix --check    the same, and compares: exit code 1 if it differs
    python -m tests.variant_matrix --quick    compares the cases that are listed for each variant

The table is docs/reference/variants.md. The gate runs `--quick`, which does not see that a case
that is not listed for a variant fails on it; a test runs some variants on the case of their clause.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final, NamedTuple

from flasher.conformance.catalogue import (
    CASES,
    NOT_IMPLEMENTED,
    QUICK,
    WEAR,
    Selection,
    catalogue_order,
)
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.mock.variants import VARIANTS, Variant

PATH: Final = Path(__file__).parents[1] / "docs" / "reference" / "variants.md"
TARGET: Final = "bms"
AREA_BYTES: Final = 80 * 1024
"""Smaller than the mock's own, since the largest image is sent often; larger than 16 bits tell."""
_RUN: Final = [case_id for case_id in catalogue_order(CASES) if case_id not in WEAR]
"""A whole run, of cases that need not be named."""
NOT_OF_MODEL: Final = {
    "PW-04": "the model's flash does not fail; shown by bugs 91 to 93 planted in the example in C"
}
"""Cases that need a compiled bootloader, with what shows that they detect a mistake."""
_COUNTING: Final = frozenset({"hangs-at-20th-update"})
"""Which case meets the fault depends on those before it."""
_MANY: Final = 20
"""A variant that fails more cases fails whatever needs an upgrade: its quick ones show that."""
_CAUGHT: Final = frozenset({CaseVerdict.FAIL, CaseVerdict.ERROR})

_INTRODUCTION: Final = """\
# Wrong bootloaders, and the cases that catch them

Made by `python -m tests.variant_matrix`, which runs the whole suite on every variant of the device
model; the gate runs again on each the cases that are listed (`--quick`).
`flasher mock --variant NAME` serves as one, `flasher conformance --mock --variant NAME -t bms` runs
the suite on it.

A variant violates one clause and is right in everything else. What it fails beside the case of
its clause has the same stimulus in it; where no upgrade works, or the fault is met in every one,
most cases that need one fail.
"""


class Row(NamedTuple):
    """What the suite says of a variant: the cases that it fails, in the order of the catalogue."""

    variant: str
    fails: tuple[str, ...]
    not_run: int
    """Cases that were not run, since the device could not be brought back."""


def row_of(name: str, cases: Sequence[str] = ()) -> Row:
    """Run the suite, or these cases of it, on a variant."""
    variant = VARIANTS[name]
    changes: dict[str, Any] = {"application_area_bytes": AREA_BYTES, **variant.profile}
    device = dataclasses.replace(MOCK_PROFILE, **changes)
    subject = MockSubject(TARGET, profile=device, make_device=variant_maker(name))
    report = run(subject, profile_of_mock(device), selection=Selection(cases=tuple(cases)))
    failed = {result.case_id for result in report.results if result.verdict in _CAUGHT}
    return Row(name, tuple(catalogue_order(failed)), report.count(CaseVerdict.NOT_RUN))


def cases_of_gate(name: str, fails: tuple[str, ...]) -> tuple[str, ...]:
    """Of the cases listed for a variant, those that the gate runs."""
    clause = VARIANTS[name].clause
    if name in _COUNTING:
        return (clause,)
    if len(fails) <= _MANY:
        return fails
    return tuple(case_id for case_id in fails if case_id in {*QUICK, clause})


def differs(listed: tuple[str, tuple[str, ...]]) -> str:
    """What the cases listed for a variant say otherwise; "" for nothing."""
    cases = cases_of_gate(*listed)
    row = row_of(listed[0], cases)
    return "" if row.fails == cases else f"{row.variant}: {', '.join(row.fails) or 'nothing fails'}"


def all_rows(jobs: int | None = None) -> list[Row]:
    """Every variant, on as many processes as there are cores."""
    with ProcessPoolExecutor(jobs or os.cpu_count()) as pool:
        return list(pool.map(row_of, VARIANTS))


def groups_passed(row: Row) -> str:
    """The groups of which no case fails."""
    failed = {case.partition("-")[0] for case in row.fails}
    groups = dict.fromkeys(case.partition("-")[0] for case in _RUN)
    return " ".join(group for group in groups if group not in failed)


def document(rows: Iterable[Row]) -> str:
    """docs/reference/variants.md."""
    rows = list(rows)
    lines = [_INTRODUCTION, "## By variant", ""]
    lines += [
        "| variant | clause | fails | passes the groups | what it does wrong |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        variant = VARIANTS[row.variant]
        fails = _failed_text(row, variant)
        lines.append(
            f"| {row.variant} | {variant.clause} | {fails} | {groups_passed(row)} "
            f"| {variant.summary} |"
        )
    lines += ["", "## By case", "", "| case | title | caught |", "|---|---|---|"]
    for case_id in _RUN:
        caught = ", ".join(row.variant for row in rows if case_id in row.fails)
        caught = NOT_OF_MODEL.get(case_id, caught)
        lines.append(f"| {case_id} | {CASES[case_id].title} | {caught} |")
    if NOT_IMPLEMENTED:
        lines += ["", "## Not done in software", ""]
        lines += [f"- {case_id}: {reason}" for case_id, reason in NOT_IMPLEMENTED.items()]
    return "\n".join([*lines, ""])


def _failed_text(row: Row, variant: Variant) -> str:
    cases = [f"**{case}**" if case == variant.clause else case for case in row.fails]
    rest = [f"{row.not_run} not run"] if row.not_run else []
    return ", ".join([*cases, *rest])


def listed_rows() -> dict[str, tuple[str, ...]]:
    """The variants of docs/reference/variants.md with the cases that catch each."""
    rows = {}
    by_variant = PATH.read_text(encoding="utf-8").partition("## By case")[0]
    for line in by_variant.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| ") and cells[0] != "variant":
            cases = (case.strip("* ") for case in cells[2].split(","))
            rows[cells[0]] = tuple(case for case in cases if case in CASES)
    return rows


def main(words: Sequence[str] | None = None) -> int:
    """Write the table, or compare it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--check", action="store_true", help="compare with docs/reference/variants.md"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="compare what the cases that are listed for a variant say",
    )
    parser.add_argument("--jobs", type=int, help="processes (default: as many as cores)")
    options = parser.parse_args(words)
    if options.quick:
        with ProcessPoolExecutor(options.jobs or os.cpu_count()) as pool:
            found = list(filter(None, pool.map(differs, listed_rows().items())))
        sys.stderr.writelines(f"not as in {PATH.name}: {each}\n" for each in found)
        return 1 if found else 0
    text = document(all_rows(options.jobs))
    if not options.check:
        PATH.write_text(text, encoding="utf-8")
        return 0
    if PATH.read_text(encoding="utf-8") == text:
        return 0
    sys.stderr.write(f"{PATH.name} is not what the suite says: python -m tests.variant_matrix\n")
    return 1


if __name__ == "__main__":
    sys.exit(main())
