"""`flasher scan`: who is on the bus, and what that tells about the dialect."""

from __future__ import annotations

import pytest

from flasher.errors import ExitCode
from tests.api.battery import ANSWERS, Battery, opened
from tests.cli.conftest import Flasher

MOCK = ("--mock", "--mock-speed", "0")
SILENT = frozenset(ANSWERS)


def on_the_bus(monkeypatch: pytest.MonkeyPatch, *batteries: Battery) -> None:
    """Put these in place of the device model."""
    monkeypatch.setattr("flasher.api.connect_mock", lambda *_, **__: opened(*batteries))


@pytest.mark.parametrize(
    ("dialect", "bitrate"), [("welling", "250 kbit/s"), ("motinova", "125 kbit/s")]
)
def test_a_bit_rate_is_called_an_assumption(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, dialect: str, bitrate: str
) -> None:
    on_the_bus(monkeypatch, Battery())
    run = flasher("scan", "--dialect", dialect, *MOCK)
    assert run.code == ExitCode.OK
    lines = run.out.splitlines()
    assert lines[0].startswith(f"bit rate: {bitrate} (the dialect's)")
    assert lines[1].startswith(f"dialect:  {dialect} (by the bit rate alone")
    assert "assumption" in lines[1]
    assert "BMS" in lines


def test_a_display_unit_reports_the_other_dialect_and_how_to_ask_for_it(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_the_bus(monkeypatch, Battery(silent=SILENT, repeats=((0x740, 0x1305, b"READY"),)))
    run = flasher("scan", *MOCK)
    assert run.code == ExitCode.OK
    assert "dialect:  motinova (a display unit (HMI) sends" in run.out
    assert "use --dialect motinova" in run.out


def test_json_lists_the_nodes_with_their_messages(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    talker = Battery(silent=SILENT, repeats=((0x710, 0x1808, b"SHUTDOWN"),))
    on_the_bus(monkeypatch, Battery(), talker)
    run = flasher("scan", "--json", *MOCK)
    document = run.document
    assert document["exit_code"] == run.code == ExitCode.OK
    assert set(document["nodes"]) == {"bms", "wmc"}
    assert document["nodes"]["bms"]["messages"] == {
        "720 1010 running information": 1,
        "720 1540 version information": 1,
    }
    assert document["dialect"] == "welling"
    assert document["bitrate_is_assumed"] is True


def test_a_message_that_no_document_has_is_listed_by_its_number(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_the_bus(monkeypatch, Battery(silent=SILENT, repeats=((0x730, 0x6603, b"abc"),)))
    assert "730 6603 (not in the documents)" in flasher("scan", *MOCK).out


def test_a_silent_bus_is_exit_5_and_bounded(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_the_bus(monkeypatch)
    run = flasher("scan", "--json", *MOCK)
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert run.document["nodes"] == {}
    assert "250 kbit/s" in run.err


def test_frames_of_other_protocols_are_counted_not_taken_for_devices(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_the_bus(monkeypatch, Battery(silent=SILENT, repeats=((0x123, 0x6603, b"abc"),)))
    run = flasher("scan", *MOCK)
    assert run.code == ExitCode.NO_ANSWER
    assert "under ids of other protocols" in run.err


def test_a_babbling_node_does_not_fill_the_screen(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = tuple((0x730, serial << 8 | 0x01, b"x") for serial in range(0x60, 0x90))
    bootloader = (0x715, 0xC109, b"WMCV1.2.3")
    on_the_bus(monkeypatch, Battery(silent=SILENT, repeats=(*reports, bootloader)))
    run = flasher("scan", *MOCK)
    assert run.code == ExitCode.OK
    assert run.out.count("(not in the documents)") == 40
    assert "and 8 kinds of message more" in run.out
    assert "WMC V1.2.3" in run.out
    assert "dialect:  welling (a bootloader announces itself" in run.out


def test_bytes_that_make_no_message_are_counted(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    talker = Battery(silent=SILENT, repeats=((0x710, 0x1305, b"READY"),), damages=True)
    on_the_bus(monkeypatch, talker)
    run = flasher("scan", *MOCK)
    assert run.code == ExitCode.OK
    assert "bytes outside any message" in run.out
