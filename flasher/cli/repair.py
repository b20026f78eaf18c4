"""The command that repairs a device which an upgrade left without an application."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from flasher.cli.logs import OPTION


def repair_command(words: Sequence[str], command: str) -> str:
    """The `flasher rescue` for an upgrade that was typed as `words`, as a shell takes it.

    Left out are what `rescue` does not have, and an overall deadline that was meant for a device
    which answers at once: here somebody has to switch it off and on.
    """
    rest = list(words)
    at = next(i for i, word in enumerate(rest) if word == command and not _is_log_file(rest, i))
    rest[at] = "rescue"
    kept = []
    while rest:
        word = rest.pop(0)
        name, equals, _ = word.partition("=")
        if word == "--":
            kept += [word, *rest]
            break
        if _stands_for(name, "--timeout", at_least="--timeo"):
            if not equals:
                rest.pop(0)
        elif not _stands_for(name, "--skip-same-version", at_least="--s"):
            kept.append(word)
    return shlex.join(["flasher", *kept])


def _stands_for(word: str, option: str, *, at_least: str) -> bool:
    """True for an option and its abbreviations."""
    return word.startswith(at_least) and option.startswith(word)


def _is_log_file(words: Sequence[str], index: int) -> bool:
    """True for a word that is the name of the log file."""
    return index > 0 and _stands_for(words[index - 1], OPTION, at_least="--l")
