"""Sentences that can be said in another language: what the operator of a station reads.

`say("Put {serial} into socket {socket}.", serial="W1", socket="A")` is a `str`, the English
sentence, everywhere. It also knows its template and values, so that a page can say it by a
catalogue of templates. A value that was said itself is translated too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Gettext = Callable[[str], str]


class Said(str):
    """A sentence with what it was made of."""

    __slots__ = ("template", "values")
    template: str
    values: dict[str, Any]

    def __new__(cls, template: str, values: dict[str, Any]) -> Said:
        said = super().__new__(cls, template.format(**values) if values else template)
        said.template, said.values = template, values
        return said

    def __reduce__(self) -> tuple[type[Said], tuple[str, dict[str, Any]]]:
        return Said, (self.template, self.values)


def say(template: str, **values: Any) -> Said:
    """The sentence of an English template; its values stand where it names them in braces."""
    return Said(template, values)


def with_value(text: str, old: str, new: str) -> str:
    """A text with another one in the place of `old`, which may be a value of any sentence in it."""
    if not isinstance(text, Said) or not text.values:
        return new if text == old else text
    values = {
        name: with_value(value, old, new) if isinstance(value, str) else value
        for name, value in text.values.items()
    }
    return Said(text.template, values)


def in_language(text: str, gettext: Gettext) -> str:
    """A text as `gettext` says it: a sentence by its template, another text as it stands in the
    catalogue, and as it is where the catalogue does not know it.
    """
    if not text:
        return ""
    if not isinstance(text, Said):
        return gettext(text)
    template = gettext(text.template)
    if not text.values:
        return template
    values = {
        name: in_language(value, gettext) if isinstance(value, Said) else value
        for name, value in text.values.items()
    }
    return template.format(**values)
