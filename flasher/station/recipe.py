"""Recipes: how a station flashes, writes and checks one product.

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

`recipe_file` loads a recipe with its images. Values are templates with the placeholders `{serial}`,
`{lot}`, `{date:%Y%m%d}` and `{match.week}`; `{{` and `}}` are brackets. They do not use Python's
`str.format`, which can reach the attributes of objects.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import date, time
from enum import StrEnum
from typing import Annotated, Final, Literal

from pydantic import Field, field_validator, model_validator

from flasher.errors import FlasherError, printable
from flasher.settings.bike_set import TargetImage, TargetTable, check_named_once
from flasher.settings.toml_reader import Reader, TomlTable
from flasher.station.pattern import CHECKS, TEXT_MAX, pattern_of
from flasher.station.records.model import StepName, Verified

_TIME_MAX_S: Final = 3600.0
_TRIES_MAX: Final = 10

ShortText = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
Seconds = Annotated[float, Field(gt=0, le=_TIME_MAX_S)]


class SerialNumberRule(TomlTable):
    """Rules for the product's serial numbers."""

    pattern: str
    """Pattern of serial numbers, with named groups (see `flasher.station.pattern`)."""
    example: str = Field(min_length=1, max_length=TEXT_MAX)
    """A valid serial number; `station check` tries the recipe with it."""
    check_digit: str = ""
    """Method of the check digit: luhn, gtin, mod11-2, mod11-10, mod37-2, mod37-36 or mod97-10;
    empty: no check digit.
    """
    check_group: str = ""
    """The group that the check digit covers; empty: the whole serial number."""
    lot_group: str = ""
    """The group that holds the lot; empty: serial numbers do not contain the lot."""
    number_group: str = ""
    """The group that holds the running number."""
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
            raise ValueError(f"must be one of {', '.join(CHECKS)}")
        return value

    @model_validator(mode="after")
    def _check_example(self) -> SerialNumberRule:
        groups = pattern_of(self.pattern).groups
        for key in ("check_group", "lot_group", "number_group"):
            name = getattr(self, key)
            if name and name not in groups:
                raise ValueError(f"{key} {name!a:.40} is not a group of the pattern")
        if not self.number_group and (self.number_min or self.number_max is not None):
            raise ValueError("number_min and number_max need number_group")
        self.read(self.example)
        return self

    def read(self, serial: str) -> dict[str, str]:
        """Groups of the pattern in a serial number. Raises ValueError for an invalid one."""
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
    """Rules for lots."""

    quantity_max: int | None = Field(default=None, ge=1)
    """Maximum number of units that pass in one lot."""
    required: bool = False
    """Every unit needs a lot, in its serial number or set at the station."""


class Verify(StrEnum):
    """Required verification of a target."""

    COMPLETED = "completed"
    VERSION = "version"
    MEMORY = "memory"

    @property
    def level(self) -> Verified:
        return Verified[self.name]


class SignatureRule(StrEnum):
    """Whether an image must be signed."""

    CHECKED = "checked"
    REQUIRED = "required"
    WAIVED = "waived"


class Firmware(TargetImage):
    """A target and its image. Targets are flashed in the order of the recipe."""

    signature: SignatureRule = SignatureRule.CHECKED
    """checked: trusted keys must have signed the image if this computer has a trust file;
    required: in any case; waived: it need not be signed, which the records state."""
    sha256: Sha256
    """SHA-256 of the bytes to be sent, as in the manifest."""
    hardware_versions: tuple[ShortText, ...] = ()
    """Accepted hardware versions, in addition to the manifest's limits; * matches any text."""
    previous_versions: tuple[ShortText, ...] = ()
    """Running versions that it may replace; empty: those of the manifest."""
    verify: Verify | None = None
    """Required verification; unset: the version where the target can be asked for it, else
    completed."""


class Write(TargetTable):
    """An item to write to a unit."""

    item: ShortText
    """Name of the item, as in `flasher write --list`."""
    values: tuple[str, ...] = Field(min_length=1)
    """Templates with {serial}, {lot}, {date:%Y%m%d} and {match.GROUP}; values are read back."""
    manufacturer: bool = False
    """Allows items that the protocol reserves for the manufacturer."""


class Unchanged(TargetTable):
    """An item that must read the same after the run as before it."""

    item: ShortText
    """Name of the item, as in `flasher read --list`."""


class Limit(TargetTable):
    """A measurement of a step, with its limits."""

    step: Literal[StepName.IDENTIFY, StepName.CHECK, StepName.VERIFY] = StepName.CHECK
    """The step that measures it; check is before the first write."""
    item: ShortText
    """Name of the item, as in `flasher read --list`."""
    field: ShortText
    """Name of a field of the item, which ends with its unit."""
    low: float | None = None
    """The smallest accepted value."""
    high: float | None = None
    """The largest accepted value."""
    expected: str | None = None
    """Template of the expected text, for a field that is not a number."""

    @model_validator(mode="after")
    def _check_limits(self) -> Limit:
        has_range = self.low is not None or self.high is not None
        if has_range == (self.expected is not None):
            raise ValueError("give low or high (or both), or expected")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError("low is above high")
        return self


class StepRule(TomlTable):
    """Time limit and tries of a step."""

    time_limit_s: Seconds | None = None
    """A unit fails when the step takes longer; unset: no limit."""
    tries: int = Field(default=1, ge=1, le=_TRIES_MAX)
    """Number of tries, including the first."""
    pause_s: float = Field(default=0.0, ge=0, le=_TIME_MAX_S)
    """Pause between two tries."""
    power_cycle: bool = False
    """Switch the unit off and on before another try."""


class Duplicate(StrEnum):
    """Handling of a unit that has already passed."""

    BLOCK = "block"
    VERIFY_ONLY = "verify-only"
    REFLASH_WITH_REASON = "reflash-with-reason"


class AfterRestart(StrEnum):
    """Handling of a restart that the run did not cause."""

    END = "end"
    CONTINUE = "continue"


class Unchecked(StrEnum):
    """Handling of a unit of which something is not known."""

    ALLOW = "allow"
    BLOCK = "block"


class ClockRule(StrEnum):
    """Handling of a clock that differs from that of the plant's database."""

    REPORT = "report"
    STOP = "stop"


class PlantRule(TomlTable):
    """Rules for what a plant's database answers before a run (`plant` of the station file)."""

    unchecked: Unchecked = Unchecked.ALLOW
    """A unit that may have passed at another station, as the database does not answer, or that
    station has not sent the end of its run: allow marks the run "duplicates not checked"."""
    time_limit_s: float = Field(default=3.0, gt=0, le=30)
    """Time limit for the answer of the database."""
    clock: ClockRule = ClockRule.REPORT
    """A clock that differs too much: report shows it; stop refuses units as well."""
    clock_offset_max_s: float = Field(default=5.0, gt=0, le=3600)
    """Largest accepted difference between the station's clock and that of the database."""
    clock_unknown: Unchecked = Unchecked.BLOCK
    """With clock = "stop": a unit while the difference is not known."""


class Golden(TomlTable):
    """Known good units that test the sockets at intervals. Figures exclude their runs."""

    serial_numbers: tuple[ShortText, ...] = Field(min_length=1)
    """Serial numbers of the known good units."""
    shift_starts: tuple[time, ...] = ()
    """Local times; after each, a known good unit must pass on a socket before other units."""
    every_h: float | None = Field(default=None, gt=0, le=24 * 31)
    """Hours after which a known good unit must pass on a socket again."""

    @model_validator(mode="after")
    def _check_rule(self) -> Golden:
        if not self.shift_starts and self.every_h is None:
            raise ValueError("give shift_starts or every_h")
        if any(start.tzinfo is not None for start in self.shift_starts):
            raise ValueError("shift_starts are local times, without a time zone")
        return self


class Recipe(TomlTable):
    """A recipe. `target` and `write` are processed in order."""

    name: ShortText
    """Name for people."""
    part: ShortText
    """Part number of the product. Serial numbers are unique within a part."""
    revision: Annotated[str, Field(min_length=1, max_length=64)]
    """Revision, which is recorded; change it with every change of the recipe."""
    notes: str = ""
    """Notes for people."""
    profile: str = ""
    """A target profile (see `flasher profile`) in the recipe's folder."""
    serial_number: SerialNumberRule
    lot: Lot = Lot()
    target: tuple[Firmware, ...] = Field(min_length=1)
    write: tuple[Write, ...] = ()
    unchanged: tuple[Unchanged, ...] = ()
    limit: tuple[Limit, ...] = ()
    step: dict[StepName, StepRule] = Field(default_factory=dict)
    duplicate: Duplicate = Duplicate.BLOCK
    """Handling of a unit that has already passed."""
    after_restart: AfterRestart = AfterRestart.END
    """Handling of a unit that restarts by itself in a run, which may have been exchanged.
    "continue" is for sockets that hold the unit until the run has ended; it is recorded."""
    golden: Golden | None = None
    plant: PlantRule = PlantRule()
    allow_completed_not_read_back: bool = True
    """Let a target without a version query pass; it is recorded."""

    @model_validator(mode="after")
    def _check_targets(self) -> Recipe:
        check_named_once(self.target)
        if StepName.PLANT in self.step:
            raise ValueError("[step.plant] has no effect: its time limit is plant.time_limit_s")
        names = [firmware.target for firmware in self.target]
        for key in ("write", "unchanged", "limit"):
            for part in getattr(self, key):
                if part.target not in names:
                    raise ValueError(f"[[{key}]] names {part.target}, which has no [[target]]")
        return self

    def rule(self, step: StepName) -> StepRule:
        """Rule of a step, or the default rule."""
        return self.step.get(step, _USUAL)


_USUAL: Final = StepRule()
RECIPE: Final = Reader(Recipe, "recipe")


def groups_by(recipe: str, serial: str) -> dict[str, str]:
    """Groups of a serial number by the text of a recorded recipe; {} if it cannot be read."""
    try:
        return RECIPE.parse(recipe.encode(), "").serial_number.read(serial)
    except (FlasherError, ValueError):  # of another flasher
        return {}


# -- templates ------------------------------------------------------------------------------------

DATE_DEFAULT: Final = "%Y%m%d"
_DATE_FORM: Final = re.compile(r"(?:%[YymdjGVu]|[0-9A-Za-z_ /-])+")
_PART: Final = re.compile(r"\{\{|\}\}|\{([^{}]*)\}|[{}]|[^{}]+")
_GROUP: Final = "match."


@dataclass(frozen=True)
class Scan:
    """Values of a scanned label, for templates."""

    serial: str
    day: date
    """The day of production, in the station's time zone."""
    lot: str = ""
    groups: Mapping[str, str] = field(default_factory=dict)
    """The named groups of the serial number's pattern."""


def fill(template: str, scan: Scan) -> str:
    """Fill in a template. Raises ValueError for an unknown placeholder."""
    return "".join(_part(part, scan) for part in _PART.finditer(template))


def check_template(template: str, groups: Collection[str]) -> None:
    """Check that a template has only known placeholders. Raises ValueError."""
    fill(template, Scan("", date(2000, 1, 1), "", dict.fromkeys(groups, "")))


def uses_lot(template: str) -> bool:
    """True if the template contains {lot}."""
    return any(part[1] == "lot" for part in _PART.finditer(template))


def _part(part: re.Match[str], scan: Scan) -> str:
    word = part[1]
    if word is None:
        if part[0] in ("{", "}"):
            raise ValueError(f"single {part[0]} in the template; write it twice for the character")
        return part[0][0] if part[0] in ("{{", "}}") else part[0]
    name, _, form = word.partition(":")
    if name == "date":
        form = form or DATE_DEFAULT
        if _DATE_FORM.fullmatch(form) is None:
            word = printable(word)
            raise ValueError(f"{{{word}}} is not a date: use %Y %y %m %d %j %G %V %u")
        return scan.day.strftime(form)
    if word == "serial":
        return scan.serial
    if word == "lot":
        return scan.lot
    if word.startswith(_GROUP) and word.removeprefix(_GROUP) in scan.groups:
        return scan.groups[word.removeprefix(_GROUP)]
    word = printable(word)
    known = ["{serial}", "{lot}", "{date:%Y%m%d}", *(f"{{match.{g}}}" for g in scan.groups)]
    raise ValueError(f"unknown placeholder {{{word}}}; known are {', '.join(known)}")
