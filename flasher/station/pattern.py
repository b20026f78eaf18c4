"""Serial-number patterns with bounded matching time, and check digits by python-stdnum.

Recipes are untrusted, and matching a regular expression such as `(A+)+` can take years. Patterns
are therefore a subset of Python's regular expressions: characters, classes, named groups that are
not repeated, counts (`{8}`, `{2,4}`, `?`) of single characters, and alternatives, but no unlimited
repetition. The product of all choices is at most `WAYS_MAX`.
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
    "Use characters, \\d, classes such as [0-9A-F], each followed by a count such as {8} or {2,4}, "
    "and groups such as (?P<lot>...) that are not repeated."
)


class Pattern:
    """A compiled pattern. Raises ValueError for an invalid or unbounded one."""

    def __init__(self, text: str) -> None:
        if len(text) > PATTERN_MAX:
            raise ValueError(f"the pattern is longer than {PATTERN_MAX} characters")
        ways = _ways(text)
        if ways > WAYS_MAX:
            raise ValueError(
                f"the pattern has {ways} ways to match a text, more than {WAYS_MAX}: "
                "use fixed counts"
            )
        try:
            self._compiled = re.compile(text, re.ASCII)
        except re.error as error:
            raise ValueError(f"the pattern is invalid: {error}") from error
        self.text = text

    @property
    def groups(self) -> tuple[str, ...]:
        return tuple(self._compiled.groupindex)

    def match(self, text: str) -> dict[str, str] | None:
        """Named groups if the pattern matches the whole text, else None. Unused groups are ""."""
        if len(text) > TEXT_MAX:
            return None
        match = self._compiled.fullmatch(text)
        return None if match is None else {k: v or "" for k, v in match.groupdict().items()}


@lru_cache(maxsize=64)
def pattern_of(text: str) -> Pattern:
    """Compile a pattern; cached. Raises ValueError."""
    return Pattern(text)


def _ways(text: str) -> int:
    """Number of ways to match a text. Raises ValueError for a pattern outside the subset."""
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
                    f"the count at {position + 1} does not follow a single character. {_ALLOWED}"
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
        raise ValueError(f"the count {token['count']} is not possible; the maximum is {TEXT_MAX}")
    return high - low + 1


def _check(form: str, is_right: Callable[[str], bool]) -> Callable[[str], bool]:
    """Restrict a check to texts of this form, since stdnum accepts more than allowed."""
    return lambda text: re.fullmatch(form, text) is not None and is_right(text)


CHECKS: Final = {
    "luhn": _check("[0-9]{2,}", luhn.is_valid),
    # Not `ean.is_valid`, which refuses the 18 digits of an SSCC.
    "gtin": _check("[0-9]{2,}", lambda text: bool(ean.calc_check_digit(text[:-1]) == text[-1])),
    "mod11-2": _check("[0-9]{2,}[0-9X]", mod_11_2.is_valid),
    "mod11-10": _check("[0-9]{2,}", mod_11_10.is_valid),
    "mod37-2": _check("[0-9A-Z]{2,}[0-9A-Z*]", mod_37_2.is_valid),
    "mod37-36": _check("[0-9A-Z]{2,}", mod_37_36.is_valid),
    "mod97-10": _check("[0-9A-Z]{3,}", mod_97_10.is_valid),
}
"""Check-digit functions by method, for a text with its check characters."""
