"""`--export-test`: writes the first failure as a unit test in C."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from flasher.cli import values
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import option, typed_values
from flasher.cli.output import Output, counted
from flasher.conformance.bench_options import BenchOptions
from flasher.conformance.results import RunStopped
from flasher.errors import BusError, UsageError
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from flasher.conformance.dut.exported_test import ExportedTest

NAME: Final = "--export-test"
export_option: Final = option(
    NAME, type=values.FilePath("c", gives=Path), metavar="FILE", panel="reports",
    help="the first thing that failed as a unit test in C (.c) against flasher_dut.h, with as few "
    "messages as show it (--subject). Power cuts, faults of bus and flash, limits of time, and "
    "choices that the device model does not have cannot be in it",
)  # fmt: skip


def check_export(path: Path | None, bench: BenchOptions) -> None:
    """Raises UsageError when the file cannot be written or no bootloader is compiled."""
    check_writable(path, NAME, typed_values(but="export_test"))
    if path is not None and not bench.subject:
        raise UsageError(
            f"{NAME} works with --subject only.",
            cause="the test is linked with a bootloader in C",
            remedy="Replay a trace of the bench on the compiled bootloader: "
            "`flasher conformance replay`.",
        )


def export(
    path: Path | None, attempts: Iterable[tuple[str, Callable[[], ExportedTest]]], output: Output
) -> None:
    """Write the first of these tests that can be made; reports why the others cannot. Raises
    UsageError when the file cannot be written.
    """
    if path is None:
        return
    from flasher.conformance.dut.exported_test import NotExportableError  # noqa: PLC0415  much

    names = []
    for name, make in attempts:
        names.append(name)
        try:
            made = make()
        except NotExportableError as error:
            why = " ".join(filter(None, (error.what, error.cause)))
            output.progress(f"no test of {name}: {printable(why)}")
            continue
        except (RunStopped, BusError) as error:
            output.progress(f"no test of {name}: {printable(str(error))}")
            return
        write_whole(path, made.code, NAME)
        size = f"{counted(made.messages, 'message')}, {counted(made.frames, 'frame')}"
        output.progress(f"test: {printable(str(path))}, of {name} ({size})")
        return
    if not names:
        output.progress("no test: nothing failed")
