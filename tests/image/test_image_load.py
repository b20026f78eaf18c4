"""Loading: detection of formats, options, every refusal, and what a refusal costs."""

from __future__ import annotations

import hashlib
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ErrorCode, ExitCode, ImageError, UsageError
from flasher.image import load as load_module
from flasher.image import records
from flasher.image.image import AddressSpan, Image
from flasher.image.load import DEFAULT_FILL_GAPS_UP_TO, load
from flasher.image.plausible import check_plausible
from flasher.protocol.spec import IMAGE_MAX_SIZE
from flasher.protocol.text import find_firmware_version
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
BAD = SAMPLES / "bad"


def write(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


# -- refusals -----------------------------------------------------------------------------------

FILL = {"fill_gaps_up_to": 1 << 24}
ENDLESS = {"fill_gaps_up_to": 1 << 32}
REFUSALS: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("empty.bin", {}, ("is empty",)),
    ("text.bin", {}, ("is a text", "the firmware file itself")),
    ("zip.bin", {}, ("a zip archive",)),
    ("utf_16.bin", {}, ("a text in UTF-16",)),
    ("hex_inside.bin", {}, ("damaged Intel HEX", "checksum is 09, computed 11", "line 2")),
    ("lost_first_line.bin", {}, ("damaged Intel HEX", "does not start with a colon", "line 1")),
    ("no_data.hex", {}, ("is empty",)),
    ("check_sum.hex", {}, ("checksum is 09, computed 11", "line 2")),
    ("no_end.hex", {}, ("end record is missing", "line 3")),
    ("after_end.hex", {}, ("data after the end record", "line 5")),
    ("overlap.hex", {}, ("0x08000008: first 3A, then 23", "line 5")),
    ("gap.hex", {}, ("gap of 8176 bytes", "0x08000010 and 0x08002000", "--fill-gaps-up-to 8176")),
    (
        "gigabytes.hex",
        {},
        ("gap of 2281701360", "0x08000000..0x0800000F", "0x90000000..0x9000000F"),
    ),
    ("gigabytes.hex", ENDLESS, ("too large", "2281701392 bytes", "65535 packets")),
    ("cut_line.hex", {}, ("does not have the length", "line 2")),
    ("odd_digit.hex", {}, ("pairs of hex digits", "line 2")),
    ("no_digit.hex", {}, ("pairs of hex digits", "line 2")),
    ("no_colon.hex", {}, ("does not start with a colon", "line 2")),
    ("record_type.hex", {}, ("no record type 06", "line 3")),
    ("record_size.hex", {}, ("type 04 contains 1 bytes", "line 1")),
    ("extended_address.hex", {}, ("an address of its own", "line 1")),
    ("past_segment.hex", {}, ("past the end of its 64 KiB segment", "line 2")),
    ("past_last_address.hex", {}, ("0xFFFFFFFF", "line 2")),
    ("no_line_ends.hex", {}, ("longer than any record", "line 1")),
    ("no_ascii.hex", {}, ("not ASCII", "line 2")),
    ("outside_vector.hex", {}, ("0x08000101", "0x08000000..0x0800001F", "--allow-outside-vector")),
    ("no_data.s19", {}, ("is empty",)),
    ("check_sum.s19", {}, ("checksum is FB, computed 6", "line 2")),
    ("no_end.s19", {}, ("end record is missing", "line 3")),
    ("after_end.s19", {}, ("data after the end record", "line 4")),
    ("overlap.s19", {}, ("0x08000008: first 3A, then 23", "line 2")),
    ("gap.s19", {}, ("gap of 8176 bytes",)),
    ("too_many_packets.s19", FILL, ("too large", "8388496 bytes", "65535 packets hold 8388480")),
    ("count.s19", {}, ("1 data records", "count of 2", "line 2")),
    ("cut_line.s19", {}, ("does not have the length", "line 1")),
    ("odd_digit.s19", {}, ("pairs of hex digits", "line 1")),
    ("record_type.s19", {}, ("S and a record type", "line 2")),
    ("record_size.s19", {}, ("type S7 contains 1 bytes", "line 2")),
    ("second_header.s19", {}, ("a header follows another record", "line 3")),
    ("no_s.s19", {}, ("S and a record type", "line 2")),
    ("past_last_address.s19", {}, ("0xFFFFFFFF", "line 1")),
    ("overlap.elf", {}, ("0x08000008: first 3A, then 23", "program header 1")),
    ("cut.elf", {}, ("program headers are truncated",)),
    ("cut_header.elf", {}, ("header is truncated",)),
    ("not.elf", {}, ("does not start with 7F 45 4C 46",)),
    ("no_segment.elf", {}, ("no loadable segment",)),
    ("no_section.elf", {}, ("program header 0 has bytes but no section",)),
    ("64_bit.elf", {}, ("64-bit processor",)),
    ("segment_past_file.elf", {}, ("program header 0 points past the end",)),
    ("section_past_segment.elf", {}, ("a section is outside",)),
    ("past_last_address.elf", {}, ("program header 0 runs past address 0xFFFFFFFF",)),
    ("gap.elf", {}, ("gap of 8176 bytes",)),
]


@each("encoding", ("utf-8-sig", "utf-16"))
def test_a_file_that_an_editor_saved_as_unicode_is_refused_with_that_cause(
    tmp_path: Path, encoding: str
) -> None:
    saved = tmp_path / "saved.hex"
    saved.write_text(":0400000001020304F2\n:00000001FF\n", encoding=encoding)
    with pytest.raises(ImageError) as caught:
        load(saved)
    assert "byte order mark" in caught.value.cause
    assert caught.value.where == "line 1"


@each("name, options, words", REFUSALS)
def test_each_bad_file_is_refused_in_the_words_for_it(
    name: str, options: dict[str, Any], words: tuple[str, ...]
) -> None:
    with pytest.raises(ImageError) as caught:
        check_plausible(load(BAD / name, **options))
    assert caught.value.exit_code is ExitCode.IMAGE
    message = str(caught.value)
    assert name in message
    for word in words:
        assert word in message


def test_what_no_option_lets_through_has_not_the_code_of_that_option() -> None:
    with pytest.raises(ImageError) as caught:
        load(BAD / "64_bit.elf")
    assert caught.value.code is ErrorCode.IMAGE


def test_every_bad_file_is_in_the_table() -> None:
    assert {name for name, _, _ in REFUSALS} == {path.name for path in BAD.iterdir()}


@each("name", ["text.bin", "zip.bin", "hex_inside.bin", "check_sum.hex"])
def test_a_user_who_insists_on_a_raw_binary_gets_one(name: str) -> None:
    image = load(BAD / name, format="bin")
    assert image.format == "raw binary"
    assert image.data == (BAD / name).read_bytes()


def test_the_merged_file_rule_can_be_waived() -> None:
    assert load(BAD / "outside_vector.hex", allow_outside_vector=True).size_bytes == 32


# -- how a format is detected -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sample", "name", "expected"),
    [
        ("wmc.hex", "app.bin", "Intel HEX"),
        ("wmc.hex", "app", "Intel HEX"),
        ("wmc.s19", "app.hex", "Motorola S-record"),
        ("obc.elf", "app.bin", "ELF"),
        ("obc.bin", "app.img", "raw binary"),
        ("bms.bin", "app", "raw binary"),
    ],
)
def test_the_content_decides_the_format_before_the_suffix(
    sample: str, name: str, expected: str, tmp_path: Path
) -> None:
    assert load(write(tmp_path, name, (SAMPLES / sample).read_bytes())).format == expected


@pytest.mark.parametrize(
    ("suffix", "words"),
    [
        (".hex", "damaged Intel HEX"),
        (".IHX", "damaged Intel HEX"),
        (".s19", "damaged Motorola S-record"),
        (".mot", "damaged Motorola S-record"),
        (".elf", "damaged ELF"),
    ],
)
def test_binary_content_under_a_text_suffix_is_refused(
    suffix: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(ImageError, match=words):
        load(write(tmp_path, f"app{suffix}", (SAMPLES / "obc.bin").read_bytes()))


@pytest.mark.parametrize("head", [b":", b"S3", b"\xef\xbb\xbf:10", b"\r\n :"])
def test_what_starts_like_a_record_is_never_a_binary(head: bytes, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="damaged"):
        load(write(tmp_path, "app.bin", head + b"0000\x00\x01\n" * 40))


@pytest.mark.parametrize("head", [b":", b"S3", b"\r\n :"])
def test_a_binary_that_happens_to_begin_like_a_record_is_a_binary(
    head: bytes, tmp_path: Path
) -> None:
    data = head + bytes(range(256))
    assert load(write(tmp_path, "app.bin", data)).data == data


@pytest.mark.parametrize("data", [b"A", b"A" * 128, b"0123456789abcdef" * 1000])
def test_a_printable_pattern_without_lines_is_a_binary(data: bytes, tmp_path: Path) -> None:
    assert load(write(tmp_path, "app.bin", data)).data == data


def test_a_binary_that_begins_like_utf_16_but_is_none_is_a_binary(tmp_path: Path) -> None:
    data = b"\xff\xfe" + bytes(range(128, 256))
    assert load(write(tmp_path, "app.bin", data)).data == data


def test_a_binary_that_has_some_lines_like_records_is_a_binary(tmp_path: Path) -> None:
    data = b"\x00\x50\x00\x20\n:100000000102\n\x00\x01"
    assert load(write(tmp_path, "app.bin", data)).data == data


def test_a_forced_format_must_fit_the_content() -> None:
    with pytest.raises(ImageError, match="damaged Intel HEX"):
        load(SAMPLES / "wmc.s19", format="hex")


# -- options ------------------------------------------------------------------------------------


def test_a_raw_binary_has_no_address_until_the_user_gives_one() -> None:
    image = load(SAMPLES / "obc.bin")
    assert (image.base, image.segments) == (None, (AddressSpan(0, 4000),))
    placed = load(SAMPLES / "obc.bin", base=0x0800_2000)
    assert (placed.base, placed.segments) == (0x0800_2000, (AddressSpan(0x0800_2000, 4000),))
    assert placed.data == image.data == (SAMPLES / "obc.bin").read_bytes()


def test_a_raw_binary_with_a_wrong_base_does_not_start_inside_itself() -> None:
    with pytest.raises(ImageError, match="does not start inside itself"):
        load(SAMPLES / "obc.bin", base=0x0800_0000)


def test_a_range_of_a_raw_binary_can_be_chosen_when_it_has_a_base() -> None:
    whole = (SAMPLES / "obc.bin").read_bytes()
    image = load(SAMPLES / "obc.bin", base=0x1000, range_=(0x1100, 1 << 32))
    assert (image.base, image.data) == (0x1100, whole[0x100:])
    image = load(SAMPLES / "obc.bin", base=0x1000, range_=(0x0FFE, 0x1004))
    assert (image.base, image.data, image.filled_bytes) == (0x0FFE, b"\xff\xff" + whole[:4], 2)
    assert image.segments == (AddressSpan(0x1000, 4),)


def test_a_range_beside_a_raw_binary_is_refused() -> None:
    with pytest.raises(ImageError, match="no bytes in the range 0x00000000:0x00000010"):
        load(SAMPLES / "obc.bin", base=0x1000, range_=(0, 0x10))


def test_a_range_chooses_one_part_of_a_sparse_file() -> None:
    path = BAD / "gigabytes.hex"
    image = load(path, range_=(0x9000_0000, 1 << 32))
    assert (image.base, image.size_bytes, image.filled_bytes) == (0x9000_0000, 16, 0)


def test_the_first_address_of_a_range_is_the_first_byte_sent() -> None:
    image = load(BAD / "gigabytes.hex", range_=(0x8FFF_FFF0, 0x9000_0004))
    assert image.data[:16] == b"\xff" * 16
    assert (image.base, image.size_bytes, image.filled_bytes) == (0x8FFF_FFF0, 20, 16)


def test_a_user_can_fill_a_larger_gap() -> None:
    image = load(BAD / "gap.hex", fill_gaps_up_to=8176)
    assert (image.size_bytes, image.filled_bytes) == (0x2010, 8176)
    assert image.data[16:0x2000] == b"\xff" * 8176


def test_the_default_limit_of_a_gap_is_four_kib() -> None:
    assert DEFAULT_FILL_GAPS_UP_TO == 4096


@each(
    "name, options, words",
    [
        ("obc.bin", {"format": "uf2"}, "no image format 'uf2'"),
        ("obc.bin", {"range_": (0, 16)}, "--base"),
        ("obc.bin", {"base": -1}, "not a 32-bit address"),
        ("obc.bin", {"base": 1 << 32}, "not a 32-bit address"),
        ("obc.bin", {"base": 0xFFFF_FFF0}, "does not end below 4 GiB"),
        ("wmc.hex", {"base": 0}, "a base is for a raw binary"),
        ("wmc.s19", {"base": 0x0800_4000}, "a base is for a raw binary"),
        ("obc.elf", {"base": 0}, "a base is for a raw binary"),
        ("wmc.hex", {"range_": (16, 16)}, "range"),
        ("wmc.hex", {"range_": (-1, 16)}, "range"),
        ("wmc.hex", {"range_": (0, (1 << 32) + 1)}, "range"),
        ("wmc.hex", {"fill_gaps_up_to": -1}, "gaps"),
        ("missing.hex", {}, "there is no file"),
        ("obc.bin/missing.hex", {}, "there is no file"),
        ("nul\0.hex", {}, "there is no file"),
    ],
)
def test_options_that_make_no_sense_are_wrong_usage(
    name: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(UsageError, match=words) as caught:
        load(SAMPLES / name, **options)
    assert caught.value.exit_code is ExitCode.USAGE


# -- files that cannot be read --------------------------------------------------------------------


def test_a_directory_is_refused() -> None:
    with pytest.raises(UsageError, match="is a directory"):
        load(SAMPLES)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_named_pipe_is_refused_without_waiting_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="is not a regular file"):
        load(tmp_path / "pipe")


@pytest.mark.parametrize("method", ["open", "stat"])
def test_an_unreadable_file_is_refused_with_the_system_s_reason(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, method, denied)
    with pytest.raises(ImageError, match="cannot be read: Permission denied"):
        load("app.hex" if method == "stat" else SAMPLES / "wmc.hex")


def test_a_file_that_fails_while_it_is_read_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(load_module, "_detect", failing)
    with pytest.raises(ImageError, match="cannot be read: Input/output error"):
        load(SAMPLES / "wmc.hex")


def test_a_binary_that_is_too_large_is_refused_by_its_size_alone(tmp_path: Path) -> None:
    path = write(tmp_path, "disk.bin", b"\x01")
    os.truncate(path, 1 << 40)
    with pytest.raises(ImageError, match=r"too large: 1099511627776 bytes"):
        load(path)
    with pytest.raises(ImageError, match=r"too large: 16777216 bytes"):
        load(path, base=0, range_=(0, 1 << 24))


def test_a_part_of_a_huge_binary_can_be_chosen(tmp_path: Path) -> None:
    path = write(tmp_path, "disk.bin", b"\x01\x02")
    os.truncate(path, 1 << 31)
    assert load(path, base=0, range_=(1, 3)).data == b"\x02\x00"


def test_a_text_or_elf_file_of_absurd_size_is_not_read(tmp_path: Path) -> None:
    path = write(tmp_path, "app.elf", b"\x7fELF")
    os.truncate(path, 1 << 40)
    with pytest.raises(ImageError, match="too large for an ELF file"):
        load(path)


def test_a_text_file_of_exactly_the_largest_size_is_read_and_one_byte_more_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = (SAMPLES / "wmc.hex").read_bytes()
    path = write(tmp_path, "app.hex", data)
    monkeypatch.setattr("flasher.image.load.FILE_MAX_SIZE", len(data))
    assert load(path).data == load(SAMPLES / "wmc.hex").data
    path = write(tmp_path, "app.hex", data + b"\n")
    with pytest.raises(ImageError, match="too large for an Intel HEX file"):
        load(path)


def test_the_largest_binary_is_loaded_and_one_byte_more_is_not(tmp_path: Path) -> None:
    path = write(tmp_path, "app.bin", b"\x01")
    os.truncate(path, IMAGE_MAX_SIZE)
    assert load(path).size_bytes == 8_388_480
    os.truncate(path, IMAGE_MAX_SIZE + 1)
    with pytest.raises(ImageError, match="too large: 8388481 bytes"):
        load(path)


# -- what is known about an image ---------------------------------------------------------------


def test_an_image_states_its_source_hash_and_version() -> None:
    image = load(str(SAMPLES / "bms.bin"))
    assert image.source == str(SAMPLES / "bms.bin")
    assert image.sha256 == hashlib.sha256(image.data).hexdigest()
    assert image.version == "V1r0r4_20220512"


def test_an_image_of_bytes_at_hand_is_as_one_from_a_file(tmp_path: Path) -> None:
    data = (SAMPLES / "obc.bin").read_bytes()
    path = write(tmp_path, "obc.bin", data)
    assert Image.from_bytes(data, source=str(path)) == load(path)
    assert Image.from_bytes(data, base=0x0800_2000).base == 0x0800_2000


@each(
    "data, version",
    [
        (b"\0\0V1r2r3_20240131\0", "V1r2r3_20240131"),
        (b"BMSV1r2r3_20240131.HW", "V1r2r3_20240131"),
        (b"V1r2r3_20240131..V1r2r3_20240131", "V1r2r3_20240131"),
        (b"V1r2r3_20240131 V1r2r4_20240131", None),
        (b"V1r12r3_20240131", "V1r12r3_20240131"),
        (b"V1r2r3_20241331", None),
        (b"V1r2r3_20240100", None),
        (b"V1.2.3_20240131", None),
        (b"V1r2r3_2024013", None),
        (b"", None),
    ],
)
def test_a_version_is_found_when_there_is_just_one(data: bytes, version: str | None) -> None:
    assert find_firmware_version(data) == version


# -- what it costs --------------------------------------------------------------------------------

MEASURE = """
import re, sys, time
from pathlib import Path
from flasher.errors import ImageError
from flasher.image.load import load
from flasher.image.plan import plan
from flasher.protocol.spec import BMS
start = time.process_time()
try:
    plan(load(sys.argv[1]), BMS, 250_000)
except ImageError as error:
    print(error.what)
status = Path("/proc/self/status").read_text()
print(time.process_time() - start, int(re.search(r"VmHWM:\\s*([0-9]+) kB", status)[1]) / 1024)
"""


def measure(path: Path) -> tuple[str, float, float]:
    """Output of loading and planning, seconds of processor time, megabytes at the peak.

    The peak is taken from /proc: getrusage counts what a child had of its parent before it became
    a program of its own.
    """
    if not Path("/proc/self/status").exists():
        pytest.skip("the system does not tell a process its peak of memory")
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], check=True, capture_output=True, text=True
    )
    *reported, figures = done.stdout.splitlines()
    seconds, megabytes = map(float, figures.split())
    return "".join(reported), seconds, megabytes


@pytest.mark.parametrize(
    ("content", "options"),
    [
        (b"", {}),
        (b":x", {}),
        (b"S1x", {}),
        (b"\x7fELFx", {}),
        (b"PK\x05", {}),
        (b"some\ntext\n", {}),
        (b"\x00\x01", {"range_": (0, 1)}),
        (b"\x00\x01", {"base": 0x1_0000_0000 - 1}),
        (None, {}),
    ],
)
def test_a_file_name_cannot_disturb_a_terminal(
    tmp_path: Path, content: bytes | None, options: dict[str, Any]
) -> None:
    path = tmp_path / "a\x1b[31m\nname.hex"
    if options:
        path = path.with_suffix(".bin")
    if content is not None:
        path.write_bytes(content)
    with pytest.raises((ImageError, UsageError)) as caught:
        load(path, **options)
    reported = str(caught.value)
    assert "\x1b" not in reported
    assert "a\\x1b[31m\\nname" in reported


@pytest.mark.slow
def test_a_file_that_spans_gigabytes_is_refused_quickly_and_in_little_memory() -> None:
    assert (BAD / "gigabytes.hex").stat().st_size == 132
    reported, seconds, megabytes = measure(BAD / "gigabytes.hex")
    assert "gap of 2281701360 bytes" in reported
    assert seconds < 1
    assert megabytes < 64


@pytest.mark.slow
def test_the_largest_binary_is_planned_in_time_and_memory(tmp_path: Path) -> None:
    path = write(tmp_path, "app.bin", bytes(range(251, 0, -1)) * 33_000)
    reported, seconds, megabytes = measure(path)
    assert not reported
    assert seconds < 4  # about 1 on an idle desktop; room for a loaded one
    assert megabytes < 150


@pytest.mark.slow
def test_a_hex_file_of_one_mebibyte_is_planned_in_little_memory(tmp_path: Path) -> None:
    lines = []
    for upper in range(16):
        head = struct.pack(">BHBH", 2, 0, 4, 0x0800 + upper)
        lines.append(f":{head.hex()}{-sum(head) & 0xFF:02x}")
        for offset in range(0, 0x1_0000, 16):
            body = struct.pack(">BHB16s", 16, offset, 0, bytes(range(offset & 0x7F, 200))[:16])
            lines.append(f":{body.hex()}{-sum(body) & 0xFF:02x}")
    lines.append(":00000001ff")
    reported, seconds, megabytes = measure(write(tmp_path, "app.hex", "\n".join(lines).encode()))
    assert not reported
    assert seconds < 4
    assert megabytes < 150


def test_a_file_has_so_many_lines_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (SAMPLES / "wmc.hex").read_bytes()
    path = write(tmp_path, "app.hex", text)
    monkeypatch.setattr(records, "LINES_MAX", text.count(b"\n"))
    assert load(path).size_bytes
    monkeypatch.setattr(records, "LINES_MAX", text.count(b"\n") - 1)
    with pytest.raises(ImageError, match="it has more than"):
        load(path)


def test_an_image_keeps_its_bytes_when_their_buffer_is_filled_again() -> None:
    buffer = bytearray(b"first")
    image = Image.from_bytes(buffer)  # type: ignore[arg-type]
    buffer[:] = b"other"
    assert image.data == b"first"


@pytest.mark.parametrize("base", [-1, 0xFFFF_FFF1, 1 << 32])
def test_bytes_in_memory_have_32_bit_addresses(base: int) -> None:
    assert Image.from_bytes(bytes(16), base=0xFFFF_FFF0).base == 0xFFFF_FFF0
    with pytest.raises(UsageError, match=f"not inside 32-bit addresses with the base {base:#x}"):
        Image.from_bytes(bytes(16), base=base)


def test_a_raw_binary_may_end_with_the_last_address(tmp_path: Path) -> None:
    path = tmp_path / "top.bin"
    path.write_bytes(b"\1\2" * 8)
    assert load(path, base=0xFFFF_FFF0).size_bytes == 16
    with pytest.raises(UsageError, match="does not end below 4 GiB with the base 0xFFFFFFF1"):
        load(path, base=0xFFFF_FFF1)


def test_a_part_in_the_middle_of_a_raw_binary_is_read_and_no_more(tmp_path: Path) -> None:
    path = tmp_path / "whole.bin"
    path.write_bytes(bytes(range(256)))
    part = load(path, base=0x1000, range_=(0x1010, 0x1020), allow_outside_vector=True)
    assert (part.data, part.base) == (bytes(range(16, 32)), 0x1010)
    path.write_bytes(bytes(IMAGE_MAX_SIZE + 300))
    with pytest.raises(ImageError, match=f" {IMAGE_MAX_SIZE + 44} bytes to send"):
        load(path, base=0x1000, range_=(0x1100, 0x8000_0000))


def test_a_limit_of_zero_fills_no_gap() -> None:
    with pytest.raises(ImageError):
        load(SAMPLES / "bad" / "gap.hex", fill_gaps_up_to=0)
    for name in ("bms.hex", "bms.bin"):
        assert load(SAMPLES / name, fill_gaps_up_to=0).filled_bytes == 0
    with pytest.raises(UsageError, match="filled up to -1 bytes"):
        load(SAMPLES / "bms.hex", fill_gaps_up_to=-1)
