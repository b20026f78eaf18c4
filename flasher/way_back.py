"""Index of the images on this computer by firmware version, to undo an upgrade.

Files are searched for the text of a version, not loaded: that takes milliseconds for a file. An
image that is flashed later is checked like any other.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from flasher.errors import FlasherError
from flasher.files import read
from flasher.history import Flash, FlashHistory
from flasher.protocol.spec import Target
from flasher.protocol.text import find_firmware_version, printable
from flasher.release.places import SUFFIX as RELEASE_SUFFIX

FILES_MAX: Final = 100
"""Maximum number of searched files: of a folder the newest, of the history the last used."""
_SIZE_MAX: Final = 8 * 1024 * 1024
"""Maximum size of a searched file in bytes: more than the largest image as Intel HEX needs."""
_RECORD: Final = re.compile(
    rb"^(?::.{6}00|S1.{6}|S2.{8}|S3.{10})([0-9A-Fa-f]*)[0-9A-Fa-f]{2}\s*$", re.MULTILINE
)
"""Matches a data record of Intel HEX or Motorola S-record; its group are the data."""


def images_here(target: Target, files: Iterable[Path]) -> dict[str, str]:
    """Return the files with images for a target on this computer, by firmware version: those of its
    upgrades that are still in their places, then `files`.
    """
    flashes: list[Flash] = []
    with suppress(FlasherError, OSError):
        flashes, _ = FlashHistory().flashes()
    used: dict[Path, set[str]] = {}
    for flash in reversed(flashes):
        began = flash.began
        if began.target == target.name and began.image_version is not None:
            path = Path(began.folder) / began.image
            used.setdefault(path, set()).add(began.image_version)
    found: dict[str, str] = {}
    for path, flashed in islice(used.items(), FILES_MAX):
        for version in flashed.intersection(_versions(path, target)):
            found.setdefault(version, printable(str(path)))
    for path in files:
        for version in _versions(path, target):
            found.setdefault(version, printable(str(path)))
    return found


def images_beside(image: str | os.PathLike[str], suffixes: Iterable[str]) -> list[Path]:
    """Return the possible images in the folder of an image, the newest first."""
    wanted = {f".{suffix}" for suffix in suffixes}
    found = []
    with suppress(OSError):
        for entry in os.scandir(Path(image).parent):
            with suppress(OSError):
                if Path(entry.name).suffix.lower() in wanted and entry.is_file():
                    found.append((entry.stat().st_mtime, Path(entry.path)))
    return [path for _, path in sorted(found, reverse=True)[:FILES_MAX]]


def _versions(path: Path, target: Target) -> Iterator[str]:
    """Yield the versions of a file's images for a target; an unreadable file has none."""
    with suppress(FlasherError, OSError):
        if path.suffix.lower() == RELEASE_SUFFIX:
            from flasher.release.verify import open_package  # noqa: PLC0415  for releases alone

            stated = open_package(path).statement.images.get(target)
            if stated is not None and stated[1].firmware_version:
                yield stated[1].firmware_version
            return
        version = find_firmware_version(_contents(read(path, _SIZE_MAX)))
        if version is not None:
            yield version


def _contents(raw: bytes) -> bytes:
    """Return the bytes of hexadecimal records; any other file as it is."""
    if not raw.startswith((b":", b"S")):
        return raw
    data = [digits for digits in _RECORD.findall(raw) if len(digits) % 2 == 0]
    return bytes.fromhex(b"".join(data).decode("ascii"))
