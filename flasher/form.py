"""What a type says of its values where bounds do not do: how to read one, and that in words.

It stands in an annotation, as `Annotated[str, Form("64 hex digits", read_sha256)]`. Only who reads
files (`flasher.settings`) needs the validation library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic_core import CoreSchema


@dataclass(frozen=True)
class Form:
    """The form of a value; `read` raises ValueError or TypeError for what has another."""

    words: str
    """What it is, as "64 hex digits"."""
    read: Callable[[Any], object]

    def __get_pydantic_core_schema__(self, source: object, handler: object) -> CoreSchema:
        from pydantic_core import core_schema  # noqa: PLC0415

        return core_schema.no_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, schema: object, handler: object) -> dict[str, Any]:
        return {"words": self.words}

    def _read(self, value: object) -> object:
        try:
            return self.read(value)
        except TypeError as error:
            raise ValueError(str(error)) from error
