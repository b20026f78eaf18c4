"""`flasher image-info`: what is in a file, what would be sent, how long it takes on the bus."""

from __future__ import annotations

import argparse
import contextlib
from typing import Final, TypedDict

from flasher import api
from flasher.cli import arguments
from flasher.cli.documents import ImageDocument, PlanDocument
from flasher.cli.manifest_text import ManifestBesideDocument, beside_line, manifest_beside
from flasher.cli.output import Output
from flasher.cli.plan_text import (
    image_document,
    image_lines,
    plan_document,
    plan_lines,
    vector_lines,
)
from flasher.cli.profile import add_option as add_profile
from flasher.cli.upgrade_text import check_line
from flasher.errors import ExitCode, FlasherError
from flasher.host.identity import Check, judge_bytes
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import BMS
from flasher.settings.profile import load_profile

_EPILOG = """\
examples:
  flasher image-info firmware.hex
  flasher image-info firmware.bin --base 0x8004000 -t wmc
  flasher image-info merged.hex --range 0x8004000:0x8020000
"""


class ImageInfoDocument(TypedDict):
    """What is in a file, what lies beside it, and what an upgrade would send."""

    image: ImageDocument
    manifest: ManifestBesideDocument
    plan: PlanDocument
    """For the BMS where no target was named: others differ by the ids alone."""


DOCUMENTS: Final = (ImageInfoDocument,)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = (
        "Show what is in an image file and what an upgrade would send. Opens no adapter. A file "
        "that no device should get is shown as far as it can be read, and refused as flasher flash "
        "refuses it."
    )
    parser.epilog = _EPILOG
    arguments.add_image(parser)
    arguments.add_implausible(parser)
    arguments.add_target(parser, required=False)
    arguments.add_dialect(parser)
    add_profile(parser)
    arguments.add_gaps(parser)


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    image = arguments.load_image(options)
    table = vector_table(image)
    # The time differs by stuff bits only between targets: any one serves for the figure.
    target = options.target or BMS
    profile = load_profile(options.profile, target, api.as_dialect(options.dialect))
    plan = api.make_plan(image, target, profile.dialect, has_upgrade=profile.has_upgrade)
    chosen = profile.upgrade_options(frame_gap_s=options.frame_gap, packet_gap_s=options.packet_gap)
    beside = manifest_beside(options.image, image, options.target)
    lines = [*image_lines(image), *vector_lines(table), beside_line(beside)]
    for line in (*lines, *plan_lines(plan, chosen)):
        output.result(line)
    document = ImageInfoDocument(
        image=image_document(image, table), manifest=beside, plan=plan_document(plan, chosen)
    )
    release = None
    with contextlib.suppress(FlasherError):  # told in `beside`
        release = api.find_release(options.image)
    waived = frozenset({Check.PLAUSIBLE} if options.allow_implausible else ())
    identity = profile.identity(release=release, waived=waived)
    for found in judge_bytes(image, identity):
        error = api.refusal(plan, found)
        if error is not None:
            output.failure(error, **document)
            return error.exit_code
        output.result(check_line(found.event))
    output.document(document)
    return ExitCode.OK
