"""Sparse bytes: what is accepted in any order, and what is refused, by address."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.errors import ImageError
from flasher.image import segments
from flasher.image.image import AddressSpan
from flasher.image.segments import SparseBytes
from flasher.protocol.spec import IMAGE_MAX_SIZE


def place(address: int) -> str:
    return f"place of {address:#x}"


def sparse(*pieces: tuple[int, bytes], window: tuple[int, int] | None = None) -> SparseBytes:
    result = SparseBytes("app.hex", window)
    for start, data in pieces:
        result.add(start, data, place)
    return result


def test_neighbours_in_any_order_are_one_span() -> None:
    result = sparse((8, b"cc"), (4, b"aabb"), (10, b"d"))
    assert result.spans() == (AddressSpan(4, 7),)
    assert result.join(0) == (b"aabbccd", 4)


def test_neighbours_after_a_gap_are_joined_to_the_span_before_them() -> None:
    result = sparse((4, b"a"), (10, b"c"), (8, b"bb"))
    assert result.spans() == (AddressSpan(4, 1), AddressSpan(8, 3))


def test_a_gap_within_the_limit_is_filled_with_ff() -> None:
    result = sparse((4, b"a"), (8, b"b"))
    assert result.join(3) == (b"a\xff\xff\xffb", 4)
    assert result.spans() == (AddressSpan(4, 1), AddressSpan(8, 1))


def test_a_gap_beyond_the_limit_is_refused_with_the_segments_named() -> None:
    with pytest.raises(ImageError) as caught:
        sparse((4, b"a"), (8, b"b")).join(2)
    message = str(caught.value)
    assert "a gap of 3 bytes between 0x00000005 and 0x00000008" in message
    assert "0x00000004..0x00000004 (1 byte), 0x00000008..0x00000008 (1 byte)" in message
    assert "--fill-gaps-up-to 3" in message


def test_a_message_names_at_most_eight_segments() -> None:
    with pytest.raises(ImageError, match=r"0x0000000E \(1 byte\) and 2 more"):
        sparse(*((2 * index, b"a") for index in range(10))).join(0)


def test_filling_is_not_advised_where_the_image_would_become_too_large() -> None:
    with pytest.raises(ImageError) as caught:
        sparse((0, b"a"), (IMAGE_MAX_SIZE, b"b")).join(100)
    assert "--fill-gaps-up-to" not in caught.value.remedy
    assert "--range" in caught.value.remedy


def test_the_same_bytes_twice_are_accepted() -> None:
    result = sparse((0, b"abcd"), (10, b"xyz"), (2, b"cd"), (0, b"abcdEFGHIJxyzK"))
    assert result.join(0) == (b"abcdEFGHIJxyzK", 0)
    assert result.size_bytes == 14


def test_other_bytes_for_the_same_address_are_refused_by_address_and_place() -> None:
    with pytest.raises(ImageError) as caught:
        sparse((0, b"abcd"), (10, b"xyz"), (3, b"d......xYz"))
    message = str(caught.value)
    assert "0x0000000B: first 79, then 59" in message
    assert "place of 0xb" in message


def test_only_the_window_is_kept_and_it_states_where_the_image_starts() -> None:
    result = sparse((0, b"abcdef"), (20, b"z"), window=(2, 5))
    assert result.join(0) == (b"cde", 2)
    later = sparse((4, b"ef"), window=(2, 10))
    assert later.join(2) == (b"\xff\xffef", 2)


def test_bytes_outside_of_the_window_may_contradict_each_other() -> None:
    assert sparse((0, b"a"), (0, b"b"), (4, b"c"), window=(4, 5)).join(0) == (b"c", 4)


def test_the_start_of_the_window_counts_as_the_start_of_a_gap() -> None:
    with pytest.raises(ImageError, match="gap of 2 bytes between 0x00000002 and 0x00000004"):
        sparse((4, b"ef"), window=(2, 10)).join(1)


def test_a_window_without_bytes_is_refused_and_the_message_names_where_the_bytes_are() -> None:
    with pytest.raises(ImageError) as caught:
        sparse((4, b"ef"), (8, b"g"), window=(0x10, 0x20)).join(0)
    message = str(caught.value)
    assert "no bytes in the range 0x00000010:0x00000020" in message
    assert "between 0x00000004 and 0x00000009" in message


def test_nothing_at_all_is_refused_as_empty() -> None:
    with pytest.raises(ImageError, match=r"app\.hex is empty"):
        sparse((4, b"")).join(0)


def test_the_largest_image_is_accepted_and_one_byte_more_is_not() -> None:
    data, _ = sparse((0, b"a"), (IMAGE_MAX_SIZE - 1, b"b")).join(IMAGE_MAX_SIZE)
    assert len(data) == 8_388_480
    with pytest.raises(ImageError, match="65535 packets hold 8388480"):
        sparse((0, b"a"), (IMAGE_MAX_SIZE, b"b")).join(IMAGE_MAX_SIZE)


def test_more_bytes_than_an_image_can_have_are_refused_when_they_come() -> None:
    full = sparse((0, bytes(IMAGE_MAX_SIZE)))
    with pytest.raises(ImageError, match="at least 8388481 bytes"):
        full.add(IMAGE_MAX_SIZE, b"x", place)


def test_too_many_pieces_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "PIECES_MAX", 3)
    scattered = sparse((0, b"a"), (2, b"a"), (4, b"a"))
    scattered.add(5, b"on the end of one", place)
    with pytest.raises(ImageError, match="more than 3 separate pieces"):
        scattered.add(50, b"a", place)


PIECES = st.lists(st.tuples(st.integers(0, 60), st.binary(max_size=12)), max_size=12)


@given(pieces=PIECES, window=st.none() | st.tuples(st.integers(0, 40), st.integers(41, 80)))
def test_any_pieces_come_to_the_same_as_a_map_of_addresses(
    pieces: list[tuple[int, bytes]], window: tuple[int, int] | None
) -> None:
    low, high = window or (0, 1000)
    model: dict[int, int] = {}
    result = SparseBytes("app.hex", window)
    for start, data in pieces:
        wanted = {start + at: byte for at, byte in enumerate(data) if low <= start + at < high}
        if any(model.get(address, byte) != byte for address, byte in wanted.items()):
            with pytest.raises(ImageError):
                result.add(start, data, place)
            return
        model |= wanted
        result.add(start, data, place)
    if not model:
        with pytest.raises(ImageError):
            result.join(1000)
        return
    first = low if window else min(model)
    expected = bytes(model.get(address, 0xFF) for address in range(first, max(model) + 1))
    assert result.join(1000) == (expected, first)
    assert result.size_bytes == len(model) == sum(span.size_bytes for span in result.spans())
