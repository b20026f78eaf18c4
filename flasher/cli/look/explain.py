"""`flasher explain`: explain a recorded trace, with a verdict."""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from flasher.cli import values
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import argument, command, option
from flasher.cli.look.explain_text import story_lines
from flasher.cli.output import Output
from flasher.cli.recording import bundle_folder
from flasher.cli.terminal import painted, takes_colour
from flasher.cli.upgrade.history import describe_progress, repeat_command
from flasher.errors import ErrorCode, ExitCode, UsageError
from flasher.files import is_folder
from flasher.history import MOCK, Flash, FlashHistory
from flasher.protocol.text import printable
from flasher.trace.story import Story


@dataclass(frozen=True)
class ExplainDocument:
    """Story of a trace. Times in seconds since its first frame."""

    story: Story


DOCUMENTS: Final = (ExplainDocument,)
_HTML: Final = "--html"
_LAST: Final = "--last"
_EXAMPLES: Final = """\
examples:
  flasher explain upgrade.asc
  flasher explain --last                                 the bundle of the latest failure
  flasher explain upgrade.blf --html story.html          one page with diagrams
  flasher explain upgrade.log --json | jq .story.verdict
  flasher explain upgrade.log --all --packets            every message, every packet

Exit code 0 whenever the trace can be read, regardless of the verdict.
"""


@command(epilog=_EXAMPLES, exit_codes=(ExitCode.INTERRUPTED,))
@argument(
    "trace", required=False,
    type=values.FilePath(*values.TRACE_SUFFIXES, gives=Path),
    help="a recorded trace (.asc .blf .log ...), or the folder of a bundle",
)  # fmt: skip
@option(_LAST, is_flag=True, brief=True, help="read the bundle of the latest failed command")
@option(
    "-b", "--bitrate", type=values.count, metavar="BPS",
    help="bit rate of the bus that was recorded (default: the dialect's)",
)  # fmt: skip
@option(
    "--all", "everything", is_flag=True, panel="how to show it", brief=True,
    help="every message on a line of its own, packets too",
)  # fmt: skip
@option(
    "--packets", is_flag=True, panel="how to show it",
    help="a table of all packets with their answer times",
)  # fmt: skip
@option(
    _HTML, type=values.FilePath("html", gives=Path), metavar="FILE", panel="how to show it",
    brief=True, help="write the story as one self-contained page as well",
)  # fmt: skip
def explain(
    output: Output,
    *,
    trace: Path | None,
    last: bool,
    bitrate: int | None,
    everything: bool,
    packets: bool,
    html: Path | None,
) -> int:
    """Explain a recorded trace, or the bundle of a failed command: the verdict and its likely
    cause, phases and messages with their times, the response times of both ends, the bus load and
    other nodes on the bus. No bus is opened. Identifies nodes by CAN id, whichever program recorded
    the trace.
    """
    from flasher.trace.bundle import OLDER_TRACE, REPORT, TRACE  # noqa: PLC0415  loads python-can
    from flasher.trace.source import explain_path  # noqa: PLC0415  loads python-can

    source = find_source(trace, last=last)
    in_folder = (TRACE, OLDER_TRACE, REPORT) if is_folder(source) else ()
    check_writable(html, _HTML, [source, *(source / name for name in in_folder)])
    story = explain_path(source, bitrate_bps=bitrate, everything=everything)
    is_coloured = takes_colour(sys.stdout)
    for line in story_lines(story, packets=packets):
        is_bad = "  ! " in line or line.endswith("  none")
        output.result(painted(line, "red") if is_coloured and is_bad else line)
    if html is not None:
        from flasher.report.explain_page import render  # noqa: PLC0415  loads jinja2

        write_whole(html, render(story).encode("utf-8"), _HTML)
        output.progress(f"page: {printable(str(html))}")
    return output.document(ExplainDocument(story=story))


def find_source(named: Path | None, *, last: bool) -> Path:
    """Return the named trace or bundle, or the latest bundle. Raises UsageError unless exactly one
    is given, and without a bundle of the latest failure.
    """
    from flasher.trace.bundle import bundles  # noqa: PLC0415  loads python-can

    if last == (named is not None):
        raise UsageError("Name one trace or bundle.", remedy=f"Write either its name or {_LAST}.")
    if named is not None:
        if named.suffix.lower() == ".zip":
            raise UsageError(
                f"{printable(str(named))} is an archive, not a trace.",
                remedy="Unpack it into a folder of its own; a packed bundle is read with "
                "`flasher explain FOLDER`.",
            )
        return named
    folder = bundle_folder()
    found = bundles(folder)
    unfinished = _unfinished(found[-1] if found else None)
    if unfinished is not None:
        raise unfinished
    if not found:
        raise UsageError(
            f"There is no bundle in {printable(str(folder))}.",
            cause="no command has failed on the bus yet, or bundles go to another folder",
            remedy="Name the folder that the failed command has printed.",
        )
    return found[-1]


def _unfinished(bundle: Path | None) -> UsageError | None:
    """Return the error for an upgrade without a recorded end, newer than the latest bundle."""
    with suppress(UsageError, ValueError):
        flashes, _ = FlashHistory().flashes()
        latest = flashes[-1] if flashes else None
        if latest is None or latest.ended is not None or latest.is_running:
            return None
        began_at = datetime.fromisoformat(latest.began.at).timestamp()  # in whole seconds
        if bundle is None or began_at >= int(bundle.stat().st_mtime):
            return _without_end(latest)
    return None


def _without_end(flash: Flash) -> UsageError:
    began = flash.began
    error = UsageError(
        printable(f"{began.command} {began.image} has no end, and left no bundle."),
        where=printable(
            f"{began.target.upper()} on {began.adapter}, begun {began.at.replace('T', ' ')}; "
            f"{describe_progress(flash)}"
        ),
        cause="the program was killed, or the computer lost power",
        remedy="The device model is gone with the program: nothing needs repair.",
        code=ErrorCode.UNFINISHED,
    )
    if began.adapter != MOCK:
        where = f" in {printable(began.folder)}" if began.folder else ""
        error.remedy = (
            f"Run the command below{where}: it finds a device that still waits in the upgrade. "
            f"State of the device: {flash.device_left}."
        )
        error.command = printable(repeat_command(began))
    return error
