"""Random walks: their findings, how they are shrunk, and that there are no false ones."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flasher.conformance.explore import Explorer
from flasher.conformance.explore.steps import parse_step, reachable_pairs
from flasher.conformance.explore.stimuli import REFUSED, TransferPosition, make_stimulus
from flasher.conformance.explore.walk import ALL_STEPS, filler
from flasher.conformance.mock import MOCK_PROFILE, MockSubject, profile_of_mock, variant_maker
from flasher.conformance.profile import Value
from flasher.conformance.restore import BY_NOTHING, restore
from flasher.conformance.results import ExploreResult
from flasher.conformance.wire import Encoder, joined
from flasher.errors import UsageError
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.variants.framing import ShortFrameEnds
from flasher.protocol.spec import TARGETS, WELLING
from tests.campaigns.right_devices import CountsFromPackets, answers_late
from tests.cli.conftest import Flasher


def _explorer(variant: str = "", target: str = "bms", seed: str = "1", **choices: Any) -> Explorer:
    device = replace(MOCK_PROFILE, **choices)
    make = variant_maker(variant) if variant else None
    subject = MockSubject(target, profile=device, make_device=make)
    return Explorer(subject, profile_of_mock(device), seed=seed)


def _found(explored: ExploreResult) -> tuple[str, str]:
    assert explored.finding is not None
    return explored.finding.rule, " ".join(explored.finding.steps)


@pytest.mark.slow
@pytest.mark.parametrize(
    "choices",
    [
        {"pause_in_transfer": "waits", "reset_in_transfer": "restarts"},
        {"update_in_transfer": "ignored", "bad_packet": "silence", "older_packet": "nak"},
        {"without_application": "listens", "repeated_packet": "nak_next"},
        {"image_checksum": "crc32", "after_complete": "restarts", "repeated_end": "silence"},
        {"reset_in_bootloader": "restarts", "upgrade_in_application": "silence"},
    ],
    ids=lambda choices: next(iter(choices)),
)
def test_nothing_is_found_on_a_device_of_other_choices(choices: dict[str, str]) -> None:
    assert _explorer(**choices).explore(250).finding is None


@pytest.mark.slow
@pytest.mark.parametrize("target", ["wmc", "bms", "obc"])
def test_nothing_is_found_on_a_right_device(target: str) -> None:
    explored = _explorer(target=target).explore(250)
    assert explored.finding is None
    assert explored.stopped == ""
    assert explored.steps >= 250


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "rule", "last", "count"),
    [
        ("no-feedback", "no feedback", "reset", 1),
        ("announces-three-times", "burst", "burst", 1),
        ("accepts-skipped-number", "ack", "packet-skip", 3),
        ("accepts-early-end", "complete", "end", 3),
        ("repeat-unanswered", "no ACK", "packet-again", 4),
        ("record-erased-last", "mixed", "cut=0", 2),
    ],
)
def test_the_shortest_walk_to_a_flaw_is_found_and_finds_it_again(
    variant: str, rule: str, last: str, count: int
) -> None:
    found, steps = _found(_explorer(variant, seed="2").explore(4000))
    assert (found, steps.split()[-1], len(steps.split())) == (rule, last, count)
    assert _found(_explorer(variant).replay(steps.split())) == (rule, steps)
    assert _explorer().replay(steps.split()).finding is None


@pytest.mark.slow
def test_a_seed_decides_everything() -> None:
    first, second = (_explorer("accepts-early-end", seed="4").explore(1000) for _ in range(2))
    assert first == second


@pytest.mark.slow
def test_a_device_that_takes_no_upgrade_is_a_finding_before_the_first_step() -> None:
    explored = _explorer("big-endian-numbers").explore(100)
    assert explored.finding is not None
    assert explored.finding.rule == "upgrade"
    assert explored.steps == 0


def test_pairs_of_phase_and_step_that_were_never_met_are_reported() -> None:
    explored = _explorer().explore(5)
    met = {(each.phase, each.step) for each in explored.coverage if each.count}
    assert met
    assert met.isdisjoint(explored.not_covered)
    assert len(met) + len(explored.not_covered) == len(reachable_pairs())


def test_what_is_transferred_and_does_not_run_is_never_completed() -> None:
    explored = _explorer().replay(["reset", "update=384", "packets=all", "end", "wait=window"])
    assert explored.finding is None
    assert explored.steps == 5


@pytest.mark.parametrize("words", [None, ["reset", "update=384", "packet", "wait=20"]])
@pytest.mark.parametrize("stops_at_s", [0.0, 5.0])
def test_a_walk_that_is_stopped_leaves_the_good_image(
    words: list[str] | None, stops_at_s: float
) -> None:
    subject = MockSubject()
    explorer = Explorer(
        subject, profile_of_mock(), stopped=lambda: subject.port.now() >= stops_at_s
    )
    explored = explorer.explore(10_000) if words is None else explorer.replay(words)
    assert explored.stopped == "it was stopped"
    assert explored.finding is None
    assert restore(subject, profile_of_mock(), flash=False).how == BY_NOTHING


@pytest.mark.slow
def test_a_stop_while_the_walk_is_cut_down_keeps_what_was_found() -> None:
    subject = MockSubject(make_device=variant_maker("repeat-unanswered"))
    whole = Explorer(subject, profile_of_mock()).explore(4000)
    stops_at_s = subject.port.now() - 20
    again = MockSubject(make_device=variant_maker("repeat-unanswered"))
    explored = Explorer(
        again, profile_of_mock(), stopped=lambda: again.port.now() >= stops_at_s
    ).explore(4000)
    assert whole.finding is not None
    assert explored.finding is not None
    assert explored.finding.rule == whole.finding.rule
    assert len(explored.finding.steps) > len(whole.finding.steps)
    assert explored.stopped == "it was stopped"
    assert restore(again, profile_of_mock(), flash=False).how == BY_NOTHING


def test_a_replay_that_finds_something_leaves_the_good_image() -> None:
    subject = MockSubject(make_device=variant_maker("accepts-skipped-number"))
    explorer = Explorer(subject, profile_of_mock())
    assert explorer.replay(["reset", "update=good", "packet-skip"]).finding is not None
    assert restore(subject, profile_of_mock(), flash=False).how == BY_NOTHING


@pytest.mark.parametrize(
    "step", ["pocket", "update=abc", "packets", "packets=-1", "packets=0.5", "cut=good", "wait="]
)
def test_a_step_that_does_not_exist_is_reported(step: str) -> None:
    with pytest.raises(UsageError, match=f"no step '{step}'"):
        _explorer().replay(["reset", step])


def test_every_step_is_written_and_read() -> None:
    assert {name for _, name in reachable_pairs()} == set(ALL_STEPS)
    assert str(parse_step("packet-again=older-other")) == "packet-again=older-other"


def test_no_two_messages_that_are_refused_are_the_same_and_none_is_the_right_one() -> None:
    place = TransferPosition(Encoder("bms"), filler(640), 2, 0x20000)
    made = {name: make_stimulus(name, place) for name in REFUSED}
    sent = {name: tuple(refused.frames) for name, refused in made.items()}
    assert len(set(sent.values())) == len(sent)
    right = {
        tuple(place.encoder.frames(place.next_packet)),
        tuple(place.encoder.end()),
        tuple(place.encoder.reset()),
        tuple(place.encoder.update(384)),
    }
    assert right.isdisjoint(sent.values())
    writes = {joined(made[name].frames)[2] for name in made if made[name].is_intact_write}
    assert writes == {0x16}


@pytest.mark.slow
def test_the_command_prints_a_replay_that_finds_the_same(flasher: Flasher, tmp_path: Path) -> None:
    trace = tmp_path / "walk.log"
    ran = flasher(
        *("conformance", "explore", "-t", "bms", "--mock", "--variant", "accepts-early-end"),
        *("--trace-file", trace),
    )
    assert ran.code == 12
    assert "FOUND complete: " in ran.out
    (replay,) = (line for line in ran.out.splitlines() if "replay: " in line)
    words = shlex.split(replay.partition("replay: ")[2])
    again = flasher(*words[1:], "--json")
    assert again.code == 12
    finding = again.document["finding"]
    assert finding["rule"] == "complete"
    assert f"steps: {' '.join(finding['steps'])}\n" in ran.out
    assert len(finding["steps"]) == 3
    assert trace.read_text().count("752#") >= 5


def test_nothing_found_is_exit_code_0(flasher: Flasher) -> None:
    ran = flasher("conformance", "explore", "-t", "bms", "--mock", "--steps", "50", "-v")
    assert ran.code == 0
    assert ran.out.splitlines()[-1] == "nothing was found"
    assert "never in the phase transfer" in ran.out


def test_it_walks_for_a_time_and_reports_what_was_covered(flasher: Flasher) -> None:
    ran = flasher("conformance", "explore", "-t", "bms", "--mock", "--for", "0.01")
    assert ran.code == 0
    assert " 1 walk, " in ran.out
    assert "pairs of phase and step were covered" in ran.out
    assert ran.out.splitlines()[-1] == "nothing was found"
    sooner = flasher("conformance", "explore", "-t", "bms", "--mock", "--for", "99", "--steps", "3")
    assert " 3 steps, " in sooner.out


def test_a_device_on_a_bus_is_not_worn_without_being_asked_for(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = ("-t", "bms", "-i", "virtual", "-c", "explore", "--good-image", "README.md")
    ran = flasher("conformance", "explore", *bench)
    assert ran.code == 2
    assert "2000 steps erase and write the device about 333 times" in ran.err
    assert "Add --yes." in ran.err
    asked = []
    where = "flasher.cli.bench.conformance_bench"
    monkeypatch.setattr("flasher.cli.terminal.can_ask", lambda: True)
    monkeypatch.setattr(f"{where}.agrees", lambda question, **_: asked.append(question))
    assert flasher("conformance", "explore", *bench, "--steps", "12").code == 2
    assert flasher("conformance", "explore", *bench, "--for", "60").code == 2
    assert asked == [
        "12 steps erase and write the device about 2 times. Begin?",
        "the device is erased and written again and again for 60 s. Begin?",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("argument", ["", "=other"])
@pytest.mark.parametrize("choice", ["ack", "nak_next", "either"])
def test_a_repeated_packet_is_judged_by_the_profile_as_in_the_case(
    choice: str, argument: str
) -> None:
    steps = ["reset", "update=good", "packets=2", f"packet-again{argument}"]
    for answers in ("ack", "nak_next"):
        device = replace(MOCK_PROFILE, repeated_packet=answers)
        stated = profile_of_mock(device)
        stated = replace(stated, given={**stated.given, "tx_02": choice})
        found = Explorer(MockSubject(profile=device), stated).replay(steps).finding
        assert (found is None) is (choice in (answers, "either"))
        silent = MockSubject(profile=device, make_device=variant_maker("repeat-unanswered"))
        assert Explorer(silent, stated).replay(steps).finding is not None


def _walked(
    kind: type[MockDevice], steps: list[str], given: dict[str, Value] | None = None, **choices: Any
) -> ExploreResult:
    device = replace(MOCK_PROFILE, **choices)

    def make(target: str, profile: DeviceProfile) -> MockDevice:
        return kind(TARGETS[target], bitrate_bps=WELLING.bitrate_bps, profile=profile)

    stated = profile_of_mock(device)
    pause: dict[str, Value] = {"limits.pause_s": device.transfer_timeout_s}
    stated = replace(stated, given={**stated.given, **pause, **(given or {})})
    return Explorer(MockSubject(profile=device, make_device=make), stated).replay(steps)


def test_feedback_to_an_update_command_may_come_after_the_reset_that_follows() -> None:
    late = answers_late(GeneralFeedbackMessage=0.9)
    assert _walked(late, ["update=good", "burst"]).finding is None


def test_a_pause_may_count_from_the_last_packet_that_was_stored_and_end_within_a_step() -> None:
    kind = type("Hasty", (CountsFromPackets, answers_late(Ack=0.488)), {})
    steps = ["reset", "update=128", "packets=4", "packet-again=other", "packet-mode", "flood"]
    choices: dict[str, Any] = {
        "repeated_packet": "nak_next",
        "bad_packet": "silence",
        "transfer_timeout_s": 2.5,
    }
    assert _walked(kind, steps, **choices).finding is None


def test_a_device_that_rejects_short_frames_may_ignore_empty_ones() -> None:
    kind = type("Short", (MockDevice,), {"reassembler_type": ShortFrameEnds})
    steps = ["reset", "update=second", "packet-between"]
    assert _walked(kind, steps, {"fr_01": "rejected"}).finding is None
