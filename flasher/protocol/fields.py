"""Field codecs for message data: encoding, decoding, label and unit from one declaration.

A message's content is a frozen dataclass whose fields each have a codec, in wire order. Decoding
accepts any bytes of the right size, and encoding the result gives the same bytes: out-of-range
numbers, malformed texts and reserved bytes are kept.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, ClassVar, Final, Protocol, Self

from flasher.protocol.text import decode_text, encode_text, printable

_CODEC: Final = "codec"


class Codec(Protocol):
    """Encodes and decodes one field of a message."""

    @property
    def size_bytes(self) -> int: ...

    @property
    def unit(self) -> str:
        """Unit of the value; may be empty."""
        ...

    def encode(self, value: Any) -> bytes:
        """Encode a value. Raises ValueError if it does not fit."""
        ...

    def decode(self, raw: bytes) -> Any:
        """Decode the bytes of a field. Never raises."""
        ...

    def show(self, value: Any) -> str:
        """Format a value for display: without its unit, control characters escaped."""
        ...


@dataclass(frozen=True)
class NumberField:
    """Little-endian integer; `offset` is added on the wire."""

    size_bytes: int
    unit: str = ""
    offset: int = 0
    signed: bool = False

    def encode(self, value: int) -> bytes:
        return _integer(value, value + self.offset, self.size_bytes, signed=self.signed)

    def decode(self, raw: bytes) -> int:
        return int.from_bytes(raw, "little", signed=self.signed) - self.offset

    def show(self, value: int) -> str:
        return str(value)


@dataclass(frozen=True)
class AddressField(NumberField):
    """Memory address, shown in hexadecimal."""

    def show(self, value: int) -> str:
        return f"0x{value:0{2 * self.size_bytes}X}"


@dataclass(frozen=True)
class NumberListField:
    """Array of integers of the same size and unit."""

    count: int
    each: NumberField

    @property
    def size_bytes(self) -> int:
        return self.count * self.each.size_bytes

    @property
    def unit(self) -> str:
        return self.each.unit

    def encode(self, value: tuple[int, ...]) -> bytes:
        if len(value) != self.count:
            raise ValueError(f"{len(value)} numbers, not {self.count}")
        return b"".join(map(self.each.encode, value))

    def decode(self, raw: bytes) -> tuple[int, ...]:
        size = self.each.size_bytes
        return tuple(self.each.decode(raw[at : at + size]) for at in range(0, len(raw), size))

    def show(self, value: tuple[int, ...]) -> str:
        used = len(value)
        while used and not value[used - 1]:
            used -= 1
        return " ".join(map(str, value[:used])) or "none"


class Bits(IntFlag):
    """Bit flags with names; other bits are reserved."""

    @classmethod
    def unnamed(cls, bit: int) -> str:
        """Text for a set bit without a name."""
        return f"reserved bit {bit}"


_ABBREVIATIONS: Final = re.compile(r"\b(?:afe|mcu|mos)\b")


@dataclass(frozen=True)
class FlagsField:
    """Bit flags, little-endian; unknown bits are kept."""

    size_bytes: int
    names: type[Bits]
    none: str = "none"
    unit: str = ""

    def encode(self, value: int) -> bytes:
        return _integer(int(value), int(value), self.size_bytes)

    def decode(self, raw: bytes) -> Bits:
        return self.names(int.from_bytes(raw, "little"))

    def show(self, value: int) -> str:
        words = ", ".join(flag_names(self.names, value)) or self.none
        return _ABBREVIATIONS.sub(lambda found: found[0].upper(), words)


def flag_names(names: type[Bits], value: int) -> list[str]:
    """Names of the set bits in ascending order, as in JSON; unnamed bits by number."""
    named = {int(flag): (flag.name or "").lower().replace("_", " ") for flag in names}
    bits = (1 << bit for bit in range(int(value).bit_length()) if value >> bit & 1)
    return [named.get(bit) or names.unnamed(bit.bit_length() - 1) for bit in bits]


@dataclass(frozen=True)
class WireText:
    """ASCII field as received; `str()` decodes and escapes it (R20)."""

    raw: bytes

    def __str__(self) -> str:
        return decode_text(self.raw)


@dataclass(frozen=True)
class TextField:
    """ASCII text with terminator and padding (chapter 3). Encodes a str or a `WireText`."""

    size_bytes: int
    unit: str = ""

    def encode(self, value: WireText | str) -> bytes:
        if isinstance(value, str):
            return encode_text(value, self.size_bytes)
        return _sized(value.raw, self.size_bytes)

    def decode(self, raw: bytes) -> WireText:
        return WireText(raw)

    def show(self, value: WireText | str) -> str:
        return printable(str(value))


@dataclass(frozen=True)
class DateField:
    """Date of eight digits, YYYYMMDD, without terminator. Encodes a `WireText` or a str of eight
    digits; the caller checks that the date exists.
    """

    size_bytes: int = 8
    unit: str = ""

    def encode(self, value: WireText | str) -> bytes:
        if not isinstance(value, str):
            return _sized(value.raw, self.size_bytes)
        if len(value) != self.size_bytes or not (value.isascii() and value.isdigit()):
            raise ValueError(f"{value!a} is not YYYYMMDD")
        return value.encode("ascii")

    def decode(self, raw: bytes) -> WireText:
        return WireText(raw)

    def show(self, value: WireText | str) -> str:
        # Not `str(value)`: a dot in a date is not a terminator.
        text = printable(value if isinstance(value, str) else value.raw.decode("latin-1")).rstrip()
        is_date = len(text) == self.size_bytes and text.isdigit()
        return f"{text[:4]}-{text[4:6]}-{text[6:]}" if is_date else text


@dataclass(frozen=True)
class LatinField:
    """Latin-1 text of exactly the field's size."""

    size_bytes: int
    unit: str = ""

    def encode(self, value: str) -> bytes:
        return _sized(value.encode("latin-1"), self.size_bytes)

    def decode(self, raw: bytes) -> str:
        return raw.decode("latin-1")

    def show(self, value: str) -> str:
        return printable(value)


@dataclass(frozen=True)
class BytesField:
    """Opaque bytes, shown in hexadecimal."""

    size_bytes: int
    unit: str = ""

    def encode(self, value: bytes) -> bytes:
        return _sized(value, self.size_bytes)

    def decode(self, raw: bytes) -> bytes:
        return raw

    def show(self, value: bytes) -> str:
        return value.hex(" ")


@dataclass(frozen=True)
class ConstantField:
    """Field with a constant value; any other received value is kept and shown."""

    expected: bytes
    unit: str = ""

    @property
    def size_bytes(self) -> int:
        return len(self.expected)

    def encode(self, value: bytes) -> bytes:
        return _sized(value, self.size_bytes)

    def decode(self, raw: bytes) -> bytes:
        return raw

    def show(self, value: bytes) -> str:
        shown = printable(value.decode("latin-1"))
        return shown if value == self.expected else f"{shown} (not {self.expected.decode()})"


@dataclass(frozen=True)
class ReservedField(BytesField):
    """Reserved bytes: sent as zero, kept as received."""


def _integer(value: int, on_the_wire: int, size_bytes: int, *, signed: bool = False) -> bytes:
    try:
        return on_the_wire.to_bytes(size_bytes, "little", signed=signed)
    except OverflowError as error:
        raise ValueError(f"{value} does not fit {size_bytes} bytes") from error


def _sized(raw: bytes, size_bytes: int) -> bytes:
    if len(raw) != size_bytes:
        raise ValueError(f"{len(raw)} bytes, not {size_bytes}")
    return raw


# -- declaring ------------------------------------------------------------------------------------


def field(codec: Codec, **options: Any) -> Any:
    """Declare a dataclass field with its codec."""
    return dataclasses.field(metadata={_CODEC: codec}, **options)


def number(size_bytes: int, unit: str = "", *, offset: int = 0, signed: bool = False) -> Any:
    return field(NumberField(size_bytes, unit, offset, signed))


def constant(text: bytes) -> Any:
    return field(ConstantField(text), default=text)


def reserved(size_bytes: int) -> Any:
    return field(ReservedField(size_bytes), default=bytes(size_bytes))


@dataclass(frozen=True)
class Content:
    """Decoded data of a message; subclasses declare their fields in wire order."""

    SIZE_BYTES: ClassVar[int] = 0
    LAYOUT: ClassVar[tuple[tuple[str, Codec], ...]] = ()
    """Name and codec of each field, in wire order."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.LAYOUT = tuple(
            (name, value.metadata[_CODEC])
            for name, value in vars(cls).items()
            if isinstance(value, dataclasses.Field) and _CODEC in value.metadata
        )
        cls.SIZE_BYTES = sum(codec.size_bytes for _, codec in cls.LAYOUT)

    def data(self) -> bytes:
        """Encode the data. Raises ValueError with the name of the field that does not fit."""
        parts = []
        for name, codec in self.LAYOUT:
            try:
                parts.append(codec.encode(getattr(self, name)))
            except ValueError as error:
                raise ValueError(f"{label(name, codec)}: {error}") from error
        return b"".join(parts)

    @classmethod
    def from_data(cls, data: bytes) -> Self:
        """Decode `SIZE_BYTES` bytes; raises ValueError for another size."""
        if len(data) != cls.SIZE_BYTES:
            raise ValueError(f"{len(data)} bytes of data, not {cls.SIZE_BYTES}")
        values, at = [], 0
        for _, codec in cls.LAYOUT:
            values.append(codec.decode(data[at : at + codec.size_bytes]))
            at += codec.size_bytes
        return cls(*values)

    def shown(self) -> Iterator[tuple[str, str, str]]:
        """Yield label, value and unit of each field for display; no reserved bytes of zero."""
        for name, codec in self.LAYOUT:
            value = getattr(self, name)
            if not isinstance(codec, ReservedField) or any(value):
                yield label(name, codec), codec.show(value), codec.unit


_UNIT_SUFFIXES: Final = {"mV": "_mv", "V": "_v", "mA": "_ma", "mAh": "_mah", "°C": "_c",
                         "%": "_percent", "h": "_h", "min": "_min", "B": "_bytes"}  # fmt: skip
_OWN_LABELS: Final = {
    "full_capacity": "full-charge capacity",
    "latest_charge_interval": "most recent charge interval",
}


def label(name: str, codec: Codec) -> str:
    """Display name of a field, without its unit."""
    bare = name.removesuffix(_UNIT_SUFFIXES.get(codec.unit, ""))
    if bare.endswith("_count"):  # of the history; warnings have the same names (chapter 3)
        bare = f"{bare.removesuffix('count')}protection_count"
        bare = re.sub("(over|under|short)_", r"\1-", bare)
    return _OWN_LABELS.get(bare, bare.replace("_", " "))
