"""Diagnosis of a device that cannot be upgraded, from literal frames or from frames that break one
rule of the document.
"""

from __future__ import annotations

import pytest

from flasher.conformance.catalogue import Selection
from flasher.conformance.diagnosis import _Crc, diagnose
from flasher.conformance.dut.subject import open_subject
from flasher.conformance.results import CaseVerdict, TraceEntry
from flasher.conformance.runner import run
from flasher.conformance.wire import Encoder, RawFrame, split

_BMS = Encoder("bms")
_VERSION = b"\x55\xaa\x0c\x0b\xc1\x09BMSV1.0.0"
"""A boot version up to its CRC."""


def _diagnosis(*frames: RawFrame) -> str:
    trace = [TraceEntry(0.001 * at, sent=False, frame=frame) for at, frame in enumerate(frames)]
    (text,) = diagnose(trace, _BMS)
    return text


def _message(raw: bytes, can_id: int = 0x725) -> list[RawFrame]:
    return split(can_id, raw)


def test_nothing_at_all() -> None:
    assert _diagnosis().startswith("no frame ")
    own = TraceEntry(0.0, sent=True, frame=_BMS.reset()[0])
    assert diagnose([own], _BMS)[0].startswith("no frame ")


def test_error_frames_alone_are_counted() -> None:
    error = RawFrame(0x725, bytes(8), is_error=True)
    assert _diagnosis(error, error).startswith("2 error frames and no frame ")


def test_only_others_are_received() -> None:
    text = _diagnosis(RawFrame(0x123, b"\x00"), RawFrame(0x123, b"\x01"), RawFrame(0x1F0, b"\x00"))
    assert "725" in text
    assert text.endswith("123 (2 times), 1F0")


def test_another_target_speaks() -> None:
    text = _diagnosis(*_message(bytes.fromhex("55AA0C02"), 0x735))
    assert text.startswith("735 ")
    assert "-t obc" in text


@pytest.mark.parametrize("can_id", [0x725, 0x725 << 18])
def test_the_id_comes_as_an_extended_one(can_id: int) -> None:
    frame = RawFrame(can_id, b"\x55\xaa", is_extended=True)
    assert "extended 29-bit id" in _diagnosis(frame)


@pytest.mark.parametrize(
    ("crc", "way"),
    [
        # Computed independently of the suite, bit by bit, over 55 AA 07 25 and mode to data.
        ("start", _Crc(start=0)),
        ("plain", _Crc(is_widened=False)),
        ("no_id", _Crc(id_order="none")),
        ("id_swapped", _Crc(id_order="little")),
        ("no_header", _Crc(has_header=False)),
        ("inverted", _Crc(inverts=True)),
        ("mirrored", _Crc(field_order="little")),
    ],
)
def test_the_crc_that_fits_is_named(crc: str, way: _Crc) -> None:
    body = _VERSION[2:]
    covered = {
        "no_id": b"\x55\xaa" + body,
        "id_swapped": b"\x55\xaa\x25\x07" + body,
        "no_header": b"\x07\x25" + body,
    }.get(crc, b"\x55\xaa\x07\x25" + body)
    register = 0 if crc == "start" else 0xFFFFFFFF
    for byte in covered:
        word = byte << 24 if crc == "plain" else byte
        register ^= word
        for _ in range(8 if crc == "plain" else 32):
            register = (register << 1) ^ (0x104C11DB7 if register & 0x80000000 else 0)
    if crc == "inverted":
        register ^= 0xFFFFFFFF
    field = register.to_bytes(4, "big")
    if crc == "mirrored":
        field = field[::-1]
    (difference,) = way.differences
    text = _diagnosis(*_message(_VERSION + field + b"\xf0"))
    assert text.startswith("725 ")
    assert text.endswith(f"CRC fits {difference}")


def test_a_crc_that_nothing_fits_is_shown_with_the_right_one() -> None:
    text = _diagnosis(*_message(_VERSION + b"\x01\x02\x03\x04\xf0"))
    assert "has 01020304, and 0BD4B7F6 is right" in text


@pytest.mark.parametrize(
    ("raw", "reported"),
    [
        ("AA550C0BC109424D5356312E302E30F0", "begin with AA 55"),
        ("55AA0C0BC109424D5356312E302E300BD4B7F60D", "end with 0D"),
        ("55AA0C0409C20100AAAAAAAAF0", "length and command"),
        ("55AA0C0402C20100AAAAAAAAF0", "command is sent low byte first"),
        ("0102", "incomplete messages: the first one is 01 02"),
    ],
)
def test_another_form_of_the_messages_is_named(raw: str, reported: str) -> None:
    assert reported in _diagnosis(*_message(bytes.fromhex(raw)))


def test_the_name_of_another_device() -> None:
    assert "announces itself as PBU" in _diagnosis(*_BMS.answer(0xC109, b"PBUV1.0.0"))


def test_numbers_high_byte_first() -> None:
    assert _diagnosis(*_BMS.answer(0xC202, b"\x00\x01")).endswith("high byte first: 256")


def test_announcements_without_a_request() -> None:
    version = _BMS.answer(0xC109, b"BMSV1.0.0")
    assert "answers no update command" in _diagnosis(*version)


def test_messages_that_are_right_are_counted() -> None:
    frames = [*_BMS.answer(0xC402, bytes(2)), *_BMS.answer(0xC202, b"\x01\x00")]
    assert _diagnosis(*frames).endswith(" correct messages: request transfer, ACK 1")


@pytest.mark.slow
def test_bring_up_fails_with_the_diagnosis_and_its_trace() -> None:
    name = "tests.conformance.wrong_bootloaders:StartsAtZero"
    with open_subject(name, "bms", None, good_image=None, second_image=None) as (subject, profile):
        report = run(subject, profile, selection=Selection(cases=("BR-01", "TX-01")))
    bring_up, other = report.results
    assert bring_up.verdict is CaseVerdict.FAIL
    (difference,) = _Crc(start=0).differences
    assert difference in bring_up.reason
    assert any(not entry.sent for entry in bring_up.trace)
    assert other.verdict is CaseVerdict.NOT_RUN
    assert difference in report.stopped
