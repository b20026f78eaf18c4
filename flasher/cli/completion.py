"""Completion in the shell, with argcomplete (the extra `completion`). Imported only while a shell
asks for it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import argcomplete
from argcomplete.completers import DirectoriesCompleter, FilesCompleter

from flasher.cli.main import with_actions
from flasher.protocol.spec import TARGET_ALIASES, TARGETS, Node

_IMAGE_SUFFIXES: Final = (
    "hex", "ihex", "ihx", "s19", "s28", "s37", "srec", "mot", "elf", "axf", "out", "bin",
)  # fmt: skip
_TRACE_SUFFIXES: Final = ("asc", "blf", "csv", "db", "log", "mf4", "trc", "gz")
_NETWORK: Final = Path("/sys/class/net")
_LINK_TYPE_CAN: Final = "280"
"""ARPHRD_CAN of Linux."""

Completer = Callable[..., Iterable[str]]


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell and end the process; returns where no shell asks."""
    for each in with_actions(parser):
        prepare(each)
    argcomplete.autocomplete(parser)


def prepare(parser: argparse.ArgumentParser) -> None:
    """Give every argument of a parser what completes it. Choices complete themselves."""
    for action in parser._actions:  # noqa: SLF001  argparse has no other way to see them
        completer = _completer_of(action)
        if completer is not None and not action.choices:
            setattr(action, "completer", completer)  # noqa: B010  argcomplete's own attribute


def _completer_of(action: argparse.Action) -> Completer | None:
    by_name: dict[str, Completer] = {
        "target": _target_names,
        "node": _node_names,
        "channel": _channels,
        "item": _items,
        "choices": _mock_choices,
        "image": FilesCompleter(_IMAGE_SUFFIXES),
        "trace": FilesCompleter(_TRACE_SUFFIXES),
        "trace_file": FilesCompleter(_TRACE_SUFFIXES),
        "profile": FilesCompleter(("toml",)),
        "manifest": FilesCompleter(("toml",)),
    }
    if action.dest in by_name:
        return by_name[action.dest]
    if action.metavar == "DIR":
        return DirectoriesCompleter()
    return FilesCompleter() if action.metavar == "FILE" else _nothing


def _nothing(**_: Any) -> list[str]:
    """For numbers and texts: no list of files in their place."""
    return []


def _target_names(**_: Any) -> list[str]:
    return [*TARGETS, *TARGET_ALIASES]


def _node_names(**_: Any) -> list[str]:
    return [*(node.name.lower() for node in Node), *TARGET_ALIASES]


def _channels(**_: Any) -> list[str]:
    """The CAN interfaces of Linux; other back ends do not name theirs without opening them."""
    if not _NETWORK.is_dir():
        return []
    kinds = {link.name: link / "type" for link in _NETWORK.iterdir()}
    return sorted(name for name, kind in kinds.items() if _is_can(kind))


def _is_can(kind: Path) -> bool:
    try:
        return kind.read_text().strip() == _LINK_TYPE_CAN
    except OSError:
        return False


def _items(parsed_args: argparse.Namespace, **_: Any) -> list[str]:
    """What `flasher read` or `flasher write` can name, for the target where it is given."""
    from flasher import api  # noqa: PLC0415
    from flasher.cli.read import MEMORY  # noqa: PLC0415
    from flasher.host.items import readable, writable  # noqa: PLC0415
    from flasher.protocol.spec import BMS  # noqa: PLC0415

    target = getattr(parsed_args, "target", None) or BMS
    dialect = api.as_dialect(parsed_args.dialect)
    if parsed_args.command == "write":
        return list(writable(target, dialect))
    return [*readable(target, dialect), MEMORY]


def _mock_choices(**_: Any) -> list[str]:
    """KEY= of each choice of the device model."""
    from flasher.settings.device_model import describe_options  # noqa: PLC0415

    return [f"{key}=" for key, _, _ in describe_options()]
