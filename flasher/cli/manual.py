"""What every command's --help says behind its own text: exit codes, files, environment; and which
commands belong together. Facts about one command stand with that command.
"""

from __future__ import annotations

import argparse
import itertools
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from flasher.cli.terminal import wrap_line
from flasher.errors import ExitCode

_EXAMPLE: Final = re.compile(r"(\s+flasher .*?\S) {3,}(\S.*)")
WIDTH: Final = 100
"""Columns that help takes at the most."""
_OK: Final = ExitCode.OK
_ASKS: Final = (ExitCode.BUS, ExitCode.NO_ANSWER)
_UPGRADES: Final = (
    ExitCode.IMAGE,
    *_ASKS,
    ExitCode.WRONG_DEVICE,
    ExitCode.TRANSFER,
    ExitCode.REFUSED,
    ExitCode.UNCONFIRMED,
    ExitCode.VERIFICATION,
)
_STOPS: Final = ExitCode.INTERRUPTED

PURPOSES: Final[Mapping[str, tuple[str, ...]]] = {
    "upgrade a device": ("flash", "rescue", "image-info", "manifest"),
    "look at devices and the bus": ("info", "scan", "read", "write", "monitor"),
    "when something goes wrong": ("doctor", "explain"),
    "without hardware, and for bootloaders": ("mock", "conformance"),
    "at the end of a production line": ("station",),
    "what a product does its own way": ("profile",),
}
"""The commands by what they are for; one that is in none of them comes at the end."""

_MEANINGS: Final[Mapping[ExitCode, str]] = {
    ExitCode.OK: "done",
    ExitCode.INTERNAL: "a bug in flasher",
    ExitCode.USAGE: "wrong usage",
    ExitCode.IMAGE: "image rejected",
    ExitCode.BUS: "adapter or bus failure",
    ExitCode.NO_ANSWER: "no answer",
    ExitCode.WRONG_DEVICE: "wrong device",
    ExitCode.TRANSFER: "transfer failed",
    ExitCode.REFUSED: "refused by the device",
    ExitCode.UNCONFIRMED: "unconfirmed",
    ExitCode.VERIFICATION: "verification failed",
    ExitCode.NOTHING_TO_DO: "nothing to do",
    ExitCode.PARTIAL: "some failed",
    ExitCode.INTERRUPTED: "interrupted",
}

_EXIT_CODES: Final[Mapping[str, tuple[ExitCode, ...]]] = {
    "flash": (*_UPGRADES, ExitCode.NOTHING_TO_DO, _STOPS),
    "rescue": (*_UPGRADES, _STOPS),
    "image-info": (ExitCode.IMAGE,),
    "manifest": (ExitCode.IMAGE, ExitCode.WRONG_DEVICE),
    "info": (*_ASKS, _STOPS),
    "scan": (*_ASKS, _STOPS),
    "read": (*_ASKS, _STOPS),
    "write": (*_ASKS, ExitCode.VERIFICATION, _STOPS),
    "monitor": (ExitCode.BUS,),
    "mock": (ExitCode.BUS,),
    "doctor": (ExitCode.BUS, _STOPS),
    "explain": (_STOPS,),
    "conformance": (ExitCode.IMAGE, *_ASKS, ExitCode.PARTIAL, _STOPS),
    "station": (ExitCode.BUS, ExitCode.VERIFICATION, ExitCode.PARTIAL, _STOPS),
    "profile": (),
}
"""What a command can end with besides done, wrong usage and a bug; another command: anything."""

_READS: Final[Mapping[str, tuple[tuple[str, str], ...]]] = {
    "--interface": (
        ("CAN_INTERFACE, CAN_CHANNEL, ...", "the adapter, where -i and -c do not name it"),
        ("can.conf, ~/.canrc, /etc/can.conf", "the same in python-can's configuration files"),
    ),
    "--profile": (
        ("flasher.toml", "target profile, where --profile names none: of the"),
        ("", "working directory, else of the user's configuration"),
    ),
    "--bundle-dir": (("FLASHER_BUNDLE_DIR", "where bundles go, where --bundle-dir is not given"),),
    "--last": (("FLASHER_BUNDLE_DIR", "where bundles are looked for"),),
}
"""Environment variables and files, by the option of the command that stands for them."""
_READS_ALWAYS: Final = (("NO_COLOR", "set to anything: no colours"),)

_BUS_OPTIONS: Final[Mapping[str, tuple[str, str]]] = {
    "interface": ("BACKEND", "python-can's back end for the adapter: one of %(choices)s"),
    "channel": ("CHANNEL", "which adapter or port: can0, PCAN_USBBUS1, 0, COM3, ..."),
    "bitrate": ("BPS", "bits per second (default: the dialect's)"),
    "fd": ("", "open the adapter for CAN FD; the protocol itself uses classical frames"),
    "data_bitrate": ("BPS", "bits per second of the data phase of CAN FD"),
    "timing": ("KEY=VALUE", "bit timing, such as f_clock=8_000_000 brp=2 tseg1=5 tseg2=2 sjw=2"),
    "can_filters": (
        "ID:MASK",
        (
            "filters of the adapter, in hexadecimal; ID~MASK for all others. At least the "
            "device's answers must pass: 725:7FF 720:7FF for the BMS"
        ),
    ),
    "bus_kwargs": ("KEY=VALUE", "more arguments for the back end, such as app_name=CANalyzer"),
}
"""python-can's options in our words: their own help is made for other programs."""


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Help no wider than `WIDTH` and the window. Lines of a text stay as they are; where one is too
    long, its paragraph is filled, and what is said of an example goes below it.
    """

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=30, width=columns())

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        width = width if _is_for_terminal() else WIDTH - len(indent)
        lines: list[str] = []
        for is_prose, group in itertools.groupby(
            text.splitlines(), lambda line: line[:1].isalpha()
        ):
            part = list(group)
            if is_prose and max(map(len, part)) > width:
                lines += textwrap.wrap(" ".join(part), width)
            else:
                lines += (each for line in part for each in _narrowed(line, width))
        return "\n".join(indent + line for line in lines)


def columns() -> int:
    """Columns that help takes."""
    return max(40, min(shutil.get_terminal_size().columns - 2, WIDTH))


def _is_for_terminal() -> bool:
    """Of the process: while it is parsed, stdout itself is held back."""
    return sys.__stdout__ is not None and sys.__stdout__.isatty()


def _narrowed(line: str, width: int) -> list[str]:
    """An indented line that fits: an example's remark below it, else wrapped."""
    example = _EXAMPLE.match(line)
    if len(line) > width and example:
        return [example[1], f"      {example[2]}"]
    return wrap_line(line, width)


def reword_bus_options(actions: Iterable[argparse.Action]) -> None:
    """Give python-can's options short names for their values, and help."""
    for action in actions:
        if action.dest in _BUS_OPTIONS and action.option_strings:
            metavar, action.help = _BUS_OPTIONS[action.dest]
            action.metavar = metavar or None


def commands_by_purpose(commands: Mapping[str, tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Title and lines of each group of commands; `commands` is `flasher.cli.main.COMMANDS`."""
    grouped = {name for names in PURPOSES.values() for name in names}
    others = tuple(name for name in commands if name not in grouped)
    width = max(map(len, commands))
    for title, names in (*PURPOSES.items(), ("others", others)):
        lines = [f"{name:<{width}}  {commands[name][1]}" for name in names if name in commands]
        if lines:
            yield title, "\n".join(lines)


def exit_codes(command: str | None = None) -> str:
    """The section on what the command can end with; without one, on all exit codes."""
    codes: Iterable[ExitCode] = ExitCode
    if command is not None and command in _EXIT_CODES:
        codes = {_OK, ExitCode.USAGE, ExitCode.INTERNAL, *_EXIT_CODES[command]}
    # No space inside, so that a meaning is not parted from its code.
    told = [f"{int(code)} {_MEANINGS.get(code, code.name.lower())}" for code in sorted(codes)]
    words = "   ".join(each.replace(" ", "\xa0") for each in told)
    width = min(columns(), WIDTH - 4) if _is_for_terminal() else WIDTH - 4
    lines = textwrap.wrap(words, width, initial_indent="  ", subsequent_indent="  ")
    return "exit codes:\n" + "\n".join(lines).replace("\xa0", " ")


def files_and_environment(options: Iterable[str]) -> str:
    """The section on what a command with these options reads besides its command line."""
    given = set(options)
    rows = [row for option, rows in _READS.items() if option in given for row in rows]
    rows += _READS_ALWAYS
    width = max(len(name) for name, _ in rows)
    return "files and environment:\n" + "\n".join(
        f"  {name:<{width}}  {meaning}" for name, meaning in rows
    )
