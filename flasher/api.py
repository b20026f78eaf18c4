"""What a program calls: blocking functions, typed results, an event callback.

`flash` is the whole job in one call. `connect` and `upgrade` are its two halves, for who wants to
keep the adapter open or look at the outcome of a failure.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from flasher import service
from flasher.bus.bit_rate import BitRate
from flasher.bus.link import Clock, Link, MonotonicClock, PacedClock, VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.driver import Tap
from flasher.errors import FlasherError, UsageError
from flasher.flashing import run_session
from flasher.host.identity import Check, Finding, Identity, judge_image
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome, before_the_start
from flasher.host.session import Result, Session
from flasher.host.table import Ending
from flasher.host.verify import Level, possible_levels
from flasher.host.write import Written
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.manifest import Release, find_release
from flasher.image.plan import Plan, plan
from flasher.log import log_event
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile, set_option
from flasher.mock.system import System
from flasher.protocol.fields import Content
from flasher.protocol.spec import DIALECTS, TARGETS, Dialect, Target, find_target

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
    "check_level",
    "default_level",
    "as_dialect",
    "as_level",
    "as_target",
    "find_release",
    "Check",
    "Connection",
    "DeviceLeft",
    "Ending",
    "EventHandler",
    "Identity",
    "Image",
    "Level",
    "Outcome",
    "Plan",
    "Release",
    "Result",
    "UpgradeOptions",
]

EventHandler = Callable[[object], None]


@dataclass(frozen=True)
class Connection:
    """An open way to a bus, with the clock that belongs to it."""

    link: Link
    clock: Clock
    name: str
    bit_rate: BitRate | None = None
    """What the bus runs at, and where that comes from; None where nobody told."""


@contextmanager
def connect(
    dialect: str | Dialect = "welling", *, holder: str | None = "a program", **bus: Any
) -> Iterator[Connection]:
    """Open an adapter through python-can and close it at the end.

    `bus` are python-can's own keywords (`interface`, `channel`, `bitrate`, ...); its configuration
    files and CAN_* variables hold too. The bit rate is the dialect's unless `bus` itself names
    another one. Meanwhile no other program of this user may speak as the tool on this adapter:
    `holder` is what it is told; None is for who never does so (a device model, a monitor). Raises
    UsageError or BusError.
    """
    from flasher.bus.adapter import open_adapter  # noqa: PLC0415  loads python-can

    link = open_adapter(as_dialect(dialect).bitrate_bps, holder=holder, **bus)
    try:
        yield Connection(link, MonotonicClock(), str(link), link.bit_rate)
    finally:
        link.close()


@contextmanager
def connect_mock(
    target: str | Target,
    dialect: str | Dialect = "welling",
    *,
    speed: float = 1.0,
    system: bool = False,
    has_application: bool = True,
    profile: DeviceProfile | None = None,
    on_event: EventHandler | None = None,
) -> Iterator[Connection]:
    """A bus in this process with a device model on it, or, as `system`, with a whole bicycle.

    Without an application the device sits in its bootloader, as one does whose upgrade failed.

    It takes the time that a real bus takes, divided by `speed`; 0 means no time at all. `on_event`
    gets what the device model reports.
    """
    chosen, node = as_dialect(dialect), as_target(target)
    bitrate_bps = chosen.bitrate_bps
    own = set_option(profile or DeviceProfile(), "dialect", chosen.name)
    clock: Clock = PacedClock(speed) if speed else VirtualClock()
    bus = SimulatedBus(bitrate_bps, clock)
    if system:
        bus.attach(System(chosen, node, profile=own, has_application=has_application), on_event)
    else:
        device = MockDevice(
            node, bitrate_bps=bitrate_bps, profile=own, has_application=has_application
        )
        bus.attach(device, on_event)
    rate = BitRate(bitrate_bps, "the dialect's")
    yield Connection(bus.link(), clock, "the built-in mock", rate)


def bit_rate(dialect: str | Dialect = "welling", **bus: Any) -> BitRate:
    """The bit rate that `connect` would open with; `bus` are its keywords. Opens nothing.

    Raises UsageError and BusError as `connect` does for a bit rate; where no adapter is configured,
    the one that `bus` or else the dialect names.
    """
    from flasher.bus import bit_rate as settling  # noqa: PLC0415  loads python-can
    from flasher.bus.opening import bus_config  # noqa: PLC0415

    try:
        merged = bus_config(bus)
    except FlasherError:  # none is named, or none that there is: who opens it says so
        merged = bus
    return settling.bit_rate(as_dialect(dialect).bitrate_bps, bus, merged)


def upgrade(  # noqa: PLR0913  one argument for each thing that a caller may want
    plan: Plan,
    connection: Connection,
    *,
    options: UpgradeOptions | None = None,
    verify: Level | None = None,
    identity: Identity | None = None,
    taps: Sequence[Tap] = (),
    on_event: EventHandler | None = None,
    cancelled: Callable[[], bool] | None = None,
    hung_up: Callable[[], bool] | None = None,
) -> Result:
    """Run one upgrade to its end, good or bad, and verify a good one.

    `verify` None stands for `default_level`. `identity` says what the image may be flashed to; the
    device is asked who it is and held against it before anything is written. `cancelled` is asked
    while it runs, and ends it; `hung_up` ends it only before the update command. Raises UsageError
    when the target or the image cannot be verified so, BusError when the adapter fails, saying how
    far the upgrade had come and in what state the device is left; every other end is a `Result`.
    """
    chosen = options or UpgradeOptions()
    level = default_level(plan.target, chosen) if verify is None else verify
    check_level(plan, level, chosen)
    rate = connection.bit_rate
    if rate is not None and rate.bps != plan.bitrate_bps:
        raise UsageError(
            f"The plan is for {plan.bitrate_bps / 1000:g} kbit/s, the bus runs at {rate}.",
            remedy="Make the plan with bitrate_bps of the connection.",
        )
    return run_session(
        Session(plan, chosen, level, identity or Identity()),
        connection.link,
        connection.clock,
        adapter_return_s=chosen.adapter_return_s,
        taps=taps,
        on_event=_logged(on_event),
        cancelled=cancelled,
        hung_up=hung_up,
    )


def _logged(on_event: EventHandler | None) -> EventHandler:
    def tell(event: object) -> None:
        log_event(event)
        if on_event is not None:
            on_event(event)

    return tell


def default_level(target: Target, options: UpgradeOptions | None = None) -> Level:
    """How far an upgrade of a target is verified unless somebody says otherwise: by its version
    where there is a query for it.
    """
    return Level.VERSION if Level.VERSION in possible_levels(target, options) else Level.NONE


def check_level(plan: Plan, level: Level, options: UpgradeOptions | None = None) -> None:
    """Raise UsageError when an upgrade cannot be verified so."""
    if level not in possible_levels(plan.target, options):
        raise UsageError(
            f"A {plan.target.node.name} cannot be verified by {level.value}.",
            cause="the document gives no query for it, and no profile names one",
            remedy="Leave --verify out, or use --verify none.",
        )
    if level is Level.MEMORY and plan.image.base is None:
        raise UsageError(
            "The memory cannot be read back without addresses.",
            cause=f"{plan.image.source} is a raw binary",
            remedy="Say with --base where its first byte lies.",
        )


def flash(
    image: str | os.PathLike[str] | Image,
    target: str | Target,
    *,
    dialect: str | Dialect = "welling",
    mock: bool = False,
    options: UpgradeOptions | None = None,
    verify: Level | str | None = None,
    identity: Identity | None = None,
    on_event: EventHandler | None = None,
    **bus: Any,
) -> Result:
    """Upgrade a device with an image file (or a loaded `Image`), and verify it.

    `bus` are python-can's keywords, as for `connect`; with `mock` the built-in device model is
    upgraded instead. `verify` is "none", "version" or "memory"; None chooses (`default_level`).
    `identity` None takes the manifest beside the file, if there is one, and waives no check.
    Returns the result of a good session, or of one that found nothing to do; every other one is
    raised as the FlasherError that stands for it (see flasher.errors).
    """
    loaded = image if isinstance(image, Image) else load(image)
    if identity is None:
        identity = Identity(None if isinstance(image, Image) else find_release(image))
    rate = None if mock else bit_rate(dialect, **bus).bps
    checked = release_checked(loaded, identity.release)
    planned = make_plan(checked, target, dialect, bitrate_bps=rate)
    check_image(planned, identity)
    level = None if verify is None else as_level(verify)
    opened = connect_mock(target, dialect) if mock else connect(dialect, **bus)
    with opened as connection:
        result = upgrade(
            planned,
            connection,
            options=release_options(options, identity.release),
            verify=level,
            identity=identity,
            on_event=on_event,
        )
    error = result.error()
    if error is not None:
        raise error
    return result


def release_checked(image: Image, release: Release | None) -> Image:
    """The image, with the version that its manifest gives where it names none itself.

    Raises ImageError when its bytes are not those of the manifest.
    """
    if release is None:
        return image
    release.check_bytes(image)
    return image if image.version else replace(image, version=release.firmware_version)


def release_options(options: UpgradeOptions | None, release: Release | None) -> UpgradeOptions:
    """The options, with what the manifest asks of the bootloader where they do not say it."""
    chosen = options or UpgradeOptions()
    if release is None or chosen.minimum_boot_version is not None:
        return chosen
    return replace(chosen, minimum_boot_version=release.minimum_boot_version)


def check_image(plan: Plan, identity: Identity) -> list[Finding]:
    """What an image and its manifest say of the target by themselves, without a device.

    Raises ImageError when it is hardly a program for the device, WrongDeviceError when they speak
    against the target.
    """
    findings = list(judge_image(plan.image, plan.target, identity))
    for found in findings:
        error = refusal(plan, found)
        if error is not None:
            raise error
    return findings


def refusal(plan: Plan, found: Finding) -> FlasherError | None:
    """The error for a finding that speaks against an upgrade; None for any other."""
    if found.ending is None:
        return None
    refused = before_the_start(plan, found.ending, found.detail, duration_s=0.0).error()
    if refused is not None:
        refused.where = "before anything was sent"
    return refused


def as_level(level: Level | str) -> Level:
    """A level of verification by its name. Raises UsageError."""
    try:
        return Level(level)
    except ValueError:
        names = ", ".join(each.value for each in Level)
        raise UsageError(f"There is no verification {level!r}; there are {names}.") from None


def query(
    connection: Connection,
    name: str,
    target: str | Target = "bms",
    *,
    dialect: str | Dialect = "welling",
) -> Content:
    """What a device answers to the question `name` ("version-information", "running-information",
    "serial-number", ...), as the typed content of `flasher.protocol.contents`.

    Raises NoAnswerError when it does not answer, UsageError for a name that is none.
    """
    return service.read(connection, name, as_target(target), dialect=as_dialect(dialect))


def read(
    connection: Connection, start: int, end: int, *, dialect: str | Dialect = "welling"
) -> bytes:
    """The battery's memory from `start` up to `end`, which is not read any more (R5).

    Raises NoAnswerError when some of it is not answered.
    """
    return service.read_memory(connection, start, end, dialect=as_dialect(dialect))


def write(
    connection: Connection,
    name: str,
    *values: object,
    target: str | Target = "bms",
    dialect: str | Dialect = "welling",
    manufacturer: bool = False,
) -> Written:
    """Write an item and read it back where it can be read; old and new value are in the result.

    `manufacturer` allows what the document leaves to the manufacturer. Raises UsageError for a
    value that does not fit, NoAnswerError when the write is not confirmed, VerificationError when
    it reads back differently.
    """
    return service.write(
        connection,
        name,
        *values,
        target=as_target(target),
        dialect=as_dialect(dialect),
        manufacturer=manufacturer,
    )


def make_plan(
    image: Image,
    target: str | Target,
    dialect: str | Dialect = "welling",
    *,
    bitrate_bps: int | None = None,
    has_upgrade: bool | None = None,
) -> Plan:
    """What an upgrade would send; at the dialect's bit rate unless another one is given.

    Raises UsageError for a dialect that has no upgrade, unless `has_upgrade` says that a product
    has it all the same.
    """
    chosen = as_dialect(dialect)
    if not (chosen.has_upgrade if has_upgrade is None else has_upgrade):
        raise UsageError(
            f"The {chosen.name.upper()} dialect has no upgrade: its document cancelled it.",
            remedy="Use --dialect welling if the device speaks it; a profile can enable it.",
        )
    rate = chosen.bitrate_bps if bitrate_bps is None else bitrate_bps
    return plan(image, as_target(target), rate)


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
