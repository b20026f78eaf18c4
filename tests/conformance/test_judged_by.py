"""A check that fails names the profile keys that decide it, in every report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from flasher.cli.bench.conformance_text import report_lines
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import Selection
from flasher.conformance.html_report import html_page
from flasher.conformance.judge import TimeName
from flasher.conformance.mock import MOCK_PROFILE, profile_of_mock
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.profile_time import limits_of
from flasher.conformance.reports import junit_report, to_json
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.conformance.wire import Reply
from tests.conformance.bench import NOTHING_STATED, one, run_case, subject
from tests.loops import each


def _waits_for_an_answer(bench: Bench) -> None:
    bench.expect(Reply.ACK)


def _waits_for_answers_to_damage(bench: Bench) -> None:
    bench.check(bool(bench.answers()), "NAK", "silence")


def _waits_for_the_longest_of_several(bench: Bench) -> None:
    bench.expect(Reply.ACK, within_s=max(bench.limit("erase_s"), bench.limit("ack_s")))


def _waits_in_vain_and_gets_a_wrong_answer(bench: Bench) -> None:
    bench.collect(bench.limit("feedback_s"))
    bench.send(bench.encoder.query_version())
    bench.expect(Reply.ACK)


def _measures(bench: Bench) -> None:
    bench.check_time(TimeName.REQUEST, 12.0, high_s=bench.limit("erase_s"))


def _measures_often(bench: Bench) -> None:
    bench.measure(TimeName.SPACING, 0.2)
    spacing_s, off_s = bench.limit("version_spacing_s"), bench.limit("version_spacing_tolerance_s")
    bench.judge.check_measured(TimeName.SPACING, low_s=spacing_s - off_s, high_s=spacing_s + off_s)


def _compares_the_flash_in_a_transfer(bench: Bench) -> None:
    bench.start_transfer(len(bench.good_image))
    bench.collect(bench.waits.silence_s)
    bench.check_stored(bench.good_image[:128])


def _waits_for_an_application(bench: Bench) -> None:
    bench.start_transfer(len(bench.good_image))
    bench.check_application()


def _makes_a_pause(bench: Bench) -> None:
    bench.start_transfer(len(bench.good_image))
    bench.packet(bench.good_image, 1)
    bench.wait(bench.limit("pause_s") + 1.0)
    bench.end_transfer()


def _fails_at_once(bench: Bench) -> None:
    bench.fail("one", "two")


@pytest.mark.slow
@each(
    "action, keys",
    (
        (_waits_for_an_answer, {"limits.ack_s": 0.5}),
        (_waits_for_answers_to_damage, {"limits.inter_frame_s": 0.1, "limits.ack_s": 0.5}),
        (_waits_for_the_longest_of_several, {"limits.erase_s": 10.0}),
        (_waits_in_vain_and_gets_a_wrong_answer, {}),
        (_measures, {"limits.erase_s": 10.0}),
        (
            _measures_often,
            {"limits.version_spacing_s": 0.05, "limits.version_spacing_tolerance_s": 0.01},
        ),
        (_compares_the_flash_in_a_transfer, {"device.buffer_bytes": 0}),
        (_waits_for_an_application, {"limits.start_s": 5.0}),
        (_makes_a_pause, {"tx_12": "either", "tx_13": "either", "limits.pause_s": 5.0}),
        (_fails_at_once, {}),
    ),
)
def test_a_failed_check_has_the_limits_that_it_waited_for(
    action: Callable[[Bench], None], keys: dict[str, float | str]
) -> None:
    report = run_case(action, profile=ConformanceProfile({"limits.start_s": 5.0}))
    failure = one(report, "FR-00").first_failure
    assert failure is not None
    assert failure.judged_by == keys
    values = {key: value if isinstance(value, str) else f"{value:g}" for key, value in keys.items()}
    assert all(f"{key} = {value}" in str(failure) for key, value in values.items())


def test_a_time_keeps_its_limits_in_sums_and_differences_and_products() -> None:
    profile = ConformanceProfile({"limits.ack_s": 0.25, "limits.erase_s": 2.0})
    ack_s, erase_s = profile.limit("ack_s"), profile.limit("erase_s")
    both = {"limits.ack_s": 0.25, "limits.erase_s": 2.0}
    for time_s, value_s, limits in (
        (1.0 + ack_s, 1.25, {"limits.ack_s": 0.25}),
        (erase_s - 0.5, 1.5, {"limits.erase_s": 2.0}),
        (3.0 - erase_s, 1.0, {"limits.erase_s": 2.0}),
        (2 * ack_s + erase_s / 2, 1.5, both),
        (sum((ack_s, erase_s)), 2.25, both),
        (max(ack_s, erase_s), 2.0, {"limits.erase_s": 2.0}),
        (float(erase_s), 2.0, {}),
    ):
        assert (time_s, limits_of(time_s)) == (value_s, limits)


def test_the_clock_of_the_bench_knows_no_limit() -> None:
    """Times of the device, and of frames, would name all limits that were ever waited for."""
    device = subject()
    run(device, profile_of_mock(), selection=Selection(cases=("BU-02", "RS-01")))
    assert limits_of(device.port.now()) == {}


def test_an_announcement_among_damaged_packets_names_the_pause() -> None:
    impatient = replace(MOCK_PROFILE, transfer_timeout_s=0.4)
    report = run(subject(profile=impatient), NOTHING_STATED, selection=Selection(cases=("CR-03",)))
    failure = one(report, "CR-03").first_failure
    assert failure is not None
    assert failure.judged_by == {"tx_12": "either", "tx_13": "either", "limits.pause_s": 5.0}


def test_a_passed_check_names_no_key() -> None:
    report = run(subject(), profile_of_mock(), selection=Selection(cases=("TX-02",)))
    assert not any(check.judged_by for check in one(report, "TX-02").checks)


@pytest.fixture(scope="module")
def lines() -> dict[str, str]:
    """A report about a device that differs from its profile in a choice, in each format."""
    other = ConformanceProfile({**profile_of_mock().given, "tx_02": "nak_next"})
    report = run(subject(), other, selection=Selection(cases=("TX-02",)))
    assert one(report, "TX-02").verdict is CaseVerdict.FAIL
    (result,) = to_json(report)["results"]
    assert result["findings"][0]["judged_by"] == {"tx_02": "nak_next"}
    return {
        "text": "\n".join(report_lines(report)),
        "junit": junit_report(report).decode(),
        "html": html_page(report),
    }


@each("kind", ("text", "junit", "html"))
def test_a_report_names_the_key_beside_what_was_expected(lines: dict[str, str], kind: str) -> None:
    assert "NAK 2 for the repeated packet (profile: tx_02 = nak_next)" in lines[kind]
