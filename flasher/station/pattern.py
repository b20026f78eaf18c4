"""Serial numbers: patterns that cannot take long, and check digits by python-stdnum.

A recipe comes from outside, and a pattern such as `(A+)+` can take a regular expression years. So a
pattern is a part of Python's language in which the work is bounded before it is used: characters,
classes, named groups that are not repeated, counts (`{8}`, `{2,4}`, `?`) on single characters, and
alternatives. Nothing repeats without end. The ways in which a text can be tried are the product of
the choices, and at most `WAYS_MAX`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Final

from stdnum import ean, luhn
from stdnum.iso7064 import mod_11_2, mod_11_10, mod_37_2, mod_37_36, mod_97_10

TEXT_MAX: Final = 64
"""Longest serial number in characters."""
PATTERN_MAX: Final = 200
WAYS_MAX: Final = 10_000
_TOKEN: Final = re.compile(
    r"(?P<open>\((?:\?P<(?P<name>[A-Za-z_][A-Za-z0-9_]*)>|\?:|(?!\?)))"
    r"|(?P<close>\))"
    r"|(?P<bar>\|)"
    r"|(?P<count>\{(?P<low>[0-9]{1,2})(?:,(?P<high>[0-9]{1,2}))?\}|\?)"
    r"|(?P<one>\[\^?(?:\\[dw\]\\.^-]|[^\]\[\\])+\]|\\[dwAZ.\\()\[\]{}|?*+^$/-]|[^\\()\[\]{}|?*+^$])",
    re.ASCII,
)
_ALLOWED: Final = (
    "Use characters, \\d, classes as [0-9A-F], counts as {8} or {2,4} behind them, and groups as "
    "(?P<lot>...) that are not repeated."
)


class Pattern:
    """A pattern whose work is bounded. Raises ValueError saying what is not allowed."""

    def __init__(self, text: str) -> None:
        if len(text) > PATTERN_MAX:
            raise ValueError(f"the pattern is longer than {PATTERN_MAX} characters")
        ways = _ways(text)
        if ways > WAYS_MAX:
            raise ValueError(
                f"the pattern leaves {ways} ways to read a text, {WAYS_MAX} are allowed: "
                "give fixed counts"
            )
        try:
            self._compiled = re.compile(text, re.ASCII)
        except re.error as error:
            raise ValueError(f"the pattern is not right: {error}") from error
        self.text = text

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(self._compiled.groupindex)

    def match(self, text: str) -> dict[str, str] | None:
        """The named groups when the whole text fits the pattern, else None. A group that took no
        part is empty.
        """
        if len(text) > TEXT_MAX:
            return None
        found = self._compiled.fullmatch(text)
        return None if found is None else {k: v or "" for k, v in found.groupdict().items()}


@lru_cache(maxsize=64)
def pattern_of(text: str) -> Pattern:
    """The pattern, made once. Raises ValueError."""
    return Pattern(text)


def _ways(text: str) -> int:
    """The product of all choices. Raises ValueError for what is not in the language."""
    position, ways, depth = 0, 1, 0
    alternatives = [1]
    may_repeat = False
    while position < len(text):
        token = _TOKEN.match(text, position)
        if token is None:
            raise ValueError(
                f"{text[position]!a} at {position + 1} is not allowed here. {_ALLOWED}"
            )
        kind = token.lastgroup
        if token["count"]:
            if not may_repeat:
                raise ValueError(
                    f"a count at {position + 1} stands behind no single character. {_ALLOWED}"
                )
            ways *= _choices(token)
        elif token["open"]:
            depth += 1
            alternatives.append(1)
        elif token["close"]:
            if not depth:
                raise ValueError("a closing bracket without an opening one")
            depth -= 1
            ways *= alternatives.pop()
        elif kind == "bar":
            alternatives[-1] += 1
        may_repeat = token["one"] is not None
        position = token.end()
    if depth:
        raise ValueError("an opening bracket without a closing one")
    return ways * alternatives[0]


def _choices(token: re.Match[str]) -> int:
    if token["low"] is None:  # the question mark
        return 2
    low = int(token["low"])
    high = int(token["high"] or low)
    if not low <= high <= TEXT_MAX:
        raise ValueError(f"a count {token['count']} is not possible, {TEXT_MAX} is the most")
    return high - low + 1


def _check(form: str, is_right: Callable[[str], bool]) -> Callable[[str], bool]:
    """A check of texts of this form; stdnum's own take more than their standards allow."""
    return lambda text: re.fullmatch(form, text) is not None and is_right(text)


CHECKS: Final = {
    "luhn": _check("[0-9]{2,}", luhn.is_valid),
    # Of any length: stdnum's `is_valid` knows no SSCC.
    "gtin": _check("[0-9]{2,}", lambda text: bool(ean.calc_check_digit(text[:-1]) == text[-1])),
    "mod11-2": _check("[0-9]{2,}[0-9X]", mod_11_2.is_valid),
    "mod11-10": _check("[0-9]{2,}", mod_11_10.is_valid),
    "mod37-2": _check("[0-9A-Z]{2,}[0-9A-Z*]", mod_37_2.is_valid),
    "mod37-36": _check("[0-9A-Z]{2,}", mod_37_36.is_valid),
    "mod97-10": _check("[0-9A-Z]{3,}", mod_97_10.is_valid),
}
"""Each takes the whole text, check characters included; texts of another form are not valid."""
