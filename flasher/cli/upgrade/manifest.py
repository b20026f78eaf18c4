"""`flasher manifest`: write the release manifest of an image, or check an image against it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import click

from flasher.cli import values
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import Decorator, group, option
from flasher.cli.options import (
    ImageOptions,
    allow_implausible_option,
    image_options,
    target_option,
)
from flasher.cli.output import Output
from flasher.errors import ErrorCode, ExitCode, FlasherError, ImageError, UsageError
from flasher.image.image import Image
from flasher.image.plausible import check_plausible
from flasher.image.release import Comparison, Release, check_target, names_of
from flasher.protocol.spec import Target
from flasher.protocol.text import BOOT_VERSION_FORM, FIRMWARE_VERSION_FORM, printable
from flasher.settings.manifest import (
    STATEMENTS,
    check_statement,
    manifest_path,
    release_of,
    to_toml,
)


@dataclass(frozen=True)
class StatementDocument:
    """Value of a manifest key, compared with the image."""

    check: str
    result: Literal["agrees", "differs", "unchecked"]
    stated: str | None
    found: str | None
    detail: str


@dataclass(frozen=True)
class ManifestCreateDocument:
    """Result of `manifest create`."""

    image: str
    manifest: str
    release: Release
    warnings: list[str]


@dataclass(frozen=True)
class ManifestCheckDocument:
    """Result of `manifest check`."""

    image: str
    manifest: str
    release: Release
    checks: list[StatementDocument]


DOCUMENTS: Final = (ManifestCreateDocument, ManifestCheckDocument)

_EXAMPLES: Final = """\
examples:
  flasher manifest create firmware.hex -t bms
  flasher manifest create firmware.hex -t bms --hardware-version 'V1r2r0_*' \\
      --minimum-boot-version V1.0.0 --previous-from V1r0r0_20220512
  flasher manifest check firmware.hex -t bms
  flasher manifest check firmware.hex --manifest release/firmware.toml --json

The manifest of firmware.hex is firmware.hex.toml. It states the size and the SHA-256 of the bytes
that would be sent, so options that change these (--range, --fill-gaps-up-to) have to be given to
`check` as they were given to `create`.
"""
_CREATE_EXAMPLES: Final = """\
examples:
  flasher manifest create firmware.hex -t bms
  flasher manifest create firmware.bin --base 0x8004000 -t wmc --notes 'field trial only'
  flasher manifest create firmware.hex -t bms --hardware-version 'V1r2r0_*' \\
      --hardware-version V1r3r0_20230101 --previous-except V1r0r2_20220601 --force
"""
_CHECK_EXAMPLES: Final = """\
examples:
  flasher manifest check firmware.hex
  flasher manifest check firmware.hex -t bms
  flasher manifest check firmware.hex --manifest release/firmware.toml --json

Exit code 3 where the image is not the one of the manifest, or there is no right manifest; 6 where
it is for another target.
"""
_FOR_A_DEVICE: Final = ("hardware_versions", "minimum_boot_version", "previous_from")
"""Keys whose values only a device's answers can confirm."""


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE, ExitCode.WRONG_DEVICE))
def manifest() -> None:
    """Create the release manifest of an image, or check an image against it."""


# -- create ---------------------------------------------------------------------------------------


def _key_option(key: str, metavar: str, text: str, *, is_list: bool = False) -> Decorator:
    """Declare the option for a key of the manifest, parsed like the key."""
    name = key.removesuffix("s" if is_list else "").replace("_", "-")

    def read(value: str) -> str:
        try:
            check_statement(key, [value] if is_list else value)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error
        return value

    return option(
        f"--{name}", key, type=read, multiple=is_list, metavar=metavar, panel="manifest",
        help=f"{text}; may be given more than once" if is_list else text,
    )  # fmt: skip


@manifest.action("create", epilog=_CREATE_EXAMPLES)
@image_options
@target_option()
@allow_implausible_option()
@_key_option("firmware_version", FIRMWARE_VERSION_FORM, "(default: the one inside)")
@_key_option("product", "NAME", "the product whose releases share a counter")
@option(
    "--counter", type=values.count, metavar="N", panel="manifest",
    help="number of the release: higher than all before of its product",
)  # fmt: skip
@_key_option("minimum_boot_version", BOOT_VERSION_FORM, "the oldest bootloader that may receive it")
@_key_option(
    "previous_from", FIRMWARE_VERSION_FORM, "the oldest running version that it may replace"
)
@_key_option("notes", "TEXT", "what a person should know")
@_key_option("hardware_versions", "V", "hardware that it fits; * matches any text", is_list=True)
@_key_option("previous_except", "V", "running versions that it must not replace", is_list=True)
@option(
    "-o", "--output", "file", metavar="FILE", type=values.FilePath("toml"), panel="manifest",
    brief=True, help="(default: beside IMAGE, IMAGE.toml)",
)  # fmt: skip
@option("--force", "overwrite", is_flag=True, panel="manifest", help="overwrite an older manifest")
def create(
    output: Output,
    image: ImageOptions,
    target: Target,
    *,
    file: str | None,
    overwrite: bool,
    allow_implausible: bool,
    notes: str | None,
    **statements: Any,
) -> int:
    """Write the release manifest of an image."""
    loaded = image.load()
    if file is None and image.is_piped:
        raise UsageError("An image from standard input needs -o FILE for its manifest.")
    path = Path(file) if file else manifest_path(image.image)
    _check_destination(path, image.image, overwrite=overwrite)
    if not allow_implausible:
        check_plausible(loaded)
    release = release_of(loaded, target, source=str(path), notes=notes or "", **statements)
    warnings, names, node = [], loaded.named_targets, target.node.name
    if names and names != {target}:
        also, others = "also " * (target in names), names_of(names - {target})
        warnings = [
            f"the image {also}names the {others}; the manifest says that it is for the {node}"
        ]
        output.error_line(f"warning: {warnings[0]}")
    write_whole(path, to_toml(release).encode("utf-8"), "-o")
    output.result(f"written: {printable(str(path))}")
    output.table(((f"{key}:", value) for key, value in stated_rows(release).items()), indent=2)
    return output.document(ManifestCreateDocument(image.image, str(path), release, warnings))


def _check_destination(path: Path, image: str, *, overwrite: bool) -> None:
    """Raise UsageError if the manifest must not or cannot be written."""
    check_writable(path, "-o")
    if not path.exists():
        return
    if os.path.lexists(image) and path.samefile(image):
        raise UsageError(
            f"{printable(str(path))} is the image itself, which would be overwritten.",
            remedy="Name another file with -o.",
        )
    if not overwrite:
        raise UsageError(
            f"{printable(str(path))} exists.",
            remedy="Check whether it is still needed; --force overwrites it, -o names another.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        )


# -- check ----------------------------------------------------------------------------------------


@manifest.action("check", epilog=_CHECK_EXAMPLES)
@image_options
@target_option(required=False)
@option(
    "--manifest", "file", metavar="FILE", type=values.FilePath("toml"), brief=True,
    help="(default: beside IMAGE, IMAGE.toml)",
)  # fmt: skip
def check(output: Output, image: ImageOptions, target: Target | None, *, file: str | None) -> int:
    """Check the bytes that would be sent against the release manifest."""
    loaded = image.load()
    release = image.find_release(file)
    if release is None:
        raise ImageError(
            f"There is no manifest for {loaded.source}.",
            where="" if image.is_piped else printable(str(manifest_path(image.image))),
            remedy="Name it with --manifest, or write it with `flasher manifest create`.",
            code=ErrorCode.MANIFEST,
        )
    checks = checks_of(release, loaded, target)
    output.result(f"{printable(release.source)}, compared with {loaded.source}")
    output.table(((f"{each.check}:", each.detail) for each in checks), indent=2)
    document = ManifestCheckDocument(image.image, release.source, release, checks)
    try:
        release.check_bytes(loaded)
        check_target(loaded, release, target or release.target)
    except FlasherError as error:
        return output.failure(error, document)
    return output.document(document)


# -- as text and as JSON ---------------------------------------------------------------------------


def stated_rows(release: Release) -> dict[str, str]:
    """Format the values of a manifest, escaped for a terminal."""
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


def checks_of(release: Release, image: Image, target: Target | None) -> list[StatementDocument]:
    """Compare every key of a manifest with image and target, or explain why it was not compared."""
    checks = [_statement(finding, "the image") for finding in release.findings(image)]
    asked = None if target is None else target.node.name
    stated = release.target.node.name
    agrees = None if asked is None else asked == stated
    checks.append(
        _statement(Comparison("requested_target", stated, asked, agrees), "the command line")
    )
    rows = stated_rows(release)
    for key in (*_FOR_A_DEVICE, "previous_except"):
        if key in rows:
            detail = f"{rows[key]}: not checked, only a device can answer it"
            checks.append(StatementDocument(key, "unchecked", rows[key], None, detail))
        elif key in _FOR_A_DEVICE:
            detail = "not stated: any will do"
            checks.append(StatementDocument(key, "unchecked", None, None, detail))
    return checks


def _statement(finding: Comparison, other: str) -> StatementDocument:
    """Convert a comparison; `other` names the source of the compared value."""
    stated, found = finding.stated, finding.found
    if finding.agrees is None:
        detail = (
            "not stated: nothing to check"
            if stated is None
            else f"{stated}: nothing to check against, {other} does not say it"
        )
        return StatementDocument(finding.key, "unchecked", stated, found, detail)
    if finding.agrees:
        return StatementDocument(finding.key, "agrees", stated, found, f"{stated}: agrees")
    detail = f"{stated}: differs, {other} has {found}"
    return StatementDocument(finding.key, "differs", stated, found, detail)


# -- image-info -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class ManifestBesideDocument:
    """Manifest next to an image; `problem` explains why it does not match."""

    file: str
    """Empty for standard input."""
    found: bool
    agrees: bool | None
    problem: str | None
    release: Release | None


def manifest_beside(
    options: ImageOptions, image: Image, target: Target | None
) -> ManifestBesideDocument:
    """Find the manifest next to an image and compare it with the image and `target`. Errors are
    reported in the result, not raised.
    """
    beside = "" if options.is_piped else str(manifest_path(options.image))
    release = None
    try:
        release = options.find_release()
        if release is not None:
            release.check_bytes(image)
            check_target(image, release, target or release.target)
    except FlasherError as error:
        problem: str | None = error.what
    else:
        problem = None
    found = release is not None or problem is not None
    return ManifestBesideDocument(
        file=beside,
        found=found,
        agrees=problem is None if found else None,
        problem=problem,
        release=release,
    )


def beside_line(beside: ManifestBesideDocument) -> str:
    """Format the manifest's line in `image-info`."""
    file, release = printable(beside.file), beside.release
    if not beside.found:
        return f"  release: no manifest beside it{f' ({file})' if file else ''}"
    if release is None or not beside.agrees:
        return f"  release: {file}: {beside.problem}"
    version = release.firmware_version or "without a version"
    return f"  release: {file}: agrees, {release.target.node.name} {version}"
