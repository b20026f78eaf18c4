"""Label templates: ZPL that is filled in with the values of a recorded run.

    ^XA
    ^FO40,40^BQN,2,6^FDQA,{{ serial }}^FS
    ^FO40,220^FH^FD{{ recipe | fh }}^FS
    ^XZ

The template runs in a sandbox. Values cannot contain printer commands: `^`, `~` and control
characters become `?`. In a field with ^FH, the filter `fh` prints all characters unchanged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from jinja2 import StrictUndefined, TemplateError
from jinja2.sandbox import ImmutableSandboxedEnvironment

from flasher.errors import UsageError
from flasher.files import read
from flasher.protocol.text import printable
from flasher.station.recipe import Recipe
from flasher.station.records.model import RunRecord

FILE_MAX_SIZE: Final = 64 * 1024
"""Bytes."""
LABEL_MAX_SIZE: Final = 1024 * 1024
_COMMANDS: Final = "^~"
_PLAIN: Final = frozenset("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz-. ")


def _neutral(value: object) -> str:
    return "".join(
        "?" if char in _COMMANDS or not char.isprintable() else char for char in str(value)
    )


def _hex(value: object) -> str:
    """Escape a value for a field with ^FH: all but plain characters as UTF-8 bytes (`_5E`)."""
    return "".join(
        char if char in _PLAIN else "".join(f"_{byte:02X}" for byte in char.encode())
        for char in str(value)
    )


class LabelTemplate:
    """A label template, tried with sample values when it is loaded. Raises UsageError."""

    def __init__(self, path: Path, sample: dict[str, object]) -> None:
        raw = read(path, FILE_MAX_SIZE, what="label template")
        environment = ImmutableSandboxedEnvironment(
            undefined=StrictUndefined,
            finalize=_neutral,
            autoescape=False,
            keep_trailing_newline=True,
        )
        environment.filters["fh"] = _hex
        where = printable(str(path))
        known = f"Known values are {', '.join(sample)}."
        try:
            self._template = environment.from_string(raw.decode("utf-8-sig"))
            self.fill(sample)
        except UnicodeDecodeError as error:
            raise UsageError("The label template is not a text file.", where=where) from error
        except Exception as error:
            what = f"The label template cannot be filled in: {printable(str(error))}."
            raise UsageError(what, where=where, remedy=known) from error

    def fill(self, values: dict[str, object]) -> bytes:
        """Fill in the template. Raises any exception of the template."""
        made: list[str] = []
        size = 0
        for part in self._template.generate(values):
            size += len(part)
            if size > LABEL_MAX_SIZE:
                raise TemplateError("the label is too large")
            made.append(part)
        return "".join(made).encode()


def values_of(run: RunRecord, groups: dict[str, str]) -> dict[str, object]:
    """Values of a run for a template. `groups`: groups of its serial number."""
    ended_at = (run.ended_at or run.begun_at).astimezone()
    return {
        "serial": run.serial,
        "part": run.part,
        "lot": run.lot or "",
        "recipe": run.recipe,
        "revision": run.recipe_revision,
        "operator": run.operator,
        "station": run.station,
        "socket": run.socket,
        "run": int(run.run_id),
        "date": f"{ended_at:%Y-%m-%d}",
        "time": f"{ended_at:%H:%M:%S}",
        "match": groups,
    }


def sample_of(recipe: Recipe, station: str) -> dict[str, object]:
    """Sample values for the example of a recipe, with the keys of `values_of`."""
    example = recipe.serial_number.example
    return {
        "serial": example,
        "part": recipe.part,
        "lot": "LOT1",
        "recipe": recipe.name,
        "revision": recipe.revision,
        "operator": "Jo",
        "station": station,
        "socket": "A",
        "run": 1,
        "date": "2026-05-17",
        "time": "09:00:00",
        "match": recipe.serial_number.read(example),
    }
