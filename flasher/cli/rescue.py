"""`flasher rescue`: wait for a device to announce its bootloader at power-up, then upgrade it."""

from __future__ import annotations

import argparse
from typing import Final

from flasher.cli import arguments
from flasher.cli.output import Output
from flasher.cli.upgrade_options import add_upgrade
from flasher.cli.upgrade_text import DryRunDocument, UpgradeDocument
from flasher.cli.upgrading import run_upgrade
from flasher.host.options import DEFAULT_POWER_UP_TIMEOUT_S

DOCUMENTS: Final = (UpgradeDocument, DryRunDocument)

_EPILOG = """\
examples:
  flasher rescue firmware.hex -t bms -i socketcan -c can0
  flasher rescue firmware.hex -t bms -i pcan -c PCAN_USBBUS1 --wait 300
  flasher rescue firmware.hex -t bms --mock             try it without hardware

Start it, then take the device's supply away for some seconds and give it back. It works for a
device that announces itself at power-up only as well as for one that announces itself for ever.
Nothing is sent before the device announces itself; hardware and running version cannot be checked,
since no application runs.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = (
        "Upgrade a device that does not start any more: wait for the announcement that its "
        "bootloader makes at power-up, answer it, transfer, wait for the final answer, verify."
    )
    parser.epilog = _EPILOG
    add_upgrade(parser)
    parser.add_argument(
        "--wait",
        type=arguments.seconds,
        metavar="S",
        help=f"seconds to wait for the announcement (default {DEFAULT_POWER_UP_TIMEOUT_S:g})",
    )


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    return run_upgrade(options, output, at_power_up=True, power_up_timeout_s=options.wait)
