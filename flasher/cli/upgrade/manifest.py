"""`flasher manifest`: write the release manifest of an image, or hold an image against its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

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
from flasher.cli.upgrade.manifest_text import (
    ManifestCheckDocument,
    ManifestCreateDocument,
    ManifestRefusedDocument,
    checks_of,
    release_document,
    stated_rows,
)
from flasher.errors import ExitCode, FlasherError, ImageError, UsageError
from flasher.image.image import Image
from flasher.image.plausible import check_plausible
from flasher.image.release import check_target, names_of
from flasher.protocol.spec import Target
from flasher.protocol.text import BOOT_VERSION_FORM, FIRMWARE_VERSION_FORM, printable
from flasher.settings.manifest import (
    STATEMENTS,
    check_statement,
    find_release,
    manifest_path,
    release_of,
    to_toml,
)

DOCUMENTS: Final = (ManifestCreateDocument, ManifestCheckDocument, ManifestRefusedDocument)

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
_LABEL_WIDTH: Final = max(map(len, STATEMENTS)) + 1


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE, ExitCode.WRONG_DEVICE))
def manifest() -> None:
    """Create the release manifest of an image, or check an image against it."""


# -- create ---------------------------------------------------------------------------------------


def _stated(name: str, key: str, metavar: str, text: str, *, is_list: bool = False) -> Decorator:
    """An option for a statement of the manifest, read as the manifest's key takes it."""

    def read(value: str) -> str:
        try:
            check_statement(key, [value] if is_list else value)
        except ValueError as error:
            raise click.BadParameter(str(error)) from error
        return value

    return option(
        name, key, type=read, multiple=is_list, metavar=metavar, panel="manifest",
        help=f"{text}; may be given more than once" if is_list else text,
    )  # fmt: skip


@manifest.action("create", epilog=_CREATE_EXAMPLES)
@image_options
@target_option()
@allow_implausible_option()
@_stated(
    "--firmware-version", "firmware_version", FIRMWARE_VERSION_FORM, "(default: the one inside)"
)
@_stated(
    "--minimum-boot-version",
    "minimum_boot_version",
    BOOT_VERSION_FORM,
    "the oldest bootloader that may receive it",
)
@_stated(
    "--previous-from",
    "previous_from",
    FIRMWARE_VERSION_FORM,
    "the oldest running version that it may replace",
)
@_stated("--notes", "notes", "TEXT", "what a person should know")
@_stated(
    "--hardware-version",
    "hardware_versions",
    "V",
    "hardware that it fits; * stands for any text",
    is_list=True,
)
@_stated(
    "--previous-except",
    "previous_except",
    "V",
    "running versions that it must not replace",
    is_list=True,
)
@option(
    "-o", "--output", "file", metavar="FILE", type=values.FilePath("toml"), panel="manifest",
    brief=True, help="(default: beside IMAGE, IMAGE.toml)",
)  # fmt: skip
@option("--force", "overwrite", is_flag=True, panel="manifest", help="write over an older manifest")
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
    path = Path(file) if file else manifest_path(image.image)
    _check_destination(path, image.image, overwrite=overwrite)
    if not allow_implausible:
        check_plausible(loaded)
    release = release_of(loaded, target, source=str(path), notes=notes or "", **statements)
    warnings = _warnings(loaded, target)
    for warning in warnings:
        output.error_line(f"warning: {warning}")
    write_whole(path, to_toml(release).encode("utf-8"), "-o")
    output.result(f"written: {printable(str(path))}")
    for key, value in stated_rows(release).items():
        output.result(f"  {key + ':':<{_LABEL_WIDTH}}  {value}")
    document: ManifestCreateDocument = {
        "image": image.image,
        "manifest": str(path),
        "release": release_document(release),
        "warnings": warnings,
    }
    output.document(document)
    return ExitCode.OK


def _check_destination(path: Path, image: str, *, overwrite: bool) -> None:
    """Raises UsageError where the manifest must not or cannot be written."""
    check_writable(path, "-o")
    if not path.exists():
        return
    if path.samefile(image):
        raise UsageError(
            f"{printable(str(path))} is the image itself.", remedy="Name another file with -o."
        )
    if not overwrite:
        raise UsageError(
            f"{printable(str(path))} exists.",
            remedy="Look whether it is still wanted; --force writes over it, -o names another.",
        )


def _warnings(image: Image, target: Target) -> list[str]:
    names = image.named_targets
    if not names or names == {target}:
        return []
    also = "also names" if target in names else "names"
    others = names_of(names - {target})
    return [
        f"the image {also} the {others}; the manifest says that it is for the {target.node.name}"
    ]


# -- check ----------------------------------------------------------------------------------------


@manifest.action("check", epilog=_CHECK_EXAMPLES)
@image_options
@target_option(required=False)
@option(
    "--manifest", "file", metavar="FILE", type=values.FilePath("toml"), brief=True,
    help="(default: beside IMAGE, IMAGE.toml)",
)  # fmt: skip
def check(output: Output, image: ImageOptions, target: Target | None, *, file: str | None) -> int:
    """Hold the bytes that would be sent against the release manifest."""
    loaded = image.load()
    release = find_release(image.image, file)
    if release is None:
        raise ImageError(
            f"There is no manifest for {printable(image.image)}.",
            where=printable(str(manifest_path(image.image))),
            remedy="Name it with --manifest, or write it with `flasher manifest create`.",
        )
    checks = checks_of(release, loaded, target)
    output.result(f"{printable(release.source)}, held against {printable(image.image)}")
    for each in checks:
        output.result(f"  {each['check'] + ':':<{_LABEL_WIDTH}}  {each['detail']}")
    more: dict[str, Any] = {
        "image": image.image,
        "manifest": release.source,
        "release": release_document(release),
        "checks": checks,
    }
    try:
        release.check_bytes(loaded)
        check_target(loaded, release, target or release.target)
    except FlasherError as error:
        output.failure(error, **more)
        return error.exit_code
    output.document(more)
    return ExitCode.OK
