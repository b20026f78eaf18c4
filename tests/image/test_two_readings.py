"""A file of records is read twice, by the strict pass and by a library, and both have to agree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import bincopy
import intelhex
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flasher.errors import ErrorCode, ExitCode, ImageError
from flasher.image import records
from flasher.image.load import load

Line = Callable[[int, bytes], str]
BASE = 0x0800_0000
END = {".hex": ":00000001FF\n", ".s37": "S70500000000FA\n"}


def hex_line(address: int, data: bytes) -> str:
    """A data record below its own extended linear address."""
    high = bytes((2, 0, 0, 4, address >> 24, address >> 16 & 0xFF))
    low = bytes((len(data), address >> 8 & 0xFF, address & 0xFF, 0)) + data
    return "".join(f":{body.hex()}{-sum(body) & 0xFF:02x}\n" for body in (high, low))


def srec_line(address: int, data: bytes) -> str:
    body = bytes((len(data) + 5,)) + address.to_bytes(4, "big") + data
    return f"S3{body.hex()}{~sum(body) & 0xFF:02x}\n"


LINES: dict[str, Line] = {".hex": hex_line, ".s37": srec_line}
both = pytest.mark.parametrize("suffix", LINES)


def written(folder: Path, suffix: str, pieces: list[tuple[int, bytes]]) -> Path:
    path = folder / f"app{suffix}"
    text = "".join(LINES[suffix](BASE + start, data) for start, data in pieces) + END[suffix]
    path.write_text(text)
    return path


# -- the two differ -------------------------------------------------------------------------------


def other_byte(data: bytes) -> bytes:
    return data[:-1] + bytes((data[-1] ^ 1,))


@pytest.mark.parametrize("damage", [other_byte, lambda data: data[:-1], lambda data: data + b"\0"])
@both
def test_bytes_that_a_library_reads_otherwise_are_not_used(
    suffix: str,
    damage: Callable[[bytes], bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = {".hex": "_by_intelhex", ".s37": "_by_bincopy"}[suffix]
    real = getattr(records, name)

    def wrong(lines: str) -> list[tuple[int, bytes]]:
        return [(start, damage(data)) for start, data in real(lines)]

    monkeypatch.setattr(records, name, wrong)
    with pytest.raises(ImageError) as caught:
        load(written(tmp_path, suffix, [(0, b"abcd"), (4, b"efgh")]))
    assert (caught.value.code, caught.value.exit_code) == (
        ErrorCode.IMAGE_READINGS,
        ExitCode.IMAGE,
    )
    assert "nothing of it was used" in caught.value.what
    assert (
        caught.value.where
        == {
            ".hex": "records between line 2 and line 4",
            ".s37": "records between line 1 and line 2",
        }[suffix]
    )


@both
def test_an_address_that_a_library_reads_otherwise_is_noticed(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = {".hex": "_by_intelhex", ".s37": "_by_bincopy"}[suffix]
    real = getattr(records, name)
    monkeypatch.setattr(records, name, lambda lines: [(at + 1, data) for at, data in real(lines)])
    with pytest.raises(ImageError) as caught:
        load(written(tmp_path, suffix, [(0, b"abcd")]))
    assert caught.value.code is ErrorCode.IMAGE_READINGS


@pytest.mark.parametrize(
    ("suffix", "where", "error"),
    [
        (".hex", (intelhex.IntelHex, "loadhex"), intelhex.RecordChecksumError(line=1)),
        (".s37", (bincopy.BinFile, "add_srec"), bincopy.Error("expected crc")),
        (".s37", (bincopy.BinFile, "add_srec"), ValueError("non-hexadecimal number")),
    ],
)
def test_a_record_that_passed_and_that_a_library_refuses_is_no_traceback(
    suffix: str,
    where: tuple[type, str],
    error: Exception,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(*where, refuse)
    with pytest.raises(ImageError) as caught:
        load(written(tmp_path, suffix, [(0, b"abcd")]))
    assert caught.value.code is ErrorCode.IMAGE_READINGS
    assert caught.value.__cause__ is error


# -- what libraries do with a right file, and what is asked of them -------------------------------


@both
def test_records_that_repeat_each_other_are_read(suffix: str, tmp_path: Path) -> None:
    """intelhex refuses them."""
    pieces = [(0, b"abcd"), (0, b"abcd"), (2, b"cdef"), (0, b"abcdef"), (6, b"gh")]
    assert load(written(tmp_path, suffix, pieces)).data == b"abcdefgh"


@both
def test_a_contradiction_is_refused_by_the_line_that_brings_it(suffix: str, tmp_path: Path) -> None:
    """bincopy lets the later record win where it may, intelhex refuses without the bytes."""
    lines_each = {".hex": 2, ".s37": 1}[suffix]
    for count in (2, 3, records._BATCH_MAX, 2 * records._BATCH_MAX):
        pieces = [(4 * at, b"abcd") for at in range(count)]
        with pytest.raises(ImageError) as caught:
            load(written(tmp_path, suffix, [*pieces, (3, b"dX"), (-16, b"later"), (-8, b"on")]))
        assert caught.value.code is ErrorCode.IMAGE_CONFLICT
        assert f"0x{BASE + 4:08X}: first 61, then 58" in caught.value.what
        assert caught.value.where == f"line {(count + 1) * lines_each}"


@both
def test_what_is_outside_of_the_range_is_not_given_to_a_library(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = {".hex": "_by_intelhex", ".s37": "_by_bincopy"}[suffix]
    real, given_lines = getattr(records, name), []

    def noted(lines: str) -> list[tuple[int, bytes]]:
        given_lines.append(lines)
        result: list[tuple[int, bytes]] = real(lines)
        return result

    monkeypatch.setattr(records, name, noted)
    path = written(tmp_path, suffix, [(0, b"a"), (0, b"b"), (4, b"cdef"), (8, b"gh"), (20, b"z")])
    image = load(path, range_=(BASE + 6, BASE + 9))
    assert (image.base, image.data) == (BASE + 6, b"efg")
    assert len(given_lines) == 1
    assert given_lines[0].count(LINES[suffix](BASE, b"a").splitlines()[-1]) == 0
    with pytest.raises(ImageError, match=f"between 0x{BASE:08X} and 0x{BASE + 21:08X}"):
        load(path, range_=(0, 4))


def test_start_addresses_are_no_business_of_the_library(tmp_path: Path) -> None:
    """intelhex refuses a second one."""
    start = ":0400000508000000EF\n:0400000300003800C1\n"
    path = tmp_path / "app.hex"
    path.write_text(start + hex_line(BASE, b"abcd") + start + END[".hex"])
    assert load(path).data == b"abcd"


@both
def test_a_file_in_descending_order_is_read(suffix: str, tmp_path: Path) -> None:
    data = bytes(range(256)) * 64
    pieces = [(at, data[at : at + 8]) for at in range(0, len(data), 8)]
    assert load(written(tmp_path, suffix, pieces[::-1])).data == data


def test_each_record_goes_to_the_library_with_what_its_address_is_relative_to(
    tmp_path: Path,
) -> None:
    path = tmp_path / "app.hex"
    low = ":0400000001020304F2\n"  # below no extended address
    text = low + hex_line(0x2_0000, b"z") + hex_line(0x1_0004, b"y") + END[".hex"]
    path.write_text(text)
    image = load(path, fill_gaps_up_to=1 << 20)
    assert [str(span)[:10] for span in image.segments] == ["0x00000000", "0x00010004", "0x00020000"]
    assert (image.data[:4], image.data[0x1_0004:0x1_0005], image.data[-1:]) == (
        bytes((1, 2, 3, 4)),
        b"y",
        b"z",
    )


def test_overlaps_without_end_are_refused_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each record overlaps the one before: every one is loaded for itself."""
    monkeypatch.setattr(records, "PIECES_MAX", 9)
    pieces = [(at, b"aaa") for at in range(10)]
    assert load(written(tmp_path, ".hex", pieces[:9])).data == b"a" * 11
    with pytest.raises(ImageError, match="separate pieces of data"):
        load(written(tmp_path, ".hex", pieces))


PIECES = st.lists(st.tuples(st.integers(0, 60), st.binary(min_size=1, max_size=12)), max_size=14)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(pieces=PIECES, suffix=st.sampled_from(sorted(LINES)))
def test_any_records_come_to_the_same_as_a_map_of_addresses(
    pieces: list[tuple[int, bytes]], suffix: str, tmp_path: Path
) -> None:
    path = written(tmp_path, suffix, [(0, b"first"), *pieces])
    model: dict[int, int] = {}
    for start, data in [(0, b"first"), *pieces]:
        placed = {start + at: byte for at, byte in enumerate(data)}
        if any(model.get(at, byte) != byte for at, byte in placed.items()):
            with pytest.raises(ImageError) as caught:
                load(path, allow_outside_vector=True)
            assert caught.value.code is ErrorCode.IMAGE_CONFLICT
            return
        model |= placed
    image = load(path, allow_outside_vector=True)
    assert image.data == bytes(model.get(at, 0xFF) for at in range(max(model) + 1))
    assert image.filled_bytes == image.size_bytes - len(model)
