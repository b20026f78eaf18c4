"""JSON Schema (draft 2020-12) of the output of `--json`, made by pydantic from the types of the
documents (`DOCUMENTS` and `LINES` of the commands' modules) and of the events.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, Final

from pydantic import TypeAdapter
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from flasher import events
from flasher.cli.documents import Envelope, ErrorDocument
from flasher.cli.main import COMMANDS
from flasher.documents import SCHEMA_VERSION, adapter, descriptions

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
_REFERENCE: Final = re.compile(r'"#/\$defs/([^"]+)"')
Schema = dict[str, Any]


class _Generator(GenerateJsonSchema):
    """Requires every field of a document, and forbids others."""

    def field_title_should_be_set(self, schema: Any) -> bool:
        return False

    def field_is_required(self, field: Any, total: bool) -> bool:
        return True

    def dataclass_schema(self, schema: core_schema.DataclassSchema) -> Schema:
        return {**super().dataclass_schema(schema), "additionalProperties": False}

    def default_schema(self, schema: core_schema.WithDefaultSchema) -> Schema:
        return self.generate_inner(schema["schema"])


def build() -> Schema:
    """Create the whole schema. `#/$defs/document.NAME` is the document of a command,
    `#/$defs/line.NAME` an event or another line that a command prints before it.
    """
    modules = command_modules()
    lines = event_classes()
    for module in modules.values():
        lines += getattr(module, "LINES", ())
    documents = {command: tuple(module.DOCUMENTS) for command, module in modules.items()}
    described = [*lines, *(each for each in documents.values() for each in each), ErrorDocument]
    with descriptions():
        wanted = dict.fromkeys([Envelope, *described])
        schemas, shared = TypeAdapter.json_schemas(
            [(each, "serialization", adapter(each)) for each in wanted],
            ref_template="#/$defs/{model}",
            schema_generator=_Generator,
        )
    known: Schema = shared.get("$defs", {})

    def table(kind: type) -> Schema:
        schema = schemas[(kind, "serialization")]
        return known[schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema

    envelope = table(Envelope)
    envelope["properties"]["schema"]["const"] = SCHEMA_VERSION
    found: Schema = {}
    for line in lines:
        name, form = _line(line, table(line), envelope["properties"]["schema"])
        found[f"line.{name}"] = form
    for command, kinds in [*documents.items(), (None, ())]:
        forms = list(_documents(command, [table(kind) for kind in kinds], envelope))
        forms[-1]["properties"]["error"] = schemas[(ErrorDocument, "serialization")]
        found[f"document.{command or 'none'}"] = {"anyOf": forms}
    for form in (*found.values(), *known.values()):
        _tidy(form)
    return {
        "$schema": DIALECT,
        "title": f"Output of flasher --json, version {SCHEMA_VERSION}",
        "description": "One document. With events, or from a streaming command, lines precede it, "
        "one for each event; the key `event` names its type.",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in found],
        "$defs": dict(sorted({**_needed(found, known), **found}.items())),
    }


def schema_of(kind: Any) -> Schema:
    with descriptions():
        return adapter(kind).json_schema(
            mode="serialization", schema_generator=_Generator, ref_template="#/$defs/{model}"
        )


def event_classes() -> list[type]:
    """List the event classes, in the order of flasher.events."""
    return [
        each
        for each in vars(events).values()
        if isinstance(each, type)
        and dataclasses.is_dataclass(each)
        and each.__module__ == events.__name__
    ]


def command_modules() -> dict[str, ModuleType]:
    """Import the module of every command."""
    return {command: entry.module() for command, entry in COMMANDS.items()}


def _line(kind: type, own: Schema, version: Schema) -> tuple[str, Schema]:
    """Return name and schema of a line: an event, or a type that has the key `event`."""
    properties = {"schema": version, **own["properties"]}
    if "event" not in own["properties"]:
        text = {"type": "string", "description": "The event as text, from commands that have one."}
        properties |= {"event": {"const": kind.__name__}, "text": text}
    required = [name for name in properties if name != "text" or name in own["properties"]]
    name = properties["event"]["const"]
    return name, _closed(properties, required, own["description"])


def _documents(command: str | None, own: Sequence[Schema], envelope: Schema) -> Iterator[Schema]:
    """Yield the documents of a command: each of its own, and the document of a failure."""
    around = {**envelope["properties"], "command": {"const": command}}
    by_key: dict[str, list[Schema]] = {}
    for each in own:
        for key, value in each["properties"].items():
            if value not in by_key.setdefault(key, []):
                by_key[key].append(value)
        properties = {**each["properties"], **around}
        yield _closed(properties, list(properties), each["description"])
    by_then = {
        key: forms[0] if len(forms) == 1 else {"anyOf": forms} for key, forms in by_key.items()
    }
    yield _closed(
        {**by_then, **around, "ok": {"const": False}, "error": {}},
        [*around, "error"],
        "A failure, with the data known so far.",
    )


def _closed(properties: Mapping[str, Any], required: Sequence[str], description: str) -> Schema:
    return {
        "description": description,
        "type": "object",
        "properties": dict(properties),
        "required": list(required),
        "additionalProperties": False,
    }


def _tidy(part: Any) -> None:
    """Join lines of descriptions; remove titles that repeat a name."""
    for each in part.values() if isinstance(part, dict) else part:
        if isinstance(each, dict | list):
            _tidy(each)
    if isinstance(part, dict) and isinstance(part.get("title"), str):
        del part["title"]
    if isinstance(part, dict) and isinstance(part.get("description"), str):
        part["description"] = " ".join(part["description"].split())


def _needed(found: Schema, known: Schema) -> Schema:
    """Return the referenced definitions."""
    needed: Schema = {}
    open_ones = _REFERENCE.findall(json.dumps(found))
    while open_ones:
        name = open_ones.pop()
        if name in known and name not in needed:
            needed[name] = known[name]
            open_ones += _REFERENCE.findall(json.dumps(known[name]))
    return needed
