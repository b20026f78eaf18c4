"""A receiver's list is compared with what was handed over."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.plant.deliveries import DeliveryState
from flasher.plant.reconcile import compare, read_list

DELIVERIES = {
    "a-1": DeliveryState.CONFIRMED,
    "a-2": DeliveryState.CONFIRMED,
    "a-3": DeliveryState.CONFIRMED,
    "a-4": DeliveryState.UNKNOWN,
    "a-5": DeliveryState.UNKNOWN,
    "a-6": DeliveryState.REFUSED,
}


def test_each_difference_is_found() -> None:
    found = compare("mes", ["a-1", "a-2", "a-2", "a-4", "b-9"], DELIVERIES)
    assert (found.listed, found.delivered) == (5, 3)
    assert found.missing == ["a-3"]
    assert found.doubled == ["a-2"]
    assert found.unknown == ["b-9"]
    assert found.unconfirmed == ["a-4"]
    assert not found.agrees


def test_an_answer_that_was_lost_is_no_difference() -> None:
    assert compare("mes", ["a-1", "a-2", "a-3", "a-4"], DELIVERIES).agrees


@pytest.mark.parametrize(
    "text",
    [
        "serial,key\nW1,a-1\nW2,a-2\n",
        "\ufeffkey;serial\r\na-1;W1\r\na-2;W2\r\n",
        json.dumps(["a-1", "a-2"]),
        json.dumps([{"key": "a-1", "serial": "W1"}, {"key": "a-2"}]),
    ],
)
def test_lists_in_each_form(tmp_path: Path, text: str) -> None:
    path = tmp_path / "list"
    path.write_text(text, encoding="utf-8")
    assert read_list(path) == ["a-1", "a-2"]


@pytest.mark.parametrize(
    "raw",
    [b"serial\nW1\n", b"[1]", b'[{"id": 1}]', b"[", b"\xff\xfe", b"key\n\"a", b"key,x\n,y\n",
     b"[" * 100_000],
)  # fmt: skip
def test_a_list_that_is_none(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "list"
    path.write_bytes(raw)
    with pytest.raises(UsageError, match="list cannot be read"):
        read_list(path)


def test_an_empty_list_is_a_list(tmp_path: Path) -> None:
    path = tmp_path / "list"
    path.write_text("key\n", encoding="utf-8")
    assert read_list(path) == []
