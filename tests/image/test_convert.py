"""Image files merged and written: what is written reads back to the same bytes and addresses."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from bincopy import BinFile

from flasher.errors import ErrorCode, ImageError, UsageError
from flasher.image.convert import WRITTEN, check_no_other_file, encode, merge
from flasher.image.load import READERS, Content, Format, read
from flasher.image.segments import SparseBytes
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"


def content(name: str, *pieces: tuple[int, bytes]) -> Content:
    sparse = SparseBytes(name)
    for start, data in pieces:
        sparse.add(start, data, str)
    return Content(sparse, Format.HEX, True, None)


@each("form", [Format.HEX, Format.SREC])
@each("start", [0, 0xFFF8, 0xFF_FFF8, 0x0800_4000, 0xFFFF_FFD0])
def test_records_read_back_with_their_gaps(form: Format, start: int) -> None:
    pieces = [(start, bytes(range(20))), (start + 0x20, b"end")]
    encoded = encode(content("a", *pieces).sparse, form, fills=False)
    again = SparseBytes("again")
    READERS[form](io.BytesIO(encoded), "again", again)
    assert list(again.pieces()) == pieces


def test_a_record_file_is_that_of_the_documents() -> None:
    sparse = content("a", (0x0800_4000, bytes(range(17)))).sparse
    assert encode(sparse, Format.HEX, fills=False).split() == [
        b":020000040800F2",
        b":10400000000102030405060708090A0B0C0D0E0F38",
        b":01401000109F",
        b":00000001FF",
    ]
    short = content("a", (0x10, b"\x01\x02")).sparse
    assert encode(short, Format.SREC, fills=False).split() == [
        b"S10500100102E7",
        b"S5030001FB",
        b"S9030000FC",
    ]


def test_gaps_are_filled_only_on_request() -> None:
    sparse = content("a", (0x100, b"ab"), (0x104, b"c")).sparse
    with pytest.raises(ImageError) as refused:
        encode(sparse, Format.BIN, fills=False)
    assert refused.value.code is ErrorCode.IMAGE_GAP
    assert encode(sparse, Format.BIN, fills=True) == b"ab\xff\xffc"
    filled = BinFile()
    filled.add_ihex(encode(sparse, Format.HEX, fills=True).decode())
    assert filled[0x100:0x105] == b"ab\xff\xffc"


def test_parts_far_apart_stay_apart_and_do_not_fill_the_disk() -> None:
    sparse = content("a", (0x0800_0000, b"flash"), (0x1FFF_7800, b"option")).sparse
    assert len(encode(sparse, Format.HEX, fills=False)) < 200
    for form in WRITTEN:
        with pytest.raises(ImageError) as refused:
            encode(sparse, form, fills=True)
        assert refused.value.code is ErrorCode.IMAGE_TOO_LARGE


def test_overlaps_are_merged_if_equal_and_refused_otherwise() -> None:
    first, same = content("a", (0, b"abcd")), content("b", (2, b"cdef"))
    assert list(merge([first, same], "all").pieces()) == [(0, b"abcdef")]
    with pytest.raises(ImageError) as refused:
        merge([content("z", (0x50, b"-")), first, content("c", (3, b"X"))], "all")
    assert refused.value.code is ErrorCode.IMAGE_CONFLICT
    assert refused.value.where == "a and c"


def test_a_raw_binary_is_merged_at_an_address_only(tmp_path: Path) -> None:
    path = tmp_path / "data.bin"
    path.write_bytes(b"\1\2")
    with pytest.raises(UsageError):
        merge([read(path)], "all")
    assert list(merge([read(path, base=0x40)], "all").pieces()) == [(0x40, b"\1\2")]


@each("head", [b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"<!DOCTYPE html>"])
def test_other_files_are_no_images(tmp_path: Path, head: bytes) -> None:
    path = tmp_path / "x.hex"
    path.write_bytes(head + bytes(100))
    with pytest.raises(ImageError):
        check_no_other_file(read(path, base=0))
    check_no_other_file(read(SAMPLES / "obc.bin", base=0))


def test_a_file_without_bytes_is_not_written() -> None:
    for form in WRITTEN:
        with pytest.raises(ImageError) as refused:
            encode(SparseBytes("a"), form, fills=False)
        assert refused.value.code is ErrorCode.IMAGE_EMPTY
