"""`flasher verify`: compare what a device runs with an image, without flashing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import click

from flasher import api, events, jobs
from flasher.cli import values
from flasher.cli.bar import Bar
from flasher.cli.documents import ImageDocument
from flasher.cli.framework import command, option
from flasher.cli.options import (
    Bus,
    ImageOptions,
    bus_options,
    image_options,
    profile_option,
    target_option,
)
from flasher.cli.output import ClosingLine, Output, byte_count, counted
from flasher.cli.recording import RecordingOptions, recorded_device, recording_options
from flasher.cli.upgrade import text
from flasher.errors import ExitCode, UsageError, VerificationError
from flasher.host.verify import Level, Verdict, Verification, possible_levels
from flasher.image.cortexm import vector_table
from flasher.image.plan import Plan
from flasher.image.release import target_problem
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.profile import load_profile
from flasher.wording import wording

_RANGES_SHOWN: Final = 12
_EXAMPLES: Final = """\
examples:
  flasher verify firmware.hex -t bms -i socketcan -c can0
  flasher verify firmware.hex -t bms --level version -i socketcan -c can0
  flasher verify firmware.bin -t bms --base 0x8004000 --json | jq .verification

Nothing is written or reset. Exit code 0: the device runs the image, as far as it was compared. 10:
it runs another one, differs in the listed ranges, or has no application. 5: it does not answer.
"""


@dataclass(frozen=True)
class VerifyDocument:
    """Comparison of a device with an image."""

    target: str
    image: ImageDocument
    verification: Verification
    memory_not_compared: str | None
    """Reason why the memory was not compared; null if it was."""


DOCUMENTS: Final = (VerifyDocument,)


@command(
    epilog=_EXAMPLES,
    exit_codes=(
        ExitCode.IMAGE,
        ExitCode.BUS,
        ExitCode.NO_ANSWER,
        ExitCode.WRONG_DEVICE,
        ExitCode.VERIFICATION,
        ExitCode.INTERRUPTED,
    ),
)
@target_option()
@image_options
@option(
    "--manifest", metavar="FILE", type=values.FilePath("toml"), panel="image",
    help="the image's release manifest (default: IMAGE.toml beside the image, if there is one)",
)  # fmt: skip
@profile_option
@option(
    "--level", type=click.Choice([Level.VERSION.value, Level.MEMORY.value]), brief=True,
    help="compare the version alone, or require that the memory is compared (default: the version, "
    "then the memory where it can be read)",
)  # fmt: skip
@bus_options(mock="compare with a device model in this process")
@recording_options
def verify(
    output: Output,
    target: Target,
    image: ImageOptions,
    bus: Bus,
    recorded: RecordingOptions,
    *,
    manifest: str | None,
    profile: str | None,
    level: str | None,
) -> int:
    """Compare what a device runs with an image: the version that its application reports, then its
    memory, byte by byte. The documents let a tool ask the BMS only; a profile can name a version
    query for the others.
    """
    settings = load_profile(profile, target, bus.dialect)
    # What is only compared may be an image that would not be sent.
    opened = jobs.open_image(image.source, target, manifest=manifest, **image.options(force=True))
    bus = bus.with_profile(profile)
    options = settings.upgrade_options()
    plan = api.make_plan(
        opened.image, target, bus.dialect, bitrate_bps=bus.bit_rate.bps, has_upgrade=True
    )
    if possible_levels(target, options) == (Level.NONE,):
        raise UsageError(
            f"A {target.node.name} cannot be verified.",
            cause="the document gives no query for it, and no profile names one",
            remedy="`flasher history` lists what this computer has flashed. A product with a "
            "query of its own needs a profile with its version_query.",
        )
    if level is not None:
        api.check_level(plan, Level(level), options)
    problem = target_problem(opened.image, opened.release, target)
    if problem is not None:
        output.error_line(f"warning: {problem}")
    with recorded_device(recorded, bus, output, target, settings) as (device, record):
        output.progress(f"comparing the {target.node.name} on {device.connection.name} ...")

        def show(event: object) -> None:
            output.event(event)
            record.warn(output, event)
            if isinstance(event, events.MemoryRead):
                bar.move_to(event.read_bytes, event.total_bytes)

        with Bar(output, unit="B", unit_scale=True, desc="memory") as bar:
            found, unread = api.compare(device, plan, options, level, on_event=show)
        if level is None and found.ok and unread is not None and plan.image.base is None:
            unread += ": --base gives that of its first byte"
        error = found.error(target, is_after_upgrade=False)
        if error is not None and not isinstance(error, VerificationError):
            record.failed(error)
    document = VerifyDocument(
        target.name, text.image_document(opened.image, vector_table(opened.image)), found, unread
    )
    output.results(_lines(plan, found, unread))
    if error is not None:
        output.ending = text.failed
        return output.failure(error, document)
    is_sure = found.verdict is not Verdict.VERSION_UNJUDGED
    remark = "memory read back" if found.level is Level.MEMORY else wording(found.verdict)
    output.verdict(
        ClosingLine(
            "OK",
            f"{target.node.name} runs {found.running_version} ({remark})",
            "green" if is_sure else "yellow",
        )
    )
    return output.document(document)


def _lines(plan: Plan, found: Verification, unread: str | None) -> Iterator[str]:
    image = plan.image
    version = image.version or "names no version"
    yield f"image:   {printable(image.source)}, {byte_count(image.size_bytes)}, {version}"
    yield f"version: {found.running_version or 'not reported'}"
    if unread is not None:
        yield f"memory:  not compared: {unread}"
    elif found.differing:
        count = sum(span.size_bytes for span in found.differing)
        ranges = counted(len(found.differing), "range")
        yield f"memory:  differs in {ranges} of {byte_count(count)} together"
        yield from (f"         {span}" for span in found.differing[:_RANGES_SHOWN])
        if len(found.differing) > _RANGES_SHOWN:
            yield f"         and {len(found.differing) - _RANGES_SHOWN} more, see --json"
    elif found.verdict is Verdict.MEMORY_RIGHT:
        yield f"memory:  {byte_count(image.size_bytes)} are the image's"
