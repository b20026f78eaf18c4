"""`flasher conformance init`: observe a device, and write its conformance profile."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.bench.conformance_bench import (
    bench_options,
    confirm_wear,
    described,
    opened,
)
from flasher.cli.bench.conformance_text import tried_lines
from flasher.cli.files import check_new, write_whole
from flasher.cli.framework import command, option
from flasher.cli.options import Bus, adapter_options
from flasher.cli.output import Output
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.catalogue import Selection
from flasher.conformance.results import InitResult
from flasher.errors import ExitCode
from flasher.protocol.text import printable

_EXAMPLES: Final = """\
examples:
  flasher conformance init -t bms --subject ./boot -o boot.toml
  flasher conformance init -t bms --mock --set repeated_packet=nak_next -o mock.toml
  flasher conformance init -t bms -i socketcan -c can0 --good-image known_good.hex -o p.toml

The device is upgraded to its good image again and again, more than a hundred times, and its answers
to test messages in between are written with their counts. A value that cannot be observed stays
open, as a comment with the reason. Before the file is written, the quick cases are run by it; what
does not pass is printed with the keys that decide it, and is a comment in the file. Review the file
before you judge by it: it describes what the device does, not what it should do. --profile gives
the values that cannot be observed.
"""
_OUTPUT: Final = "-o/--output"
_SEEN_SHOWN: Final = 100


DOCUMENTS: Final = (InitResult,)


_what = partial(option, panel="what is written")


@command(
    short_help="Observe a device, and write its conformance profile",
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.IMAGE, ExitCode.BUS, ExitCode.NO_ANSWER, ExitCode.PARTIAL, ExitCode.INTERRUPTED,
    ),
)  # fmt: skip
@bench_options
@_what(
    "-o", "--output", "file", type=values.FilePath("toml", gives=Path), metavar="FILE", brief=True,
    help="the profile (default: the name of the target, as bms.toml)",
)  # fmt: skip
@_what("--force", is_flag=True, brief=True, help="overwrite an existing file")
@_what("-y", "--yes", is_flag=True, help="do not ask before a device on a bus is worn")
@adapter_options
def init(
    output: Output, bus: Bus, bench: BenchOptions, *, file: Path | None, force: bool, yes: bool
) -> int:
    """Find the value of every profile key on the bus alone, and write the profile with the
    observations. The good image runs before and after. Exit code 12 when a quick case does not pass
    by the profile that is written.
    """
    from flasher.cli.bench.conformance_progress import progress  # noqa: PLC0415  much is loaded
    from flasher.conformance.init import UPGRADES, ask_device  # noqa: PLC0415
    from flasher.conformance.init.answers import MARGINS  # noqa: PLC0415
    from flasher.conformance.profile import (  # noqa: PLC0415
        ConformanceProfile,
        load_profile,
        value_text,
    )
    from flasher.conformance.runner import run  # noqa: PLC0415

    bench = described(bench, bus)
    path = file or Path(f"{bench.device.name}.toml")
    check_new(path, _OUTPUT, force=force)
    # Other facts of the bench must be observed too.
    start = ConformanceProfile() if bench.profile is None else load_profile(bench.profile)
    if not bench.is_simulated:
        wear = f"questions and quick cases erase and write the device about {UPGRADES} times"
        confirm_wear(wear, is_agreed=yes)
    with opened(bench, output) as (subject, _, stopped):
        with Bar(output, leave=False, unit=" questions") as bar:
            asked = ask_device(subject, start, stopped=stopped, progress=bar.move_to)
        found = replace(asked.profile(start), source=printable(str(path)))
        if not asked.stopped:
            with progress(output) as observer:
                quick = Selection(quick=True)
                report = run(subject, found, selection=quick, observer=observer, stopped=stopped)
            broken_off = report.stopped if stopped() or report.adapter_failed else ""
            asked = replace(asked, report=report, stopped=broken_off)
        was_stopped = stopped()
    rows = []
    for one in asked.answers:
        seen = one.seen
        if output.verbosity <= 0 and len(seen) > _SEEN_SHOWN:
            seen = seen[: _SEEN_SHOWN - 3] + "..."
        value = "open" if one.value is None else value_text(one.key, one.value)
        rows.append(tuple(map(printable, (one.key, value, seen))))
    output.table(rows)
    tried = asked.report
    if asked.stopped or tried is None:
        code = ExitCode.PARTIAL
        if was_stopped:
            code = ExitCode.INTERRUPTED
        elif tried is not None:
            code = ExitCode.BUS
        elif not asked.was_brought_up:
            code = ExitCode.NO_ANSWER
        output.error_line(f"no profile is written: {printable(asked.stopped)}")
        return output.document(asked, exit_code=code)
    lines = list(tried_lines(tried, asked))
    output.results(lines)
    head = [
        f"What {printable(asked.subject)} answered, target {asked.target}.",
        f"Margins: {MARGINS}.",
        *lines,
    ]
    toml = "".join(f"# {line}\n" for line in head) + found.to_toml(asked.open_keys)
    check_new(path, _OUTPUT, force=force)
    write_whole(path, toml.encode("utf-8"), _OUTPUT)
    asked = replace(asked, toml=toml, file=str(path))
    total, still_open = len(asked.answers), len(asked.open_keys)
    output.result(
        f"{printable(str(path))}: {total - still_open} of {total} keys, each with its "
        f"observations; {still_open} stay open; {MARGINS}"
    )
    return output.document(asked, exit_code=ExitCode.OK if tried.ok else ExitCode.PARTIAL)
