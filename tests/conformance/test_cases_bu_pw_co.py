"""BU, PW and CO on the mock: a correct device passes with every choice, each wrong one fails."""

from __future__ import annotations

from typing import Any

import pytest

from flasher.conformance.catalogue import CASES, Requirement, Selection
from flasher.conformance.mock import MockSubject, profile_of_mock, variant_maker
from flasher.conformance.results import CaseResult, CaseVerdict, CheckOutcome
from flasher.conformance.runner import run
from flasher.conformance.wire import Encoder
from tests.loops import each

from .verdicts import cases_of, not_passed, verdicts

SHARES = ("0%", "50%", "100%")
GROUPS = ("BU", "PW", "CO")
MINE = tuple(case_id for group in GROUPS for case_id in cases_of(group))
QUICK = tuple(case_id for case_id in MINE if case_id not in ("PW-01", "PW-04", "CO-01"))


def result_of(case_id: str, variant: str | None = None, **powers: bool) -> CaseResult:
    """Run one case on a bench without some capabilities."""
    subject = MockSubject(make_device=None if variant is None else variant_maker(variant))
    for name, value in powers.items():
        setattr(subject, name, value)
    report = run(subject, profile_of_mock(), selection=Selection(cases=(case_id,)))
    return report.results[0]


@pytest.mark.slow
def test_the_mock_passes() -> None:
    expected = ("BU-01", "BU-02", "BU-06", "PW-01", "PW-02", "PW-04", "CO-01", "CO-02", "CO-04")
    assert expected == MINE
    assert not_passed("CO-01", *QUICK) == []


@pytest.mark.slow
def test_a_target_without_a_version_query_passes() -> None:
    assert not_passed(*QUICK, target="wmc") == []


@pytest.mark.slow
@pytest.mark.no_cover
@each(
    "choices",
    [
        {"reset_in_bootloader": "restarts", "without_application": "listens"},
        {"window_s": 0.05, "update_in_transfer": "ignored", "pause_in_transfer": "waits"},
        {"reset_in_transfer": "restarts", "window_s": 0.5, "after_complete": "restarts"},
        {"bad_packet": "silence", "repeated_packet": "nak_next", "repeated_end": "silence"},
    ],
)
def test_the_mock_passes_by_its_profile_whatever_it_chooses(choices: dict[str, Any]) -> None:
    assert not_passed(*QUICK, **choices) == []


@pytest.mark.slow
def test_one_image_and_readback_report_a_torn_image_too() -> None:
    for name in ("starts-torn-image", "record-first"):
        assert verdicts(["PW-01"], name, with_second_image=False) == {"PW-01": CaseVerdict.FAIL}
    assert not_passed("PW-02", with_second_image=False) == []


def test_versions_show_a_torn_image_on_a_bench_without_readback() -> None:
    result = result_of("PW-01", "record-first", has_readback=False)
    assert result.verdict is CaseVerdict.FAIL
    assert result.first_failure is not None
    assert result.first_failure.got.startswith("version ")


@pytest.mark.slow
def test_a_bench_with_power_alone_judges_what_it_can_and_states_what_it_cannot() -> None:
    result = result_of("PW-01", has_readback=False, has_timed_cuts=False)
    assert result.verdict is CaseVerdict.PASS_IN_PART
    steps = [one.step for one in result.checks if one.outcome is CheckOutcome.UNSUPPORTED]
    assert steps[:2] == ["", "after ACK 2"]


@each("case_id, power", [("PW-01", "has_power"), ("PW-02", "has_power"), ("BU-02", "has_bus_off")])
def test_what_a_bench_lacks_makes_a_case_unsupported(case_id: str, power: str) -> None:
    assert result_of(case_id, None, **{power: False}).verdict is CaseVerdict.UNSUPPORTED


@pytest.mark.slow
def test_others_take_nine_tenths_of_the_bus() -> None:
    own = Encoder("bms").to_device
    trace = result_of("CO-01").trace
    sent = [entry for entry in trace if entry.sent and entry.frame.can_id != 0x001]
    share = sum(entry.frame.can_id != own for entry in sent) / len(sent)
    assert 0.85 < share < 0.98
    foreign = [entry.at_s for entry in sent if entry.frame.can_id != own]
    # 200 full frames of 125 bits fill 100 ms.
    assert max(sum(at <= one < at + 0.1 for one in foreign) for at in foreign[::100]) > 160


@pytest.mark.slow
def test_every_frame_of_every_message_is_disturbed() -> None:
    """Each frame in each way: as many steps as there are frames and kinds of fault."""
    result = result_of("BU-01")
    steps = " ".join(check.step for check in result.checks)
    for frame in range(1, 19):
        assert f"frame {frame} sent is dropped" in steps
        assert f"frame {frame} sent is doubled" in steps
        assert frame == 1 or f"frame {frame} sent is delayed" in steps
        assert frame == 18 or f"frame {frame} sent is swapped" in steps


@pytest.mark.slow
def test_power_is_cut_at_every_frame_of_an_upgrade_and_in_every_flash_operation() -> None:
    result = result_of("PW-01")
    assert result.verdict is CaseVerdict.PASS
    steps = {check.step for check in result.checks}
    assert {f"after frame {frame} of reset" for frame in (1, 2)} <= steps
    assert {f"after frame {frame} of the update command" for frame in (1, 2, 3)} <= steps
    packets = {f"after frame {f} of packet {n}" for f in range(1, 19) for n in range(1, 7)}
    assert packets <= steps
    assert {f"after frame {frame} of end of transfer" for frame in (1, 2)} <= steps
    # Erase of a page, six packets, the record.
    operations = {
        f"flash operation {n}, {share} of it done" for n in range(1, 9) for share in SHARES
    }
    assert operations <= steps


def test_the_cases_describe_what_they_do() -> None:
    for case_id in MINE:
        case = CASES[case_id]
        assert Requirement.DESTRUCTIVE in case.requires
        assert all((case.title, case.clause, case.stimulus, case.expectation))
