"""JSON documents: the version of their schema, and conversion of values to JSON.

What `--json` prints, what files such as `--json-report` hold, and what is handed over to other
systems is written here alone, so that a type has one form.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, Final, cast

if TYPE_CHECKING:
    from pydantic import ConfigDict, TypeAdapter

SCHEMA_VERSION: Final = 3
"""Incremented when a field of any document changes its meaning or is removed; not for a new one."""


_CONFIG: Final[ConfigDict] = {
    "ser_json_bytes": "hex",
    "alias_generator": lambda name: name.rstrip("_"),
    "serialize_by_alias": True,
    "arbitrary_types_allowed": True,  # of fields that are no keys
}


@cache
def adapter(kind: Any) -> TypeAdapter[Any]:
    """Create the pydantic adapter of a type, which reads values and writes them as JSON:
    enumerations as their words, bytes in hexadecimal. A field `from_` is the key `from`.
    """
    from pydantic import TypeAdapter, with_config  # noqa: PLC0415  for JSON only

    if dataclasses.is_dataclass(kind):
        described: Any = with_config(_CONFIG)(cast("Any", kind))
        return TypeAdapter(described)
    return TypeAdapter(kind, config=_CONFIG)


@contextmanager
def descriptions() -> Iterator[None]:
    """Context manager in which adapters have the docstrings of fields, for schemas. Adapters for
    JSON alone have none: most of the time would be spent on finding them.
    """
    adapter.cache_clear()
    _CONFIG["use_attribute_docstrings"] = True  # of the classes with this configuration, too
    try:
        yield
    finally:
        del _CONFIG["use_attribute_docstrings"]
        adapter.cache_clear()


def as_json(document: object) -> Any:
    """Convert a document, an event or a part of one to plain JSON values."""
    kind: Any = type(document)
    return adapter(kind).dump_python(document, mode="json")
