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
        result = flasher.upgrade(plan, connection)
    print(result.outcome.ending, result.outcome.device_left, result.error())

What the battery says of itself, as dataclasses with units in their names:

    with flasher.connect(interface="socketcan", channel="can0") as connection:
        print(flasher.query(connection, "running-information").voltage_mv)
        flasher.write(connection, "user-string-1", "checked 2026-01")

Every failure is a `FlasherError` with its exit code, its likely cause and what to do; what happens
meanwhile comes as the dataclasses of `flasher.events`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flasher import events
    from flasher.api import (
        Connection,
        DeviceLeft,
        Ending,
        Identity,
        Image,
        Level,
        Outcome,
        Plan,
        Result,
        UpgradeOptions,
        connect,
        connect_mock,
        flash,
        load,
        make_plan,
        query,
        read,
        upgrade,
        write,
    )
    from flasher.errors import ExitCode, FlasherError

__all__ = [
    "flash",
    "connect",
    "connect_mock",
    "load",
    "make_plan",
    "query",
    "read",
    "upgrade",
    "write",
    "Connection",
    "DeviceLeft",
    "Ending",
    "ExitCode",
    "FlasherError",
    "Identity",
    "Image",
    "Level",
    "Outcome",
    "Plan",
    "Result",
    "UpgradeOptions",
    "events",
]

_ELSEWHERE = {"ExitCode": "errors", "FlasherError": "errors"}


def __getattr__(name: str) -> Any:
    """Load what is asked for when it is asked for: pytest imports this package in every project
    that has flasher installed, for its plugin, and must not wait for the rest.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "events":
        return importlib.import_module("flasher.events")
    return getattr(importlib.import_module(f"flasher.{_ELSEWHERE.get(name, 'api')}"), name)
