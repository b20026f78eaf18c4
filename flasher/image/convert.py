"""Contents of image files joined, and written as Intel HEX, S-record or raw binary."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Final

from flasher.errors import ErrorCode, ImageError, UsageError
from flasher.image.image import ADDRESS_SPACE
from flasher.image.load import READERS, Content, Format
from flasher.image.plausible import file_type
from flasher.image.segments import SparseBytes

WRITTEN: Final = (Format.HEX, Format.SREC, Format.BIN)
"""Formats that can be written."""
_RECORD_SIZE: Final = 16
"""Bytes of data a record, as other programs write them; some readers take no more."""
_BANK_SIZE: Final = 0x10000
_HEX_END: Final = ":00000001FF\n"
_ADDRESS_BITS: Final = (16, 24, 32)


def check_no_other_file(content: Content) -> None:
    """Raise ImageError for a file of another type that would be taken for a raw binary."""
    if content.format is not Format.BIN:
        return
    head = next((data for _, data in content.sparse.pieces()), b"")
    name = file_type(head)
    if name is not None:
        raise ImageError(
            f"{content.sparse.source} is {name}, not an image.",
            remedy="Name the firmware file itself.",
            code=ErrorCode.IMAGE_IMPLAUSIBLE,
        )


def merge(contents: Sequence[Content], source: str) -> SparseBytes:
    """Join files into one; `source` is its name in messages. Bytes of the same address must be
    equal. Raises ImageError, and UsageError for a raw binary without an address.
    """
    merged = SparseBytes(source)
    done: list[SparseBytes] = []
    for content in contents:
        own = content.sparse
        if not content.has_addresses:
            raise UsageError(
                f"{own.source} is a raw binary, which has no addresses.",
                remedy=f"Add the address of its first byte to its name, as {own.source}@0x8004000.",
            )
        for start, data in own.pieces():
            try:
                merged.add(start, data, str)
            except ImageError as error:
                if error.code is ErrorCode.IMAGE_CONFLICT:
                    first = next(each.source for each in done if _overlaps(each, start, len(data)))
                    error.where = f"{first} and {own.source}"
                    error.cause = "two builds of the same part, or a wrong address"
                    error.remedy = "Merge files that do not overlap, or whose bytes are equal."
                raise
        done.append(own)
    return merged


def encode(sparse: SparseBytes, form: Format, *, fills: bool) -> bytes:
    """Encode as a file that reads back to the same bytes at the same addresses. Gaps are kept, or
    filled with FF if `fills`. A raw binary needs that where there are gaps; it loses the addresses.
    Raises ImageError.
    """
    if form is Format.BIN:
        data, _ = _joined(sparse, fills=fills)
        return data
    if fills:
        data, base = _joined(sparse, fills=True)
        filled = SparseBytes(sparse.source)
        filled.add(base, data, str)
        sparse = filled
    spans = sparse.spans()
    if not spans:
        sparse.join(0)  # raises the error for a file without bytes
    encoded = (_as_hex(sparse) if form is Format.HEX else _as_srec(sparse)).encode("ascii")
    again = SparseBytes(sparse.source)
    READERS[form](io.BytesIO(encoded), sparse.source, again)
    if again.spans() != spans or _bytes_of(again) != _bytes_of(sparse):
        raise ImageError(
            f"{sparse.source} reads back with other bytes than were written.",
            remedy="Nothing was written. Please report it.",
            code=ErrorCode.IMAGE_READINGS,
        )
    return encoded


def _as_hex(sparse: SparseBytes) -> str:
    """Encode each 64 KiB by itself, because a record must not run past their end."""
    from bincopy import BinFile  # noqa: PLC0415  only to write one

    banks: dict[int, BinFile] = {}
    for start, piece in sparse.pieces():
        at, end = start, start + len(piece)
        while at < end:
            until = min(end, (at // _BANK_SIZE + 1) * _BANK_SIZE)
            bank = banks.setdefault(at // _BANK_SIZE, BinFile())
            bank.add_binary(piece[at - start : until - start], address=at)
            at = until
    texts = [bank.as_ihex(number_of_data_bytes=_RECORD_SIZE) for bank in banks.values()]
    return "".join(text.removesuffix(_HEX_END) for text in texts) + _HEX_END


def _as_srec(sparse: SparseBytes) -> str:
    from bincopy import BinFile  # noqa: PLC0415  only to write one

    written = BinFile()
    for start, piece in sparse.pieces():
        written.add_binary(piece, address=start)
    written.execution_start_address = 0  # an end record, which some readers wait for
    bits = next(bits for bits in _ADDRESS_BITS if sparse.spans()[-1].end <= 1 << bits)
    text: str = written.as_srec(number_of_data_bytes=_RECORD_SIZE, address_length_bits=bits)
    return text


def _bytes_of(sparse: SparseBytes) -> bytes:
    return b"".join(data for _, data in sparse.pieces())


def _overlaps(sparse: SparseBytes, start: int, size_bytes: int) -> bool:
    return any(span.start < start + size_bytes and start < span.end for span in sparse.spans())


def _joined(sparse: SparseBytes, *, fills: bool) -> tuple[bytes, int]:
    try:
        return sparse.join(ADDRESS_SPACE if fills else 0)
    except ImageError as error:
        if error.code is ErrorCode.IMAGE_GAP:
            error.cause = "a raw binary has no addresses, so it cannot have gaps"
            error.remedy = "Add --fill to fill them with FF, or write Intel HEX or S-record."
        elif error.code is ErrorCode.IMAGE_TOO_LARGE:
            error.cause = "parts that are far apart, such as flash memory and option bytes"
            error.remedy = "Write Intel HEX or S-record without --fill: these keep gaps."
        raise
