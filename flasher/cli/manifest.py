"""`flasher manifest`: write the release manifest of an image, or hold an image against its own."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from flasher.cli import arguments
from flasher.cli.files import check_writable, write_whole
from flasher.cli.manifest_text import (
    ManifestCheckDocument,
    ManifestCreateDocument,
    ManifestRefusedDocument,
    checks_of,
    release_document,
    stated_rows,
)
from flasher.cli.output import Output
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

_EPILOG = """\
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
_CREATE_EPILOG = """\
examples:
  flasher manifest create firmware.hex -t bms
  flasher manifest create firmware.bin --base 0x8004000 -t wmc --notes 'field trial only'
  flasher manifest create firmware.hex -t bms --hardware-version 'V1r2r0_*' \\
      --hardware-version V1r3r0_20230101 --previous-except V1r0r2_20220601 --force
"""
_CHECK_EPILOG = """\
examples:
  flasher manifest check firmware.hex
  flasher manifest check firmware.hex -t bms
  flasher manifest check firmware.hex --manifest release/firmware.toml --json

exit codes:
  0 everything that could be checked agrees   3 the image is not the one of the manifest, or there
  is no right manifest   6 the image is for another target
"""
_LABEL_WIDTH: Final = max(map(len, STATEMENTS)) + 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = "Create the release manifest of an image, or check an image against it."
    parser.epilog = _EPILOG
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    raw = argparse.RawDescriptionHelpFormatter
    create = actions.add_parser(
        "create",
        help="write the manifest of an image",
        description="Write the release manifest of an image.",
        epilog=_CREATE_EPILOG,
        formatter_class=raw,
    )
    check = actions.add_parser(
        "check",
        help="is an image the one of its manifest",
        description="Hold the bytes that would be sent against the release manifest.",
        epilog=_CHECK_EPILOG,
        formatter_class=raw,
    )
    for action in (create, check):
        arguments.add_image(action)
        arguments.add_target(action, required=action is create)
    arguments.add_implausible(create)
    _add_statements(create)
    check.add_argument("--manifest", metavar="FILE", help="(default: beside IMAGE, IMAGE.toml)")


def _add_statements(create: argparse.ArgumentParser) -> None:
    group = create.add_argument_group("manifest")
    for option, key, metavar, text in (
        (
            "--firmware-version",
            "firmware_version",
            FIRMWARE_VERSION_FORM,
            "(default: the one inside)",
        ),
        (
            "--minimum-boot-version",
            "minimum_boot_version",
            BOOT_VERSION_FORM,
            "the oldest bootloader that may receive it",
        ),
        (
            "--previous-from",
            "previous_from",
            FIRMWARE_VERSION_FORM,
            "the oldest running version that it may replace",
        ),
        ("--notes", "notes", "TEXT", "what a person should know"),
    ):
        group.add_argument(option, type=_one(key), metavar=metavar, help=text)
    for option, key, text in (
        (
            "--hardware-version",
            "hardware_versions",
            "hardware that it fits; * stands for any text",
        ),
        ("--previous-except", "previous_except", "running versions that it must not replace"),
    ):
        group.add_argument(
            option,
            dest=key,
            action="append",
            default=[],
            type=_one_of(key),
            metavar="V",
            help=f"{text}; may be given more than once",
        )
    group.add_argument("-o", "--output", metavar="FILE", help="(default: beside IMAGE, IMAGE.toml)")
    # Not "force": that waives checks of the image.
    group.add_argument(
        "--force", dest="overwrite", action="store_true", help="write over an older manifest"
    )


def _one(key: str) -> Callable[[str], str]:
    """Reads the value of an option as the manifest's key takes it."""

    def read(text: str) -> str:
        try:
            check_statement(key, text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return text

    return read


def _one_of(key: str) -> Callable[[str], str]:
    """Reads one value of several as the manifest's key takes it."""

    def read(text: str) -> str:
        try:
            check_statement(key, [text])
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error
        return text

    return read


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    image = arguments.load_image(options)
    return (
        _create(options, image, output)
        if options.action == "create"
        else _check(options, image, output)
    )


# -- create ---------------------------------------------------------------------------------------


def _create(options: argparse.Namespace, image: Image, output: Output) -> int:
    path = Path(options.output) if options.output else manifest_path(options.image)
    _check_destination(path, options)
    if not options.allow_implausible:
        check_plausible(image)
    release = release_of(
        image,
        options.target,
        source=str(path),
        firmware_version=options.firmware_version,
        hardware_versions=options.hardware_versions,
        minimum_boot_version=options.minimum_boot_version,
        previous_from=options.previous_from,
        previous_except=options.previous_except,
        notes=options.notes or "",
    )
    warnings = _warnings(image, options.target)
    for warning in warnings:
        output.error_line(f"warning: {warning}")
    write_whole(path, to_toml(release).encode("utf-8"), "-o")
    output.result(f"written: {printable(str(path))}")
    for key, value in stated_rows(release).items():
        output.result(f"  {key + ':':<{_LABEL_WIDTH}}  {value}")
    document: ManifestCreateDocument = {
        "image": options.image,
        "manifest": str(path),
        "release": release_document(release),
        "warnings": warnings,
    }
    output.document(document)
    return ExitCode.OK


def _check_destination(path: Path, options: argparse.Namespace) -> None:
    """Raises UsageError where the manifest must not or cannot be written."""
    check_writable(path, "-o")
    if not path.exists():
        return
    if path.samefile(options.image):
        raise UsageError(
            f"{printable(str(path))} is the image itself.", remedy="Name another file with -o."
        )
    if not options.overwrite:
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


def _check(options: argparse.Namespace, image: Image, output: Output) -> int:
    release = find_release(options.image, options.manifest)
    if release is None:
        raise ImageError(
            f"There is no manifest for {printable(options.image)}.",
            where=printable(str(manifest_path(options.image))),
            remedy="Name it with --manifest, or write it with `flasher manifest create`.",
        )
    checks = checks_of(release, image, options.target)
    output.result(f"{printable(release.source)}, held against {printable(options.image)}")
    for check in checks:
        output.result(f"  {check['check'] + ':':<{_LABEL_WIDTH}}  {check['detail']}")
    more: dict[str, Any] = {
        "image": options.image,
        "manifest": release.source,
        "release": release_document(release),
        "checks": checks,
    }
    try:
        release.check_bytes(image)
        check_target(image, release, options.target or release.target)
    except FlasherError as error:
        output.failure(error, **more)
        return error.exit_code
    output.document(more)
    return ExitCode.OK
