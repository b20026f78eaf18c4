"""Translation of pages and certificates: Babel catalogues in `locale`, keyed by English sentences.

A `Text` is translated by its template. Errors, stories and records contain plain English made by
f-strings; the catalogue has these with their values in braces ("There is no run {run_id}."), so
that the entry which matches a sentence gives its translation and its values. Sentences joined in a
text are translated one by one; a text without matching entry stays English.
"""

from __future__ import annotations

import gettext
import io
import re
from collections.abc import Iterable, Iterator
from functools import cache, lru_cache
from importlib import resources
from string import Formatter
from typing import Any, Final, NamedTuple

from flasher.i18n import Text

NAMES: Final = {"en": "English", "de": "Deutsch", "zh": "\u4e2d\u6587"}
"""Native language names by code. English needs no catalogue."""
_COMMA: Final = str.maketrans(",.", ".,")
_COMMA_LANGUAGES: Final = frozenset({"de"})
"""Languages that write 1.234,5."""
_NUMBER: Final = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?!\.?\d)")
_MARKS_MIN: Final = 4
"""Minimum characters of an entry besides values and spaces; fewer would match anything."""
_LENGTH_MAX: Final = 1000
_JOINTS_MAX: Final = 24
"""Maximum number of characters and joints in a text that is matched, which takes time that grows
with both. Longer texts come from files, devices and data bases, and no entry matches them."""
_JOINT: Final = re.compile(r"[.!?;:] | \(")
_QUANTITY: Final = re.compile(r"-?[\d,]+(?:\.\d+)? [A-Za-z%\N{MICRO SIGN}]{1,4}")
"""Number and unit."""
_LEADING: Final = re.compile(r"(?<![^.!? \N{IDEOGRAPHIC FULL STOP}])\{\w+\} ?")
"""Value at the beginning of a sentence, in place of another sentence."""
_BETWEEN: Final = re.compile(r"(?<=[.!?]) (?=\S)|(?<=\N{IDEOGRAPHIC FULL STOP})(?=\S)")
"""Space between two sentences."""
_SENTENCES: Final = re.compile(r"(.+?[.!?])( )([A-Z].*)()", re.DOTALL)
_CLAUSES: Final = re.compile(r"((?:[^()]|\([^()]*\))+?)(; )(.+)()", re.DOTALL)
_BRACKETS: Final = re.compile(r"(.+?)( \()(.+)(\))", re.DOTALL)
_COLON: Final = re.compile(r"(.+?)(: )(.+)()", re.DOTALL)
"""Patterns of texts that are joined from several ones."""
_WHOLE: Final = re.compile(r"(?:(?![.!?] [A-Z]|; ).)*", re.DOTALL)
"""Values that are not joined themselves."""
_BALANCED: Final = re.compile(r"(?:[^()]|\([^()]*\))*")
"""Values with whole brackets."""
_ANY: Final = re.compile(r".*", re.DOTALL)
_FULL_STOPS: Final = {"zh": "\N{IDEOGRAPHIC FULL STOP}"}


class _Entry(NamedTuple):
    """Sentence with values, and the longest part that each of its texts has."""

    template: str
    regex: str
    landmark: str


class _Formatted(str):
    """Value from an English sentence, formatted there."""

    __slots__ = ()


class _Converted(str):
    """Text whose numbers are in the language's format."""

    __slots__ = ()


class Translator(Formatter):
    """Translates into one language; `code` is for a page's `lang` attribute."""

    def __init__(self, code: str, catalogue: gettext.NullTranslations) -> None:
        self.code = code
        self._gettext = catalogue.gettext
        self._entries = sorted(_entries(catalogue), key=lambda entry: -len(entry.landmark))
        self._stop = _FULL_STOPS.get(code, ".")
        self._sentences = dict(_sentences(catalogue))
        self._plain = lru_cache(4096)(self._translate_plain)
        """Translate plain English, cached."""

    def __call__(self, sentence: str, **values: object) -> str:
        """Translate a sentence; `values` fill the placeholders of a page's own sentence."""
        if isinstance(sentence, Text):
            values |= sentence.values
            sentence = sentence.template
        elif not values:
            return self._plain(sentence)
        template = self._gettext(sentence) if sentence else ""
        return self.vformat(template, (), values) if values else template

    def numbers(self, text: str) -> str:
        """Convert the numbers of a text from English, 1,234.5, to the language's format."""
        if self.code not in _COMMA_LANGUAGES:
            return text
        return _Converted(_NUMBER.sub(lambda number: number[0].translate(_COMMA), text))

    def _translate_plain(self, sentence: str) -> str:
        translated = self._known(sentence)
        if translated or " " not in sentence or not self._entries:
            return translated or sentence
        if len(sentence) > _LENGTH_MAX or len(_JOINT.findall(sentence)) > _JOINTS_MAX:
            return sentence
        if _QUANTITY.fullmatch(sentence):
            return self.numbers(sentence)
        return (
            self._labelled(sentence)
            or self._matched(sentence, _WHOLE)
            or self._split(sentence, _SENTENCES)
            or self._split(sentence, _CLAUSES)
            or self._matched(sentence, _BALANCED)
            or self._matched(sentence, _ANY)
            or self._matched(f"{sentence}.", _ANY).removesuffix(self._stop)
            or self._split(sentence, _BRACKETS)
            or self._split(sentence, _COLON)
            or self._without_stop(sentence)
            or sentence
        )

    def _known(self, sentence: str) -> str:
        """Translate a whole entry, with or without its full stop; "" for an unknown sentence."""
        if sentence in self._sentences:
            return self._sentences[sentence]
        bare = sentence.removesuffix(".")
        return f"{self._sentences[bare]}{self._stop}" if bare in self._sentences else ""

    def _labelled(self, sentence: str) -> str:
        """Translate a known word, a colon and the text after it; "" for other sentences."""
        label, colon, rest = sentence.partition(": ")
        translated = self._sentences.get(label, "")
        return f"{translated}{colon}{self._plain(rest)}" if rest and translated else ""

    def _matched(self, sentence: str, values: re.Pattern[str]) -> str:
        """Translate by the entry that matches with such values; "" without one."""
        for entry in self._entries:
            is_near = entry.landmark in sentence
            found = _pattern(entry.regex).fullmatch(sentence) if is_near else None
            has_other_end = values is _WHOLE and sentence[-1:] == "." != entry.template[-1:]
            if found is None or has_other_end or not all(map(values.fullmatch, found.groups())):
                continue
            formatted = {name: _Formatted(text) for name, text in found.groupdict().items()}
            return self.vformat(self._gettext(entry.template), (), formatted)
        return ""

    def _split(self, sentence: str, joint: re.Pattern[str]) -> str:
        """Translate the parts of a joined text; "" if it is not joined, or no part is known."""
        parts = joint.fullmatch(sentence)
        if parts is None:
            return ""
        first, between, second, end = parts.groups()
        joined = "".join([self._plain(first), between, self._plain(second), end])
        return joined if joined != sentence else ""

    def _without_stop(self, sentence: str) -> str:
        """Translate a sentence that the catalogue has without full stop; "" otherwise."""
        bare = sentence.removesuffix(".")
        translated = self._plain(bare) if bare != sentence else bare
        return "" if translated == bare else f"{translated}{self._stop}"

    # -- filling in values ------------------------------------------------------------------------

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Text):
            return self(value)
        if isinstance(value, _Converted):
            return format(str(value), format_spec)
        if isinstance(value, _Formatted):
            text = str(value)
            bare = text.strip()
            return self.numbers(text) if format_spec else text.replace(bare, self._plain(bare))
        text = format(value, format_spec)
        if isinstance(value, str):
            return self._plain(text) if " " in text else text
        return self.numbers(text)

    def convert_field(self, value: Any, conversion: Any) -> Any:
        return value if isinstance(value, _Formatted) else super().convert_field(value, conversion)


def _sentences(catalogue: gettext.NullTranslations) -> Iterator[tuple[str, str]]:
    """Yield each sentence of entries with several; then the entries, which take precedence."""
    entries = {key: text for key, text in getattr(catalogue, "_catalog", {}).items() if key}
    for entry in entries.items():
        english, other = (_BETWEEN.split(_LEADING.sub("", each)) for each in entry)
        if len(english) == len(other) > 1:
            yield from (pair for pair in zip(english, other, strict=True) if "{" not in pair[0])
    yield from entries.items()


def _entries(catalogue: gettext.NullTranslations) -> Iterator[_Entry]:
    for template in getattr(catalogue, "_catalog", ()):
        regex, landmark, marks, names = "", "", 0, set[str]()
        for literal, name, _, _ in Formatter().parse(template):
            regex += re.escape(literal)
            landmark = max(landmark, literal, key=len)
            marks += len(literal) - literal.count(" ")
            if name is not None:
                regex += f"(?P={name})" if name in names else f"(?P<{name}>.*?)"
                names.add(name)
        if names and marks >= _MARKS_MIN:
            yield _Entry(template, regex, landmark)


@cache  # only entries whose landmark was read need theirs
def _pattern(regex: str) -> re.Pattern[str]:
    return re.compile(regex, re.DOTALL)


@cache
def translator(code: str) -> Translator:
    """Return the translator for a language code. Raises KeyError for an unknown one."""
    if code not in NAMES:
        raise KeyError(code)
    if code == "en":
        return Translator(code, gettext.NullTranslations())
    from babel.messages.mofile import write_mo  # noqa: PLC0415  of an extra
    from babel.messages.pofile import read_po  # noqa: PLC0415

    source = resources.files("flasher").joinpath("locale", f"{code}.po")
    compiled = io.BytesIO()
    with source.open("rb") as file:
        write_mo(compiled, read_po(file, locale=code))
    compiled.seek(0)
    return Translator(code, gettext.GNUTranslations(compiled))


ENGLISH: Final = translator("en")


def chosen(wanted: str | None, accepted: Iterable[str]) -> Translator:
    """Return the translator selected by the address or by the browser's languages."""
    for code in (wanted or "", *accepted):
        if code.split("-")[0].lower() in NAMES:
            return translator(code.split("-")[0].lower())
    return translator("en")
