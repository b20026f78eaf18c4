"""Release manifest: a TOML file next to a firmware image with its version, hash and rules.

`firmware.hex` has `firmware.hex.toml`:

    format = 1
    target = "bms"
    firmware_version = "V1r0r4_20220512"
    size_bytes = 78351
    sha256 = "5084b23b..."
    hardware_versions = ["V1r2r0_*"]
    minimum_boot_version = "V1.0.0"
    previous_from = "V1r0r0_20220512"

An unreadable or invalid manifest is an ImageError, because its image cannot be trusted.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import tomli_w

from flasher.errors import ErrorCode, ImageError
from flasher.files import read_toml
from flasher.image.image import Image
from flasher.image.release import Release
from flasher.protocol.spec import Target
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.settings.toml_reader import Reader

FORMAT_KEY: Final = "format"
FORMAT_VERSION: Final = 1
STATEMENTS: Final = tuple(each.name for each in fields(Release) if each.name != "source")
"""Keys of a manifest in the order in which they are written."""
SUFFIX: Final = ".toml"


def manifest_path(image_path: str | os.PathLike[str]) -> Path:
    """Path of an image's manifest: the image's path with `.toml` appended."""
    path = Path(image_path)
    return path.with_name(path.name + SUFFIX)


def find_release(
    image_path: str | os.PathLike[str], given: str | os.PathLike[str] | None = None
) -> Release | None:
    """Read the manifest `given`, else the one next to the image; None without any.

    Raises UsageError and ImageError like `read_release`.
    """
    if given is not None:
        return read_release(given)
    beside = manifest_path(image_path)
    # A dangling link counts as existing, so that it is an error.
    return read_release(beside) if os.path.lexists(beside) else None


@cache
def reader() -> Reader[Release]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(
        Release,
        "manifest",
        error=ImageError,
        remedy="Correct it, or write it again with `flasher manifest create --force`.",
        beside=("source",),
        also=(FORMAT_KEY,),
    )


def read_release(path: str | os.PathLike[str]) -> Release:
    """Read a release manifest.

    Raises UsageError if the file does not exist or is not regular; ImageError, with all problems,
    if it cannot be read, is not TOML, or has another format version.
    """
    document = read_toml(
        path,
        what="manifest",
        error=ImageError,
        if_missing="Correct the name, or write it with `flasher manifest create`.",
    )
    _check_format(document, printable(os.fspath(path)))
    stated = {key: value for key, value in document.items() if key != FORMAT_KEY}
    return reader().read(stated, path, source=os.fspath(path))


def check_statement(key: str, value: object) -> None:
    """Raise ValueError for a value that a manifest cannot contain."""
    _, faults = reader().check({key: value}, source="")
    for fault in faults:
        if fault.place.startswith(key):
            raise ValueError(str(fault))


def _check_format(document: Mapping[str, Any], shown: str) -> None:
    version = document.get(FORMAT_KEY)
    if type(version) is int and version == FORMAT_VERSION:
        return
    newer = type(version) is int and version > FORMAT_VERSION
    problem = "does not state its format" if version is None else f"has the format {version!a:.60}"
    raise ImageError(
        f"The manifest {problem}; this flasher reads {FORMAT_KEY} = {FORMAT_VERSION}.",
        where=shown,
        cause="it was written by a newer flasher" if newer else "it is not a manifest of flasher",
        remedy="Use a newer flasher." if newer else "Write it with `flasher manifest create`.",
        code=ErrorCode.MANIFEST,
    )


def release_of(
    image: Image,
    target: Target,
    *,
    source: str = "",
    firmware_version: str | None = None,
    **statements: str | int | Sequence[str] | None,
) -> Release:
    """Create the release of an image; `statements` are further manifest keys. The default firmware
    version is the one inside the image.

    Raises ImageError if the given firmware version differs from the one inside, ValueError for a
    value that a manifest cannot contain.
    """
    if firmware_version and image.version and firmware_version != image.version:
        raise ImageError(
            f"The image is version {image.version}, not {printable(firmware_version)}.",
            where=f"the text inside {printable(image.source)}",
            remedy="Omit the version: the one inside applies.",
            code=ErrorCode.MANIFEST,
        )
    stated = {
        "target": target.name,
        "firmware_version": firmware_version or image.version,
        "size_bytes": image.size_bytes,
        "sha256": image.sha256,
        **statements,
    }
    release, faults = reader().check(stated, source=source)
    if release is None or faults:
        raise ValueError("\n".join(map(str, faults)))
    return release


def stated_keys(release: Release) -> dict[str, Any]:
    """Return the keys of a manifest with their values, without unset ones."""
    values = {key: getattr(release, key) for key in STATEMENTS}
    return {
        key: value.name if isinstance(value, Target) else value
        for key, value in values.items()
        if value not in (None, (), "")
    }


def to_toml(release: Release) -> str:
    """Format a manifest, without unset values."""
    return tomli_w.dumps({FORMAT_KEY: FORMAT_VERSION, **stated_keys(release)})
