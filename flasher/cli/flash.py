"""`flasher flash`: upgrade a device."""

from __future__ import annotations

import argparse
from typing import Final

from flasher.cli.output import Output
from flasher.cli.upgrade_options import add_upgrade
from flasher.cli.upgrade_text import DryRunDocument, UpgradeDocument
from flasher.cli.upgrading import run_upgrade

DOCUMENTS: Final = (UpgradeDocument, DryRunDocument)

_EPILOG = """\
examples:
  flasher flash firmware.hex -t bms --mock              try it without hardware
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.bin -t mc -i kvaser -c 0 --base 0x8004000
  flasher flash firmware.hex -t bms --skip-same-version -i socketcan -c can0
  flasher flash firmware.hex -t obc --dry-run           show the plan, open no adapter

"Transferred" (every packet acknowledged), "completed" (the device said so) and "running version X"
(the new application answered) are three claims; the last lines say which of them were made good.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = (
        "Upgrade a device: ask it who it is, check that the image belongs there, reset it into its "
        "bootloader, transfer, wait for the final answer, verify. A device that sits in its "
        "bootloader already, and announces itself, goes straight on; one that announces itself "
        "only at power-up needs `flasher rescue`."
    )
    parser.epilog = _EPILOG
    add_upgrade(parser)
    parser.add_argument(
        "--skip-same-version",
        action="store_true",
        help="leave a device alone that already runs the image's version: exit code 11",
    )


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    return run_upgrade(options, output, skip_same_version=options.skip_same_version)
