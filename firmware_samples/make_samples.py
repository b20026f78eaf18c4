"""Make the firmware samples and the bad files again, bit for bit.

Usage: python make_samples.py [FOLDER]

The samples are no programs: a Cortex-M vector table, the device's name and a version of the
document's form, and bytes that look like Thumb code, so that time on the wire is realistic. The
bad files are tiny, one for each way in which a firmware file is refused; the name says which.

So that no sample gets into a real device, all of them carry a mark by which flasher knows them
(flasher/image/sample.py): in the reserved words of the vector table, and all over the code, so that
any part of a sample that could be taken for a program has it too.
"""

from __future__ import annotations

import random
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

# Facts of the samples; the names are those of the boot versions (appendix 3).
BMS_BASE, BMS_SIZE = 0x0800_8000, 78_351
WMC_BASE, WMC_TABLE_SIZE, WMC_GAP, WMC_CODE_SIZE = 0x0800_4000, 0x188, 0x878, 0x2400
OBC_BASE, OBC_SIZE = 0x0800_2000, 4_000
STATION_SIZE = 24_000
STACK_TOP = 0x2000_5000
IDENTITY_SIZE = 32
MARK = b"#flasher:sample#"
MARK_DISTANCE = 256
RESERVED_WORDS_AT = 0x1C
"""Four words of a Cortex-M vector table have no meaning: the size of the mark."""

_THUMB = (0x4600, 0x6800, 0x6000, 0x2000, 0xB500, 0xBD00, 0xD000, 0xE000, 0x4400, 0xF000, 0x1C00)


def code(seed: int, size: int) -> bytes:
    """Halfwords drawn from the shapes of Thumb instructions, some literals, and marks."""
    draw = random.Random(seed)  # noqa: S311  reproducible, no secret
    halfwords = bytearray()
    while len(halfwords) < size:
        shape = _THUMB[draw.getrandbits(16) % len(_THUMB)]
        halfwords += struct.pack("<H", shape | draw.getrandbits(9))
        if draw.getrandbits(5) == 0:
            halfwords += struct.pack("<I", 0x4000_0000 | draw.getrandbits(16))
    for at in range(0, size - len(MARK) + 1, MARK_DISTANCE):
        halfwords[at : at + len(MARK)] = MARK
    return bytes(halfwords[:size])


def vector_table(base: int, size: int, entry_offset: int) -> bytes:
    """Stack pointer, reset vector and handlers that lie one behind the other from the entry on."""
    words = [STACK_TOP]
    words += [(base + entry_offset + 4 * index) | 1 for index in range(size // 4 - 1)]
    table = bytearray(struct.pack(f"<{len(words)}I", *words))
    table[RESERVED_WORDS_AT : RESERVED_WORDS_AT + len(MARK)] = MARK
    return bytes(table)


def identity(name: str, version: str) -> bytes:
    """The device's name and the firmware version, as texts in a fixed place."""
    return f"{name}\0{version}\0".encode("ascii").ljust(IDENTITY_SIZE, b"\0")


def program(name: str, version: str, base: int, size: int, seed: int) -> bytes:
    """An image without gaps: vector table, identity, code."""
    table_size = 0x100
    table = vector_table(base, table_size, table_size + IDENTITY_SIZE)
    head = table + identity(name, version)
    return head + code(seed, size - len(head))


# -- record formats, written here and not by the libraries that read them -----------------------


def hex_record(kind: int, address: int, data: bytes = b"") -> str:
    """One Intel HEX record."""
    body = bytes((len(data),)) + address.to_bytes(2, "big") + bytes((kind,)) + data
    return f":{(body + bytes((-sum(body) & 0xFF,))).hex().upper()}"


def hex_data(start: int, data: bytes, width: int = 16) -> list[str]:
    """Data records, with an extended linear address wherever its upper half changes."""
    lines, upper = [], None
    for at in range(0, len(data), width):
        address = start + at
        if address >> 16 != upper:
            upper = address >> 16
            lines.append(hex_record(4, 0, upper.to_bytes(2, "big")))
        lines.append(hex_record(0, address & 0xFFFF, data[at : at + width]))
    return lines


HEX_END = hex_record(1, 0)


def s_record(kind: int, address: int, data: bytes = b"", address_size: int = 4) -> str:
    """One S-record."""
    body = address.to_bytes(address_size, "big") + data
    body = bytes((len(body) + 1,)) + body
    return f"S{kind}{(body + bytes((~sum(body) & 0xFF,))).hex().upper()}"


def s_data(start: int, data: bytes, width: int = 16) -> list[str]:
    """S3 records."""
    return [s_record(3, start + at, data[at : at + width]) for at in range(0, len(data), width)]


S_HEADER = s_record(0, 0, b"sample", 2)
S_END = s_record(7, 0)


def lines(records: Iterable[str]) -> bytes:
    """A text file."""
    return "".join(f"{record}\n" for record in records).encode("ascii")


def elf_file(parts: list[tuple[int, bytes]], *, sections: bool = True, bits: int = 32) -> bytes:
    """A little-endian ELF file for ARM: one loadable segment with one section for each part."""
    header_size, program_size, section_size = 52, 32, 40
    names = b"\0.part\0.shstrtab\0"
    content_at = header_size + program_size * len(parts)
    programs, table, content = b"", bytes(section_size), b""
    for address, data in parts:
        at = content_at + len(content)
        size = len(data)
        programs += struct.pack("<8I", 1, at, address, address, size, size, 5, 4)
        table += struct.pack("<10I", 1, 1, 6, address, at, size, 0, 0, 4, 0)
        content += data
    names_at = content_at + len(content)
    table += struct.pack("<10I", 7, 3, 0, 0, names_at, len(names), 0, 0, 1, 0)
    count = len(parts) + 2 if sections else 0
    ident = b"\x7fELF" + bytes((2 if bits == 64 else 1, 1, 1))
    header = struct.pack(
        "<16s2H5I6H", ident, 2, 40, 1, parts[0][0] if parts else 0,
        header_size if parts else 0, names_at + len(names) if sections else 0, 0x0500_0000,
        header_size, program_size, len(parts), section_size, count, max(count - 1, 0),
    )  # fmt: skip
    return header + programs + content + (names + table if sections else b"")


# -- the files ------------------------------------------------------------------------------------


def good_files() -> dict[str, bytes]:
    """Name to content of every sample."""
    code_at = WMC_BASE + WMC_TABLE_SIZE + WMC_GAP
    wmc_table = vector_table(WMC_BASE, WMC_TABLE_SIZE, code_at - WMC_BASE + IDENTITY_SIZE)
    wmc_code = identity("WMC", "V2r1r0_20230117")
    wmc_code += code(2, WMC_CODE_SIZE - len(wmc_code))
    bms = program("BMS", "V1r0r4_20220512", BMS_BASE, BMS_SIZE, 1)
    obc = program("PBU", "V1r2r0_20221103", OBC_BASE, OBC_SIZE, 3)
    return {
        "bms.hex": lines((*hex_data(BMS_BASE, bms), HEX_END)),
        "bms.bin": bms,
        "wmc.hex": lines((*hex_data(WMC_BASE, wmc_table), *hex_data(code_at, wmc_code), HEX_END)),
        "wmc.s19": lines(
            (S_HEADER, *s_data(WMC_BASE, wmc_table), *s_data(code_at, wmc_code), S_END)
        ),
        "obc.bin": obc,
        "obc.elf": elf_file([(OBC_BASE, obc[:0x100]), (OBC_BASE + 0x100, obc[0x100:])]),
        # For the station: small, so that a unit takes seconds.
        "station/bms.bin": program("BMS", "V1r0r5_20230301", BMS_BASE, STATION_SIZE, 6),
    }


def _bad_hex(base: int, first: bytes, second: bytes) -> dict[str, bytes]:
    one, two = hex_data(base, first), hex_data(base + 16, second)[1:]
    good = [*one, *two, HEX_END]
    damaged = one[1][:20] + ("0" if one[1][20] != "0" else "1") + one[1][21:]
    linear = [hex_record(4, 0, b"\xff\xff"), hex_record(0, 0xFFF8, first)]
    return {
        "no_data.hex": lines([HEX_END]),
        "check_sum.hex": lines([one[0], damaged, *two, HEX_END]),
        "no_end.hex": lines([*one, *two]),
        "after_end.hex": lines([*good, *two]),
        "overlap.hex": lines([*one, *two, *hex_data(base + 8, second), HEX_END]),
        "gap.hex": lines([*one, *hex_data(base + 0x2000, second), HEX_END]),
        "gigabytes.hex": lines([*one, *hex_data(0x9000_0000, second), HEX_END]),
        "cut_line.hex": lines([one[0], one[1][:-6], *two, HEX_END]),
        "odd_digit.hex": lines([one[0], one[1][:-1], *two, HEX_END]),
        "no_digit.hex": lines([one[0], one[1].replace("0", "O", 1), *two, HEX_END]),
        "no_colon.hex": lines([one[0], one[1][1:], *two, HEX_END]),
        "record_type.hex": lines([*one, hex_record(6, 0), HEX_END]),
        "record_size.hex": lines([hex_record(4, 0, b"\x08"), *two, HEX_END]),
        "extended_address.hex": lines([hex_record(4, 4, b"\x08\x00"), *two, HEX_END]),
        "past_segment.hex": lines([hex_record(2, 0, b"\x10\x00"), linear[1], HEX_END]),
        "past_last_address.hex": lines([*linear, HEX_END]),
        "no_line_ends.hex": "".join(good * 12).encode("ascii"),
        "no_ascii.hex": lines(good).replace(b"\n:", b"\n\xbf:", 1),
        "hex_inside.bin": lines([one[0], damaged, *two, HEX_END]),
        "lost_first_line.bin": lines([one[1][9:], *two * 4, HEX_END]),
        "outside_vector.hex": lines(
            [*hex_data(base, struct.pack("<4I", STACK_TOP, 0x0800_0101, 0, 0) + second), HEX_END]
        ),
    }


def _bad_s_records(base: int, first: bytes, second: bytes) -> dict[str, bytes]:
    one, two = s_data(base, first)[0], s_data(base + 16, second)[0]
    damaged = one[:20] + ("0" if one[20] != "0" else "1") + one[21:]
    return {
        "no_data.s19": lines([S_HEADER, S_END]),
        "check_sum.s19": lines([S_HEADER, damaged, two, S_END]),
        "no_end.s19": lines([S_HEADER, one, two]),
        "after_end.s19": lines([S_HEADER, one, S_END, two]),
        "overlap.s19": lines([one, *s_data(base + 8, second), S_END]),
        "gap.s19": lines([one, *s_data(base + 0x2000, second), S_END]),
        "too_many_packets.s19": lines([one, *s_data(base + 65_535 * 128, second), S_END]),
        "count.s19": lines([one, s_record(5, 2, b"", 2), S_END]),
        "cut_line.s19": lines([one[:-2], two, S_END]),
        "odd_digit.s19": lines([one[:-1], two, S_END]),
        "record_type.s19": lines([one, s_record(4, 0, b"", 2), S_END]),
        "record_size.s19": lines([one, s_record(7, base, b"\0")]),
        "second_header.s19": lines([S_HEADER, one, "S0" + two[2:], S_END]),
        "no_s.s19": lines([one, two[1:], S_END]),
        "past_last_address.s19": lines([s_record(3, 0xFFFF_FFF8, first), S_END]),
    }


def _bad_elf(base: int, first: bytes, second: bytes) -> dict[str, bytes]:
    good = elf_file([(base, first), (base + 16, second)])
    past = bytearray(good)
    past[52 + 16 : 52 + 20] = (len(good)).to_bytes(4, "little")
    section = bytearray(good)
    at = len(good) - 2 * 40
    section[at + 20 : at + 24] = (len(second) + 4).to_bytes(4, "little")
    return {
        "overlap.elf": elf_file([(base, first), (base + 8, second)]),
        "cut.elf": good[:60],
        "cut_header.elf": good[:20],
        "not.elf": b"\0" * 64,
        "no_segment.elf": elf_file([]),
        "no_section.elf": elf_file([(base, first)], sections=False),
        "64_bit.elf": elf_file([(base, first)], bits=64),
        "segment_past_file.elf": bytes(past),
        "section_past_segment.elf": bytes(section),
        "past_last_address.elf": elf_file([(0xFFFF_FFF8, first)]),
        "gap.elf": elf_file([(base, first), (base + 0x2000, second)]),
    }


def bad_files() -> dict[str, bytes]:
    """Name to content of every file that is refused."""
    base, first, second = 0x0800_0000, MARK, MARK
    return {
        "empty.bin": b"",
        "text.bin": b"Firmware of the BMS: see the release page.\n" + MARK + b"\n",
        "zip.bin": b"PK\x03\x04" + bytes(26) + MARK,
        "utf_16.bin": ("\ufeff" + ":00000001FF\n" * 3).encode("utf-16-le") + MARK,
        **_bad_hex(base, first, second),
        **_bad_s_records(base, first, second),
        **_bad_elf(base, first, second),
    }


def make(folder: Path) -> None:
    """Write all files below `folder`."""
    bad = folder / "bad"
    bad.mkdir(parents=True, exist_ok=True)
    (folder / "station").mkdir(exist_ok=True)
    for name, content in good_files().items():
        (folder / name).write_bytes(content)
    for name, content in bad_files().items():
        (bad / name).write_bytes(content)


if __name__ == "__main__":
    make(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
