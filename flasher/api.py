"""What a program calls: a connection, the devices on it, and `flash`, the whole job in one call.

`Device` blocks; `AsyncDevice` is the same for programs with an event loop. Both run the procedures
of `flasher.procedures`.
"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, TypedDict, TypeVar, Unpack, overload

from flasher.driver import Tap, adrive, drive
from flasher.errors import FlasherError, UsageError
from flasher.host import waivers
from flasher.host.identity import WAIVABLE, Check, CheckResult, Identity, judge_image
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome, before_the_start
from flasher.host.query import Request
from flasher.host.session import Result
from flasher.host.survey import Survey
from flasher.host.table import Ending
from flasher.host.verify import Level, Verification, as_level, check_level, default_level
from flasher.host.write import WritePlan, Written
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.plan import Plan, make_plan
from flasher.image.release import Release
from flasher.log import log_event
from flasher.procedures import (
    DeviceInfo,
    Procedure,
    Procedures,
    Run,
    Step,
    Tell,
    WaitUntil,
    plan_for,
)
from flasher.protocol.engine import Engine
from flasher.protocol.fields import Content
from flasher.protocol.spec import Dialect, Target, as_dialect, as_target
from flasher.settings.manifest import find_release
from flasher.settings.profile import Profile

if TYPE_CHECKING:
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
    "Check",
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
    "Written",
]

EventHandler = Callable[[object], None]
T = TypeVar("T")
C = TypeVar("C", bound=Content)
_TURN_PAUSE_S: Final = 0.01
"""Between two looks whether the call of another task has ended."""


class Watch(TypedDict, total=False):
    """How a call is watched and ended; what is left out is as the device was made."""

    taps: Sequence[Tap]
    """See every frame in both directions."""
    on_event: EventHandler | None
    """Gets what happens, as dataclasses of `flasher.events`."""
    cancelled: Callable[[], bool] | None
    """Asked while it runs; ends it at the next message boundary."""
    hung_up: Callable[[], bool] | None
    """The same for a terminal that is gone: it does not end an upgrade that has begun to erase."""


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
        device = self.device("bms", dialect=dialect)
        device._run(device._steps.listen_first(), watch)  # noqa: SLF001  of this module

    def scan(self, dialect: str | Dialect = "welling", **watch: Unpack[Watch]) -> Survey:
        """Listen for a second, then ask the BMS for its version and state: who was heard, with
        what. Raises BusError, and InterruptedByUserError when it was cancelled.
        """
        device = self.device("bms", dialect=dialect)
        return device._run(device._steps.scan(), watch)  # noqa: SLF001  of this module


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


class _OnBus:
    """What `Device` and `AsyncDevice` share: everything but the waiting."""

    def __init__(
        self, connection: Connection, profile: Profile, *, is_alone: bool, watch: Watch
    ) -> None:
        self.connection = connection
        self.profile = profile
        self._watch = watch
        self._steps = Procedures(
            connection.link, connection.clock, profile, connection.bit_rate, is_alone
        )

    @property
    def target(self) -> Target:
        """Which device it is."""
        return self.profile.target

    def plan(self, image: Image | Plan) -> Plan:
        """What an upgrade with this image would send. Raises ImageError and UsageError."""
        return self._steps.plan(image)

    def _job(
        self,
        image: str | os.PathLike[str] | Image,
        options: UpgradeOptions | None,
        verify: Level | str | None,
        identity: Identity | None,
        *,
        in_session: bool,
        at_power_up: bool = False,
    ) -> Job:
        rate = self.connection.bit_rate
        job = prepare(
            image,
            self.profile,
            bitrate_bps=None if rate is None else rate.bps,
            options=options,
            verify=verify,
            identity=identity,
            at_power_up=at_power_up,
        )
        return job.in_session() if in_session else job

    def _cancelled(self, step: Run | WaitUntil, watch: Watch) -> Callable[[], bool] | None:
        """What ends a step before its end."""
        asked = watch.get("cancelled") or _never
        hung_up = watch.get("hung_up") or _never
        may_hang_up = step.hang_up_ends
        if isinstance(step, Run) and not step.may_cancel:
            return None
        if may_hang_up is None:
            return asked
        return lambda: asked() or (hung_up() and may_hang_up())


def _never() -> bool:
    return False


def _teller(watch: Watch, of_step: EventHandler | None = None) -> EventHandler:
    """Logs an event, and hands it to the step and to the caller."""
    handlers = [each for each in (of_step, watch.get("on_event")) if each is not None]

    def tell(event: object) -> None:
        log_event(event)
        for handle in handlers:
            handle(event)

    return tell


class Device(_OnBus):
    """A device on a bus, for programs that wait for it; made by `Connection.device`.

    Every method takes the keywords of `Watch`, and raises BusError when the adapter fails or
    another tool speaks on the bus, InterruptedByUserError when `cancelled` said so, UsageError
    while another call is under way on the connection (in another thread, or around `on_event`).
    """

    def identify(self, **watch: Unpack[Watch]) -> DeviceInfo:
        """Ask it everything that the documents let one ask; listen only where they give nothing.

        Silence is no error: see `DeviceInfo.is_there`. Takes 12 s when nothing is answered by a
        device that is heard, 4 s when it is not heard either.
        """
        return self._run(self._steps.identify(), watch)

    def is_heard(self, **watch: Unpack[Watch]) -> bool:
        """True when it sends a message, or answers a question for its version: nothing else is sent
        to it. Takes 5 s at the most.
        """
        return self._run(self._steps.is_heard(), watch)

    def version(self, **watch: Unpack[Watch]) -> Content:
        """Its version information, or the answer to the product's own version query. Raises
        NoAnswerError when it does not answer, or nobody knows how to ask it.
        """
        return self._run(self._steps.version(), watch)

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
        return self._run(self._steps.read(what), watch)

    def ask(self, request: Request, **watch: Unpack[Watch]) -> Content:
        """Ask a question of your own. Raises NoAnswerError."""
        return self._run(self._steps.ask(request), watch)

    def read_memory(self, start: int, end: int, **watch: Unpack[Watch]) -> bytes:
        """The bytes from address `start` up to `end`, which is not read any more (R5).

        Raises UsageError for an impossible range and for a target whose memory the documents do not
        let one read, NoAnswerError when a piece is not answered.
        """
        return self._run(self._steps.read_memory(start, end), watch)

    def write(
        self,
        name: str,
        *values: object,
        manufacturer: bool = False,
        **watch: Unpack[Watch],
    ) -> Written:
        """Write an item by name and read it back; old and new value are in the result.

        `manufacturer` allows what the document leaves to the manufacturer. Raises UsageError for a
        value that does not fit, NoAnswerError when the device is silent before anything was
        written, VerificationError when the write is not confirmed or reads back differently.
        """
        return self._run(self._steps.write(name, values, manufacturer=manufacturer), watch)

    def content_before(self, plan: WritePlan, **watch: Unpack[Watch]) -> Content:
        """The first half of a write: what the device holds now."""
        return self._run(self._steps.content_before(plan), watch)

    def carry_out(self, plan: WritePlan, before: Content | None, **watch: Unpack[Watch]) -> Written:
        """The second half: write and read back. What went wrong stands in the result."""
        return self._run(self._steps.carry_out(plan, before), watch)

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
        job = self._job(image, options, verify, identity, in_session=in_session)
        return _checked(self._run(job.procedure(self._steps), watch))

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
        job = self._job(image, options, verify, identity, in_session=in_session, at_power_up=True)
        return _checked(self._run(job.procedure(self._steps), watch))

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
        return self._run(self._steps.upgrade(image, options, verify, identity), watch)

    def verify(
        self, image: Image | Plan, level: Level | str = Level.VERSION, **watch: Unpack[Watch]
    ) -> Verification:
        """Whether it runs this image: by the version that it names, or by its memory too. What
        speaks against it stands in the result. Raises UsageError for a level that is not possible.
        """
        return self._run(self._steps.verify(image, as_level(level)), watch)

    def reset(self, **watch: Unpack[Watch]) -> None:
        """Restart its application. Raises NoAnswerError when it does not confirm, or when the
        documents give no reset for it.
        """
        self._run(self._steps.reset(), watch)

    def run(self, engine: Engine, **watch: Unpack[Watch]) -> None:
        """Run an engine of your own on the connection."""
        self._run(_alone(engine), watch)

    def _run(self, procedure: Procedure[T], of_call: Watch) -> T:
        turn = self.connection._turn  # noqa: SLF001  of this module
        if not turn.acquire(blocking=False):
            raise UsageError(
                f"Another call is under way on {self.connection.name}.",
                cause="two threads use one connection, or a call is made from on_event",
                remedy="Make one call after the other; from several tasks use async_device.",
            )
        try:
            return self._finished(procedure, {**self._watch, **of_call})
        finally:
            turn.release()

    def _finished(self, procedure: Procedure[T], watch: Watch) -> T:
        try:
            step = next(procedure)
            while True:
                try:
                    came = self._do(step, watch)
                except (FlasherError, KeyboardInterrupt) as error:
                    step = procedure.throw(error)
                else:
                    step = procedure.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    def _do(self, step: Step, watch: Watch) -> bool:
        link, clock = self.connection.link, self.connection.clock
        match step:
            case Run():
                drive(
                    step.engine,
                    link,
                    clock,
                    taps=(*watch.get("taps", ()), *step.taps),
                    on_event=_teller(watch, step.on_event),
                    cancelled=self._cancelled(step, watch),
                )
            case WaitUntil():
                clock.wait_until(step.moment)
                cancelled = self._cancelled(step, watch)
                return cancelled is not None and cancelled()
            case Tell():
                _teller(watch)(step.event)
        return False


class AsyncDevice(_OnBus):
    """`Device` for programs with an event loop; made by `Connection.async_device`. Every method is
    that of `Device`, awaited. A task that is cancelled ends at the next message boundary first.
    Calls of several tasks on one connection wait for each other.
    """

    async def identify(self, **watch: Unpack[Watch]) -> DeviceInfo:
        return await self._run(self._steps.identify(), watch)

    async def version(self, **watch: Unpack[Watch]) -> Content:
        return await self._run(self._steps.version(), watch)

    @overload
    async def read(self, what: type[C], **watch: Unpack[Watch]) -> C: ...
    @overload
    async def read(self, what: str, **watch: Unpack[Watch]) -> Content: ...
    async def read(self, what: str | type[Content], **watch: Unpack[Watch]) -> Content:
        return await self._run(self._steps.read(what), watch)

    async def read_memory(self, start: int, end: int, **watch: Unpack[Watch]) -> bytes:
        return await self._run(self._steps.read_memory(start, end), watch)

    async def write(
        self,
        name: str,
        *values: object,
        manufacturer: bool = False,
        **watch: Unpack[Watch],
    ) -> Written:
        return await self._run(self._steps.write(name, values, manufacturer=manufacturer), watch)

    async def flash(
        self,
        image: str | os.PathLike[str] | Image,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | str | None = None,
        identity: Identity | None = None,
        in_session: bool = False,
        **watch: Unpack[Watch],
    ) -> Result:
        import asyncio  # noqa: PLC0415  for programs that have it already

        job = await asyncio.to_thread(
            partial(self._job, image, options, verify, identity, in_session=in_session)
        )
        return _checked(await self._run(job.procedure(self._steps), watch))

    async def rescue(
        self,
        image: str | os.PathLike[str] | Image,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | str | None = None,
        identity: Identity | None = None,
        in_session: bool = False,
        **watch: Unpack[Watch],
    ) -> Result:
        import asyncio  # noqa: PLC0415  for programs that have it already

        job = await asyncio.to_thread(
            partial(
                self._job, image, options, verify, identity, in_session=in_session, at_power_up=True
            )
        )
        return _checked(await self._run(job.procedure(self._steps), watch))

    async def upgrade(
        self,
        image: Image | Plan,
        *,
        options: UpgradeOptions | None = None,
        verify: Level | None = None,
        identity: Identity | None = None,
        **watch: Unpack[Watch],
    ) -> Result:
        return await self._run(self._steps.upgrade(image, options, verify, identity), watch)

    async def verify(
        self, image: Image | Plan, level: Level | str = Level.VERSION, **watch: Unpack[Watch]
    ) -> Verification:
        return await self._run(self._steps.verify(image, as_level(level)), watch)

    async def reset(self, **watch: Unpack[Watch]) -> None:
        await self._run(self._steps.reset(), watch)

    async def _run(self, procedure: Procedure[T], of_call: Watch) -> T:
        import asyncio  # noqa: PLC0415  for programs that have it already

        turn = self.connection._turn  # noqa: SLF001  of this module
        while not turn.acquire(blocking=False):
            await asyncio.sleep(_TURN_PAUSE_S)
        try:
            return await self._finished(procedure, {**self._watch, **of_call})
        finally:
            turn.release()

    async def _finished(self, procedure: Procedure[T], watch: Watch) -> T:
        import asyncio  # noqa: PLC0415  for programs that have it already

        try:
            step = next(procedure)
            while True:
                try:
                    came = await self._do(step, watch)
                except (FlasherError, asyncio.CancelledError) as error:
                    step = procedure.throw(error)
                else:
                    step = procedure.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    async def _do(self, step: Step, watch: Watch) -> bool:
        link, clock = self.connection.link, self.connection.clock
        match step:
            case Run():
                await adrive(
                    step.engine,
                    link,
                    clock,
                    taps=(*watch.get("taps", ()), *step.taps),
                    on_event=_teller(watch, step.on_event),
                    cancelled=self._cancelled(step, watch),
                )
            case WaitUntil():
                import asyncio  # noqa: PLC0415  for programs that have it already

                await asyncio.to_thread(clock.wait_until, step.moment)
                cancelled = self._cancelled(step, watch)
                return cancelled is not None and cancelled()
            case Tell():
                _teller(watch)(step.event)
        return False


def _alone(engine: Engine) -> Procedure[None]:
    yield Run(engine)


# -- an image for a device ------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """An upgrade whose image was checked as far as it can be without the device."""

    plan: Plan
    options: UpgradeOptions
    level: Level
    identity: Identity
    checks: tuple[CheckResult, ...]
    """What was found; nothing that speaks against it."""
    waived: tuple[str, ...] = ()
    """Names of the checks that somebody has waived (flasher.host.waivers)."""

    def in_session(self) -> Job:
        """The same for a device that an earlier upgrade may have left in its session (R26)."""
        return replace(self, options=replace(self.options, in_session=True))

    def procedure(self, steps: Procedures) -> Procedure[Result]:
        """What carries it out, to its end, good or bad."""
        return steps.upgrade(self.plan, self.options, self.level, self.identity)


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
    """What an upgrade does before a bus is needed: load, plan, check, and settle what is left
    open as `Device.flash` does. `waived` names checks of flasher.host.waivers; what `identity` and
    `options` say goes before it. Raises ImageError, UsageError and WrongDeviceError.
    """
    names = frozenset(waived)
    if isinstance(image, Image):
        loaded, release = image, None
    else:
        loaded = load(image, allow_outside_vector=waivers.OUTSIDE_VECTOR in names)
        release = find_release(image) if identity is None else None
    if identity is None:
        identity = profile.identity(
            release=release,
            waived=frozenset(check for check in WAIVABLE if check.value in names),
            goes_on_unchecked=at_power_up,
        )
    plan = plan_for(release_checked(loaded, identity.release), profile, bitrate_bps)
    checks = check_image(plan, identity)
    chosen = options or profile.upgrade_options(allow_boot_name=waivers.BOOT_NAME in names or None)
    if waivers.BOOT_VERSION not in names:
        chosen = release_options(chosen, identity.release)
    if at_power_up:
        chosen = replace(chosen, at_power_up=True)
    level = default_level(plan.target, chosen) if verify is None else as_level(verify)
    check_level(plan, level, chosen)
    return Job(plan, chosen, level, identity, tuple(checks), tuple(sorted(names)))


def _checked(result: Result) -> Result:
    """The result of a good session. Raises the error of every other one."""
    error = result.error()
    if error is not None:
        raise error
    return result


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
    loaded = image if isinstance(image, Image) else load(image)
    if identity is None:
        identity = Identity(None if isinstance(image, Image) else find_release(image))
    rate = None if mock else bit_rate(dialect, **bus).bps
    checked = release_checked(loaded, identity.release)
    check_image(make_plan(checked, target, dialect, bitrate_bps=rate), identity)
    level = None if verify is None else as_level(verify)
    opened = connect_mock(target, dialect) if mock else connect(dialect, **bus)
    with opened as connection:
        return connection.device(target, dialect=dialect).flash(
            checked, options=options, verify=level, identity=identity, on_event=on_event
        )


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


def check_image(plan: Plan, identity: Identity) -> list[CheckResult]:
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


def refusal(plan: Plan, found: CheckResult) -> FlasherError | None:
    """The error for a finding that speaks against an upgrade; None for any other."""
    if found.ending is None:
        return None
    refused = before_the_start(
        plan, found.ending, found.detail, duration_s=0.0, waiver=found.waiver
    ).error()
    if refused is not None:
        refused.where = "before anything was sent"
    return refused
