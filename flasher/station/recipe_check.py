"""Holds a recipe against its images, the protocol and a sample scan: before a shift, not in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final

from flasher.errors import FlasherError, UsageError
from flasher.host.identity import judge_bytes
from flasher.host.items import Readable, find, meaningful_fields, readable
from flasher.host.read import READ_MEMORY
from flasher.image.plan import plan
from flasher.image.release import check_target
from flasher.protocol.fields import Codec, Number
from flasher.station import template
from flasher.station.recipe import Limit, Unchanged
from flasher.station.recipe_file import (
    Finding,
    LoadedRecipe,
    LoadedTarget,
    RecipeError,
    load_recipe,
)
from flasher.station.records.model import Verified
from flasher.station.template import Scan

_SAMPLE_LOT: Final = "LOT1"


@dataclass(frozen=True)
class Findings:
    """What a check found; `recipe` is None when it could not even be read."""

    recipe: LoadedRecipe | None
    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """True when the recipe can be used."""
        return self.recipe is not None and not self.findings


def check_recipe(path: Path, day: date) -> Findings:
    """Everything that can be known of a recipe without a device; `day` is the sample's.

    Raises UsageError only when there is no such file.
    """
    try:
        loaded = load_recipe(path)
    except RecipeError as error:
        return Findings(None, error.findings)
    found = [
        *(finding for target in loaded.targets for finding in _check_target(loaded, target)),
        *_check_scan(loaded, day),
        *_check_reads(loaded),
        *_check_golden(loaded),
    ]
    return Findings(loaded, tuple(found))


def load_checked(path: Path, day: date) -> LoadedRecipe:
    """A recipe that passed `check_recipe`. Raises RecipeError with all findings."""
    result = check_recipe(path, day)
    if result.recipe is None or result.findings:
        raise RecipeError(path, result.findings)
    return result.recipe


def _check_target(loaded: LoadedRecipe, target: LoadedTarget) -> Iterator[Finding]:
    where = f"target {target.name}"
    if target.firmware.sha256 != target.image.sha256:
        yield Finding(
            where,
            f"sha256 is {target.firmware.sha256}, the image has {target.image.sha256}.",
            "Take the image that the recipe was released with, or release a new recipe.",
        )
    try:
        target.release.check_bytes(target.image)
        check_target(target.image, target.release, target.target)
        identity = target.profile.identity(release=target.release)
        for found in judge_bytes(target.image, identity):
            if found.ending is not None:
                yield Finding(where, f"{found.text}.", "Name the firmware file itself.")
        target.profile.check_fits(target.image)
        plan(target.image, target.target, target.profile.dialect.bitrate_bps)
    except FlasherError as error:
        yield Finding(where, error.what, error.remedy)
    if not target.profile.has_upgrade:
        yield Finding(where, "its profile has no upgrade (has_upgrade).")
    yield from _check_level(loaded, target, where)


def _check_level(loaded: LoadedRecipe, target: LoadedTarget, where: str) -> Iterator[Finding]:
    if target.required is Verified.COMPLETED:
        if not loaded.recipe.allow_completed_not_read_back:
            yield Finding(
                where,
                "nothing of it is read back, and allow_completed_not_read_back is false.",
                "Name a profile with its version_query, or allow it.",
            )
        return
    if target.required is Verified.MEMORY:
        if READ_MEMORY.receiver is not target.target.node:
            yield Finding(where, "its memory cannot be read.", "Verify the version.")
        elif target.image.base is None:
            yield Finding(where, "a raw binary can be read back only with its base.")
        return
    if not target.can_read_version:
        yield Finding(
            where,
            "it cannot be asked for its version.",
            "Name a profile with its version_query, or verify = 'completed'.",
        )
    elif target.image.version is None:
        yield Finding(
            where,
            "the image names no version that could be compared.",
            "Verify the memory, or verify = 'completed'.",
        )


def _check_scan(loaded: LoadedRecipe, day: date) -> Iterator[Finding]:
    recipe = loaded.recipe
    scan = loaded.scan(recipe.serial_number.example, day)
    has_lot = bool(recipe.serial_number.lot_group) or recipe.lot.required
    if not scan.lot and has_lot:
        scan = Scan(scan.serial, day, _SAMPLE_LOT, scan.groups)
    for number, write in enumerate(recipe.write, 1):
        where = f"write {number}"
        try:
            loaded.write_plan(write, scan)
        except UsageError as error:
            yield Finding(where, error.what, error.remedy)
        if not has_lot and any(map(template.uses_lot, write.values)):
            yield Finding(
                where, "{lot} is used, but a unit may have none.", "Set lot.required = true."
            )
    names = [(write.target, write.item) for write in recipe.write]
    for name in {name for name in names if names.count(name) > 1}:
        yield Finding(f"write {name[1]}", "it is written twice.", "Leave one of them.")


def _check_reads(loaded: LoadedRecipe) -> Iterator[Finding]:
    groups = loaded.scan(loaded.recipe.serial_number.example, date(2000, 1, 1)).groups
    written = {(write.target, write.item.lower()) for write in loaded.recipe.write}
    for number, unchanged in enumerate(loaded.recipe.unchanged, 1):
        try:
            found = readable_of(loaded, unchanged)
        except UsageError as error:
            yield Finding(f"unchanged {number}", error.what, error.remedy)
            continue
        if (unchanged.target, found.name) in written:
            yield Finding(f"unchanged {number}", f"{found.name} is written by this recipe.")
    for number, limit in enumerate(loaded.recipe.limit, 1):
        where = f"limit {number}"
        try:
            codec = codec_of(loaded, limit)
            if limit.expected is not None:
                template.check(limit.expected, groups)
        except UsageError as error:
            yield Finding(where, error.what, error.remedy)
        except ValueError as error:
            yield Finding(where, f"{error}.")
        else:
            if isinstance(codec, Number) != (limit.expected is None):
                kind = (
                    "a number: give low or high"
                    if isinstance(codec, Number)
                    else "no number: give expected"
                )
                yield Finding(where, f"{limit.field} is {kind}.")


def readable_of(loaded: LoadedRecipe, part: Unchanged | Limit) -> Readable:
    """What a table of the recipe wants to read. Raises UsageError for what cannot be."""
    target = next(each for each in loaded.targets if each.name == part.target)
    return find(part.item, readable(target.target, target.profile.dialect), target.target, "read")


def codec_of(loaded: LoadedRecipe, limit: Limit) -> Codec:
    """The field that a limit is for; its name is `limit.field`. Raises UsageError without one."""
    found = readable_of(loaded, limit)
    fields = dict(meaningful_fields(found.content))
    if limit.field not in fields:
        raise UsageError(
            f"{found.name} has no field {limit.field!a:.40}.",
            remedy=f"There are: {', '.join(fields)}.",
        )
    return fields[limit.field]


def _check_golden(loaded: LoadedRecipe) -> Iterator[Finding]:
    golden = loaded.recipe.golden
    for serial in golden.serial_numbers if golden is not None else ():
        try:
            loaded.recipe.serial_number.read(serial)
        except ValueError as error:
            yield Finding("golden", f"{error}.")
