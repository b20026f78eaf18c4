"""The mistakes that `python -m tests.campaigns.line_bugs` plants in the station."""

from __future__ import annotations

import pytest

from tests.campaigns.line_bugs import CHECKOUT, Bug, read_bugs

BUGS = read_bugs()


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_planted_bug_applies_and_is_python(bug: Bug) -> None:
    modules = bug.modules()

    for file, text in modules.items():
        before = (CHECKOUT / file).read_text("utf-8")
        compile(text, file, "exec")
        assert text != before


def test_planted_bugs_have_names_of_their_own() -> None:
    assert len({bug.name for bug in BUGS}) == len(BUGS) == 25
