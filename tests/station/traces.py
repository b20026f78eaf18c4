"""Bus traces of good runs, made from literal messages: a transfer, writes, and the answers."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path

from flasher.image.image import Image
from flasher.protocol import catalogue
from flasher.protocol.contents import SerialNumber, VersionInformation
from flasher.protocol.fields import WireText
from flasher.protocol.messages import Complete, EndOfTransfer, Packet, UpdateCommand
from flasher.protocol.spec import BMS, PACKET_DATA_SIZE, Target, packet_count
from flasher.protocol.text import encode_text
from flasher.protocol.wire import Message, encode, split


def run_messages(
    serial: str, version: str, image: Image | None, *, written: str = ""
) -> Iterator[Message]:
    """The messages of a good run of a BMS that are compared with its records."""
    if image is not None:
        yield from transfer(BMS, image)
    if written:
        item = catalogue.BY_KEY[BMS.request_id, 0x4110]
        yield catalogue.encode(item, SerialNumber(WireText(encode_text(written, 16))))
    yield version_answer(serial, version)


def transfer(target: Target, image: Image, *, is_complete: bool = True) -> Iterator[Message]:
    """An image on the bus, without the answers to each packet."""
    total = packet_count(image.size_bytes)
    yield UpdateCommand(target.update_text, image.size_bytes).to_message(target.request_id)
    for number in range(1, total + 1):
        payload = image.data[(number - 1) * PACKET_DATA_SIZE : number * PACKET_DATA_SIZE]
        payload = payload.ljust(PACKET_DATA_SIZE, b"\xff")
        yield Packet(number, total, payload).to_message(target.request_id)
    yield EndOfTransfer().to_message(target.request_id)
    if is_complete:
        yield Complete().to_message(target.answer_id)


def version_answer(serial: str, version: str) -> Message:
    (item,) = (each for each in catalogue.ITEMS if each.content is VersionInformation)
    return catalogue.encode(
        item,
        VersionInformation(
            *(WireText(encode_text(each, 16)) for each in ("M", serial, "V1r0r0_1", version))
        ),
    )


def write_trace(path: Path, messages: Iterator[Message], *, at_s: float = 1_779_000_000.0) -> Path:
    """A packed candump log of these messages, a frame each millisecond."""
    lines = []
    for message in messages:
        for frame in split(message.can_id, encode(message)):
            at_s += 0.001
            lines.append(f"({at_s:.6f}) can0 {frame.can_id:03X}#{frame.data.hex()}\n")
    path.write_bytes(gzip.compress("".join(lines).encode("ascii"), mtime=0))
    return path
