"""The codecs that fields are declared with, and what a declaration yields."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import pytest

from flasher.protocol import fields
from flasher.protocol.fields import (
    AddressField,
    Bits,
    BytesField,
    Codec,
    ConstantField,
    Content,
    DateField,
    FlagsField,
    NumberField,
    NumberListField,
    ReservedField,
    TextField,
    WireText,
    flag_names,
    label,
)
from tests.loops import each


class Lamp(Bits):
    """Two bits with names, one without."""

    FRONT = 1
    REAR_LEFT = 4


@dataclass(frozen=True)
class Sample(Content):
    """A content of our own: 1 + 2 + 4 + 2 + 3 bytes."""

    speed_c: int = fields.number(1, "°C", offset=40)
    depth_mv: int = fields.number(2, "mV", signed=True)
    name: WireText = fields.field(TextField(4))  # noqa: RUF009
    reserved: bytes = fields.reserved(2)
    mark: bytes = fields.constant(b"END")


# -- codecs ---------------------------------------------------------------------------------------


@each(
    "codec, value, raw",
    [
        (NumberField(1), 0, "00"),
        (NumberField(1), 255, "FF"),
        (NumberField(2), 0x1234, "34 12"),
        (NumberField(4), 0x12345678, "78 56 34 12"),
        (NumberField(2, signed=True), -1, "FF FF"),
        (NumberField(2, signed=True), -2, "FE FF"),
        (NumberField(2, signed=True), -32768, "00 80"),
        (NumberField(2, signed=True), 32767, "FF 7F"),
        (NumberField(1, offset=40), -40, "00"),
        (NumberField(1, offset=40), 0, "28"),
        (NumberField(1, offset=40), 215, "FF"),
        (AddressField(4), 0x08004000, "00 40 00 08"),
        (NumberListField(3, NumberField(2)), (1, 2, 0x300), "01 00 02 00 00 03"),
        (FlagsField(1, Lamp), Lamp.FRONT | Lamp.REAR_LEFT, "05"),
        (FlagsField(2, Lamp), Lamp(0x8001), "01 80"),
        (TextField(4), WireText(b"AB. "), "41 42 2E 20"),
        (TextField(4), WireText(b"ABCD"), "41 42 43 44"),
        (TextField(4), WireText(b"\x00\xff\x80."), "00 FF 80 2E"),
        (DateField(), WireText(b"20220512"), "32 30 32 32 30 35 31 32"),
        (BytesField(2), b"\xa5\x5a", "A5 5A"),
        (ReservedField(2), b"\x00\x01", "00 01"),
        (ConstantField(b"OK"), b"OK", "4F 4B"),
        (ConstantField(b"OK"), b"KO", "4B 4F"),
    ],
)
def test_a_codec_gives_and_takes_the_bytes(codec: Codec, value: object, raw: str) -> None:
    data = bytes.fromhex(raw)
    assert codec.size_bytes == len(data)
    assert codec.encode(value) == data
    assert codec.decode(data) == value


@each(
    "codec, value, refusal",
    [
        (NumberField(1), 256, "256 does not fit 1 bytes"),
        (NumberField(2), -1, "-1 does not fit 2 bytes"),
        (NumberField(2, signed=True), 40000, "40000 does not fit 2 bytes"),
        (NumberField(1, offset=40), 216, "216 does not fit 1 bytes"),
        (NumberField(1, offset=40), -41, "-41 does not fit 1 bytes"),
        (AddressField(4), -1, "-1 does not fit 4 bytes"),
        (NumberListField(3, NumberField(2)), (1, 2), "2 numbers, not 3"),
        (NumberListField(3, NumberField(2)), (1, 2, 65536), "65536 does not fit 2 bytes"),
        (FlagsField(1, Lamp), 256, "256 does not fit 1 bytes"),
        (FlagsField(1, Lamp), -1, "-1 does not fit 1 bytes"),
        (TextField(4), "ABCD", "longer than 3 characters"),
        (TextField(4), "A.", "terminator of a field"),
        (TextField(4), WireText(b"ABCDE"), "5 bytes, not 4"),
        (DateField(), "", "'' is not YYYYMMDD"),
        (DateField(), "20220512 ", "is not YYYYMMDD"),
        (DateField(), "2022O512", "is not YYYYMMDD"),
        (DateField(), "2022051\u0662", "is not YYYYMMDD"),
        (DateField(), WireText(b"20220512."), "9 bytes, not 8"),
        (BytesField(2), b"\x00", "1 bytes, not 2"),
        (ReservedField(2), b"\x00\x00\x00", "3 bytes, not 2"),
        (ConstantField(b"OK"), b"", "0 bytes, not 2"),
    ],
)
def test_a_codec_refuses_what_does_not_fit(codec: Codec, value: object, refusal: str) -> None:
    with pytest.raises(ValueError, match=refusal):
        codec.encode(value)


@each(
    "codec, value, shown",
    [
        (NumberField(2, "mA", signed=True), -1234, "-1234"),
        (AddressField(4), 0x4000, "0x00004000"),
        (NumberListField(4, NumberField(2)), (3600, 0, 3601, 0), "3600 0 3601"),
        (NumberListField(4, NumberField(2)), (0, 0, 0, 0), "none"),
        (FlagsField(1, Lamp), Lamp(0), "none"),
        (FlagsField(1, Lamp, none="dark"), Lamp(0), "dark"),
        (FlagsField(1, Lamp), Lamp(0x87), "front, reserved bit 1, rear left, reserved bit 7"),
        (TextField(8), WireText(b"AB.     "), "AB"),
        (TextField(8), WireText(b"ABCDEFGH"), "ABCDEFGH"),
        (TextField(8), WireText(b"AB      "), "AB"),
        (TextField(8), WireText(b"\x1b[2J.   "), r"\x1b[2J"),
        (TextField(8), WireText(b"caf\xe9.   "), r"caf\xe9"),
        (TextField(8), "\x1b[2J\xe9", r"\x1b[2J\xe9"),
        (DateField(), WireText(b"20220512"), "2022-05-12"),
        (DateField(), "20220512", "2022-05-12"),
        (DateField(), WireText(b"99999999"), "9999-99-99"),
        (DateField(), WireText(b"2022051."), "2022051."),
        (DateField(), WireText(b"2022    "), "2022"),
        (DateField(), WireText(b"        "), ""),
        (DateField(), WireText(b"\x00\x1b[2J\xff\n\r"), r"\x00\x1b[2J\xff\n\r"),
        (DateField(), "2022051\u0662", r"2022051\u0662"),
        (BytesField(3), b"\x00\xa5\xff", "00 a5 ff"),
        (ConstantField(b"READY"), b"READY", "READY"),
        (ConstantField(b"READY"), b"REA\x1bY", r"REA\x1bY (not READY)"),
        (ConstantField(b"OK"), b"\xff\x00", r"\xff\x00 (not OK)"),
    ],
)
def test_a_value_is_shown_without_harm(codec: Codec, value: object, shown: str) -> None:
    assert codec.show(value) == shown


def test_the_unit_of_a_row_of_numbers_is_that_of_each() -> None:
    assert NumberListField(16, NumberField(2, "mV")).unit == "mV"


def test_the_names_of_flags_are_in_the_order_of_their_bits() -> None:
    assert flag_names(Lamp, 0b1111) == ["front", "reserved bit 1", "rear left", "reserved bit 3"]
    assert flag_names(Lamp, 0) == []


def test_text_reads_up_to_its_terminator_and_keeps_its_bytes() -> None:
    text = WireText(b"AB\xff.    ")
    assert str(text) == r"AB\xff"
    assert text.raw == b"AB\xff.    "
    assert text != WireText(b"AB\xff.\x00\x00\x00\x00")


@each(
    "name, unit, expected",
    [
        ("voltage_mv", "mV", "voltage"),
        ("design_voltage_v", "V", "design voltage"),
        ("mean_current_ma", "mA", "mean current"),
        ("full_capacity_mah", "mAh", "full-charge capacity"),
        ("cell_temperature_c", "°C", "cell temperature"),
        ("state_of_charge_percent", "%", "state of charge"),
        ("charge_interval_h", "h", "charge interval"),
        ("running_time_min", "min", "running time"),
        ("short_circuit_count", "", "short-circuit protection count"),
        ("ends_in_min", "", "ends in min"),
    ],
)
def test_a_label_leaves_out_the_unit_that_follows_the_value(
    name: str, unit: str, expected: str
) -> None:
    assert label(name, NumberField(1, unit)) == expected


# -- declarations ---------------------------------------------------------------------------------


def test_a_declaration_yields_size_layout_and_both_directions() -> None:
    assert Sample.SIZE_BYTES == 12
    assert [name for name, _ in Sample.LAYOUT] == [
        "speed_c",
        "depth_mv",
        "name",
        "reserved",
        "mark",
    ]
    sample = Sample(-1, -2, WireText(b"AB. "))
    assert sample.data() == bytes.fromhex("27 FE FF 41 42 2E 20 00 00 45 4E 44")
    assert Sample.from_data(sample.data()) == sample


def test_a_declaration_without_fields_is_empty() -> None:
    @dataclass(frozen=True)
    class Nothing(Content):
        """No field."""

    assert (Nothing.SIZE_BYTES, Nothing.LAYOUT) == (0, ())
    assert Nothing().data() == b""
    assert list(Nothing.from_data(b"").shown()) == []


@each("size_bytes", [0, 11, 13])
def test_data_of_another_size_is_refused(size_bytes: int) -> None:
    with pytest.raises(ValueError, match=f"{size_bytes} bytes of data, not 12"):
        Sample.from_data(bytes(size_bytes))


def test_reserved_bytes_are_shown_only_when_they_are_not_zero() -> None:
    sample = Sample(20, 5, WireText(b"AB. "))
    lines = [("speed", "20", "°C"), ("depth", "5", "mV"), ("name", "AB", ""), ("mark", "END", "")]
    assert list(sample.shown()) == lines
    with_reserved = dataclasses.replace(sample, reserved=b"\x00\x07")
    assert ("reserved", "00 07", "") in list(with_reserved.shown())


def test_a_content_is_a_value() -> None:
    sample = Sample(20, 5, WireText(b"AB. "))
    assert sample == Sample.from_data(sample.data())
    assert sample != dataclasses.replace(sample, depth_mv=6)
    assert len({sample, Sample.from_data(sample.data())}) == 1
    name: Any = "depth_mv"
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(sample, name, 6)
