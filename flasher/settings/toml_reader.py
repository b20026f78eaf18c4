"""TOML reader: validates a file against a type, and reports all its problems at once.

Fields of the type are the keys, annotations their limits, docstrings after the fields their help.
Error messages and tables of the documentation are made from it.
"""

from __future__ import annotations

import datetime
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cached_property
from typing import Any, Final, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, with_config
from pydantic_core import to_json

from flasher.errors import Fault, FlasherError, UsageError, did_you_mean, printable
from flasher.files import parse_file, read_toml

ModelT = TypeVar("ModelT")
Location = tuple[str | int, ...]
"""Place in a document: keys, and indexes of lists."""
Detail = tuple[str, Location, str]
"""Validation error of pydantic: type, place and text."""
CONFIG: Final = ConfigDict(
    extra="forbid",
    frozen=True,
    strict=True,  # no conversion between numbers and texts
    allow_inf_nan=False,
    use_attribute_docstrings=True,
    defer_build=True,
)
FAULTS_SHOWN: Final = 8
_UNKNOWN: Final = frozenset({"extra_forbidden", "unexpected_keyword_argument"})
_NO_TABLE: Final = frozenset({"dataclass_type", "model_type", "dict_type"})
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_HEXADECIMAL: Final = frozenset({0x7FF, 0xFFFF, 0xFFFF_FFFF})
"""Limits that are shown in hexadecimal."""


class TomlTable(BaseModel):
    """Base of tables that are pydantic models."""

    model_config = CONFIG


@dataclass(frozen=True)
class Key:
    """Key of a settings file, for help and documentation."""

    path: str
    """Name with its tables, such as `limits.erase_s`."""
    default: Any
    allowed: str
    """Description of the allowed values."""
    choices: tuple[str, ...]
    """Allowed words of a choice."""
    text: str
    """Help text."""


class Reader(Generic[ModelT]):
    """Reads files of one type, which messages call `what`.

    `beside` are fields of the type that are not in the file; `also` are keys of the file that are
    not fields of the type. `remedy` is appended to the remedy of each message.
    """

    def __init__(
        self,
        kind: type[ModelT],
        what: str,
        *,
        error: type[FlasherError] = UsageError,
        remedy: str = "",
        beside: Sequence[str] = (),
        also: Sequence[str] = (),
    ) -> None:
        described = with_config(CONFIG)(kind) if is_dataclass(kind) else kind
        self._adapter: TypeAdapter[ModelT] = TypeAdapter(described)
        self._what = what
        self._error = error
        self._remedy = remedy
        self._beside = frozenset(beside)
        self._also = tuple(also)

    @cached_property
    def _root(self) -> _Schema:
        schema = self._adapter.json_schema()
        return _Schema(schema, schema.get("$defs", {}))

    @cached_property
    def keys(self) -> dict[str, Key]:
        """All keys by path, without keys inside lists."""
        found = self._root.keys(())
        return {key.path: key for key in found if key.path not in self._beside}

    def load(
        self, path: str | os.PathLike[str], *, if_missing: str = "Correct the name.", **beside: Any
    ) -> ModelT:
        """Read a file. Raises UsageError if it does not exist, else `error` with all problems."""
        document = read_toml(path, what=self._what, error=self._error, if_missing=if_missing)
        return self.read(document, path, **beside)

    def parse(self, raw: bytes, path: str | os.PathLike[str], **beside: Any) -> ModelT:
        """Read the bytes of a file. Raises `error` with all problems."""
        return self.read(parse_file(raw, path, what=self._what, error=self._error), path, **beside)

    def read(
        self, document: Mapping[str, Any], path: str | os.PathLike[str], **beside: Any
    ) -> ModelT:
        """Read a parsed document. Raises `error` with all problems."""
        value, faults = self.check(document, **beside)
        if value is None or faults:
            raise self.refusal(path, faults)
        return value

    def check(
        self,
        document: Mapping[str, Any],
        prefix: Location = (),
        *,
        is_whole: bool = True,
        **beside: Any,
    ) -> tuple[ModelT | None, list[Fault]]:
        """Read a parsed document, or the table `prefix` of one; return the value and all problems.
        Missing keys are a problem of a whole document only.
        """
        invalid: list[Location] = []
        plain = _for_json(dict(document), (), invalid)
        value = None
        details: list[Detail] = [("invalid", at, "") for at in invalid]
        details += [("extra_forbidden", (name,), "") for name in document if name in self._beside]
        try:
            # As JSON, in which `strict` allows what a file may contain: a list for a tuple, a word
            # for an enumeration, but no text for a number.
            text = to_json(plain | beside, inf_nan_mode="constants")
            value = self._adapter.validate_json(text)
        except ValidationError as error:
            details += [
                (each["type"], each["loc"], str(each.get("ctx", {}).get("error", each["msg"])))
                for each in error.errors(include_url=False)
                if is_whole or each["type"] != "missing"
            ]
        return value, self._faults(document, details, prefix)

    def refusal(self, path: str | os.PathLike[str], faults: Sequence[Fault]) -> FlasherError:
        """Create the error for a file with these problems."""
        shown = printable(os.fspath(path))
        if len(faults) == 1:
            (fault,) = faults
            remedy = " ".join(filter(None, (fault.remedy, self._remedy)))
            error = self._error(fault.alone or fault.sentence, where=shown, remedy=remedy)
        else:
            listed = [f"{shown}: {fault}" for fault in faults[:FAULTS_SHOWN]]
            if len(faults) > FAULTS_SHOWN:
                listed.append(f"and {len(faults) - FAULTS_SHOWN} more")
            error = self._error(
                f"The {self._what} {shown} has {len(faults)} faults.",
                where="\n         ".join(listed),
                remedy=self._remedy or f"Correct the {self._what}.",
            )
        return error.with_faults(faults)

    # -- faults -----------------------------------------------------------------------------------

    def _faults(
        self, document: Mapping[str, Any], details: Sequence[Detail], prefix: Location
    ) -> list[Fault]:
        unknown: dict[Location, list[str]] = {}
        missing: dict[Location, list[str]] = {}
        wrong: dict[str, Fault] = {}
        places = [location for kind, location, _ in details if kind != "too_short"]
        for kind, location, sentence in details:
            if kind == "too_short" and any(each[: len(location)] == location for each in places):
                continue  # the length of a list with errors is not reported
            at, value = _existing_part(document, location)
            if kind == "missing":
                missing.setdefault(location[:-1], []).append(str(location[-1]))
            elif kind in _UNKNOWN or location[-1:] == ("[key]",):
                unknown.setdefault(at[:-1], []).append(str(at[-1]))
            else:
                fault = self._wrong(kind, at, value, sentence, prefix)
                wrong.setdefault(fault.place, fault)
        lacking = [
            self.fault((*prefix, *at), f"has no {' and no '.join(names)}.")
            for at, names in missing.items()
        ]
        # Unknown keys first: one may be a misspelled missing key.
        strange = [each for at, keys in unknown.items() for each in self._unknown(at, keys, prefix)]
        return [*strange, *lacking, *wrong.values()]

    def _unknown(self, location: Location, keys: list[str], prefix: Location) -> Iterator[Fault]:
        """Yield the unknown keys of a table; the first one lists the known keys."""
        table = (*prefix, *location)
        names = [
            *(() if table else self._also),
            *(name for name in self._root.at(location).names if name not in self._beside),
        ]
        spelled = {path.rpartition(".")[2]: location_text((*prefix, path)) for path in self.keys}
        spelled |= {name: name for name in names}
        where = f" in [{location_text(table)}]" if table else ""
        for key in keys:
            close = did_you_mean(key.lower(), spelled, spelled.__getitem__)
            known = f"Known are: {', '.join(names)}." if key == keys[0] else ""
            yield Fault(
                location_text((*table, key)),
                "unknown key.",
                (close + known).strip(),
                f"The {self._what} has an unknown key {key!a:.60}{where}.",
            )

    def _wrong(
        self, kind: str, location: Location, value: object, sentence: str, prefix: Location
    ) -> Fault:
        place = location_text((*prefix, *location))
        schema = self._root.at(location)
        if kind in _NO_TABLE:
            return self.fault((*prefix, *location), f"is a table, [{place}].")
        if kind in ("value_error", "assertion_error") and not schema.has_words:
            return Fault(place, f"{printable(sentence)}.")
        name = next((part for part in reversed(location) if isinstance(part, str)), "")
        close = did_you_mean(value, schema.choices) if isinstance(value, str) else ""
        remedy = f"{close}It is {schema.allowed(name)}"
        remedy += f": {schema.text}" if schema.text else "."
        return self.fault((*prefix, *location), f"cannot be {value!a:.60}.", remedy)

    def fault(self, location: Location, what: str, remedy: str = "") -> Fault:
        """Create a problem; `what` begins with a verb, whose subject is the place or the file."""
        place = location_text(location)
        return Fault(place, f"{place or f'The {self._what}'} {what}", remedy)


@dataclass(frozen=True)
class _Schema:
    """Part of a JSON Schema."""

    node: Mapping[str, Any]
    definitions: Mapping[str, Any]

    @cached_property
    def kinds(self) -> tuple[_Schema, ...]:
        """Alternatives without null, with references resolved."""
        node = self.node
        if "$ref" in node:
            node = self.definitions[node["$ref"].rpartition("/")[2]]
        if "anyOf" not in node:
            return (_Schema(node, self.definitions),)
        parts = [_Schema(each, self.definitions) for each in node["anyOf"]]
        return tuple(each for part in parts for each in part.kinds if each.node != _NULL)

    def at(self, location: Location) -> _Schema:
        """Schema at a place; empty if unknown."""
        if not location:
            return self
        part = location[0]
        for each in self.kinds:
            if isinstance(part, int):
                found = each.node.get("items")
            else:
                found = each.node.get("properties", {}).get(part)
                found = found or each.node.get("additionalProperties")
            if isinstance(found, dict):  # True or False: no limits, or no other keys
                return _Schema(found, self.definitions).at(location[1:])
        return _Schema({}, {})

    def keys(self, table: Location) -> Iterator[Key]:
        """Yield the keys of a table and of its tables."""
        for name in self.kinds[0].node.get("properties", {}):
            place, found = (*table, name), self.at((name,))
            if "properties" in found.kinds[0].node:
                yield from found.keys(place)
            else:
                default = found.node.get("default")
                allowed, choices = found.allowed(name), tuple(found.choices)
                yield Key(location_text(place), default, allowed, choices, found.text)

    @property
    def names(self) -> list[str]:
        """Keys of a table."""
        node = self.kinds[0].node
        names = node.get("propertyNames", {})
        return list(node.get("properties", _Schema(names, self.definitions).choices))

    @property
    def choices(self) -> list[str]:
        """Allowed words of a choice."""
        return [str(word) for each in self.kinds for word in each.node.get("enum", ())]

    @property
    def has_words(self) -> bool:
        """True if the type has its own description of its values."""
        return any("words" in each.node for each in self.kinds)

    @property
    def text(self) -> str:
        """Help text."""
        return " ".join(str(self.node.get("description", "")).split())

    def allowed(self, name: str) -> str:
        """Description of the allowed values; `name` is the key, which may end with a unit."""
        return " or ".join(dict.fromkeys(each.words(name) for each in self.kinds))

    def words(self, name: str) -> str:
        """Description of the allowed values of one kind."""
        match self.node:
            case {"words": str() as words}:
                return words
            case {"enum": words}:
                return ", ".join(map(str, words))
            case {"const": word}:
                return str(word)
            case {"type": "boolean"}:
                return "true or false"
            case {"type": "integer"}:
                return f"a whole number{self._bounds()}"
            case {"type": "number"}:
                return f"{'seconds' if name.endswith('_s') else 'a number'}{self._bounds()}"
            case {"type": "array", "items": items}:
                each = _Schema(items, self.definitions).allowed(name)
                each = each.replace("a text", "texts", 1).replace("a table", "tables", 1)
                return f"a list of {each}{', not empty' if self.node.get('minItems') else ''}"
            case {"type": "string", "format": "time"}:
                return "a time of day"
            case {"type": "string"}:
                return f"a text{self._size()}"
            case _:
                return "a table"

    def _bounds(self) -> str:
        node = self.node
        low, above = node.get("minimum"), node.get("exclusiveMinimum")
        high, below = node.get("maximum"), node.get("exclusiveMaximum")
        start = f" above {_number(above)}" if above is not None else ""
        start = f" from {_number(low)}" if low is not None else start
        end = f" below {_number(below)}" if below is not None else ""
        return start + (f" to {_number(high)}" if high is not None else end)

    def _size(self) -> str:
        low, high = self.node.get("minLength", 0), self.node.get("maxLength")
        pattern = f" of the form {self.node['pattern']}" if "pattern" in self.node else ""
        size = f" of {low} to {high} characters" if high is not None else ""
        return size or pattern or (" that is not empty" if low else "")


_NULL: Final = {"type": "null"}


def location_text(location: Location) -> str:
    """Format a place, such as `target[0].base`."""
    place = ""
    for part in location:
        name = f"[{part}]" if isinstance(part, int) else printable(part)[:60]
        place += name if isinstance(part, int) or not place else f".{name}"
    return place


def _number(value: float) -> str:
    return f"0x{value:X}" if value in _HEXADECIMAL else f"{value:.12g}"


def _existing_part(document: Any, location: Location) -> tuple[Location, object]:
    """Return the part of a location that exists in the document, and its value."""
    for at, part in enumerate(location):
        is_there = (isinstance(document, dict) and part in document) or (
            isinstance(document, list) and isinstance(part, int) and part < len(document)
        )
        if not is_there:
            return location[:at], document
        document = document[part]
    return location, document


def _for_json(value: Any, at: Location, invalid: list[Location]) -> Any:
    """Convert to a JSON value. Adds to `invalid` the places of values that no setting accepts:
    dates, and command-line texts that are not Unicode.
    """
    match value:
        case dict():
            return {key: _for_json(each, (*at, key), invalid) for key, each in value.items()}
        case list():
            return [_for_json(each, (*at, n), invalid) for n, each in enumerate(value)]
        case str() if not _SURROGATE.search(value):
            return value
        case datetime.date() | str():
            invalid.append(at)
            return None
        case _:
            return value
