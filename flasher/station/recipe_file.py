"""Loads a recipe with its images, checks it before a shift, and detects later changes of its files.

The files of a recipe are in its folder: absolute paths, `..` and links out of it are refused.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final

from flasher.errors import ErrorCode, Fault, FlasherError, UsageError
from flasher.files import TOML_MAX_SIZE, opened, read
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.items import Readable, find_item, meaningful_fields, readable
from flasher.host.query import READ_MEMORY
from flasher.host.write import WritePlan, plan_write
from flasher.i18n import text, with_value
from flasher.image.image import Image
from flasher.image.load import FILE_MAX_SIZE, load
from flasher.image.release import Provenance, Release
from flasher.jobs import check_signatures, open_image, prepare
from flasher.protocol.fields import Codec, NumberField
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.release.places import release_path
from flasher.settings.manifest import manifest_path, read_release
from flasher.settings.profile import Profile, load_profile
from flasher.station.recipe import (
    RECIPE,
    Firmware,
    Limit,
    Recipe,
    Scan,
    SignatureRule,
    Unchanged,
    Write,
    check_template,
    fill,
    uses_lot,
)
from flasher.station.records.model import Signature, Verified

DAMAGED_COPY: Final = text(
    "The copy of a recipe from the plant is damaged. It is fetched again when the server can be"
    " reached."
)
_SAMPLE_LOT: Final = "LOT1"


@dataclass(frozen=True)
class LoadedTarget:
    """A target of a recipe with its loaded image, manifest and profile."""

    firmware: Firmware
    path: Path
    """The image, or the release with it."""
    image: Image = field(repr=False)
    release: Release
    profile: Profile
    required: Verified
    """Verification level that a PASS requires."""
    provenance: Provenance | None = None
    """Result of checking signatures when the recipe was loaded; None if nothing asks for any."""

    @property
    def target(self) -> Target:
        return self.firmware.device

    @property
    def name(self) -> str:
        return self.firmware.target

    @property
    def version(self) -> str:
        """Version in the image, or else in the manifest; "" without one."""
        return self.image.version or self.release.firmware_version or ""

    def check_signatures(self) -> Provenance | None:
        """Check the signatures against the trust file as it is now. None if nothing asks for any.

        Raises UsageError for a refusal that the recipe does not waive.
        """
        rule = self.firmware.signature
        is_required = rule is SignatureRule.REQUIRED
        found = check_signatures(self.path, self.target, require_signed=is_required)
        problem = None if found is None else found.problem
        if problem is None or rule is SignatureRule.WAIVED:
            return found
        sentence = problem.what
        if problem.cause:
            sentence = text("{what} Cause: {cause}.", what=problem.what, cause=problem.cause)
        remedy = problem.remedy
        if problem.code is ErrorCode.RELEASE_UNSIGNED and release_path(self.path) is None:
            remedy = text(
                "Take the release (*.wfw) of its maker, or waive it in the recipe:"
                " signature = 'waived'."
            )
        raise UsageError(sentence, remedy=remedy, code=problem.code)

    def signature(self) -> Signature | None:
        """Check the signatures for the records. Raises UsageError like `check_signatures`."""
        found = self.check_signatures()
        if self.firmware.signature is SignatureRule.WAIVED and (found is None or found.problem):
            why = text("the image is not signed") if found is None else found.text
            # Records name files of the recipe without their folder.
            source = release_path(self.path) or self.path
            why = with_value(why, printable(str(source)), printable(source.name))
            return Signature(text("waived by the recipe: {why}", why=why))
        if found is None:
            return None
        if not found.signers:
            return Signature(found.text)
        return Signature(found.text, self.release.product or "", self.release.counter)

    @property
    def identity(self) -> Identity:
        """Settings of the identity checks."""
        is_waived = self.firmware.signature is SignatureRule.WAIVED
        return self.profile.identity(
            release=self.release,
            provenance=self.provenance,
            waived=frozenset({IdentityCheck.UNSIGNED} if is_waived else ()),
            reports_unchecked=True,
        )


@dataclass(frozen=True)
class LoadedRecipe:
    """A loaded recipe with its images."""

    recipe: Recipe
    path: Path
    sha256: str
    """SHA-256 of the recipe file."""
    content: str
    """Text of the recipe file."""
    targets: tuple[LoadedTarget, ...]
    files: Mapping[Path, str] = field(repr=False)
    """SHA-256 of each loaded file: recipe, images, manifests and profile."""
    digest: str = ""
    """Digest of the bundle, if the plant gave it (`given_recipes`); "" for a local recipe."""

    @cached_property
    def required(self) -> Verified:
        """Lowest verification level that a target requires."""
        return min(target.required for target in self.targets)

    def is_unchanged(self) -> bool:
        """True if the recipe's files on disk still have the loaded content."""
        try:
            return all(sha256_of(path) == sha256 for path, sha256 in self.files.items())
        except FlasherError:
            return False

    def scan(self, serial: str, day: date, lot: str = "") -> Scan:
        """Parse a scanned serial number. `lot` is used if the serial number contains none.

        Raises ValueError for a serial number that this recipe does not accept, or of another
        lot.
        """
        rule = self.recipe.serial_number
        groups = rule.read(serial)
        own_lot = groups[rule.lot_group] if rule.lot_group else ""
        if own_lot and lot and own_lot != lot:
            raise ValueError(f"{serial!a:.80} is of lot {own_lot!a:.40}, not of {lot!a:.40}")
        return Scan(serial, day, own_lot or lot, groups)

    def write_plan(self, write: Write, scan: Scan) -> WritePlan:
        """Plan a `[[write]]`. Raises UsageError for a value that does not fit."""
        try:
            values = [fill(template, scan) for template in write.values]
        except ValueError as error:
            raise UsageError(f"{write.item}: {error}.") from error
        dialect = next(t.profile.dialect for t in self.targets if t.name == write.target)
        return plan_write(
            write.item, values, write.device, dialect=dialect, manufacturer=write.manufacturer
        )


def load_recipe(path: Path, *, may_waive: bool = True) -> LoadedRecipe:
    """Load a recipe with its images without trying its values. Without `may_waive`,
    `signature = "waived"` in it is read as "checked".

    Raises UsageError with all problems of the file and the files that it refers to.
    """
    raw = read(path, TOML_MAX_SIZE, what="recipe")
    recipe = RECIPE.parse(raw, path)
    if not may_waive:
        checked = {"signature": SignatureRule.CHECKED}
        recipe = recipe.model_copy(
            update={
                "target": tuple(
                    each.model_copy(update=checked)
                    if each.signature is SignatureRule.WAIVED
                    else each
                    for each in recipe.target
                )
            }
        )
    files = {path: hashlib.sha256(raw).hexdigest()}
    targets: list[LoadedTarget] = []
    faults: list[Fault] = []
    for number, firmware in enumerate(recipe.target):
        try:
            target, its_files = _load_target(path, recipe, firmware)
        except ValueError as error:
            remedy = "Copy the file into the recipe's folder, and use its name there."
            faults.append(Fault(f"target[{number}]", f"{error}.", remedy))
        except FlasherError as error:
            faults.append(Fault(f"target[{number}]", error.what, error.remedy))
        else:
            targets.append(target)
            files |= its_files
    if faults:
        raise RECIPE.refusal(path, faults)
    return LoadedRecipe(recipe, path, files[path], raw.decode("utf-8-sig"), tuple(targets), files)


def load_checked(path: Path, day: date, *, may_waive: bool = True) -> LoadedRecipe:
    """Load a recipe with its images, and check everything that needs no device.

    `day`: the day of production of the sample scan; `may_waive`: see `load_recipe`. Raises
    UsageError with all problems.
    """
    loaded = load_recipe(path, may_waive=may_waive)
    faults = [
        *(
            fault
            for number, target in enumerate(loaded.targets)
            for fault in _check_target(loaded, target, f"target[{number}]")
        ),
        *_check_scan(loaded, day),
        *_check_reads(loaded),
        *_check_golden(loaded),
    ]
    if faults:
        raise RECIPE.refusal(path, faults)
    return loaded


def sha256_of(path: Path) -> str:
    """SHA-256 of a file. Raises UsageError."""
    with opened(path, FILE_MAX_SIZE) as (file, _):
        return hashlib.file_digest(file, "sha256").hexdigest()


# -- files of a recipe ----------------------------------------------------------------------------


def _inside(recipe_path: Path, name: str) -> Path:
    """Path of a file in the recipe's folder. Raises ValueError for a path outside."""
    windows, posix = PureWindowsPath(name), PurePosixPath(name)
    if windows.anchor or windows.drive or posix.is_absolute() or ".." in windows.parts:
        raise ValueError(f"{name!a:.80} is outside of the recipe's folder")
    folder = recipe_path.parent.resolve()
    try:
        path = (folder / name).resolve()
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{name!a:.80} is not a file name") from error
    if not path.is_relative_to(folder):
        raise ValueError(f"{name!a:.80} is a link that leads out of the recipe's folder")
    return path


def _load_target(
    path: Path, recipe: Recipe, firmware: Firmware
) -> tuple[LoadedTarget, dict[Path, str]]:
    """Load a target with its files. Raises ValueError for a file outside the folder, FlasherError
    for an unusable one.
    """
    image_path = _inside(path, firmware.image)
    manifest = _inside(path, firmware.manifest or str(manifest_path(firmware.image)))
    profile_path = _inside(path, recipe.profile) if recipe.profile else None
    signed = release_path(image_path)
    if signed is not None:
        manifest = _inside(path, os.path.relpath(signed, path.parent.resolve()))
        if firmware.manifest or firmware.base is not None:
            raise UsageError(
                f"{firmware.image!a:.80} is signed with its manifest, as a whole file.",
                remedy="Remove manifest and base: a release is taken as it is.",
            )
    files = [image_path, manifest, *([profile_path] if profile_path else [])]
    # Hashed before and after loading: the hashes are those of the loaded bytes.
    hashes = {file: sha256_of(file) for file in files}
    if signed is None:
        image, release = load(image_path, base=firmware.base), read_release(manifest)
    else:
        opened = open_image(image_path, firmware.device)
        if opened.release is None:
            raise UsageError("a file changed while it was read.", remedy="Try again.")
        image, release = opened.image, opened.release
    # os.devnull as profile: one of the user must not change the recipe.
    profile = load_profile(profile_path or os.devnull, firmware.device)
    if firmware.verify is not None:
        required = firmware.verify.level
    else:
        can_ask = profile.version_query is not None
        required = Verified.VERSION if can_ask else Verified.COMPLETED
    target = LoadedTarget(firmware, image_path, image, release, profile, required)
    target = replace(target, provenance=target.check_signatures())
    if any(sha256_of(file) != sha256 for file, sha256 in hashes.items()):
        raise UsageError("a file changed while it was read.", remedy="Try again.")
    return target, hashes


# -- checks ---------------------------------------------------------------------------------------

_REMEDIES: Final = {
    IdentityCheck.PLAUSIBLE: "Name the firmware file itself.",
    IdentityCheck.TARGET: "Choose the image for this target, or the target that it was built for.",
}


def _check_target(loaded: LoadedRecipe, target: LoadedTarget, where: str) -> Iterator[Fault]:
    if target.firmware.sha256 != target.image.sha256:
        yield Fault(
            where,
            f"sha256 is {target.firmware.sha256}, the image has {target.image.sha256}.",
            "Take the image that the recipe was released with, or release a new recipe.",
        )
    try:
        for check in prepare(target.image, target.profile, identity=target.identity).checks:
            if check.ending is not None:
                yield Fault(where, f"{check.text}.", _REMEDIES.get(check.check, ""))
    except FlasherError as error:
        yield Fault(where, error.what, error.remedy)
    yield from _check_level(loaded, target, where)


def _check_level(loaded: LoadedRecipe, target: LoadedTarget, where: str) -> Iterator[Fault]:
    if target.required is Verified.COMPLETED:
        if not loaded.recipe.allow_completed_not_read_back:
            yield Fault(
                where,
                "its version is not read back, and allow_completed_not_read_back is false.",
                "Name a profile with its version_query, or allow it.",
            )
        return
    if target.required is Verified.MEMORY:
        if READ_MEMORY.receiver is not target.target.node:
            yield Fault(where, "its memory cannot be read.", "Verify the version.")
        elif target.image.base is None:
            yield Fault(where, "a raw binary can be read back only with its base.")
        return
    if target.profile.version_query is None:
        yield Fault(
            where,
            "it cannot be asked for its version.",
            "Name a profile with its version_query, or verify = 'completed'.",
        )
    elif target.image.version is None:
        yield Fault(
            where,
            "the image names no version to compare.",
            "Verify the memory, or verify = 'completed'.",
        )


def _check_scan(loaded: LoadedRecipe, day: date) -> Iterator[Fault]:
    recipe = loaded.recipe
    scan = loaded.scan(recipe.serial_number.example, day)
    has_lot = bool(recipe.serial_number.lot_group) or recipe.lot.required
    if not scan.lot and has_lot:
        scan = Scan(scan.serial, day, _SAMPLE_LOT, scan.groups)
    for number, write in enumerate(recipe.write):
        where = f"write[{number}]"
        try:
            loaded.write_plan(write, scan)
        except UsageError as error:
            yield Fault(where, error.what, error.remedy)
        if not has_lot and any(map(uses_lot, write.values)):
            yield Fault(
                where, "{lot} is used, but units may have no lot.", "Set lot.required = true."
            )
        if any(
            (write.target, write.item) == (each.target, each.item) for each in recipe.write[:number]
        ):
            yield Fault(where, f"{write.item} is written twice.", "Remove one of the two.")


def _check_reads(loaded: LoadedRecipe) -> Iterator[Fault]:
    groups = loaded.scan(loaded.recipe.serial_number.example, date(2000, 1, 1)).groups
    written = {(write.target, write.item.lower()) for write in loaded.recipe.write}
    for number, unchanged in enumerate(loaded.recipe.unchanged):
        try:
            item = readable_of(loaded, unchanged)
        except UsageError as error:
            yield Fault(f"unchanged[{number}]", error.what, error.remedy)
            continue
        if (unchanged.target, item.name) in written:
            yield Fault(f"unchanged[{number}]", f"{item.name} is written by this recipe.")
    for number, limit in enumerate(loaded.recipe.limit):
        where = f"limit[{number}]"
        try:
            codec = codec_of(loaded, limit)
            if limit.expected is not None:
                check_template(limit.expected, groups)
        except UsageError as error:
            yield Fault(where, error.what, error.remedy)
        except ValueError as error:
            yield Fault(where, f"{error}.")
        else:
            if isinstance(codec, NumberField) != (limit.expected is None):
                kind = (
                    "a number: give low or high"
                    if isinstance(codec, NumberField)
                    else "not a number: give expected"
                )
                yield Fault(where, f"{limit.field} is {kind}.")


def readable_of(loaded: LoadedRecipe, part: Unchanged | Limit) -> Readable:
    """Item that a table of the recipe reads. Raises UsageError for an unreadable one."""
    target = next(each for each in loaded.targets if each.name == part.target)
    return find_item(
        part.item, readable(target.target, target.profile.dialect), target.target, "read"
    )


def codec_of(loaded: LoadedRecipe, limit: Limit) -> Codec:
    """Field that a limit measures. Raises UsageError for an unknown item or field."""
    item = readable_of(loaded, limit)
    fields = dict(meaningful_fields(item.content))
    if limit.field not in fields:
        raise UsageError(
            f"{item.name} has no field {limit.field!a:.40}.",
            remedy=f"Its fields are {', '.join(fields)}.",
        )
    return fields[limit.field]


def _check_golden(loaded: LoadedRecipe) -> Iterator[Fault]:
    golden = loaded.recipe.golden
    for number, serial in enumerate(golden.serial_numbers if golden is not None else ()):
        try:
            loaded.recipe.serial_number.read(serial)
        except ValueError as error:
            yield Fault(f"golden.serial_numbers[{number}]", f"{error}.")
