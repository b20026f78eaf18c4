"""Entry point: finds the command, runs it, and turns every error into one message and a code.

Only the chosen command's module is imported, so that `flasher --help` is quick.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Final, NoReturn

from flasher.cli.lists import gather_lists
from flasher.cli.output import Output, open_missing_streams
from flasher.errors import ExitCode, FlasherError, InterruptedByUserError, UsageError

COMMANDS: Final = {
    "flash": ("flash", "upgrade a device"),
    "image-info": ("image_info", "what is in a file, what would be sent, how long it takes"),
    "info": ("info", "identity, versions, state, faults and history of a device"),
    "scan": ("scan", "who is on the bus, and which dialect is spoken"),
    "read": ("read", "read an item of a device by its name, or its memory"),
    "write": ("write", "write an item of a device by its name, and read it back"),
    "mock": ("mock", "run the device model on a bus until interrupted"),
    "monitor": ("monitor", "show decoded traffic, live or of a recorded trace"),
    "profile": ("profile", "what a target profile sets, and where each value comes from"),
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
    """argparse that reports wrong usage as all other errors are reported."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message}.", remedy=f"Try `{self.prog} --help`.")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = gather_lists(sys.argv[1:] if argv is None else argv)
    open_missing_streams()
    output = Output(json_wanted="--json" in arguments)
    try:
        return _guarded(lambda: _parse_and_run(arguments, output), output)
    except SystemExit as ended:
        return int(ended.code or 0)


def _parse_and_run(arguments: Sequence[str], output: Output) -> int:
    name = next((word for word in arguments if word in COMMANDS), None)
    options = _parse(_build_parser(name), arguments)
    output.verbosity = options.verbose - options.quiet
    return int(options.run(options, output))


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
        Output().result(said.getvalue().rstrip())
        raise
    return options


def _guarded(run: Callable[[], int], output: Output) -> int:
    """Run, and turn whatever is raised into a message and its exit code."""
    try:
        return run()
    except FlasherError as error:
        output.failure(error)
        return error.exit_code
    except KeyboardInterrupt:
        output.failure(
            InterruptedByUserError(
                "Interrupted at once.",
                remedy="If an upgrade was under way, it ended in the middle of a message and the "
                "state of the device is not known: run the same command again.",
            )
        )
        return ExitCode.INTERRUPTED
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
    _add_output(parser, verbosity=0, json_wanted=False)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, (module_name, summary) in COMMANDS.items():
        command = commands.add_parser(
            name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        _add_output(command, verbosity=argparse.SUPPRESS, json_wanted=argparse.SUPPRESS)
        if name == chosen:
            module = importlib.import_module(f"flasher.cli.{module_name}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser


def _add_output(parser: argparse.ArgumentParser, *, verbosity: object, json_wanted: object) -> None:
    """What may stand before the command and behind it."""
    parser.add_argument(
        "-v", "--verbose", action="count", default=verbosity, help="say more; twice for everything"
    )
    parser.add_argument("-q", "--quiet", action="count", default=verbosity, help="say less")
    parser.add_argument(
        "--json",
        action="store_true",
        default=json_wanted,
        help="print one JSON document (or JSON lines) on stdout",
    )


def _version() -> str:
    try:
        return version("welling-flasher")
    except PackageNotFoundError:
        return "(not installed)"
