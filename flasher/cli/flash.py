"""`flasher flash`: upgrade a device."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

from flasher import api
from flasher.cli import arguments
from flasher.cli.output import Output, byte_count, counted, duration
from flasher.cli.plan_text import (
    image_document,
    image_lines,
    plan_document,
    plan_lines,
    vector_lines,
)
from flasher.cli.profile import add_option as add_profile
from flasher.cli.profile import profile_of
from flasher.cli.progress import Progress
from flasher.cli.stop import stop_on_signal
from flasher.driver import Tap
from flasher.errors import ExitCode
from flasher.host.options import DEFAULT_ATTEMPTS, UpgradeOptions
from flasher.host.outcome import Outcome
from flasher.host.session import Result
from flasher.host.verify import Level, Verdict, possible_levels
from flasher.image.cortexm import vector_table
from flasher.image.plan import Plan
from flasher.profile.model import Profile
from flasher.protocol.timing import DEFAULT_TIMINGS

_EPILOG = """\
examples:
  flasher flash firmware.hex -t bms --mock              try it without hardware
  flasher flash firmware.hex -t bms -i socketcan -c can0
  flasher flash firmware.bin -t mc -i kvaser -c 0 --base 0x8004000
  flasher flash firmware.hex -t obc --dry-run           show the plan, open no adapter

"Transferred" (every packet acknowledged), "completed" (the device said so) and "running version X"
(the new application answered) are three claims; the last lines say which of them were made good.
"""


_NO_QUERY = ": the document gives this target no query for it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.description = "Upgrade a device: reset, bootloader, transfer, final answer."
    parser.epilog = _EPILOG
    arguments.add_image(parser)
    arguments.add_target(parser)
    arguments.add_dialect(parser)
    add_profile(parser)
    _add_upgrade(parser)
    mock = parser.add_argument_group("without hardware")
    mock.add_argument("--mock", action="store_true", help="upgrade a device model in this process")
    mock.add_argument(
        "--mock-speed",
        type=arguments.speed,
        default=1.0,
        metavar="X",
        help="times as fast as a real bus, from 0.1 on; 0 takes no time (default %(default)s)",
    )
    arguments.add_bus(parser)


def _add_upgrade(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("upgrade")
    group.add_argument("-n", "--dry-run", action="store_true", help="show the plan and stop")
    group.add_argument(
        "--verify",
        choices=[level.value for level in Level],
        help="after the upgrade: ask the new application for its version, or read the whole image "
        "back as well (default: version where the target has a query for it, else none)",
    )
    group.add_argument(
        "--retries",
        type=arguments.count,
        metavar="N",
        help=f"send a packet up to N times (default {DEFAULT_TIMINGS.packet_tries})",
    )
    group.add_argument(
        "--attempts",
        type=arguments.count,
        metavar="N",
        help="begin the transfer up to N times, if the device restarts "
        f"(default {DEFAULT_ATTEMPTS})",
    )
    group.add_argument(
        "--timeout",
        type=arguments.seconds,
        metavar="S",
        help="overall deadline in seconds (default: computed from the plan)",
    )
    group.add_argument(
        "--frame-gap",
        type=arguments.seconds,
        metavar="S",
        help="seconds of silence between frames, for slow receivers",
    )
    group.add_argument(
        "--packet-gap",
        type=arguments.seconds,
        metavar="S",
        help="seconds of silence before each packet, for slow receivers",
    )
    group.add_argument(
        "--nak-next-is-ack",
        action="store_true",
        help="for bootloaders that answer a repeated packet n with NAK n+1",
    )
    group.add_argument(
        "--allow-boot-name",
        action="store_true",
        help="upgrade a device whose bootloader gives another name than the target's",
    )
    group.add_argument(
        "-f", "--force", action="store_true", help="the same as every --allow-... together"
    )
    group.add_argument(
        "--trace-file", metavar="FILE", help="record all frames; format by suffix (.asc .blf ...)"
    )


def run(options: argparse.Namespace, output: Output) -> int:
    """Run the command; returns the exit code."""
    profile = profile_of(options)
    image = arguments.load_image(options)
    profile.check_fits(image)
    plan = api.make_plan(
        image,
        options.target,
        options.dialect,
        bitrate_bps=getattr(options, "bitrate", None),
        has_upgrade=profile.has_upgrade,
    )
    show = output.result if options.dry_run else output.progress
    lines = [*image_lines(image), *vector_lines(vector_table(image)), *plan_lines(plan)]
    for line in lines:
        show(line)
    if options.dry_run:
        output.result("dry run: nothing was sent")
        output.document(_document(plan, ok=True, exit_code=ExitCode.OK, dry_run=True))
        return ExitCode.OK
    chosen = _upgrade_options(options, profile)
    level = _level(options, plan, chosen)
    result = _upgrade(options, plan, chosen, level, output)
    error = result.error()
    if error is not None:
        if result.outcome.ok:
            for line in _summary(result, plan):
                output.progress(line)
        output.failure(error, **_result_document(result), plan=plan_document(plan))
        return error.exit_code
    for line in _summary(result, plan):
        output.result(line)
    document = _document(plan, ok=True, exit_code=ExitCode.OK, **_result_document(result))
    output.document(document)
    return ExitCode.OK


def _level(options: argparse.Namespace, plan: Plan, chosen: UpgradeOptions) -> Level:
    if options.verify is None:
        return api.default_level(plan.target, chosen)
    level = Level(options.verify)
    api.check_level(plan, level, chosen)
    return level


def _upgrade(
    options: argparse.Namespace, plan: Plan, chosen: UpgradeOptions, level: Level, output: Output
) -> Result:
    with ExitStack() as stack:
        connection = stack.enter_context(_connection(options))
        taps = stack.enter_context(_recording(options.trace_file, output))
        output.progress(f"on {connection.name}")
        progress = stack.enter_context(Progress(plan, output))
        cancelled = stack.enter_context(
            stop_on_signal(lambda: output.error_line("stopping at the end of the message ..."))
        )
        return api.upgrade(
            plan,
            connection,
            options=chosen,
            verify=level,
            taps=taps,
            on_event=progress,
            cancelled=cancelled,
        )


@contextmanager
def _recording(path: str | None, output: Output) -> Iterator[list[Tap]]:
    """The tap that records to a file, if one is named."""
    if path is None:
        yield []
        return
    from flasher.trace.recorder import Recorder  # noqa: PLC0415  loads python-can

    with Recorder(path) as recorder:
        yield [recorder]
    if recorder.failure is not None:
        output.error_line(f"warning: the trace {path} is incomplete: {recorder.failure}")


def _connection(options: argparse.Namespace) -> AbstractContextManager[api.Connection]:
    if options.mock:
        return api.connect_mock(options.target, options.dialect, speed=options.mock_speed)
    return api.connect(options.dialect, **arguments.bus_config(options))


def _upgrade_options(options: argparse.Namespace, profile: Profile) -> UpgradeOptions:
    """The profile's choices, and the command line's where it makes any."""
    return profile.upgrade_options(
        packet_tries=options.retries,
        attempts=options.attempts,
        timeout_s=options.timeout,
        frame_gap_s=options.frame_gap,
        packet_gap_s=options.packet_gap,
        nak_next_is_ack=options.nak_next_is_ack or None,
        allow_boot_name=(options.allow_boot_name or options.force) or None,
        version_request=profile.version_query and profile.version_query.request(options.target),
    )


def _summary(result: Result, plan: Plan) -> list[str]:
    """The final lines of a good upgrade: three claims, kept apart."""
    outcome = result.outcome
    figures = outcome.statistics
    transfer_s = figures.transfer_s or 0.0
    sent = f"{byte_count(plan.image.size_bytes)} in {counted(plan.total_packets, 'packet')}"
    faults = f"{figures.repetitions} repeated, {figures.naks} NAK"
    whole = f"{counted(figures.attempts, 'attempt')}, {duration(figures.duration_s)} in all"
    return [
        f"transferred:  {sent}, {duration(transfer_s)}{_rate(plan, transfer_s)}",
        f"              {faults}, {whole}",
        f"boot version: {outcome.boot_version}",
        f"completed:    {outcome.ending.value}",
        f"running:      {_running(result)}",
    ]


def _running(result: Result) -> str:
    """What is known of the application that runs now, and how."""
    verification = result.verification
    if verification.verdict is Verdict.NOT_ASKED:
        reason = "" if possible_levels(result.outcome.target) != (Level.NONE,) else _NO_QUERY
        return result.running_version or f"not asked{reason}"
    return f"{result.running_version or 'unknown'} ({verification.verdict.value})"


def _rate(plan: Plan, transfer_s: float) -> str:
    """Bytes per second and how close to the line rate that is."""
    if not transfer_s:
        return ""
    share = plan.transfer_wire_s / transfer_s
    line = f"{plan.bitrate_bps / 1000:g} kbit/s line"
    # A bus in memory or on a network has no bit rate to keep to.
    closeness = f"{share:.0%} of a {line}" if share <= 1.02 else f"faster than a {line}"
    return f" ({plan.image.size_bytes / transfer_s / 1000:.1f} kB/s, {closeness})"


def _result_document(result: Result) -> dict[str, Any]:
    verification = result.verification
    return {
        "outcome": _outcome_document(result.outcome),
        "verification": {
            "level": verification.level.value,
            "verdict": verification.verdict.name.lower(),
            "running_version": result.running_version,
            "detail": verification.detail,
        },
    }


def _outcome_document(outcome: Outcome) -> dict[str, Any]:
    return {
        "ending": outcome.ending.name.lower(),
        "phase": outcome.phase.name.lower(),
        "packet": outcome.packet,
        "device_left": outcome.device_left.name.lower(),
        "boot_version": outcome.boot_version,
        "running_version": outcome.running_version,
        "detail": outcome.detail,
        "statistics": dataclasses.asdict(outcome.statistics),
    }


def _document(plan: Plan, **more: Any) -> dict[str, Any]:
    image = image_document(plan.image, vector_table(plan.image))
    return {**more, "image": image, "plan": plan_document(plan)}
