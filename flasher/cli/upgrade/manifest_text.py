"""A release and its manifest in words and as JSON, for `manifest` and `image-info`."""

from __future__ import annotations

import os
from typing import Any, Final, Literal, TypedDict

from flasher.cli.documents import ErrorDocument
from flasher.errors import FlasherError
from flasher.image.image import Image
from flasher.image.release import Finding, Release, check_target
from flasher.protocol.spec import TARGETS, Target
from flasher.protocol.text import printable
from flasher.settings.manifest import STATEMENTS, find_release, manifest_path

_FOR_A_DEVICE: Final = ("hardware_versions", "minimum_boot_version", "previous_from")
"""Statements that only a device's answers can be held against."""


class ReleaseDocument(TypedDict):
    """What a manifest states; null and empty where it states nothing."""

    target: str
    firmware_version: str | None
    size_bytes: int
    sha256: str
    hardware_versions: list[str]
    minimum_boot_version: str | None
    previous_from: str | None
    previous_except: list[str]
    notes: str


class StatementDocument(TypedDict):
    """One statement of a manifest, held against the image."""

    check: str
    result: Literal["agrees", "differs", "unchecked"]
    stated: str | None
    found: str | None
    detail: str


class ManifestCreateDocument(TypedDict):
    """Of `manifest create`."""

    image: str
    manifest: str
    release: ReleaseDocument
    warnings: list[str]


class ManifestCheckDocument(TypedDict):
    """Of `manifest check`."""

    image: str
    manifest: str
    release: ReleaseDocument
    checks: list[StatementDocument]


class ManifestRefusedDocument(TypedDict):
    """Of `manifest check` when an image does not fit its manifest."""

    error: ErrorDocument
    image: str
    manifest: str
    release: ReleaseDocument
    checks: list[StatementDocument]


def stated_rows(release: Release) -> dict[str, str]:
    """What a manifest states, in words and safe to show."""
    rows = {}
    for key in STATEMENTS:
        value: Any = getattr(release, key)
        if isinstance(value, Target):
            rows[key] = value.node.name
        elif isinstance(value, tuple):
            rows[key] = printable(", ".join(value))
        elif value not in (None, ""):
            rows[key] = printable(str(value))
    return {key: value for key, value in rows.items() if value}


def release_document(release: Release) -> ReleaseDocument:
    """A release as JSON."""
    return {
        "target": release.target.name,
        "firmware_version": release.firmware_version,
        "size_bytes": release.size_bytes,
        "sha256": release.sha256,
        "hardware_versions": list(release.hardware_versions),
        "minimum_boot_version": release.minimum_boot_version,
        "previous_from": release.previous_from,
        "previous_except": list(release.previous_except),
        "notes": release.notes,
    }


def checks_of(release: Release, image: Image, target: Target | None) -> list[StatementDocument]:
    """Everything that a manifest states, held against image and target, or why it was not."""
    checks = [_held(finding, "the image") for finding in release.findings(image)]
    asked = None if target is None else target.node.name
    stated = release.target.node.name
    agrees = None if asked is None else asked == stated
    checks.append(_held(Finding("requested_target", stated, asked, agrees), "the command line"))
    rows = stated_rows(release)
    for key in (*_FOR_A_DEVICE, "previous_except"):
        if key in rows:
            detail = f"{rows[key]}: not checked, only a device can answer it"
            checks.append(_unchecked(key, rows[key], detail))
        elif key in _FOR_A_DEVICE:
            checks.append(_unchecked(key, None, "not stated: any will do"))
    return checks


def _held(finding: Finding, other: str) -> StatementDocument:
    """A finding; `other` is what the manifest is held against."""
    stated, found = finding.stated, finding.found
    if finding.agrees is None:
        detail = (
            "not stated: nothing to check"
            if stated is None
            else f"{stated}: nothing to check against, {other} does not say it"
        )
        return _unchecked(finding.key, stated, detail, found)
    return {
        "check": finding.key,
        "result": "agrees" if finding.agrees else "differs",
        "stated": stated,
        "found": found,
        "detail": f"{stated}: agrees"
        if finding.agrees
        else f"{stated}: differs, {other} has {found}",
    }


def _unchecked(
    key: str, stated: str | None, detail: str, found: str | None = None
) -> StatementDocument:
    return {"check": key, "result": "unchecked", "stated": stated, "found": found, "detail": detail}


# -- image-info -----------------------------------------------------------------------------------


class ManifestBesideDocument(TypedDict):
    """The manifest that lies beside an image; `problem` says why it does not hold."""

    file: str
    found: bool
    agrees: bool | None
    problem: str | None
    release: ReleaseDocument | None


def manifest_beside(
    path: str | os.PathLike[str], image: Image, target: Target | None
) -> ManifestBesideDocument:
    """Whether a manifest lies beside an image, and whether it agrees with it and with `target`.
    What is wrong is told, not raised.
    """
    beside = str(manifest_path(path))
    release = None
    try:
        release = find_release(path)
        if release is not None:
            release.check_bytes(image)
            check_target(image, release, target or release.target)
    except FlasherError as error:
        problem: str | None = error.what
    else:
        problem = None
    found = release is not None or problem is not None
    return {
        "file": beside,
        "found": found,
        "agrees": problem is None if found else None,
        "problem": problem,
        "release": None if release is None else release_document(release),
    }


def beside_line(beside: ManifestBesideDocument) -> str:
    """The line of `image-info` for it."""
    file = printable(beside["file"])
    release = beside["release"]
    if not beside["found"]:
        return f"  release: no manifest beside it ({file})"
    if release is None or not beside["agrees"]:
        return f"  release: {file}: {beside['problem']}"
    version = release["firmware_version"] or "without a version"
    return f"  release: {file}: agrees, {TARGETS[release['target']].node.name} {version}"
