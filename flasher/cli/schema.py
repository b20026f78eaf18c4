"""The JSON Schema (draft 2020-12) of everything that `--json` prints, made from the type hints of
the documents (`flasher.cli.documents`, the commands' modules) and of the events (`flasher.events`).

Nothing is described twice: names and types are the hints', descriptions are the docstrings.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from enum import Enum, IntEnum
from types import ModuleType, NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NotRequired,
    Required,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from flasher import events
from flasher.cli.documents import SCHEMA_VERSION, Envelope, ErrorDocument, LineEnvelope
from flasher.cli.main import COMMANDS

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_SIMPLE: Final[dict[object, dict[str, Any]]] = {
    NoneType: {"type": "null"},
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": "number"},
    str: {"type": "string"},
    datetime: {"type": "string", "format": "date-time"},
    bytes: {"type": "string", "pattern": "^([0-9a-f]{2})*$"},
    object: {},
    Any: {},
}
_LISTS: Final = (list, tuple, Sequence, Iterable, frozenset, set)
_MAPPINGS: Final = (dict, Mapping)


class Definitions:
    """Schemas of type hints. Every class is described once, in `found`, and referred to."""

    def __init__(self) -> None:
        self.found: dict[str, dict[str, Any]] = {}
        self._classes: dict[str, type] = {}

    def of(self, hint: Any, *, by_name: bool = False) -> dict[str, Any]:
        """The schema of a type hint; numbered choices are shown by their numbers, or by name.

        Raises TypeError for a hint that has no schema.
        """
        hint = getattr(hint, "__supertype__", hint)  # of a NewType
        simple = _SIMPLE.get(hint) if _is_hashable(hint) else None
        if simple is not None:
            return dict(simple)
        if get_origin(hint) is not None:
            return self._of_generic(hint)
        if isinstance(hint, type) and issubclass(hint, IntEnum) and not by_name:
            return {"enum": [int(member) for member in hint]}
        if isinstance(hint, type) and issubclass(hint, Enum):
            return {"enum": [member.name.lower() for member in hint]}
        if hint in _LISTS:
            return {"type": "array"}
        if hint in _MAPPINGS:
            return {"type": "object"}
        if is_typeddict(hint) or dataclasses.is_dataclass(hint):
            return self._reference(hint)
        raise TypeError(f"{hint!r} has no JSON Schema")

    def _of_generic(self, hint: Any) -> dict[str, Any]:
        origin, parts = get_origin(hint), get_args(hint)
        if origin is Annotated:
            shown, meant = parts[:2]
            return (
                self.of(meant, by_name=shown is str) if isinstance(meant, type) else self.of(shown)
            )
        if origin in (NotRequired, Required):
            return self.of(parts[0])
        if origin is Literal:
            return {"enum": list(parts)} if len(parts) > 1 else {"const": parts[0]}
        if origin in (Union, UnionType):
            return {"anyOf": [self.of(part) for part in parts]}
        if origin is tuple and parts[-1] is not Ellipsis:
            items = [self.of(part) for part in parts]
            return {"type": "array", "prefixItems": items, "minItems": len(items), "items": False}
        if origin in _LISTS:
            return {"type": "array", "items": self.of(parts[0])}
        if origin in _MAPPINGS:
            return {"type": "object", "additionalProperties": self.of(parts[1])}
        raise TypeError(f"{hint!r} has no JSON Schema")

    def _reference(self, described: type) -> dict[str, Any]:
        name = described.__name__
        if self._classes.setdefault(name, described) is not described:
            raise TypeError(f"two classes of the documents are named {name}")
        if name not in self.found:
            self.found[name] = {}  # a class that holds itself refers to this
            self.found[name] = closed(*self.properties(described), summary_of(described))
        return {"$ref": f"#/$defs/{name}"}

    def properties(self, described: Any) -> tuple[dict[str, Any], list[str]]:
        """The schema of each field of a TypedDict or dataclass, and the required names."""
        hints = get_type_hints(described, include_extras=True)
        texts = _field_texts(described)
        properties = {}
        for name, hint in hints.items():
            properties[name] = self.of(hint)
            if name in texts:
                properties[name]["description"] = texts[name]
        return properties, [name for name in hints if _is_required(described, name, hints[name])]


def closed(
    properties: Mapping[str, Any], required: Sequence[str], description: str
) -> dict[str, Any]:
    """The schema of an object with these properties and no others."""
    return {
        "description": description,
        "type": "object",
        "properties": dict(properties),
        "required": list(required),
        "additionalProperties": False,
    }


def _is_hashable(hint: object) -> bool:
    return getattr(type(hint), "__hash__", None) is not None


def _is_required(described: Any, name: str, hint: Any) -> bool:
    """Hints are text when a class is made, so that a TypedDict itself cannot tell NotRequired."""
    if not is_typeddict(described):
        return True
    return name in described.__required_keys__ and get_origin(hint) is not NotRequired


def summary_of(described: type) -> str:
    """The docstring of a class as one paragraph; for one without, nothing."""
    return " ".join((inspect.getdoc(described) or "").split())


def _field_texts(described: type) -> dict[str, str]:
    """The docstrings that stand behind the fields of a class, its bases' too."""
    texts: dict[str, str] = {}
    for base in getattr(described, "__orig_bases__", described.__bases__):
        if is_typeddict(base) or dataclasses.is_dataclass(base):
            texts |= _field_texts(base)
    try:
        body = ast.parse(textwrap.dedent(inspect.getsource(described))).body[0]
    except OSError:  # a TypedDict made by a call has no class statement
        return texts
    assert isinstance(body, ast.ClassDef)  # noqa: S101  the source of a class is one
    for field, behind in zip(body.body, body.body[1:], strict=False):
        match field, behind:
            case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=text)):
                texts[name] = " ".join(str(text).split())
    return texts


# -- everything that is printed --------------------------------------------------------------------


def build() -> dict[str, Any]:
    """The whole schema. `#/$defs/document.NAME` is the document of a command, `#/$defs/line.NAME`
    an event or another line that a command prints before it.
    """
    known = Definitions()
    lines = [_add_line(known, event) for event in event_classes()]
    documents = []
    for command, module in command_modules().items():
        lines += [_add_line(known, line) for line in getattr(module, "LINES", ())]
        documents.append(_add_documents(known, command, getattr(module, "DOCUMENTS", ())))
    documents.append(_add_documents(known, None, ()))
    return {
        "$schema": DIALECT,
        "title": f"What flasher --json prints, version {SCHEMA_VERSION}",
        "description": "One document; where events are wanted or a command streams, one line for "
        "each of them before it, told by their key `event`.",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in dict.fromkeys(documents + lines)],
        "$defs": dict(sorted(known.found.items())),
    }


def event_classes() -> list[type]:
    """Every class of events, in the order of flasher.events."""
    return [
        each
        for each in vars(events).values()
        if isinstance(each, type)
        and dataclasses.is_dataclass(each)
        and each.__module__ == events.__name__
    ]


def command_modules() -> dict[str, ModuleType]:
    """The module of every command."""
    return {command: entry.module() for command, entry in COMMANDS.items()}


def _add_line(known: Definitions, described: type) -> str:
    """A line: an event by the name of its class, or a TypedDict that has the key `event`."""
    properties, required = known.properties(LineEnvelope)
    own, own_required = known.properties(described)
    if "event" not in own:
        text = {"type": "string", "description": "The same in words, where a command has them."}
        own = {"event": {"const": described.__name__}, **own, "text": text}
        own_required = ["event", *own_required]
    name = f"line.{own['event']['const']}"
    properties["schema"] = _version()
    known.found[name] = closed(
        {**properties, **own}, [*required, *own_required], summary_of(described)
    )
    return name


def _add_documents(known: Definitions, command: str | None, documents: Sequence[type]) -> str:
    """The documents of a command: each of its own, and how a failure looks."""
    base, required = known.properties(Envelope)
    base["schema"] = _version()
    base["command"] = {"const": command}
    forms = []
    told: dict[str, list[dict[str, Any]]] = {}
    for described in documents:
        own, own_required = known.properties(described)
        for key, value in own.items():
            if value not in told.setdefault(key, []):
                told[key].append(value)
        needed = list(dict.fromkeys([*required, *own_required]))
        forms.append(closed({**own, **base}, needed, summary_of(described)))
    known_by_then = {
        key: values[0] if len(values) == 1 else {"anyOf": values} for key, values in told.items()
    }
    error = {"ok": {"const": False}, "error": known.of(ErrorDocument)}
    forms.append(
        closed(
            {**known_by_then, **base, **error},
            [*required, "error"],
            "A failure, with as much as was known by then.",
        )
    )
    name = f"document.{command or 'none'}"
    known.found[name] = {"anyOf": forms}
    return name


def _version() -> dict[str, Any]:
    return {"const": SCHEMA_VERSION, "description": "Version of this schema."}
