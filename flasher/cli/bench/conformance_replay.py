"""The command that runs one case again, on the same bench and with the same seed."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from typing import Final

from flasher.conformance.results import RunReport

_DROPPED: Final = {
    "--case": None,
    "--group": None,
    "--quick": 0,
    "--list": 0,
    "--seed": 1,
    "--repeat": 1,
    "--timeout": 1,
    "--junit": 1,
    "--json-report": 1,
    "--html": 1,
    "--trace-dir": 1,
    "--json": 0,
    "--events": 0,
    "--verbose": 0,
    "--quiet": 0,
    "--log-file": 1,
    "-v": 0,
    "-vv": 0,
    "-q": 0,
}
"""Options that are about the selection or the reports, with how many values they take; None: all
words up to the next option. The rest of a command line is about the bench."""
_KEPT: Final = ("--allow-implausible", "--second-image", "--set", "--strict")
"""Options that an abbreviation of a dropped one could be taken for."""


def replay_commands(report: RunReport, command_line: Sequence[str]) -> dict[tuple[str, int], str]:
    """The command for each result, by case id and repeat; `command_line` is without the program."""
    bench = ["flasher", *_about_the_bench(command_line)]
    found = {}
    for result in report.results:
        words = [*bench, "--case", result.case_id, "--seed", report.seed]
        if result.repeat > 1:
            words += ["--repeat", str(result.repeat)]
        found[result.key] = shlex.join(words)
    return found


def _about_the_bench(words: Sequence[str]) -> Iterator[str]:
    rest = list(words)
    while rest:
        word = rest.pop(0)
        name, equals, _ = word.partition("=")
        values = _DROPPED.get(_whole(name), -1)
        if values == -1:
            yield word
        elif not equals:
            while rest and (values is None or values) and not _is_option(rest[0], values):
                rest.pop(0)
                values = values and values - 1


def _whole(name: str) -> str:
    """An option in full, where it is the beginning of one that is dropped."""
    if not name.startswith("--") or len(name) == 2 or name in _DROPPED or name in _KEPT:
        return name
    return next((option for option in _DROPPED if option.startswith(name)), name)


def _is_option(word: str, values: int | None) -> bool:
    return values is None and word.startswith("-")
