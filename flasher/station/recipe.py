"""What a recipe says: how one product is made, as data. `recipe_file` reads it with its images, and
holds it against them and the protocol.

    name = "Battery 36 V, line 2"
    part = "BAT-36-10"
    revision = "4"

    [serial_number]
    pattern = 'W(?P<year>[0-9]{2})(?P<week>[0-9]{2})[0-9]{3}'
    example = "W2605002"

    [[target]]
    target = "bms"
    image = "bms.hex"
    sha256 = "5084b23b..."

    [[write]]
    target = "bms"
    item = "serial-number"
    values = ["{serial}"]

Values are templates, filled in from the scan: `{serial}`, `{lot}`, `{date:%Y%m%d}`, `{match.week}`.
They are not Python's own formatting, which reaches into objects: a template is data, and knows
these words and no others. `{{` and `}}` are the brackets themselves.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import date, time
from enum import StrEnum
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from flasher.protocol.spec import TARGETS, Target, find_target
from flasher.settings.toml_reader import Reader, TomlTable
from flasher.station.pattern import CHECKS, TEXT_MAX, pattern_of
from flasher.station.records.model import StepName, Verified

_TIME_MAX_S: Final = 3600.0
_TRIES_MAX: Final = 10

ShortText = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Seconds = Annotated[float, Field(gt=0, le=_TIME_MAX_S)]


def _target_name(value: str) -> str:
    target = find_target(value)
    if target is None:
        raise ValueError(f"there is no target {value!a:.20}; there are: {', '.join(TARGETS)}")
    return target.name


class TargetTable(TomlTable):
    """A table for one of the targets."""

    target: Annotated[str, AfterValidator(_target_name)]
    """The device."""

    @property
    def device(self) -> Target:
        return TARGETS[self.target]


class SerialNumber(TomlTable):
    """How serial numbers look."""

    pattern: str
    """Which texts are serial numbers (`pattern`), and its named groups."""
    example: str = Field(min_length=1, max_length=TEXT_MAX)
    """A good serial number; `station check` tries the whole recipe with it."""
    check_digit: str = ""
    """Its method, as luhn, gtin, mod11-2, mod11-10, mod37-2, mod37-36 or mod97-10; without it there
    is none.
    """
    check_group: str = ""
    """The group that the check digit is of; without it the whole serial number."""
    lot_group: str = ""
    """The group that is the lot, where it stands in the serial number."""
    number_group: str = ""
    """The group with the running number."""
    number_min: int = Field(default=0, ge=0)
    """The smallest running number."""
    number_max: int | None = Field(default=None, ge=0)
    """The largest running number."""

    @field_validator("pattern")
    @classmethod
    def _check_pattern(cls, value: str) -> str:
        pattern_of(value)
        return value

    @field_validator("check_digit")
    @classmethod
    def _check_method(cls, value: str) -> str:
        if value and value not in CHECKS:
            raise ValueError(f"it is one of {', '.join(CHECKS)}")
        return value

    @model_validator(mode="after")
    def _check_example(self) -> SerialNumber:
        groups = pattern_of(self.pattern).groups
        for key in ("check_group", "lot_group", "number_group"):
            name = getattr(self, key)
            if name and name not in groups:
                raise ValueError(f"{key} {name!a:.40} is no group of the pattern")
        if not self.number_group and (self.number_min or self.number_max is not None):
            raise ValueError("number_min and number_max need number_group")
        self.read(self.example)
        return self

    def read(self, serial: str) -> dict[str, str]:
        """The groups of a serial number. Raises ValueError saying why it is none."""
        groups = pattern_of(self.pattern).match(serial)
        if groups is None:
            raise ValueError(f"{serial!a:.80} does not fit the pattern {self.pattern}")
        checked = groups[self.check_group] if self.check_group else serial
        if self.check_digit and not CHECKS[self.check_digit](checked):
            raise ValueError(f"the check digit ({self.check_digit}) of {serial!a:.80} is wrong")
        if self.number_group:
            text = groups[self.number_group]
            number = int(text) if text.isdecimal() else -1
            most = self.number_max
            if number < self.number_min or (most is not None and number > most):
                bound = "any" if most is None else most
                raise ValueError(f"the number {text!a} is not from {self.number_min} to {bound}")
        return groups


class Lot(TomlTable):
    """What holds for a lot."""

    quantity_max: int | None = Field(default=None, ge=1)
    """Units that may pass in one lot."""
    required: bool = False
    """A unit needs a lot: from its serial number, or given to the station."""


class Verify(StrEnum):
    """How far a target is to be verified."""

    COMPLETED = "completed"
    VERSION = "version"
    MEMORY = "memory"

    @property
    def level(self) -> Verified:
        return Verified[self.name]


class Firmware(TargetTable):
    """A target, and what it is flashed with. Targets are done in the order of the recipe."""

    image: str = Field(min_length=1)
    """A file in the recipe's folder."""
    manifest: str = ""
    """What its maker states of it; without it the one beside the image, `IMAGE.toml`."""
    sha256: Sha256
    """Of the bytes to be sent, as in the manifest."""
    base: int | None = Field(default=None, ge=0, le=0xFFFF_FFFF)
    """Address of the first byte of a raw binary."""
    hardware_versions: tuple[ShortText, ...] = ()
    """Narrower than the manifest's, which hold as well; * stands for any text."""
    previous_versions: tuple[ShortText, ...] = ()
    """Running versions that it may replace; without it as the manifest says."""
    verify: Verify | None = None
    """How far it is verified; without it the version, where it can be asked for, else completed."""


class Write(TargetTable):
    """Something to write to a unit, with values that are templates."""

    item: ShortText
    """As `flasher write --list` names it."""
    values: tuple[str, ...] = Field(min_length=1)
    """May hold {serial}, {lot}, {date:%Y%m%d} and {match.GROUP}; each is read back."""
    manufacturer: bool = False
    """Needed for what the document reserves for the manufacturer."""


class Unchanged(TargetTable):
    """Something that must read the same after the run as before it."""

    item: ShortText
    """As `flasher read --list` names it."""


class Limit(TargetTable):
    """Something that is measured in a step, with its limits."""

    step: Literal[StepName.IDENTIFY, StepName.CHECK, StepName.VERIFY] = StepName.CHECK
    """When it is measured: check is before the first write."""
    item: ShortText
    """As `flasher read --list` names it."""
    field: ShortText
    """A field of that item, with its unit in its name."""
    low: float | None = None
    """The least good value."""
    high: float | None = None
    """The greatest good value."""
    expected: str | None = None
    """For a text; a template."""

    @model_validator(mode="after")
    def _check_limits(self) -> Limit:
        has_range = self.low is not None or self.high is not None
        if has_range == (self.expected is not None):
            raise ValueError("give low or high (or both), or expected")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError("low is above high")
        return self


class StepRule(TomlTable):
    """How long a step may take, and when it is tried again."""

    time_limit_s: Seconds | None = None
    """A unit whose step takes longer has failed."""
    tries: int = Field(default=1, ge=1, le=_TRIES_MAX)
    """How often it is begun, in all."""
    pause_s: float = Field(default=0.0, ge=0, le=_TIME_MAX_S)
    """Between two tries."""
    power_cycle: bool = False
    """Switch the socket off and on before a new try."""


class Duplicate(StrEnum):
    """What is done with a unit that has passed already."""

    BLOCK = "block"
    VERIFY_ONLY = "verify-only"
    REFLASH_WITH_REASON = "reflash-with-reason"


class AfterRestart(StrEnum):
    """What a run does when the unit has restarted, and the run has not caused it."""

    END = "end"
    CONTINUE = "continue"


class Golden(TomlTable):
    """Known good units that test a socket before it may go on. Their runs count in no figure."""

    serial_numbers: tuple[ShortText, ...] = Field(min_length=1)
    """Of the known good units."""
    shift_starts: tuple[time, ...] = ()
    """Local times at which a shift starts; one must pass on each socket after each."""
    every_h: float | None = Field(default=None, gt=0, le=24 * 31)
    """One must pass on each socket after so many hours."""

    @model_validator(mode="after")
    def _check_rule(self) -> Golden:
        if not self.shift_starts and self.every_h is None:
            raise ValueError("give shift_starts or every_h")
        if any(start.tzinfo is not None for start in self.shift_starts):
            raise ValueError("shift_starts are times of the clock on the wall, without a zone")
        return self


class Recipe(TomlTable):
    """A recipe. `target` and `write` are in the order in which they are done."""

    name: ShortText
    """As people know it."""
    part: ShortText
    """The product. A serial number is unique for its part."""
    revision: Annotated[str, Field(min_length=1, max_length=64)]
    """Raise it with every change: the records name it."""
    notes: str = ""
    """For people."""
    profile: str = ""
    """A target profile of `flasher profile`, in the recipe's folder."""
    serial_number: SerialNumber
    lot: Lot = Lot()
    target: tuple[Firmware, ...] = Field(min_length=1)
    write: tuple[Write, ...] = ()
    unchanged: tuple[Unchanged, ...] = ()
    limit: tuple[Limit, ...] = ()
    step: dict[StepName, StepRule] = Field(default_factory=dict)
    duplicate: Duplicate = Duplicate.BLOCK
    """What is done with a unit that has passed already."""
    after_restart: AfterRestart = AfterRestart.END
    """A unit that restarts by itself in a run may be another one. "continue" is for sockets that
    hold the unit until the run has ended; the record says so."""
    golden: Golden | None = None
    allow_completed_not_read_back: bool = True
    """A target that cannot be asked for its version may pass; the record says so."""

    @model_validator(mode="after")
    def _check_targets(self) -> Recipe:
        names = [firmware.target for firmware in self.target]
        if len(set(names)) < len(names):
            raise ValueError("a target is named twice in [[target]]")
        for key in ("write", "unchanged", "limit"):
            for part in getattr(self, key):
                if part.target not in names:
                    raise ValueError(f"[[{key}]] names {part.target}, which is no [[target]]")
        return self

    def rule(self, step: StepName) -> StepRule:
        """The rule of a step; the usual one where the recipe gives none."""
        return self.step.get(step, _USUAL)


_USUAL: Final = StepRule()
RECIPE: Final = Reader(Recipe, "recipe")


# -- templates ------------------------------------------------------------------------------------

DATE_DEFAULT: Final = "%Y%m%d"
_DATE_FORM: Final = re.compile(r"(?:%[YymdjGVu]|[0-9A-Za-z_ /-])+")
_PART: Final = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]|[^{}]+")
_GROUP: Final = "match."


@dataclass(frozen=True)
class Scan:
    """What is known of a unit before it is connected."""

    serial: str
    day: date
    """The day of production, where the station stands."""
    lot: str = ""
    groups: Mapping[str, str] = field(default_factory=dict)
    """The named groups of the serial number's pattern."""


def fill(template: str, scan: Scan) -> str:
    """The text of a template. Raises ValueError for a word that it does not know."""
    return "".join(_part(part, scan) for part in _PART.finditer(template))


def check_template(template: str, groups: Collection[str]) -> None:
    """Raises ValueError for a template that cannot be filled with these groups of the pattern."""
    fill(template, Scan("", date(2000, 1, 1), "", dict.fromkeys(groups, "")))


def uses_lot(template: str) -> bool:
    """True when the template needs a lot."""
    return any(part[1] == "lot" for part in _PART.finditer(template))


def _part(part: re.Match[str], scan: Scan) -> str:
    word = part[1]
    if word is None:
        if part[0] in ("{", "}"):
            raise ValueError(f"a bracket {part[0]} stands alone; write it twice for itself")
        return part[0][0] if part[0] in ("{{", "}}") else part[0]
    name, _, form = word.partition(":")
    if name == "date":
        form = form or DATE_DEFAULT
        if _DATE_FORM.fullmatch(form) is None:
            raise ValueError(f"{{{word}}} is no date: use %Y %y %m %d %j %G %V %u")
        return scan.day.strftime(form)
    if word == "serial":
        return scan.serial
    if word == "lot":
        return scan.lot
    if word.startswith(_GROUP) and word.removeprefix(_GROUP) in scan.groups:
        return scan.groups[word.removeprefix(_GROUP)]
    known = ["{serial}", "{lot}", "{date:%Y%m%d}", *(f"{{match.{g}}}" for g in scan.groups)]
    raise ValueError(f"{{{word}}} is not known: {', '.join(known)}")
