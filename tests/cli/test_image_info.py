"""`flasher image-info`: what is in a file, in words and as JSON."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from flasher.cli.values import number
from flasher.errors import ExitCode
from tests.cli.conftest import SAMPLES, Flasher
from tests.loops import each


def test_the_sample_is_described_with_its_plan(flasher: Flasher) -> None:
    run = flasher("image-info", SAMPLES / "wmc.s19", "-t", "wmc")
    assert run.code == ExitCode.OK
    assert "Motorola S-record" in run.out
    assert "filled with FF" in run.out
    assert "plausible for a Cortex-M" in run.out
    assert "WMC (CAN ids 0x751, 0x715) at 250 kbit/s" in run.out
    assert "on the wire" in run.out


def test_an_empty_record_file_is_called_empty(flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "empty.hex").touch()
    run = flasher("image-info", tmp_path / "empty.hex")
    assert run.code == ExitCode.IMAGE
    assert "empty.hex is empty: it contains no bytes to send" in run.err
    assert "line 0" not in run.err


def test_json_names_segments_vectors_and_hash(flasher: Flasher) -> None:
    document = flasher("image-info", SAMPLES / "wmc.hex", "--json").document
    assert document["ok"] is True
    assert len(document["image"]["segments"]) == 2
    assert len(document["image"]["sha256"]) == 64
    assert document["image"]["vector_table"]["plausible"] is True
    assert document["plan"]["packets"] == 92


@pytest.fixture
def pipe(monkeypatch: pytest.MonkeyPatch) -> Callable[[bytes], None]:
    """Puts bytes on standard input."""

    def put(data: bytes) -> None:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))

    return put


@pytest.mark.slow
@each("name", ["bms.hex", "wmc.s19", "obc.bin"])
def test_an_image_is_read_from_standard_input_like_the_file(
    flasher: Flasher, pipe: Callable[[bytes], None], name: str
) -> None:
    of_file = flasher("image-info", SAMPLES / name, "--json").document
    pipe((SAMPLES / name).read_bytes())
    piped = flasher("image-info", "-", "--json").document
    assert piped["image"].pop("source") == "standard input"
    del of_file["image"]["source"]
    assert piped["image"] == of_file["image"]
    assert piped["manifest"]["found"] is False


def test_standard_input_that_is_empty_or_a_terminal_is_refused(
    flasher: Flasher, pipe: Callable[[bytes], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    pipe(b"")
    run = flasher("image-info", "-")
    assert run.code == ExitCode.IMAGE
    assert "standard input is empty" in run.err
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    run = flasher("image-info", "-")
    assert run.code == ExitCode.USAGE
    assert "is this terminal" in run.err


def test_more_bytes_on_standard_input_than_any_file_has_are_refused(
    flasher: Flasher, pipe: Callable[[bytes], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.options.FILE_MAX_SIZE", 10)
    pipe(bytes(11))
    run = flasher("image-info", "-")
    assert run.code == ExitCode.IMAGE
    assert "more than 10 bytes" in run.err


def test_the_manifest_of_standard_input_needs_a_name(
    flasher: Flasher, pipe: Callable[[bytes], None], tmp_path: Path, short_bms: Path
) -> None:
    data = short_bms.read_bytes()
    pipe(data)
    run = flasher("manifest", "create", "-", "-t", "bms")
    assert run.code == ExitCode.USAGE
    assert "needs -o FILE" in run.err
    pipe(data)
    path = tmp_path / "bms.toml"
    assert flasher("manifest", "create", "-", "-t", "bms", "-o", path).code == ExitCode.OK
    pipe(data)
    assert flasher("manifest", "check", "-", "--manifest", path).code == ExitCode.OK
    pipe(data)
    assert flasher("manifest", "check", "-").code == ExitCode.IMAGE


def test_a_binary_states_that_its_address_is_unknown(flasher: Flasher) -> None:
    run = flasher("image-info", SAMPLES / "obc.bin")
    assert "address: unknown" in run.out
    with_base = flasher("image-info", SAMPLES / "obc.bin", "--base", "0x8002000")
    assert "0x08002000..0x08002F9F" in with_base.out


def test_what_is_no_program_is_shown_and_refused_as_flash_refuses_it(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "data.bin"
    path.write_bytes(bytes(range(1, 200)))
    run = flasher("image-info", path)
    assert run.code == ExitCode.IMAGE
    assert "not plausible for a Cortex-M" in run.out
    assert "[E306]" in run.err
    document = flasher("image-info", path, "--json").document
    assert document["image"]["vector_table"]["plausible"] is False
    run = flasher("image-info", path, "--allow-implausible")
    assert run.code == ExitCode.OK
    assert "check: waived: the image begins with no" in run.out
    path.write_bytes(b"\1\2\3")
    assert "too short for a vector table" in flasher("image-info", path).out


def test_gaps_count_in_the_planned_time(flasher: Flasher) -> None:
    """613 packets and 3 other messages: 17 gaps in a packet, 1 + 2 + 1 in the others (2.2.3)."""
    gaps = ("--frame-gap", "0.01", "--packet-gap", "0.1")
    plan = flasher("image-info", SAMPLES / "bms.bin", *gaps, "--json").document["plan"]
    assert plan["gaps_s"] == pytest.approx(0.01 * (613 * 17 + 1 + 2 + 1) + 0.1 * 614)
    reported = flasher("image-info", SAMPLES / "bms.bin", *gaps).out
    assert "on the wire, 2 min 45 s of gaps" in reported


def test_an_outside_vector_is_refused_until_waived(flasher: Flasher) -> None:
    bad = SAMPLES / "bad" / "outside_vector.hex"
    assert flasher("image-info", bad).code == ExitCode.IMAGE
    assert flasher("image-info", bad, "--allow-outside-vector").code == ExitCode.OK


@each("text, value", [("4K", 4096), ("0x10", 16), ("1M", 1048576), ("7", 7)])
def test_numbers_take_hex_and_suffixes(text: str, value: int) -> None:
    assert number(text) == value


def test_the_gap_limit_is_the_users(flasher: Flasher) -> None:
    wmc = SAMPLES / "wmc.hex"
    assert flasher("image-info", wmc, "--fill-gaps-up-to", "1K").code == ExitCode.IMAGE
    assert flasher("image-info", wmc, "--fill-gaps-up-to", "4K").code == ExitCode.OK


def test_hostile_names_are_shown_harmlessly(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "a\x1b[2Jb.bin"
    path.write_bytes(bytes(64))
    run = flasher("image-info", path)
    assert "\x1b" not in run.out + run.err
    missing = flasher("image-info", tmp_path / "\x1b]0;x.bin")
    assert "\x1b" not in missing.err


def test_the_hash_of_the_file_and_that_of_the_bytes_to_send_are_both_named(
    flasher: Flasher, pipe: Callable[[bytes], None]
) -> None:
    path = SAMPLES / "wmc.hex"
    whole = hashlib.sha256(path.read_bytes()).hexdigest()
    run = flasher("image-info", path)
    sent = flasher("image-info", path, "--json").document["image"]["sha256"]
    assert f"{sent} of the bytes to send" in run.out
    assert f"{whole} of the file itself" in run.out
    pipe(path.read_bytes())
    assert flasher("image-info", "-", "--json").document["file_sha256"] == whole


@each("more, node", [((), "WMC"), (("-t", "obc", "--allow-implausible"), "OBC")])
def test_without_a_target_the_plan_is_for_the_one_that_the_image_names(
    flasher: Flasher, more: tuple[str, ...], node: str
) -> None:
    run = flasher("image-info", SAMPLES / "wmc.hex", *more)
    assert f"  to:      {node} " in run.out
    assert ("the image names it" in run.out) is (not more)


@pytest.mark.slow
def test_a_release_is_shown_by_another_command(flasher: Flasher, tmp_path: Path) -> None:
    release = tmp_path / "bike.wfw"
    words = ("--image", f"bms={SAMPLES / 'bms.hex'}", "--product", "48V", "--counter", "7")
    assert flasher("release", "build", release, *words).code == ExitCode.OK
    run = flasher("image-info", release)
    assert run.code == ExitCode.USAGE
    assert f"release show {release}" in run.err
    assert not run.out
    release.write_bytes(release.read_bytes()[:-10])
    assert "[E311]" in flasher("image-info", release).err
    other = release.rename(tmp_path / "other.zip")
    assert "a zip archive" in flasher("image-info", other).err


def test_an_image_that_names_another_target_is_refused_as_flash_refuses_it(
    flasher: Flasher,
) -> None:
    run = flasher("image-info", SAMPLES / "wmc.hex", "-t", "bms")
    assert run.code == ExitCode.WRONG_DEVICE == flasher(
        "flash", SAMPLES / "wmc.hex", "-t", "bms", "--mock"
    ).code  # fmt: skip
    assert "the image names the WMC inside, not the BMS" in run.err
    assert "names:   WMC" in run.out
    assert not re.search(r"device: |device is connected|\(flasher info\)", run.err)
    assert "--allow" not in run.err, "it has no such option"


def test_an_image_that_is_not_plausible_is_refused_with_the_option_that_shows_it(
    flasher: Flasher, tmp_path: Path
) -> None:
    file = tmp_path / "tiny.bin"
    file.write_bytes(bytes(range(200, 240)))
    run = flasher("image-info", file, "--base", "0x8008000")
    assert run.code == ExitCode.IMAGE
    assert "device: " not in run.err
    assert "--allow-implausible waives this" in run.err
    assert flasher("image-info", file, "--base", "0x8008000", "--allow-implausible").code == 0
