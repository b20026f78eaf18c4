"""What a program calls: blocking functions, typed results, an event callback.

`flash` is the whole job in one call. `connect` and `upgrade` are its two halves, for who wants to
keep the adapter open or look at the outcome of a failure.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from flasher.bus.link import Clock, Link, MonotonicClock, PacedClock, VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.device.model import Device
from flasher.device.profile import DeviceProfile
from flasher.driver import Tap, drive
from flasher.errors import BusError, UsageError
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome
from flasher.host.table import Ending
from flasher.host.upgrade import Upgrade
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan, plan
from flasher.protocol.spec import DIALECTS, TARGETS, Dialect, Target, find_target

__all__ = [
    "flash",
    "connect",
    "connect_mock",
    "load",
    "make_plan",
    "upgrade",
    "as_dialect",
    "as_target",
    "Connection",
    "DeviceLeft",
    "Ending",
    "EventHandler",
    "Image",
    "Outcome",
    "Plan",
    "UpgradeOptions",
]

EventHandler = Callable[[object], None]


@dataclass(frozen=True)
class Connection:
    """An open way to a bus, with the clock that belongs to it."""

    link: Link
    clock: Clock
    name: str


@contextmanager
def connect(dialect: str | Dialect = "welling", **bus: Any) -> Iterator[Connection]:
    """Open an adapter through python-can and close it at the end.

    `bus` are python-can's own keywords (`interface`, `channel`, `bitrate`, ...); its configuration
    files and CAN_* variables hold too. The bit rate defaults to the dialect's. Raises UsageError
    or BusError.
    """
    from flasher.bus.adapter import open_adapter  # noqa: PLC0415  loads python-can

    link = open_adapter(as_dialect(dialect).bitrate_bps, **bus)
    try:
        yield Connection(link, MonotonicClock(), str(link))
    finally:
        link.close()


@contextmanager
def connect_mock(
    target: str | Target,
    dialect: str | Dialect = "welling",
    *,
    speed: float = 1.0,
    profile: DeviceProfile | None = None,
    on_event: EventHandler | None = None,
) -> Iterator[Connection]:
    """A bus in this process with a device model on it.

    It takes the time that a real bus takes, divided by `speed`; 0 means no time at all. `on_event`
    gets what the device model reports.
    """
    bitrate_bps = as_dialect(dialect).bitrate_bps
    clock: Clock = PacedClock(speed) if speed else VirtualClock()
    bus = SimulatedBus(bitrate_bps, clock)
    device = Device(as_target(target), bitrate_bps=bitrate_bps, profile=profile or DeviceProfile())
    bus.attach(device, on_event)
    yield Connection(bus.link(), clock, "the built-in mock")


def upgrade(
    plan: Plan,
    connection: Connection,
    *,
    options: UpgradeOptions | None = None,
    taps: Sequence[Tap] = (),
    on_event: EventHandler | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> Outcome:
    """Run one upgrade to its end, good or bad; `cancelled` is asked while it runs.

    Raises BusError when the adapter fails, saying how far the upgrade had come and in what state
    the device is left; every other end is an `Outcome`.
    """
    engine = Upgrade(plan, options)
    try:
        drive(
            engine,
            connection.link,
            connection.clock,
            taps=taps,
            on_event=on_event,
            cancelled=cancelled,
        )
    except BusError as error:
        # The adapter does not know what it was used for.
        error.where = f"{engine.standing}; {error.where}"
        error.remedy = f"{error.remedy} State of the device: {engine.device_left.value}.".lstrip()
        raise
    return engine.outcome


def flash(
    image: str | os.PathLike[str] | Image,
    target: str | Target,
    *,
    dialect: str | Dialect = "welling",
    mock: bool = False,
    options: UpgradeOptions | None = None,
    on_event: EventHandler | None = None,
    **bus: Any,
) -> Outcome:
    """Upgrade a device with an image file (or a loaded `Image`).

    `bus` are python-can's keywords, as for `connect`; with `mock` the built-in device model is
    upgraded instead. Returns the outcome of a good upgrade; every other one is raised as the
    FlasherError that stands for it (see flasher.errors).
    """
    loaded = image if isinstance(image, Image) else load(image)
    planned = make_plan(loaded, target, dialect)
    opened = connect_mock(target, dialect) if mock else connect(dialect, **bus)
    with opened as connection:
        outcome = upgrade(planned, connection, options=options, on_event=on_event)
    error = outcome.error()
    if error is not None:
        raise error
    return outcome


def make_plan(
    image: Image,
    target: str | Target,
    dialect: str | Dialect = "welling",
    *,
    bitrate_bps: int | None = None,
) -> Plan:
    """What an upgrade would send; at the dialect's bit rate unless another one is given.

    Raises UsageError for a dialect that has no upgrade.
    """
    chosen = as_dialect(dialect)
    if not chosen.has_upgrade:
        raise UsageError(
            f"The {chosen.name.upper()} dialect has no upgrade: its document cancelled it.",
            remedy="Use --dialect welling if the device speaks it.",
        )
    return plan(image, as_target(target), bitrate_bps or chosen.bitrate_bps)


def as_target(target: str | Target) -> Target:
    """A target by its name or one of the documents' other names. Raises UsageError."""
    found = target if isinstance(target, Target) else find_target(target)
    if found is None:
        raise UsageError(f"There is no target {target!r}; targets are {', '.join(TARGETS)}.")
    return found


def as_dialect(dialect: str | Dialect) -> Dialect:
    """A dialect by its name. Raises UsageError."""
    found = dialect if isinstance(dialect, Dialect) else DIALECTS.get(dialect.lower())
    if found is None:
        raise UsageError(f"There is no dialect {dialect!r}; dialects are {', '.join(DIALECTS)}.")
    return found
