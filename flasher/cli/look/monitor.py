"""`flasher monitor`: show decoded traffic, live or from a recorded trace."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

from flasher.cli import values
from flasher.cli.adapters import choose_adapter
from flasher.cli.framework import argument, command, option
from flasher.cli.look.monitor_views import FrameLine, LineView, MonitorView, SeenLine, TableView
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output, counted
from flasher.cli.stop import stop_on_signal
from flasher.driver import drive
from flasher.errors import ExitCode, UsageError
from flasher.protocol.spec import BMS, Target
from flasher.protocol.text import printable
from flasher.trace.decoder import Kind, message_titles
from flasher.trace.watcher import Filter, Watcher, replay
from flasher.wording import wording

REFRESH_S: Final = 0.25
"""Interval of refreshes of the table: slow enough to read, quick enough to follow."""
_EXAMPLES: Final = """\
examples:
  flasher monitor -i socketcan -c can0
  flasher monitor -i socketcan -c can0 --node bms --message "running information"
  flasher monitor -i pcan -c PCAN_USBBUS1 --errors --duration 60
  flasher monitor upgrade.asc                            a recorded trace
  flasher monitor upgrade.blf --json | jq .message

Nothing is sent. A terminal shows a table of the latest of each message, other outputs one line
per message; `*` marks values that changed since the previous one. Ctrl-C ends it with exit code 0.
"""


@dataclass(frozen=True)
class MonitorDocument:
    """Numbers of frames and messages."""

    frames: int
    messages: int
    """Messages shown, after filtering."""
    troubles: int


DOCUMENTS: Final = (MonitorDocument,)
LINES: Final = (SeenLine, FrameLine)


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.BUS,))
@argument(
    "trace", required=False, type=values.FilePath(*values.TRACE_SUFFIXES),
    help="a recorded trace (.asc .blf .log ...), no bus",
)  # fmt: skip
@target_option(required=False)
@option(
    "--node", "nodes", multiple=True, type=values.node, metavar="wmc|bms|obc|hmi|cdl", brief=True,
    panel="what to show (default: everything)", shell_complete=values.offers(values.node_names),
    help="only what this node sends or is sent; may be repeated",
)  # fmt: skip
@option(
    "--message", "messages", multiple=True, metavar="WORDS", brief=True,
    panel="what to show (default: everything)",
    help="only messages with these words in their title; may be repeated",
)  # fmt: skip
@option(
    "--errors", is_flag=True, panel="what to show (default: everything)",
    help="only faults: damaged, malformed and unknown messages, error frames, NAK, faults",
)  # fmt: skip
@option(
    "--lines", is_flag=True, panel="how to show it", brief=True,
    help="one line per message, even on a terminal",
)  # fmt: skip
@option(
    "--table", is_flag=True, panel="how to show it",
    help="a table at the end, where the output is not a terminal",
)  # fmt: skip
@option("--raw", is_flag=True, panel="how to show it", help="also every received frame (as lines)")
@option(
    "--count", type=values.count, metavar="N", panel="how to show it", help="end after N messages"
)  # fmt: skip
@option(
    "--duration", type=values.seconds, metavar="S", panel="how to show it", brief=True,
    help="end after S seconds",
)  # fmt: skip
@bus_options(mock="watch a device model in this process")
def monitor(
    output: Output,
    target: Target | None,
    bus: Bus,
    *,
    trace: str | None,
    nodes: tuple[str, ...],
    messages: tuple[str, ...],
    errors: bool,
    lines: bool,
    table: bool,
    raw: bool,
    count: int | None,
    duration: float | None,
) -> int:
    """Show decoded traffic, of a bus or of a recorded trace. Nothing is sent; the adapter still
    acknowledges frames, as every node does.
    """
    if lines and table:
        raise UsageError("--lines and --table do not go together.", remedy="Leave one out.")
    if trace is not None and (bus.mock or bus.interface is not None):
        raise UsageError(
            "A trace is read without a bus.", remedy="Leave out either TRACE or --mock and -i."
        )
    check_messages(messages)
    terminal = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    is_live = terminal and trace is None
    wants_table = (table or is_live) and not (lines or raw or output.json_wanted)
    view: MonitorView = TableView(output, live=is_live) if wants_table else LineView(output)
    watcher = Watcher(
        Filter(frozenset(nodes), messages, errors),
        raw=raw,
        count=count,
        duration_s=duration,
        pulse_s=REFRESH_S if view.is_live else None,
        dialect=bus.dialect,
    )

    def is_over() -> bool:
        return stop() or output.is_stdout_closed  # `| head` ends it

    with ExitStack() as stack:
        if trace is None:
            bus = choose_adapter(bus, output)
            connection = stack.enter_context(bus.connect(target or BMS, asks=False))
            view.name = printable(connection.name)
            stop = stack.enter_context(stop_on_signal())
            output.progress(f"watching {view.name}; Ctrl-C ends it")
            stack.enter_context(view)
            drive(watcher, connection.link, connection.clock, on_event=view, cancelled=is_over)
        else:
            from flasher.trace.reader import read_trace  # noqa: PLC0415  loads python-can

            view.name = printable(trace)
            stop = stack.enter_context(stop_on_signal())
            stack.enter_context(view)
            replay(watcher, read_trace(trace), view, is_over)
    output.progress(
        f"{counted(view.messages, 'message')} shown of {counted(watcher.frames, 'frame')}, "
        f"{view.troubles:,} with trouble"
    )
    return output.document(
        MonitorDocument(frames=watcher.frames, messages=view.messages, troubles=view.troubles)
    )


def check_messages(wanted: Iterable[str]) -> None:
    """Raise UsageError for words that no message title contains."""
    titles = message_titles() + tuple(map(wording, Kind))
    for words in wanted:
        if not any(words.lower() in title.lower() for title in titles):
            raise UsageError(
                f"--message {words!a}: no message has these words in its title.",
                remedy=f"Titles are {', '.join(titles)}.",
            )
