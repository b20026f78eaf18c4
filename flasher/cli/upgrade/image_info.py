"""`flasher image-info`: show an image, the bytes to be sent, and the time on the bus."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final

from flasher import api
from flasher.cli.documents import ErrorDocument, ImageDocument, PlanDocument
from flasher.cli.framework import command, option_set
from flasher.cli.options import (
    STANDARD_INPUT,
    ImageOptions,
    SentSelection,
    allow_implausible_option,
    dialect_option,
    gap_options,
    image_argument,
    profile_option,
    target_option,
)
from flasher.cli.output import Output, counted
from flasher.cli.upgrade import text
from flasher.cli.upgrade.manifest import ManifestBesideDocument, beside_line, manifest_beside
from flasher.errors import ExitCode, FlasherError, ImageError, UsageError
from flasher.host.identity import IdentityCheck, judge_bytes, judge_image
from flasher.host.outcome import image_refused
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import BMS, Target
from flasher.protocol.text import printable
from flasher.release.places import SUFFIX, is_container
from flasher.settings.profile import load_profile

_EXAMPLES: Final = """\
examples:
  flasher image-info firmware.hex
  flasher image-info firmware.bin --base 0x8004000 -t wmc
  flasher image-info merged.hex --range 0x8004000:0x8020000
  flasher image-info release/*.hex --json

Several images are shown one after the other; the exit code is that of the worst.
"""


@dataclass(frozen=True)
class ImageInfoDocument:
    """Contents of an image file, its manifest, and the plan of an upgrade."""

    image: ImageDocument
    file_sha256: str
    """SHA-256 of the file itself, in hexadecimal."""
    manifest: ManifestBesideDocument
    plan: PlanDocument
    """Plan for the target; without one for the target that the image names, else for the BMS.
    Targets differ only by their ids."""


@dataclass(frozen=True)
class ShownImageDocument:
    """One of several image files."""

    file: str
    exit_code: ExitCode
    shown: ImageInfoDocument | None
    """Null if the file cannot be read."""
    error: ErrorDocument | None


@dataclass(frozen=True)
class ImagesInfoDocument:
    """Several image files. The exit code is the highest of them."""

    images: list[ShownImageDocument]


DOCUMENTS: Final = (ImageInfoDocument, ImagesInfoDocument)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE, ExitCode.WRONG_DEVICE))
@image_argument("images", nargs=-1, required=True, metavar="IMAGE...")
@option_set("selection", SentSelection)
@allow_implausible_option("image")
@target_option(required=False)
@dialect_option
@profile_option
@gap_options
def image_info(
    output: Output,
    images: tuple[str, ...],
    selection: SentSelection,
    target: Target | None,
    **chosen: Any,
) -> int:
    """Show the contents of image files and the plan of an upgrade with each. Opens no adapter. A
    file that no device should get is shown as far as it can be read, and refused as by flasher
    flash.
    """
    check_one_standard_input(images)
    shown: list[ShownImageDocument] = []
    for file in images:
        if shown:
            output.result("")
        known = None
        error: FlasherError | None = None
        try:
            known, error = _show(
                output, ImageOptions(**vars(selection), image=file), target, **chosen
            )
        except FlasherError as refused:
            error = refused
        if len(images) == 1:
            return output.document(known) if error is None else output.failure(error, known)
        if known is None:
            output.result(f"{printable(file)}: refused, it cannot be read")
        failed = None if error is None else output.error(error)
        code = ExitCode.OK if error is None else error.exit_code
        shown.append(ShownImageDocument(file, code, known, failed))
    refused_count = sum(each.error is not None for each in shown)
    output.result("")
    output.result(
        f"{counted(len(shown), 'image')}: {len(shown) - refused_count} can be sent, "
        f"{refused_count} refused"
    )
    worst = max(shown, key=lambda each: each.exit_code)
    return output.document(ImagesInfoDocument(shown), exit_code=worst.exit_code, error=worst.error)


def check_one_standard_input(images: Sequence[str]) -> None:
    """Raise UsageError if standard input, which can be read once, is named twice."""
    if images.count(STANDARD_INPUT) > 1:
        raise UsageError(
            "- is named twice, and standard input can be read once.",
            remedy="Name it once, and the other images by their files.",
        )


def _show(
    output: Output,
    image: ImageOptions,
    target: Target | None,
    *,
    dialect_name: str,
    profile: str | None,
    frame_gap_s: float | None,
    packet_gap_s: float | None,
    allow_implausible: bool,
) -> tuple[ImageInfoDocument, FlasherError | None]:
    """Print an image. Return its document, and the reason why it would not be sent."""
    if not image.is_piped:
        check_no_release(image.image)
    loaded = image.load()
    table = vector_table(loaded)
    file_sha256 = image.file_sha256()
    named = None if len(loaded.named_targets) != 1 else next(iter(loaded.named_targets))
    # Between targets the time differs only by stuff bits: any of them gives the figure.
    shown = target or named or BMS
    settings = load_profile(profile, shown, api.as_dialect(dialect_name))
    plan = api.make_plan(
        loaded, settings.target, settings.dialect, has_upgrade=settings.has_upgrade
    )
    chosen = settings.upgrade_options(frame_gap_s=frame_gap_s, packet_gap_s=packet_gap_s)
    beside = manifest_beside(image, loaded, target)
    lines = [*text.image_lines(loaded, file_sha256), *text.vector_lines(table), beside_line(beside)]
    output.results((*lines, *text.plan_lines(plan, chosen)))
    if target is None:
        why = "the image names it" if named else "-t chooses one; others take as long"
        output.result(f"           (for the {shown.node.name}: {why})")
    document = ImageInfoDocument(
        image=text.image_document(loaded, table),
        file_sha256=file_sha256,
        manifest=beside,
        plan=text.plan_document(plan, chosen),
    )
    release = None
    with contextlib.suppress(FlasherError):  # reported in `beside`
        release = image.find_release()
    waived = frozenset({IdentityCheck.PLAUSIBLE} if allow_implausible else ())
    identity = settings.identity(release=release, waived=waived)
    judged = (
        judge_bytes(loaded, identity) if target is None else judge_image(loaded, target, identity)
    )
    for found in judged:
        if found.ending is not None:
            has_option = found.check is IdentityCheck.PLAUSIBLE  # of all that waive a check
            detail = found.detail if has_option else found.text
            return document, image_refused(found.ending, plan.target, detail)
        output.result(text.check_line(found.event))
    return document, None


def check_no_release(path: str) -> None:
    """Raise UsageError for a release, which has one image or several; ImageError for a damaged
    one.
    """
    if not is_container(path):
        return
    from flasher.release.verify import open_package  # noqa: PLC0415  only for a zip

    try:
        open_package(path)
    except ImageError:
        if PurePath(path).suffix.lower() == SUFFIX:
            raise
        return  # another zip, reported as such
    raise UsageError(
        f"{printable(path)} is a release, with an image for each of its targets.",
        remedy=f"Show it with flasher release show {printable(shlex.quote(path))}.",
    )
