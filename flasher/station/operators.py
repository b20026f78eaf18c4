"""Operators of a station: badges, roles, PINs, and the commands that they permit.

    [[person]]
    name = "Jo"
    code = "BADGE-0017"                # the barcode of the badge
    role = "rework"
    pin = "$argon2id$..."              # printed by `flasher station pin`

`Crew` does no I/O: times are arguments, and the station runs the slow check of a PIN.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import ceil
from pathlib import Path
from typing import Any, Final

from pydantic import Field, field_validator, model_validator

from flasher.errors import Fault
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.settings.toml_reader import Reader, TomlTable
from flasher.station import pins
from flasher.station.attempts import BackOff
from flasher.station.config import no_two
from flasher.station.pattern import pattern_of
from flasher.station.recipe import SerialNumberRule, ShortText
from flasher.station.scans import Label, Refused, ScanCommand, Word, understand
from flasher.station.socket import PAGE, Source

PIN_LIMIT_S: Final = 30.0
"""Time limit for the PIN after the command that needs it."""
HIDDEN: Final = "****"
"""Displayed instead of a scan or typed text that may be a PIN."""


class Role(StrEnum):
    """Role of a person: decides which commands the person may give."""

    OPERATOR = "operator"
    REWORK = "rework"
    SUPERVISOR = "supervisor"


_REWORK: Final = frozenset({Role.REWORK, Role.SUPERVISOR})
_ROLES: Final[Mapping[Word, frozenset[Role]]] = {
    Word.REASON: _REWORK,
    Word.ABORT: _REWORK,
    Word.RECIPE: frozenset({Role.SUPERVISOR}),
    Word.RESUME: frozenset({Role.SUPERVISOR}),
}
"""Roles that may give a command that overrides the station. Anyone may give the others."""


class Person(TomlTable):
    """A person with a badge."""

    name: ShortText
    """Name of the person in the records."""
    code: ShortText
    """Text of the badge's barcode."""
    role: Role
    """Role of the person."""
    pin: str = Field(default="", repr=False)
    """Hash of the PIN that overrides need, by `flasher station pin`; empty: no PIN is needed."""

    @field_validator("code")
    @classmethod
    def _check_code(cls, value: str) -> str:
        meaning = understand(value)
        if meaning != Label(value):
            what = "is a command" if isinstance(meaning, ScanCommand) else "cannot be scanned"
            raise ValueError(f"{value!a:.60} {what}")
        return value

    @field_validator("pin", mode="before")
    @classmethod
    def _check_pin(cls, value: Any) -> Any:
        # Checked before pydantic, whose message would show a PIN written here by mistake.
        if value != "":
            pins.check_hash(value if isinstance(value, str) else "")
        return value


class BadgeTable(TomlTable):
    """A badge table."""

    person: tuple[Person, ...] = Field(min_length=1, max_length=1000)

    @model_validator(mode="after")
    def _check_people(self) -> BadgeTable:
        no_two("people", "name", [each.name for each in self.person])
        no_two("badges", "code", [each.code for each in self.person])
        return self


BADGES: Final = Reader(BadgeTable, "badge table")


def load_badges(path: Path, serial_number: SerialNumberRule) -> tuple[Person, ...]:
    """Load the people of a badge table. Raises UsageError with all problems, for example a badge
    code that could be a label of this recipe.
    """
    table = BADGES.load(path)
    # Without the check digit: a label that was misread must not be taken for a badge.
    is_label = pattern_of(serial_number.pattern).match
    faults = [
        Fault(
            f"person[{number}].code",
            f"{printable(person.code)} could be a label: it matches the pattern of the recipe's"
            " serial numbers.",
            "Give the badge another code.",
        )
        for number, person in enumerate(table.person)
        if is_label(person.code) is not None
    ]
    if faults:
        raise BADGES.refusal(path, faults)
    return table.person


@dataclass(frozen=True)
class Asked:
    """A command that waits for the PIN of its person."""

    person: Person
    word: Word
    argument: str
    until_s: float
    source: Source

    @property
    def text(self) -> str:
        """The command as scanned."""
        return f"{self.word.value} {self.argument}".strip()


class Crew:
    """People of a station: their badges, the present operator, and the command that waits for a
    PIN. Without badges every command is allowed.
    """

    def __init__(self, people: Iterable[Person]) -> None:
        self._people = {each.code: each for each in people}
        self.has_badges = bool(self._people)
        self.has_pins = any(each.pin for each in self._people.values())
        self.person: Person | None = None
        """The operator; None before the first badge is scanned."""
        self.asked: Asked | None = None
        self._tries: dict[tuple[str, str], BackOff] = {}
        """PIN tries by person and source: wrong PINs on a page do not block the scanner."""

    @property
    def codes(self) -> frozenset[str]:
        return frozenset(self._people)

    @property
    def people(self) -> tuple[Person, ...]:
        return tuple(self._people.values())

    def find(self, text: str) -> Person | None:
        return self._people.get(text)

    def may_be_pin(self, text: str) -> bool:
        """True for a text that may be a PIN, for example one typed too late."""
        return self.has_pins and pins.is_form(text)

    def check_assigned(self) -> None:
        """Check that a badge was scanned. Raises Refused."""
        if self.has_badges and self.person is None:
            raise Refused(
                "NOBODY", text("No badge has been scanned yet."), text("Scan your badge first.")
            )

    def check_role(self, word: Word) -> Person | None:
        """Check that the operator may give a command. Returns the operator if the command needs a
        role, else None. Raises Refused.
        """
        if word not in _ROLES:
            return None
        self.check_assigned()
        person = self.person
        if person is not None and person.role not in _ROLES[word]:
            raise Refused(
                "NOT_ALLOWED",
                text("{name} may not do that.", name=printable(person.name)),
                text("A rework operator or a supervisor has to scan a badge first.")
                if Role.REWORK in _ROLES[word]
                else text("A supervisor has to scan a badge first."),
            )
        return person

    def ask(self, person: Person, word: Word, argument: str, now: float, source: Source) -> Asked:
        """Make a command wait for a person's PIN. Raises Refused after too many wrong PINs."""
        if remedy := self.lock_words(person.name, source, now):
            name = printable(person.name)
            raise Refused("PIN_LOCKED", text("Too many wrong PINs of {name}.", name=name), remedy)
        self.asked = Asked(person, word, argument, now + PIN_LIMIT_S, source)
        return self.asked

    def lock_words(self, name: str, source: Source, now: float) -> str:
        """Remedy with the time to wait after too many wrong PINs; "" if a PIN is accepted."""
        wait_s = self._tries_of(name, source).wait_s(now)
        if wait_s == 0.0:
            return ""
        return text("Wait {seconds} s, then scan it again.", seconds=ceil(wait_s))

    def count_try(self, name: str, source: Source, now: float) -> None:
        """Count a PIN of this person, before its check."""
        self._tries_of(name, source).count(now)

    def forget_tries(self, name: str, source: Source) -> None:
        self._tries_of(name, source).reset()

    def _tries_of(self, name: str, source: Source) -> BackOff:
        # All pages count together, since a browser can begin any number of sessions.
        place = PAGE if source.name.startswith(PAGE) else source.name
        return self._tries.setdefault((name, place), BackOff())
