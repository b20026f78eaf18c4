"""Device under test, from the options of `flasher conformance`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

from flasher.cli import values
from flasher.cli.framework import option, option_set
from flasher.cli.options import Bus, allow_implausible_option, target_option
from flasher.cli.output import Output
from flasher.cli.stop import Stop, stop_on_signal
from flasher.cli.terminal import agrees, check_can_ask
from flasher.conformance.bench_options import BenchOptions, check_bench, open_bench
from flasher.conformance.real import HOST_UNCERTAINTY_S, DevicePowerCommand, ReadbackCommand
from flasher.errors import ErrorCode, UsageError

if TYPE_CHECKING:
    from flasher.conformance.profile import ConformanceProfile
    from flasher.conformance.subject import Subject

OUTPUT_OPTIONS: Final = ("--json", "--events", "--verbose", "--quiet", "--log-file")
"""Options that a command to repeat a run omits."""


def described(bench: BenchOptions, bus: Bus) -> BenchOptions:
    """The bench with its adapter. Raises UsageError for options that contradict each other."""
    if bench.target is None:
        raise UsageError(
            "flasher conformance: -t/--target is required.", remedy="Write -t wmc, bms or obc."
        )
    for name, value in {"--variant": bench.variant, "--set": bench.choices}.items():
        if value and not bench.is_mock:
            raise UsageError(f"{name} works with --mock only.")
    without = "--mock" if bench.is_mock else "--subject" if bench.subject else ""
    for name, command in {"--power-cmd": bench.power, "--readback-cmd": bench.readback}.items():
        if command and without:
            raise UsageError(f"{name} works without {without} only.")
    bench = replace(bench, bus=bus.config, fallback=None if without else bus.fallback)
    check_bench(bench)
    return bench


@contextmanager
def opened(
    bench: BenchOptions, output: Output
) -> Iterator[tuple[Subject, ConformanceProfile, Stop]]:
    """The device, its profile, and the user's stop request."""

    def stopping() -> None:
        output.progress("stopping: the device gets its good image back; press again to end at once")

    output.has_opened = True
    with open_bench(bench) as (subject, profile), stop_on_signal(stopping) as stopped:
        yield subject, profile, stopped


def confirm_wear(wear: str, *, is_agreed: bool) -> None:
    """Report how often the device is erased, and ask unless it `is_agreed`. Raises UsageError
    without a yes.
    """
    if is_agreed:
        return
    check_can_ask(wear)
    if not agrees(f"{wear}. Begin?", interrupted="nothing was sent to the device."):
        raise UsageError(
            "Nothing was sent to the device.",
            remedy="Answer y to begin, or add --yes.",
            code=ErrorCode.NOT_CONFIRMED,
        )


_bench = partial(option, panel="device under test")
_without_hardware = partial(option, panel="without hardware")
_image = partial(_bench, metavar="IMAGE", type=values.FilePath(*values.IMAGE_SUFFIXES))
set_option: Final = _without_hardware(
    "--set", "choices", multiple=True, metavar="KEY=VALUE",
    help="set a choice of the model, see `flasher mock --help`; may be repeated",
)  # fmt: skip
bench_options: Final = option_set(
    "bench",
    BenchOptions,
    target_option(required=False),
    _bench(
        "--profile", metavar="FILE", type=values.FilePath("toml"), brief=True,
        help="the product's choices and limits (TOML); see `flasher conformance profile`",
    ),
    _image("--good-image", brief=True, help="an image that runs on the device"),
    _image("--second-image", help="another one, smaller, of another version"),
    allow_implausible_option("device under test"),
    _bench(
        "--power-cmd", "power", type=DevicePowerCommand, metavar="COMMAND",
        help="command that switches the device, as 'relay 3 {on|off}'",
    ),
    _bench(
        "--readback-cmd", "readback", type=ReadbackCommand, metavar="COMMAND",
        help="command that dumps the application area, as 'dump {file}'",
    ),
    _bench(
        "--uncertainty", "uncertainty_s", type=values.seconds, default=HOST_UNCERTAINTY_S,
        metavar="SECONDS",
        help="how far the adapter's and the computer's times may be off",
    ),
    _without_hardware(
        "--mock", "is_mock", is_flag=True, brief=True,
        help="test the device model in this process; takes no time",
    ),
    _without_hardware(
        "--subject", metavar="BOOTLOADER", brief=True,
        help="test a bootloader that is compiled for the computer: a program, a shared library, or "
        "MODULE:FACTORY; see `flasher conformance header`",
    ),
    _without_hardware(
        "--variant", metavar="NAME",
        help="test a faulty model, see `flasher mock --list-variants`",
    ),
    set_option,
)  # fmt: skip
