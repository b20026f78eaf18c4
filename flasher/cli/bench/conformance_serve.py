"""`flasher conformance serve`: run a compiled bootloader on any python-can bus."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from typing import Final

from flasher import api
from flasher.cli.bench.serving import DeviceWatcher
from flasher.cli.bench.serving import serve as serve_device
from flasher.cli.framework import command, option
from flasher.cli.options import Bus, adapter_options, target_option
from flasher.cli.output import Output
from flasher.cli.stop import stop_on_signal
from flasher.errors import ExitCode, UsageError
from flasher.protocol.spec import WELLING, Target
from flasher.protocol.text import printable

_EXAMPLES: Final = """\
examples:
  flasher conformance serve -t bms --subject ./boot -i socketcan -c vcan0
  flasher rescue application.bin -t bms -i socketcan -c vcan0

The device begins with erased flash. Its time is that of this computer: erasing takes as long as the
bootloader's facts say. The flash is lost when the command ends. A bootloader that crashes is
reported, and starts again as after a watchdog's reset. Ends with exit code 0 when interrupted.
"""


@dataclass(frozen=True)
class ServedDocument:
    """What the served bootloader did."""

    name: str
    """Of the bootloader, from its facts."""
    applications: int
    """How often it started its application."""


DOCUMENTS: Final = (ServedDocument,)


@command(
    short_help="Run a compiled bootloader on a bus, for other tools",
    epilog=_EXAMPLES,
    exit_codes=(ExitCode.BUS,),
)
@target_option(required=False)
@option(
    "--subject", metavar="BOOTLOADER", panel="device", brief=True,
    help="a program, a shared library, or MODULE:FACTORY; see `flasher conformance header`",
)  # fmt: skip
@adapter_options
def serve(output: Output, bus: Bus, target: Target | None, *, subject: str | None) -> int:
    """Run a bootloader that is compiled for this computer as a device on a bus, so that any tool
    can upgrade it: flash memory, CAN controller and application are simulated.
    """
    from flasher.conformance.dut.device import CompiledDevice  # noqa: PLC0415  much is loaded
    from flasher.conformance.dut.process import BootloaderError, BootloaderProcess  # noqa: PLC0415

    if target is None or subject is None:
        raise UsageError(
            "flasher conformance serve: -t/--target and --subject are required.",
            remedy="Write -t bms --subject ./boot, for example.",
        )
    watcher = DeviceWatcher(output)
    with closing(BootloaderProcess(subject)) as process:
        try:
            device = CompiledDevice(target, process, bitrate_bps=WELLING.bitrate_bps)
        except BootloaderError as error:
            raise process.unusable(f"does not start: {error.what}", error.cause) from error
        name = printable(device.facts.name or subject)
        with (
            api.connect(WELLING, holder=None, fallback=bus.fallback, **bus.config) as connection,
            stop_on_signal() as stopped,
        ):
            output.progress(f"{name} as {target.node.name} on {connection.name}; Ctrl-C ends it")
            serve_device(
                device, device, connection, output,
                on_event=watcher, stopped=stopped, crashes=True,
            )  # fmt: skip
    return output.document(ServedDocument(name, watcher.applications))
