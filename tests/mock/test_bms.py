"""The BMS's application: every query and write of both documents, answered byte by byte."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from flasher.errors import UsageError
from flasher.events import DeviceReported, DeviceWritten
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.protocol.spec import BMS, OBC, WMC, Target
from tests.loops import each
from tests.mock.talk import READ, REPORT, START_S, WRITE, Answer, Talk

DIALECTS = ["welling", "motinova"]


def battery(target: Target = BMS, **options: Any) -> Talk:
    """A device that rests, and whose flash takes no time."""
    plain: dict[str, Any] = {"battery_use": "resting", "erase_time_s": 0.0, "program_time_s": 0.0}
    return Talk(MockDevice(target, bitrate_bps=250_000, profile=DeviceProfile(**plain | options)))


# Typed from the tables of chapter 3; a battery at rest, with 85 % of 9,800 mAh.
FEEDBACK_IDS = {0x712: 0x721, 0x732: 0x723, 0x742: 0x724, 0x752: 0x725}
CELLS_MV = (4012, 4021, 4021, 4013, 4016, 4020, 4009, 4018, 4010, 4013)
RUNNING = struct.pack("<HhHHBBBBI", sum(CELLS_MV), -8, 8330, 9800, 22 + 40, 85, 0, 98, 0)
CELLS = struct.pack("<16H", *CELLS_MV, 0, 0, 0, 0, 0, 0)
DESIGN = bytes.fromhex("1027 24 323137303041 2e20 0000000000")
VERSION = b"BM36.           " + b"W2605001.       " + b"V1r2r0_20220512." + b"V1r0r0_20220512."
PHYSICAL_ID = b"W2605001\x01\x01\x01\x01"
CHECK_CODE = bytes(12)
PRODUCTION = b"WELLING." + b"WUXI.   " + b"20220512" + bytes(8)
NO_STRING = b".               "
HISTORY = bytes.fromhex("5523 a861 a00f 0c00 1e00 9001") + bytes(18) + bytes.fromhex("60ea0000 62")
HISTORY += bytes(5)

# Sender's id and command, then the answer's id, command and data.
QUERIES = {
    "WMC 712 3100": (0x712, 0x3100, 0x720, 0x160C, PHYSICAL_ID),
    "WMC 712 3200": (0x712, 0x3200, 0x720, 0x170C, CHECK_CODE),
    "WMC 712 3300": (0x712, 0x3300, 0x720, 0x1410, DESIGN),
    "OBC 732 5000": (0x732, 0x5000, 0x720, 0x1010, RUNNING),
    "OBC 732 5100": (0x732, 0x5100, 0x720, 0x1540, VERSION),
    "OBC 732 5200": (0x732, 0x5200, 0x720, 0x1410, DESIGN),
    "OBC 732 5300": (0x732, 0x5300, 0x720, 0x1120, CELLS),
    "CDL 752 3000": (0x752, 0x3000, 0x720, 0x160C, PHYSICAL_ID),
    "CDL 752 3100": (0x752, 0x3100, 0x720, 0x170C, CHECK_CODE),
    "CDL 752 3300": (0x752, 0x3300, 0x720, 0x1540, VERSION),
    "CDL 752 3400": (0x752, 0x3400, 0x720, 0x1010, RUNNING),
    "CDL 752 3500": (0x752, 0x3500, 0x720, 0x1120, CELLS),
    "CDL 752 3600": (0x752, 0x3600, 0x720, 0x1410, DESIGN),
    "CDL 752 3700": (0x752, 0x3700, 0x725, 0x5120, PRODUCTION),
    "CDL 752 3800": (0x752, 0x3800, 0x725, 0x5028, HISTORY),
    "CDL 752 3900": (0x752, 0x3900, 0x725, 0x5210, NO_STRING),
    "CDL 752 3B00": (0x752, 0x3B00, 0x725, 0x5310, NO_STRING),
    "CDL 752 3D00": (0x752, 0x3D00, 0x725, 0x5410, NO_STRING),
}
HMI_QUERIES = {
    "HMI 742 5000": (0x742, 0x5000, 0x720, 0x1540, VERSION),
    "HMI 742 5100": (0x742, 0x5100, 0x720, 0x1410, DESIGN),
    "HMI 742 5200": (0x742, 0x5200, 0x720, 0x1120, CELLS),
}
# Command and data of the write, then the query of 752 that reads it back, and where it lies.
WRITES = {
    "check code 320C": (0x320C, b"CHECK-CODE-9", 0x3100, slice(0, 12)),
    "user string 1 3A10": (0x3A10, b"one.            ", 0x3900, slice(0, 16)),
    "user string 2 3C10": (0x3C10, b"two.            ", 0x3B00, slice(0, 16)),
    "user string 3 3E10": (0x3E10, b"three.          ", 0x3D00, slice(0, 16)),
    "production 3F20": (0x3F20, b"ACME.   HERE.   20260102" + bytes(8), 0x3700, slice(0, 32)),
    "model 4010": (0x4010, b"BM48.           ", 0x3300, slice(0, 16)),
    "serial number 4110": (0x4110, b"W2605999.       ", 0x3300, slice(16, 32)),
}
FEEDBACK = Answer(START_S, 0x725, REPORT, 0x5503, b"ACK")


# -- queries --------------------------------------------------------------------------------------


@each("dialect", DIALECTS)
@each("query", QUERIES.values())
def test_every_query_gets_the_answer_of_the_document_on_its_id(
    query: tuple[int, int, int, int, bytes], dialect: str
) -> None:
    asked_on, asked, answered_on, answer, data = query
    talk = battery(dialect=dialect)
    assert talk.ask(asked_on, READ, asked) == [Answer(START_S, answered_on, REPORT, answer, data)]


@each("query", HMI_QUERIES.values())
def test_queries_of_the_hmi_are_answered_in_its_own_dialect_only(
    query: tuple[int, int, int, int, bytes],
) -> None:
    asked_on, asked, answered_on, answer, data = query
    expected = [Answer(START_S, answered_on, REPORT, answer, data)]
    assert battery(dialect="motinova").ask(asked_on, READ, asked) == expected
    assert battery(dialect="welling").ask(asked_on, READ, asked) == []


@each("dialect", DIALECTS)
def test_the_handshake_is_answered_to_the_wmc_alone(dialect: str) -> None:
    talk = battery(dialect=dialect)
    expected = [Answer(START_S, 0x721, REPORT, 0x3005, b"READY")]
    assert talk.ask(0x712, READ, 0x3009, b"HANDSHAKE") == expected
    assert talk.ask(0x712, READ, 0x3009, b"HANDSHAKY") == []


@each("mode", [WRITE, REPORT])
@each("query", QUERIES.values())
def test_a_query_in_the_wrong_mode_is_not_answered(
    query: tuple[int, int, int, int, bytes], mode: int
) -> None:
    """By 2.2.1(2) a write is confirmed to its sender, whatever it says."""
    feedback = FEEDBACK._replace(can_id=FEEDBACK_IDS[query[0]])
    assert battery().ask(query[0], mode, query[1]) == ([feedback] if mode == WRITE else [])


@each("can_id", [0x751, 0x753, 0x710, 0x720, 0x725, 0x713, 0x731])
@each("command", [0x3300, 0x3000, 0x5000])
def test_queries_to_others_are_never_answered(can_id: int, command: int) -> None:
    assert battery().ask(can_id, READ, command) == []


@each("target", [WMC, OBC])
def test_wmc_and_obc_answer_no_query_and_no_write(target: Target) -> None:
    talk = battery(target)
    for can_id in (target.request_id, 0x752, 0x712, 0x732):
        for command in (0x3300, 0x3400, 0x5000):
            assert talk.ask(can_id, READ, command) == []
        for command, data, _, _ in WRITES.values():
            assert talk.ask(can_id, WRITE, command, data) == []


@each("dialect", DIALECTS)
def test_an_older_battery_has_no_state_of_health_and_knows_fewer_queries(dialect: str) -> None:
    talk = battery(older_battery="yes", dialect=dialect)
    (heard,) = talk.ask(0x752, READ, 0x3400)
    assert heard.data == RUNNING[:11] + b"\x00" + RUNNING[12:]
    assert talk.ask(0x732, READ, 0x5300) == []
    assert talk.ask(0x742, READ, 0x5200) == []
    assert talk.data_of(0x3500) == CELLS
    assert talk.data_of(0x5100, 0x732) == VERSION


def test_queries_that_the_profile_names_are_not_answered_the_others_are() -> None:
    talk = battery(silent_queries="3800, 732:5000,4110")
    assert talk.ask(0x752, READ, 0x3800) == []
    assert talk.ask(0x732, READ, 0x5000) == []
    assert talk.ask(0x752, WRITE, 0x4110, b"W2605999.       ") == []
    assert talk.data_of(0x3300) == VERSION
    assert talk.data_of(0x3400) == RUNNING
    assert talk.data_of(0x5100, 0x732) == VERSION


@each("text", ["38G0", "x:3800", ",", "732:"])
def test_silent_queries_that_are_no_commands_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a command"):
        DeviceProfile(silent_queries=text)


# -- writes ---------------------------------------------------------------------------------------


@each("dialect", DIALECTS)
@each("write", WRITES.values())
def test_every_write_is_confirmed_and_reads_back(
    write: tuple[int, bytes, int, slice], dialect: str
) -> None:
    command, data, query, part = write
    talk = battery(dialect=dialect)
    before = talk.data_of(query)
    assert talk.ask(0x752, WRITE, command, data) == [FEEDBACK]
    after = talk.data_of(query)
    assert after[part] == data
    assert after[: part.start] == before[: part.start]
    assert after[part.stop :] == before[part.stop :]


def test_writes_do_not_touch_each_other() -> None:
    talk = battery()
    for command, data, _, _ in WRITES.values():
        talk.put(0x752, WRITE, command, data)
    for _, data, query, part in WRITES.values():
        assert talk.data_of(query)[part] == data


@each("write", WRITES.values())
def test_what_was_written_outlasts_power_cuts_and_an_upgrade(
    write: tuple[int, bytes, int, slice],
) -> None:
    command, data, query, part = write
    talk = battery(reset_delay_s=0.0, window_s=0.0)
    device = talk.engine
    assert isinstance(device, MockDevice)
    talk.put(0x752, WRITE, command, data)
    device.power_cut(talk.now)
    assert talk.ask(0x752, READ, query) == []
    device.power_on(talk.now)
    talk.run(1.0)
    assert talk.data_of(query)[part] == data
    flash(talk, b"V3r1r4_20260203".ljust(128, b"\xee"))
    assert talk.data_of(query)[part] == data
    assert talk.data_of(0x3300)[48:] == b"V3r1r4_20260203."


def flash(talk: Talk, packet: bytes) -> None:
    """An upgrade of one packet, byte by byte."""
    talk.put(0x752, WRITE, 0x4205, b"RESET")
    talk.run(0.05)
    talk.put(0x752, WRITE, 0xA10B, b"BMS_UPD" + len(packet).to_bytes(4, "little"))
    talk.put(0x752, WRITE, 0xA385, b"\x01\x01\x00\x01\x00" + packet)
    talk.put(0x752, WRITE, 0xA401, b"\x04")
    assert 0xC502 in [heard.command for heard in talk.take()]
    talk.run(1.0)


def test_the_bootloader_answers_no_query_and_keeps_nothing() -> None:
    talk = battery()
    talk.put(0x752, WRITE, 0x4205, b"RESET")
    talk.run(0.06)
    assert [heard.command for heard in talk.take()] == [0x5503, 0xC109]
    assert talk.ask(0x732, READ, 0x5000) == []
    assert talk.ask(0x712, READ, 0x3009, b"HANDSHAKE") == []
    assert talk.ask(0x752, WRITE, 0x4010, b"BM48.           ") == []
    talk.run(1.0)
    assert talk.data_of(0x3300)[:5] == b"BM36."


@each(
    "data", [b"\x00" * 16, b"\x1b[2J....\xff\xfe      ", b"no terminator 16", b"a.b.c           "]
)
def test_broken_texts_are_kept_as_they_are_and_reported_harmlessly(data: bytes) -> None:
    """R20."""
    talk = battery()
    assert talk.ask(0x752, WRITE, 0x4110, data) == [FEEDBACK]
    assert talk.data_of(0x3300)[16:32] == data
    (event,) = [event for event in talk.events if isinstance(event, DeviceWritten)]
    assert (event.name, event.before) == ("serial number", "W2605001")
    assert event.after.isascii()
    assert event.after.isprintable()


@each(
    "command, data",
    [(0x4108, b"W2605999"), (0x7701, b"?"), (0x4205, b"RESEt"), (0x4204, b"RESE"), (0xA401, b"?")],
)
def test_a_write_that_is_no_row_of_the_document_is_confirmed_and_changes_nothing(
    command: int, data: bytes
) -> None:
    """2.2.1(2)."""
    talk = battery()
    assert talk.ask(0x752, WRITE, command, data) == [FEEDBACK]
    talk.run(1.0)
    assert talk.take() == []
    assert talk.data_of(0x3300) == VERSION


@each("can_id", [0x712, 0x732, 0x742, 0x751, 0x753, 0x710])
def test_only_the_tool_may_write(can_id: int) -> None:
    """Others get general feedback on the battery's id to them, as 2.2.1(2) says."""
    talk = battery(dialect="motinova")
    at = FEEDBACK_IDS.get(can_id)
    for command, data, _, _ in WRITES.values():
        confirmed = [] if at is None else [FEEDBACK._replace(can_id=at)]
        assert talk.ask(can_id, WRITE, command, data) == confirmed
    assert talk.data_of(0x3300) == VERSION
    assert talk.data_of(0x3900) == NO_STRING


# -- memory ---------------------------------------------------------------------------------------


def memory(talk: Talk, start: int, end: int) -> list[Answer]:
    return talk.ask(0x752, READ, 0x4308, struct.pack("<II", start, end))


@each("start, size", [(0, 128), (0, 1), (5, 20), (300, 128), (400, 100)])
def test_memory_reads_give_the_application_of_the_flash(start: int, size: int) -> None:
    """R5."""
    talk = battery()
    assert isinstance(talk.engine, MockDevice)
    image = talk.engine.stored_image or b""
    first, last = 0x0800_8000 + start, 0x0800_8000 + start + size
    (heard,) = memory(talk, first, last)
    assert heard[1:4] == (0x725, REPORT, 0x5688)
    content = image[start : start + size].ljust(128, b"\xff")
    assert heard.data == struct.pack("<II", first, last) + content


def test_an_upgrade_is_read_back_through_memory_reads() -> None:
    talk = battery(reset_delay_s=0.0, window_s=0.0)
    packet = bytes(range(128))
    flash(talk, packet)
    (heard,) = memory(talk, 0x0800_8000, 0x0800_8080)
    assert heard.data[8:] == packet


def test_bootloader_and_ram_can_be_read_and_are_always_the_same() -> None:
    for start in (0x0800_0000, 0x0800_4000, 0x2000_0000, 0x2000_4F80):
        (first,) = memory(battery(), start, start + 128)
        (second,) = memory(battery(), start, start + 128)
        assert first == second
        assert len(set(first.data[8:])) > 64


def test_a_read_may_run_from_the_bootloader_into_the_application() -> None:
    talk = battery()
    (low,) = memory(talk, 0x0800_7FF0, 0x0800_8000)
    (high,) = memory(talk, 0x0800_8000, 0x0800_8010)
    (both,) = memory(talk, 0x0800_7FF0, 0x0800_8010)
    assert both.data[8:40] == low.data[8:24] + high.data[8:24]


@each(
    "start, end",
    [
        (0x0000_0000, 0x0000_0010),
        (0x07FF_FFF0, 0x0800_0010),
        (0x0880_8800, 0x0880_8801),
        (0x2000_4FF0, 0x2000_5010),
        (0xFFFF_FFF0, 0xFFFF_FFFF),
        (0x0800_8000, 0x0800_8081),
        (0x0800_8010, 0x0800_8000),
        (0x0800_8000, 0x0800_8000),
    ],
)
def test_reads_outside_or_of_impossible_size_are_silent_and_reported(start: int, end: int) -> None:
    talk = battery()
    assert memory(talk, start, end) == []
    reports = [event.what for event in talk.events if isinstance(event, DeviceReported)]
    assert reports == [f"memory 0x{start:08X}..0x{end:08X} cannot be read"]


# -- what changes by itself -----------------------------------------------------------------------


def test_a_ride_shows_in_running_information_and_cells() -> None:
    talk = battery(battery_use="riding")
    before = struct.unpack("<HhHHBBBBI", talk.data_of(0x3400))
    cells = struct.unpack("<16H", talk.data_of(0x3500))
    assert before[0] == sum(cells)
    talk.run(3600.0)
    after = struct.unpack("<HhHHBBBBI", talk.data_of(0x3400))
    assert after[1] < -1000
    assert after[2] == pytest.approx(before[2] - 2940, abs=20)
    assert (before[5], after[5]) == (78, 48)
    assert after[0] < before[0]


def test_running_time_counts_minutes() -> None:
    talk = battery()
    assert talk.data_of(0x3800)[30:34] == (60_000).to_bytes(4, "little")
    talk.run(125.0)
    assert talk.data_of(0x3800)[30:34] == (60_002).to_bytes(4, "little")


def test_an_application_at_rest_asks_for_no_tick() -> None:
    assert battery().engine.deadline() is None


def test_reset_still_restarts_into_the_bootloader_in_both_dialects() -> None:
    for dialect in DIALECTS:
        talk = battery(dialect=dialect)
        assert talk.ask(0x752, WRITE, 0x4205, b"RESET") == [FEEDBACK]
        assert isinstance(talk.engine, MockDevice)
        assert talk.engine.state is BootloaderState.RESTARTING
