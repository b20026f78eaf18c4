"""Types of command-line values (numbers, targets, files, ...), with their shell completion."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from flasher.errors import UsageError, did_you_mean
from flasher.protocol.spec import TARGET_ALIASES, TARGETS, Node, Target

IMAGE_SUFFIXES: Final = (
    "hex", "ihex", "ihx", "s19", "s28", "s37", "srec", "mot", "elf", "axf", "out", "bin", "wfw",
)  # fmt: skip
TRACE_SUFFIXES: Final = (
    "asc", "blf", "csv", "db", "log", "mf4", "pcap", "pcapng", "trc", "gz",
)  # fmt: skip
SLOWEST: Final = 0.1
"""Smallest speed of the mock, except 0."""
_NUMBER: Final = re.compile(r"(0[xX][0-9a-fA-F_]+|[0-9][0-9_]*)([kKmM]?)")
_ADDRESS: Final = re.compile(r"0|0[xX][0-9A-Fa-f_]+")
_SUFFIXES: Final = {"": 1, "k": 1024, "m": 1024 * 1024}
_KEY_VALUE: Final = re.compile(r"([A-Za-z_]\w*)=(.*)")
_PROCESSES_MAX: Final = 1024
_PORT_MAX: Final = 65_535
_CHANNEL: Final = re.compile(r"v?can\d+")
_NETWORK: Final = Path("/sys/class/net")
_LINK_TYPE_CAN: Final = "280"
"""ARPHRD_CAN of Linux."""


# -- numbers ---------------------------------------------------------------------------------------


def number(text: str) -> int:
    """Parse a whole number: decimal or 0x, with K or M for 1024 and 1024 * 1024."""
    match = _NUMBER.fullmatch(text)
    if match is None:
        raise click.BadParameter(f"{text!r} is not a number (decimal, 0x..., K or M suffix)")
    return (
        int(match[1], 0 if match[1].lower().startswith("0x") else 10) * _SUFFIXES[match[2].lower()]
    )


def address(text: str) -> int:
    """Parse an address in hexadecimal, with 0x: without it, another address would be meant."""
    if _ADDRESS.fullmatch(text):
        return int(text, 16)
    hint = f", such as 0x{text}" if re.fullmatch(r"[0-9a-fA-F]{1,8}", text) else ""
    raise click.BadParameter(f"{text!a} is not an address in hexadecimal with 0x{hint}")


def address_range(text: str) -> tuple[int, int]:
    """Parse START:END, the end exclusive."""
    start, colon, end = text.partition(":")
    if not colon:
        raise click.BadParameter(f"{text!r} is not a range; write START:END")
    return address(start), address(end)


def _from_zero(text: str, what: str) -> float:
    with contextlib.suppress(ValueError):
        value = float(text)
        if 0 <= value < float("inf"):
            return value
    raise click.BadParameter(f"{text!a} is not {what}")


def seconds(text: str) -> float:
    """Parse a time in seconds, zero or more."""
    return _from_zero(text, "a time in seconds")


def percent(text: str) -> float:
    """Parse a percentage, zero or more."""
    return _from_zero(text, "a number of percent")


def speed(text: str) -> float:
    """Parse a speed relative to a real bus: 0, or at least `SLOWEST`."""
    value = _from_zero(text, "a speed: 1 is that of a real bus, 0 has no delays")
    if value and value < SLOWEST:
        raise click.BadParameter(f"must be 0, or {SLOWEST} and more")
    return value


def count(text: str) -> int:
    """Parse a whole number, at least 1."""
    value = number(text)
    if value < 1:
        raise click.BadParameter("must be 1 or more")
    return value


def processes(text: str) -> int:
    """Parse a number of processes."""
    value = count(text)
    if value > _PROCESSES_MAX:
        raise click.BadParameter(f"must be 1 to {_PROCESSES_MAX}")
    return value


def port(text: str) -> int:
    """Parse the number of a TCP port; 0 is any that is free."""
    if not text.isdecimal() or int(text) > _PORT_MAX:
        raise click.BadParameter(f"{text!a} is not a port: 0 to {_PORT_MAX}")
    return int(text)


def reason(text: str) -> str:
    """Parse a reason for the records, which is not empty."""
    if not text.strip():
        raise click.BadParameter("must not be empty")
    return text.strip()


def key_value(text: str) -> tuple[str, str]:
    """Parse KEY=VALUE."""
    match = _KEY_VALUE.fullmatch(text)
    if match is None:
        raise click.BadParameter(f"{text!r} is not KEY=VALUE")
    return match[1], match[2]


# -- names -----------------------------------------------------------------------------------------


def target(text: str) -> Target:
    """Parse the name or alias of a target."""
    from flasher.api import as_target  # noqa: PLC0415  not needed to show help

    try:
        return as_target(text)
    except UsageError as error:
        raise click.BadParameter(error.what) from error


def node(text: str) -> str:
    """Parse the name of a node, or the alias of a target."""
    alias = TARGET_ALIASES.get(text.lower())
    name = text.upper() if alias is None else alias.node.name
    if name not in Node.__members__:
        known = ", ".join(_NODES)
        raise click.BadParameter(f"there is no node {text!a}; nodes are {known}")
    return name


def interface(text: str) -> str:
    """Parse the name of a python-can back end."""
    known = interface_names()
    if text not in known:
        hint = did_you_mean(text, known)
        if _CHANNEL.fullmatch(text):
            hint = f"Did you mean -i socketcan -c {text}? "
        raise click.BadParameter(f"there is no {text!a}. {hint}Known are {', '.join(known)}")
    return text


_NODES: Final = (*(each.name.lower() for each in Node), *TARGET_ALIASES)


def offers(known: Callable[..., Iterable[str]]) -> Callable[..., list[str]]:
    """Create a function for `shell_complete`: words of `known(context)` with the typed prefix."""

    def complete(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
        return [word for word in known(ctx) if word.startswith(incomplete)]

    return complete


def target_names(_ctx: click.Context) -> Iterable[str]:
    """Words for --target."""
    return (*TARGETS, *TARGET_ALIASES)


def node_names(_ctx: click.Context) -> Iterable[str]:
    """Words for --node."""
    return _NODES


def interface_names(_ctx: click.Context | None = None) -> list[str]:
    """Words for --interface."""
    from flasher.python_can import can  # noqa: PLC0415  slow

    return sorted(can.VALID_INTERFACES)


def channels(_ctx: click.Context) -> list[str]:
    """Words for --channel: the CAN interfaces of Linux. Other back ends list theirs only after
    opening them.
    """
    if not _NETWORK.is_dir():
        return []
    found = []
    for link in _NETWORK.iterdir():
        with contextlib.suppress(OSError):
            if (link / "type").read_text().strip() == _LINK_TYPE_CAN:
                found.append(link.name)
    return sorted(found)


# -- files -----------------------------------------------------------------------------------------


class FilePath(click.ParamType[Any]):
    """Type of a file name, as text or as a `Path`. Errors are reported when the file is opened.

    A shell completes folders, and the files with one of the `suffixes`.
    """

    name = "file"

    def __init__(self, *suffixes: str, gives: Callable[[str], Any] = str) -> None:
        self._suffixes = tuple(f".{suffix}" for suffix in suffixes)
        self._gives = gives

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return self._gives(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        if not self._suffixes:
            return [CompletionItem(incomplete, type="file")]
        found = self._matching(incomplete)
        while len(found) == 1 and found[0].endswith("/") and (inside := self._matching(found[0])):
            found = inside  # shells append a blank to a unique completion
        return [CompletionItem(name) for name in found]

    def _matching(self, begun: str) -> list[str]:
        folder, slash, name = begun.rpartition("/")
        found = []
        with contextlib.suppress(OSError):
            for path in sorted(Path(folder + slash or ".").iterdir()):
                if path.name.startswith(name) and path.is_dir():
                    found.append(f"{folder}{slash}{path.name}/")
                elif path.name.startswith(name) and path.suffix.lower() in self._suffixes:
                    found.append(f"{folder}{slash}{path.name}")
        return found


class FolderPath(click.ParamType[Path]):
    """Type of a folder name."""

    name = "folder"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        return Path(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        return [CompletionItem(incomplete, type="dir")]
