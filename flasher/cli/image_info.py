"""`flasher image-info`: what is in a file, what would be sent, how long it takes on the bus."""

from __future__ import annotations

import argparse
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
from flasher.errors import ExitCode
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import BMS

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
        "that no device should get is refused as flasher flash refuses it."
    )
    parser.epilog = _EPILOG
    arguments.add_image(parser)
    arguments.add_target(parser, required=False)
    arguments.add_dialect(parser)


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    image = arguments.load_image(options)
    table = vector_table(image)
    # The time differs by stuff bits only between targets: any one serves for the figure.
    plan = api.make_plan(image, options.target or BMS, options.dialect)
    beside = manifest_beside(options.image, image, options.target)
    for line in (*image_lines(image), *vector_lines(table)):
        output.result(line)
    output.result(beside_line(beside))
    for line in plan_lines(plan):
        output.result(line)
    output.document(
        ImageInfoDocument(
            image=image_document(image, table), manifest=beside, plan=plan_document(plan)
        )
    )
    return ExitCode.OK
