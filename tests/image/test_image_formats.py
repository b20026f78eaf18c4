"""Intel HEX, S-record and ELF as other programs write them, read back to the same bytes."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import bincopy
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from intelhex import IntelHex

from flasher.errors import ImageError
from flasher.image import elf
from flasher.image.load import load
from flasher.image.records import read_hex, read_srec
from flasher.image.segments import SparseBytes
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
FAR = 1 << 20

SPARSE = st.dictionaries(
    st.integers(0, 0x2_0000), st.binary(min_size=1, max_size=300), min_size=1, max_size=6
)


def flat(parts: dict[int, bytes]) -> tuple[int, bytes]:
    """First address, and the bytes from there on with FF in the gaps; later parts win."""
    model = {start + at: byte for start, data in parts.items() for at, byte in enumerate(data)}
    first, last = min(model), max(model)
    return first, bytes(model.get(address, 0xFF) for address in range(first, last + 1))


def write(folder: Path, name: str, content: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode("ascii"))
    return path


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(parts=SPARSE, base=st.sampled_from([0, 0x0800_0000, 0xFFFD_0000]), width=st.integers(1, 255))
def test_what_intelhex_writes_is_read_back(
    parts: dict[int, bytes], base: int, width: int, tmp_path: Path
) -> None:
    writer = IntelHex()
    for start, data in parts.items():
        writer.puts(base + start, data)
    text = io.StringIO()
    writer.write_hex_file(text, byte_count=width)
    image = load(
        write(tmp_path, "app.hex", text.getvalue()), fill_gaps_up_to=FAR, allow_outside_vector=True
    )
    first, data = flat(parts)
    assert (image.base, image.data) == (base + first, data)
    assert image.format == "Intel HEX"


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(parts=SPARSE, width=st.integers(1, 200), bits=st.sampled_from([24, 32]))
def test_what_bincopy_writes_as_s_records_is_read_back(
    parts: dict[int, bytes], width: int, bits: int, tmp_path: Path
) -> None:
    writer = bincopy.BinFile()
    for start, data in parts.items():
        writer.add_binary(data, start, overwrite=True)
    path = write(tmp_path, "app", writer.as_srec(width, bits))
    image = load(path, fill_gaps_up_to=FAR, allow_outside_vector=True)
    first, data = flat(parts)
    assert (image.base, image.data) == (first, data)
    assert image.format == "Motorola S-record"


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(parts=SPARSE, width=st.integers(1, 200))
def test_what_bincopy_writes_as_hex_is_read_back(
    parts: dict[int, bytes], width: int, tmp_path: Path
) -> None:
    """Not below 64 KiB: there it lets a record run past them without an extended address."""
    base = 0x0800_0000
    writer = bincopy.BinFile()
    for start, data in parts.items():
        writer.add_binary(data, base + start, overwrite=True)
    path = write(tmp_path, "app", writer.as_ihex(width, 32))
    image = load(path, fill_gaps_up_to=FAR, allow_outside_vector=True)
    first, data = flat(parts)
    assert (image.base, image.data) == (base + first, data)
    assert image.format == "Intel HEX"


GOOD_HEX = (SAMPLES / "wmc.hex").read_text()
GOOD_SREC = (SAMPLES / "wmc.s19").read_text()


@pytest.mark.parametrize("text", [GOOD_HEX, GOOD_SREC], ids=["hex", "srec"])
def test_line_ends_small_digits_and_blank_lines_do_not_matter(text: str, tmp_path: Path) -> None:
    expected = load(write(tmp_path, "app", text)).data
    small = "".join(line[:2] + line[2:].lower() for line in text.splitlines(keepends=True))
    for variant in (text.replace("\n", "\r\n"), small, f"\n{text}\r\n \n", text.rstrip()):
        assert load(write(tmp_path, "app", variant)).data == expected


def test_a_hex_file_with_segment_addresses_is_read(tmp_path: Path) -> None:
    text = (
        ":020000021000EC\n"  # segment 1000, so 0x10000
        ":04FFFC0001020304F7\n"  # the last four bytes of it
        ":020000022000DC\n"
        ":0100000005FA\n"
        ":0400000300003800C1\n"  # start CS:IP
        ":0400000508000000EF\n"  # start address
        ":00001000F0\n"  # no data at all
        ":00000001FF\n"
    )
    image = load(write(tmp_path, "app.hex", text))
    assert (image.base, image.data) == (0x1FFFC, bytes((1, 2, 3, 4, 5)))


def test_a_linear_and_a_segment_address_replace_each_other(tmp_path: Path) -> None:
    text = ":020000040800F2\n:0100000001FE\n:020000020000FC\n:0100000002FD\n:00000001FF\n"
    path = write(tmp_path, "app.hex", text)
    assert load(path, range_=(0, 1)).data == b"\x02"
    assert load(path, range_=(0x0800_0000, 0x0800_0001)).data == b"\x01"


def test_a_record_may_cross_64_kib_under_a_linear_address(tmp_path: Path) -> None:
    text = ":020000040001F9\n:04FFFE0001020304F5\n:00000001FF\n"
    image = load(write(tmp_path, "app.hex", text))
    assert (image.base, image.data) == (0x1FFFE, bytes((1, 2, 3, 4)))


def test_no_record_may_cross_64_kib_before_any_extended_address(tmp_path: Path) -> None:
    text = ":02FFFF000102FD\n:00000001FF\n"
    with pytest.raises(ImageError, match=r"64 KiB segment(.|\n)*line 1"):
        load(write(tmp_path, "app.hex", text))


def test_the_last_32_bit_address_can_be_used(tmp_path: Path) -> None:
    text = ":02000004FFFFFC\n:01FFFF0007FA\n:00000001FF\n"
    assert load(write(tmp_path, "app.hex", text)).base == 0xFFFF_FFFF
    beyond = text.replace(":01FFFF0007FA", ":02FFFF000708F1")
    with pytest.raises(ImageError, match="past the last 32-bit address"):
        load(write(tmp_path, "app.hex", beyond))


@pytest.mark.parametrize(
    ("line", "base"),
    [
        ("S1040010AA41", 0x10),
        ("S205000010AA40", 0x10),
        ("S30608000010AA37", 0x0800_0010),
    ],
)
@pytest.mark.parametrize(
    "end", ["S9030000FC", "S804000000FB", "S70500000000FA", "S5030001FB", "S604000001FA"]
)
def test_every_kind_of_data_record_end_and_count_is_read(
    line: str, base: int, end: str, tmp_path: Path
) -> None:
    image = load(write(tmp_path, "app.s19", f"S00600004844521B\n{line}\n{end}\n"))
    assert (image.base, image.data) == (base, b"\xaa")


def test_a_count_is_no_end_when_records_follow_it(tmp_path: Path) -> None:
    text = "S1040010AA41\nS5030001FB\nS1040011AA40\n"
    with pytest.raises(ImageError, match=r"end record is missing(.|\n)*line 3"):
        load(write(tmp_path, "app.s19", text))


def test_a_count_holds_no_data(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"type S5 contains 1 bytes of data(.|\n)*line 2"):
        load(write(tmp_path, "app.s19", "S1040010AA41\nS504000107F3\n"))


def test_a_data_record_without_data_counts_and_adds_nothing(tmp_path: Path) -> None:
    text = "S1040010AA41\nS1030090 6C\n".replace(" ", "") + "S5030002FA\n"
    assert load(write(tmp_path, "app.s19", text)).data == b"\xaa"


# -- ELF ------------------------------------------------------------------------------------------

GOOD_ELF = (SAMPLES / "obc.elf").read_bytes()


def test_an_elf_file_has_the_bytes_of_the_raw_binary() -> None:
    image = load(SAMPLES / "obc.elf")
    assert image.data == (SAMPLES / "obc.bin").read_bytes()
    assert (image.base, image.format) == (0x0800_2000, "ELF")


def test_an_elf_segment_without_bytes_in_the_file_and_other_headers_are_left_out(
    tmp_path: Path,
) -> None:
    path = write(tmp_path, "app.elf", GOOD_ELF)
    whole = load(path)
    note = bytearray(GOOD_ELF)
    struct.pack_into("<I", note, 52, 4)  # the first segment is a note now
    assert load(write(tmp_path, "app.elf", bytes(note))).data == whole.data[0x100:]
    bss = bytearray(GOOD_ELF)
    struct.pack_into("<I", bss, 52 + 16, 0)  # and now one that is cleared at start
    assert load(write(tmp_path, "app.elf", bytes(bss))).data == whole.data[0x100:]


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (5, b"\x07", "header is truncated"),
        (42, b"\x10\x00", "program headers are truncated"),
        (44, b"\x41\x00", "program headers"),
        (48, b"\x01\x20", "8193 sections"),
        (46, b"\x01\x00", "section table"),
    ],
)
def test_a_damaged_elf_header_is_refused(at: int, value: bytes, words: str, tmp_path: Path) -> None:
    damaged = GOOD_ELF[:at] + value + GOOD_ELF[at + len(value) :]
    with pytest.raises(ImageError, match=words):
        load(write(tmp_path, "app.elf", damaged))


def test_an_elf_segment_that_lost_its_last_byte_is_refused(tmp_path: Path) -> None:
    whole = (SAMPLES / "bad" / "no_section.elf").read_bytes()
    with pytest.raises(ImageError, match="program header 0 points past the end"):
        load(write(tmp_path, "app.elf", whole[:-1]))


def test_a_range_of_an_elf_file_can_be_chosen() -> None:
    whole = load(SAMPLES / "obc.elf").data
    image = load(SAMPLES / "obc.elf", range_=(0x0800_2080, 0x0800_2180), allow_outside_vector=True)
    assert image.data == whole[0x80:0x180]


@settings(max_examples=150)
@given(at=st.integers(0, 52 + 64 - 1), value=st.integers(0, 255))
def test_no_damaged_byte_of_the_elf_headers_escapes_as_another_error(at: int, value: int) -> None:
    damaged = GOOD_ELF[:at] + bytes((value,)) + GOOD_ELF[at + 1 :]
    sparse = SparseBytes("app.elf")
    try:
        elf.read(io.BytesIO(damaged), "app.elf", sparse)
    except ImageError:
        return
    assert sparse.size_bytes <= len(GOOD_ELF)


@settings(max_examples=150)
@given(cut=st.integers(0, len(GOOD_ELF) - 1))
def test_an_elf_file_that_was_cut_off_is_refused(cut: int) -> None:
    with pytest.raises(ImageError):
        elf.read(io.BytesIO(GOOD_ELF[:cut]), "app.elf", SparseBytes("app.elf"))


# -- damage by a single character ---------------------------------------------------------------

SMALL_HEX = ":020000040800F2\n:0400100001020304E2\n:0400140005060708CE\n:00000001FF\n"
SMALL_SREC = "S00400004AB1\nS3090800001001020304D4\nS3090800001405060708C0\nS70500000000FA\n"


@each("read_records, text", [(read_hex, SMALL_HEX), (read_srec, SMALL_SREC)])
def test_no_single_changed_character_gives_other_bytes(
    read_records: Callable[[BinaryIO, str, SparseBytes], None], text: str
) -> None:
    def read(content: str) -> tuple[bytes, int]:
        sparse = SparseBytes("app")
        read_records(io.BytesIO(content.encode()), "app", sparse)
        return sparse.join(4096)

    assert read(text) == (bytes(range(1, 9)), 0x0800_0010)
    refused = 0
    for at in range(len(text)):
        for char in "0123456789ABCDEFadf:SsX \n":
            try:
                data = read(text[:at] + char + text[at + 1 :])
            except ImageError:
                refused += 1
            else:
                assert data == (bytes(range(1, 9)), 0x0800_0010), (at, char)
    assert refused > 20 * len(text)


@each(
    "line, what",
    [
        (":0G", "':0G' does not consist of pairs of hex digits"),
        (":" + "Z" * 39, f"':{'Z' * 39}' does not consist of pairs of hex digits"),
        (":" + "Z" * 40, f"':{'Z' * 39}...' does not consist of pairs of hex digits"),
        (":00000001", "':00000001' does not have the length in its count"),
        (":00000001FE", "the checksum is FE, computed FF"),
    ],
)
def test_a_damaged_line_is_shown_and_not_more_of_it_than_fits(
    line: str, what: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError) as refused:
        load(write(tmp_path, "bad.hex", f"{line}\n"), format="hex")
    assert refused.value.what.endswith(f"bad.hex is a damaged Intel HEX file: {what}")
    assert refused.value.where == "line 1"
    assert refused.value.cause == "damaged while it was copied, or edited by hand"
