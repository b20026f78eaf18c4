"""Catalogue rows that concern a host, and the tests of this project that cover each of them.

A row that names no side concerns both; the bootloader's half is a case of the suite. Paths are
relative to `tests/`. `test_host_rows` checks that every test exists and no row is missing.
"""

from __future__ import annotations

from typing import Final

_REASSEMBLER: Final = "protocol/test_reassembler.py::"
_PROPERTIES: Final = "protocol/test_reassembler_properties.py::"
_VECTORS: Final = "protocol/test_vectors.py::"
_WIRE: Final = "protocol/test_wire.py::"
_ADAPTER: Final = "bus/test_adapter.py::"
_DRIVER: Final = "bus/test_driver.py::"
_FLOW: Final = "host/test_flow.py::"
_TRANSFER: Final = "host/test_transfer.py::"
_END: Final = "host/test_end.py::"
_TABLE: Final = "host/test_table.py::"
_STAGES: Final = "host/test_session_stages.py::"
_GUARD: Final = "host/test_guard.py::"
_ANY: Final = "host/test_any_device.py::"
_CORNERS: Final = "host/test_quiet_corners.py::"
_FAULTS: Final = "end_to_end/test_bus_faults.py::"
_ODD: Final = "end_to_end/test_odd_wires.py::"
_FOREIGN: Final = "end_to_end/test_foreign_traffic.py::"
_REFEREES: Final = "end_to_end/test_referees.py::"
_RESCUE: Final = "end_to_end/test_rescue.py::"

HOST_ROWS: Final[dict[str, tuple[str, ...]]] = {
    # -- framing ------------------------------------------------------------------------------
    "FR-01": (
        _VECTORS + "test_frames_of_any_one_size_are_decoded_alike",
        _VECTORS + "test_a_message_split_at_random_is_decoded_alike",
        _PROPERTIES + "test_valid_messages_in_any_split_come_back_as_they_were",
    ),
    "FR-02": (
        _REASSEMBLER + "test_junk_before_a_header_is_reported_and_skipped",
        _REASSEMBLER
        + "test_a_lone_55_at_the_end_of_a_frame_is_not_half_a_header_of_the_next_message",
        _REASSEMBLER + "test_a_lone_header_before_a_message_is_reported_as_a_bad_length",
        _PROPERTIES + "test_a_message_straight_after_any_noise_is_found_by_the_silence_after_it",
    ),
    "FR-03": (
        _REASSEMBLER + "test_a_header_inside_data_starts_nothing",
        _REASSEMBLER + "test_a_tail_at_every_place_in_data_ends_nothing",
        _REASSEMBLER + "test_a_whole_message_inside_data_is_data",
    ),
    "FR-04": (
        _REASSEMBLER + "test_a_wrong_tail_is_reported_with_the_whole_message",
        _REASSEMBLER + "test_after_a_wrong_tail_the_rest_is_scanned_again",
        _FLOW + "test_damaged_bytes_and_unknown_messages_are_reported_and_passed_over",
    ),
    "FR-05": (
        _REASSEMBLER + "test_after_a_lost_frame_the_next_message_is_found",
        _REASSEMBLER + "test_after_a_lost_frame_the_next_message_is_found_without_silence_too",
        _REASSEMBLER + "test_a_message_after_a_partial_one_is_found_at_the_timeout",
    ),
    "FR-06": (
        _REASSEMBLER + "test_a_length_that_does_not_fit_the_command_is_refused_at_once",
        _REASSEMBLER
        + "test_a_length_of_255_with_an_unknown_command_waits_for_no_more_than_264_bytes",
    ),
    "FR-07": (_VECTORS + "test_the_last_frame_may_be_padded_to_eight_bytes",),
    "FR-08": (
        _VECTORS + "test_two_messages_back_to_back_are_both_decoded",
        _VECTORS + "test_all_messages_of_one_id_in_a_row_are_decoded_in_order",
    ),
    "FR-09": (
        _WIRE + "test_only_a_standard_data_frame_with_bytes_is_payload",
        _FLOW + "test_frames_of_others_and_frames_that_are_no_payload_change_nothing",
    ),
    "FR-10": (
        _REASSEMBLER + "test_an_intact_message_with_an_unknown_mode_and_command_is_handed_on",
        _CORNERS + "test_messages_that_are_malformed_or_unknown_are_reported_by_command_and_id",
    ),
    # -- checksum -----------------------------------------------------------------------------
    "CR-01": (_PROPERTIES + "test_no_packet_with_a_single_flipped_bit_is_accepted",),
    "CR-02": (
        _PROPERTIES + "test_no_packet_with_a_burst_within_eight_bits_is_accepted",
        _PROPERTIES + "test_no_two_frames_of_a_packet_may_change_places",
        _REASSEMBLER + "test_a_packet_with_a_doubled_frame_is_not_accepted",
    ),
    "CR-03": (
        _PROPERTIES + "test_a_crc_for_another_id_or_in_the_other_order_is_refused",
        _PROPERTIES + "test_a_crc_that_leaves_out_the_id_is_refused",
    ),
    "CR-04": (
        _VECTORS + "test_a_message_is_encoded_byte_for_byte",
        _VECTORS + "test_the_frames_of_the_table_are_decoded",
    ),
    # -- reset and update command -------------------------------------------------------------
    "RS-06": (_FLOW + "test_a_boot_version_without_general_feedback_is_answered",),
    "RS-07": (
        _FLOW + "test_every_boot_version_of_a_burst_is_answered_until_request_transfer",
        _FLOW + "test_no_boot_version_ends_with_no_answer_and_an_untouched_device",
        "peers/test_device_strays.py::test_lost_versions_are_just_these",
        _REFEREES + "test_the_host_copes_with_a_device_that_strays",
    ),
    "RS-08": (
        _FLOW + "test_another_device_or_no_version_is_refused_before_anything_is_sent_to_it",
        "protocol/test_messages.py::test_a_boot_version_text_is_kept_as_received_and_judged",
    ),
    "RS-09": (
        _FLOW + "test_another_version_within_the_burst_means_two_devices",
        _STAGES + "test_two_bootloaders_that_announce_different_versions_are_refused",
    ),
    "UP-05": (
        _TRANSFER
        + "test_request_transfer_again_before_ack_1_gets_packet_1_again_and_no_update_command",
        _TRANSFER + "test_request_transfer_doubled_at_once_does_no_harm",
    ),
    "UP-07": (
        _FLOW + "test_request_transfer_may_come_up_to_ten_seconds_after_the_update_command",
        _FLOW + "test_the_update_command_is_never_repeated_into_silence",
    ),
    # -- transfer -----------------------------------------------------------------------------
    "TX-02": (
        _TRANSFER + "test_a_silent_device_gets_every_try_and_then_the_upgrade_ends",
        _TRANSFER + "test_a_late_answer_does_not_double_the_packets_that_follow",
        _REFEREES + "test_late_answers_do_not_double_the_packets_that_follow",
    ),
    "TX-09": (
        _TRANSFER + "test_a_packet_may_be_refused_as_often_as_there_are_tries_but_one",
        _TRANSFER + "test_the_last_try_refused_ends_the_upgrade_naming_the_packet",
    ),
    "TX-10": (
        _TRANSFER + "test_an_answer_for_an_older_packet_is_ignored",
        _TRANSFER + "test_an_answer_for_a_later_packet_is_reported_and_ignored",
        _TRANSFER + "test_a_doubled_ack_advances_once",
        _TRANSFER + "test_nak_after_ack_for_the_same_packet_is_stale",
        _TRANSFER + "test_ack_after_nak_for_the_same_packet_waits_for_the_copy_that_is_out",
    ),
    "TX-11": (
        _TRANSFER + "test_a_boot_version_within_60_ms_of_request_transfer_is_a_leftover",
        _TRANSFER + "test_a_later_boot_version_starts_the_transfer_over_as_a_new_attempt",
        _TRANSFER + "test_request_transfer_in_the_middle_starts_over_and_is_reported",
        _REFEREES + "test_a_restart_at_every_packet_number_is_overcome",
    ),
    # -- end ----------------------------------------------------------------------------------
    "EN-03": (
        _END + "test_end_of_transfer_is_asked_again_after_ten_seconds",
        _END + "test_a_lost_final_answer_is_replaced_by_the_version_answer",
        _END + "test_three_unanswered_ends_are_unconfirmed_where_no_version_can_be_asked",
        _END + "test_no_boot_version_is_answered_after_the_end_and_the_version_answer_decides",
        _TABLE + "test_after_end_of_transfer_only_a_device_beyond_its_burst_gets_an_update_command",
        _REFEREES + "test_a_lost_final_answer_never_leads_to_a_second_erase",
    ),
    "EN-05": (
        _TRANSFER + "test_complete_before_end_of_transfer_is_a_protocol_error",
        _END + "test_complete_before_the_end_has_left_is_a_protocol_error",
    ),
    "EN-06": (
        _END + "test_one_nak_gets_end_of_transfer_once_more",
        _END + "test_a_second_nak_whatever_its_number_means_refused",
    ),
    # -- timing -------------------------------------------------------------------------------
    "TM-01": (
        _FLOW + "test_the_boot_version_may_come_up_to_five_seconds_after_the_reset",
        _FLOW + "test_request_transfer_may_come_up_to_ten_seconds_after_the_update_command",
        _TRANSFER + "test_the_answer_may_come_up_to_500_ms_after_the_packet_has_left",
        "peers/test_host_strays.py::test_every_limit_of_the_host_is_kept_in_time",
    ),
    "TM-02": (
        _REASSEMBLER + "test_a_partial_message_waits_until_just_before_the_timeout",
        _REASSEMBLER + "test_a_partial_message_is_dropped_at_the_timeout_and_after",
        _REASSEMBLER + "test_every_frame_starts_the_wait_anew",
    ),
    "TM-03": (
        _FLOW + "test_a_device_that_answers_only_the_last_try_is_ended_by_the_overall_deadline",
        _STAGES + "test_a_device_that_is_always_just_in_time_is_upgraded_or_ends_with_the_deadline",
    ),
    "TM-04": (
        _ADAPTER + "test_a_jump_of_the_wall_clock_does_not_lengthen_a_receive",
        "api/test_flash.py::test_the_clock_of_an_adapter_is_the_monotonic_one",
    ),
    # -- bus ----------------------------------------------------------------------------------
    "BU-01": (
        _FAULTS + "test_one_disturbed_frame_anywhere_never_ends_in_a_wrong_image",
        _FAULTS + "test_two_swapped_frames_anywhere_never_end_in_a_wrong_image",
        _ODD + "test_one_late_frame_anywhere_never_ends_in_a_wrong_image",
    ),
    "BU-02": (
        _ODD + "test_a_device_that_goes_bus_off_at_any_frame_is_upgraded_or_the_end_is_explicit",
        _RESCUE + "test_an_adapter_that_restarts_after_a_bus_off_in_any_phase_is_overcome",
        _ADAPTER + "test_once_bus_off_is_reported_nothing_more_is_sent_into_the_void",
    ),
    "BU-03": (
        _ADAPTER + "test_a_full_transmit_queue_is_waited_for_whatever_the_back_end_calls_it",
        _ADAPTER + "test_frames_that_arrive_while_the_queue_is_full_are_kept_in_order",
        "bus/test_simulated.py::test_a_full_transmit_queue_makes_the_sender_wait_and_loses_nothing",
        _FOREIGN + "test_a_slow_adapter_queue_is_no_reason_to_repeat",
    ),
    "BU-04": (
        _FLOW + "test_frames_of_others_and_frames_that_are_no_payload_change_nothing",
        "bus/test_echoes.py::test_an_echo_is_one_however_late_it_is_read",
        _STAGES + "test_echoes_of_own_frames_are_no_second_tool",
    ),
    "BU-05": (
        _DRIVER + "test_a_failing_adapter_ends_the_loop_with_its_error",
        (
            "cli/test_flash.py::"
            "test_an_adapter_that_fails_in_the_middle_states_how_far_it_came_and_what_is_left"
        ),
        _ODD + "test_an_adapter_that_is_pulled_out_ends_it_within_a_second",
    ),
    "BU-06": (
        _ODD + "test_somebody_who_speaks_with_the_devices_id_is_overcome_or_the_end_is_explicit",
    ),
    # -- power, bad input, others -------------------------------------------------------------
    "PW-03": (
        (
            "end_to_end/test_host_killed.py::"
            "test_a_host_that_is_killed_at_any_packet_is_repaired_by_the_same_command"
        ),
        _FAULTS
        + "test_an_upgrade_that_was_cancelled_in_the_middle_is_finished_by_the_same_command",
    ),
    "SE-01": (
        _PROPERTIES + "test_endless_bytes_of_no_use_do_not_fill_the_memory",
        _PROPERTIES + "test_endless_random_bytes_do_not_fill_the_memory",
        _ANY + "test_memory_and_time_are_bounded_when_a_device_repeats_itself_for_ever",
        _DRIVER + "test_a_babbling_bus_does_not_stop_the_timers",
    ),
    "SE-02": (
        "protocol/test_text.py::test_any_bytes_are_shown_in_printable_ascii",
        "cli/test_monitor.py::test_device_text_reaches_no_terminal_unescaped",
        "cli/test_read_write.py::test_escape_sequences_from_the_device_are_shown_escaped",
        "cli/test_info.py::test_a_broken_device_is_shown_harmlessly",
        "cli/test_explain.py::test_hostile_texts_do_not_reach_the_terminal",
        "host/test_identity.py::test_what_a_device_reports_is_shown_escaped",
        "report/test_explain_page.py::test_hostile_text_is_shown_and_does_nothing",
    ),
    "SE-03": (
        _ANY + "test_the_host_ends_explicitly_whatever_the_device_answers",
        "trace/test_decoder.py::test_nothing_on_the_bus_raises_and_everything_is_harmless",
    ),
    "CO-01": (
        _FAULTS + "test_other_traffic_at_high_load_changes_nothing_but_the_time",
        _FOREIGN + "test_a_bus_that_is_full_for_a_while_in_the_transfer_is_waited_for",
        (
            "api/test_flash.py::"
            "test_a_babbling_bus_keeps_an_upgrade_neither_from_its_deadline_nor_from_being_cancelled"
        ),
    ),
    "CO-02": (
        _FAULTS + "test_two_devices_are_upgraded_on_one_bus_without_crosstalk",
        _FOREIGN
        + "test_two_other_pairs_are_upgraded_at_the_same_time_and_do_not_notice_each_other",
    ),
    "CO-03": (
        _STAGES
        + "test_a_second_tool_ends_the_session_in_every_stage_and_not_one_frame_more_is_sent",
        _STAGES + "test_a_query_of_a_second_tool_is_reported_once_and_the_upgrade_goes_on",
        _GUARD + "test_a_frame_that_was_not_sent_is_from_another_sender_and_is_reported_in_hex",
    ),
}
