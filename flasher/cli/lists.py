"""Options that take several values, and the positional argument behind them.

python-can's `--bus-kwargs a=1 b=2`, `--timing` and `--filter` swallow every word that follows, the
image file too, and of two such options the second hides the first. Words that cannot be a value end
the list here; the values of all lists of one name go together to the end of the command line, where
nothing is left to swallow.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

_KEY_VALUE: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*=\S*")
_LISTS: Final = {
    "--bus-kwargs": _KEY_VALUE,
    "--timing": _KEY_VALUE,
    "--filter": re.compile(r"[0-9A-Fa-f]+[:~][0-9A-Fa-f]+"),
}
"""Each such option, with what its values look like."""
_ONLY_POSITIONAL: Final = "--"


def gather_lists(words: Sequence[str]) -> list[str]:
    """The command line with the lists at its end, but before `--`."""
    kept: list[str] = []
    lists: dict[str, list[str]] = {}
    rest = list(words)
    while rest and rest[0] != _ONLY_POSITIONAL:
        word = rest.pop(0)
        option, equals, value = word.partition("=")
        if option not in _LISTS:
            kept.append(word)
            continue
        values = lists.setdefault(option, [])
        if equals:
            values.append(value)
            continue
        # The first value is taken whatever it is: python-can says what is wrong with it.
        if rest and not rest[0].startswith("-"):
            values.append(rest.pop(0))
        while rest and _LISTS[option].fullmatch(rest[0]):
            values.append(rest.pop(0))
    gathered = [word for option, values in lists.items() for word in (option, *values)]
    return [*kept, *gathered, *rest]
