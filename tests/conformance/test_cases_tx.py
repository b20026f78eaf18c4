"""TX on the mock: a correct device passes with every choice, each wrong one fails its case."""

from __future__ import annotations

from typing import Any

import pytest

from flasher.conformance.results import CaseVerdict
from tests.loops import each

from .verdicts import cases_of, not_passed, verdicts

BAD_PACKET = ("TX-01", "TX-03", "TX-04", "TX-06")
REPEATED = ("TX-02", "TX-05")
LEFT = ("TX-12", "TX-13")


@pytest.mark.slow
def test_the_mock_passes() -> None:
    cases = cases_of("TX")
    assert len(cases) == 10
    assert not_passed(*cases) == []


@pytest.mark.slow
@each("target", ["wmc", "obc"])
def test_a_target_without_a_version_query_passes(target: str) -> None:
    assert not_passed("TX-01", "TX-13", target=target) == []


@pytest.mark.slow
@each(
    "cases, choices",
    [
        (
            BAD_PACKET + REPEATED,
            {
                "bad_packet": "nak_received",
                "older_packet": "nak",
                "repeated_packet": "nak_next",
                "image_checksum": "crc32",
                "states": {"tx_01_lost_frame": "nak"},
            },
        ),
        (
            BAD_PACKET,
            {
                "bad_packet": "silence",
                "older_packet": "silence",
                "after_complete": "restarts",
                "states": {"tx_01_lost_frame": "silence"},
            },
        ),
        (("TX-08",), {"variant": "filler-checked", "states": {"tx_08": "rejected"}}),
        (LEFT, {"pause_in_transfer": "waits"}),
        (("TX-12",), {"pause_in_transfer": "waits", "update_in_transfer": "ignored"}),
        (LEFT, {"reset_in_transfer": "restarts", "without_application": "listens"}),
        (
            LEFT,
            {
                "pause_in_transfer": "waits",
                "update_in_transfer": "ignored",
                "reset_in_transfer": "restarts",
            },
        ),
    ],
)
def test_the_mock_passes_by_its_profile_whatever_it_chooses(
    cases: tuple[str, ...], choices: dict[str, Any]
) -> None:
    assert not_passed(*cases, **choices) == []


@pytest.mark.slow
@each(
    "case_id, states",
    [
        ("TX-01", {"tx_01": "silence"}),
        ("TX-01", {"tx_01": "nak_received"}),
        ("TX-01", {"tx_01_lost_frame": "silence"}),
        ("TX-02", {"tx_02": "nak_next"}),
        ("TX-03", {"tx_03": "nak"}),
        ("TX-08", {"tx_08": "rejected"}),
        ("TX-12", {"tx_12": "waits"}),
        ("TX-13", {"tx_13": "restarts"}),
    ],
)
def test_a_device_that_chooses_otherwise_than_its_profile_states_fails(
    case_id: str, states: dict[str, str]
) -> None:
    assert not_passed(case_id, states=states) == [case_id]


def test_a_device_that_waits_for_ever_after_a_pause_fails_although_waiting_is_allowed() -> None:
    chosen = {"variant": "never-times-out", "pause_in_transfer": "waits"}
    assert not_passed("TX-12", **chosen) == ["TX-12"]


def test_an_image_without_filler_leaves_nothing_to_judge_about_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = bytes(range(128)) * 8
    monkeypatch.setattr("flasher.conformance.bench.Bench.good_image", whole)
    found = verdicts(["TX-08"], with_second_image=False)
    assert found == {"TX-08": CaseVerdict.UNSUPPORTED}


def test_nothing_is_begun_that_only_a_power_cut_could_end_where_power_is_not_controlled() -> None:
    chosen: dict[str, Any] = {
        "pause_in_transfer": "waits",
        "update_in_transfer": "ignored",
        "with_power": False,
    }
    assert verdicts(["TX-07"], **chosen) == {"TX-07": CaseVerdict.UNSUPPORTED}
    found = verdicts(["TX-12", "TX-13"], **chosen)
    assert found == {"TX-12": CaseVerdict.PASS_IN_PART, "TX-13": CaseVerdict.PASS}
