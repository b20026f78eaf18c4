"""How types become JSON Schema, and values of them JSON."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from enum import Enum, IntEnum, StrEnum
from functools import cached_property
from typing import Literal

import pytest
from pydantic import PydanticUserError, TypeAdapter, ValidationError

from flasher.documents import adapter, as_json
from flasher.validation import LowerCaseInJson, json_keys
from tests.schema import schema_of
from tests.schema_document import mismatches


class Colour(Enum):
    DARK_RED = "dark_red"


class State(LowerCaseInJson, StrEnum):
    PASS = "PASS"  # noqa: S105
    FAIL = "FAIL"


class Number(IntEnum):
    SEVEN = 7


@dataclass(frozen=True)
class Point:
    """A place."""

    x_m: float
    """To the right."""
    name: str | None


@dataclass(frozen=True)
class Thing:
    """A thing."""

    colour: Colour
    state: State
    number: Number
    points: list[Point]
    pair: tuple[int, str]
    by_name: dict[str, Point]
    from_: bytes
    note: Literal["a", "b"] | None = None


THING = Thing(
    Colour.DARK_RED,
    State.PASS,
    Number.SEVEN,
    [Point(0.5, None)],
    (1, "x"),
    {"p": Point(1.0, "p")},
    b"\x00\xff",
)


def test_descriptions_are_collected_for_schemas_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time of a short command; a process may print JSON before a schema."""
    adapter.cache_clear()
    with monkeypatch.context() as patched:
        patched.setattr(inspect, "findsource", None)
        assert as_json(Point(0.5, None)) == {"x_m": 0.5, "name": None}
        assert as_json(THING)["by_name"] == {"p": {"x_m": 1.0, "name": "p"}}
    described = schema_of(Thing)["$defs"]["Point"]["properties"]["x_m"]
    assert described["description"] == "To the right."


def test_a_dataclass_becomes_a_closed_object_with_its_texts() -> None:
    schema = schema_of(Thing)
    properties, point = schema["properties"], schema["$defs"]["Point"]
    assert schema["required"] == list(properties)
    assert schema["required"][-2:] == ["from", "note"], "what has a default is there too"
    assert schema["additionalProperties"] is False
    assert schema["$defs"]["Colour"]["enum"] == ["dark_red"]
    assert schema["$defs"]["State"]["enum"] == ["pass", "fail"]
    assert properties["note"]["anyOf"][0]["enum"] == ["a", "b"]
    assert properties["by_name"]["additionalProperties"] == {"$ref": "#/$defs/Point"}
    assert properties["pair"]["prefixItems"] == [{"type": "integer"}, {"type": "string"}]
    assert point["properties"]["x_m"] == {"type": "number", "description": "To the right."}
    assert point["properties"]["name"] == {"anyOf": [{"type": "string"}, {"type": "null"}]}
    assert (schema["description"], point["description"]) == ("A thing.", "A place.")


def test_a_value_is_written_as_its_type_is_described() -> None:
    written = as_json(THING)
    assert not mismatches(written, schema_of(Thing))
    assert written == {
        "colour": "dark_red",
        "state": "pass",
        "number": 7,
        "points": [{"x_m": 0.5, "name": None}],
        "pair": [1, "x"],
        "by_name": {"p": {"x_m": 1.0, "name": "p"}},
        "from": "00ff",
        "note": None,
    }


class Opaque:
    """No type of a document."""


def test_a_type_without_a_schema_is_refused() -> None:
    with pytest.raises(PydanticUserError, match="Opaque"):
        schema_of(Opaque)


@json_keys("area_m2 long=length_m")
@dataclass(frozen=True)
class Field:
    """A field."""

    length_m: float
    """From end to end."""
    width_m: float = 1.0

    @property
    def area_m2(self) -> float:
        """Of its ground."""
        return self.length_m * self.width_m


def test_a_type_names_its_keys_which_are_fields_and_properties_in_any_order() -> None:
    assert list(as_json(Field(2.0, 3.0)).items()) == [("area_m2", 6.0), ("long", 2.0)]
    schema = schema_of(Field)
    assert schema["required"] == list(schema["properties"]) == ["area_m2", "long"]
    assert schema["properties"]["area_m2"] == {"description": "Of its ground.", "type": "number"}
    assert schema["properties"]["long"]["description"] == "From end to end."


def test_a_type_that_names_its_keys_has_them_inside_of_another_too() -> None:
    @dataclass(frozen=True)
    class Farm:
        fields: tuple[Field, ...]
        best: Field | None = None

    assert as_json(Farm((Field(1.0),), Field(2.0))) == {
        "fields": [{"area_m2": 1.0, "long": 1.0}],
        "best": {"area_m2": 2.0, "long": 2.0},
    }


def test_a_type_that_names_its_keys_is_read_by_them_and_keeps_what_was_derived() -> None:
    @json_keys("seen=count sum")
    @dataclass(frozen=True)
    class Tally:
        count: int = 0
        values: tuple[int, ...] = ()

        @cached_property
        def sum(self) -> int:
            return sum(self.values)

    assert as_json(Tally(2, (3, 4))) == {"seen": 2, "sum": 7}
    found = TypeAdapter(Tally).validate_python({"seen": 2, "sum": 7})
    assert (found.count, found.sum, found.values) == (2, 7, ())
    for missing in ("seen", "sum"):
        with pytest.raises(ValidationError):
            TypeAdapter(Tally).validate_python({missing: 2})
