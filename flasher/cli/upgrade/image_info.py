"""`flasher image-info`: show an image, the bytes to be sent, and the time on the bus."""

from __future__ import annotations

import contextlib
import shlex
from dataclasses import dataclass
from pathlib import PurePath
from typing import Final

from flasher import api
from flasher.cli.documents import ImageDocument, PlanDocument
from flasher.cli.framework import command
from flasher.cli.options import (
    ImageOptions,
    allow_implausible_option,
    dialect_option,
    gap_options,
    image_options,
    profile_option,
    target_option,
)
from flasher.cli.output import Output
from flasher.cli.upgrade import text
from flasher.cli.upgrade.manifest import ManifestBesideDocument, beside_line, manifest_beside
from flasher.errors import ExitCode, FlasherError, ImageError, UsageError
from flasher.host.identity import IdentityCheck, judge_bytes
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


DOCUMENTS: Final = (ImageInfoDocument,)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE,))
@image_options
@allow_implausible_option("image")
@target_option(required=False)
@dialect_option
@profile_option
@gap_options
def image_info(
    output: Output,
    image: ImageOptions,
    target: Target | None,
    *,
    dialect_name: str,
    profile: str | None,
    frame_gap_s: float | None,
    packet_gap_s: float | None,
    allow_implausible: bool,
) -> int:
    """Show the contents of an image file and the plan of its upgrade. Opens no adapter. A file that
    no device should get is shown as far as it can be read, and refused as by flasher flash.
    """
    if not image.is_piped:
        _check_no_release(image.image)
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
    for found in judge_bytes(loaded, identity):
        error = api.refusal(plan, found)
        if error is not None:
            return output.failure(error, document)
        output.result(text.check_line(found.event))
    return output.document(document)


def _check_no_release(path: str) -> None:
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
