"""Packet forms that the profile decides about: one list for cases, `init` and walks."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from flasher.conformance.bench import Bench
from flasher.conformance.cases import fr
from flasher.conformance.catalogue import Selection
from flasher.conformance.explore import Explorer
from flasher.conformance.explore.steps import next_step
from flasher.conformance.explore.walk import Walk
from flasher.conformance.init.answers import Trial
from flasher.conformance.init.session import InitSession
from flasher.conformance.init.transfer_questions import in_forms
from flasher.conformance.profile import choice_words
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.conformance.wire import Encoder
from tests.conformance.bench import PROFILE, one, subject
from tests.loops import each

KEYS = tuple(fr.forms(Encoder("bms")))
START = ("reset", "update=good", "packet")


@pytest.fixture
def own_junk(monkeypatch: pytest.MonkeyPatch) -> bytes:
    own = b"\x34\x12"
    monkeypatch.setattr(fr, "JUNK_IN_FRAME", (*fr.JUNK_IN_FRAME, own))
    return own


def test_a_form_that_is_added_is_sent_by_its_case(own_junk: bytes) -> None:
    report = run(subject(), PROFILE, selection=Selection(cases=("FR-02",)))
    result = one(report, "FR-02")
    assert result.verdict is CaseVerdict.PASS
    assert f"{own_junk.hex(' ')} in its first frame" in {check.step for check in result.checks}


def test_a_form_that_is_added_is_asked_for_a_profile(own_junk: bytes) -> None:
    session = InitSession(subject(), PROFILE, lambda: False)
    stimulus = f"a packet after {own_junk.hex(' ')} in its first frame"
    found = list(in_forms(session, "fr_02"))
    assert Trial("found", "accepted", stimulus, "") in found


@pytest.mark.usefixtures("own_junk")
def test_a_form_that_is_added_is_sent_in_walks() -> None:
    bench = Bench(subject(), PROFILE, limit_s=100.0)
    walk = Walk(bench)
    for name, argument in (("reset", ""), ("update", "good"), ("packet", "")):
        walk.take(name, argument)
    drawn = {str(next_step(walk, random.Random(seed))) for seed in range(1500)}
    assert "packet-open=fr_02-6" in drawn
    explorer = Explorer(subject(), PROFILE)
    assert explorer.replay([*START, "packet-open=fr_02-6", "packets=all", "end"]).finding is None


@pytest.mark.slow
@each("key", KEYS)
def test_a_walk_judges_by_the_profile_as_a_case_does(key: str) -> None:
    _, not_taken = choice_words(key)
    stated = replace(PROFILE, given={**PROFILE.given, key: not_taken})
    steps = [*START, f"packet-open={key}-0"]
    found = Explorer(subject(), stated).replay(steps).finding
    assert found is not None
    assert found.rule == "ack"
    case_id = key.upper().replace("_", "-")
    report = run(subject(), stated, selection=Selection(cases=(case_id,)))
    assert one(report, case_id).verdict is CaseVerdict.FAIL
    open_one = replace(PROFILE, given={**PROFILE.given, key: "either"})
    assert Explorer(subject(), open_one).replay(steps).finding is None
