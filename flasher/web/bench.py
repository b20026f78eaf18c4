"""The bench: one person upgrades one bike, step by step. A machine that does one thing at a time.

Pages give it orders; its whole state goes into its feed, where every page gets it from. So a page
may come and go, and a second one shows the same. What is done with a device is done by `Workplace`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path
from queue import Empty, Queue
from typing import Final, Protocol, TypeVar

from flasher import events
from flasher.api import Connection, DeviceInfo, Job, Result, prepare, refusal
from flasher.errors import FlasherError, ImageError, UsageError
from flasher.host.identity import Check, DeviceAnswers, judge_device, new_version
from flasher.host.outcome import AGAIN
from flasher.host.told import line_of, warning_of
from flasher.procedures import nobody_heard
from flasher.protocol.contents import RunningInformation, VersionInformation
from flasher.protocol.spec import BMS, TARGETS, Dialect, Target
from flasher.protocol.text import printable
from flasher.settings.profile import Profile
from flasher.web.feed import Feed

TURN_S: Final = 0.2
"""How often an idle bench shows that it is at work."""
SILENCE_LIMIT_S: Final = 5.0
"""Opening an adapter may take seconds, in which nothing can be told."""
NOTES_KEPT: Final = 12
SUBJECT: Final = "bench"
_AGAIN: Final = "Begin again with the adapter."
_RESCUE: Final = "Then rescue this device."
T = TypeVar("T")
_LOG: Final = logging.getLogger("flasher.web")


class Doing(Enum):
    """What the bench does now."""

    NOTHING = "nothing"
    ADAPTERS = "adapters"
    LOOKING = "looking"
    JUDGING = "judging"
    UPGRADING = "upgrading"
    LOOKING_AGAIN = "looking_again"


# -- what it shows ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Adapter:
    """A way to a bike; `name` tells it from the others."""

    name: str
    note: str = ""
    was_last: bool = False
    """The one that was used last."""


@dataclass(frozen=True)
class Offer:
    """An image file, held against the target: it fits, or `refusal` says why not."""

    path: Path
    version: str = ""
    size_bytes: int = 0
    packets: int = 0
    wire_s: float = 0.0
    sha256: str = ""
    checks: tuple[events.CheckMade, ...] = ()
    refusal: FlasherError | None = None

    @property
    def name(self) -> str:
        return printable(self.path.name)


@dataclass(frozen=True)
class Done:
    """An upgrade that has ended. Transferred, completed and running are three claims, of which
    None is: not known.
    """

    at: datetime
    adapter: Adapter
    target: Target
    offer: Offer
    checks: tuple[events.CheckMade, ...]
    before: DeviceInfo | None
    packet: int
    """Packets that the device has acknowledged, in the best attempt."""
    result: Result | None
    """None where the adapter failed, or somebody ended it at once."""
    error: FlasherError | None
    bundle: Path | None
    after: DeviceInfo | None = None

    @property
    def is_transferred(self) -> bool | None:
        return None if self.result is None else self.result.outcome.is_transferred

    @property
    def is_completed(self) -> bool | None:
        return None if self.result is None else self.result.outcome.is_completed

    @property
    def is_running(self) -> bool | None:
        """The application answered, and nothing speaks against its being the new one."""
        result = self.result
        if result is None or result.running_version is None:
            return None
        return result.ok

    @property
    def may_rescue_with_it(self) -> bool:
        """The device needs an image, and has not refused this one."""
        error = self.error
        return error is not None and error.needs_rescue and not self.is_refused

    @property
    def is_refused(self) -> bool:
        return self.error is not None and self.error.exit_code is self.error.exit_code.REFUSED


@dataclass(frozen=True)
class State:
    """Everything that a page shows."""

    doing: Doing = Doing.NOTHING
    is_rescue: bool = False
    adapters: tuple[Adapter, ...] = ()
    was_looked_for: bool = False
    adapter: Adapter | None = None
    bike: DeviceInfo | None = None
    """What was heard and what the battery answered, before the upgrade."""
    target: Target | None = None
    offers: tuple[Offer, ...] = ()
    offer: Offer | None = None
    phase: events.Phase | None = None
    packet: int = 0
    """Packets that the device has acknowledged in this attempt."""
    furthest: int = 0
    """The same, in the best attempt."""
    repetitions: int = 0
    transfer_began_s: float | None = None
    now_s: float = 0.0
    """On the clock of the bench, as `transfer_began_s`."""
    power_cycle_s: float | None = None
    """The device has to be switched off and on; it is waited for so long."""
    checks: tuple[events.CheckMade, ...] = ()
    notes: tuple[str, ...] = ()
    is_stopping: bool = False
    done: Done | None = None
    trouble: FlasherError | None = None
    """What ended the last step, but for an upgrade."""

    @property
    def is_idle(self) -> bool:
        return self.doing is Doing.NOTHING


# -- orders ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FindAdapters:
    """Look what is plugged in."""


@dataclass(frozen=True)
class UseAdapter:
    """Use this adapter, and look who answers on it."""

    name: str


@dataclass(frozen=True)
class Look:
    """Look again who answers."""


@dataclass(frozen=True)
class ChooseTarget:
    """Upgrade this device, and look which images fit; "" is none."""

    name: str


@dataclass(frozen=True)
class Judge:
    """Look again which images fit."""


@dataclass(frozen=True)
class ChooseImage:
    """Take this image; "" is none."""

    name: str


@dataclass(frozen=True)
class Upgrade:
    """Upgrade, with the image of this digest: what was chosen where the button was pressed."""

    target: str
    sha256: str


@dataclass(frozen=True)
class StartOver:
    """Begin with the next bike, or with the rescue of one."""

    is_rescue: bool = False


@dataclass(frozen=True)
class RescueIt:
    """Rescue the device whose upgrade has just failed."""


Order = (
    FindAdapters
    | UseAdapter
    | Look
    | ChooseTarget
    | Judge
    | ChooseImage
    | Upgrade
    | StartOver
    | RescueIt
)


# -- the machine -----------------------------------------------------------------------------------


@dataclass
class Carried:
    """How an upgrade ended."""

    result: Result | None
    error: FlasherError | None
    bundle: Path | None


class Workplace(Protocol):
    """What the bench works with. Methods raise FlasherError."""

    dialect: Dialect

    def adapters(self, cancelled: Callable[[], bool]) -> Sequence[Adapter]:
        """What there is now."""
        ...

    def use(self, adapter: Adapter) -> None:
        """This one was chosen."""
        ...

    def connect(self, adapter: Adapter) -> AbstractContextManager[Connection]:
        """Open it."""
        ...

    def profile(self, target: Target) -> Profile:
        """What the product does its own way."""
        ...

    def bitrate_bps(self, adapter: Adapter) -> int:
        """What its bus runs at."""
        ...

    def images(self) -> Sequence[Path]:
        """Files that may be images."""
        ...

    def upgrade(
        self,
        adapter: Adapter,
        job: Job,
        *,
        on_event: Callable[[object], None],
        cancelled: Callable[[], bool],
    ) -> Carried:
        """Carry out an upgrade, to its end, and keep what is to be kept of it."""
        ...


class Bench:
    """`now` is a monotonic clock, and `date` the time of day."""

    def __init__(
        self,
        workplace: Workplace,
        now: Callable[[], float],
        date: Callable[[], datetime] = lambda: datetime.now().astimezone(),
    ) -> None:
        self.feed = Feed(now, silence_limit_s=SILENCE_LIMIT_S)
        self.state = State()
        self._place = workplace
        self._now = now
        self._date = date
        self._lock = threading.Lock()
        self._is_taken = False
        """An order was given and is not carried out yet."""
        self._orders: Queue[Order] = Queue()
        self._stop = threading.Event()
        self._is_closing = self._ends_at_once = False
        self._set()

    # -- any thread --------------------------------------------------------------------------------

    def order(self, order: Order) -> bool:
        """Give it something to do; False while it does something else."""
        with self._lock:
            if self._is_taken:
                return False
            self._is_taken = True
            self._stop.clear()
        self._orders.put(order)
        return True

    def stop(self) -> None:
        """End what it does, at the next message boundary."""
        self._stop.set()

    def close(self, *, ends_upgrade: bool = True) -> None:
        """The program ends: nothing more is begun, and what is under way ends as by `stop`, but for
        an upgrade that is to come to its own end.
        """
        self._is_closing = True
        if ends_upgrade or self.state.doing is not Doing.UPGRADING:
            self._ends_at_once = True

    # -- its own thread ----------------------------------------------------------------------------

    def run(self) -> None:
        """Carry out orders until it is closed."""
        while not self._is_closing:
            self.feed.beat()
            try:
                order = self._orders.get(timeout=TURN_S)
            except Empty:
                continue
            self.carry_out(order)

    def carry_out(self, order: Order) -> None:
        """Do it, and show how it goes."""
        self._set(trouble=None)
        try:
            self._carry_out(order)
        except FlasherError as error:
            self._set(trouble=error)
        except Exception as error:  # noqa: BLE001  it is shown, and the bench goes on
            _LOG.exception("internal error")
            trouble = FlasherError(
                f"Internal error: {type(error).__name__}: {printable(str(error))}.",
                cause="a bug in flasher",
                remedy="Please report it with what the terminal shows and what you were doing.",
            )
            self._set(trouble=trouble)
        finally:
            with self._lock:
                self._is_taken = False
            self._set(doing=Doing.NOTHING, is_stopping=False)

    def _set(self, **changes: object) -> None:
        self.state = replace(self.state, now_s=self._now(), **changes)  # type: ignore[arg-type]
        self.feed.put(SUBJECT, self.state, word=None)
        self.feed.beat()

    def _cancelled(self) -> bool:
        """Asked all the time by what takes long."""
        self.feed.beat()
        is_asked = self._stop.is_set() or self._ends_at_once
        if is_asked and not self.state.is_stopping:
            self._set(is_stopping=True)
        return is_asked

    def _carry_out(self, order: Order) -> None:
        match order:
            case FindAdapters():
                self._find_adapters()
            case UseAdapter(name):
                self._use(name)
            case Look():
                self._look()
            case ChooseTarget(""):
                self._set(target=None, offers=(), offer=None, done=None)
            case ChooseImage(""):
                self._set(offer=None, done=None)
            case ChooseTarget(name):
                self._set(target=_known(TARGETS, name), offer=None, done=None)
                self._judge()
            case Judge():
                self._judge()
            case ChooseImage(name):
                fitting = {offer.name: offer for offer in self.state.offers if not offer.refusal}
                self._set(offer=_known(fitting, name), done=None)
            case Upgrade(target, sha256):
                self._check_meant(target, sha256)
                self._upgrade()
            case StartOver(is_rescue):
                self.state = State(
                    adapters=self.state.adapters, was_looked_for=True, is_rescue=is_rescue
                )
                self._find_adapters()
            case RescueIt():
                self._rescue_it()

    # -- the steps ---------------------------------------------------------------------------------

    def _find_adapters(self) -> None:
        self._set(doing=Doing.ADAPTERS)
        self._set(adapters=tuple(self._place.adapters(self._cancelled)), was_looked_for=True)

    def _use(self, name: str) -> None:
        adapter = _known({each.name: each for each in self.state.adapters}, name)
        self._place.use(adapter)
        marked = tuple(replace(each, was_last=each == adapter) for each in self.state.adapters)
        self._set(
            adapter=adapter, adapters=marked, bike=None, target=None, offers=(), offer=None,
            done=None, checks=(), notes=(),
        )  # fmt: skip
        if not self.state.is_rescue:
            self._look()

    def _look(self) -> None:
        """Ask the battery, and listen to the others: the documents give no question for them."""
        self._set(doing=Doing.LOOKING, bike=None, done=None)
        bike = self._seen(self._adapter(), BMS)
        self._set(bike=bike)
        if not bike.survey.heard:
            raise nobody_heard(bike.survey, self._place.bitrate_bps(self._adapter()))

    def _seen(self, adapter: Adapter, target: Target) -> DeviceInfo:
        with self._place.connect(adapter) as connection:
            device = connection.device(target, dialect=self._place.dialect)
            return device.identify(cancelled=self._cancelled)

    def _judge(self) -> None:
        self._set(doing=Doing.JUDGING, offers=(), offer=None)
        self._adapter()
        offers = []
        for path in self._place.images():
            if self._cancelled():
                break
            offers.append(self._judged(path))
        offers.sort(key=lambda offer: (offer.refusal is not None, offer.name))
        self._set(offers=tuple(offers))

    def _judged(self, path: Path) -> Offer:
        try:
            job = self._job(path)
            self._check_device(job)
        except FlasherError as error:
            return Offer(path, refusal=error)
        image = job.plan.image
        return Offer(
            path,
            new_version(image, job.identity.release) or "",
            image.size_bytes,
            job.plan.total_packets,
            job.plan.wire_s,
            image.sha256,
            tuple(found.event for found in job.checks),
        )

    def _job(self, path: Path) -> Job:
        target = self.state.target
        if target is None:
            raise UsageError("No device is chosen.", remedy="Choose the one to upgrade.")
        profile = self._place.profile(target)
        rate = self._place.bitrate_bps(self._adapter())
        return prepare(path, profile, bitrate_bps=rate, at_power_up=self.state.is_rescue)

    def _check_device(self, job: Job) -> None:
        """Raises WrongDeviceError for an image that does not belong into the device that answered;
        the upgrade asks it again.
        """
        bike = self.state.bike
        if bike is None or self.state.is_rescue or job.plan.target is not bike.target:
            return
        answers = {type(each.answer): each.answer for each in bike.readings}
        version = answers.get(VersionInformation)
        running = answers.get(RunningInformation)
        assert running is None or isinstance(running, RunningInformation)  # noqa: S101  by its key
        seen = DeviceAnswers(version, running)
        for found in judge_device(job.plan.image, job.plan.target, job.identity, seen):
            error = None if found.check is Check.IN_USE else refusal(job.plan, found)
            if error is not None:
                raise error

    def _check_meant(self, target: str, sha256: str) -> None:
        """Raises UsageError when a page that was not up to date has ordered it."""
        chosen, offer = self.state.target, self.state.offer
        if chosen is None or offer is None or (chosen.name, offer.sha256) != (target, sha256):
            raise UsageError(
                "Another device or image was chosen meanwhile; nothing was sent.",
                remedy="Look at what is chosen, and begin again.",
            )

    def _upgrade(self) -> None:
        adapter, offer = self._adapter(), self.state.offer
        assert offer is not None  # noqa: S101  _check_meant
        self._set(
            doing=Doing.UPGRADING, done=None, checks=(), notes=(), packet=0, furthest=0,
            repetitions=0, phase=None, transfer_began_s=None, power_cycle_s=None,
        )  # fmt: skip
        job = self._job(offer.path)
        if job.plan.image.sha256 != offer.sha256:
            raise ImageError(
                f"{offer.name} is another file than when it was chosen; nothing was sent.",
                remedy="Choose the image again.",
            )
        carried = self._place.upgrade(
            adapter, job, on_event=self._happened, cancelled=self._cancelled
        )
        if carried.error is not None:
            again = _RESCUE if carried.error.needs_rescue else _AGAIN
            carried.error.remedy = carried.error.remedy.replace(AGAIN, again)
        state = self.state
        done = Done(
            self._date(), adapter, job.plan.target, offer, state.checks, state.bike, state.furthest,
            carried.result, carried.error, carried.bundle,
        )  # fmt: skip
        self._set(done=done, power_cycle_s=None, phase=None)
        is_new = carried.result is not None and carried.result.outcome.ok
        if is_new and done.target.has_version_query:
            self._set(doing=Doing.LOOKING_AGAIN)
            self._set(done=replace(done, after=self._seen(adapter, done.target)))

    def _happened(self, event: object) -> None:
        """In the middle of an upgrade."""
        changes: dict[str, object] = {}
        match event:
            case events.PacketAcknowledged(number, _, _):
                changes |= {"packet": number, "furthest": max(number, self.state.furthest)}
                if self.state.transfer_began_s is None:
                    changes["transfer_began_s"] = self._now()
            case events.PhaseEntered(phase, _):
                changes["phase"] = phase
                if phase is not events.Phase.BOOT:
                    changes["power_cycle_s"] = None
            case events.AttemptStarted():
                changes |= {"packet": 0, "transfer_began_s": None}
            case events.MessageRepeated():
                changes["repetitions"] = self.state.repetitions + 1
            case events.PowerCycleAwaited(limit_s):
                changes["power_cycle_s"] = limit_s
            case events.CheckMade():
                changes["checks"] = (*self.state.checks, event)
        line = line_of(event)
        said = warning_of(event) or (line[0] if line and line[1] < 2 else "")
        if said and not isinstance(event, events.CheckMade):
            changes["notes"] = (*self.state.notes, said)[-NOTES_KEPT:]
        if changes:
            self._set(**changes)

    def _rescue_it(self) -> None:
        """The same device, and the same image where the device has not refused it."""
        done = self.state.done
        if done is None:
            raise UsageError("No upgrade has failed.", remedy="Begin with the adapter.")
        self._set(is_rescue=True, done=None, offer=None, checks=(), notes=())
        self._judge()
        if done.may_rescue_with_it:
            same = [each for each in self.state.offers if each.sha256 == done.offer.sha256]
            self._set(offer=next(iter(same), None))

    def _adapter(self) -> Adapter:
        if self.state.adapter is None:
            raise UsageError("No adapter is chosen.", remedy="Choose one.")
        return self.state.adapter


def _known(things: Mapping[str, T], name: str) -> T:
    """Raises UsageError for what is not there any more."""
    found = things.get(name)
    if found is None:
        raise UsageError(f"{printable(name)} is not there any more.", remedy="Look again.")
    return found
