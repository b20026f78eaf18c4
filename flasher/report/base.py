"""HTML rendering: template environment, escaping, and filters common to all pages.

A page is one file with its style inside, without scripts or external resources (its
Content-Security-Policy forbids both). Every value passes HTML escaping and `visible`, which escapes
characters that reorder, hide or pile up text. So text from a device is safe anywhere in a template.
"""

from __future__ import annotations

import unicodedata
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, Final

from jinja2 import BaseLoader, Environment, PackageLoader, StrictUndefined

from flasher.report import scale
from flasher.translation import Translator, translator
from flasher.wording import wording

TEXT_LIMIT: Final = 400
"""Maximum number of characters of a text on a page; longer ones end in an ellipsis."""
_UNSAFE_CATEGORIES: Final = ("C", "M", "Zl", "Zp")
"""Unicode categories: control, format (text direction), surrogates, unassigned; combining marks;
separators of lines and paragraphs."""
PAGE_STYLE: Final = Path(__file__).parent / "templates" / "page.css"
"""Style sheet of all documents."""
_ELLIPSIS: Final = "\N{HORIZONTAL ELLIPSIS}"


class Status(Enum):
    """Rating of a result. The value is its class in the style sheet; a page always adds a word."""

    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"
    NEUTRAL = "neutral"


def visible(text: str) -> str:
    """Escape invisible and combining characters; newline and tab are kept."""
    return "".join(
        char.encode("unicode_escape").decode()
        if unicodedata.category(char).startswith(_UNSAFE_CATEGORIES) and char not in "\n\t"
        else char
        for char in text
    )


def shortened(text: str, limit: int = TEXT_LIMIT) -> str:
    """Truncate `text` to `limit` characters with an ellipsis."""
    return text if len(text) <= limit else text[: limit - 1].rstrip() + _ELLIPSIS


def counted(number: int) -> str:
    """Format a whole number with commas: 65,535."""
    return f"{number:,}"


def percent(share: float) -> str:
    """Format a share of 1 in percent: 87 %, 0.4 %, 0 %; a share above 1 as text."""
    if share > 1.02:  # time stamps are wrong by less
        return "more than the line carries"
    value = min(share, 1) * 100
    return f"{value:.1f} %" if 0.05 <= value < 9.95 else f"{value:.0f} %"


def render_page(template: str, language: str = "en", **context: Any) -> str:
    """Render a template of `templates/` with `context` in a language.

    Raises jinja2.UndefinedError for a name missing from `context`.
    """
    return _environment(language).get_template(template).render(**context)


def _finalize(value: object) -> object:
    """Escape every value that a template prints, except our own markup."""
    return visible(value) if isinstance(value, str) and not hasattr(value, "__html__") else value


def environment(loader: BaseLoader, translate: Translator) -> Environment:
    """Create the template environment of a language. It has the globals `_` (translation) and
    `lang`; its templates raise jinja2.UndefinedError for a missing name.
    """
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_finalize,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["duration"] = lambda seconds: translate.numbers(scale.duration_text(seconds))
    made.filters["counted"] = lambda number: translate.numbers(counted(number))
    made.filters["wording"] = lambda word: translate(wording(word))
    made.filters["percent"] = lambda share: translate.numbers(translate(percent(share)))
    made.filters["share"] = lambda share: translate.numbers(f"{scale.share_percent(share):.1f} %")
    made.filters["fixed"] = lambda value, digits: translate.numbers(f"{value:.{digits}f}")
    made.filters["number"] = translate.numbers
    made.filters["translated"] = translate
    made.filters["shortened"] = shortened
    made.globals.update(Status=Status, _=translate, lang=translate.code)
    return made


@cache
def _environment(language: str) -> Environment:
    return environment(PackageLoader("flasher.report"), translator(language))
