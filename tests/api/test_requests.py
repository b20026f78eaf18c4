"""Reading, writing, memory, info and scan on an open connection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from flasher.errors import (
    BusError,
    ErrorCode,
    InterruptedByUserError,
    NoAnswerError,
    UsageError,
    VerificationError,
)
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.query import check_range
from flasher.host.write import plan_write
from flasher.protocol import contents
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, MOTINOVA, OBC, WELLING, WMC, Dialect, Node, Target
from tests.api.battery import ANSWERS, Battery, wire_to
from tests.loops import each

BOTH = pytest.mark.parametrize("dialect", [WELLING, MOTINOVA], ids=lambda d: d.name)
SILENT = frozenset(ANSWERS)


@BOTH
def test_an_item_is_read_by_its_name(dialect: Dialect) -> None:
    answer = wire_to(Battery()).device(dialect=dialect).read("running-information")
    assert isinstance(answer, contents.RunningInformation)
    assert (answer.voltage_mv, answer.mean_current_ma) == (36_000, -1000)
    assert (answer.cell_temperature_c, answer.status) == (
        25,
        contents.BatteryStatus.CHARGER_CONNECTED,
    )


def test_a_sleeping_device_that_misses_the_first_messages_is_read_all_the_same() -> None:
    battery = Battery(deaf_messages=3)
    answer = wire_to(battery).device().read("version-information")
    assert isinstance(answer, contents.VersionInformation)
    assert str(answer.model) == "BM36"
    assert battery.received == [(0x3300, b"")]


def test_a_silent_device_is_no_answer_with_what_was_asked() -> None:
    wire = wire_to(Battery(silent=SILENT))
    with pytest.raises(NoAnswerError) as caught:
        wire.device().read("history")
    assert "752 3800, sent 5 times" in caught.value.where
    assert 1.0 + LISTEN_FIRST_S <= wire.clock.now() < 1.2


def test_a_pause_of_this_computer_in_the_first_message_is_no_silence_of_the_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    battery = Battery()
    connection = wire_to(battery)
    send, pauses_s = connection.link.send, [1.2]

    def pause(frame: Frame) -> None:
        send(frame)
        if pauses_s:
            connection.clock.wait_until(connection.clock.now() + pauses_s.pop())

    monkeypatch.setattr(connection.link, "send", pause)
    assert connection.device().read("production-information")
    assert battery.received == [(0x3700, b"")]


def test_an_answer_in_another_form_is_named_as_the_cause() -> None:
    battery = Battery()
    battery.answers[0x3300] = (0x720, 0x1530, bytes(0x30))
    with pytest.raises(NoAnswerError) as caught:
        wire_to(battery).device().read("version-information")
    assert "1530 with 48 bytes, not 1540" in caught.value.cause


def test_an_unknown_name_is_refused_with_the_closest_one() -> None:
    with pytest.raises(UsageError, match="serial-nmber") as caught:
        wire_to().device().read("serial-nmber")
    assert "Did you mean serial-number?" in caught.value.remedy


@each("target", [WMC, OBC])
def test_devices_without_queries_are_not_asked(target: Target) -> None:
    with pytest.raises(UsageError, match="nothing to read"):
        wire_to().device(target).read("version-information")


def test_cancelled_reading_is_an_interruption() -> None:
    with pytest.raises(InterruptedByUserError):
        wire_to(Battery(silent=SILENT)).device().read("history", cancelled=lambda: True)


# -- writing ---------------------------------------------------------------------------------------

SERIAL = b"W9999999.       "


@BOTH
def test_a_write_is_confirmed_and_read_back(dialect: Dialect) -> None:
    battery = Battery()
    written = (
        wire_to(battery)
        .device(dialect=dialect)
        .write("serial-number", "W9999999", manufacturer=True)
    )
    assert battery.received == [(0x3300, b""), (0x4110, SERIAL), (0x3300, b"")]
    (change,) = written.changes
    assert (change.old, change.new, change.read_back) == ("W2605001", "W9999999", "W9999999")


def test_production_data_go_out_as_the_document_has_them() -> None:
    battery = Battery()
    values = ("ACME", "SUZHOU", "20260517")
    wire_to(battery).device().write("production-information", *values, manufacturer=True)
    assert battery.received[1] == (0x3F20, b"ACME.   SUZHOU. 20260517" + bytes(8))


def test_a_finished_content_may_be_given() -> None:
    battery = Battery()
    wire_to(battery).device().write("check-code", contents.CheckCode(b"\x5a" * 12))
    assert battery.received[1] == (0x320C, b"\x5a" * 12)


def test_what_the_document_reserves_for_the_manufacturer_needs_his_word() -> None:
    battery = Battery()
    with pytest.raises(UsageError, match="manufacturer"):
        wire_to(battery).device().write("model", "BM48")
    assert battery.received == []


def test_nothing_is_written_to_a_device_that_does_not_answer() -> None:
    battery = Battery(silent=SILENT)
    with pytest.raises(NoAnswerError) as caught:
        wire_to(battery).device().write("user-string-1", "RACK 7")
    assert "Nothing was written" in caught.value.remedy
    assert 0x3A10 not in [command for command, _ in battery.received]


def test_an_unconfirmed_write_fails_even_if_it_reads_back() -> None:
    battery = Battery()
    battery.silent = frozenset({0x3A10})
    plan = plan_write("user-string-1", [""])
    old = wire_to(battery).device().read_before_write(plan)
    written = wire_to(battery).device().write_planned(plan, old)
    assert not written.is_confirmed
    error = written.error()
    assert isinstance(error, VerificationError)
    assert "did not confirm it; it does read back as written" in error.what


def test_a_write_that_reads_back_differently_fails_and_names_both_values() -> None:
    with pytest.raises(VerificationError) as caught:
        wire_to(Battery(loses_writes=True)).device().write("user-string-2", "RACK 7")
    assert caught.value.what.endswith("reads back text '' instead of 'RACK 7'.")


def test_a_write_is_seen_through_once_it_has_begun() -> None:
    battery = Battery()
    plan = plan_write("user-string-1", ["RACK 7"])
    written = wire_to(battery).device().write_planned(plan, None, cancelled=lambda: True)
    assert written.error() is None
    assert written.is_confirmed


@each(
    "name, values, says",
    [
        ("production-information", ("ACME", "SUZHOU", "20260230"), "not in the calendar"),
        ("production-information", ("ACME", "SUZHOU", "2026W101"), "not a date"),
        ("production-information", ("ACME", "SUZHOU"), "takes 3 values; 2 were given"),
        ("production-information", ("LONGNAME", "X", "20260517"), "longer than 7"),
        ("serial-number", ("W26.5001",), "terminator of a field"),
        ("serial-number", ("W" * 16,), "longer than 15"),
        ("serial-number", ("\x1b[2J",), "not printable ASCII"),
        ("serial-number", (), "takes 1 value; no value was given"),
        ("check-code", ("0011",), "2 bytes, not 12"),
        ("check-code", ("xyz",), "12 bytes in hexadecimal"),
        ("check-code", (12,), "12 is not 12 bytes in hexadecimal"),
        ("check-code", (contents.CheckCode(b"\x5a"),), "1 bytes, not 12"),
        ("serial-number", (2605001,), "2605001 is not a text"),
        ("user-string-1", (None,), "None is not a text"),
        ("production-information", ("A", "B", 20260517), "20260517 is not a text"),
        ("reset", (), "nothing called 'reset'"),
    ],
)
def test_values_that_do_not_fit_are_refused_before_anything_is_sent(
    name: str, values: tuple[object, ...], says: str
) -> None:
    battery = Battery()
    with pytest.raises(UsageError, match=says):
        wire_to(battery).device().write(name, *values, manufacturer=True)
    assert battery.received == []


# -- memory ----------------------------------------------------------------------------------------


def test_memory_is_read_in_pieces_of_128_bytes() -> None:
    battery = Battery()
    data = wire_to(battery).device().read_memory(0x1010, 0x1010 + 300)
    assert data == battery.memory[0x10 : 0x10 + 300]
    assert [asked.hex(" ") for _, asked in battery.received] == [
        "10 10 00 00 90 10 00 00",
        "90 10 00 00 10 11 00 00",
        "10 11 00 00 3c 11 00 00",
    ]


def test_memory_that_is_not_answered_names_the_address() -> None:
    with pytest.raises(NoAnswerError) as caught:
        wire_to(Battery()).device().read_memory(0x1380, 0x1480)
    assert caught.value.where == "memory at 0x00001400"


def test_repeated_answers_do_not_shift_the_pieces() -> None:
    battery = Battery(copies=2, deaf_messages=1)
    assert wire_to(battery).device().read_memory(0x1000, 0x1400) == battery.memory


def test_all_but_the_last_byte_of_the_memory_can_be_named() -> None:
    check_range(0, 0xFFFF_FFFF)


@each("start, end", [(8, 8), (9, 8), (-1, 8), (0, 0x1_0000_0000)])
def test_an_impossible_range_is_refused(start: int, end: int) -> None:
    with pytest.raises(UsageError, match="not a valid memory range"):
        wire_to().device().read_memory(start, end)


# -- info and scan ---------------------------------------------------------------------------------

FAULTS = (0x720, 0x1204, bytes.fromhex("0400 0100"))


@BOTH
def test_info_asks_everything_that_the_tool_may_ask(dialect: Dialect) -> None:
    found = wire_to(Battery()).device(dialect=dialect).identify()
    assert found.is_there
    assert [reading.item.command for reading in found.readings] == list(ANSWERS)
    assert all(reading.answer is not None for reading in found.readings)
    assert found.survey.faults is None


def test_info_shows_faults() -> None:
    found = wire_to(Battery(repeats=(FAULTS,))).device().identify()
    assert found.survey.faults is not None
    assert found.survey.faults.faults == (
        contents.BatteryFault.SHORT_CIRCUIT_PROTECTION
        | contents.BatteryFault.CHARGE_OVER_VOLTAGE_WARNING
    )


def test_info_of_a_device_that_answers_half_is_bounded_and_states_what_is_missing() -> None:
    silent = frozenset(list(ANSWERS)[::2])
    wire = wire_to(Battery(silent=silent, delay_s=0.3))
    found = wire.device().identify()
    missing = {reading.item.command for reading in found.readings if reading.answer is None}
    assert missing == silent
    assert wire.clock.now() < 0.5 + 11 * 1.1


def test_info_does_not_ask_into_the_dialogue_of_another_tool() -> None:
    battery, tool = Battery(), Battery(silent=SILENT, repeats=((0x751, 0xA401, b"\x04"),))
    with pytest.raises(BusError) as refused:
        wire_to(battery, tool).device().identify()
    assert refused.value.code is ErrorCode.SECOND_TOOL
    assert battery.received == []


@each(
    "ask",
    [
        lambda wire: wire.device().read("history"),
        lambda wire: wire.device().read_memory(0x0800_0000, 0x0800_0080),
        lambda wire: wire.device().write("user-string-1", "rack 7"),
        lambda wire: wire.device().write_planned(
            plan_write("user-string-1", ["rack 7"], BMS), None
        ),
    ],
)
def test_no_command_asks_or_writes_before_it_has_listened_for_another_tool(
    ask: Callable[[Any], object],
) -> None:
    battery, tool = Battery(), Battery(silent=SILENT, repeats=((0x751, 0xA401, b"\x04"),))
    wire = wire_to(battery, tool)
    with pytest.raises(BusError) as refused:
        ask(wire)
    assert refused.value.code is ErrorCode.SECOND_TOOL
    assert battery.received == []
    assert wire.clock.now() >= LISTEN_FIRST_S


def test_scan_shows_another_tool_and_asks_nothing_then() -> None:
    battery, tool = Battery(), Battery(silent=SILENT, repeats=((0x751, 0xA401, b"\x04"),))
    survey = wire_to(battery, tool).scan()
    assert survey.other_tool_heard
    assert set(survey.heard) == {Node.CDL}
    assert battery.received == []


def test_info_gives_an_absent_device_up_soon() -> None:
    wire = wire_to()
    found = wire.device().identify()
    assert not found.is_there
    assert [reading.was_asked for reading in found.readings] == [True] * 3 + [False] * 8
    assert wire.clock.now() < 4.0


def test_info_of_a_device_without_queries_listens_only() -> None:
    chatty = Battery(repeats=((0x710, 0x1305, b"READY"),))
    found = wire_to(chatty).device(WMC).identify()
    assert found.is_there
    assert found.readings == ()
    assert chatty.received == []
    assert found.survey.heard[Node.WMC].messages["710 1305 ready for shutdown"] >= 2


def test_scan_finds_who_talks_and_who_answers() -> None:
    wire = wire_to(Battery(), Battery(silent=SILENT, repeats=((0x730, 0x1405, b"READY"),)))
    survey = wire.scan()
    assert set(survey.heard) == {Node.BMS, Node.OBC}
    assert survey.guess_dialect()[0] is None


@each(
    "report, dialect",
    [
        ((0x740, 0x1305, b"READY"), MOTINOVA),
        ((0x710, 0x1808, b"SHUTDOWN"), WELLING),
        ((0x725, 0xC109, b"BMSV1.2.3"), WELLING),
    ],
)
def test_traffic_of_one_dialect_only_decides_it(
    report: tuple[int, int, bytes], dialect: Dialect
) -> None:
    survey = wire_to(Battery(silent=SILENT, repeats=(report,))).scan()
    assert survey.guess_dialect()[0] is dialect


def test_a_bootloader_that_announces_itself_is_named() -> None:
    survey = wire_to(Battery(repeats=((0x725, 0xC109, b"BMSV1.2.3"),))).scan()
    assert survey.heard[Node.BMS].boot_version == "BMS V1.2.3"


def test_the_default_target_is_the_bms() -> None:
    assert wire_to(Battery()).device().identify().target is BMS
