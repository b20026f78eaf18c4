"""How type hints become JSON Schema."""

from __future__ import annotations

import dataclasses
from enum import Enum, IntEnum
from typing import Annotated, Any, Literal, NotRequired, TypedDict

import pytest

from flasher.cli.schema import Definitions


class Colour(Enum):
    DARK_RED = "#800000"


class Number(IntEnum):
    SEVEN = 7


@dataclasses.dataclass(frozen=True)
class Point:
    """A place."""

    x_m: float
    """To the right."""
    name: str | None


class Base(TypedDict):
    """What both have."""

    colour: Annotated[str, Colour]


class Thing(Base):
    """A thing."""

    points: list[Point]
    pair: tuple[int, str]
    by_name: dict[str, Thing]
    note: NotRequired[Literal["a", "b"]]


def test_a_typed_dict_becomes_a_closed_object_with_its_texts() -> None:
    known = Definitions()
    assert known.of(Thing) == {"$ref": "#/$defs/Thing"}
    thing, point = known.found["Thing"], known.found["Point"]
    assert thing["required"] == ["colour", "points", "pair", "by_name"]
    assert thing["additionalProperties"] is False
    assert thing["properties"]["colour"] == {"enum": ["dark_red"]}
    assert thing["properties"]["note"] == {"enum": ["a", "b"]}
    assert thing["properties"]["by_name"]["additionalProperties"] == {"$ref": "#/$defs/Thing"}
    assert thing["properties"]["pair"]["prefixItems"] == [{"type": "integer"}, {"type": "string"}]
    assert point["properties"]["x_m"] == {"type": "number", "description": "To the right."}
    assert point["properties"]["name"] == {"anyOf": [{"type": "string"}, {"type": "null"}]}
    assert (thing["description"], point["description"]) == ("A thing.", "A place.")


def test_numbered_choices_are_their_numbers_where_they_are_numbers() -> None:
    assert Definitions().of(Number) == {"enum": [7]}
    assert Definitions().of(Annotated[int, Number]) == {"enum": [7]}
    assert Definitions().of(Annotated[str, Number]) == {"enum": ["seven"]}


@pytest.mark.parametrize("hint", [complex, type[int], "text"])
def test_a_type_without_a_schema_is_named(hint: Any) -> None:
    with pytest.raises(TypeError, match="has no JSON Schema"):
        Definitions().of(hint)


def test_two_classes_of_one_name_are_refused() -> None:
    known = Definitions()
    known.of(Point)
    with pytest.raises(TypeError, match="two classes"):
        known.of(dataclasses.make_dataclass("Point", ["x"]))
