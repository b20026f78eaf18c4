"""Entry point: finds the command, runs it, and turns every error into one message and a code.

Only the chosen command's module is imported, so that `flasher --help` is quick.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Final, NoReturn

from flasher.cli.output import Output
from flasher.errors import ExitCode, FlasherError

COMMANDS: Final = {
    "flash": ("flash", "upgrade a device"),
    "image-info": ("image_info", "what is in a file, what would be sent, how long it takes"),
    "mock": ("mock", "run the device model on a bus until interrupted"),
}
"""Name of each command, its module in this package, and its one-line help."""

_EPILOG: Final = """\
examples:
  flasher image-info firmware.hex
  flasher flash firmware.hex -t bms --mock
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.hex -t mc -i pcan -c PCAN_USBBUS1 --trace-file upgrade.asc
  flasher mock -t bms -i socketcan -c vcan0 --save-image received.bin

exit codes:
  0 done   2 wrong usage   3 image rejected   4 adapter or bus failure   5 no answer
  6 wrong device   7 transfer failed   8 refused by the device   9 unconfirmed
  10 verification failed   130 interrupted   1 a bug in flasher
"""


class _Parser(argparse.ArgumentParser):
    """argparse with the one exit code for wrong usage, and a hint instead of a wall of text."""

    def error(self, message: str) -> NoReturn:
        self.exit(ExitCode.USAGE, f"{self.prog}: {message}\nTry `{self.prog} --help`.\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if argv is None else list(argv)
    name = next((word for word in arguments if word in COMMANDS), None)
    try:
        options = _parse(_build_parser(name), arguments)
    except SystemExit as ended:
        return int(ended.code or 0)
    output = Output(verbosity=options.verbose - options.quiet, json_wanted=options.json)
    try:
        return _run(options, output)
    except BrokenPipeError:
        # The reader of our output went away (`| head`): nothing is left to say to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitCode.OK


def _parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse; raises SystemExit for --help and for wrong usage.

    python-can's argument actions print what they read (filters, timing): stdout is the result's,
    so only what goes with the exit (the help) is let through.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            options = parser.parse_args(arguments)
            if options.command is None:
                parser.print_help()
                parser.exit(ExitCode.USAGE)
    except SystemExit:
        sys.stdout.write(said.getvalue())
        raise
    return options


def _run(options: argparse.Namespace, output: Output) -> int:
    try:
        return int(options.run(options, output))
    except FlasherError as error:
        output.failure(error)
        return error.exit_code
    except KeyboardInterrupt:
        output.error_line("Interrupted at once: the device may be left in the middle of a message.")
        return ExitCode.INTERRUPTED
    except BrokenPipeError:
        raise
    except Exception as error:  # noqa: BLE001  the last line of defence
        output.failure(
            FlasherError(
                f"Internal error: {type(error).__name__}: {error}.",
                cause="a bug in flasher",
                remedy="Please report it with the lines below and what you were doing.",
            )
        )
        output.error_line(traceback.format_exc().rstrip())
        return ExitCode.INTERNAL


def _build_parser(chosen: str | None) -> argparse.ArgumentParser:
    parser = _Parser(
        prog="flasher",
        description="Upgrade the firmware of Welling mid-drive e-bike systems over CAN.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"flasher {_version()}")
    _add_verbosity(parser, default=0)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, (module_name, summary) in COMMANDS.items():
        command = commands.add_parser(
            name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        _add_verbosity(command, default=argparse.SUPPRESS)
        command.add_argument(
            "--json", action="store_true", help="print one JSON document (or JSON lines) on stdout"
        )
        if name == chosen:
            module = importlib.import_module(f"flasher.cli.{module_name}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser


def _add_verbosity(parser: argparse.ArgumentParser, default: object) -> None:
    parser.add_argument(
        "-v", "--verbose", action="count", default=default, help="say more; twice for everything"
    )
    parser.add_argument("-q", "--quiet", action="count", default=default, help="say less")


def _version() -> str:
    try:
        return version("welling-flasher")
    except PackageNotFoundError:
        return "(not installed)"
