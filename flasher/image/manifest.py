"""The release manifest: a release as a TOML file beside its image.

`firmware.hex` has `firmware.hex.toml`:

    format = 1
    target = "bms"
    firmware_version = "V1r0r4_20220512"
    size_bytes = 78351
    sha256 = "5084b23b..."
    hardware_versions = ["V1r2r0_*"]
    minimum_boot_version = "V1.0.0"
    previous_from = "V1r0r0_20220512"

A manifest that cannot be read or breaks the rules of `manifest_keys` is an ImageError: its image is
not trustworthy then.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import tomli_w

from flasher.errors import ImageError
from flasher.files import read_toml
from flasher.image.manifest_keys import (
    FORMAT_KEY,
    FORMAT_VERSION,
    KEYS,
    explain_unknown,
    read_value,
)
from flasher.image.release import Release, check_target, release_of
from flasher.protocol.spec import Target
from flasher.protocol.text import printable

__all__ = [
    "Release",
    "check_target",
    "find_release",
    "manifest_path",
    "read_release",
    "release_of",
    "to_toml",
]

SUFFIX: Final = ".toml"


def manifest_path(image_path: str | os.PathLike[str]) -> Path:
    """Where the manifest of an image lies: beside it, with `.toml` behind its whole name."""
    path = Path(image_path)
    return path.with_name(path.name + SUFFIX)


def find_release(
    image_path: str | os.PathLike[str], given: str | os.PathLike[str] | None = None
) -> Release | None:
    """The release of the manifest `given`, else of the one beside the image; None without any.

    Raises as `read_release`.
    """
    if given is not None:
        return read_release(given)
    beside = manifest_path(image_path)
    # A link that leads nowhere is there too: what it should have said is not known.
    return read_release(beside) if os.path.lexists(beside) else None


def read_release(path: str | os.PathLike[str]) -> Release:
    """The release that a manifest states.

    Raises UsageError when there is no such file or it is no regular one, ImageError naming file and
    key when it cannot be read, is no TOML, has another format version, or holds a key or a value
    that is not allowed.
    """
    shown = printable(os.fspath(path))
    document = read_toml(
        path,
        what="manifest",
        error=ImageError,
        if_missing="Correct the name, or write it with `flasher manifest create`.",
    )
    _check_format(document, shown)
    values: dict[str, Any] = {}
    for key, value in document.items():
        if key == FORMAT_KEY:
            continue
        if key not in KEYS:
            raise explain_unknown(key, shown)
        try:
            values[key] = read_value(key, value)
        except ValueError as error:
            raise ImageError(
                f"The manifest is wrong: {error}.",
                where=shown,
                remedy="Correct it, or write it anew with `flasher manifest create --force`.",
            ) from error
    missing = [key for key, known in KEYS.items() if known.required and key not in values]
    if missing:
        raise ImageError(
            f"The manifest has no {' and no '.join(missing)}.",
            where=shown,
            remedy="Write it anew with `flasher manifest create --force`.",
        )
    return Release(**values, source=os.fspath(path))


def _check_format(document: Mapping[str, Any], shown: str) -> None:
    version = document.get(FORMAT_KEY)
    if type(version) is int and version == FORMAT_VERSION:
        return
    newer = type(version) is int and version > FORMAT_VERSION
    said = "does not say its format" if version is None else f"has the format {version!a:.60}"
    raise ImageError(
        f"The manifest {said}; this flasher reads {FORMAT_KEY} = {FORMAT_VERSION}.",
        where=shown,
        cause="it was written by a newer flasher" if newer else "it is no manifest of flasher",
        remedy="Use a newer flasher." if newer else "Write it with `flasher manifest create`.",
    )


def to_toml(release: Release) -> str:
    """The text of a manifest; what is not stated is left out."""
    values: dict[str, Any] = {FORMAT_KEY: FORMAT_VERSION}
    for key in KEYS:
        value = getattr(release, key)
        if value not in (None, (), ""):
            values[key] = value.name if isinstance(value, Target) else value
    return tomli_w.dumps(values)
