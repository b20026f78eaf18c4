"""Entry point: runs a command, and turns every error into a message and an exit code."""

from __future__ import annotations

import logging
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import click

from flasher.cli.framework import CommandEntry, Program, Session, usage_error
from flasher.cli.help import STYLE
from flasher.cli.logs import Logs
from flasher.cli.output import CHANGING, PRINTED, Output
from flasher.cli.terminal import may_colour, prepare_streams, started_as
from flasher.errors import (
    ExitCode,
    FlasherError,
    InterruptedByUserError,
    UsageError,
    hide_passwords,
)
from flasher.protocol.text import printable

PURPOSES: Final[Mapping[str, Mapping[str, CommandEntry]]] = {
    "upgrade a device": {
        "flash": CommandEntry("upgrade.flash:flash", "upgrade a device"),
        "rescue": CommandEntry(
            "upgrade.flash:rescue",
            "wait for a device to announce itself at power-up, then upgrade it",
        ),
        "ui": CommandEntry("upgrade.ui:ui", "upgrade a bike in a browser, step by step"),
        "image-info": CommandEntry(
            "upgrade.image_info:image_info",
            "show images, the bytes to be sent, and the time it takes",
        ),
        "image": CommandEntry(
            "upgrade.image:image", "convert and merge images: Intel HEX, S-record, raw binary"
        ),
        "acceptance": CommandEntry(
            "upgrade.acceptance:acceptance",
            "try a new adapter and device step by step, with a report",
        ),
        "history": CommandEntry(
            "upgrade.history:history", "list the upgrades made from this computer"
        ),
        "manifest": CommandEntry(
            "upgrade.manifest:manifest", "create or check the release manifest of an image"
        ),
    },
    "look at devices and the bus": {
        "info": CommandEntry(
            "look.info:info", "identity, versions, state, faults and history of a device"
        ),
        "scan": CommandEntry(
            "look.scan:scan", "list the devices on the bus, and identify its dialect"
        ),
        "verify": CommandEntry(
            "look.verify:verify", "compare what a device runs with an image, without flashing"
        ),
        "read": CommandEntry(
            "look.read:read", "read an item of a device by its name, or its memory"
        ),
        "write": CommandEntry(
            "look.write:write", "write an item of a device by its name, and read it back"
        ),
        "backup": CommandEntry(
            "look.backup:backup", "save a device's memory and all its answers to a file"
        ),
        "monitor": CommandEntry(
            "look.monitor:monitor", "show decoded traffic, live or of a recorded trace"
        ),
        "export": CommandEntry(
            "look.export:export", "convert the protocol and traces for Wireshark and other tools"
        ),
    },
    "when something goes wrong": {
        "adapters": CommandEntry(
            "look.adapters:adapters",
            "list the adapters of this computer, with the arguments for each",
        ),
        "doctor": CommandEntry(
            "look.doctor:doctor",
            "check adapters, bus and traffic, and suggest repairs",
        ),
        "help": CommandEntry("look.help:help_", "explain an error code, as E402"),
        "explain": CommandEntry(
            "look.explain:explain", "explain a recorded trace or a bundle, with a verdict"
        ),
        "bundle": CommandEntry(
            "look.bundle:bundle", "pack what explains a failure into one file to send"
        ),
    },
    "signed releases": {
        "release": CommandEntry(
            "release.release:release", "build, sign, verify and show signed releases"
        ),
        "trust": CommandEntry(
            "release.trust:trust", "choose whose releases are flashed; keys, rotation, revocation"
        ),
    },
    "without hardware, and for bootloaders": {
        "mock": CommandEntry("bench.mock:mock", "run the device model on a bus until interrupted"),
        "conformance": CommandEntry(
            "bench.conformance:conformance", "test a bootloader against the protocol, case by case"
        ),
        "simulate": CommandEntry(
            "bench.simulate:simulate", "upgrade simulated devices with random faults, from seeds"
        ),
    },
    "at the end of a production line": {
        "station": CommandEntry(
            "station.commands:station", "flash unit after unit at the end of a line, with records"
        ),
        "plant": CommandEntry(
            "plant.commands:plant", "collect the records of all stations of a plant"
        ),
    },
    "settings of a product": {
        "profile": CommandEntry(
            "upgrade.profile:profile",
            "show the settings of a target, and where each comes from",
        ),
    },
}
"""Commands by purpose."""
COMMANDS: Final = {name: each for group in PURPOSES.values() for name, each in group.items()}
_EPILOG: Final = """\
examples:
  flasher image-info firmware.hex
  flasher flash firmware.hex -t bms --mock
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.hex -t mc -i pcan -c PCAN_USBBUS1 --trace-file upgrade.asc
  flasher mock -t bms -i socketcan -c vcan0 --save-image received.bin

`flasher COMMAND -h` shows the most used options, `flasher COMMAND --help` everything;
`flasher help CODE` explains the code of an error, as E402.
"""
_COMPLETE: Final = "_FLASHER_COMPLETE"
"""Environment variable set by a shell that completes a command line."""
_LOG: Final = logging.getLogger("flasher.cli")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    if instruction := os.environ.get(_COMPLETE):
        from click.shell_completion import shell_complete  # noqa: PLC0415  a shell asks for it

        return shell_complete(flasher, {}, "flasher", _COMPLETE, instruction)
    words = list(sys.argv[1:] if argv is None else argv)
    prepare_streams()
    output = Output(
        json_wanted="--json" in words, program=started_as(), commands=(*COMMANDS, "--help")
    )
    with Logs(output) as logs:
        session = Session(output, logs, words)
        code = _guarded(lambda: _run(session, words), output)
        _LOG.info("exit code %d", code, extra=PRINTED)
    return code


def _run(session: Session, words: list[str]) -> int:
    colours = "auto" if may_colour() else None
    style = {**STYLE, "color_system": colours}
    try:
        with flasher.make_context("flasher", words, obj=session, rich_help_config=style) as ctx:
            return int(flasher.invoke(ctx))
    except click.exceptions.Exit as ended:
        return ended.exit_code
    except click.UsageError as wrong:
        raise usage_error(wrong, session.output.command) from wrong


def _guarded(run: Callable[[], int], output: Output) -> int:
    """Run, and turn any exception into a message and its exit code."""
    try:
        return run()
    except FlasherError as error:
        return output.failure(error)
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
    """Describe the device after an immediate end, unless the command only reads."""
    if output.command not in CHANGING:
        return ""
    if not output.has_opened:
        return "No adapter was opened, and nothing was sent: run the same command again."
    return (
        "If something was being written to a device, it ended in the middle of a message and the "
        "state of the device is not known: run the same command again."
    )


@click.group(cls=Program, entries=PURPOSES, epilog=_EPILOG)
@click.pass_context
def flasher(ctx: click.Context) -> int:
    """Upgrade the firmware of Welling mid-drive e-bike systems over CAN, and read their data. Acts
    as the CAN dongle (CDL) on any adapter that python-can supports, or on a built-in device model
    (--mock).
    """
    output = ctx.ensure_object(Session).output
    if ctx.invoked_subcommand is None and output.json_wanted:
        raise UsageError("No command was named.", remedy="`flasher --help` lists them.")
    if ctx.invoked_subcommand is None:
        output.print_help(ctx.get_help())
    return ExitCode.USAGE
