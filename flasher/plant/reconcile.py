"""Compares what a receiver has with what was handed over to it."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flasher.errors import UsageError
from flasher.files import read
from flasher.plant.deliveries import DeliveryState
from flasher.protocol.text import printable

LIST_MAX_SIZE: Final = 512 * 1024 * 1024
_COLUMN: Final = "key"


@dataclass(frozen=True)
class Reconciliation:
    """Differences between the list of a receiver and the deliveries to it, as keys."""

    receiver: str
    listed: int
    """Rows of the receiver's list."""
    delivered: int
    """Deliveries that were confirmed."""
    missing: list[str]
    """Confirmed, but not in the list."""
    doubled: list[str]
    """More than once in the list."""
    unknown: list[str]
    """In the list, but never handed over from this database."""
    unconfirmed: list[str]
    """In the list although no answer confirmed it."""

    @property
    def agrees(self) -> bool:
        """True if the receiver has each confirmed run once, and no other. What it has and did not
        confirm is no difference: that will be sent again with the same key.
        """
        return not (self.missing or self.doubled or self.unknown)


def compare(
    receiver: str, listed: list[str], deliveries: dict[str, DeliveryState]
) -> Reconciliation:
    """Compare keys that a receiver lists with the states of its deliveries."""
    has = Counter(listed)
    confirmed = {key for key, state in deliveries.items() if state is DeliveryState.CONFIRMED}
    return Reconciliation(
        receiver,
        len(listed),
        len(confirmed),
        sorted(confirmed - has.keys()),
        sorted(key for key, count in has.items() if count > 1),
        sorted(has.keys() - deliveries.keys()),
        sorted((has.keys() & deliveries.keys()) - confirmed),
    )


def read_list(path: Path) -> list[str]:
    """Read the keys from a receiver's list: CSV with a column `key`, or a JSON array of keys or of
    objects with `key`. Raises UsageError.
    """
    raw = read(path, LIST_MAX_SIZE, what="receiver's list")
    try:
        text = raw.decode("utf-8-sig")
        if text.lstrip().startswith("["):
            rows = json.loads(text)
            return [_key(row if isinstance(row, str) else row[_COLUMN]) for row in rows]
        lines = csv.DictReader(io.StringIO(text), dialect=_dialect(text))
        return [_key(row[_COLUMN]) for row in lines]
    except (ValueError, KeyError, TypeError, RecursionError, csv.Error) as error:
        raise UsageError(
            "The receiver's list cannot be read.",
            where=printable(str(path)),
            cause=f"no {error}" if isinstance(error, KeyError) else printable(str(error))[:200],
            remedy=f"Give CSV with a column `{_COLUMN}`, or a JSON array of keys or of objects"
            f" with `{_COLUMN}`.",
        ) from error


def _dialect(text: str) -> type[csv.Dialect]:
    class Dialect(csv.excel):
        delimiter = ";" if ";" in text.partition("\n")[0] else ","
        strict = True

    return Dialect


def _key(value: object) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"{value!r} is not a key")
    return value.strip()
