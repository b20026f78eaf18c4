"""ELF files header by header: which of their bytes are the program's."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable

import pytest

from flasher.errors import ImageError
from flasher.image.elf import EM_ARM, machine_name, machine_of, read
from flasher.image.segments import SparseBytes
from tests.loops import each

BASE = 0x0800_2000
CONTENT = bytes(range(1, 65))
LOAD, NOTE_SEGMENT = 1, 4
PROGRAM, NO_BITS, NOTE, INIT_ARRAY = 1, 8, 7, 14
WRITE, ALLOCATED, EXECUTED = 1, 2, 4
Load = tuple[int, int, int, int]
"""Kind, offset in the content, address, size."""
Section = tuple[int, int, int, int]
"""Kind, flags, offset in the content, size."""
WHOLE: list[Section] = [(PROGRAM, ALLOCATED, 0, 64)]


def elf_file(
    loads: list[Load], sections: list[Section], *, order: str = "<", content: bytes = CONTENT
) -> bytes:
    """A file for ARM: headers, then the content."""
    programs_at = 52
    sections_at = programs_at + 32 * len(loads)
    content_at = sections_at + 40 * len(sections)
    ident = b"\x7fELF\x01" + (b"\x01" if order == "<" else b"\x02") + b"\x01"
    header = struct.pack(
        order + "16s2H5I6H",
        ident, 2, EM_ARM, 1, BASE, programs_at, sections_at, 0,
        52, 32, len(loads), 40, len(sections), 0,
    )  # fmt: skip
    for kind, offset, address, size in loads:
        header += struct.pack(
            order + "8I", kind, content_at + offset, address ^ 0xFFFF, address, size, size, 5, 4
        )
    for kind, flags, offset, size in sections:
        header += struct.pack(
            order + "10I", 1, kind, flags, BASE, content_at + offset, size, 0, 0, 4, 0
        )
    return header + content


def read_back(file: bytes) -> tuple[bytes, int]:
    """The bytes of the program, and where they begin."""
    sparse = SparseBytes("app.elf")
    read(io.BytesIO(file), "app.elf", sparse)
    return sparse.join(1000)


@each("order", ["<", ">"])
def test_both_byte_orders_are_read(order: str) -> None:
    file = elf_file([(LOAD, 0, BASE, 64)], WHOLE, order=order)
    assert read_back(file) == (CONTENT, BASE)
    assert machine_of(file) == EM_ARM


@each(
    "kind, flags, is_program",
    [
        (PROGRAM, ALLOCATED, True),
        (PROGRAM, ALLOCATED | EXECUTED, True),
        (INIT_ARRAY, ALLOCATED | WRITE, True),
        (NOTE, ALLOCATED, True),
        (NO_BITS, ALLOCATED | WRITE, False),
        (PROGRAM, WRITE | EXECUTED, False),
        (PROGRAM, 0, False),
    ],
)
def test_a_section_that_is_allocated_and_has_bytes_is_a_part_of_the_program(
    kind: int, flags: int, *, is_program: bool
) -> None:
    file = elf_file([(LOAD, 0, BASE, 64)], [(PROGRAM, ALLOCATED, 0, 8), (kind, flags, 8, 8)])
    assert read_back(file) == (CONTENT[: 16 if is_program else 8], BASE)


def test_sections_of_two_segments_lie_at_the_physical_addresses_of_each() -> None:
    loads = [(NOTE_SEGMENT, 0, 0, 64), (LOAD, 0, BASE, 16), (LOAD, 16, BASE + 32, 16)]
    sections: list[Section] = [
        (PROGRAM, ALLOCATED, 20, 4),
        (PROGRAM, ALLOCATED, 4, 12),
        (PROGRAM, ALLOCATED, 16, 4),
        (PROGRAM, ALLOCATED, 24, 0),
        (PROGRAM, ALLOCATED, 32, 4),  # in no segment
    ]
    gap = b"\xff" * 16
    assert read_back(elf_file(loads, sections)) == (CONTENT[4:16] + gap + CONTENT[16:24], BASE + 4)


@each("at, size", [(0, 65), (63, 2), (8, 57)])
def test_a_section_that_ends_past_its_segment_is_refused(at: int, size: int) -> None:
    file = elf_file(
        [(LOAD, 0, BASE, 64)], [(PROGRAM, ALLOCATED, at, size)], content=CONTENT + bytes(8)
    )
    with pytest.raises(ImageError, match="a section is outside its program header"):
        read_back(file)


def test_a_segment_may_end_with_the_file_and_with_the_last_address() -> None:
    assert read_back(elf_file([(LOAD, 0, 0xFFFF_FFC0, 64)], WHOLE)) == (CONTENT, 0xFFFF_FFC0)
    with pytest.raises(ImageError, match="program header 0 runs past address 0xFFFFFFFF"):
        read_back(elf_file([(LOAD, 0, 0xFFFF_FFC1, 64)], WHOLE))
    with pytest.raises(ImageError, match="program header 1 points past the end of the file"):
        read_back(elf_file([(NOTE_SEGMENT, 0, 0, 1), (LOAD, 0, BASE, 65)], WHOLE))


def test_sections_that_overlap_are_taken_once() -> None:
    """However many there are: each is compared with nothing."""

    class Counting(SparseBytes):
        taken = 0

        def add(self, start: int, data: bytes, place: Callable[[int], str]) -> None:
            self.taken += len(data)
            super().add(start, data, place)

    spread: list[Section] = [
        (PROGRAM, ALLOCATED, 0, 40),
        (PROGRAM, ALLOCATED, 8, 8),
        (PROGRAM, ALLOCATED, 12, 40),
        (PROGRAM, ALLOCATED, 12, 52),
    ]
    sparse = Counting("app.elf")
    read(io.BytesIO(elf_file([(LOAD, 0, BASE, 64)], spread)), "app.elf", sparse)
    assert sparse.join(0) == (CONTENT, BASE)
    assert sparse.taken == 64


@each("programs, sections, is_refused", [(64, 4096, False), (65, 1, True), (1, 4097, True)])
def test_no_more_headers_are_read_than_any_program_has(
    programs: int, sections: int, *, is_refused: bool
) -> None:
    loads = [(LOAD, 0, BASE, 64)] + [(NOTE_SEGMENT, 0, 0, 0)] * (programs - 1)
    file = elf_file(loads, WHOLE + [(NOTE, 0, 0, 0)] * (sections - 1))
    if is_refused:
        with pytest.raises(ImageError, match=f"has {programs} program headers and {sections} sec"):
            read_back(file)
    else:
        assert read_back(file) == (CONTENT, BASE)


@each(
    "machine, name",
    [
        (2, "SPARC"),
        (3, "x86"),
        (8, "MIPS"),
        (20, "PowerPC"),
        (36, "V850"),
        (42, "SuperH"),
        (62, "x86-64"),
        (83, "AVR"),
        (87, "V850"),
        (94, "Xtensa"),
        (105, "MSP430"),
        (173, "RX"),
        (183, "AArch64"),
        (197, "RL78"),
        (243, "RISC-V"),
        (999, "ELF machine 999"),
        (None, "ELF machine None"),
    ],
)
def test_a_processor_is_named_by_its_number_in_the_elf_standard(
    machine: int | None, name: str
) -> None:
    assert machine_name(machine) == name


def test_of_a_header_that_is_cut_off_before_it_the_processor_is_not_known() -> None:
    file = elf_file([(LOAD, 0, BASE, 64)], WHOLE)
    assert machine_of(file[:20]) == EM_ARM
    assert machine_of(file[:19]) is None
    assert machine_of(file[:5] + b"\x03" + file[6:]) is None


def test_a_header_alone_is_whole_and_holds_no_program() -> None:
    header = elf_file([], [], content=b"")
    assert len(header) == 52
    with pytest.raises(ImageError, match="has no loadable segment"):
        read_back(header)
    with pytest.raises(ImageError, match="its header is truncated"):
        read_back(header[:-1])
