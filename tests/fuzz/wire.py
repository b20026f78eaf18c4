"""Harnesses of the protocol: frames to messages, messages to what they mean."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from math import inf
from typing import Final

from flasher.protocol import catalogue, messages
from flasher.protocol.spec import data_size
from flasher.protocol.wire import Damage, Message, encode, split
from flasher.trace.decoder import ROUTES, Decoder
from tests.fuzz.harness import Choices, Harness
from tests.protocol.cases import CASES, HELD_MAX, case, feed_all, make_reassembler, messages_of

_ID: Final = 0x725
_ACK: Final = case("bms ACK 1")
_SHOWN: Final = re.compile("[ -~°]*")
_INTACT, _PAUSE = 0xC0, 0xE0
"""The first choice of an intact message, and of a pause; the smaller ones are a frame of bytes."""


def take_frames(data: bytes) -> None:
    """Frames of any bytes, intact messages between them, and pauses."""
    choices, reassembler, now = Choices(data), make_reassembler(_ID), 0.0
    stream, found, was_interrupted = b"", list[Message | Damage](), False
    while choices:
        kind = choices.byte()
        payloads = []
        if kind < _INTACT:
            payloads = [choices.take(kind % 8 + 1)]
        elif kind < _PAUSE:
            mode, serial = choices.byte(), choices.byte()
            content = choices.take(choices.byte() % 254)
            message = Message(_ID, mode, serial << 8 | len(content), content)
            payloads = [frame.data for frame in split(_ID, encode(message))]
        else:
            now += choices.byte() / 100
            found += reassembler.tick(now)
            was_interrupted = True
        for payload in payloads:
            stream += payload
            found += reassembler.feed(payload, now)
            assert reassembler.buffered_bytes <= HELD_MAX
        assert (reassembler.due_at == inf) == (reassembler.buffered_bytes == 0)
    found += reassembler.tick(now + 1.0)
    assert reassembler.buffered_bytes == 0
    assert bool(found) == bool(stream)
    assert all(item.can_id == _ID for item in found)
    assert all(item.data in stream and item.data for item in found if isinstance(item, Damage))
    assert all(encode(message) in stream for message in messages_of(found))
    if not was_interrupted:
        whole = make_reassembler(_ID)
        at_once = [*whole.feed(stream, 0.0), *whole.tick(1.0)]
        assert messages_of(at_once) == messages_of(found)
    assert feed_all(reassembler, _ACK.payloads, now + 2.0) == [_ACK.message]


def _streams() -> Iterator[bytes]:
    for each in CASES:
        frames = b"".join(bytes((len(payload) - 1,)) + payload for payload in each.payloads)
        yield frames
        yield frames[:-4] + bytes((_PAUSE, 11)) + frames
        data = each.message.data
        serial = each.message.command >> 8
        yield bytes((_INTACT, each.message.mode, serial, len(data))) + data


_KNOWN: Final = (
    *((item.can_id, item.mode, item.command) for item in catalogue.ITEMS),
    *(
        (can_id, row.MODE, row.COMMAND)
        for row in messages.UPGRADE_MESSAGES.values()
        for can_id in (0x725, 0x752)
    ),
)
_IDS: Final = tuple(ROUTES)


def take_message(data: bytes) -> None:
    """A message of the documents, or of any id, mode, command and size."""
    choices = Choices(data)
    number = choices.byte()
    if number < len(_KNOWN):
        key: tuple[int, int, int] = _KNOWN[number]
        size = data_size(key[2])
        content = choices.take(size).ljust(size, b"\0")
    else:
        key = _IDS[choices.byte() % len(_IDS)], choices.byte(), choices.number(2)
        content = choices.take(253)
    message = Message(*key, content)
    upgrade = messages.decode(message)
    if isinstance(upgrade, messages.Malformed | messages.Unknown):
        assert upgrade.message == message
    else:
        assert upgrade.to_message(message.can_id) == message
    decoded = catalogue.decode(message)
    if decoded is not None:
        assert catalogue.encode(decoded.item, decoded.content) == message
        for line in decoded.content.shown():
            assert all(map(_SHOWN.fullmatch, line)), line
    if len(content) == data_size(message.command):
        _check_shown(message)


def _check_shown(message: Message) -> None:
    """As `flasher monitor` shows it."""
    decoder = Decoder()
    frames = split(message.can_id, encode(message))
    (event,) = [event for frame in frames for event in decoder.feed(frame, 0.0)]
    json.dumps({shown.name: shown.value for shown in event.fields}, allow_nan=False)
    for shown in event.fields:
        assert _SHOWN.fullmatch(shown.text), shown
    assert _SHOWN.fullmatch(event.marked_title)


def _messages() -> Iterator[bytes]:
    for number, (_, _, command) in enumerate(_KNOWN):
        yield bytes((number,)) + bytes(data_size(command))
    for each in CASES:
        key = (each.message.can_id, each.message.mode, each.message.command)
        if key in _KNOWN:
            yield bytes((_KNOWN.index(key),)) + each.message.data


HARNESSES: Final = {
    "reassembler": Harness(take_frames, _streams, "flasher.protocol.wire.crc32", max_size=1024),
    "messages": Harness(
        take_message, _messages, "flasher.protocol.catalogue.data_size", max_size=256
    ),
}
