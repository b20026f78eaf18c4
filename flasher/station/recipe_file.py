"""Reads a recipe with its images from disk, once, and tells later whether the disk still agrees.

A recipe reaches nothing outside of its own folder: no absolute path, no `..`, no link that leads
out of it.
"""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import date
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from flasher.errors import FlasherError, UsageError
from flasher.files import TOML_MAX_SIZE, opened, parse_toml, read
from flasher.host.write import WritePlan, plan_write
from flasher.image.image import Image
from flasher.image.load import FILE_MAX_SIZE, load
from flasher.image.release import Release
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.manifest import manifest_path, read_release
from flasher.settings.profile import Profile, load_profile
from flasher.station.recipe import Firmware, Recipe, Verify, Write
from flasher.station.records.model import Verified
from flasher.station.template import Scan, fill

Model = TypeVar("Model", bound=BaseModel)
_UNKNOWN_KEY: Final = "unknown key."
FINDINGS_SHOWN: Final = 8


@dataclass(frozen=True)
class Finding:
    """Something that speaks against a recipe."""

    where: str
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        rest = f" {self.remedy}" if self.remedy else ""
        return f"{self.where}: {self.what}{rest}"


class RecipeError(UsageError):
    """A recipe that cannot be used; `findings` are all that was found, not the first alone."""

    def __init__(self, path: Path, findings: tuple[Finding, ...], what: str = "recipe") -> None:
        shown = "\n         ".join(str(finding) for finding in findings[:FINDINGS_SHOWN])
        more = len(findings) - FINDINGS_SHOWN
        super().__init__(
            f"The {what} {printable(str(path))} cannot be used.",
            where=shown + (f"\n         and {more} more" if more > 0 else ""),
            remedy=f"Correct the {what}.",
        )
        self.findings = findings


@dataclass(frozen=True)
class LoadedTarget:
    """A target of a recipe, with its image and what its maker states of it."""

    firmware: Firmware
    image: Image = field(repr=False)
    release: Release
    profile: Profile
    required: Verified
    """How far it must be verified to pass."""

    @property
    def target(self) -> Target:
        """The device."""
        return self.firmware.device

    @property
    def name(self) -> str:
        """The target's name."""
        return self.firmware.target

    @property
    def version(self) -> str:
        """The version inside the image, or that the manifest states; empty when nobody says it."""
        return self.image.version or self.release.firmware_version or ""

    @property
    def can_read_version(self) -> bool:
        """True when the application can be asked for its version."""
        return self.profile.version_query is not None


@dataclass(frozen=True)
class LoadedRecipe:
    """A recipe as it was read, frozen, with the hash of its file."""

    recipe: Recipe
    path: Path
    sha256: str
    """Of the file's bytes."""
    content: str
    """The file's text."""
    targets: tuple[LoadedTarget, ...]
    files: Mapping[Path, str] = field(repr=False)
    """Every file that it was made of, with its SHA-256."""

    @cached_property
    def required(self) -> Verified:
        """The weakest verification that any of its targets needs."""
        return min(target.required for target in self.targets)

    def is_unchanged(self) -> bool:
        """True while recipe, images, manifests and profile on disk are those that were read."""
        try:
            return all(_sha256(path) == sha256 for path, sha256 in self.files.items())
        except FlasherError:
            return False

    def scan(self, serial: str, day: date, lot: str = "") -> Scan:
        """What a scanned serial number says. The lot in it goes before the one given.

        Raises ValueError saying why it is no serial number of this recipe.
        """
        rule = self.recipe.serial_number
        groups = rule.read(serial)
        own_lot = groups[rule.lot_group] if rule.lot_group else ""
        if own_lot and lot and own_lot != lot:
            raise ValueError(f"{serial!a:.80} is of lot {own_lot!a:.40}, not of {lot!a:.40}")
        return Scan(serial, day, own_lot or lot, groups)

    def write_plans(self, scan: Scan) -> tuple[WritePlan, ...]:
        """What to write to this unit, in order. Raises UsageError for a value that does not fit."""
        return tuple(self.write_plan(write, scan) for write in self.recipe.write)

    def write_plan(self, write: Write, scan: Scan) -> WritePlan:
        """What one `[[write]]` comes to. Raises UsageError for a value that does not fit."""
        try:
            values = [fill(template, scan) for template in write.values]
        except ValueError as error:
            raise UsageError(f"{write.item}: {error}.") from error
        dialect = next(t.profile.dialect for t in self.targets if t.name == write.target)
        return plan_write(
            write.item, values, write.device, dialect=dialect, manufacturer=write.manufacturer
        )


def load_recipe(path: Path) -> LoadedRecipe:
    """The recipe at `path` with its images.

    Raises RecipeError with all that is wrong with the file, or with files that it names. It does
    not try values: `recipe_check.check_recipe` does.
    """
    findings: list[Finding] = []
    raw = read(path, TOML_MAX_SIZE, what="recipe")
    recipe = parse(Recipe, path, raw)
    files = {path: hashlib.sha256(raw).hexdigest()}
    targets = []
    for number, firmware in enumerate(recipe.target, 1):
        loaded = _load_target(path, recipe, firmware, f"target {number}", findings)
        if loaded is not None:
            targets.append(loaded[0])
            files |= loaded[1]
    if findings:
        raise RecipeError(path, tuple(findings))
    return LoadedRecipe(recipe, path, files[path], raw.decode("utf-8-sig"), tuple(targets), files)


def _sha256(path: Path) -> str:
    with opened(path, FILE_MAX_SIZE) as (file, _):
        return hashlib.file_digest(file, "sha256").hexdigest()


def parse(model: type[Model], path: Path, raw: bytes, what: str = "recipe") -> Model:
    """A TOML file as a checked model. Raises RecipeError with all that is wrong."""
    try:
        return model.model_validate(parse_toml(raw))
    except ValidationError as error:
        # An unknown key first: it may be why another one is missing.
        found = sorted(_findings(model, error), key=lambda each: each.what != _UNKNOWN_KEY)
        raise RecipeError(path, tuple(found), what) from error
    except ValueError as error:
        no_toml = Finding(
            printable(str(path)),
            f"it is no TOML file: {printable(str(error))}.",
            "Texts stand in quotes, lists in brackets, tables as [name].",
        )
        raise RecipeError(path, (no_toml,), what) from error


def _findings(model: type[BaseModel], error: ValidationError) -> Iterator[Finding]:
    for detail in error.errors(include_url=False, include_context=False):
        where = ".".join(_shown(part) for part in detail["loc"]) or "the whole file"
        if detail["type"] == "extra_forbidden":
            key = str(detail["loc"][-1])
            names = _keys_at(model, detail["loc"][:-1])
            close = difflib.get_close_matches(key.lower(), names, n=1)
            guess = f"Did you mean {close[0]}? " if close else ""
            yield Finding(where, _UNKNOWN_KEY, f"{guess}Known are: {', '.join(names)}.")
        else:
            said = printable(detail["msg"].removeprefix("Value error, "))
            yield Finding(where, f"{said[:1].lower()}{said[1:]}.")


def _shown(part: str | int) -> str:
    return str(part + 1) if isinstance(part, int) else printable(part)[:60]


def _keys_at(model: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    """The keys of the table at this place of a document."""
    found: type[BaseModel] | None = model
    for part in location:
        if not isinstance(part, str) or found is None or part not in found.model_fields:
            continue
        found = _model_in(found.model_fields[part].annotation)
    return list(found.model_fields) if found is not None else []


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _model_in(argument)
        if found is not None:
            return found
    return None


# -- files of a recipe ----------------------------------------------------------------------------


def inside(recipe_path: Path, name: str) -> Path:
    """The file `name` in the folder of the recipe. Raises ValueError for one that is outside."""
    windows, posix = PureWindowsPath(name), PurePosixPath(name)
    if windows.anchor or windows.drive or posix.is_absolute() or ".." in windows.parts:
        raise ValueError(f"{name!a:.80} does not stay in the recipe's folder")
    folder = recipe_path.parent.resolve()
    try:
        path = (folder / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{name!a:.80} names no file") from error
    if not path.is_relative_to(folder):
        raise ValueError(f"{name!a:.80} is a link that leads out of the recipe's folder")
    return path


def _load_target(
    path: Path, recipe: Recipe, firmware: Firmware, where: str, findings: list[Finding]
) -> tuple[LoadedTarget, dict[Path, str]] | None:
    """The target with its files; None, and findings, where something is wrong with them."""
    before = len(findings)
    try:
        image_path = inside(path, firmware.image)
        default = manifest_path(firmware.image)
        manifest = inside(path, firmware.manifest or str(default))
        profile_path = inside(path, recipe.profile) if recipe.profile else None
        files = [image_path, manifest, *([profile_path] if profile_path else [])]
        # Before and after loading: what was loaded is what was hashed.
        hashes = {file: _sha256(file) for file in files}
        image = load(image_path, base=firmware.base)
        release = read_release(manifest)
        # Without a profile of its own: what lies about on the computer must not matter.
        profile = load_profile(profile_path or os.devnull, firmware.device)
        if any(_sha256(file) != sha256 for file, sha256 in hashes.items()):
            findings.append(Finding(where, "a file changed while it was read.", "Try again."))
    except ValueError as error:
        findings.append(Finding(where, f"{error}.", "Copy it there, and name it by its name."))
    except FlasherError as error:
        findings.append(Finding(where, error.what, error.remedy))
    if len(findings) > before:
        return None
    required = _required(firmware, profile)
    return LoadedTarget(firmware, image, release, profile, required), hashes


def _required(firmware: Firmware, profile: Profile) -> Verified:
    if firmware.verify is not None:
        return firmware.verify.level
    return Verify.VERSION.level if profile.version_query is not None else Verified.COMPLETED
