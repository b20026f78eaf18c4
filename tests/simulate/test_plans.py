"""Plans of simulated upgrades: read, replayed, and judged by an honest oracle."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flasher.host.duplicates import DuplicateDetector
from flasher.host.outcome import Outcome
from flasher.simulate import plan as plans
from flasher.simulate.corpus import parents
from flasher.simulate.draw import drawn
from flasher.simulate.independent import frames_of
from flasher.simulate.plan import Plan
from flasher.simulate.play import play
from tests.loops import each

VECTORS = Path(__file__).parent.parent / "vectors.json"
SHORT = "job packets=3 ; independent erase=0.05"


@each("name", ["independent", "mock"])
def test_an_undisturbed_device_is_upgraded(name: str) -> None:
    verdict = play(Plan.parse(f"job packets=3 ; {name}"))
    assert verdict.is_good
    assert (verdict.ending, verdict.left, verdict.violations) == ("completed", "new", ())


def test_the_messages_of_the_independent_device_are_those_of_the_document() -> None:
    for vector in json.loads(VECTORS.read_text())["vectors"]:
        head = (int(vector["can_id"], 16), int(vector["mode"], 16), int(vector["command"], 16))
        frames = frames_of(*head, bytes.fromhex(vector["data"]))
        assert [frame.data.hex() for frame in frames] == vector["can_frames"], vector["name"]


@pytest.mark.slow
def test_a_plan_that_is_printed_is_read_as_the_same() -> None:
    for seed in (*range(280), *range(70_000_000, 70_000_020)):
        plan = drawn(seed)
        assert Plan.parse(str(plan)) == plan
        assert Plan.parse("\n".join(map(str, plan.clauses))) == plan
        assert drawn(seed) == plan


def test_every_eighth_seed_changes_a_plan_that_is_kept() -> None:
    kept = [{*map(str, parent.events)} for parent in parents()]
    for seed in range(0, 800, 8):
        events = {*map(str, drawn(seed).events)}
        assert any(len(each - events) <= 3 and len(events - each) <= 3 for each in kept)


@each("line", ["@99999999999999999 drop", "@0.0000000001 drop", "@packet3+1e20 drop"])
def test_long_and_short_times_are_read_as_they_are_printed(line: str) -> None:
    assert Plan.parse(str(Plan.parse(line))) == Plan.parse(line)


@each(
    "line",
    [
        "nonsense",
        "@noon drop",
        "drop count=many",
        "drop colour=red",
        "independent erase=soon",
        "@packet3 tool does=sing",
        "mock nonsense=1",
        "job others=yes",
        "load every=nan",
        "adapter lost=inf",
        "@reset5 drop",
        "@1.5+3 drop",
        "@1e400 drop",
        "",
        " ; ;",
        "job packets=0",
        "job packets=65536",
        "job packets=3 packets=4",
        "job ; job",
        "@1 adapter",
        "job short=128",
        "load every=0",
        "@1 drop count=1001",
        "@1 unsolicited number=65536",
        "@1 power device=-1",
        "@1 stall seconds=3600.1",
        "mock drift=-1",
        "independent erase=-0.1",
        "adapter queue=0",
    ],
)
def test_what_is_no_plan_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Plan.parse(line)


@each(
    "line", ["x" * 10_000, f"job packets={'9' * 4_000}", f"job {'x' * 9_000}", f"@{'1' * 9_000}s"]
)
def test_the_reason_quotes_only_the_beginning_of_a_long_text(line: str) -> None:
    with pytest.raises(ValueError, match=r"\w") as refused:
        Plan.parse(line)
    assert len(str(refused.value)) < 400


@each("line", ["job packets=1 short=127", "job packets=3 ; @1 stall seconds=3600", "load id=0x7FF"])
def test_a_plan_at_its_limits_is_played(line: str) -> None:
    play(Plan.parse(line))


@pytest.mark.slow
@each("seed", range(100, 112))
def test_a_line_replays_a_run_frame_by_frame(seed: int) -> None:
    plan = drawn(seed)
    assert play(plan) == play(Plan.parse(str(plan)))


@pytest.mark.slow
def test_random_plans_end_in_no_false_success_and_no_false_claim() -> None:
    for seed in range(60):
        verdict = play(drawn(seed, twin_share=0.0))
        assert verdict.violations == (), verdict


def test_the_oracle_finds_a_success_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """It believes the devices' flash only."""
    monkeypatch.setattr(Outcome, "ok", property(lambda _outcome: True))
    plan = Plan.parse("job target=wmc ; independent ; @packet2 power ; @packet2+0.5 interrupt")
    verdict = play(plan)
    assert verdict.left == "none"
    assert "FALSE" in {each.kind for each in verdict.violations}


def test_the_oracle_finds_a_twin_that_was_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DuplicateDetector, "_set_evidence", lambda _duplicates, _what: None)
    twin = "independent erase=0.05 late=0.003 ; @packet3+0.02 power device=1 seconds=9"
    verdict = play(Plan.parse(f"job target=wmc packets=3 ; independent erase=0.05 ; {twin}"))
    assert verdict.left == "new / none"
    assert [*map(str, verdict.violations)] == ["FALSE: success, and its twin has none"]


def test_a_twin_that_sent_nothing_in_the_transfer_is_counted_by_itself() -> None:
    verdict = play(Plan.parse(f"{SHORT} ; independent begins=off"))
    assert verdict.left == "new / old"
    assert [*map(str, verdict.violations)] == ["UNSEEN: success, and its twin has old"]
    assert all(each.is_excused for each in verdict.violations)


def test_announcements_of_two_bursts_around_update_commands_may_be_those_of_one_device() -> None:
    """The twin starts its application, which stays as it was and sends nothing."""
    twin = "independent begins=boot restart=0.122 spacing=0.0521 listens=after_burst erase=0.058"
    device = "independent restart=0.122 spacing=0.0521 listens=after_burst erase=0.058"
    text = f"job target=wmc packets=12 ; {device} ; @reset+0.0985 {twin} ; @update restart device=1"
    verdict = play(Plan.parse(text))
    assert all(each.is_excused for each in verdict.violations), verdict


def test_an_answer_that_is_doubled_before_a_restart_is_not_that_of_two_devices() -> None:
    plan = "job packets=6 ; mock ; @packet3 answer becomes=twice ; @packet5 power seconds=0.12"
    verdict = play(Plan.parse(plan))
    assert (verdict.ending, verdict.violations) == ("completed", ())


def test_packets_of_another_tool_while_the_adapter_is_away_are_reported_as_unobserved() -> None:
    """The device confirms them like the host's own, and then runs both images."""
    verdict = play(
        Plan.parse(
            "job ; mock bad_packet=silence ; @flash6+0.23874 tool does=packets count=20 ;"
            " @packet13+0.019723 unplug seconds=4.934275 wrong_rate=0.249305"
        )
    )
    assert verdict.left == "other"
    assert [*map(str, verdict.violations)] == ["UNSEEN: success, and the device has other"]


def test_a_tool_that_repeats_a_message_sent_twice_within_a_moment_may_be_taken_for_an_echo() -> (
    None
):
    """The second echo came as late as a copy of the first would, so another one is expected."""
    plan = (
        "job packets=3 ; adapter echoes=true delay=0.061193 ; independent erase=1.36 ;"
        " @update drop sender=host ; @packet2+0.43 tool does=updates ; @packet2 power seconds=3.8"
    )
    verdict = play(Plan.parse(plan))
    assert (verdict.left, verdict.violations) == ("new", ())


def test_a_second_device_that_comes_after_the_transfer_is_no_fault_of_the_host() -> None:
    verdict = play(Plan.parse(f"{SHORT} ; @end+0.001 independent begins=off"))
    assert verdict.left == "new / old"
    assert verdict.violations == ()


def test_each_clause_of_a_plan_is_drawn_by_some_seed() -> None:
    names = {clause.NAME for seed in range(400) for clause in drawn(seed).clauses}
    assert names | {plans.Subject.NAME} == set(plans.CLAUSES)
