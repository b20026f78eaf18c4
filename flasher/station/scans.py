"""What an operator scans: labels of units, and commands, which are barcodes on a card.

SOCKET A      the unit is, or will be, in socket A; for the label before or after it
CANCEL        forget the label and the socket that wait
ABORT A       stop the run in socket A
FREE A        the unit is out of socket A, where the station cannot see it
LOT 4711      the lot of the units that follow
OPERATOR Jo   who works here now
REASON text   why units that have passed are done again; holds for the next label
RESUME        what stopped the line is mended: save what is open, and go on
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from flasher.station.pattern import TEXT_MAX

_COMMAND_MAX: Final = 200


class Word(StrEnum):
    """The first word of a command."""

    SOCKET = "SOCKET"
    CANCEL = "CANCEL"
    ABORT = "ABORT"
    FREE = "FREE"
    LOT = "LOT"
    OPERATOR = "OPERATOR"
    REASON = "REASON"
    RESUME = "RESUME"


ALONE: Final = frozenset({Word.CANCEL, Word.RESUME})
"""Commands that are one word."""


@dataclass(frozen=True)
class Label:
    """The label of a unit."""

    serial: str


@dataclass(frozen=True)
class Command:
    """A command with what stands behind its word."""

    word: Word
    argument: str = ""


@dataclass(frozen=True)
class Nonsense:
    """It is neither; `why` says so."""

    why: str


def understand(text: str) -> Label | Command | Nonsense:
    """What was scanned. Whether a label is one of the recipe is not looked at."""
    scanned = text.strip()
    if not scanned:
        return Nonsense("Nothing was scanned.")
    if not scanned.isprintable() or len(scanned) > _COMMAND_MAX:
        return Nonsense("It holds characters that no label has, or too many.")
    first, _, rest = scanned.partition(" ")
    word = next((each for each in Word if each.value == first.upper()), None)
    if word is not None and (word in ALONE) == (not rest.strip()):
        return Command(word, rest.strip())
    if word is not None:
        return Nonsense(f"{word.value} stands alone." if word in ALONE else f"{word.value} what?")
    if len(scanned) > TEXT_MAX:
        return Nonsense(f"It is longer than {TEXT_MAX} characters.")
    return Label(scanned)
