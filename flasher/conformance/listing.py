"""The catalogue as a list: what could be run, and what cannot with the reason."""

from __future__ import annotations

from typing import NamedTuple

import flasher.conformance.cases  # noqa: F401  registers the cases
from flasher.conformance.cases.elsewhere import NOT_IMPLEMENTED
from flasher.conformance.model import CASES
from flasher.conformance.selection import Selection, check_selection, in_order


class Listed(NamedTuple):
    """A case; one that cannot be run has the reason as its title."""

    id: str
    group: str
    title: str
    clause: str
    requires: tuple[str, ...]
    choices: tuple[str, ...]
    can_be_run: bool


def listed(selection: Selection) -> list[Listed]:
    """The selected cases in the order of the catalogue. Raises UsageError for one that does not
    exist.
    """
    check_selection(selection)
    found = []
    for case_id in in_order((*CASES, *NOT_IMPLEMENTED)):
        case = CASES.get(case_id)
        group = case_id.partition("-")[0]
        if not selection.has(case_id, case.requires if case is not None else ()):
            continue
        if case is None:
            found.append(Listed(case_id, group, NOT_IMPLEMENTED[case_id], "", (), (), False))  # noqa: FBT003
        else:
            needs = tuple(sorted(need.value for need in case.requires))
            found.append(
                Listed(
                    case_id, group, case.title, case.clause, needs, case.choices, can_be_run=True
                )
            )
    return found
