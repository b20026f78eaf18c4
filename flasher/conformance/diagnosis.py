"""Diagnosis of a device that could not be upgraded, from the received frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Final, NamedTuple

from flasher.conformance.results import TraceEntry
from flasher.conformance.wire import DeviceDecoder, Encoder, RawFrame, Received, Reply, crc

_SHOWN: Final = 6
_OTHER_HEADER: Final = b"\xaa\x55"
_CRC_AT: Final = slice(-5, -1)


class _Crc(NamedTuple):
    """A way to compute the CRC field; the defaults follow the document."""

    start: int = 0xFFFF_FFFF
    is_widened: bool = True
    has_header: bool = True
    id_order: str = "big"
    field_order: str = "big"
    inverts: bool = False

    def of(self, can_id: int, body: bytes) -> bytes:
        """Compute the CRC field of a message; `body` is mode to last data byte."""
        head = b"\x55\xaa" if self.has_header else b""
        own_id = b"" if self.id_order == "none" else can_id.to_bytes(2, self.id_order)  # type: ignore[arg-type]
        value = crc(head + own_id + body, start=self.start, steps=4 if self.is_widened else 1)
        value ^= 0xFFFF_FFFF if self.inverts else 0
        return value.to_bytes(4, self.field_order)  # type: ignore[arg-type]

    @property
    def differences(self) -> list[str]:
        """Differences from the document, as text."""
        differs = {
            "a start value of 0": self.start == 0,
            "one table step per byte instead of four": not self.is_widened,
            "the header 55 AA left out": not self.has_header,
            "the CAN id left out": self.id_order == "none",
            "the CAN id low byte first": self.id_order == "little",
            "all bits inverted at the end": self.inverts,
            "the CRC sent low byte first": self.field_order == "little",
        }
        return [text for text, is_so in differs.items() if is_so]


_CRCS: Final = sorted(
    (
        _Crc(*each)
        for each in product(
            (0xFFFF_FFFF, 0),
            (True, False),
            (True, False),
            ("big", "little", "none"),
            ("big", "little"),
            (False, True),
        )
    ),
    key=lambda each: len(each.differences),
)
"""All variants, the one closest to the document first."""


def diagnose(trace: Iterable[TraceEntry], encoder: Encoder, *, has_wires: bool = True) -> list[str]:
    """Explain what was received and which change would fix it, the likeliest cause first. With
    `has_wires`, silence may be a wiring problem.
    """
    replies = [(entry.frame, entry.at_s) for entry in trace if not entry.sent]
    frames = [frame for frame, _ in replies if not frame.is_error]
    own = f"{encoder.to_tool:03X}"
    if not frames:
        errors = f"{len(replies)} error frames and " if replies else ""
        parts = "the device's power, the wiring and its termination, the bit rate, the channel"
        why = f": check {parts}, and that the device is a {encoder.target}" if has_wires else ""
        return [f"{errors}no frame was received{why}"]
    if not any(frame.can_id == encoder.to_tool and frame.is_payload for frame in frames):
        return [_diagnose_senders(frames, encoder)]
    decoder = DeviceDecoder(encoder)
    messages = [found for frame, at in replies for found in decoder.feed(frame, at)]
    to_tool = [message for message in messages if message.can_id == encoder.to_tool]
    damaged = [message for message in to_tool if message.kind is Reply.DAMAGED]
    if damaged:
        return [_diagnose_framing(damaged, own)]
    return _diagnose_protocol(to_tool, own, encoder) or [
        f"{own} sends correct messages: {_with_counts(map(str, to_tool))}"
    ]


def _with_counts(texts: Iterable[str]) -> str:
    """The most frequent texts with their counts."""
    found = Counter(texts).most_common(_SHOWN)
    return ", ".join(text if count == 1 else f"{text} ({count} times)" for text, count in found)


def _diagnose_senders(frames: Sequence[RawFrame], encoder: Encoder) -> str:
    """No frame arrived on the id of the device's answers: explain which ids were seen instead."""
    own = f"{encoder.to_tool:03X}"
    extended = [frame.can_id for frame in frames if frame.is_extended]
    if any(encoder.to_tool in (can_id, can_id >> 18) for can_id in extended):
        return f"{own} is sent as an extended 29-bit id: the document uses 11-bit ids"
    for other in encoder.others():
        if any(frame.can_id == other.to_tool and frame.is_payload for frame in frames):
            return (
                f"{other.to_tool:03X} sends messages and {own} does not: it is another device, "
                f"which -t {other.target} selects"
            )
    ids = _with_counts(f"{frame.can_id:03X}" for frame in frames)
    return f"nothing was received from {own}, only from the ids {ids}"


def _diagnose_framing(damaged: Sequence[Received], own: str) -> str:
    """Damaged messages arrived: find a framing or CRC variant that fits all of them."""
    raws = [message.raw for message in damaged]
    if any(raw.startswith(_OTHER_HEADER) for raw in raws):
        return f"{own} sends messages that begin with AA 55 instead of 55 AA"
    whole = [raw for raw in raws if raw.startswith(b"\x55\xaa") and len(raw) == 9 + raw[3]]
    if not whole:
        shown = raws[0].hex(" ").upper()
        return f"{own} sends only incomplete messages: the first one is {shown}"
    if any(raw[-1] != 0xF0 for raw in whole):
        return f"{own} sends messages that end with {whole[0][-1]:02X} instead of F0"
    if all(raw[5] != raw[3] - 2 for raw in whole):
        fits = all(raw[4] == raw[3] - 2 for raw in whole)
        why = (
            "the command is sent low byte first"
            if fits
            else "length and command contradict each other"
        )
        return f"{own} sends messages, but {why}: {whole[0].hex(' ').upper()}"
    can_id = damaged[0].can_id
    for way in _CRCS:
        if all(way.of(can_id, raw[2:-5]) == raw[_CRC_AT] for raw in whole):
            return f"{own} sends messages whose CRC fits {' and '.join(way.differences)}"
    return (
        f"{own} sends messages whose CRC fits no known variant: {whole[0].hex(' ').upper()} has "
        f"{whole[0][_CRC_AT].hex().upper()}, and {_Crc().of(can_id, whole[0][2:-5]).hex().upper()} "
        "is right"
    )


def _diagnose_protocol(messages: Sequence[Received], own: str, encoder: Encoder) -> list[str]:
    """Intact messages arrived: list what contradicts the protocol."""
    names = {one.boot_name for one in messages if one.kind is Reply.BOOT_VERSION}
    for other in encoder.others():
        if other.boot_name in names:
            return [f"{own} announces itself as {other.boot_name}: the name of another device"]
    numbers = {one.number for one in messages if one.kind in (Reply.ACK, Reply.NAK)}
    if numbers and all(number and not number & 0xFF for number in numbers):
        shown = ", ".join(str(number) for number in sorted(numbers)[:_SHOWN])
        return [f"{own} sends the numbers of ACK and NAK high byte first: {shown}"]
    if names and not any(one.kind is Reply.REQUEST for one in messages):
        why = "check its CRC and when it listens (up_04_burst in the profile)"
        return [f"{own} announces itself but answers no update command: {why}"]
    return []
