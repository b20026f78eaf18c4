"""Firmware upgrades for the Welling mid-drive e-bike system over CAN.

The whole job:

    result = flasher.flash("firmware.hex", "bms", interface="socketcan", channel="can0")
    print(result.running_version)

The same without hardware, with something to look at while it runs:

    flasher.flash("firmware.hex", "bms", mock=True, on_event=print)

What would be sent, and how long it takes on the bus:

    plan = flasher.make_plan(flasher.load("firmware.hex"), "bms")
    print(plan.total_packets, plan.wire_s)

In two steps, to look at a failure instead of catching it:

    with flasher.connect(interface="pcan", channel="PCAN_USBBUS1") as connection:
        result = connection.device("bms").upgrade(plan)
    print(result.outcome.ending, result.outcome.device_left, result.error())

A device on a bus: what it says of itself, typed, with units in the names; its memory; writing:

    with flasher.connect(interface="socketcan", channel="can0") as connection:
        battery = connection.device("bms")
        print(battery.read(flasher.contents.RunningInformation).voltage_mv)
        battery.write("user-string-1", "checked 2026-01")
        battery.flash("firmware.hex", verify="memory", on_event=print)

With an event loop:

    async def main():
        async with flasher.aconnect(interface="socketcan", channel="can0") as connection:
            await connection.async_device("bms").flash("firmware.hex")

Every failure is a `FlasherError` with its exit code, its likely cause and what to do; what happens
meanwhile comes as the dataclasses of `flasher.events`.
"""

from flasher import events
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
    "events",
]
