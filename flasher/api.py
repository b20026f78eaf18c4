"""Public API: connections to a bus, its devices, and `flash`, which upgrades a device in one call.

`Device` blocks; `AsyncDevice` runs the same methods in a thread, for programs with an event loop.
"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import partial, update_wrapper
from threading import Lock
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    Final,
    NamedTuple,
    ParamSpec,
    TypeVar,
    Unpack,
    overload,
)

from flasher.errors import FlasherError, InterruptedByUserError, UsageError
from flasher.host.identity import Identity, IdentityCheck
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome
from flasher.host.query import Request
from flasher.host.session import Result
from flasher.host.survey import Survey
from flasher.host.table import Ending
from flasher.host.verify import (
    Level,
    Verdict,
    Verification,
    as_level,
    check_level,
    default_level,
    possible_levels,
)
from flasher.host.write import WritePlan, WriteResult
from flasher.i18n import text
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan, make_plan
from flasher.jobs import Job, prepare
from flasher.procedures import CallOptions, DeviceInfo, EventHandler, Procedures
from flasher.protocol.engine import Engine
from flasher.protocol.fields import Content
from flasher.protocol.spec import Dialect, Target, as_dialect, as_target
from flasher.settings.profile import Profile

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

    from flasher.bus.bit_rate import BitRate
    from flasher.bus.fallback import Fallback
    from flasher.bus.link import Clock, Link
    from flasher.mock.profile import DeviceProfile

__all__ = [
    "flash",
    "aconnect",
    "connect",
    "connect_mock",
    "load",
    "make_plan",
    "as_dialect",
    "as_level",
    "as_target",
    "check_level",
    "default_level",
    "AsyncDevice",
    "IdentityCheck",
    "Connection",
    "Device",
    "DeviceInfo",
    "DeviceLeft",
    "Ending",
    "EventHandler",
    "Identity",
    "Image",
    "Level",
    "Outcome",
    "Plan",
    "Profile",
    "Result",
    "UpgradeOptions",
    "Verification",
    "CallOptions",
    "WriteResult",
]

T = TypeVar("T")
P = ParamSpec("P")
C = TypeVar("C", bound=Content)
_TURN_PAUSE_S: Final = 0.01
"""Interval at which a call checks whether another one has ended, and whether it was cancelled."""
_OF_DEVICE: Final = CallOptions.__annotations__.keys() | {"profile", "is_alone", "in_session"}
"""Keywords of a device and its calls that `flash` does not take, and python-can would ignore."""
_LOOP_GONE_S: Final = 5.0
"""Time without a handled event after which an event loop has ended."""


# -- the bus --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Connection:
    """Open connection to a bus, with its clock."""

    link: Link
    clock: Clock
    name: str
    bit_rate: BitRate | None = None
    """Bit rate of the bus and its source; None if unknown."""
    channel: str = ""
    """Channel of the adapter as in python-can; may be empty."""
    _turn: Lock = field(default_factory=Lock, repr=False, compare=False)
    """Held during a call: two at once would take each other's frames."""

    def renamed(self) -> Connection:
        """Return the connection with the name that its adapter came back with, after it was lost:
        another adapter may have the old one.
        """
        channel = getattr(self.link, "channel", self.channel)
        if channel == self.channel:
            return self
        return replace(self, name=str(self.link), channel=channel)

    def device(
        self,
        target: str | Target = "bms",
        *,
        dialect: str | Dialect = "welling",
        profile: Profile | None = None,
        is_alone: bool = False,
        **watch: Unpack[CallOptions],
    ) -> Device:
        """Create a device on this bus; nothing is sent yet.

        `profile` describes the product (timings, its own reset and version query), and overrides
        `target` and `dialect`. `is_alone` means that no other tool can be on this bus, so that
        queries need not listen for one first. Raises UsageError for an unknown name.
        """
        chosen = profile or _default_profile(target, dialect)
        return Device(self, chosen, is_alone=is_alone, watch=watch)

    def async_device(
        self,
        target: str | Target = "bms",
        *,
        dialect: str | Dialect = "welling",
        profile: Profile | None = None,
        is_alone: bool = False,
        **watch: Unpack[CallOptions],
    ) -> AsyncDevice:
        """Create a device for a program with an event loop; arguments as for `device`."""
        chosen = profile or _default_profile(target, dialect)
        return AsyncDevice(self, chosen, is_alone=is_alone, watch=watch)

    def listen_first(
        self, dialect: str | Dialect = "welling", **watch: Unpack[CallOptions]
    ) -> None:
        """Listen briefly for another tool. Raises BusError if one is detected."""
        with self.device("bms", dialect=dialect)._turn(watch) as steps:  # noqa: SLF001  of this module
            steps.listen_first()

    def scan(self, dialect: str | Dialect = "welling", **watch: Unpack[CallOptions]) -> Survey:
        """Listen for a second, then query version and state of the BMS; return the traffic of all
        nodes. Raises BusError; InterruptedByUserError if cancelled.
        """
        with self.device("bms", dialect=dialect)._turn(watch) as steps:  # noqa: SLF001  of this module
            return steps.scan()


def _default_profile(target: str | Target, dialect: str | Dialect) -> Profile:
    chosen = as_dialect(dialect)
    return Profile(as_target(target), chosen, has_upgrade=chosen.has_upgrade)


@contextmanager
def connect(
    dialect: str | Dialect = "welling",
    *,
    holder: str | None = "a program",
    sends: bool = True,
    fallback: Fallback | None = None,
    **bus: Any,
) -> Iterator[Connection]:
    """Open an adapter through python-can and close it at the end.

    `bus` are python-can's own keywords (`interface`, `channel`, `bitrate`, ...). Its configuration
    files and CAN_* variables apply too, and after them the `fallback`. The bit rate is the
    dialect's unless `bus` itself names another one. The adapter is locked against other programs of
    this user that send as the tool: `holder` names this program to them; None does not lock, for
    programs that never send as the tool (a device model, a monitor). A program with `sends` False
    can use an interface in listen-only mode. Raises UsageError or BusError.
    """
    from flasher.bus.adapter import open_adapter  # noqa: PLC0415  loads python-can
    from flasher.bus.link import MonotonicClock  # noqa: PLC0415

    link = open_adapter(
        as_dialect(dialect).bitrate_bps, holder=holder, sends=sends, fallback=fallback, **bus
    )
    try:
        yield Connection(link, MonotonicClock(), str(link), link.bit_rate, link.channel)
    finally:
        link.close()


@asynccontextmanager
async def aconnect(
    dialect: str | Dialect = "welling", *, holder: str | None = "a program", **bus: Any
) -> AsyncIterator[Connection]:
    """Open an adapter like `connect`, without blocking the event loop."""
    import asyncio  # noqa: PLC0415  for programs that have it already

    opened = connect(dialect, holder=holder, **bus)
    connection = await asyncio.to_thread(opened.__enter__)
    try:
        yield connection
    finally:
        await asyncio.to_thread(opened.__exit__, None, None, None)


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
    """Create a bus in this process with a device model on it, or, as `system`, with a whole
    bicycle.

    Without an application the device stays in its bootloader, as after a failed upgrade. It takes
    as long as a real bus, divided by `speed`; 0 means no time at all. `on_event` gets the events of
    the device model.
    """
    from flasher.bus.bit_rate import BitRate  # noqa: PLC0415  loads python-can
    from flasher.bus.link import SteadyClock, VirtualClock  # noqa: PLC0415
    from flasher.bus.simulated import SimulatedBus  # noqa: PLC0415
    from flasher.mock.model import MockDevice  # noqa: PLC0415
    from flasher.mock.profile import DeviceProfile  # noqa: PLC0415
    from flasher.mock.system import System  # noqa: PLC0415

    chosen, node = as_dialect(dialect), as_target(target)
    bitrate_bps = chosen.bitrate_bps
    if not speed >= 0:
        raise UsageError(f"The speed cannot be {speed}: it is 0 or more.")
    own = (profile or DeviceProfile()).speaking(chosen)
    clock: Clock = SteadyClock(speed) if speed else VirtualClock()
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


def bit_rate(
    dialect: str | Dialect = "welling", *, fallback: Fallback | None = None, **bus: Any
) -> BitRate:
    """Return the bit rate with which `connect` would open an adapter, without opening it.

    Raises UsageError for an invalid bit rate, BusError for one that differs from the dialect's.
    Without a configured adapter it is the bit rate that `bus` or else the dialect names.
    """
    from flasher.bus import bit_rate as settling  # noqa: PLC0415  loads python-can
    from flasher.bus.opening import bus_config  # noqa: PLC0415

    try:
        merged = bus_config(bus, fallback)
    except FlasherError:  # no valid adapter is named: opening it reports that
        merged = bus
    return settling.bit_rate(as_dialect(dialect).bitrate_bps, bus, merged, fallback)


# -- a device -------------------------------------------------------------------------------------


class Device:
    """Device on a bus, for blocking programs; created by `Connection.device`.

    Every method takes the keywords of `CallOptions`. It raises BusError if the adapter fails or
    another tool sends on the bus, InterruptedByUserError if `cancelled` returned True, and
    UsageError while another call is running on the connection (in another thread, or around
    `on_event`). An upgrade opens a lost adapter again; after another call,
    `connection.link.reopen()` does.
    """

    def __init__(
        self,
        connection: Connection,
        profile: Profile,
        *,
        is_alone: bool,
        watch: CallOptions,
        awaits_turn: bool = False,
    ) -> None:
        self.connection = connection
        self.profile = profile
        self._is_alone = is_alone
        self._watch = watch
        self._awaits_turn = awaits_turn
        _check_keywords(watch)

    @property
    def target(self) -> Target:
        return self.profile.target

    def plan(self, image: Image | Plan) -> Plan:
        """Plan an upgrade with this image. Raises ImageError and UsageError."""
        return self._steps({}).plan(image)

    def identify(self, **watch: Unpack[CallOptions]) -> DeviceInfo:
        """Send all documented queries; only listen if there are none.

        Silence is not an error: see `DeviceInfo.is_there`. Takes 12 s if a device sends but does
        not answer, 4 s if it is silent.
        """
        with self._turn(watch) as steps:
            return steps.identify()

    def is_present(self, **watch: Unpack[CallOptions]) -> bool:
        """True if the device sends or answers. Sends only a version query; takes up to 5 s."""
        with self._turn(watch) as steps:
            return steps.is_present()

    def version(self, **watch: Unpack[CallOptions]) -> Content:
        """Return the version information, or the answer to the product's own version query. Raises
        NoAnswerError if the device does not answer or has no version query.
        """
        with self._turn(watch) as steps:
            return steps.version()

    @overload
    def read(self, item: type[C], **watch: Unpack[CallOptions]) -> C: ...
    @overload
    def read(self, item: str, **watch: Unpack[CallOptions]) -> Content: ...
    def read(self, item: str | type[Content], **watch: Unpack[CallOptions]) -> Content:
        """Read an item by its name ("running-information"), or by the class of its content
        (`flasher.protocol.contents.RunningInformation`) if only one item has it. "model" and
        "serial-number" return the version information, which contains them.

        Raises UsageError for an unknown item, NoAnswerError if the device does not answer.
        """
        with self._turn(watch) as steps:
            return steps.read(item)

    def ask(self, request: Request, **watch: Unpack[CallOptions]) -> Content:
        """Send your own request. Raises NoAnswerError."""
        with self._turn(watch) as steps:
            return steps.ask(request)

    def read_memory(self, start: int, end: int, **watch: Unpack[CallOptions]) -> bytes:
        """Read memory from address `start` up to `end`, exclusive (R5).

        Raises UsageError for an impossible range or a target without a memory query, NoAnswerError
        if a part of the range is not answered.
        """
        with self._turn(watch) as steps:
            return steps.read_memory(start, end)

    def write(
        self,
        name: str,
        *values: object,
        manufacturer: bool = False,
        **watch: Unpack[CallOptions],
    ) -> WriteResult:
        """Write an item by name and read it back; the result has the old and the new value.

        `manufacturer` allows items that the document reserves for the manufacturer. Raises
        UsageError for a value that does not fit; NoAnswerError if the device is silent before
        anything was written; VerificationError if the write is not confirmed or reads back
        differently.
        """
        with self._turn(watch) as steps:
            return steps.write(name, values, manufacturer=manufacturer)

    def read_before_write(self, plan: WritePlan, **watch: Unpack[CallOptions]) -> Content:
        """First half of a write: read the present content."""
        with self._turn(watch) as steps:
            return steps.read_before_write(plan)

    def write_planned(
        self, plan: WritePlan, before: Content | None, **watch: Unpack[CallOptions]
    ) -> WriteResult:
        """Second half of a write: write and read back. Failures are in the result."""
        with self._turn(watch) as steps:
            return steps.write_planned(plan, before)

    def flash(
        self,
        image: str | os.PathLike[str] | Image,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | str | None = None,
        identity: Identity | None = None,
        in_session: bool = False,
        **watch: Unpack[CallOptions],
    ) -> Result:
        """Upgrade the device with an image file (or a loaded `Image`), and verify it.

        `verify` is "none", "version" or "memory"; None chooses (`default_level`). `identity` None
        uses the manifest next to the file, if any, and waives no check. With `in_session`, a silent
        device gets an update command (R26), because an interrupted upgrade may have left it in its
        transfer. Returns the result of a successful session, or of one that found nothing to do;
        raises any other as its FlasherError (see flasher.errors).
        """
        return self._carried_out(image, options, verify, identity, watch, in_session=in_session)

    def rescue(
        self,
        image: str | os.PathLike[str] | Image,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | str | None = None,
        identity: Identity | None = None,
        in_session: bool = False,
        **watch: Unpack[CallOptions],
    ) -> Result:
        """Upgrade a device whose application does not run: wait until it announces its bootloader
        at power-up, for `power_up_timeout_s` of the options, then continue like `flash`. With
        `in_session`, a silent device gets an update command first.
        """
        return self._carried_out(
            image, options, verify, identity, watch, in_session=in_session, at_power_up=True
        )

    def upgrade(
        self,
        image: Image | Plan,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | None = None,
        identity: Identity | None = None,
        **watch: Unpack[CallOptions],
    ) -> Result:
        """Run the upgrade alone and return its result, so that a failure can be examined instead of
        caught: only an adapter failure is raised.

        With `identity`, the device is identified and checked before anything is written. Raises
        UsageError if the target or the image cannot be verified at this level; BusError if the
        adapter fails, with the progress and the state of the device.
        """
        with self._turn(watch) as steps:
            return steps.upgrade(image, options, verify, identity)

    def run_job(self, job: Job, **watch: Unpack[CallOptions]) -> Result:
        """Run a prepared upgrade and return its result, a failure too; see `upgrade`."""
        return self.upgrade(
            job.plan, options=job.options, verify=job.level, identity=job.identity, **watch
        )

    def verify(
        self, image: Image | Plan, level: Level | str = Level.VERSION, **watch: Unpack[CallOptions]
    ) -> Verification:
        """Check whether the device runs an image, by its reported version or also by its memory.
        The result lists contradictions. Raises UsageError for an impossible level.
        """
        with self._turn(watch) as steps:
            return steps.verify(image, as_level(level))

    def reset(self, **watch: Unpack[CallOptions]) -> None:
        """Restart the application. Raises NoAnswerError if unconfirmed or not documented."""
        with self._turn(watch) as steps:
            steps.reset()

    def run(self, engine: Engine, **watch: Unpack[CallOptions]) -> None:
        """Run your own engine on the connection."""
        with self._turn(watch) as steps:
            steps.run(engine)

    def _carried_out(
        self,
        image: str | os.PathLike[str] | Image,
        options: UpgradeOptions | None,
        verify: Level | str | None,
        identity: Identity | None,
        watch: CallOptions,
        *,
        in_session: bool,
        at_power_up: bool = False,
    ) -> Result:
        rate = self.connection.bit_rate
        job = prepare(
            image,
            self.profile,
            bitrate_bps=None if rate is None else rate.bps,
            options=options,
            verify=verify,
            identity=identity,
            at_power_up=at_power_up,
        ).checked()
        if in_session:
            job = job.in_session()
        return _check_result(self.run_job(job, **watch))

    def _steps(self, watch: CallOptions) -> Procedures:
        link, clock, rate = self.connection.link, self.connection.clock, self.connection.bit_rate
        return Procedures(link, clock, self.profile, rate, self._is_alone, watch)

    @contextmanager
    def _turn(self, of_call: CallOptions) -> Iterator[Procedures]:
        """Run a call while no other call is running on the connection."""
        _check_keywords(of_call)
        watch: CallOptions = {**self._watch, **of_call}
        turn = self.connection._turn  # noqa: SLF001  of this module
        cancelled = watch.get("cancelled")
        while not turn.acquire(timeout=_TURN_PAUSE_S if self._awaits_turn else 0):
            if not self._awaits_turn:
                raise UsageError(
                    f"Another call is under way on {self.connection.name}.",
                    cause="two threads use one connection, or a call is made from on_event",
                    remedy="Make one call after the other; from several tasks use async_device.",
                )
            if cancelled is not None and cancelled():
                raise InterruptedByUserError("Interrupted by the user.")
        try:
            yield self._steps(watch)
        finally:
            turn.release()


def _check_keywords(watch: CallOptions) -> None:
    """Raise TypeError for a keyword that is none of `CallOptions`; it would have no effect."""
    for name in watch.keys() - CallOptions.__annotations__.keys():
        raise TypeError(f"unexpected keyword argument {name!r}")


def _in_thread(
    method: Callable[Concatenate[Device, P], T],
) -> Callable[Concatenate[AsyncDevice, P], Coroutine[Any, Any, T]]:
    """Adapt a method of `Device` for `AsyncDevice`."""

    async def call(self: AsyncDevice, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._call(method, *args, **kwargs)

    update_wrapper(call, method)
    return call


class AsyncDevice:
    """`Device` for programs with an event loop; created by `Connection.async_device`. Every method
    runs that of `Device` in a thread. `on_event` is called in the event loop, and the thread waits
    for it; `taps` and `cancelled` are called in the thread. A cancelled task ends at the next
    message boundary first; a write that has begun is read back. Concurrent calls on one connection
    wait for each other.
    """

    def __init__(
        self, connection: Connection, profile: Profile, *, is_alone: bool, watch: CallOptions
    ) -> None:
        self.connection = connection
        self.profile = profile
        self._watch = watch
        self._device = Device(connection, profile, is_alone=is_alone, watch=watch, awaits_turn=True)

    @property
    def target(self) -> Target:
        return self.profile.target

    def plan(self, image: Image | Plan) -> Plan:
        """Plan an upgrade with this image. Raises ImageError and UsageError."""
        return self._device.plan(image)

    identify = _in_thread(Device.identify)
    is_present = _in_thread(Device.is_present)
    version = _in_thread(Device.version)
    ask = _in_thread(Device.ask)
    read_memory = _in_thread(Device.read_memory)
    write = _in_thread(Device.write)
    read_before_write = _in_thread(Device.read_before_write)
    write_planned = _in_thread(Device.write_planned)
    flash = _in_thread(Device.flash)
    rescue = _in_thread(Device.rescue)
    upgrade = _in_thread(Device.upgrade)
    run_job = _in_thread(Device.run_job)
    verify = _in_thread(Device.verify)
    reset = _in_thread(Device.reset)
    run = _in_thread(Device.run)

    @overload
    async def read(self, item: type[C], **watch: Unpack[CallOptions]) -> C: ...
    @overload
    async def read(self, item: str, **watch: Unpack[CallOptions]) -> Content: ...
    async def read(self, item: str | type[Content], **watch: Unpack[CallOptions]) -> Content:
        """Read an item; see `Device.read`."""
        return await self._call(Device.read, item, **watch)

    async def _call(self, method: Callable[..., T], *args: object, **kwargs: Any) -> T:
        import asyncio  # noqa: PLC0415  for programs that have it already
        from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

        watch = {**self._watch, **kwargs}
        loop = asyncio.get_running_loop()
        bridge = _LoopBridge(loop, watch.get("on_event"), watch.get("cancelled"))
        kwargs["cancelled"] = bridge.is_cancelled
        if bridge.on_event is not None:
            kwargs["on_event"] = bridge.handle_in_loop
        call = partial(copy_context().run, method, self._device, *args, **kwargs)
        # Its own thread, because the loop has few and a call may take minutes. Not a task, because
        # the end of the loop would cancel it before the call has ended.
        thread = ThreadPoolExecutor(1, "flasher-call")
        work = loop.run_in_executor(thread, call)
        thread.shutdown(wait=False)
        while not work.done():
            try:
                await asyncio.wait([work])
            except asyncio.CancelledError:
                bridge.task_is_cancelled = True
        if bridge.task_is_cancelled:
            raise asyncio.CancelledError from work.exception()
        return work.result()


@dataclass
class _LoopBridge:
    """Connects a call in a thread with the event loop that awaits it."""

    loop: AbstractEventLoop
    on_event: EventHandler | None
    cancelled: Callable[[], bool] | None
    task_is_cancelled: bool = False
    loop_is_gone: bool = False

    def is_cancelled(self) -> bool:
        """True if task, loop or caller cancelled the call; called in the thread."""
        if self.task_is_cancelled or self.loop_is_gone or self.loop.is_closed():
            return True
        return self.cancelled is not None and self.cancelled()

    def handle_in_loop(self, event: object) -> None:
        """Handle an event in the loop, and wait for that. Raises exceptions of the handler."""
        from concurrent.futures import Future, wait  # noqa: PLC0415  only needed with a loop

        handled: Future[None] = Future()

        def handle() -> None:
            try:
                if self.on_event is not None:
                    self.on_event(event)
            except BaseException as error:  # noqa: BLE001  raised in the thread
                handled.set_exception(error)
            else:
                handled.set_result(None)

        with suppress(RuntimeError):  # it has been closed
            self.loop.call_soon_threadsafe(handle)
        while not (self.loop_is_gone or self.loop.is_closed()):
            if wait([handled], _LOOP_GONE_S).done:
                handled.result()
                return
            self.loop_is_gone = not self.loop.is_running()


# -- in one call ----------------------------------------------------------------------------------


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
    """Upgrade a device in one call: open the bus, run `Device.flash`, close the bus.

    `bus` are python-can's keywords, as for `connect`; `mock` upgrades the built-in device model
    instead. An unusable image is refused before the bus is opened.
    """
    for name in bus.keys() & _OF_DEVICE:
        raise TypeError(f"flash() does not take {name!r}: use a device of `connect`")
    profile = _default_profile(target, dialect)
    job = prepare(
        image,
        profile,
        bitrate_bps=None if mock else bit_rate(dialect, **bus).bps,
        options=options,
        verify=verify,
        identity=identity,
    ).checked()
    opened = connect_mock(target, dialect) if mock else connect(dialect, **bus)
    with opened as connection:
        device = connection.device(profile=profile)
        return _check_result(device.run_job(job, on_event=on_event))


def _check_result(result: Result) -> Result:
    """Return a successful result; raise the error of any other."""
    error = result.error()
    if error is not None:
        raise error
    return result


class Comparison(NamedTuple):
    """Comparison of a device with an image, without an upgrade."""

    verification: Verification
    memory_not_compared: str | None
    """Reason why the memory was not compared; None if it was."""


def compare(
    device: Device,
    plan: Plan,
    options: UpgradeOptions,
    level: Level | str | None = None,
    **watch: Unpack[CallOptions],
) -> Comparison:
    """Compare what a device runs with an image: by `level`, else by its version, and by its memory
    where that can be read. Nothing is written or reset. Raises UsageError for an impossible level.
    """
    chosen, unread = _comparable(plan, options) if level is None else (as_level(level), None)
    if level is not None and chosen is Level.VERSION:
        unread = text("as requested")
    check_level(plan, chosen, options)
    found = device.verify(plan, chosen, **watch)
    if level is None and found.running_version and found.verdict is Verdict.NO_ANSWER:
        unread = text("no answer {detail}", detail=found.detail)
        is_named = plan.image.version is not None and plan.image.version == found.running_version
        verdict = Verdict.VERSION_RIGHT if is_named else Verdict.VERSION_UNJUDGED
        found = replace(found, level=Level.VERSION, verdict=verdict, detail="")
    if found.level is Level.VERSION and not found.ok:
        unread = text("the version decides already")
    return Comparison(found, unread)


def _comparable(plan: Plan, options: UpgradeOptions) -> tuple[Level, str | None]:
    """Return the highest level, and the reason why the memory is not to be compared."""
    if Level.MEMORY not in possible_levels(plan.target, options):
        why = text(
            "the documents give no way to read that of the {node}", node=plan.target.node.name
        )
        return Level.VERSION, why
    if plan.image.base is None:
        return Level.VERSION, text("a raw binary has no addresses")
    return Level.MEMORY, None
