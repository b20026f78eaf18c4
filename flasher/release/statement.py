"""Statement of a release: the content that is signed (in-toto Statement v1).

Subjects are the files of the release, and the bytes to be sent of each image (`bms:sent`). The
predicate has the manifest of each image, with its product and counter.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from flasher.errors import FlasherError, ImageError, printable
from flasher.files import parse_json
from flasher.image.image import Image
from flasher.image.release import Release
from flasher.protocol.spec import Target
from flasher.release.container import IMAGES, damaged
from flasher.release.envelope import json_bytes
from flasher.release.trust import DateText
from flasher.settings.manifest import reader as manifest_reader
from flasher.settings.manifest import stated_keys
from flasher.validation import Parsed, json_keys

if TYPE_CHECKING:
    from flasher.settings.toml_reader import Reader

PAYLOAD_TYPE: Final = "application/vnd.in-toto+json"
PREDICATE_TYPE: Final = "urn:welling-flasher:release:v1"
STATEMENT_TYPE: Final = "https://in-toto.io/Statement/v1"
STATEMENT_MAX_SIZE: Final = 256 * 1024
_SENT: Final = ":sent"
"""Suffix of the subject that is the bytes to be sent to a target."""


def _hash(value: object) -> str:
    if not isinstance(value, str) or len(value) != 64 or set(value) - set("0123456789abcdef"):
        raise ValueError
    return value


@dataclass(frozen=True, kw_only=True)
class Digest:
    """Hash of a subject."""

    sha256: Annotated[str, Parsed("64 lower-case hex digits", _hash)]


@dataclass(frozen=True, kw_only=True)
class Subject:
    """File of a release, or the bytes to be sent of one."""

    name: str
    digest: Digest


@dataclass(frozen=True, kw_only=True)
class StatedImage:
    """Image of a release: its file, and its manifest."""

    file: str
    manifest: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Predicate:
    """What is stated about the images of a release."""

    released: DateText
    """Day on which the release was built."""
    images: tuple[StatedImage, ...]


@json_keys("_type=type subject predicateType=predicate_type predicate")
@dataclass(frozen=True, kw_only=True)
class _Statement:
    type: Literal["https://in-toto.io/Statement/v1"]
    subject: tuple[Subject, ...]
    predicate_type: Literal["urn:welling-flasher:release:v1"]
    predicate: Predicate


@dataclass(frozen=True)
class Statement:
    """Statement of a release."""

    released: str
    files: Mapping[str, str]
    """SHA-256 of each file, by its name in the container."""
    images: Mapping[Target, tuple[str, Release]]
    """File name and manifest of each image."""

    def release_for(self, target: Target) -> Release:
        return self.images[target][1]


@cache
def _reader() -> Reader[_Statement]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(_Statement, "statement of a release", error=ImageError)


@dataclass(frozen=True)
class Part:
    """Image of a release that is built: its file, and its manifest."""

    name: str
    content: bytes
    image: Image
    release: Release

    @property
    def file(self) -> str:
        """Name of the file in the container."""
        return IMAGES + self.name


def statement_bytes(
    files: Mapping[str, bytes], parts: Mapping[Target, Part], *, released: str
) -> bytes:
    """Write the statement of files and images, in the one form that is signed."""
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    hashes |= {f"{target.name}{_SENT}": part.image.sha256 for target, part in parts.items()}
    return json_bytes(
        {
            "_type": STATEMENT_TYPE,
            "subject": [
                {"name": name, "digest": {"sha256": hashes[name]}} for name in sorted(hashes)
            ],
            "predicateType": PREDICATE_TYPE,
            "predicate": {
                "released": released,
                "images": [
                    {"file": part.file, "manifest": stated_keys(part.release)}
                    for _, part in sorted(parts.items(), key=lambda item: item[0].name)
                ],
            },
        }
    )


def parse_statement(payload: bytes, source: str) -> Statement:
    """Parse a statement. Raises ImageError."""
    shown = printable(source)
    if len(payload) > STATEMENT_MAX_SIZE:
        raise damaged(shown, f"its statement is larger than {STATEMENT_MAX_SIZE} bytes")
    try:
        return _parsed(payload, source)
    except ValueError as error:
        raise damaged(shown, f"its statement is not right: {printable(str(error))}") from error
    except FlasherError as error:
        raise damaged(shown, "its statement is not right", where=str(error.what)) from error


def _parsed(payload: bytes, source: str) -> Statement:
    """Parse a statement. Raises ValueError and FlasherError."""
    document = parse_json(payload)
    if not isinstance(document, dict):
        raise ValueError("it is no JSON object")  # noqa: TRY004  of a file
    stated = _reader().read(document, source)
    hashes = {each.name: each.digest.sha256 for each in stated.subject}
    if len(hashes) != len(stated.subject):
        raise ValueError("it has two subjects of one name")
    images: dict[Target, tuple[str, Release]] = {}
    for each in stated.predicate.images:
        release = manifest_reader().read(each.manifest, source, source=source)
        _check_image(each.file, release, hashes, images)
        images[release.target] = each.file, release
    if not images:
        raise ValueError("it states no image")
    files = {name: found for name, found in hashes.items() if not name.endswith(_SENT)}
    if len(hashes) != len(files) + len(images):
        raise ValueError("it has a subject without an image")
    return Statement(stated.predicate.released, files, images)


def _check_image(
    file: str, release: Release, hashes: Mapping[str, str], others: Mapping[Target, object]
) -> None:
    """Raise ValueError if a stated image contradicts the subjects, or lacks a part."""
    name = release.target.name
    if release.target in others:
        raise ValueError(f"it has two images for the {name}")
    if release.product is None or release.counter is None:
        raise ValueError(f"the image for the {name} has no product or no counter")
    if not file.startswith(IMAGES) or file not in hashes:
        raise ValueError(f"the file of the image for the {name} is no subject")
    if hashes.get(f"{name}{_SENT}") != release.sha256:
        raise ValueError(f"manifest and subject of the {name} name other bytes to be sent")
