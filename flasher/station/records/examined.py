"""State of the last examination of the records, after which the next one continues.

It is stored in a file beside the examiner's keys, signed with a key of the examiner.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from flasher.files import parse_json, read
from flasher.station.records.chain import GENESIS
from flasher.station.records.errors import RecordError, mapped
from flasher.station.records.files import whole_file
from flasher.station.records.signatures import EXAMINED, SigningKey, is_signed

_MAX_SIZE: Final = 6 * 1024 * 1024
"""In bytes."""


@dataclass
class ExaminedChain:
    """One station's chain up to the last row that was examined."""

    rows: int = 0
    hash: str = GENESIS
    """Hash of the last row."""
    key: str = ""
    """Public key with which the next row is signed."""
    keys: list[str] = field(default_factory=list)
    """All public keys of the rows."""
    restored: dict[int, tuple[int, int]] = field(default_factory=dict)
    """First and last lost row, by the RESTORED row that accepts them."""
    version: int | None = None
    schema: dict[str, str] = field(default_factory=dict)
    """The schema that the chain recorded last."""
    first: dict[str, int] = field(default_factory=dict)
    """First row whose head is stored in a place, by place."""


@dataclass(frozen=True)
class Examined:
    """The examined part of the records."""

    at: str
    records: str
    """Id of the records."""
    chains: dict[str, ExaminedChain]
    run: int
    """Id of the last run."""
    runs: int
    """Number of runs up to the last one."""
    unfinished: tuple[int, ...]
    """Ids of runs that had not ended."""
    remarks: tuple[str, ...] = field(default=())


_TYPE: Final = TypeAdapter(Examined)


def load_examined(path: Path, key_path: Path) -> Examined | None:
    """Load the last examination; None without a file. Raises RecordError if it was changed."""
    key = SigningKey.load(key_path)
    if key is None or not path.exists():
        return None
    try:
        found = parse_json(read(path, _MAX_SIZE, error=RecordError))
        if is_signed(_text(found["examined"]), found["signature"], key.public, EXAMINED):
            return _TYPE.validate_python(found["examined"])
    except (ValueError, TypeError, KeyError, ValidationError):
        pass
    raise RecordError("The file of the last examination was changed.", where=str(path))


def save_examined(path: Path, key_path: Path, examined: Examined) -> None:
    """Save the state, and create the examiner's key if there is none. Raises RecordError."""
    key = SigningKey.load(key_path) or SigningKey.make(key_path)
    body = _TYPE.dump_python(examined, mode="json")
    with mapped(str(path), writes=True), whole_file(path) as part:
        signed = {"examined": body, "signature": key.sign(_text(body), EXAMINED)}
        part.write_text(json.dumps(signed), encoding="ascii")


def _text(body: Any) -> str:
    return json.dumps(body, sort_keys=True)
