"""Cortex-M vector tables: whether an image begins with one, and starts inside itself (R8).

A vector table begins with the initial stack pointer and the reset vector, an address with bit 0 set
(Thumb). The protocol does not require a Cortex-M: `flasher.image.plausible` refuses an image
without vector table unless waived. This module refuses an image whose reset vector points outside
it: part of a program, or the wrong part of a merged file.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct
from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.image.image import Image

_VECTORS: Final = Struct("<4I")
"""Initial stack pointer; reset, NMI and hard fault vectors."""
_FIRST_TWO_SIZE: Final = 8
_RAM_START: Final = 0x1000_0000
_RAM_END: Final = 0x4000_0000
"""Code RAM (core-coupled, or of some makers) and SRAM region. A stack pointer starts at the end of
a RAM and grows down: the start of the area is outside, its end inside."""
_THUMB: Final = 1
_MEMORY_SIZE: Final = 1 << 24
"""More than the program memory of any device: the handlers of a program are closer together."""
_ERASED: Final = 0xFFFF_FFFF
_EMPTY: Final = (0, _ERASED)
_BASE_ALIGNMENT: Final = 128
"""Minimum alignment of a vector table."""
_INNER_ALIGNMENT: Final = 512
"""Alignment at which a second vector table is searched: applications start at a flash page."""
_INNER_NAMED_MAX: Final = 4


@dataclass(frozen=True)
class VectorTable:
    """Stack pointer and reset vector of an image, and the problems found with them."""

    stack_pointer: int
    reset_vector: int
    plausible: bool
    """The words look like a Cortex-M vector table at this address. Whether the program starts
    inside the image is a check of its own."""
    problems: tuple[str, ...]
    notes: tuple[str, ...] = ()
    """Checks that could not be made, and why."""

    @property
    def stack_pointer_plausible(self) -> bool:
        return _is_stack_pointer(self.stack_pointer)

    @property
    def entry(self) -> int:
        """Start address of the program: the reset vector without its Thumb bit."""
        return self.reset_vector & ~_THUMB


def vector_table(image: Image) -> VectorTable | None:
    """Read the vector table at the start of an image; None if the image is shorter."""
    if image.size_bytes < _FIRST_TWO_SIZE:
        return None
    head = image.data[: _VECTORS.size]
    stack_pointer, reset, *others = _VECTORS.unpack(head.ljust(_VECTORS.size, b"\0"))
    problems = []
    if not _is_stack_pointer(stack_pointer):
        problems.append(
            f"the first word, 0x{stack_pointer:08X}, is not a stack pointer of a Cortex-M"
        )
    if not reset & _THUMB:
        problems.append(f"the reset vector, 0x{reset:08X}, has no Thumb bit")
    elif reset in (_THUMB, _ERASED):
        problems.append(f"the reset vector, 0x{reset:08X}, is empty")
    if any(not vector & _THUMB and vector for vector in others):
        problems.append("its NMI or hard fault vector has no Thumb bit")
    looks_right = not problems
    if looks_right:
        problems += _too_far_apart([reset, *(each for each in others if each not in _EMPTY)], image)
    notes = []
    inner = _inner_tables(image)
    if looks_right and inner:
        notes.append(
            f"another vector table is at {', '.join(f'0x{address:08X}' for address in inner)}: "
            "if that is the application, the file contains more (choose it with --range START:END)"
        )
    entry = reset & ~_THUMB
    outside = []
    if image.base is not None:
        if not image.base <= entry < image.base + image.size_bytes:
            outside.append(
                f"the reset vector, 0x{reset:08X}, points outside the image, "
                f"0x{image.base:08X}..0x{image.base + image.size_bytes - 1:08X}"
            )
        if looks_right and image.base % _BASE_ALIGNMENT:
            problems.append(f"a vector table cannot be at 0x{image.base:08X}")
    elif looks_right:
        notes.append(
            "a raw binary has no address: checking that its reset vector points into it "
            "needs --base"
        )
    return VectorTable(stack_pointer, reset, not problems, (*problems, *outside), tuple(notes))


def _too_far_apart(vectors: list[int], image: Image) -> list[str]:
    """Problem of vectors that point too far apart: a list of one or none."""
    reach = image.size_bytes if image.base is None else _MEMORY_SIZE
    if max(vectors) - min(vectors) < reach:
        return []
    if image.base is None:
        return ["its reset, NMI and hard fault vectors are too far apart: it is part of a program"]
    return ["its reset, NMI and hard fault vectors are further apart than the memory reaches"]


def check_starts_inside(image: Image) -> None:
    """Check that an image contains its own entry point, against merged files (R8).

    Raises ImageError if the image has a Cortex-M stack pointer and a known base, but its reset
    vector points outside the image. Images without base are not checked.
    """
    table = vector_table(image)
    if table is None or image.base is None or not table.stack_pointer_plausible:
        return
    end = image.base + image.size_bytes
    if image.base <= table.entry < end:
        return
    error = ImageError(
        f"{image.source} does not start inside itself: its reset vector is "
        f"0x{table.reset_vector:08X}",
        where=f"the bytes to send are at 0x{image.base:08X}..0x{end - 1:08X}",
        cause="a raw binary with a wrong --base, part of a program, or the wrong part of a file "
        "that merges bootloader and application",
        remedy="Correct --base, choose the application with --range START:END, or waive this check "
        "with --allow-outside-vector.",
        code=ErrorCode.IMAGE_OUTSIDE,
    )
    error.waiver = "outside-vector"
    raise error


def _inner_tables(image: Image) -> list[int]:
    """Addresses of further vector tables, as in a merged file."""
    if image.base is None:
        return []
    found = []
    end = image.base + image.size_bytes
    last = image.size_bytes - _VECTORS.size
    for offset in range(_INNER_ALIGNMENT, last + 1, _INNER_ALIGNMENT):
        stack_pointer, *vectors = _VECTORS.unpack_from(image.data, offset)
        start = image.base + offset
        if _is_stack_pointer(stack_pointer) and all(
            vector & _THUMB and start < vector < end for vector in vectors
        ):
            found.append(start)
            if len(found) == _INNER_NAMED_MAX:
                break
    return found


def _is_stack_pointer(word: int) -> bool:
    return word % 4 == 0 and _RAM_START < word <= _RAM_END
