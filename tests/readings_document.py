"""The document of the readings, and of the clauses that the cases of the suite are judged by.

    python -m tests.readings_document

writes docs/explanation/readings.md anew from `flasher/conformance/clauses.py`; a test holds it
against that.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from flasher.conformance import cases  # noqa: F401  registers them
from flasher.conformance.catalogue import CASES, catalogue_order
from flasher.conformance.clauses import CLAUSES, READINGS, ROBUSTNESS, ClauseReading, clause_texts
from flasher.conformance.profile import unstated

ROOT: Final = Path(__file__).parents[1]
DOCUMENT: Final = ROOT / "docs" / "explanation" / "readings.md"
HOLDERS: Final = {
    "R1": (
        (
            "tests/protocol/test_catalogue.py::"
            "test_both_dialects_leave_four_bytes_reserved_in_running_information"
        ),
    ),
    "R2": (
        (
            "tests/host/test_flow.py::"
            "test_every_boot_version_of_a_burst_is_answered_until_request_transfer"
        ),
        "tests/host/test_flow.py::test_the_update_command_is_never_repeated_into_silence",
    ),
    "R3": ("tests/host/test_product.py::test_the_products_own_reset_is_sent",),
    "R4": ("tests/image/test_plan.py::test_a_packet_number_is_little_endian",),
    "R5": (
        "tests/mock/test_bms.py::test_memory_reads_give_the_application_of_the_flash",
        "tests/api/test_requests.py::test_memory_is_read_in_pieces_of_128_bytes",
    ),
    "R6": ("tests/host/test_end.py::test_a_second_nak_whatever_its_number_means_refused",),
    "R7": ("tests/mock/test_cases.py::test_an_image_with_a_right_checksum_is_taken",),
    "R8": (
        "tests/image/test_segments.py::test_a_gap_within_the_limit_is_filled_with_ff",
        "tests/image/test_cortexm.py::test_a_program_that_starts_outside_of_itself_is_refused",
    ),
    "R9": (
        "tests/image/test_plan.py::test_an_empty_and_a_too_large_image_are_refused",
        (
            "tests/image/test_plan.py::"
            "test_the_packets_hold_the_image_and_the_last_is_filled_up_with_ff"
        ),
    ),
    "R10": (
        (
            "tests/host/test_transfer.py::"
            "test_nak_n_plus_1_for_a_repeated_packet_counts_only_where_the_profile_allows_it"
        ),
    ),
    "R11": (
        (
            "tests/host/test_transfer.py::"
            "test_a_later_boot_version_starts_the_transfer_over_as_a_new_attempt"
        ),
        (
            "tests/host/test_end.py::"
            "test_no_boot_version_is_answered_after_the_end_and_the_version_answer_decides"
        ),
    ),
    "R12": ("tests/protocol/test_spec.py::test_the_default_timings_are_the_documents_and_r12s",),
    "R13": ("tests/protocol/test_contents.py::test_its_bytes_are_decoded_to_the_content",),
    "R14": (
        (
            "tests/end_to_end/test_rescue.py::"
            "test_a_device_without_application_is_rescued_whichever_way_it_announces"
        ),
    ),
    "R15": ("tests/host/test_transfer.py::test_general_feedback_in_the_transfer_is_ignored",),
    "R16": (
        (
            "tests/host/test_transfer.py::"
            "test_request_transfer_again_before_ack_1_gets_packet_1_again_and_no_update_command"
        ),
    ),
    "R17": (
        (
            "tests/mock/test_dialogue.py::"
            "test_the_application_answers_upgrade_messages_with_feedback_or_not_and_erases_nothing"
        ),
    ),
    "R18": (
        (
            "tests/host/test_power_up.py::"
            "test_after_a_lost_packet_the_device_is_reset_and_the_power_is_asked_for_again"
        ),
    ),
    "R20": ("tests/protocol/test_text.py::test_a_field_that_breaks_the_rule_is_shown_as_it_is",),
    "R21": ("tests/protocol/test_contents.py::test_the_status_is_shown_by_its_bits",),
    "R22": (
        "tests/trace/test_decoder.py::test_a_state_of_health_is_shown_as_received_and_remarked_on",
    ),
    "R23": (
        (
            "tests/mock/test_bms_alone.py::"
            "test_shutdown_is_repeated_every_200_ms_until_1_s_when_no_device_answers_then_it_is_off"
        ),
    ),
    "R24": (
        "tests/protocol/test_contents.py::test_an_unnamed_fault_is_kept_and_shown_by_its_number",
    ),
    "R26": (
        (
            "tests/host/test_attempts.py::"
            "test_a_session_that_was_left_over_is_found_by_the_update_command_into_the_silence"
        ),
        (
            "tests/host/test_open_session.py::"
            "test_a_silent_device_gets_one_update_command_when_the_erase_limit_has_passed"
        ),
        ("tests/cli/test_open_session.py::test_nothing_else_lets_an_update_command_into_silence"),
    ),
    "R27": (
        (
            "tests/host/test_session_stages.py::"
            "test_two_devices_that_report_different_versions_are_refused_before_the_reset"
        ),
        (
            "tests/host/test_duplicates.py::"
            "test_a_packet_that_was_sent_once_and_acknowledged_twice_is_two_devices"
        ),
        (
            "tests/host/test_duplicates.py::"
            "test_two_bursts_that_overlap_are_two_devices_although_one_feedback_was_lost"
        ),
    ),
    "R28": (
        (
            "tests/host/test_transfer.py::"
            "test_a_later_boot_version_starts_the_transfer_over_as_a_new_attempt"
        ),
        "tests/station/test_exchanges.py::test_a_unit_that_is_exchanged_while_it_is_flashed",
    ),
}
"""Tests of the host, the reader and the device model that hold a reading."""

_INTRODUCTION: Final = f"""\
# Readings of the documents

What `flasher conformance` judges a bootloader by: the clauses of the vendor's document, and R1 to
R28, how this project reads the places where the documents are silent or contradict themselves. Each
reading is the default of flasher's host and of its device model. Drawn from
`flasher/conformance/clauses.py` by `python -m tests.readings_document`; a test compares them, and
that the tests named here exist.

Options that change a reading are in three places: the suite's profile
([profile of the suite](../reference/conformance_profile.md)), the host's profile
([profile](../reference/profile.md)),
and the choices of the device model (`flasher mock --set`).

The suite requires a reading that is a choice of its profile only where the profile states it.
{unstated()}
"""


def readings_document() -> str:
    """docs/explanation/readings.md."""
    lines = [_INTRODUCTION]
    for number, reading in READINGS.items():
        lines += _reading(number, reading)
    lines += [
        "## Clauses of the document",
        "",
        "| clause | what it asks for, in our words | cases |",
    ]
    lines += ["|---|---|---|"]
    lines += [
        f"| {label.removeprefix('Welling ')} | {content} | {' '.join(_cases(label))} |"
        for label, content in CLAUSES.items()
        if label.startswith("Welling")
    ]
    lines += ["", "## Labels of cases", "", f"**{ROBUSTNESS}**: {CLAUSES[ROBUSTNESS]}. "]
    lines[-1] += "What differs between products is a choice in the suite's profile."
    lines += ["", "| case | title | choices |", "|---|---|---|"]
    for case_id in _cases(ROBUSTNESS):
        keys = ", ".join(f"`{key}`" for key in CASES[case_id].choices)
        lines.append(f"| {case_id} | {CASES[case_id].title} | {keys} |")
    return "\n".join(lines) + "\n"


def _reading(number: str, reading: ClauseReading) -> Iterator[str]:
    asks = reading.asks[0].upper() + reading.asks[1:]
    yield from (f"## {number}", "", f"**{asks}.** {reading.why}", "")
    options = {
        "suite's profile": reading.suite,
        "host's profile": reading.host,
        "device model": reading.model,
    }
    for where, names in options.items():
        if names:
            yield f"- {where}: {', '.join(f'`{name}`' for name in names)}"
    if not any(options.values()):
        yield "- no option changes it"
    if found := _cases(number):
        yield f"- cases: {', '.join(found)}"
    for test in HOLDERS.get(number, ()):
        yield f"- test: `{test}`"
    yield ""


def _cases(label: str) -> list[str]:
    return [one for one in catalogue_order(CASES) if label in clause_texts(CASES[one].clause)]


if __name__ == "__main__":
    DOCUMENT.write_text(readings_document(), encoding="utf-8")
