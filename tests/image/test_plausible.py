"""A file that is no firmware is known by its own marks, or by a wrong beginning."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import pytest

from flasher.errors import ExitCode, ImageError
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plausible import check_plausible, find_doubt
from tests.firmware import VECTORS
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
PE = b"MZ" + bytes(58) + struct.pack("<I", 64) + b"PE\0\0" + bytes(60)
MARKED = [
    (b"PK\x03\x04" + bytes(200), "a zip archive"),
    (b"\x1f\x8b\x08\0" + bytes(200), "a gzip file"),
    (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(200), "a PNG picture"),
    (b"\xff\xd8\xff\xe0" + bytes(200), "a JPEG picture"),
    (b"%PDF-1.7\n\xe2\xe3\xcf\xd3" + bytes(200), "a PDF document"),
    (PE, "a Windows program"),
    (b"\x7fELF\1\1\1" + bytes(200), "an ELF file read as a raw binary"),
    (bytes(257) + b"ustar\x0000" + bytes(200), "a tar archive"),
    (b"SQLite format 3\0" + bytes(200), "an SQLite database"),
    (bytes(4096), r"one repeated byte \(0x00\)"),
    (b"\xff" * 4096, r"one repeated byte \(0xFF\)"),
    (b"\n<!DOCTYPE html>\n<html><body>404 \xe4</body></html>", "an HTML page"),
    (b'<?xml version="1.0"?><a/>', "an XML document"),
    (b"release notes", "a text"),
    ("Motor, \xe4ndern; \u7535\u673a".encode(), "a text"),
    (("\u7535\u673a\n" * 99).encode("gbk"), "a text"),
    (b"first line\nsecond line\n" + b"\xff" * 500, "a text"),
    (":00000001FF\n".encode("utf-16"), "a text in UTF-16"),
]  # fmt: skip


@each("data, words", MARKED)
def test_another_kind_of_file_is_named_and_is_certain(data: bytes, words: str) -> None:
    found = find_doubt(Image.from_bytes(data))
    assert found is not None
    assert found.is_certain
    assert found.other_waivers == ""
    with pytest.raises(ImageError, match=f"is {words}: not plausible as firmware") as caught:
        check_plausible(Image.from_bytes(data, source="it.bin"))
    assert caught.value.exit_code is ExitCode.IMAGE
    assert caught.value.remedy == "Name the firmware file itself."


def test_an_elf_of_another_machine_is_no_firmware_whatever_it_begins_with(tmp_path: Path) -> None:
    elf = bytearray((SAMPLES / "obc.elf").read_bytes())
    assert find_doubt(load(SAMPLES / "obc.elf")) is None
    elf[18:20] = (243).to_bytes(2, "little")
    path = tmp_path / "riscv.elf"
    path.write_bytes(elf)
    found = find_doubt(load(path))
    assert found is not None
    assert found.text == "is a program for another processor (RISC-V)"
    assert found.is_certain


def test_two_bytes_as_a_mark_of_utf_16_make_no_text() -> None:
    found = find_doubt(Image.from_bytes(b"\xff\xfe" + random.Random(2).randbytes(500)))
    assert found is not None
    assert not found.is_certain, "an encrypted image may begin with any two bytes"


def test_no_random_bytes_begin_like_a_program() -> None:
    """One word alone would let one in fifty pass."""
    for seed in range(2000):
        data = random.Random(seed).randbytes(4096)
        found = find_doubt(Image.from_bytes(data, base=None if seed % 2 else 0x0800_4000))
        assert found is not None
        assert not found.is_certain
        assert "cpu" in found.other_waivers


@each("base", [None, 0x0800_4000])
def test_a_vector_table_is_enough(base: int | None) -> None:
    program = VECTORS + random.Random(1).randbytes(4096)
    assert find_doubt(Image.from_bytes(program, base=base)) is None


def test_seven_bytes_have_no_vector_table() -> None:
    found = find_doubt(Image.from_bytes(VECTORS[:7]))
    assert found is not None
    assert "too short" in found.text


@each("name", ["bms.hex", "bms.bin", "wmc.s19", "obc.elf", "station/bms.bin"])
def test_every_good_sample_is_plausible(name: str) -> None:
    check_plausible(load(SAMPLES / name))


@each(
    "data, text, is_certain",
    [
        (b"\0\0", "one repeated byte (0x00)", True),
        (b"\1\1", "one repeated byte (0x01)", True),
        (b"\1", "too short to begin with a vector table", False),
        (b"MZ" + bytes(50) + b"\1" * 150, "no Cortex-M vector table", False),
        (b"MZ" + bytes(58) + struct.pack("<I", 1 << 24) + b"PE\0\0" + bytes(9), "no Cortex", False),
        (bytes(58) + b"\1\1" + struct.pack("<I", 64) + b"PE\0\0" + bytes(60), "no Cortex", False),
        (b"\xe4" * 9 + b"line\n", "no Cortex", False),
        (b"\xe4b" * 127 + b"\n\xe4", "a text", True),
        (b"\xe4b" * 127 + b"\n", "no Cortex", False),
        (b"\xe4b" * 200, "no Cortex", False),  # no line in it
    ],
)  # fmt: skip
def test_what_is_certain_and_what_is_only_unlikely(
    data: bytes, text: str, *, is_certain: bool
) -> None:
    found = find_doubt(Image.from_bytes(data))
    assert found is not None
    assert text in found.text
    assert found.is_certain is is_certain
    with pytest.raises(ImageError) as refused:
        check_plausible(Image.from_bytes(data))
    assert (refused.value.cause == "the wrong file") is is_certain
