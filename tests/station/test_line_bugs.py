"""The mistakes that `python -m tests.campaigns.line_bugs` plants in the station, each with a story
that it spoils.
"""

from __future__ import annotations

import pytest

from flasher.simulate.planting import swapped
from tests.campaigns.line_bugs import LineBug, read_bugs
from tests.campaigns.line_world.play import play
from tests.campaigns.line_world.stories import Story

BUGS = read_bugs()
AT_HOME = ("STUCK", "TRUSTED")
"""Violations that show when somebody brings the units to their ends after the story."""
each_bug = pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)


@pytest.mark.slow
@each_bug
def test_a_planted_bug_applies(bug: LineBug) -> None:
    assert bug.codes()


@pytest.mark.slow
@each_bug
def test_the_oracle_condemns_the_story_of_a_planted_bug_and_of_no_other_station(
    bug: LineBug,
) -> None:
    story, goes_home = Story.parse(bug.story), bug.kind in AT_HOME

    assert play(story, goes_home=goes_home).text == ""
    with swapped(bug.codes()):
        assert play(story, goes_home=goes_home).kind == bug.kind


def test_planted_bugs_have_names_of_their_own() -> None:
    assert len({bug.name for bug in BUGS}) == len(BUGS) == 25
