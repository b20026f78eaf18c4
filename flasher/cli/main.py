"""Entry point: finds the command, runs it, and turns every error into one message and a code.

Only the chosen command's module is imported, so that `flasher --help` is quick.
PYTHON_ARGCOMPLETE_OK
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import logging
import os
import shlex
import sys
import traceback
from argparse import _SubParsersAction
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final, NoReturn

from flasher.cli import logs, manual
from flasher.cli.lists import gather_lists
from flasher.cli.output import Output
from flasher.cli.terminal import prepare_streams
from flasher.errors import (
    ExitCode,
    FlasherError,
    InterruptedByUserError,
    UsageError,
    hide_passwords,
)
from flasher.protocol.text import printable

COMMANDS: Final = {
    "flash": ("flash", "upgrade a device"),
    "rescue": ("rescue", "wait for a device to announce itself at power-up, then upgrade it"),
    "image-info": ("image_info", "what is in a file, what would be sent, how long it takes"),
    "info": ("info", "identity, versions, state, faults and history of a device"),
    "scan": ("scan", "who is on the bus, and which dialect is spoken"),
    "read": ("read", "read an item of a device by its name, or its memory"),
    "write": ("write", "write an item of a device by its name, and read it back"),
    "mock": ("mock", "run the device model on a bus until interrupted"),
    "monitor": ("monitor", "show decoded traffic, live or of a recorded trace"),
    "explain": ("explain", "the story of a recorded trace or a bundle, with a verdict"),
    "doctor": ("doctor", "look at adapters, bus and traffic, and say what fixes what is wrong"),
    "conformance": ("conformance", "test a bootloader against the protocol, case by case"),
    "manifest": ("manifest", "create or check the release manifest of an image"),
    "station": ("station", "flash unit after unit at the end of a line, with records"),
    "profile": ("profile", "what a target profile sets, and where each value comes from"),
}
"""Name of each command, its module in this package, and its one-line help."""

_DESCRIPTION: Final = """\
Upgrade the firmware of Welling mid-drive e-bike systems over CAN, and look at what they say. Plays
the CAN dongle (CDL) on any adapter that python-can drives, or on a built-in device model (--mock).
"""
_EPILOG: Final = """\
examples:
  flasher image-info firmware.hex
  flasher flash firmware.hex -t bms --mock
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.hex -t mc -i pcan -c PCAN_USBBUS1 --trace-file upgrade.asc
  flasher mock -t bms -i socketcan -c vcan0 --save-image received.bin

"""
_LOG: Final = logging.getLogger("flasher.cli")
_CHANGING: Final = frozenset({"flash", "rescue", "write", "conformance", "station"})
"""Commands that change a device."""
_FOR_THE_FILE: Final = {"said": True}
"""What who types it sees anyway."""


class _Parser(argparse.ArgumentParser):
    """argparse that reports wrong usage as all other errors are reported."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message}.", remedy=f"Try `{self.prog} --help`.")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    if "_ARGCOMPLETE" in os.environ:
        return _complete()
    arguments = gather_lists(sys.argv[1:] if argv is None else argv)
    prepare_streams()
    output = Output(json_wanted="--json" in arguments)
    with logs.Logs(output) as log:
        try:
            code = _guarded(lambda: _parse_and_run(arguments, output, log), output)
        except SystemExit as ended:
            code = int(ended.code or 0)
        _LOG.info("exit code %d", code, extra=_FOR_THE_FILE)
    return code


def _parse_and_run(arguments: Sequence[str], output: Output, log: logs.Logs) -> int:
    name = output.command = _command_of(arguments)
    options = _parse(build_parser([name] if name else []), arguments)
    options.command_line = [hide_passwords(word) for word in arguments]
    output.json_wanted = options.json
    output.events_wanted = options.events
    output.verbosity = options.verbose - options.quiet
    if options.events and not options.json:
        raise UsageError("--events needs --json.", remedy="Events are lines of JSON: add --json.")
    others = [value for name, value in vars(options).items() if name != "log_file"]
    log.open(output.verbosity, options.log_file, others)
    told = printable(shlex.join(["flasher", *options.command_line]))
    _LOG.info("flasher %s: %s", _version(), told, extra=_FOR_THE_FILE)
    return int(options.run(options, output))


def _command_of(arguments: Sequence[str]) -> str | None:
    """The command; what stands behind --log-file is a file, whatever its name."""
    words = iter(arguments)
    for word in words:
        if len(word) > len("--") and logs.OPTION.startswith(word):
            next(words, None)
        elif word in COMMANDS:
            return word
    return None


def _parse(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Parse; raises SystemExit for --help and for wrong usage.

    python-can's argument actions print what they read (filters, timing): stdout is the result's,
    so only what goes with the exit (the help) is let through.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            options = parser.parse_args(arguments)
            if options.command is None and options.json:
                raise UsageError("No command was named.", remedy="`flasher --help` lists them.")
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
        output.failure(InterruptedByUserError("Interrupted at once.", remedy=_unfinished(output)))
        return ExitCode.INTERRUPTED
    except Exception as error:  # noqa: BLE001  the last line of defence
        output.failure(
            FlasherError(
                f"Internal error: {type(error).__name__}: {printable(str(error))}.",
                cause="a bug in flasher",
                remedy="Please report it with the lines below and what you were doing.",
            )
        )
        # Into the log file too: error_line goes there.
        lines = traceback.format_exc().rstrip().splitlines()
        output.error_line("\n".join(printable(hide_passwords(line)) for line in lines))
        return ExitCode.INTERNAL


def _unfinished(output: Output) -> str:
    """What an end at once may have left behind. Commands that only look leave nothing."""
    if output.command not in _CHANGING:
        return ""
    return (
        "If something was being written to a device, it ended in the middle of a message and the "
        "state of the device is not known: run the same command again."
    )


def _complete() -> int:
    """Answer a shell that completes a command line; says nothing without argcomplete."""
    with contextlib.suppress(ImportError):
        from flasher.cli.completion import complete  # noqa: PLC0415  an extra

        complete(build_parser(COMMANDS))
    return ExitCode.INTERNAL


# -- the parsers ----------------------------------------------------------------------------------


def build_parser(chosen: Iterable[str]) -> argparse.ArgumentParser:
    """The parser of the whole command line; only the chosen commands' options are there."""
    chosen = set(chosen)
    parser = _Parser(
        prog="flasher",
        usage="flasher [-h] [--version] [-v] [-q] [--json] [--events] [--log-file FILE] "
        "COMMAND ...",
        description=_DESCRIPTION,
        epilog=_EPILOG + manual.exit_codes() + "\n\n`flasher COMMAND --help` tells the rest.",
        formatter_class=manual.Formatter,
    )
    parser.add_argument("--version", action="version", version=f"flasher {_version()}")
    _add_output(parser, at_top=True)
    for title, text in manual.commands_by_purpose(COMMANDS):
        parser.add_argument_group(title, text)
    commands = parser.add_subparsers(
        dest="command",
        prog="flasher",
        metavar="COMMAND",
        parser_class=_Parser,
        help=argparse.SUPPRESS,
    )
    for name, (module_name, _) in COMMANDS.items():
        command = commands.add_parser(name, formatter_class=manual.Formatter)
        if name in chosen:
            module = importlib.import_module(f"flasher.cli.{module_name}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
            _complete_help(name, command)
        _add_output(command)
    return parser


def _complete_help(name: str, command: argparse.ArgumentParser) -> None:
    """What every command has: output options for its actions, and what help says at its end."""
    options = set()
    for parser in with_actions(command):
        actions = parser._actions  # noqa: SLF001  argparse has no other way to see them
        options |= {word for action in actions for word in action.option_strings}
        manual.reword_bus_options(actions)
        if parser is not command:
            parser.formatter_class = manual.Formatter
            _add_output(parser)
    sections = (command.epilog or "", manual.exit_codes(name))
    command.epilog = "\n\n".join(
        section.strip("\n") for section in (*sections, manual.files_and_environment(options))
    )


def with_actions(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """A parser and those of its actions (`flasher profile show`), without repetition."""
    found = [parser]
    for action in parser._actions:  # noqa: SLF001  argparse has no other way to see them
        if isinstance(action, _SubParsersAction):
            for each in dict.fromkeys(action.choices.values()):
                found += with_actions(each)
    return found


def _add_output(parser: argparse.ArgumentParser, *, at_top: bool = False) -> None:
    """What may stand before the command and behind it."""

    def default(value: object) -> Any:
        return value if at_top else argparse.SUPPRESS

    group = parser.add_argument_group("output")
    count: dict[str, Any] = {"action": "count", "default": default(0)}
    flag: dict[str, Any] = {"action": "store_true", "default": default(value=False)}
    group.add_argument(
        "-v",
        "--verbose",
        help="say more, and show the log on stderr; twice for everything",
        **count,
    )
    group.add_argument("-q", "--quiet", help="say less", **count)
    group.add_argument("--json", help="print one JSON document (or JSON lines) on stdout", **flag)
    group.add_argument(
        "--events",
        help="with --json: print each event as a line of JSON, before the document",
        **flag,
    )
    group.add_argument(
        logs.OPTION,
        metavar="FILE",
        default=default(None),
        help="append everything to this log, with times, whatever -v and -q say",
    )


def _version() -> str:
    try:
        return version("welling-flasher")
    except PackageNotFoundError:
        return "(not installed)"
