"""The referees' literals are the tables', the vectors', and what the CRC yields."""

from __future__ import annotations

import json
from pathlib import Path

from tests.loops import each

from .dialogue import TARGETS
from .wording import WORDINGS, build, crc, intact, literal, numbered, payloads


def test_the_crc_has_the_documents_example() -> None:
    assert crc(bytes.fromhex("55 AA 07 12 11 03 22 01 00")) == 0x01295122


@each("target", TARGETS)
def test_the_literals_are_what_the_tables_and_the_crc_yield(target: str) -> None:
    words = WORDINGS[target]
    to, back = words.to_device, words.to_tool
    name = {"wmc": b"WMC", "bms": b"BMS", "obc": b"PBU"}[target]
    built = [
        (words.reset, build(to, 0x16, 0x4205, b"RESET")),
        (words.feedback, build(back, 0x0C, 0x5503, b"ACK")),
        (words.boot_version, build(back, 0x0C, 0xC109, name + b"V1.2.3")),
        (words.update_78351, build(to, 0x16, 0xA10B, words.update_text + b"\x0f\x32\x01\x00")),
        (words.update_128, build(to, 0x16, 0xA10B, words.update_text + b"\x80\x00\x00\x00")),
        (words.request, build(back, 0x0C, 0xC402, b"\x00\x00")),
        (words.ack_1, build(back, 0x0C, 0xC202, b"\x01\x00")),
        (words.nak_1, build(back, 0x0C, 0xC302, b"\x01\x00")),
        (words.end, build(to, 0x16, 0xA401, b"\x04")),
        (words.complete, build(back, 0x0C, 0xC502, b"\x00\x00")),
    ]
    for text, wire in built:
        assert literal(text) == payloads(wire)


@each("target", TARGETS)
def test_the_literals_are_the_vectors(target: str) -> None:
    path = Path(__file__).parent.parent / "vectors.json"
    vectors = {
        vector["name"]: [bytes.fromhex(payload) for payload in vector["can_frames"]]
        for vector in json.loads(path.read_text(encoding="utf-8"))["vectors"]
    }
    words = WORDINGS[target]
    for name, text in [
        ("reset", words.reset),
        ("general feedback ACK", words.feedback),
        ("boot version", words.boot_version),
        ("update command, 78351 bytes", words.update_78351),
        ("update command, 128 bytes", words.update_128),
        ("request transfer", words.request),
        ("ACK 1", words.ack_1),
        ("NAK 1", words.nak_1),
        ("end of transfer", words.end),
        ("transfer complete", words.complete),
    ]:
        assert vectors[f"{target} {name}"] == literal(text)
    for number in (300, 613):
        assert vectors[f"{target} ACK {number}"] == numbered(words.to_tool, 0xC202, number)
        assert vectors[f"{target} NAK {number}"] == numbered(words.to_tool, 0xC302, number)
        packet = b"".join(vectors[f"{target} packet {number}/613"])
        assert intact(words.to_device, packet)
        assert not intact(words.to_tool, packet)
