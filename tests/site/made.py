"""Parts of the reference that are made from the code while the site is built.

A page names them in a comment of its own line, so that a code host shows the page without them:

    <!-- made: commands upgrade a device -->
"""

from __future__ import annotations

import json
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final

import click
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

from flasher.cli.framework import CommandEntry, Program
from flasher.cli.help import HelpedCommand
from flasher.cli.main import PURPOSES, flasher
from flasher.conformance.profile import profile_keys, unstated
from flasher.release import trust
from flasher.settings import bike_set, bus, device_model, manifest, profile
from flasher.settings.toml_reader import Key, Reader
from flasher.station import codes, config, operators, recipe
from tests.schema_document import SCHEMA

_MADE: Final = re.compile(r"^<!-- made: (\S+) ?(.*) -->$", re.MULTILINE)
_Lines = Iterator[str]


def _cell(text: object) -> str:
    return " ".join(str(text).split()).replace("|", r"\|")


def _table(*head: str, rows: Iterator[Sequence[object]]) -> _Lines:
    yield f"| {' | '.join(head)} |"
    yield "|---" * len(head) + "|"
    for row in rows:
        yield f"| {' | '.join(map(_cell, row))} |"
    yield ""


# -- commands -------------------------------------------------------------------------------------


def _all_commands(_which: str) -> _Lines:
    for purpose, entries in PURPOSES.items():
        page = _page_of(purpose)
        rows = (
            (f"[`flasher {name}`]({page}.md#flasher-{name})", entry.summary)
            for name, entry in entries.items()
        )
        yield from (f"**{purpose[0].upper()}{purpose[1:]}**", "")
        yield from _table("command", "does", rows=rows)


def _page_of(purpose: str) -> str:
    return _PAGES[list(PURPOSES).index(purpose)]


_PAGES: Final = ("upgrade", "look", "trouble", "releases", "bootloaders", "line", "product")
"""The page of each group of commands."""


def _commands(page: str) -> _Lines:
    """The manual pages of a group of commands, or with "all" the options of every one."""
    if page == "all":
        yield from _options(flasher, "flasher")
        return
    for name, entry in _group(page).items():
        command = entry.load()
        yield from _manual(command, f"flasher {name}", level=2)


def _group(page: str) -> Mapping[str, CommandEntry]:
    return list(PURPOSES.values())[_PAGES.index(page)]


def _manual(command: click.Command, path: str, *, level: int) -> _Lines:
    context = click.Context(command, info_name=path)
    usage = " ".join(command.collect_usage_pieces(context))
    yield from (f"{'#' * level} {path}", "", f"`{path} {usage}`", "")
    yield from (_prose(command.help or ""), "")
    yield from _options(command, path)
    if isinstance(command, click.Group):
        for name, action in command.commands.items():
            yield from _manual(action, f"{path} {name}", level=level + 1)


def _prose(text: str) -> str:
    """Help as Markdown: text in `...` stays, and nothing else is a mark."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([<>*_\[\]{}|\\#])", r"\\\1", part)
        for part in parts
    )


def _options(command: click.Command, path: str) -> _Lines:
    shared = {param.name for param in flasher.params} if command is not flasher else set()
    panels: dict[str, list[click.Parameter]] = {}
    for param in command.params:
        if param.name not in shared:
            panels.setdefault(getattr(param, "panel", None) or "options", []).append(param)
    for panel, params in panels.items():
        rows = ((_names(param), _prose(_reported(param))) for param in params)
        yield from _table(f"{panel[0].upper()}{panel[1:]}", "meaning", rows=rows)
    if isinstance(command, HelpedCommand) and not isinstance(command, Program):
        yield from _examples(command.epilog or "")
        numbers = sorted({0, 1, 2, *(int(code) for code in command.exit_codes)})
        noted = ", ".join(str(number) for number in numbers)
        yield from (f"[Exit codes](../exit_codes.md) of `{path}`: {noted}.", "")


def _names(param: click.Parameter) -> str:
    if isinstance(param, click.Argument):
        return f"`{param.human_readable_name}`"
    assert isinstance(param, click.Option)
    value = ""
    if not param.is_flag and not param.count:
        choice = "|".join(param.type.choices) if isinstance(param.type, click.Choice) else ""
        value = f" {param.metavar or choice or param.type.name.upper()}"
    names = sorted(param.opts, key=len)
    return "<br>".join(f"`{name}{value if name == names[-1] else ''}`" for name in names)


def _reported(param: click.Parameter) -> str:
    text = getattr(param, "help", "") or ""
    default = param.default
    if param.required:
        return f"{text} (required)"
    shown = getattr(param, "show_default", False) and not isinstance(default, bool)
    return f"{text} (default {default})" if shown and default not in (None, ()) else text


def _examples(epilog: str) -> _Lines:
    head, _, rest = epilog.strip("\n").partition("\n\n")
    if head.startswith("examples:"):
        lines = head.removeprefix("examples:\n").splitlines()
        yield from ("```text", *(line.removeprefix("  ") for line in lines), "```", "")
        yield from (_prose(rest), "")


# -- files of settings ----------------------------------------------------------------------------


def _keys(keys: Mapping[str, Key] | Iterator[Key]) -> _Lines:
    each = keys.values() if isinstance(keys, Mapping) else keys
    rows = ((f"`{key.path}`", f"{_prose(key.text)}<br>{_value(key)}") for key in each)
    yield from _table("key", "meaning", rows=rows)


def _value(key: Key) -> str:
    default = "" if key.default in (None, "", [], {}) else f"; default `{key.default}`"
    return f"*{_prose(key.allowed)}*{default}"


def _file(kind: type[BaseModel]) -> _Lines:
    """The keys of a file, and of every table that may stand in it more than once."""
    yield from _keys(_single(kind))
    for name, field in kind.model_fields.items():
        for part in _repeated(field.annotation):
            named = typing.get_origin(field.annotation) is dict
            head = f"[{name}.NAME]" if named else f"[[{name}]]"
            yield from (f"### `{head}`", "", _prose(part.__doc__ or ""), "")
            yield from _keys(_single(part))


def _single(kind: type[BaseModel]) -> Iterator[Key]:
    tables = {name for name, field in kind.model_fields.items() if _repeated(field.annotation)}
    return (key for key in Reader(kind, "").keys.values() if key.path not in tables)


def _repeated(annotation: Any) -> list[type[BaseModel]]:
    """The tables that a key has a list of, or one for each of its names."""
    if typing.get_origin(annotation) not in (tuple, list, dict):
        return []
    parts = typing.get_args(annotation)
    return [each for each in parts if isinstance(each, type) and issubclass(each, BaseModel)]


_FILES: Final[Mapping[str, Callable[[], _Lines]]] = {
    "profile": lambda: _keys(profile.reader().keys),
    "bus": lambda: _keys(bus.READER.keys),
    "manifest": lambda: _keys(manifest.reader().keys),
    "bike": lambda: _file(bike_set.BikeSet),
    "trust": lambda: _keys(trust.reader().keys),
    "recipe": lambda: _file(recipe.Recipe),
    "station": lambda: _file(config.StationConfig),
    "badges": lambda: _file(operators.BadgeTable),
    "conformance": lambda: iter([_prose(unstated()), "", *_keys(profile_keys())]),
    "mock": lambda: _keys(device_model.reader().keys),
}


# -- JSON, events, codes --------------------------------------------------------------------------


@cache
def _schema() -> Mapping[str, Any]:
    """As drawn in its file: to build it takes 3 s."""
    return dict(json.loads(SCHEMA.read_text(encoding="utf-8"))["$defs"])


def _documents(prefix: str) -> _Lines:
    """The documents of the commands ("document"), the lines before them ("line"), or what both
    have in them ("part").
    """
    for name, form in _schema().items():
        kind, _, title = name.rpartition(".")
        if (kind or "part") != prefix or title == "none":
            continue
        yield from (f"## {title}", "")
        forms = form.get("anyOf", [form])
        # The last one is the failure, which is described once for all of them.
        for each in forms[:-1] if prefix == "document" else forms:
            yield from (_prose(each.get("description", "")), "")
            if "enum" in each:
                yield from (_type(each), "")
            if "properties" not in each:
                continue
            noted = {"schema", "event", "text", "command", "ok", "exit_code"}
            rows = [
                (f"`{key}`", _type(value), _prose(value.get("description", "")))
                for key, value in each["properties"].items()
                if key not in noted
            ]
            if any(row[2] for row in rows):
                yield from _table("key", "value", "meaning", rows=iter(rows))
            elif rows:
                yield from _table("key", "value", rows=(row[:2] for row in rows))


def _type(node: Mapping[str, Any]) -> str:
    """A JSON type in a word or two; what has a definition of its own is named."""
    if "$ref" in node:
        return str(node["$ref"]).rpartition("/")[2]
    if "anyOf" in node:
        return " or ".join(dict.fromkeys(_type(each) for each in node["anyOf"]))
    if "enum" in node or "const" in node:
        return ", ".join(f"`{value}`" for value in node.get("enum", [node.get("const")]))
    if node.get("type") == "array":
        return f"list of {_type(node.get('items', {}))}"
    return str(node.get("type", "any"))


def _station_codes(_which: str) -> _Lines:
    rows = (
        (f"`{code.name}`", code.outcome.value, code.meaning, code.action)
        for code in codes.CODES.values()
    )
    yield from _table("code", "outcome", "what is wrong", "what to do", rows=rows)


_MAKERS: Final[Mapping[str, Callable[[str], _Lines]]] = {
    "command-list": _all_commands,
    "commands": _commands,
    "file": lambda which: _FILES[which](),
    "json": _documents,
    "station-codes": _station_codes,
}


def fill(text: str) -> str:
    """A page with its made parts in it."""
    return _MADE.sub(lambda match: "\n".join(_MAKERS[match[1]](match[2])), text)


def _read(_app: Sphinx, _name: str, content: list[str]) -> None:
    content[0] = fill(content[0])


def setup(app: Sphinx) -> ExtensionMetadata:
    app.connect("source-read", _read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
