"""`flasher mock`: run the device model, or a whole bicycle, on any python-can bus."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from flasher import api
from flasher.cli import values
from flasher.cli.bench.serving import DeviceWatcher, serve
from flasher.cli.files import check_writable, write_whole
from flasher.cli.framework import command, option
from flasher.cli.options import Bus, bus_options, target_option
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, UsageError
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.system import System
from flasher.mock.variants import VARIANTS, find, make
from flasher.mock.variants.base import Variant
from flasher.protocol.engine import Engine
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Dialect, Target
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.settings.device_model import describe_options, set_options

_SAVE_IMAGE: Final = "--save-image"
_QUIET_S: Final = 2.5 * DEFAULT_TIMINGS.command_repeat_s
"""Silence after which the tool has finished verifying."""
_EXAMPLES: Final = """\
examples:
  flasher mock -t bms -i socketcan -c vcan0
  flasher mock -t mc -i udp_multicast -c 239.74.163.2 --bus-kwargs hop_limit=0 \\
      --bus-kwargs port=43210
  flasher mock -t bms -i socketcan -c vcan0 --no-app --save-image received.bin
  flasher mock -t bms -i socketcan -c vcan0 --set repeated_packet=nak_next
  flasher mock -t bms --system -i socketcan -c vcan0
  flasher mock --list-variants
  flasher mock -t bms -i socketcan -c vcan0 --variant accepts-early-end

Ends with exit code 0 when interrupted. Outlives an adapter that is unplugged
or bus-off: the device goes on as it was when the adapter is back.

choices for --set, the first value is the default:
"""


@dataclass(frozen=True)
class MockDocument:
    """Upgrades that the device model received."""

    images: int
    """Number of complete upgrades."""


@dataclass(frozen=True)
class VariantsDocument:
    """Values of --variant."""

    variants: list[Variant]


DOCUMENTS: Final = (MockDocument, VariantsDocument)


_SETTINGS: Final = describe_options()


@command(
    epilog=_EXAMPLES
    + "\n".join(f"  {key:<24} {allowed}\n      {text}" for key, allowed, text in _SETTINGS),
    exit_codes=(ExitCode.BUS,),
)
@target_option(required=False)
@option(
    _SAVE_IMAGE, metavar="FILE", type=values.FilePath("bin", gives=Path), panel="device model",
    brief=True, help="write each image that was received completely",
)  # fmt: skip
@option(
    "--no-app", is_flag=True, panel="device model", brief=True,
    help="start without a valid application (R14)",
)  # fmt: skip
@option(
    "--set", "choices", multiple=True, metavar="KEY=VALUE", panel="device model", brief=True,
    shell_complete=values.offers(lambda _ctx: (f"{key}=" for key, _, _ in _SETTINGS)),
    help="set a choice of the device; may be repeated, see below",
)  # fmt: skip
@option(
    "--system", is_flag=True, panel="device model",
    help="simulate a whole bicycle; the output is about the target",
)  # fmt: skip
@option(
    "--variant", metavar="NAME", panel="device model",
    shell_complete=values.offers(lambda _ctx: VARIANTS),
    help="simulate a device with one fault, see --list-variants",
)  # fmt: skip
@option(
    "--list-variants", is_flag=True, panel="device model",
    help="list the values of --variant, with the clause that each violates, and end",
)  # fmt: skip
@option(
    "--upgrades", type=values.count, metavar="N", panel="device model",
    help="end after N complete upgrades, when the tool is quiet",
)  # fmt: skip
@bus_options(mock=None)
def mock(
    output: Output,
    target: Target | None,
    bus: Bus,
    *,
    save_image: Path | None,
    no_app: bool,
    choices: tuple[str, ...],
    system: bool,
    variant: str | None,
    list_variants: bool,
    upgrades: int | None,
) -> int:
    """Simulate a device: its application and its bootloader. With --system, all devices of a
    bicycle, which talk to each other.
    """
    if list_variants:
        output.table((each.name, each.clause, each.summary) for each in VARIANTS.values())
        return output.document(VariantsDocument(variants=list(VARIANTS.values())))
    if target is None:
        raise UsageError(
            "flasher mock: -t/--target is required.", remedy="Write -t wmc, bms or obc."
        )
    dialect = bus.dialect
    check_writable(save_image, _SAVE_IMAGE)
    profile = set_options(DeviceProfile(), choices).speaking(dialect)
    engine, device = _create_model(
        target, dialect, profile, variant, is_system=system, has_application=not no_app
    )

    def save() -> None:
        if save_image is not None and device.stored_image is not None:
            write_whole(save_image, device.stored_image, _SAVE_IMAGE)
            output.result(f"saved:   {printable(str(save_image))}")

    watcher = DeviceWatcher(output, save)
    tool = _Tool(target)
    with (
        api.connect(dialect, holder=None, fallback=bus.fallback, **bus.config) as connection,
        stop_on_signal() as stopped,
    ):
        if not dialect.has_upgrade:
            output.progress(
                f"note: the {dialect.name.upper()} document has no upgrade; after its RESET the "
                "model runs Welling's bootloader"
            )
        served = "a whole bicycle" if system else target.node.name
        if variant is not None:
            found = find(variant)
            served = f"{served} that is wrong ({found.clause}: {found.summary})"
        output.progress(f"{served} on {connection.name}; Ctrl-C ends it")
        clock = connection.clock
        serve(
            engine,
            device,
            connection,
            output,
            taps=[tool],
            on_event=watcher,
            stopped=stopped,
            is_over=lambda: watcher.images == upgrades and tool.is_quiet(clock.now()),
        )
    return output.document(MockDocument(images=watcher.images))


def _create_model(
    target: Target,
    dialect: Dialect,
    profile: DeviceProfile,
    variant: str | None,
    *,
    is_system: bool,
    has_application: bool,
) -> tuple[Engine, MockDevice]:
    """Create the model to put on the bus, and the device in it to watch."""
    if is_system:
        if variant is not None:
            raise UsageError(
                "--variant and --system do not go together.",
                remedy="Leave one out: a variant is served alone.",
            )
        system = System(dialect, target, profile=profile, has_application=has_application)
        return system, system.device
    build = MockDevice if variant is None else partial(make, variant)
    device = build(
        target,
        bitrate_bps=dialect.bitrate_bps,
        profile=profile,
        has_application=has_application,
    )
    return device, device


class _Tool:
    """Tap that detects when the tool has finished with the target."""

    def __init__(self, target: Target) -> None:
        self._request_id = target.request_id
        self._last_at = 0.0

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if frame.can_id == self._request_id:
            self._last_at = now

    def is_quiet(self, now: float) -> bool:
        """True once even a repeated query would have arrived."""
        return now - self._last_at >= _QUIET_S
