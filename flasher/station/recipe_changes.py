"""Differences between two recipes, in sentences for the person who approves the new one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.recipe_file import LoadedRecipe

_SHOWN_MAX: Final = 120
"""Characters of a value."""
_IMAGE: Final = ("target", "sha256", "size_bytes", "source")
"""Keys of a manifest that the image has, too."""
_KEYED: Final = {
    "write": ("target", "item"),
    "unchanged": ("target", "item"),
    "limit": ("target", "step", "item", "field"),
}
"""Tables of a recipe that occur several times, and the keys that name one."""


def changes(before: LoadedRecipe, after: LoadedRecipe) -> tuple[str, ...]:
    """What the new recipe does differently; empty if it does the same."""
    old, new = _facts(before), _facts(after)
    return tuple(
        _change(name, old.get(name), new.get(name))
        for name in dict.fromkeys((*old, *new))
        if old.get(name) != new.get(name)
    )


def _change(name: str, old: str | None, new: str | None) -> str:
    if old is None:
        return text("{name}: new, {value}", name=name, value=_shown(new))
    if new is None:
        return text("{name}: no longer, was {value}", name=name, value=_shown(old))
    return text("{name}: {new}, was {old}", name=name, new=_shown(new), old=_shown(old))


def _shown(value: str | None) -> str:
    shown = printable(value or "-")
    return shown if len(shown) <= _SHOWN_MAX else f"{shown[:_SHOWN_MAX]}..."


def _facts(loaded: LoadedRecipe) -> dict[str, str]:
    """Everything that a recipe states, by a name that a person understands."""
    recipe = loaded.recipe
    found: dict[str, str] = {}
    for target in loaded.targets:
        name = target.name.upper()
        image = f"{target.image.sha256[:16]}, {target.path.name}"
        found[text("{target} image", target=name)] = f"{target.version or '-'}, {image}"
        release = {key: value for key, value in vars(target.release).items() if key not in _IMAGE}
        found |= _flat(text("{target} manifest", target=name), release)
        rules = target.firmware.model_dump(mode="json", exclude={"target", "image", "sha256"})
        found |= _flat(name, rules)
    found[text("order of the targets")] = ", ".join(each.name.upper() for each in loaded.targets)
    found |= _flat("", recipe.model_dump(mode="json", exclude={"target", *_KEYED}))
    for table, keys in _KEYED.items():
        rows = [each.model_dump(mode="json") for each in getattr(recipe, table)]
        for row in rows:
            name = " ".join((table, *(str(row.pop(key)) for key in keys)))
            stated = _flat("", row)
            found[name] = ", ".join(f"{key} {value}" for key, value in stated.items()) or "-"
    found[text("order of the writes")] = ", ".join(f"{e.target} {e.item}" for e in recipe.write)
    if recipe.profile:
        hashes = {path.name: sha256 for path, sha256 in loaded.files.items()}
        found[text("content of the profile")] = hashes.get(recipe.profile.split("/")[-1], "")[:16]
    return found


def _flat(prefix: str, values: Mapping[str, Any]) -> dict[str, str]:
    return dict(_pairs(prefix, values))


def _pairs(prefix: str, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for key, value in values.items():
        name = text("{prefix} {key}", prefix=prefix, key=key) if prefix else key
        if isinstance(value, Mapping):
            yield from _pairs(name, value)
        elif value not in (None, "", [], ()):
            is_list = isinstance(value, list | tuple)
            yield name, ", ".join(map(str, value)) if is_list else str(value)
