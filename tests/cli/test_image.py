"""`flasher image`: convert and merge, and several images in `image-info`."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.image.load import load
from tests.cli.conftest import SAMPLES, Flasher


def test_an_image_survives_a_round_of_all_formats(flasher: Flasher, tmp_path: Path) -> None:
    original = load(SAMPLES / "wmc.hex")
    source: object = SAMPLES / "wmc.hex"
    for name in ("a.s19", "b.hex", "c.bin"):
        fill = ("--fill",) if name.endswith("bin") else ()
        assert flasher("image", "convert", source, "-o", tmp_path / name, *fill).code == ExitCode.OK
        source = tmp_path / name
    again = load(tmp_path / "b.hex")
    assert (again.data, again.base, again.segments) == (
        original.data, original.base, original.segments
    )  # fmt: skip
    assert (tmp_path / "c.bin").read_bytes() == original.data


def test_the_document_names_what_was_written(flasher: Flasher, tmp_path: Path) -> None:
    out = tmp_path / "part.bin"
    words = ("--range", "0x8004100:0x8004200", "--fill", "-o", out, "--json")
    document = flasher("image", "convert", SAMPLES / "wmc.hex", *words).document
    assert document["segments"] == [{"start": 0x8004100, "size_bytes": 0x88}]
    assert (document["size_bytes"], document["filled_bytes"]) == (0x88, 0)
    assert out.stat().st_size == 0x88


def test_an_older_file_is_kept_unless_forced(flasher: Flasher, tmp_path: Path) -> None:
    out = tmp_path / "old.hex"
    out.write_bytes(b"old")
    words = ("image", "merge", SAMPLES / "wmc.hex", SAMPLES / "wmc.s19", "-o", out)
    assert flasher(*words).code == ExitCode.USAGE
    assert out.read_bytes() == b"old"
    assert flasher(*words, "--force").code == ExitCode.OK
    assert load(out).data == load(SAMPLES / "wmc.hex").data


def test_nothing_is_written_after_a_conflict(flasher: Flasher, tmp_path: Path) -> None:
    out = tmp_path / "both.hex"
    part = f"{SAMPLES / 'obc.bin'}@0x8005000"
    assert flasher("image", "merge", SAMPLES / "wmc.hex", part, "-o", out).code == ExitCode.IMAGE
    assert list(tmp_path.iterdir()) == []


def test_a_name_with_an_at_sign_is_a_file_first(flasher: Flasher, tmp_path: Path) -> None:
    source, out = tmp_path / "unit@0x10", tmp_path / "out.bin"
    source.write_bytes((SAMPLES / "wmc.hex").read_bytes())
    assert flasher("image", "merge", source, "--fill", "-o", out).code == ExitCode.OK


def test_standard_input_becomes_standard_output(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = (SAMPLES / "wmc.s19").read_bytes()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    run = flasher("image", "convert", "-", "--to", "hex", "-o", "-")
    assert run.code == ExitCode.OK
    assert run.out.startswith(":020000040800F2\n")
    assert run.out.endswith(":00000001FF\n")
    assert "written: standard output" in run.err
    run = flasher("image", "convert", "-", "--to", "hex", "-o", "-", "--json")
    assert run.code == ExitCode.USAGE


def test_several_images_are_shown_and_the_worst_decides(flasher: Flasher) -> None:
    good, damaged = SAMPLES / "wmc.hex", SAMPLES / "bad" / "no_end.hex"
    words = ("image-info", good, damaged, "missing.hex", good)
    run = flasher(*words)
    assert run.code == ExitCode.IMAGE
    assert run.out.count("plausible for a Cortex-M") == 2
    assert run.out.endswith("4 images: 2 can be sent, 2 refused\n")
    document = flasher(*words, "--json").document
    assert document["exit_code"] == ExitCode.IMAGE
    assert [each["exit_code"] for each in document["images"]] == [0, 3, 2, 0]
    assert document["images"][0]["shown"] == document["images"][3]["shown"]
    assert document["error"]["code"] == document["images"][1]["error"]["code"] == "E301"
    assert flasher("image", "info", good, good).code == ExitCode.OK
