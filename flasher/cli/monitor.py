"""`flasher monitor`: what is said on the bus, live or out of a recorded trace."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from typing import Final, TypedDict

from flasher.api import as_dialect
from flasher.cli import arguments
from flasher.cli.monitor_views import FrameLine, Lines, SeenLine, Table, View
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.driver import drive
from flasher.errors import ExitCode, UsageError
from flasher.protocol.spec import BMS, TARGET_ALIASES, Node
from flasher.protocol.text import printable
from flasher.trace.decoder import Kind, message_titles
from flasher.trace.watcher import Filter, Watcher, replay

REFRESH_S: Final = 0.25
"""Time between two refreshes of the table: slow enough to read, quick enough to follow."""
_EPILOG = """\
examples:
  flasher monitor -i socketcan -c can0
  flasher monitor -i socketcan -c can0 --node bms --message "running information"
  flasher monitor -i pcan -c PCAN_USBBUS1 --errors --duration 60
  flasher monitor upgrade.asc                            a recorded trace
  flasher monitor upgrade.blf --json | jq .message

Nothing is sent. On a terminal it is a table of the latest of each message, elsewhere one line a
message; `*` marks what changed since the same message before. Ctrl-C ends it with exit code 0.
"""


class MonitorDocument(TypedDict):
    """How much was seen."""

    frames: int
    messages: int
    """Shown, after the filters."""
    troubles: int


DOCUMENTS: Final = (MonitorDocument,)
LINES: Final = (SeenLine, FrameLine)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = (
        "Show decoded traffic, of a bus or of a recorded trace. Nothing is sent; the adapter still "
        "acknowledges frames, as every node does."
    )
    parser.epilog = _EPILOG
    parser.add_argument(
        "trace", metavar="TRACE", nargs="?", help="a recorded trace (.asc .blf .log ...), no bus"
    )
    arguments.add_target(parser, required=False)
    arguments.add_dialect(parser)
    _add_filters(parser)
    group = parser.add_argument_group("how to show it")
    form = group.add_mutually_exclusive_group()
    form.add_argument("--lines", action="store_true", help="one line a message, on a terminal too")
    form.add_argument(
        "--table", action="store_true", help="a table, elsewhere than on a terminal too: at the end"
    )
    group.add_argument("--raw", action="store_true", help="also every frame as it came (lines)")
    group.add_argument("--count", type=arguments.count, metavar="N", help="end after N messages")
    group.add_argument(
        "--duration", type=arguments.seconds, metavar="S", help="end after S seconds"
    )
    mock = parser.add_argument_group("without hardware")
    mock.add_argument("--mock", action="store_true", help="watch a device model in this process")
    mock.add_argument(
        "--mock-speed",
        type=arguments.seconds,
        default=1.0,
        metavar="X",
        help="times as fast as a real bus; 0 takes no time (default %(default)s)",
    )
    arguments.add_bus(parser)


def _add_filters(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what to show (default: everything)")
    group.add_argument(
        "--node",
        action="append",
        default=[],
        type=_node,
        metavar="wmc|bms|obc|hmi|cdl",
        help="only what this node sends or is sent; may be repeated",
    )
    group.add_argument(
        "--message",
        action="append",
        default=[],
        metavar="WORDS",
        help="only messages with these words in their title; may be repeated",
    )
    group.add_argument(
        "--errors",
        action="store_true",
        help="only trouble: damaged, malformed and unknown messages, error frames, NAK, faults",
    )


def _node(text: str) -> str:
    alias = TARGET_ALIASES.get(text.lower())
    name = text.upper() if alias is None else alias.node.name
    if name not in Node.__members__:
        known = ", ".join((*(node.name.lower() for node in Node), *TARGET_ALIASES))
        raise argparse.ArgumentTypeError(f"there is no node {text!a}; nodes are {known}")
    return name


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    _check(options)
    view = _choose_view(options, output)
    watcher = Watcher(
        Filter(frozenset(options.node), tuple(options.message), options.errors),
        raw=options.raw,
        count=options.count,
        duration_s=options.duration,
        pulse_s=REFRESH_S if view.is_live else None,
        dialect=as_dialect(options.dialect),
    )
    with ExitStack() as stack:
        if options.trace is None:
            connection = stack.enter_context(
                arguments.open_connection(options, options.target or BMS, asks=False)
            )
            view.name = printable(connection.name)
            cancelled = stack.enter_context(stop_on_signal())
            output.progress(f"watching {view.name}; Ctrl-C ends it")
            stack.enter_context(view)
            drive(watcher, connection.link, connection.clock, on_event=view, cancelled=cancelled)
        else:
            from flasher.trace.reader import read_trace  # noqa: PLC0415  loads python-can

            view.name = printable(options.trace)
            cancelled = stack.enter_context(stop_on_signal())
            stack.enter_context(view)
            replay(watcher, read_trace(options.trace), view, cancelled)
    output.progress(
        f"{counted(view.messages, 'message')} shown of {counted(watcher.frames, 'frame')}, "
        f"{view.troubles:,} with trouble"
    )
    output.document(
        MonitorDocument(frames=watcher.frames, messages=view.messages, troubles=view.troubles)
    )
    return ExitCode.OK


def _check(options: argparse.Namespace) -> None:
    """Raises UsageError for what does not go together, or can never be seen."""
    if options.trace is not None and (options.mock or hasattr(options, "interface")):
        raise UsageError(
            "A trace is read without a bus.", remedy="Leave out either TRACE or --mock and -i."
        )
    titles = message_titles() + tuple(kind.value for kind in Kind)
    for words in options.message:
        if not any(words.lower() in title.lower() for title in titles):
            raise UsageError(
                f"--message {words!a}: no message has these words in its title.",
                remedy=f"Titles are {', '.join(titles)}.",
            )


def _choose_view(options: argparse.Namespace, output: Output) -> View:
    terminal = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    wants_table = options.table or (terminal and options.trace is None)
    if wants_table and not (options.lines or options.raw or output.json_wanted):
        return Table(output, live=terminal and options.trace is None)
    return Lines(output)
