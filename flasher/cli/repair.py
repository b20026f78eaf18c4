"""The command that repairs a device which an upgrade left without an application."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Final

from flasher.cli.logs import OPTION

OTHER_IMAGE: Final = "OTHER_IMAGE"
"""Stands for an image that the device accepts, where it has refused the one that was sent."""
_LEFT_OUT: Final = {"--timeout": 1, "--trace-file": 1, "--skip-same-version": 0}
"""What does not fit, with the number of its values: a deadline meant for a device that answers at
once (here somebody has to switch it off and on), a trace that is evidence now, what `rescue` has
not."""
_OF_THE_IMAGE: Final = dict.fromkeys(
    ("--format", "--base", "--range", "--fill-gaps-up-to", "--manifest"), 1
)
_WAIVERS: Final = ("--allow-", "--force", "-f")


def repair_command(words: Sequence[str], command: str, refused_image: str | None = None) -> str:
    """The `flasher rescue` for an upgrade that was typed as `words`, as a shell takes it.

    With `refused_image`, a name among the words, another image takes its place, and what was said
    about the refused one is left out.
    """
    rest = list(words)
    at = next(i for i, word in enumerate(rest) if word == command and not _is_log_file(rest, i))
    rest[at] = "rescue"
    left_out = _LEFT_OUT
    if refused_image is not None:
        rest[_place_of(refused_image, rest, at)] = OTHER_IMAGE
        left_out = _LEFT_OUT | _OF_THE_IMAGE
    kept = []
    while rest:
        word = rest.pop(0)
        name, equals, _ = word.partition("=")
        option = next((each for each in left_out if _stands_for(name, each)), None)
        if word == "--":
            kept += [word, *rest]
            break
        if option is not None:
            del rest[: 0 if equals else left_out[option]]
        elif refused_image is None or not word.startswith(_WAIVERS):
            kept.append(word)
    return shlex.join(["flasher", *kept])


def _place_of(image: str, words: Sequence[str], behind: int) -> int:
    """Where the image stands: rather not right behind an option, whose value it may be."""
    places = [i for i, word in enumerate(words) if word == image and i != behind]
    return next((i for i in places if not words[i - 1].startswith("-")), places[0])


def _stands_for(word: str, option: str) -> bool:
    """True for an option and its abbreviations, of a command line that was accepted."""
    return len(word) > len("--") and option.startswith(word)


def _is_log_file(words: Sequence[str], index: int) -> bool:
    """True for a word that is the name of the log file."""
    return index > 0 and _stands_for(words[index - 1], OPTION)
