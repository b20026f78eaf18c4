"""Translatable sentences: an English text that keeps its template and values.

`text("Put {serial} into socket {socket}.", serial="W1", socket="A")` is the English sentence, a
`str`. It keeps its template and values, so that a page can translate the template and fill in the
values. A value that is a `Text` is translated too.
"""

from __future__ import annotations

import re
from typing import Any, Final


class Text(str):
    """Sentence with its template and values."""

    __slots__ = ("template", "values")
    template: str
    values: dict[str, Any]

    def __new__(cls, template: str, values: dict[str, Any]) -> Text:
        sentence = super().__new__(cls, template.format(**values) if values else template)
        sentence.template, sentence.values = template, values
        return sentence

    def __reduce__(self) -> tuple[type[Text], tuple[str, dict[str, Any]]]:
        return Text, (self.template, self.values)


def text(template: str, **values: Any) -> Text:
    """Fill an English template; the sentence can be translated later."""
    return Text(template, values)


def with_value(sentence: str, old: str, new: str) -> str:
    """Replace a value of a sentence, at any depth."""
    if not isinstance(sentence, Text) or not sentence.values:
        return new if sentence == old else sentence
    values = {
        name: with_value(value, old, new) if isinstance(value, str) else value
        for name, value in sentence.values.items()
    }
    return Text(sentence.template, values)


_WAIVES: Final = re.compile(r"; --allow-[\w-]+ waives this.*(?=\)\.?$)", re.DOTALL)
_JOINED: Final = re.compile(r"\{\w+\}( \{\w+\})*")
"""Matches the template of joined sentences, which are translated one by one."""
_OPTION: Final = re.compile(r"(?<!\w)--[a-z]")


def without_options(message: str) -> str:
    """Leave out what a message says of options of the command line, for readers without one."""
    if not _OPTION.search(message):
        return message
    sentences: list[str] = re.split(r"(?<=[.!?]) ", _WAIVES.sub("", message))
    if isinstance(message, Text) and _JOINED.fullmatch(message.template):
        sentences = list(message.values.values())
    kept = [each for each in sentences if not _OPTION.search(each)]
    return kept[0] if len(kept) == 1 else " ".join(kept)
