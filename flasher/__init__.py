"""Firmware upgrades for the Welling mid-drive e-bike system over CAN.

The whole job:

    outcome = flasher.flash("firmware.hex", "bms", interface="socketcan", channel="can0")

The same without hardware, with something to look at while it runs:

    flasher.flash("firmware.hex", "bms", mock=True, on_event=print)

What would be sent, and how long it takes on the bus:

    plan = flasher.make_plan(flasher.load("firmware.hex"), "bms")
    print(plan.total_packets, plan.wire_s)

In two steps, to look at a failure instead of catching it:

    with flasher.connect(interface="pcan", channel="PCAN_USBBUS1") as connection:
        outcome = flasher.upgrade(plan, connection)
    print(outcome.ending, outcome.device_left, outcome.error())

Every failure is a `FlasherError` with its exit code, its likely cause and what to do; what happens
meanwhile comes as the dataclasses of `flasher.events`.
"""

from flasher import events
from flasher.api import (
    Connection,
    DeviceLeft,
    Ending,
    Image,
    Outcome,
    Plan,
    UpgradeOptions,
    connect,
    connect_mock,
    flash,
    load,
    make_plan,
    upgrade,
)
from flasher.errors import ExitCode, FlasherError

__all__ = [
    "flash",
    "connect",
    "connect_mock",
    "load",
    "make_plan",
    "upgrade",
    "Connection",
    "DeviceLeft",
    "Ending",
    "ExitCode",
    "FlasherError",
    "Image",
    "Outcome",
    "Plan",
    "UpgradeOptions",
    "events",
]
