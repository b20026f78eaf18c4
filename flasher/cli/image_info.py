"""`flasher image-info`: what is in a file, what would be sent, how long it takes on the bus."""

from __future__ import annotations

import argparse

from flasher import api
from flasher.cli import arguments
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = "Show what is in an image file and what an upgrade would send."
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
    for line in (*image_lines(image), *vector_lines(table), *plan_lines(plan)):
        output.result(line)
    output.document(
        {
            "ok": True,
            "exit_code": int(ExitCode.OK),
            "image": image_document(image, table),
            "plan": plan_document(plan),
        }
    )
    return ExitCode.OK
