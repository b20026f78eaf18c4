"""What a program calls: a connection, the devices on it, and `flash`, the whole job in one call.

`Device` blocks; `AsyncDevice` is the same in a thread, for programs with an event loop.
"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, update_wrapper
from threading import Lock
from typing import (
    TYPE_CHECKING,
    Any,
    Concatenate,
    Final,
    ParamSpec,
    TypeVar,
    Unpack,
    overload,
)

from flasher.errors import FlasherError, InterruptedByUserError, UsageError
from flasher.host import waivers
from flasher.host.identity import WAIVABLE, CheckResult, Identity, IdentityCheck, judge_image
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome, ended_before_start
from flasher.host.query import Request
from flasher.host.session import Result
from flasher.host.survey import Survey
from flasher.host.table import Ending
from flasher.host.verify import Level, Verification, as_level, check_level, default_level
from flasher.host.write import WritePlan, WriteResult
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan, make_plan
from flasher.image.release import Release
from flasher.procedures import DeviceInfo, EventHandler, Procedures, Watch, plan_for
from flasher.protocol.engine import Engine
from flasher.protocol.fields import Content
from flasher.protocol.spec import Dialect, Target, as_dialect, as_target
from flasher.settings.manifest import find_release
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
    "prepare",
    "find_release",
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
    "Job",
    "Level",
    "Outcome",
    "Plan",
    "Profile",
    "Release",
    "Result",
    "UpgradeOptions",
    "Verification",
    "Watch",
    "WriteResult",
]

T = TypeVar("T")
P = ParamSpec("P")
C = TypeVar("C", bound=Content)
_TURN_PAUSE_S: Final = 0.01
"""Between two looks whether the call of another task has ended, and whether this one is over."""
_LOOP_GONE_S: Final = 5.0
"""An event loop that was left alone for so long with an event in its hands is not coming back."""


# -- the bus --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Connection:
    """An open way to a bus, with the clock that belongs to it."""

    link: Link
    clock: Clock
    name: str
    bit_rate: BitRate | None = None
    """What the bus runs at, and where that comes from; None where that is not known."""
    channel: str = ""
    """The adapter's, as python-can has it; empty where there is none."""
    _turn: Lock = field(default_factory=Lock, init=False, repr=False, compare=False)
    """Held by the call that is under way: two at once would take each other's frames."""

    def device(
        self,
        target: str | Target = "bms",
        *,
        dialect: str | Dialect = "welling",
        profile: Profile | None = None,
        is_alone: bool = False,
        **watch: Unpack[Watch],
    ) -> Device:
        """A device on this bus. Nothing is sent yet.

        `profile` is what holds for the product (its timings, its own reset and version query); it
        goes before `target` and `dialect`. With `is_alone` no other tool can be on this bus, and
        none is listened for before a question. Raises UsageError for a name that is none.
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
        **watch: Unpack[Watch],
    ) -> AsyncDevice:
        """The same for a program with an event loop."""
        chosen = profile or _default_profile(target, dialect)
        return AsyncDevice(self, chosen, is_alone=is_alone, watch=watch)

    def listen_first(self, dialect: str | Dialect = "welling", **watch: Unpack[Watch]) -> None:
        """Listen for a moment for another tool, as every question does before it is sent. Raises
        BusError when there is one.
        """
        with self.device("bms", dialect=dialect)._turn(watch) as steps:  # noqa: SLF001  of this module
            steps.listen_first()

    def scan(self, dialect: str | Dialect = "welling", **watch: Unpack[Watch]) -> Survey:
        """Listen for a second, then ask the BMS for its version and state: who was heard, with
        what. Raises BusError, and InterruptedByUserError when it was cancelled.
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

    `bus` are python-can's own keywords (`interface`, `channel`, `bitrate`, ...); its configuration
    files and CAN_* variables hold too, and behind them the `fallback`. The bit rate is the
    dialect's unless `bus` itself names another one. Meanwhile no other program of this user may
    speak as the tool on this adapter: `holder` names this program to them; None does not lock the
    adapter, for programs that never speak as the tool (a device model, a monitor). A program that
    never `sends` can use an interface that only listens. Raises UsageError or BusError.
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
    """`connect` without blocking an event loop while the adapter opens and closes."""
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
    """A bus in this process with a device model on it, or, as `system`, with a whole bicycle.

    Without an application the device sits in its bootloader, as one does whose upgrade failed.

    It takes the time that a real bus takes, divided by `speed`; 0 means no time at all. `on_event`
    gets what the device model reports.
    """
    from flasher.bus.bit_rate import BitRate  # noqa: PLC0415  loads python-can
    from flasher.bus.link import PacedClock, VirtualClock  # noqa: PLC0415
    from flasher.bus.simulated import SimulatedBus  # noqa: PLC0415
    from flasher.mock.model import MockDevice  # noqa: PLC0415
    from flasher.mock.profile import DeviceProfile  # noqa: PLC0415
    from flasher.mock.system import System  # noqa: PLC0415

    chosen, node = as_dialect(dialect), as_target(target)
    bitrate_bps = chosen.bitrate_bps
    own = (profile or DeviceProfile()).speaking(chosen)
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


def bit_rate(
    dialect: str | Dialect = "welling", *, fallback: Fallback | None = None, **bus: Any
) -> BitRate:
    """The bit rate that `connect` would open with; all arguments are its own. Opens nothing.

    Raises UsageError and BusError as `connect` does for a bit rate; where no adapter is configured,
    the one that `bus` or else the dialect names.
    """
    from flasher.bus import bit_rate as settling  # noqa: PLC0415  loads python-can
    from flasher.bus.opening import bus_config  # noqa: PLC0415

    try:
        merged = bus_config(bus, fallback)
    except FlasherError:  # none is named, or none that there is: who opens it says so
        merged = bus
    return settling.bit_rate(as_dialect(dialect).bitrate_bps, bus, merged, fallback)


# -- a device -------------------------------------------------------------------------------------


class Device:
    """A device on a bus, for programs that wait for it; made by `Connection.device`.

    Every method takes the keywords of `Watch`, and raises BusError when the adapter fails or
    another tool speaks on the bus, InterruptedByUserError when `cancelled` said so, UsageError
    while another call is under way on the connection (in another thread, or around `on_event`).
    """

    def __init__(
        self,
        connection: Connection,
        profile: Profile,
        *,
        is_alone: bool,
        watch: Watch,
        awaits_turn: bool = False,
    ) -> None:
        self.connection = connection
        self.profile = profile
        self._is_alone = is_alone
        self._watch = watch
        self._awaits_turn = awaits_turn

    @property
    def target(self) -> Target:
        """Which device it is."""
        return self.profile.target

    def plan(self, image: Image | Plan) -> Plan:
        """What an upgrade with this image would send. Raises ImageError and UsageError."""
        return self._steps({}).plan(image)

    def identify(self, **watch: Unpack[Watch]) -> DeviceInfo:
        """Ask it everything that the documents let one ask; listen only where they give nothing.

        Silence is no error: see `DeviceInfo.is_there`. Takes 12 s when nothing is answered by a
        device that is heard, 4 s when it is not heard either.
        """
        with self._turn(watch) as steps:
            return steps.identify()

    def is_heard(self, **watch: Unpack[Watch]) -> bool:
        """True when it sends a message, or answers a question for its version: nothing else is sent
        to it. Takes 5 s at the most.
        """
        with self._turn(watch) as steps:
            return steps.is_heard()

    def version(self, **watch: Unpack[Watch]) -> Content:
        """Its version information, or the answer to the product's own version query. Raises
        NoAnswerError when it does not answer, or nobody knows how to ask it.
        """
        with self._turn(watch) as steps:
            return steps.version()

    @overload
    def read(self, what: type[C], **watch: Unpack[Watch]) -> C: ...
    @overload
    def read(self, what: str, **watch: Unpack[Watch]) -> Content: ...
    def read(self, what: str | type[Content], **watch: Unpack[Watch]) -> Content:
        """Read an item: by its name ("running-information"), or by the class of its content
        (`flasher.protocol.contents.RunningInformation`), where only one item has it. "model" and
        "serial-number" give the version information, which holds them.

        Raises UsageError for what is not there, NoAnswerError when it does not answer.
        """
        with self._turn(watch) as steps:
            return steps.read(what)

    def ask(self, request: Request, **watch: Unpack[Watch]) -> Content:
        """Ask a question of your own. Raises NoAnswerError."""
        with self._turn(watch) as steps:
            return steps.ask(request)

    def read_memory(self, start: int, end: int, **watch: Unpack[Watch]) -> bytes:
        """The bytes from address `start` up to `end`, which is not read any more (R5).

        Raises UsageError for an impossible range and for a target whose memory the documents do not
        let one read, NoAnswerError when a piece is not answered.
        """
        with self._turn(watch) as steps:
            return steps.read_memory(start, end)

    def write(
        self,
        name: str,
        *values: object,
        manufacturer: bool = False,
        **watch: Unpack[Watch],
    ) -> WriteResult:
        """Write an item by name and read it back; old and new value are in the result.

        `manufacturer` allows what the document leaves to the manufacturer. Raises UsageError for a
        value that does not fit, NoAnswerError when the device is silent before anything was
        written, VerificationError when the write is not confirmed or reads back differently.
        """
        with self._turn(watch) as steps:
            return steps.write(name, values, manufacturer=manufacturer)

    def content_before(self, plan: WritePlan, **watch: Unpack[Watch]) -> Content:
        """The first half of a write: what the device holds now."""
        with self._turn(watch) as steps:
            return steps.content_before(plan)

    def carry_out(
        self, plan: WritePlan, before: Content | None, **watch: Unpack[Watch]
    ) -> WriteResult:
        """The second half: write and read back. What went wrong stands in the result."""
        with self._turn(watch) as steps:
            return steps.carry_out(plan, before)

    def flash(
        self,
        image: str | os.PathLike[str] | Image,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | str | None = None,
        identity: Identity | None = None,
        in_session: bool = False,
        **watch: Unpack[Watch],
    ) -> Result:
        """Upgrade it with an image file (or a loaded `Image`), and verify it.

        `verify` is "none", "version" or "memory"; None chooses (`default_level`). `identity` None
        takes the manifest beside the file, if there is one, and waives no check. With `in_session`
        a device that answers nothing gets an update command (R26): an upgrade of it was broken off,
        and it may still wait in it. Returns the result of a good session, or of one that found
        nothing to do; every other one is raised as the FlasherError that stands for it (see
        flasher.errors).
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
        **watch: Unpack[Watch],
    ) -> Result:
        """`flash` for a device whose application does not run: waits until it announces its
        bootloader at power-up, for `power_up_timeout_s` of the options, and upgrades it then. With
        `in_session` it is looked for as by `flash` before.
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
        **watch: Unpack[Watch],
    ) -> Result:
        """The upgrade alone, to look at a failure instead of catching it: every end but that of the
        adapter is a `Result`.

        `identity` says what the image may be flashed to; the device is asked who it is and held
        against it before anything is written. Raises UsageError when the target or the image cannot
        be verified so, BusError when the adapter fails, saying how far the upgrade had come and in
        what state the device is left.
        """
        with self._turn(watch) as steps:
            return steps.upgrade(image, options, verify, identity)

    def verify(
        self, image: Image | Plan, level: Level | str = Level.VERSION, **watch: Unpack[Watch]
    ) -> Verification:
        """Whether it runs this image: by the version that it names, or by its memory too. What
        speaks against it stands in the result. Raises UsageError for a level that is not possible.
        """
        with self._turn(watch) as steps:
            return steps.verify(image, as_level(level))

    def reset(self, **watch: Unpack[Watch]) -> None:
        """Restart its application. Raises NoAnswerError when it does not confirm, or when the
        documents give no reset for it.
        """
        with self._turn(watch) as steps:
            steps.reset()

    def run(self, engine: Engine, **watch: Unpack[Watch]) -> None:
        """Run an engine of your own on the connection."""
        with self._turn(watch) as steps:
            steps.run(engine)

    def _carried_out(
        self,
        image: str | os.PathLike[str] | Image,
        options: UpgradeOptions | None,
        verify: Level | str | None,
        identity: Identity | None,
        watch: Watch,
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
        return _good(job.run(self, **watch))

    def _steps(self, watch: Watch) -> Procedures:
        link, clock, rate = self.connection.link, self.connection.clock, self.connection.bit_rate
        return Procedures(link, clock, self.profile, rate, self._is_alone, watch)

    @contextmanager
    def _turn(self, of_call: Watch) -> Iterator[Procedures]:
        """What a call does, while no other call is under way on the connection."""
        watch: Watch = {**self._watch, **of_call}
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


def _in_thread(
    method: Callable[Concatenate[Device, P], T],
) -> Callable[Concatenate[AsyncDevice, P], Coroutine[Any, Any, T]]:
    """A method of `Device` for `AsyncDevice`."""

    async def call(self: AsyncDevice, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._call(method, *args, **kwargs)

    update_wrapper(call, method)
    return call


class AsyncDevice:
    """`Device` for programs with an event loop; made by `Connection.async_device`. Every method is
    that of `Device`, in a thread. `on_event` is called in the event loop, and the thread waits for
    it; `taps` and `cancelled` are called in the thread. A task that is cancelled ends at the next
    message boundary first; a write that was begun is read back. Calls of several tasks on one
    connection wait for each other.
    """

    def __init__(
        self, connection: Connection, profile: Profile, *, is_alone: bool, watch: Watch
    ) -> None:
        self.connection = connection
        self.profile = profile
        self._watch = watch
        self._device = Device(connection, profile, is_alone=is_alone, watch=watch, awaits_turn=True)

    @property
    def target(self) -> Target:
        """Which device it is."""
        return self.profile.target

    def plan(self, image: Image | Plan) -> Plan:
        """What an upgrade with this image would send. Raises ImageError and UsageError."""
        return self._device.plan(image)

    identify = _in_thread(Device.identify)
    is_heard = _in_thread(Device.is_heard)
    version = _in_thread(Device.version)
    ask = _in_thread(Device.ask)
    read_memory = _in_thread(Device.read_memory)
    write = _in_thread(Device.write)
    content_before = _in_thread(Device.content_before)
    carry_out = _in_thread(Device.carry_out)
    flash = _in_thread(Device.flash)
    rescue = _in_thread(Device.rescue)
    upgrade = _in_thread(Device.upgrade)
    verify = _in_thread(Device.verify)
    reset = _in_thread(Device.reset)
    run = _in_thread(Device.run)

    @overload
    async def read(self, what: type[C], **watch: Unpack[Watch]) -> C: ...
    @overload
    async def read(self, what: str, **watch: Unpack[Watch]) -> Content: ...
    async def read(self, what: str | type[Content], **watch: Unpack[Watch]) -> Content:
        """Read an item, as `Device.read` does."""
        return await self._call(Device.read, what, **watch)

    async def _call(self, method: Callable[..., T], *args: object, **kwargs: Any) -> T:
        import asyncio  # noqa: PLC0415  for programs that have it already
        from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

        watch = {**self._watch, **kwargs}
        loop = asyncio.get_running_loop()
        hand = _Hand(loop, watch.get("on_event"), watch.get("cancelled"))
        kwargs["cancelled"] = hand.is_cancelled
        if hand.on_event is not None:
            kwargs["on_event"] = hand.over
        call = partial(copy_context().run, method, self._device, *args, **kwargs)
        # A thread of its own: the loop's are few, and a call may take minutes. And not as a task,
        # which the end of the loop would cancel before the call has ended.
        thread = ThreadPoolExecutor(1, "flasher-call")
        work = loop.run_in_executor(thread, call)
        thread.shutdown(wait=False)
        while not work.done():
            try:
                await asyncio.wait([work])
            except asyncio.CancelledError:
                hand.task_is_cancelled = True
        if hand.task_is_cancelled:
            raise asyncio.CancelledError from work.exception()
        return work.result()


@dataclass
class _Hand:
    """Between a call in a thread and the event loop that awaits it."""

    loop: AbstractEventLoop
    on_event: EventHandler | None
    cancelled: Callable[[], bool] | None
    task_is_cancelled: bool = False
    loop_is_gone: bool = False

    def is_cancelled(self) -> bool:
        """Asked in the thread."""
        if self.task_is_cancelled or self.loop_is_gone or self.loop.is_closed():
            return True
        return self.cancelled is not None and self.cancelled()

    def over(self, event: object) -> None:
        """Have the loop handle an event, and wait for that in the thread: as long as there is a
        loop. Raises what the handler raised.
        """
        from concurrent.futures import Future, wait  # noqa: PLC0415  no use without a loop

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


# -- an image for a device ------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """An upgrade as it was prepared without the device: what `flash`, the bench page and the
    station run.
    """

    plan: Plan
    options: UpgradeOptions
    level: Level
    identity: Identity
    waived: tuple[str, ...] = ()
    """Names of the checks that somebody has waived (flasher.host.waivers)."""

    @cached_property
    def checks(self) -> tuple[CheckResult, ...]:
        """What the image and its manifest say of the target by themselves."""
        return tuple(judge_image(self.plan.image, self.plan.target, self.identity))

    def checked(self) -> Job:
        """The same. Raises ImageError when the image is hardly a program for the device,
        WrongDeviceError when it or its manifest speaks against the target, UsageError when the
        upgrade cannot be verified so.
        """
        for found in self.checks:
            error = refusal(self.plan, found)
            if error is not None:
                raise error
        check_level(self.plan, self.level, self.options)
        return self

    def in_session(self) -> Job:
        """The same for a device that an earlier upgrade may have left in its session (R26)."""
        return replace(self, options=replace(self.options, in_session=True))

    def run(self, device: Device, **watch: Unpack[Watch]) -> Result:
        """To its end, good or bad, as `Device.upgrade`."""
        return device.upgrade(
            self.plan,
            options=self.options,
            verify=self.level,
            identity=self.identity,
            **watch,
        )


def prepare(
    image: str | os.PathLike[str] | Image,
    profile: Profile,
    *,
    bitrate_bps: int | None = None,
    options: UpgradeOptions | None = None,
    verify: Level | str | None = None,
    identity: Identity | None = None,
    at_power_up: bool = False,
    waived: Iterable[str] = (),
) -> Job:
    """What an upgrade settles before a bus is needed: load, plan, and choose what is left open.
    Nothing speaks against it once it was `Job.checked`.

    `waived` names checks of flasher.host.waivers; what `identity` and `options` say goes before it.
    Raises ImageError and UsageError.
    """
    names = frozenset(waived)
    if isinstance(image, Image):
        loaded, beside = image, None
    else:
        loaded = load(image, allow_outside_vector=waivers.OUTSIDE_VECTOR in names)
        beside = find_release(image) if identity is None else None
    if identity is None:
        identity = profile.identity(
            release=beside,
            waived=frozenset(check for check in WAIVABLE if check.value in names),
            goes_on_unchecked=at_power_up,
        )
    release = identity.release
    plan = plan_for(release_checked(loaded, release), profile, bitrate_bps)
    chosen = options or profile.upgrade_options(allow_boot_name=waivers.BOOT_NAME in names or None)
    if chosen.minimum_boot_version is None and release and waivers.BOOT_VERSION not in names:
        chosen = replace(chosen, minimum_boot_version=release.minimum_boot_version)
    if at_power_up:
        chosen = replace(chosen, at_power_up=True)
    level = default_level(plan.target, chosen) if verify is None else as_level(verify)
    return Job(plan, chosen, level, identity, tuple(sorted(names)))


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
    """The whole job in one call: open the bus, `Device.flash`, close it.

    `bus` are python-can's keywords, as for `connect`; with `mock` the built-in device model is
    upgraded instead. An image that cannot be flashed is refused before the bus is opened.
    """
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
        return _good(job.run(connection.device(profile=profile), on_event=on_event))


def _good(result: Result) -> Result:
    """The result of a good session. Raises the error of every other one."""
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


def refusal(plan: Plan, found: CheckResult) -> FlasherError | None:
    """The error for a finding that speaks against an upgrade; None for any other."""
    if found.ending is None:
        return None
    refused = ended_before_start(
        plan, found.ending, found.detail, duration_s=0.0, waiver=found.waiver
    ).error()
    if refused is not None:
        refused.where = "before anything was sent"
    return refused
