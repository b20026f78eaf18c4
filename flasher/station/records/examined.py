"""The examined part of records: the next examination continues after it.

It is stored in a file beside the examiner's keys, signed with a key of the examiner.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from flasher.files import parse_json, read
from flasher.station.records.errors import RecordError, mapped
from flasher.station.records.files import whole_file
from flasher.station.records.signatures import EXAMINED, SigningKey, is_signed

_MAX_SIZE: Final = 6 * 1024 * 1024
"""In bytes."""


@dataclass(frozen=True)
class ExaminedChain:
    """The chain of one station, up to the last row that was examined."""

    rows: int
    hash: str
    """Of that row."""
    key: str
    """That signs the next row."""
    keys: tuple[str, ...]
    """All that signed so far."""
    restored: dict[int, tuple[int, int]]
    """Rows that give up others, with the first and the last of these."""
    version: int | None
    schema: dict[str, str]
    """The schema as the chain states it last."""
    first: dict[str, int]
    """The first row of which a place keeps the head."""


@dataclass(frozen=True)
class Examined:
    """All that was examined."""

    at: str
    records: str
    """The id of the records."""
    chains: dict[str, ExaminedChain]
    run: int
    """The last run."""
    runs: int
    """How many runs there were up to it."""
    unfinished: tuple[int, ...]
    """Runs that went on."""
    remarks: tuple[str, ...] = field(default=())


_TYPE: Final = TypeAdapter(Examined)


def load_examined(path: Path, key_path: Path) -> Examined | None:
    """The examined part; None without a file. Raises RecordError for a changed one."""
    key = SigningKey.load(key_path)
    if key is None or not path.exists():
        return None
    try:
        found = parse_json(read(path, _MAX_SIZE, error=RecordError))
        if is_signed(_text(found["examined"]), found["signature"], key.public, EXAMINED):
            return _TYPE.validate_python(found["examined"])
    except (ValueError, TypeError, KeyError, ValidationError):
        pass
    raise RecordError("The note of the last examination was changed.", where=str(path))


def save_examined(path: Path, key_path: Path, examined: Examined) -> None:
    """Save the examined part, and make the key when there is none. Raises RecordError."""
    key = SigningKey.load(key_path) or SigningKey.make(key_path)
    body = _TYPE.dump_python(examined, mode="json")
    with mapped(str(path), writes=True), whole_file(path) as part:
        signed = {"examined": body, "signature": key.sign(_text(body), EXAMINED)}
        part.write_text(json.dumps(signed), encoding="ascii")


def _text(body: Any) -> str:
    return json.dumps(body, sort_keys=True)
