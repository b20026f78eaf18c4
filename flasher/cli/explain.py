"""`flasher explain`: the story of a recorded trace, with a verdict."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Annotated, Any, Final, TypedDict

from flasher.cli import arguments
from flasher.cli.documents import plain_value
from flasher.cli.explain_text import story_lines
from flasher.cli.files import check_not_read, check_writable, write_whole
from flasher.cli.output import Output
from flasher.cli.recording import bundle_folder
from flasher.cli.terminal import painted, takes_colour
from flasher.errors import ExitCode, UsageError
from flasher.protocol.text import printable
from flasher.trace.story import Story


class ExplainDocument(TypedDict):
    """The story of a trace. Times in seconds since its first frame."""

    story: Annotated[dict[str, Any], Story]


DOCUMENTS: Final = (ExplainDocument,)
_HTML: Final = "--html"
_LAST: Final = "--last"
_DESCRIPTION = """\
Read a recorded trace, or the bundle that a failed command has left, and tell what happened: the
verdict and its likely cause, phases and messages with their times, how quickly both ends answered,
how full the bus was, who else was on it. No bus is opened. Goes by CAN ids, whoever recorded it.
"""
_EPILOG = """\
examples:
  flasher explain upgrade.asc
  flasher explain --last                                 what the latest failure has left
  flasher explain upgrade.blf --html story.html          one page with diagrams
  flasher explain upgrade.log --json | jq .story.verdict
  flasher explain upgrade.log --all --packets            every message, every packet

Exit code 0 whenever the trace can be read, whatever the verdict is.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = _DESCRIPTION
    parser.epilog = _EPILOG
    parser.add_argument(
        "trace",
        metavar="TRACE",
        nargs="?",
        type=Path,
        help="a recorded trace (.asc .blf .log ...), or the folder of a bundle",
    )
    parser.add_argument(
        _LAST, action="store_true", help="the bundle that the latest failed command has left"
    )
    parser.add_argument(
        "-b",
        "--bitrate",
        type=arguments.count,
        metavar="BPS",
        help="bit rate of the bus that was recorded (default: the dialect's)",
    )
    group = parser.add_argument_group("how to show it")
    group.add_argument(
        "--all", action="store_true", help="every message on a line of its own, packets too"
    )
    group.add_argument(
        "--packets", action="store_true", help="a table of all packets with their answer times"
    )
    group.add_argument(
        _HTML, type=Path, metavar="FILE", help="write the story as one self-contained page as well"
    )


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    from flasher.trace.bundle import OLDER_TRACE, REPORT, TRACE  # noqa: PLC0415  loads python-can
    from flasher.trace.source import explain_path  # noqa: PLC0415  loads python-can

    trace = _source(options)
    if options.html is not None:
        check_writable(options.html, _HTML)
        read = [trace]
        if trace.is_dir():
            read += [trace / name for name in (TRACE, OLDER_TRACE, REPORT)]
        check_not_read(options.html, _HTML, read)
    story = explain_path(trace, bitrate_bps=options.bitrate, everything=options.all)
    paint = _painted if takes_colour(sys.stdout) else str
    for line in story_lines(story, packets=options.packets):
        output.result(paint(line))
    if options.html is not None:
        from flasher.report.explain_page import render  # noqa: PLC0415  loads jinja2

        write_whole(options.html, render(story).encode("utf-8"), _HTML)
        output.progress(f"page: {printable(str(options.html))}")
    output.document(ExplainDocument(story=plain_value(story)))
    return ExitCode.OK


def _painted(line: str) -> str:
    """A line for a terminal: what went wrong is red."""
    is_bad = "  ! " in line or line.endswith("  none")
    return painted(line, "red") if is_bad else line


def _source(options: argparse.Namespace) -> Path:
    """The trace or bundle to read. Raises UsageError where none is named, or both ways are."""
    from flasher.trace.bundle import bundles  # noqa: PLC0415  loads python-can

    if options.last == (options.trace is not None):
        raise UsageError(
            "flasher explain: name one trace or bundle.", remedy=f"Write either TRACE or {_LAST}."
        )
    if options.trace is not None:
        named: Path = options.trace
        return named
    folder = bundle_folder()
    found = bundles(folder)
    if not found:
        raise UsageError(
            f"There is no bundle in {printable(str(folder))}.",
            cause="no command has failed on the bus yet, or bundles go to another folder",
            remedy="Name the folder that the failed command has printed.",
        )
    return found[-1]
