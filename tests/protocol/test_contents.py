"""What the messages carry, against bytes written by hand from the documents' tables: each content
in both directions, at the ends of its ranges, and with bytes that break its rules.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any, Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.protocol import contents
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.contents import BatteryFault, BatteryStatus
from flasher.protocol.fields import Content, WireText
from tests.loops import each

CONTENTS: Final = sorted({item.content for item in ITEMS}, key=lambda content: content.__name__)
every_content = pytest.mark.parametrize("content", CONTENTS, ids=lambda found: found.__name__)


def wire(*parts: str) -> bytes:
    """Bytes of lines in hexadecimal."""
    return bytes.fromhex(" ".join(parts))


# One example each and the ends of every range: a content and its data, typed from the documents.
EXAMPLES: Final[list[tuple[str, Content, bytes]]] = [
    ("nothing", contents.Empty(), b""),
    ("handshake", contents.Handshake(), b"HANDSHAKE"),
    ("ready", contents.Ready(), b"READY"),
    ("shutdown", contents.Shutdown(), b"SHUTDOWN"),
    ("reset", contents.Reset(), b"RESET"),
    ("general feedback", contents.GeneralFeedback(), b"ACK"),
    (
        "running information, discharging at 20 A in the cold, charger connected",
        contents.RunningInformation(
            36000, -20000, 5000, 10000, -5, 50, BatteryStatus.CHARGER_CONNECTED, 97
        ),
        wire("A0 8C", "E0 B1", "88 13", "10 27", "23", "32", "01", "61", "00 00 00 00"),
    ),
    (
        "running information, lowest values",
        contents.RunningInformation(0, -32768, 0, 0, -40, 0, BatteryStatus(0), 0),
        wire("00 00", "00 80", "00 00", "00 00", "00", "00", "00", "00", "00 00 00 00"),
    ),
    (
        "running information, highest values, reserved bits and bytes set",
        contents.RunningInformation(
            65535, 32767, 65535, 65535, 215, 255, BatteryStatus(0xFF), 255, b"\x01\x02\x03\x04"
        ),
        wire("FF FF", "FF 7F", "FF FF", "FF FF", "FF", "FF", "FF", "FF", "01 02 03 04"),
    ),
    (
        "running information, one milliampere of discharge at 0 degrees",
        contents.RunningInformation(1, -1, 256, 1, 0, 100, BatteryStatus(0), 100),
        wire("01 00", "FF FF", "00 01", "01 00", "28", "64", "00", "64", "00 00 00 00"),
    ),
    (
        "cell voltages, 10 cells in use",
        contents.CellVoltages((3600, 3601, 3599, 3700, 3500, 2500, 4200, 1, 256, 3600) + (0,) * 6),
        wire(
            "10 0E 11 0E 0F 0E 74 0E AC 0D C4 09 68 10 01 00 00 01 10 0E",
            "00 00 00 00 00 00 00 00 00 00 00 00",
        ),
    ),
    (
        "cell voltages, the 16th alone and at its highest",
        contents.CellVoltages((0,) * 15 + (65535,)),
        bytes(30) + wire("FF FF"),
    ),
    ("no faults", contents.Faults(BatteryFault(0)), wire("00 00 00 00")),
    (
        "the lowest fault of each half",
        contents.Faults(
            BatteryFault.SECOND_LEVEL_DISCHARGE_OVER_CURRENT_PROTECTION
            | BatteryFault.CHARGE_OVER_VOLTAGE_WARNING
        ),
        wire("01 00 01 00"),
    ),
    ("faults with all bits set", contents.Faults(BatteryFault(0xFFFFFFFF)), wire("FF FF FF FF")),
    (
        "design information",
        contents.DesignInformation(14000, 48, WireText(b"INR18. \x20")),
        wire("B0 36", "30", "49 4E 52 31 38 2E 20 20", "00 00 00 00 00"),
    ),
    (
        "design information, highest values, cell model without terminator",
        contents.DesignInformation(65535, 255, WireText(b"ABCDEFGH"), b"\x05\x04\x03\x02\x01"),
        wire("FF FF", "FF", "41 42 43 44 45 46 47 48", "05 04 03 02 01"),
    ),
    (
        "version information, both versions filling their fields to the terminator",
        contents.VersionInformation(
            WireText(b"BM36.           "),
            WireText(b"."+ b" " * 15),
            WireText(b"V1r2r0_20220512."),
            WireText(b"V9r9r9_20261231."),
        ),
        b"BM36.           .               V1r2r0_20220512.V9r9r9_20261231.",
    ),
    (
        "version information, full field, no terminator, non-ASCII, zeros",
        contents.VersionInformation(
            WireText(b"ABCDEFGHIJKLMNOP"),
            WireText(b"W2605001        "),
            WireText(b"\xe9\x1b[2J" + b"\xff" * 11),
            WireText(bytes(16)),
        ),
        b"ABCDEFGHIJKLMNOPW2605001        \xe9\x1b[2J" + b"\xff" * 11 + bytes(16),
    ),
    (
        "physical id with its filler (R13)",
        contents.PhysicalId(b"\x12\x34\x56\x78\x9a\xbc\xde\xf0\x01\x01\x01\x01"),
        wire("12 34 56 78 9A BC DE F0 01 01 01 01"),
    ),
    ("check code", contents.CheckCode(b"CHECK-CODE-1"), b"CHECK-CODE-1"),
    (
        "history",
        contents.History(
            61, -12, 35000, 8000, 321, 24, 1500, 10, 20, 30, 40, 50, 60, 70, 80, 90, 123456, 88
        ),
        wire(
            "65 1C", "B8 88", "40 1F", "41 01", "18 00", "DC 05",
            "0A 00 14 00 1E 00 28 00 32 00 3C 00 46 00 50 00 5A 00",
            "40 E2 01 00", "58", "00 00 00 00 00",
        ),
    ),
    (
        "history, highest values",
        contents.History(
            215, 215, 65535, 65535, 65535, 65535, 65535,
            65535, 65535, 65535, 65535, 65535, 65535, 65535, 65535, 65535,
            4294967295, 255, b"\xff" * 5,
        ),
        b"\xff" * 40,
    ),
    (
        "history, lowest values",
        contents.History(-40, -40, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        bytes(40),
    ),
    (
        "production information",
        contents.ProductionInformation(
            WireText(b"WELLING."), WireText(b"FOSHAN. "), WireText(b"20240229")
        ),
        b"WELLING.FOSHAN. 20240229" + bytes(8),
    ),
    (
        "production information, full fields, a date that is none, reserved bytes set",
        contents.ProductionInformation(
            WireText(b"ABCDEFGH"), WireText(b"\x00" * 8), WireText(b"2024-2-9"), b"RESERVED"
        ),
        b"ABCDEFGH\x00\x00\x00\x00\x00\x00\x00\x002024-2-9RESERVED",
    ),
    (
        "user string of 15 characters",
        contents.UserString(WireText(b"FIFTEEN LETTERS.")),
        b"FIFTEEN LETTERS.",
    ),
    ("model", contents.Model(WireText(b"BM48.           ")), b"BM48.           "),
    ("serial number", contents.SerialNumber(WireText(b"W2605001.       ")), b"W2605001.       "),
    (
        "read memory, up to the last address",
        contents.ReadMemory(0xFFFFFF7F, 0xFFFFFFFF),
        wire("7F FF FF FF", "FF FF FF FF"),
    ),
    (
        "memory, one byte of it in use",
        contents.Memory(0x08001234, 0x08001235, b"\xa5" + b"\xff" * 127),
        wire("34 12 00 08", "35 12 00 08", "A5") + b"\xff" * 127,
    ),
]  # fmt: skip

every_example = pytest.mark.parametrize(
    ("content", "data"),
    [(content, data) for _, content, data in EXAMPLES],
    ids=[name for name, _, _ in EXAMPLES],
)


# -- bytes ----------------------------------------------------------------------------------------


def test_every_content_of_the_catalogue_has_an_example() -> None:
    assert {type(content) for _, content, _ in EXAMPLES} == set(CONTENTS)


@every_example
def test_a_content_is_encoded_byte_for_byte(content: Content, data: bytes) -> None:
    assert content.data() == data


@every_example
def test_its_bytes_are_decoded_to_the_content(content: Content, data: bytes) -> None:
    assert type(content).from_data(data) == content


@each(
    "content, data",
    [
        (
            contents.DesignInformation,
            ({"design_capacity_mah": 10000, "design_voltage_v": 36, "cell_model": "21700A"},
             b"\x10\x27\x2421700A. \x00\x00\x00\x00\x00"),
        ),
        (
            contents.ProductionInformation,
            ({"manufacturer": "WELLING", "place": "", "date": "20220512"},
             b"WELLING.\x2e\x20\x20\x20\x20\x20\x20\x2020220512\x00\x00\x00\x00\x00\x00\x00\x00"),
        ),
        (contents.UserString, ({"text": "FIFTEEN LETTERS"}, b"FIFTEEN LETTERS.")),
        (contents.Model, ({"model": "BM36"}, b"BM36.           ")),
        (contents.SerialNumber, ({"serial_number": "W2605001"}, b"W2605001.       ")),
    ],
)  # fmt: skip
def test_texts_may_be_given_as_they_read(
    content: type[Content], data: tuple[dict[str, Any], bytes]
) -> None:
    values, expected = data
    assert content(**values).data() == expected


@every_content
def test_bytes_of_another_size_are_refused(content: type[Content]) -> None:
    sizes = {0, 1, content.SIZE_BYTES - 1, content.SIZE_BYTES + 1, 253} - {content.SIZE_BYTES, -1}
    for size_bytes in sizes:
        refusal = f"{size_bytes} bytes of data, not {content.SIZE_BYTES}"
        with pytest.raises(ValueError, match=refusal):
            content.from_data(bytes(size_bytes))


@every_content
@settings(max_examples=40, deadline=None, derandomize=True)
@given(draw=st.data())
def test_any_payload_of_the_right_size_is_decoded_and_encoded_to_itself(
    content: type[Content], draw: st.DataObject
) -> None:
    size_bytes = content.SIZE_BYTES
    payload = draw.draw(st.binary(min_size=size_bytes, max_size=size_bytes))
    decoded = content.from_data(payload)
    assert decoded.data() == payload
    assert content.from_data(decoded.data()) == decoded


@every_content
@settings(max_examples=40, deadline=None, derandomize=True)
@given(draw=st.data())
def test_any_payload_is_shown_in_printable_ascii_and_degrees(
    content: type[Content], draw: st.DataObject
) -> None:
    size_bytes = content.SIZE_BYTES
    payload = draw.draw(st.binary(min_size=size_bytes, max_size=size_bytes))
    for part in (part for line in content.from_data(payload).shown() for part in line):
        assert re.fullmatch("[ -~°]*", part), part


# -- refusals -------------------------------------------------------------------------------------

GOOD: Final[dict[type[Content], Content]] = {
    type(content): content for _, content, _ in reversed(EXAMPLES)
}


@each(
    "content, field, value, refusal",
    [
        (contents.RunningInformation, "voltage_mv", 65536, "voltage: 65536 does not fit 2 bytes"),
        (contents.RunningInformation, "voltage_mv", -1, "voltage: -1 does not fit 2 bytes"),
        (contents.RunningInformation, "mean_current_ma", 32768, "mean current: 32768 does not fit"),
        (contents.RunningInformation, "mean_current_ma", -32769, "mean current: -32769 does not"),
        (contents.RunningInformation, "cell_temperature_c", 216, "cell temperature: 216 does not"),
        (contents.RunningInformation, "cell_temperature_c", -41, "cell temperature: -41 does not"),
        (contents.RunningInformation, "state_of_charge_percent", 256, "state of charge: 256"),
        (contents.RunningInformation, "status", 0x100, "status: 256 does not fit 1 bytes"),
        (contents.RunningInformation, "reserved", bytes(5), "reserved: 5 bytes, not 4"),
        (contents.CellVoltages, "cells_mv", (3600,) * 10, "cells: 10 numbers, not 16"),
        (contents.CellVoltages, "cells_mv", (3600,) * 17, "cells: 17 numbers, not 16"),
        (contents.CellVoltages, "cells_mv", (65536,) + (0,) * 15, "cells: 65536 does not fit"),
        (contents.Faults, "faults", 1 << 32, "faults: 4294967296 does not fit 4 bytes"),
        (contents.Faults, "faults", -1, "faults: -1 does not fit 4 bytes"),
        (contents.DesignInformation, "design_capacity_mah", 65536, "design capacity: 65536"),
        (contents.DesignInformation, "design_voltage_v", 256, "design voltage: 256 does not fit"),
        (contents.DesignInformation, "cell_model", "EIGHT888", "cell model: .*than 7 characters"),
        (contents.VersionInformation, "model", "A" * 16, "model: .*than 15 characters"),
        (contents.VersionInformation, "firmware_version", "V1.2", "firmware version: .*terminator"),
        (contents.VersionInformation, "hardware_version", "caf\xe9", "hardware version: .*ASCII"),
        (
            contents.VersionInformation,
            "serial_number",
            WireText(b"W."),
            "serial number: 2 bytes, not",
        ),
        (contents.PhysicalId, "physical_id", bytes(11), "physical id: 11 bytes, not 12"),
        (contents.CheckCode, "check_code", bytes(13), "check code: 13 bytes, not 12"),
        (contents.History, "cycles", 65536, "cycles: 65536 does not fit 2 bytes"),
        (contents.History, "running_time_min", 1 << 32, "running time: 4294967296 does not fit 4"),
        (contents.History, "longest_charge_interval_h", -1, "longest charge interval: -1 does"),
        (contents.ProductionInformation, "place", "SHENZHEN", "place: .*than 7 characters"),
        (contents.ProductionInformation, "date", "2022051", "date: '2022051' is not YYYYMMDD"),
        (contents.ProductionInformation, "date", "2022-5-1", "date: '2022-5-1' is not YYYYMMDD"),
        (contents.ProductionInformation, "date", "2022051\u0662", r"date: .* is not YYYYMMDD"),
        (contents.ProductionInformation, "date", WireText(b"2022051"), "date: 7 bytes, not 8"),
        (contents.UserString, "text", "a\x1b[2J", "text: .*not printable ASCII"),
        (contents.ReadMemory, "start", -1, "start: -1 does not fit 4 bytes"),
        (contents.ReadMemory, "end", 1 << 32, "end: 4294967296 does not fit 4 bytes"),
        (contents.Memory, "content", bytes(127), "content: 127 bytes, not 128"),
        (contents.Reset, "text", b"RESE", "text: 4 bytes, not 5"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_the_name_of_its_field(
    content: type[Content], field: str, value: object, refusal: str
) -> None:
    changes: dict[str, Any] = {field: value}
    broken = dataclasses.replace(GOOD[content], **changes)
    with pytest.raises(ValueError, match=f"^{refusal}") as refused:
        broken.data()
    assert str(refused.value).isascii()
    assert str(refused.value).isprintable()


# -- faults and status ----------------------------------------------------------------------------

# The documents count each half of the faults from its own bit 0.
UPPER_HALF: Final = (
    (0x0001, "charge over voltage warning"),
    (0x0002, "discharge under voltage warning"),
    (0x0004, "charge over current warning"),
    (0x0008, "discharge over current warning"),
    (0x0010, "charge over temperature warning"),
    (0x0020, "charge under temperature warning"),
    (0x0040, "discharge over temperature warning"),
    (0x0080, "discharge under temperature warning"),
    (0x0100, "MOS over temperature warning"),
)
LOWER_HALF: Final = (
    (0x0001, "second level discharge over current protection"),
    (0x0002, "charge over current protection"),
    (0x0004, "short circuit protection"),
    (0x0008, "over discharge protection"),
    (0x0010, "over charge protection"),
    (0x0020, "discharge under temperature protection"),
    (0x0040, "discharge over temperature protection"),
    (0x0080, "charge under temperature protection"),
    (0x0100, "charge over temperature protection"),
    (0x0200, "discharge MOS fault"),
    (0x0400, "charge MOS fault"),
    (0x0800, "temperature sensor fault"),
    (0x1000, "first level over current warning"),
    (0x2000, "first level over current protection"),
    (0x4000, "AFE fault"),
    (0x8000, "MCU fault"),
)


def half(bits: int) -> bytes:
    """Sixteen bits as they stand on the wire, low byte first (R19)."""
    return bytes([bits & 0xFF, bits >> 8])


def shown_faults(data: bytes) -> str:
    ((name, value, unit),) = contents.Faults.from_data(data).shown()
    assert (name, unit) == ("faults", "")
    return value


@each("bits, name", UPPER_HALF)
def test_a_warning_is_the_bit_of_the_upper_half(bits: int, name: str) -> None:
    data = b"\x00\x00" + half(bits)
    assert shown_faults(data) == name
    assert contents.Faults(BatteryFault[name.upper().replace(" ", "_")]).data() == data


@each("bits, name", LOWER_HALF)
def test_a_protection_or_defect_is_the_bit_of_the_lower_half(bits: int, name: str) -> None:
    data = half(bits) + b"\x00\x00"
    assert shown_faults(data) == name
    assert contents.Faults(BatteryFault[name.upper().replace(" ", "_")]).data() == data


def test_no_other_bit_has_a_name() -> None:
    assert len(BatteryFault) == len(UPPER_HALF) + len(LOWER_HALF) == 25


@each("bit", range(25, 32))
def test_an_unnamed_fault_is_kept_and_shown_by_its_number(bit: int) -> None:
    data = b"\x00\x00\x00" + bytes([1 << (bit - 24)])
    assert contents.Faults.from_data(data).data() == data
    assert shown_faults(data) == f"bit {bit} (not in the document)"


def test_several_faults_are_shown_in_the_order_of_their_bits() -> None:
    assert shown_faults(bytes.fromhex("04 80 01 03")) == (
        "short circuit protection, MCU fault, charge over voltage warning, "
        "MOS over temperature warning, bit 25 (not in the document)"
    )


def test_no_fault_is_shown_as_none() -> None:
    assert shown_faults(bytes(4)) == "none"


@each(
    "status, shown",
    [
        (0x00, "no flag (00)"),
        (0x01, "charger connected"),
        (0x02, "reserved bit 1"),
        (0x81, "charger connected, reserved bit 7"),
    ],
)
def test_the_status_is_shown_by_its_bits(status: int, shown: str) -> None:
    content = contents.RunningInformation.from_data(bytes(10) + bytes([status]) + bytes(5))
    assert ("status", shown, "") in list(content.shown())


# -- for people -----------------------------------------------------------------------------------


@each(
    "name, lines",
    [
        (
            "running information, discharging at 20 A in the cold, charger connected",
            [
                ("voltage", "36000", "mV"),
                ("mean current", "-20000", "mA"),
                ("remaining capacity", "5000", "mAh"),
                ("full-charge capacity", "10000", "mAh"),
                ("cell temperature", "-5", "°C"),
                ("state of charge", "50", "%"),
                ("status", "charger connected", ""),
                ("state of health", "97", "%"),
            ],
        ),
        (
            "version information, full field, no terminator, non-ASCII, zeros",
            [
                ("model", "ABCDEFGHIJKLMNOP", ""),
                ("serial number", "W2605001", ""),
                ("hardware version", r"\xe9\x1b[2J" + r"\xff" * 11, ""),
                ("firmware version", r"\x00" * 16, ""),
            ],
        ),
        (
            "production information",
            [
                ("manufacturer", "WELLING", ""),
                ("place", "FOSHAN", ""),
                ("date", "2024-02-29", ""),
            ],
        ),
        (
            "production information, full fields, a date that is none, reserved bytes set",
            [
                ("manufacturer", "ABCDEFGH", ""),
                ("place", r"\x00" * 8, ""),
                ("date", "2024-2-9", ""),
                ("reserved", "52 45 53 45 52 56 45 44", ""),
            ],
        ),
        (
            "history",
            [
                ("highest cell temperature", "61", "°C"),
                ("lowest cell temperature", "-12", "°C"),
                ("greatest discharge current", "35000", "mA"),
                ("greatest charge current", "8000", "mA"),
                ("cycles", "321", ""),
                ("most recent charge interval", "24", "h"),
                ("longest charge interval", "1500", "h"),
                ("charge over-current protection count", "10", ""),
                ("discharge over-current protection count", "20", ""),
                ("over-charge protection count", "30", ""),
                ("over-discharge protection count", "40", ""),
                ("short-circuit protection count", "50", ""),
                ("charge under-temperature protection count", "60", ""),
                ("charge over-temperature protection count", "70", ""),
                ("discharge under-temperature protection count", "80", ""),
                ("discharge over-temperature protection count", "90", ""),
                ("running time", "123456", "min"),
                ("state of health", "88", "%"),
            ],
        ),
        (
            "read memory, up to the last address",
            [("start", "0xFFFFFF7F", ""), ("end", "0xFFFFFFFF", "")],
        ),
        ("nothing", []),
    ],
)
def test_a_content_is_shown_with_labels_and_units(
    name: str, lines: list[tuple[str, str, str]]
) -> None:
    content = next(content for found, content, _ in EXAMPLES if found == name)
    assert list(content.shown()) == lines


def test_a_device_without_state_of_health_shows_zero() -> None:
    """Section 6: the byte was reserved, thus 00, before V2.7.1."""
    old = bytes.fromhex("A08C 0000 8813 1027 41 32 00 00 00000000")
    assert contents.RunningInformation.from_data(old).state_of_health_percent == 0
