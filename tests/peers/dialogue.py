"""What the tests of the two referees share: one dialogue between them, and how it has to end."""

from __future__ import annotations

import random
from dataclasses import fields
from typing import Any, Final

from .scripted_device import DeviceScript, ScriptedDevice
from .scripted_host import HostScript, Limits, ScriptedHost
from .virtual_wire import run

TARGETS: Final = ["wmc", "bms", "obc"]
IMAGE: Final = random.Random(11).randbytes(10 * 128 - 3)


def strays(parameter: object) -> str | None:
    """What a script has that a plain one has not, as a test's name."""
    if not isinstance(parameter, DeviceScript | HostScript):
        return None
    plain = type(parameter)()
    return " ".join(
        f"{one.name}={getattr(parameter, one.name)}"
        for one in fields(parameter)
        if getattr(parameter, one.name) != getattr(plain, one.name)
    )


def upgrade(
    device: DeviceScript | None = None,
    host: HostScript | None = None,
    *,
    image: bytes = IMAGE,
    target: str = "bms",
    limits: Limits | None = None,
    **device_options: Any,
) -> tuple[ScriptedHost, ScriptedDevice]:
    """One upgrade on the virtual wire, and a second more so that the application can start."""
    scripted_device = ScriptedDevice(target, device, **device_options)
    scripted_host = ScriptedHost(target, image, host, limits)
    run(scripted_host, scripted_device, linger_s=1.0)
    return scripted_host, scripted_device


def assert_upgraded(host: ScriptedHost, device: ScriptedDevice, image: bytes = IMAGE) -> None:
    assert host.outcome == "complete"
    assert device.image == image
    assert device.completed
    assert device.state == "application"
