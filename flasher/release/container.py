"""Container of a release (`*.wfw`): a zip of which only one form is valid.

Its members are stored uncompressed, sorted by name, without times, modes, comments or extra
fields. The reader packs what it read once more and compares all bytes: what hides in the many forms
of a zip (a second file of one name, data between files, a size that is not true) cannot be there.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
from collections.abc import Mapping
from typing import Final

from flasher.errors import ErrorCode, ImageError
from flasher.files import opened
from flasher.i18n import text
from flasher.protocol.text import printable

MAX_SIZE: Final = 64 * 1024 * 1024
"""Maximum size of a container in bytes: three images as text, and their documents."""
MEMBERS_MAX: Final = 16
STATEMENT: Final = "release.json"
"""Envelope of the statement."""
TRUST: Final = "trust.json"
LOG: Final = "log.json"
NOTES: Final = "notes.md"
SBOM: Final = "sbom.json"
IMAGES: Final = "images/"
"""Folder of the images."""
_IMAGE_NAME: Final = re.compile(r"images/[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")
_TIME: Final = (1980, 1, 1, 0, 0, 0)
_REGULAR_FILE: Final = 0o100644 << 16
_UNIX: Final = 3
_REMEDY: Final = text(
    "Copy it again from where it was released, as one file, and do not repack it."
)


def read(path: str | os.PathLike[str]) -> dict[str, bytes]:
    """Read the members of a container. Raises UsageError and ImageError."""
    with opened(path, MAX_SIZE, what="release", error=ImageError) as (file, size):
        raw = file.read(size)
    return unpack(raw, os.fspath(path))


def pack(members: Mapping[str, bytes]) -> bytes:
    """Create a container: the same members give the same bytes on every computer."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(members):
            entry = zipfile.ZipInfo(name, _TIME)
            entry.create_system = _UNIX
            entry.external_attr = _REGULAR_FILE
            archive.writestr(entry, members[name])
    return packed.getvalue()


def unpack(raw: bytes, source: str) -> dict[str, bytes]:
    """Return the members of a container; `source` names it in messages. Raises ImageError."""
    shown = printable(source)
    if len(raw) > MAX_SIZE:
        raise damaged(shown, text("it is larger than {limit} bytes", limit=MAX_SIZE))
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            members = _members(archive, shown)
    except (
        zipfile.BadZipFile, ValueError, LookupError, OSError, EOFError, RuntimeError,
        OverflowError, struct.error,
    ) as error:  # fmt: skip
        raise damaged(shown, text("it is not a whole zip file")) from error
    if pack(members) != raw:
        raise damaged(shown, text("it was packed by another program, or was changed"))
    return members


def _members(archive: zipfile.ZipFile, shown: str) -> dict[str, bytes]:
    entries = archive.infolist()
    if len(entries) > MEMBERS_MAX:
        raise damaged(shown, text("it has more than {limit} files", limit=MEMBERS_MAX))
    members: dict[str, bytes] = {}
    for entry in entries:
        name = printable(entry.orig_filename)
        if entry.orig_filename in members:
            raise damaged(shown, text("it has two files of the name {name}", name=name))
        if not is_member_name(entry.orig_filename):
            raise damaged(shown, text("a release has no file of the name {name}", name=name))
        # Before it is read: a compressed file may be a thousand times as large as its bytes here.
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
            raise damaged(shown, text("{name} in it is compressed", name=name))
        members[entry.orig_filename] = archive.read(entry)
    return members


def is_member_name(name: str) -> bool:
    """True if a container may have a file of this name."""
    return name in (STATEMENT, TRUST, LOG, NOTES, SBOM) or _IMAGE_NAME.fullmatch(name) is not None


def damaged(shown: str, why: str, *, where: str = "") -> ImageError:
    """Create the error for a release that cannot be read."""
    return ImageError(
        text("{file} is not a readable release: {why}.", file=shown, why=why),
        where=where or shown,
        cause=text("a damaged copy, or a file that was changed"),
        remedy=_REMEDY,
        code=ErrorCode.RELEASE_DAMAGED,
    )
