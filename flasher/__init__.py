"""Firmware upgrades for the Welling mid-drive e-bike system over CAN.

Upgrade a device:

    result = flasher.flash("firmware.hex", "bms", interface="socketcan", channel="can0")
    print(result.running_version)

The same without hardware, printing its events:

    flasher.flash("firmware.hex", "bms", mock=True, on_event=print)

Number of packets, and time on the bus:

    plan = flasher.make_plan(flasher.load("firmware.hex"), "bms")
    print(plan.total_packets, plan.wire_s)

In two steps, to examine a failure instead of catching it:

    with flasher.connect(interface="pcan", channel="PCAN_USBBUS1") as connection:
        result = connection.device("bms").upgrade(plan)
    print(result.outcome.ending, result.outcome.device_left, result.error())

Read typed data with units in the names, write an item, upgrade and verify the memory:

    with flasher.connect(interface="socketcan", channel="can0") as connection:
        battery = connection.device("bms")
        print(battery.read(flasher.contents.RunningInformation).voltage_mv)
        battery.write("user-string-1", "checked 2026-01")
        battery.flash("firmware.hex", verify="memory", on_event=print)

With an event loop:

    async def main():
        async with flasher.aconnect(interface="socketcan", channel="can0") as connection:
            await connection.async_device("bms").flash("firmware.hex")

Every failure is a `FlasherError` with an exit code, a likely cause and a remedy. Progress is
reported by the dataclasses of `flasher.events`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flasher import errors, events
    from flasher.api import (
        AsyncDevice,
        Connection,
        Device,
        DeviceInfo,
        DeviceLeft,
        Ending,
        Identity,
        Image,
        Level,
        Outcome,
        Plan,
        Profile,
        Result,
        UpgradeOptions,
        Verification,
        WriteResult,
        aconnect,
        connect,
        connect_mock,
        flash,
        load,
        make_plan,
    )
    from flasher.errors import ExitCode, FlasherError
    from flasher.protocol import contents

__version__ = "0.1.0"
__all__ = [
    "flash",
    "connect",
    "aconnect",
    "connect_mock",
    "load",
    "make_plan",
    "AsyncDevice",
    "Connection",
    "Device",
    "DeviceInfo",
    "DeviceLeft",
    "Ending",
    "ExitCode",
    "FlasherError",
    "Identity",
    "Image",
    "Level",
    "Outcome",
    "Plan",
    "Profile",
    "Result",
    "UpgradeOptions",
    "Verification",
    "WriteResult",
    "contents",
    "errors",
    "events",
]


_MODULES = {
    "contents": "flasher.protocol.contents",
    "errors": "flasher.errors",
    "events": "flasher.events",
}


if not TYPE_CHECKING:  # else every misspelled name would have the type Any

    def __getattr__(name: str) -> Any:
        """Load a name when it is first used: a process that needs a part of the package starts in a
        third of the time.
        """
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if name in _MODULES:
            value = import_module(_MODULES[name])
        else:
            is_error = name in {"ExitCode", "FlasherError"}
            value = getattr(import_module("flasher.errors" if is_error else "flasher.api"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
