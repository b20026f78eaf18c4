"""Validating type annotations (number ranges, parsed texts, enumerations), and JSON keys.

`Annotated[int, NumberRange(ge=1, le=100)]`, `Annotated[str, Parsed("64 hex digits", read_sha256)]`.
Only modules that read or write files need the validation library.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

if TYPE_CHECKING:
    from pydantic_core import CoreSchema

_Type = TypeVar("_Type", bound=type)


@dataclass(frozen=True)
class Parsed:
    """Value that `read` parses; it raises ValueError or TypeError for an invalid one."""

    words: str
    """Description of valid values: "64 hex digits"."""
    read: Callable[[Any], object]
    write: Callable[[Any], str] = str
    """Formats a value for a document."""

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
    """Limits of a number: greater than `gt`, at least `ge`, at most `le`."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None

    def allows(self, value: float) -> bool:
        """Return True for a number within the limits."""
        return (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
        )

    def __get_pydantic_core_schema__(
        self, source: Any, handler: Callable[[Any], CoreSchema]
    ) -> CoreSchema:
        schema: Any = handler(source)
        given = {name: bound for name, bound in vars(self).items() if bound is not None}
        return {**schema, **given}


class LowerCaseInJson:
    """Writes the lower-case names of an enumeration in JSON, where its values are upper case."""

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


def json_keys(keys: str) -> Callable[[_Type], _Type]:
    """Set the JSON keys of a dataclass, in this order: names of fields and properties, separated by
    blanks; `key=name` sets another key than the name. JSON that is read must contain all of them; a
    `cached_property` then has the value that was read.
    """
    names = {key: name or key for key, _, name in (each.partition("=") for each in keys.split())}

    def declare(kind: _Type) -> _Type:
        def written(source: Any, handler: Any) -> CoreSchema:
            from pydantic import Field  # noqa: PLC0415
            from pydantic_core import core_schema  # noqa: PLC0415

            schema: CoreSchema = handler(source)
            whole: Any = handler.resolve_ref_schema(schema)
            fields = {field["name"]: field for field in whole["schema"]["fields"]}
            for name in names.values() - fields.keys():
                read = getattr(kind, name)
                read = getattr(read, "func", None) or read.fget  # cached_property, property
                hint = get_type_hints(read, include_extras=True).pop("return")
                value = handler.generate_schema(Annotated[hint, Field(description=read.__doc__)])
                fields[name] = core_schema.dataclass_field(name, value)
            whole["schema"]["fields"] = [
                {**fields[name], "serialization_alias": key, "validation_alias": key}
                for key, name in names.items()
            ]
            for field in whole["schema"]["fields"]:
                if field["schema"]["type"] == "default":
                    field["schema"] = field["schema"]["schema"]
            whole["fields"] = list(names.values())
            return schema

        kind.__get_pydantic_core_schema__ = staticmethod(written)  # type: ignore[attr-defined]
        return kind

    return declare
