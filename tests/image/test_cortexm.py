"""The vector table at the start of an image, and the merged-file rule of R8."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from flasher.errors import ImageError
from flasher.image.cortexm import VectorTable, check_starts_inside, vector_table
from flasher.image.image import Image
from flasher.image.load import load
from tests.loops import each

SAMPLES = Path(__file__).parents[2] / "firmware_samples"
BASE = 0x0800_4000
STACK = 0x2000_5000


def image(*words: int, base: int | None = BASE, size: int = 0x1000) -> Image:
    data = struct.pack(f"<{len(words)}I", *words).ljust(size, b"\0")
    return Image.from_bytes(data, base=base, source="app.bin")


@each("name", ["wmc.hex", "obc.elf"])
def test_the_samples_look_like_programs(name: str) -> None:
    table = vector_table(load(SAMPLES / name))
    assert table is not None
    assert table.plausible
    assert not table.problems
    assert table.stack_pointer == STACK


def test_an_image_shorter_than_two_words_has_no_vector_table() -> None:
    assert vector_table(Image.from_bytes(bytes(7), base=BASE)) is None
    check_starts_inside(Image.from_bytes(bytes(7), base=BASE))


def test_two_words_are_enough() -> None:
    table = vector_table(image(STACK, BASE + 5, size=8))
    assert table is not None
    assert table.plausible
    assert not table.problems
    assert table.entry == BASE + 4


@each(
    "stack_pointer, plausible",
    [
        (0x2000_0004, True),
        (0x2000_0000, True),  # the end of a RAM in the code region
        (0x1000_2000, True),
        (0x3800_0000, True),
        (0x4000_0000, True),
        (0x4000_0004, False),
        (0x1000_0000, False),
        (0x2000_0FFF, False),
        (0x0800_4000, False),
        (0, False),
        (0xFFFF_FFFF, False),
    ],
)
def test_a_stack_pointer_is_an_aligned_end_of_a_ram(stack_pointer: int, *, plausible: bool) -> None:
    table = vector_table(image(stack_pointer, BASE + 0x101))
    assert table is not None
    assert table.stack_pointer_plausible is plausible
    assert table.plausible is plausible
    assert any("stack pointer" in problem for problem in table.problems) is not plausible


@each(
    "reset, words",
    [(BASE + 0x100, "no Thumb bit"), (0xFFFF_FFFF, "is empty"), (1, "is empty")],
)
def test_a_reset_vector_is_a_thumb_address(reset: int, words: str) -> None:
    table = vector_table(image(STACK, reset))
    assert table is not None
    assert not table.plausible
    assert words in table.problems[0]


@each("reset", [BASE + 1, BASE + 0xFFF])
def test_a_program_that_starts_at_its_first_or_last_halfword_is_accepted(reset: int) -> None:
    program = image(STACK, reset)
    check_starts_inside(program)
    table = vector_table(program)
    assert table is not None
    assert not table.problems


@each("reset", [BASE - 1, BASE + 0x1001, 0x0800_0101, 0])
def test_a_program_that_starts_outside_of_itself_is_refused(reset: int) -> None:
    with pytest.raises(ImageError) as caught:
        check_starts_inside(image(STACK, reset))
    message = str(caught.value)
    assert f"0x{reset:08X}" in message
    assert "0x08004000..0x08004FFF" in message
    assert "--allow-outside-vector" in message
    assert "Correct --base" in message
    table = vector_table(image(STACK, reset))
    assert table is not None
    assert any("points outside" in problem for problem in table.problems)


def test_what_does_not_look_like_a_cortex_m_is_not_refused() -> None:
    check_starts_inside(image(0xDEAD_BEEF, 0x0800_0101))


def test_without_a_base_nothing_is_refused_and_that_is_reported() -> None:
    program = image(STACK, 0x0800_0101, base=None)
    check_starts_inside(program)
    table = vector_table(program)
    assert table is not None
    assert table.plausible
    assert not table.problems
    assert "--base" in table.notes[0]


def test_without_a_base_vectors_further_apart_than_the_image_is_long_are_reported() -> None:
    near = vector_table(image(STACK, BASE + 1, BASE + 0x1001 - 2, 0, base=None))
    far = vector_table(image(STACK, BASE + 1, 0, BASE + 0x1001, base=None))
    assert near is not None
    assert far is not None
    assert not near.problems
    assert "too far apart" in far.problems[0]


@each("apart, is_near", [((1 << 24) - 2, True), (1 << 24, False)])
def test_vectors_of_one_program_lie_within_16_mib(apart: int, *, is_near: bool) -> None:
    """More than the program memory of any device has."""
    table = known(vector_table(image(STACK, BASE + 1, 0, BASE + 1 + apart)))
    assert table.plausible is is_near
    assert table.problems == (
        ()
        if is_near
        else ("its reset, NMI and hard fault vectors are further apart than the memory reaches",)
    )


def test_a_vector_table_at_an_odd_place_is_reported() -> None:
    table = vector_table(image(STACK, BASE + 0x101, base=BASE + 0x10))
    assert table is not None
    assert not table.plausible
    assert "cannot be at 0x08004010" in table.problems[0]


def merged(count: int) -> Image:
    """A boot loader and `count` more programs after it."""
    data = bytearray()
    for index in range(count + 1):
        at = BASE + index * 0x400
        data += struct.pack("<4I", STACK, *(at + 0x101 + 4 * n for n in range(3))).ljust(0x400)
    return Image.from_bytes(bytes(data), base=BASE)


def test_a_second_program_inside_the_image_is_reported() -> None:
    table = vector_table(merged(1))
    assert table is not None
    assert not table.problems
    assert "another vector table is at 0x08004400:" in table.notes[0]
    alone = vector_table(merged(0))
    assert alone is not None
    assert not alone.notes


def test_a_vector_table_in_the_last_bytes_is_seen() -> None:
    at = BASE + 0x200
    first = struct.pack("<2I", STACK, BASE + 0x101).ljust(0x200, b"\0")
    last = struct.pack("<4I", STACK, at + 5, at + 9, at + 13)
    table = vector_table(Image.from_bytes(first + last, base=BASE))
    assert table is not None
    assert "0x08004200" in table.notes[0]


def test_no_more_than_four_further_programs_are_named() -> None:
    table = vector_table(merged(6))
    assert table is not None
    assert table.notes[0].count("0x") == 4


@each("nothing", [0, 0xFFFF_FFFF])
@each("base", [BASE, None])
def test_a_vector_that_is_empty_lies_nowhere(nothing: int, base: int | None) -> None:
    """Zero, or erased: it counts in no distance of the vectors from each other."""
    table = vector_table(image(STACK, BASE + 5, nothing, nothing, base=base))
    assert table is not None
    assert table.plausible
    assert not table.problems


def test_of_an_image_that_is_no_program_no_more_is_reported_than_that() -> None:
    """Neither that its base is odd, nor that it contains another program, nor how to judge it."""
    inner = (STACK, BASE + 0x301, BASE + 0x303, BASE + 0x305)
    words = (0, BASE + 5, *(0,) * 126, *inner)
    for base in (BASE, BASE + 4, None):
        table = vector_table(image(*words, base=base))
        assert table is not None
        problem = "the first word, 0x00000000, is not a stack pointer of a Cortex-M"
        assert table.problems == (problem,)
        assert table.notes == ()
    (note,) = known(vector_table(image(STACK, *words[1:]))).notes
    assert f"0x{BASE + 512:08X}" in note


@each(
    "nmi, hard_fault, is_odd",
    [(BASE + 9, BASE + 13, False), (BASE + 8, BASE + 13, True), (BASE + 9, BASE + 12, True),
     (0, BASE + 13, False), (BASE + 8, 0, True)],
)  # fmt: skip
def test_a_handler_without_thumb_bit_is_none(nmi: int, hard_fault: int, *, is_odd: bool) -> None:
    table = known(vector_table(image(STACK, BASE + 5, nmi, hard_fault)))
    problem = "its NMI or hard fault vector has no Thumb bit"
    assert table.problems == ((problem,) if is_odd else ())
    assert table.plausible is not is_odd


END = BASE + 0x1000


@each(
    "vectors, is_program",
    [
        ((0x205, 0x209, 0x20D), True),
        ((0x204, 0x209, 0x20D), False),  # no Thumb bit
        ((0x205, 0x208, 0x20D), False),
        ((0x205, 0x209, 0x1FD), False),  # before it
        ((0x201, 0x209, 0x20D), True),
        ((0x1FF, 0x209, 0x20D), False),
        ((0xFFF, 0x209, 0x20D), True),
        ((0x1001, 0x209, 0x20D), False),  # after the image
    ],
)
def test_a_second_program_has_all_its_handlers_inside_the_image(
    vectors: tuple[int, ...], *, is_program: bool
) -> None:
    inner = (STACK, *(BASE + each_offset for each_offset in vectors))
    table = known(vector_table(image(STACK, BASE + 5, *(0,) * 126, *inner)))
    assert bool(table.notes) is is_program


def test_an_image_that_starts_outside_names_the_check_that_refused() -> None:
    with pytest.raises(ImageError) as refused:
        check_starts_inside(image(STACK, END + 5))
    assert refused.value.waiver == "outside-vector"


def known(table: VectorTable | None) -> VectorTable:
    assert table is not None
    return table
