"""Translations of the pages: Babel catalogues in `locale`, by their English sentences."""

from __future__ import annotations

import gettext
import io
from collections.abc import Callable, Iterable
from functools import cache
from importlib import resources
from typing import Final

from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po

from flasher.i18n import translate

NAMES: Final = {"en": "English", "de": "Deutsch", "zh": "\u4e2d\u6587"}
"""Native language names by code. English needs no catalogue."""


class Translator:
    """Translates into one language; `code` is for a page's `lang` attribute."""

    def __init__(self, code: str, translate: Callable[[str], str]) -> None:
        self.code = code
        self._translate = translate

    def __call__(self, text: str, **values: object) -> str:
        """Translate a text; `values` fill a page's own texts."""
        said = translate(text, self._translate)
        return said.format(**values) if values else said


@cache
def translator(code: str) -> Translator:
    """The translator for a code. Raises KeyError for an unknown one."""
    if code not in NAMES:
        raise KeyError(code)
    if code == "en":
        return Translator(code, str)
    source = resources.files("flasher.web").joinpath("locale", f"{code}.po")
    compiled = io.BytesIO()
    with source.open("rb") as file:
        write_mo(compiled, read_po(file, locale=code))
    compiled.seek(0)
    return Translator(code, gettext.GNUTranslations(compiled).gettext)


def chosen(wanted: str | None, accepted: Iterable[str]) -> Translator:
    """The translator that the address selects, else the browser's first supported language."""
    for code in (wanted or "", *accepted):
        if code.split("-")[0].lower() in NAMES:
            return translator(code.split("-")[0].lower())
    return translator("en")
