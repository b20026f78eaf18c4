"""Messages to bytes and frames: what `encode` and `split` refuse, and what counts as payload."""

from __future__ import annotations

import pytest

from flasher.protocol.frame import Frame
from flasher.protocol.wire import Message, encode, split
from tests.loops import each

from .cases import make_reassembler


@each("size_bytes", [0, 1, 3, 255])
def test_data_of_another_size_than_the_command_names_are_refused(size_bytes: int) -> None:
    with pytest.raises(ValueError, match=f"C202 carries 2 data bytes, not {size_bytes}"):
        encode(Message(0x751, 0x0C, 0xC202, bytes(size_bytes)))


@each("size_bytes", [254, 255])
def test_a_command_beyond_the_length_field_is_refused(size_bytes: int) -> None:
    with pytest.raises(ValueError, match="exceeds the length field"):
        encode(Message(0x751, 0x0C, 0x1000 | size_bytes, bytes(size_bytes)))


def test_the_smallest_message_is_eleven_bytes_in_two_frames() -> None:
    wire = encode(Message(0x752, 0x11, 0x3300, b""))
    assert [len(frame.data) for frame in split(0x752, wire)] == [8, 3]


def test_the_largest_message_is_264_bytes_in_33_frames_and_comes_back() -> None:
    message = Message(0x752, 0x16, 0x77FD, bytes(range(253)))
    wire = encode(message)
    assert wire[:6] == bytes.fromhex("55 AA 16 FF 77 FD")
    frames = split(0x752, wire)
    assert [len(frame.data) for frame in frames] == [8] * 33
    reassembler = make_reassembler(0x752)
    found = [item for frame in frames for item in reassembler.feed(frame.data, 0.0)]
    assert found == [message]


def test_nothing_is_split_into_no_frames() -> None:
    assert split(0x752, b"") == []


def test_a_frame_is_a_standard_data_frame_unless_set_otherwise() -> None:
    assert Frame(0x751, b"\x55") == (0x751, b"\x55", False, False, False, False)


@each(
    "frame, is_payload",
    [
        (Frame(0x751, b"\x00"), True),
        (Frame(0x751, bytes(8)), True),
        (Frame(0x751, b""), False),
        (Frame(0x751, b"\x55\xaa", is_extended=True), False),
        (Frame(0x751, b"", is_remote=True), False),
        (Frame(0x751, b"\x55\xaa", is_remote=True), False),
        (Frame(0x751, b"\x55\xaa", is_error=True), False),
    ],
)
def test_only_a_standard_data_frame_with_bytes_is_payload(frame: Frame, is_payload: bool) -> None:
    # FR-09: empty, remote, extended and error frames are never payload.
    assert frame.is_payload is is_payload
