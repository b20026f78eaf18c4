"""`flasher conformance replay`: send the frames of a recorded trace to a device again."""

from __future__ import annotations

from typing import Final

from flasher.cli import values
from flasher.cli.bench.conformance_bench import bench_options, confirm_wear, described, opened
from flasher.cli.framework import argument, command, option
from flasher.cli.options import Bus, adapter_options
from flasher.cli.output import Output, counted
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.replay import ReplayResult, recording
from flasher.conformance.replay import replay as replay_trace
from flasher.errors import ExitCode
from flasher.protocol.text import printable

_EXAMPLES: Final = """\
examples:
  flasher conformance replay traces/TX-03.log -t bms --subject ./boot
  flasher conformance replay field.blf -t bms --mock

The device gets its good image first, as at the beginning of each case, and at the end. The frames
to the device are sent at their times in the trace, later where it takes longer to answer. Exit code
12 when its answers differ: - is a message of the trace that did not come, + one that came instead;
how often the device announces itself is not compared.
"""


DOCUMENTS: Final = (ReplayResult,)


@command(
    short_help="Send the frames of a trace again, and compare the answers",
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.IMAGE, ExitCode.BUS, ExitCode.PARTIAL, ExitCode.INTERRUPTED),
)
@argument(
    "trace", type=values.FilePath("log", "asc", "blf", "pcapng"), metavar="TRACE",
    help="a recorded trace",
)  # fmt: skip
@bench_options
@option(
    "-y", "--yes", is_flag=True, panel="what is run, and how",
    help="do not ask before a device on a bus is erased",
)  # fmt: skip
@adapter_options
def replay(output: Output, bus: Bus, bench: BenchOptions, *, trace: str, yes: bool) -> int:
    """Send the frames of a recorded trace to a device again, and compare its answers: a fault from
    a bench or from the field, on new code.
    """
    from flasher.trace.reader import read_trace  # noqa: PLC0415

    bench = described(bench, bus)
    recorded = recording(read_trace(trace), bench.device)
    if not bench.is_simulated:
        confirm_wear("the device is flashed, and gets all frames of the trace", is_agreed=yes)
    with opened(bench, output) as (subject, profile, stopped):
        found = replay_trace(subject, profile, recorded, stopped=stopped)
        was_stopped = stopped()
    output.result(
        f"{printable(found.subject)}: {counted(found.frames_sent, 'frame')} sent, "
        f"{counted(found.messages_recorded, 'message')} of the device in the trace"
    )
    for each in found.differences:
        output.results(printable(f"- {text}") for text in each.recorded)
        output.results(printable(f"+ {text}") for text in each.answered)
    differs = "differently" if found.differences else "as in the trace"
    output.result(printable(found.trouble) or f"the device answers {differs}")
    code = ExitCode.PARTIAL if found.differences or found.trouble else ExitCode.OK
    return output.document(found, exit_code=ExitCode.INTERRUPTED if was_stopped else code)
