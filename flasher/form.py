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
    write: Callable[[Any], str] = str
    """The text of a value in a document."""

    def __get_pydantic_core_schema__(self, source: object, handler: object) -> CoreSchema:
        from pydantic_core import core_schema  # noqa: PLC0415

        return core_schema.no_info_plain_validator_function(
            self._read,
            serialization=core_schema.plain_serializer_function_ser_schema(
                self.write, return_schema=core_schema.str_schema()
            ),
        )

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        written: dict[str, Any] = handler(schema) if handler.mode == "serialization" else {}
        return written or {"words": self.words}

    def _read(self, value: object) -> object:
        try:
            return self.read(value)
        except TypeError as error:
            raise ValueError(str(error)) from error


class LowerInJson:
    """For an enumeration whose words are upper case where people and records have them: in JSON,
    where all words are lower case, stand its names.
    """

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: Callable[[Any], CoreSchema]
    ) -> CoreSchema:
        from pydantic_core import core_schema  # noqa: PLC0415

        words = core_schema.literal_schema([member.name.lower() for member in source])
        schema: Any = handler(source)
        written = core_schema.plain_serializer_function_ser_schema(
            lambda member: member.name.lower(), return_schema=words
        )
        return {**schema, "serialization": written}
