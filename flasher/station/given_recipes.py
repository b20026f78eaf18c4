"""Recipes from the plant: their files, the folder that stores them, and their approval.

A recipe is given with its files as a *bundle*. Its digest is the SHA-256 of its manifest, which
names each file with its SHA-256. The process of `flasher.plant` writes the folder, whole bundles
only; the station reads it, and checks every hash again. Approvals are rows of the station's signed
audit trail (`AuditEvent.RECIPE_APPROVED`), so that a restart needs no server.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import date, datetime
from pathlib import Path
from secrets import token_hex
from typing import Annotated, Final

from pydantic import AfterValidator, TypeAdapter, ValidationError

from flasher.errors import ErrorCode, FlasherError, UsageError
from flasher.files import is_plain, read
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.recipe_file import DAMAGED_COPY, LoadedRecipe, load_checked, sha256_of
from flasher.station.records.chain import canonical
from flasher.station.records.database import in_file_name
from flasher.station.records.errors import RecordError, mapped
from flasher.station.records.files import sync_folder

FILES_MAX: Final = 32
"""Maximum number of files of a bundle."""
_MANIFEST: Final = "bundle.json"
_FILES: Final = "files"
_STATE: Final = "given.json"
_PART: Final = ".part-"
_STATE_MAX_SIZE: Final = 256 * 1024
_PART_AGE_S: Final = 3600.0
_NOT_KEPT: Final = "A recipe from the plant cannot be saved"


@dataclass(frozen=True)
class Bundle:
    """Manifest of a recipe with its files."""

    recipe: str
    """Name of the recipe file."""
    files: Mapping[str, str]
    """SHA-256 of each file by its path in the recipe's folder, with /."""

    def to_text(self) -> str:
        return canonical({"recipe": self.recipe, "files": dict(self.files)})

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.to_text().encode("ascii")).hexdigest()


_BUNDLE: Final = TypeAdapter(Bundle)


def bundle_of(loaded: LoadedRecipe) -> Bundle:
    """The bundle of a loaded recipe."""
    folder = loaded.path.parent.resolve()
    files = {
        path.resolve().relative_to(folder).as_posix(): sha256
        for path, sha256 in loaded.files.items()
    }
    return Bundle(loaded.path.name, files)


def parse_bundle(manifest: str, digest: str) -> Bundle:
    """Parse a manifest from the plant. Raises ValueError for one that is not of this digest, or
    names files outside of the recipe's folder.
    """
    if hashlib.sha256(manifest.encode("utf-8")).hexdigest() != digest:
        raise ValueError("its manifest has another hash")
    try:
        bundle = _BUNDLE.validate_json(manifest)
    except ValidationError as error:
        raise ValueError("its manifest cannot be read") from error
    names = list(bundle.files)
    if len(names) > FILES_MAX or bundle.recipe not in names or "/" in bundle.recipe:
        raise ValueError(f"its manifest names no recipe, or more than {FILES_MAX} files")
    if len({name.casefold() for name in names}) != len(names):
        raise ValueError("two of its files have the same name")
    for name in names:
        if not is_plain(name):
            raise ValueError(f"{name!a:.80} is no plain name of a file in its folder")
    return bundle


# -- what the plant gives --------------------------------------------------------------------------


def _moment(at: str) -> str:
    """Check a time, which pages show in their own time zone. Raises ValueError."""
    try:
        datetime.fromisoformat(at).astimezone()
    except OverflowError as error:
        raise ValueError(str(error)) from error
    return at


@dataclass(frozen=True)
class GivenRecipe:
    """A recipe that the plant gives to this station."""

    digest: str
    sockets: tuple[str, ...]
    """Sockets that it is for."""
    at: Annotated[str, AfterValidator(_moment)]
    """Time of its publication, by the database's clock."""
    by: str
    """User of the database who published it."""
    fault: str = ""
    """Why its files are not here; "" if they are."""


@dataclass(frozen=True)
class Given:
    """What the plant gave when it could last be reached."""

    recipes: tuple[GivenRecipe, ...] = ()
    withdrawn: frozenset[str] = frozenset()
    """Digests of withdrawn recipes: the station begins no unit with them."""


_GIVEN: Final = TypeAdapter(Given)


class RecipeFolder:
    """Recipes from the plant, in a folder of one station."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._whole: dict[str, object] = {}
        """State of the files of the bundles that were whole, by digest."""

    @classmethod
    def of(cls, files: Path, station: str) -> RecipeFolder:
        """The folder beside the files of the records, which stations may share."""
        return cls(files / f"recipes-{in_file_name(station)}")

    def given(self) -> Given:
        """What the plant gave; nothing before it was reached first. Raises RecordError."""
        path = self.folder / _STATE
        if not path.exists():
            return Given()
        try:
            return _GIVEN.validate_json(read(path, _STATE_MAX_SIZE, error=RecordError))
        except ValidationError as error:
            raise RecordError(
                "The list of recipes from the plant cannot be read.",
                where=printable(str(path)),
                remedy="Fetch it again: flasher plant fetch --sockets FILE. Without the server,"
                " delete the file: what the plant has withdrawn is not known until it answers.",
            ) from error

    def save_given(self, given: Given) -> None:
        """Write what the plant gives, whole or not at all. Raises RecordError."""
        with self._part() as part:
            _write(part / _STATE, [_GIVEN.dump_json(given)])
            (part / _STATE).replace(self.folder / _STATE)

    def digests(self) -> tuple[str, ...]:
        """Digests of the bundles that are here."""
        with suppress(OSError):
            return tuple(sorted(each.parent.name for each in self.folder.glob(f"*/{_MANIFEST}")))
        return ()

    def add(self, bundle: Bundle, fetch: Callable[[str], Iterable[bytes]]) -> None:
        """Add a bundle, whole or not at all; `fetch` returns the content of a file by its SHA-256
        in pieces. Raises RecordError, and ValueError for a file that has another hash.
        """
        with self._part() as part:
            for name, sha256 in bundle.files.items():
                if _write(part / _FILES / name, fetch(sha256)) != sha256:
                    raise ValueError(f"{name} has another hash than its manifest states")
            _write(part / _MANIFEST, [bundle.to_text().encode("ascii")])
            final = self.folder / bundle.digest
            shutil.rmtree(final, ignore_errors=True)  # a damaged copy
            part.replace(final)

    def keep(self, digests: Collection[str]) -> None:
        """Delete other bundles, and what a killed process left."""
        with suppress(OSError):
            for each in self.folder.iterdir():
                # Another process may be fetching into a young one.
                is_young = time.time() - each.stat().st_mtime < _PART_AGE_S
                is_kept = is_young if each.name.startswith(_PART) else each.name in digests
                if each.is_dir() and not is_kept:
                    shutil.rmtree(each, ignore_errors=True)

    def is_whole(self, digest: str) -> bool:
        """True if a bundle is here, with the content that its digest states. Its files are read
        again if they have changed since; `load` reads them in any case.
        """
        try:
            state = self._state(digest)
            if self._whole.get(digest) != state:
                self._checked(digest)
                self._whole[digest] = state
        except (FlasherError, OSError):
            return False
        return True

    def _state(self, digest: str) -> object:
        """Equal as long as nobody writes to the files of a bundle. Raises OSError."""
        paths = sorted((self.folder / digest).rglob("*"))
        stats = [(path, path.stat()) for path in paths]
        return [(path, each.st_size, each.st_mtime_ns, each.st_ino) for path, each in stats]

    def load(self, digest: str, day: date) -> LoadedRecipe:
        """Load a recipe and check it as `flasher station check` does. Its digest covers each file
        that is loaded. `signature = "waived"` in it counts for nothing: whoever can write to the
        plant's database must not decide what this computer's trust file asks for.

        Raises UsageError with all problems.
        """
        try:
            bundle = self._checked(digest)
        except UsageError:
            with suppress(OSError):  # so that the process that fetches reads it again
                os.utime(self.folder / digest / _MANIFEST)
            raise
        path = self.folder / digest / _FILES / bundle.recipe
        loaded = replace(load_checked(path, day, may_waive=False), digest=digest)
        if bundle_of(loaded).files.items() - bundle.files.items():
            raise _damaged(path)  # changed in between, or files were added
        return loaded

    def _checked(self, digest: str) -> Bundle:
        """The bundle of a digest, after all files were compared. Raises UsageError."""
        folder = self.folder / digest
        try:
            manifest = read(folder / _MANIFEST, _STATE_MAX_SIZE).decode("utf-8", "replace")
            bundle = parse_bundle(manifest, digest)
            if any(sha256_of(folder / _FILES / name) != is_ for name, is_ in bundle.files.items()):
                raise _damaged(folder)
        except (ValueError, FlasherError) as error:
            raise _damaged(folder) from error
        return bundle

    @contextmanager
    def _part(self) -> Iterator[Path]:
        """Yields a new folder, in which is prepared what then gets its name. Raises RecordError."""
        part = self.folder / f"{_PART}{token_hex(4)}"
        try:
            with mapped(printable(str(self.folder)), writes=True, begin=_NOT_KEPT):
                yield part
                sync_folder(self.folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _write(path: Path, pieces: Iterable[bytes]) -> str:
    """Write a file to the disk; returns its SHA-256."""
    digest = hashlib.sha256()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as out:
        for piece in pieces:
            digest.update(piece)
            out.write(piece)
        out.flush()
        os.fsync(out.fileno())
    return digest.hexdigest()


def _damaged(path: Path) -> UsageError:
    return UsageError(
        DAMAGED_COPY,
        where=printable(str(path)),
        remedy=text("Approve another recipe, or wait until it was fetched again."),
        code=ErrorCode.FILE_NOT_READ,
    )
