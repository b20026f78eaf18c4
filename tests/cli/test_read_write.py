"""`flasher read` and `flasher write`: by name, shown before and after, read back."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from intelhex import IntelHex

from flasher.errors import ExitCode
from tests.api.battery import ANSWERS, Battery, opened
from tests.cli.conftest import Flasher

MOCK = ("--mock", "--mock-speed", "0")


@pytest.fixture
def battery(monkeypatch: pytest.MonkeyPatch) -> Battery:
    """What is on the bus in place of the device model."""
    battery = Battery()
    monkeypatch.setattr("flasher.api.connect_mock", lambda *_, **__: opened(battery))
    return battery


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """A terminal to ask on; write the answer into it."""
    typed = io.StringIO()
    monkeypatch.setattr(sys, "stdin", typed)
    monkeypatch.setattr("flasher.cli.terminal.can_ask", lambda: True)
    return typed


# -- read ------------------------------------------------------------------------------------------


def test_an_item_is_shown_with_units(flasher: Flasher, battery: Battery) -> None:
    run = flasher("read", "running-information", "-t", "bms", *MOCK)
    assert run.code == ExitCode.OK
    rows = [line.split() for line in run.out.splitlines()]
    assert ["voltage", "36000", "mV"] in rows
    assert ["mean", "current", "-1000", "mA"] in rows
    assert ["status", "charger", "connected"] in rows
    assert [command for command, _ in battery.received] == [0x3400]


def test_an_item_that_is_a_field_of_another_is_shown_alone(
    flasher: Flasher, battery: Battery
) -> None:
    run = flasher("read", "serial-number", *MOCK, "--json")
    assert run.document["fields"] == {"serial_number": "W2605001"}
    assert run.document["exit_code"] == run.code == ExitCode.OK
    assert battery.received == [(0x3300, b"")]


def test_what_is_not_answered_is_exit_5(flasher: Flasher, battery: Battery) -> None:
    battery.silent = frozenset(ANSWERS)
    run = flasher("read", "history", *MOCK, "--json")
    assert run.code == run.document["exit_code"] == ExitCode.NO_ANSWER
    assert "did not answer 'read history'" in run.err


def test_escape_sequences_from_the_device_are_shown_escaped(
    flasher: Flasher, battery: Battery
) -> None:
    battery.answers[0x3900] = (0x725, 0x5210, b"\x1b[2J\x07\xff\x00 no end..")
    run = flasher("read", "user-string-1", *MOCK)
    assert run.code == ExitCode.OK
    assert "\\x1b[2J\\x07\\xff\\x00 no end.." in run.out
    assert run.out.isascii()
    assert "\x1b" not in run.out


@pytest.mark.parametrize("command", ["read", "write"])
def test_the_items_are_listed_without_a_bus(flasher: Flasher, command: str) -> None:
    run = flasher(command, "--list")
    assert run.code == ExitCode.OK
    names = [line.split()[0] for line in run.out.splitlines()]
    assert {"serial-number", "model", "production-information", "user-string-3"} <= set(names)
    assert ("memory" in names) is (command == "read")
    listed = flasher(command, "--list", "--json").document["items"]
    assert listed["production-information"]


@pytest.mark.parametrize("command", ["read", "write"])
@pytest.mark.parametrize("target", ["wmc", "obc"])
def test_there_is_nothing_for_devices_without_queries(
    flasher: Flasher, command: str, target: str
) -> None:
    assert f"no {command.rstrip('e')}able item" in flasher(command, "--list", "-t", target).out
    assert flasher(command, "model", "-t", target, *MOCK).code == ExitCode.USAGE


# -- memory ----------------------------------------------------------------------------------------


def test_memory_goes_to_a_binary_file(flasher: Flasher, battery: Battery, tmp_path: Path) -> None:
    path = tmp_path / "memory.bin"
    run = flasher("read", "memory", "0x1000", "-o", path, "0x1190", *MOCK)
    assert run.code == ExitCode.OK
    assert path.read_bytes() == battery.memory[:0x190]
    assert len(battery.received) == 4
    assert "400 bytes from 0x00001000" in run.out


@pytest.mark.parametrize(
    ("name", "options"), [("memory.hex", ()), ("memory.txt", ("--format", "hex"))]
)
def test_memory_goes_to_an_intel_hex_file_with_its_addresses(
    flasher: Flasher, battery: Battery, tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    path = tmp_path / name
    run = flasher("read", "memory", "0x1010", "0x1020", "-o", path, *options, *MOCK)
    assert run.code == ExitCode.OK
    image = IntelHex(str(path))
    assert (image.minaddr(), image.maxaddr()) == (0x1010, 0x101F)
    assert image.tobinstr() == battery.memory[0x10:0x20]


def test_memory_is_dumped_without_a_file(flasher: Flasher, battery: Battery) -> None:
    run = flasher("read", "memory", "0x1041", "0x1045", *MOCK)
    assert run.out.split() == ["00001041", "41", "42", "43", "44", "ABCD"]
    assert battery.received == [(0x4308, bytes.fromhex("41100000 45100000"))]


def test_memory_that_ends_in_silence_leaves_no_file(
    flasher: Flasher, battery: Battery, tmp_path: Path
) -> None:
    run = flasher("read", "memory", "0x1300", "0x1500", "-o", tmp_path / "m.bin", *MOCK)
    assert run.code == ExitCode.NO_ANSWER
    assert "memory at 0x00001400" in run.err
    assert "No file was written" in run.err
    assert list(tmp_path.iterdir()) == []
    assert battery.received[0] == (0x4308, bytes.fromhex("00130000 80130000"))


@pytest.mark.parametrize(
    "words",
    [
        ("memory",),
        ("memory", "0x10"),
        ("memory", "x", "y"),
        ("memory", "0x20", "0x10"),
        ("memory", "0", "1", "-t", "wmc"),
        ("memory", "0", "1", "--format", "hex"),
        ("history", "1"),
        ("no-such-thing",),
        (),
    ],
)
def test_wrong_usage_of_read_is_exit_2(
    flasher: Flasher, battery: Battery, words: tuple[str, ...]
) -> None:
    assert flasher("read", *words, *MOCK).code == ExitCode.USAGE
    assert battery.received == []


# -- write -----------------------------------------------------------------------------------------


def test_a_write_shows_old_and_new_and_reads_back(flasher: Flasher, battery: Battery) -> None:
    run = flasher(
        "write", "serial-number", "-t", "bms", "W2605002", "--manufacturer", "--yes", *MOCK
    )
    assert run.code == ExitCode.OK
    assert "old 'W2605001'  new 'W2605002'" in run.out
    assert "confirmed by the device, read back right" in run.out
    assert battery.received[1] == (0x4110, b"W2605002.       ")


def test_production_information_is_written_with_its_three_values(
    flasher: Flasher, battery: Battery
) -> None:
    run = flasher(
        "write", "production-information", "ACME", "-t", "bms", "SUZHOU", "20260517",
        "--manufacturer", "-y", "--json", *MOCK,
    )  # fmt: skip
    assert run.code == ExitCode.OK
    assert run.document["confirmed"] is True
    assert run.document["fields"]["date"] == {
        "old": "2022-05-12",
        "new": "2026-05-17",
        "read_back": "2026-05-17",
    }
    assert battery.received[1] == (0x3F20, b"ACME.   SUZHOU. 20260517" + bytes(8))


def test_without_a_terminal_a_write_needs_yes(flasher: Flasher, battery: Battery) -> None:
    run = flasher("write", "user-string-1", "RACK 7", *MOCK)
    assert run.code == ExitCode.USAGE
    assert "--yes" in run.err
    assert battery.received == []


@pytest.mark.usefixtures("battery")
def test_manufacturer_items_need_the_manufacturer(flasher: Flasher) -> None:
    run = flasher("write", "model", "BM48", "--yes", *MOCK)
    assert run.code == ExitCode.USAGE
    assert "--manufacturer" in run.err


def test_on_a_terminal_it_asks_and_writes_on_yes(
    flasher: Flasher, battery: Battery, terminal: io.StringIO
) -> None:
    terminal.write("y\n")
    terminal.seek(0)
    run = flasher("write", "user-string-1", "RACK 7", *MOCK)
    assert run.code == ExitCode.OK
    assert "Write user-string-1 to the BMS? [y/N]" in run.err
    assert (0x3A10, b"RACK 7.         ") in battery.received


@pytest.mark.usefixtures("terminal")
def test_ctrl_c_at_the_question_states_that_nothing_was_written(
    flasher: Flasher, battery: Battery, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "stdin", SimpleNamespace(readline=press))
    run = flasher("write", "user-string-1", "RACK 7", *MOCK, "--json")
    assert run.code == run.document["exit_code"] == ExitCode.INTERRUPTED
    assert "nothing was written to the BMS" in run.document["error"]["what"]
    assert "not known" not in run.err
    assert [command for command, _ in battery.received] == [0x3900]


@pytest.mark.parametrize("answer", ["n\n", "\n", "", "yess\n"])
def test_on_a_terminal_anything_but_yes_writes_nothing(
    flasher: Flasher, battery: Battery, terminal: io.StringIO, answer: str
) -> None:
    terminal.write(answer)
    terminal.seek(0)
    run = flasher("write", "user-string-1", "RACK 7", *MOCK)
    assert run.code == ExitCode.INTERRUPTED
    assert "nothing was written" in run.err
    assert [command for command, _ in battery.received] == [0x3900]


def test_a_write_that_does_not_hold_is_exit_10(flasher: Flasher, battery: Battery) -> None:
    battery.loses_writes = True
    run = flasher("write", "user-string-1", "RACK 7", "--yes", "--json", *MOCK)
    assert run.code == run.document["exit_code"] == ExitCode.VERIFICATION
    assert run.document["fields"]["text"] == {"old": "", "new": "RACK 7", "read_back": ""}


def test_a_write_that_is_not_confirmed_is_exit_10(flasher: Flasher, battery: Battery) -> None:
    battery.silent = frozenset({0x3A10})
    run = flasher("write", "user-string-1", "RACK 7", "--yes", *MOCK)
    assert run.code == ExitCode.VERIFICATION


def test_a_silent_device_is_exit_5_and_nothing_is_written(
    flasher: Flasher, battery: Battery
) -> None:
    battery.silent = frozenset(ANSWERS)
    run = flasher("write", "user-string-1", "RACK 7", "--yes", *MOCK)
    assert run.code == ExitCode.NO_ANSWER
    assert "Nothing was written" in run.err
    assert {command for command, _ in battery.received} == {0x3900}


def test_an_unknown_option_is_still_refused(flasher: Flasher, battery: Battery) -> None:
    run = flasher("write", "model", "-t", "bms", "--no-such-option", "X", *MOCK)
    assert run.code == ExitCode.USAGE
    assert battery.received == []


def test_a_file_that_cannot_be_written_is_reported_before_the_memory_is_read(
    flasher: Flasher, battery: Battery, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("read", "memory", "0x8008000", "0x8008080", "-t", "bms", *MOCK, "-o")
    assert flasher(*words, tmp_path / "no" / "x.bin").code == ExitCode.USAGE
    monkeypatch.setattr("os.access", lambda path, _mode: Path(path) != tmp_path)
    run = flasher(*words, tmp_path / "x.bin")
    assert run.code == ExitCode.USAGE
    assert "its folder may not be written into" in run.err
    assert battery.received == []
