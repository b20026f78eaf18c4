"""What a type says of its values beyond its name: the bounds of a number, the form of a text, the
words of an enumeration.

It stands in an annotation: `Annotated[int, Bounds(ge=1, le=100)]`, `Annotated[str, Form("64 hex
digits", read_sha256)]`. The validation library is needed only by who reads or writes files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic_core import CoreSchema


@dataclass(frozen=True)
class Parsed:
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


@dataclass(frozen=True)
class NumberRange:
    """The range of a number: above `gt` or from `ge` on, up to `le`."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None

    def __get_pydantic_core_schema__(
        self, source: Any, handler: Callable[[Any], CoreSchema]
    ) -> CoreSchema:
        schema: Any = handler(source)
        given = {name: bound for name, bound in vars(self).items() if bound is not None}
        return {**schema, **given}


class LowerCaseInJson:
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
