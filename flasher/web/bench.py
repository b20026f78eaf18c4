"""Controller of the bench page: one user upgrades one bike step by step.

Pages submit orders; a feed sends the whole state to every page, so that a page may be closed and
opened again. `BenchBackend` uses the devices.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from queue import Empty, Queue
from typing import Final, TypeVar

from flasher import events
from flasher.api import Connection, DeviceInfo
from flasher.bike import SetImage, check_same_battery, open_bike_set
from flasher.errors import (
    ErrorCode,
    FlasherError,
    ImageError,
    InterruptedByUserError,
    UsageError,
    WrongDeviceError,
)
from flasher.host.event_text import progress_line, warning_text
from flasher.host.identity import (
    OF_STATE,
    CheckResult,
    DeviceAnswers,
    IdentityCheck,
    judge_device,
    new_version,
)
from flasher.host.options import serial_number
from flasher.host.outcome import AGAIN
from flasher.i18n import Text, text, with_value
from flasher.image.image import Image
from flasher.image.sample import is_sample, sample_error
from flasher.jobs import Job, prepare, refusal
from flasher.kept_settings import settings_of
from flasher.procedures import nothing_received_error
from flasher.protocol.contents import RunningInformation, VersionInformation
from flasher.protocol.engine import Tap
from flasher.protocol.spec import BMS, TARGETS, Target
from flasher.protocol.text import printable
from flasher.release.places import SUFFIX as RELEASE_SUFFIX
from flasher.report.base import visible
from flasher.way_back import images_here
from flasher.web.bench_backend import BenchBackend
from flasher.web.bench_state import (
    Activity,
    Adapter,
    BenchState,
    Done,
    Offer,
    SessionEntry,
)
from flasher.web.feed import Feed

TURN_S: Final = 0.2
"""Interval at which an idle bench reports that it runs."""
SILENCE_LIMIT_S: Final = 5.0
"""Time without a report before pages show the bench as silent; opening an adapter takes seconds."""
NOTES_KEPT: Final = 12
SUBJECT: Final = "bench"
_AGAIN: Final = text("Start again with the adapter.")
RESCUE: Final = text("Rescue this device.")
T = TypeVar("T")
Order = Callable[["BenchController"], object]
"""A function that the bench's own thread calls."""
_LOG: Final = logging.getLogger("flasher.web")


class BenchController:
    """Executes the orders of pages, one at a time, in its own thread.

    `now` is a monotonic clock in seconds, `date` the local time.
    """

    def __init__(
        self,
        backend: BenchBackend,
        now: Callable[[], float],
        date: Callable[[], datetime] = lambda: datetime.now().astimezone(),
    ) -> None:
        self.feed = Feed(now, silence_limit_s=SILENCE_LIMIT_S)
        self.state = BenchState()
        self.backend = backend
        self.now = now
        self.date = date
        self._lock = threading.Lock()
        self._is_taken = False
        """An order is queued or being executed."""
        self._orders: Queue[Order] = Queue()
        self._stop = threading.Event()
        self._question = self._agreed = 0
        """Number of the question asked last, and of the one to which a user agreed."""
        self._has_new_files = threading.Event()
        self._images_here: dict[str, str] = {}
        """Files of this computer by the firmware version inside."""
        self._last_image: Path | None = None
        """Image that was dropped or selected last, since an upgrade began."""
        self._is_closing = self._ends_at_once = False
        self._expected_serial = ""
        """Serial number of the unit that may be upgraded; "" for any."""
        self._other_serial: str | None = None
        """Serial number that another unit has reported instead; "": it has none."""
        self._connection: Connection | None = None
        """Open while an order needs the bus from one step to the next."""
        self.show()

    # -- any thread --------------------------------------------------------------------------------

    def order(self, order: Order) -> bool:
        """Submit an order; False if another one is queued or being executed."""
        with self._lock:
            if self._is_taken:
                return False
            self._is_taken = True
            self._stop.clear()
        self._orders.put(order)
        return True

    def file_came(self, path: Path) -> None:
        """Check a dropped file as soon as the bench is idle, and select it if it fits."""
        is_beside = path.suffix.lower() == RELEASE_SUFFIX and path.with_suffix("").is_file()
        if self.state.is_bike or (path.suffix.lower() != ".toml" and not is_beside):
            self._last_image = path  # the others belong to an image
        self._has_new_files.set()

    def stop(self) -> None:
        """End the current activity after the present message."""
        self._stop.set()

    def agree(self, question: int) -> None:
        """Agree to the question of this number."""
        self._agreed = question

    def close(self, *, ends_upgrade: bool = True) -> None:
        """Start nothing more, and end the current activity; an upgrade only with `ends_upgrade`."""
        self._is_closing = True
        if ends_upgrade or self.state.doing is not Activity.UPGRADING:
            self._ends_at_once = True

    # -- its own thread ----------------------------------------------------------------------------

    def run(self, between: Callable[[BenchController], None]) -> None:
        """Execute orders until closed; `between` is called after each one, and returns as soon as
        `is_wanted`.
        """
        while not self._is_closing:
            self.feed.beat()
            try:
                order = self._orders.get(timeout=TURN_S)
            except Empty:
                if not self._has_new_files.is_set() or not self.order(BenchController.take_files):
                    continue
                order = self._orders.get()
            self.execute(order)
            between(self)

    @property
    def is_wanted(self) -> bool:
        """True if there is something to do: an order, a new file, or to close."""
        return not self._orders.empty() or self._is_closing or self.has_new_files

    def execute(self, order: Order) -> None:
        """Execute an order; an error becomes the `trouble` of the state."""
        self.show(trouble=None)
        try:
            order(self)
        except FlasherError as error:
            self.show(trouble=error)
        except Exception as error:  # noqa: BLE001  it is shown, and the bench goes on
            _LOG.exception("internal error")
            trouble = FlasherError(
                f"Internal error: {type(error).__name__}: {printable(str(error))}.",
                cause="a bug in flasher",
                remedy="Please report it with the output of the terminal and the steps before it.",
            )
            self.show(trouble=trouble)
        finally:
            with self._lock:
                self._is_taken = False
            self.show(doing=Activity.NOTHING, is_stopping=False)

    def show(self, **changes: object) -> None:
        """Change the state, and send it to the pages."""
        self.state = replace(self.state, now_s=self.now(), **changes)  # type: ignore[arg-type]
        self.feed.put(SUBJECT, self.state, word=None)
        self.feed.beat()

    def cancelled(self) -> bool:
        """True if the current activity must end; called often."""
        self.feed.beat()
        left_s = self.state.power_cycle_left_s
        if left_s(self.now()) != left_s(self.state.now_s):
            self.show()
        is_asked = self._stop.is_set() or self._ends_at_once or self._other_serial is not None
        if is_asked and not self.state.is_stopping:
            self.show(is_stopping=True)
        return is_asked

    def ask(self) -> int:
        """Begin to ask for agreement; return the number of the question."""
        self._agreed = 0
        self._question += 1
        return self._question

    @property
    def is_agreed(self) -> bool:
        """True if a user has agreed to the question asked last."""
        return self._agreed == self._question

    @property
    def has_new_files(self) -> bool:
        """True if a file was dropped that is not yet checked."""
        return self._has_new_files.is_set()

    def pause(self, duration_s: float) -> None:
        """Wait; ends at once on Stop."""
        self._stop.wait(duration_s)

    # -- the steps: orders -------------------------------------------------------------------------

    def start_over(self, *, is_rescue: bool = False) -> None:
        """Reset for the next bike or a rescue."""
        self.state = BenchState(
            adapters=self.state.adapters,
            was_looked_for=True,
            is_rescue=is_rescue,
            dropped=self.state.dropped,
            session=self.state.session,
            unfinished=self.state.unfinished,
        )
        self.find_adapters()

    def find_adapters(self) -> None:
        self.show(doing=Activity.ADAPTERS, unfinished=self.backend.unfinished())
        self.show(adapters=tuple(self.backend.adapters(self.cancelled)), was_looked_for=True)

    def use_adapter(self, name: str) -> None:
        """Open an adapter and look for devices."""
        adapter = known({each.name: each for each in self.state.adapters}, name)
        self.backend.use(adapter)
        marked = tuple(replace(each, was_last=each == adapter) for each in self.state.adapters)
        self.show(
            adapter=adapter, adapters=marked, bike=None, target=None, is_bike=False, devices=(),
            offers=(), offer=None,
            done=None, checks=(), notes=(), areas=None, saved=None, watched=None,
            waived=frozenset(), compared=None,
        )  # fmt: skip
        if not self.state.is_rescue:
            self.look()

    def look(self) -> None:
        """Request the battery's identity, and receive from the others, which have no query. No
        device is selected then: it may be another bike.
        """
        self.choose_target("")
        self.show(doing=Activity.LOOKING, bike=None, done=None, checks=(), notes=(), compared=None)
        bike = self.seen(BMS)
        self.show(bike=bike)
        if not bike.survey.heard:
            raise nothing_received_error(bike.survey, self.backend.bitrate_bps(self.adapter()))

    @contextmanager
    def connected(self, *, asks: bool = True) -> Iterator[Connection]:
        """Open the chosen adapter, or continue with the connection that is open."""
        if self._connection is not None:
            yield self._connection
            return
        with self.backend.connect(self.adapter(), asks=asks) as connection:
            self._connection = connection
            try:
                yield connection
            finally:
                self._connection = None

    def seen(self, target: Target, *taps: Tap) -> DeviceInfo:
        """Ask a device for all it answers."""
        with self.connected() as connection:
            device = connection.device(target, dialect=self.backend.dialect)
            return device.identify(cancelled=self.cancelled, taps=taps)

    def choose_target(self, name: str) -> None:
        """Select the device to upgrade, and check which images fit; "" deselects."""
        self.show(is_bike=False, devices=())
        if not name:
            self.show(target=None, offers=(), offer=None, done=None, waived=frozenset())
            return
        target = known(TARGETS, name)
        has_settings = bool(settings_of(target, self.backend.dialect))
        self.show(
            target=target, offer=None, done=None, waived=frozenset(),
            keeps_settings=self.backend.profile(target).keep_settings if has_settings else None,
        )  # fmt: skip
        self.judge()

    def keep_settings(self, keep: str) -> None:
        """Choose whether the settings are kept: "yes" or "no"."""
        self.show(keeps_settings=keep == "yes")

    def choose_image(self, name: str) -> None:
        """Select an image; "" deselects."""
        if not name:
            self.show(done=None)
            self.judge()
            return
        fitting = {offer.name: offer for offer in self.state.offers if not offer.refusal}
        offer = known(fitting, name)
        self._last_image = offer.path
        self.show(offer=offer, done=None)

    def use_folder(self, path: str) -> None:
        self.backend.use_folder(path)
        self.judge()

    def choose_bike(self) -> None:
        """Select the whole bike, and check which sets of images can be used."""
        self.choose_target("")
        profiles = map(
            self.backend.profile,
            (each for each in TARGETS.values() if settings_of(each, self.backend.dialect)),
        )
        self.show(is_bike=True, keeps_settings=any(each.keep_settings for each in profiles))
        self.judge()

    def judge(self) -> None:
        """Check which images fit the selected device, or which sets the bike."""
        self.show(doing=Activity.JUDGING, offers=(), offer=None)
        self.adapter()
        offers = []
        is_bike = self.state.is_bike
        paths = self.backend.sets() if is_bike else self.backend.images()
        if not is_bike:
            self._images_here = images_here(self.state.target or BMS, paths)
        for path in paths:
            if self.cancelled():
                break
            offers.append(self.judged_set(path) if is_bike else self.judged(path))
        offers.sort(key=lambda offer: (offer.refusal is not None, offer.name))
        self.show(offers=tuple(offers))

    def take_files(self) -> None:
        """Check files dropped on the page. The image that came last replaces the selected one, or
        its refusal does. Raises FlasherError for a refused one.
        """
        self._has_new_files.clear()
        self.show(dropped=tuple(self.backend.dropped()))
        if not (self.state.target or self.state.is_bike) or self.state.done is not None:
            return
        self.judge()
        self._select_last()

    def _select_last(self) -> None:
        """Select the last image. Raises FlasherError if it was refused."""
        self._select(lambda offer: offer.path == self._last_image)
        for each in self.state.offers:
            if each.path == self._last_image and each.refusal is not None:
                raise each.refusal

    def _select(self, is_wanted: Callable[[Offer], bool]) -> None:
        """Select the first fitting image that is wanted, or none."""
        fitting = (each for each in self.state.offers if each.refusal is None)
        self.show(offer=next(filter(is_wanted, fitting), None))

    def waive(self, name: str, waiver: str) -> None:
        """Accept an image that this check refused."""
        done = self.state.done
        refused = {each.name: each.refusal for each in self.state.offers if each.refusal}
        if done is not None and done.error is not None:
            refused = {done.offer.name: done.error}
        error = known(refused, name)
        if not waiver or error.waiver != waiver:
            raise UsageError(
                "That check has not refused this image; nothing was waived.", remedy="Look again."
            )
        self.show(done=None, waived=self.state.waived | {(name, waiver)})
        self.judge()
        self._select(lambda offer: offer.name == name)

    def judged(self, path: Path) -> Offer:
        """Check an image for the selected device."""
        try:
            job = self.job(path, self.state.target)
            return self._offer(path, job, self._check_device(job))
        except FlasherError as error:
            return Offer(path, refusal=error)

    def judged_set(self, path: Path) -> Offer:
        """Check a set of images for the bike."""
        try:
            parts = [
                (target, self._offer(part.path, job, ()))
                for target, (part, job) in self.set_jobs(path).items()
            ]
        except FlasherError as error:
            return Offer(path, refusal=error)
        offers = [offer for _, offer in parts]
        return Offer(
            path,
            size_bytes=sum(each.size_bytes for each in offers),
            packets=sum(each.packets for each in offers),
            wire_s=sum(each.wire_s for each in offers),
            sha256="".join(each.sha256 for each in offers),
            origin=offers[0].origin,
            warnings=tuple(dict.fromkeys(line for each in offers for line in each.warnings)),
            parts=tuple(parts),
        )

    def set_jobs(self, path: Path) -> dict[Target, tuple[SetImage, Job]]:
        """Prepare the upgrades of a set. A device that runs its version already is skipped.

        Raises FlasherError for a set or an image that cannot be used.
        """
        rate = self.backend.bitrate_bps(self.adapter())
        jobs = {}
        for part in open_bike_set(path):
            profile = self.backend.profile(part.target)
            profile.check_fits(part.opened.image)
            here = images_here(part.target, self.backend.images())
            job = prepare(
                part.opened, profile, bitrate_bps=rate, skip_same_version=True, images_here=here
            )
            jobs[part.target] = part, job.checked()
        return jobs

    def _offer(self, path: Path, job: Job, device_checks: Iterable[CheckResult]) -> Offer:
        self._check_sample(job.plan.image)
        found = [*job.checks, *device_checks]
        image, provenance = job.plan.image, job.identity.provenance
        return Offer(
            path,
            new_version(image, job.identity.release) or "",
            image.size_bytes,
            job.plan.total_packets,
            job.plan.wire_s,
            image.sha256,
            tuple(each.event for each in found),
            waived=job.waived,
            origin=text("the image is not signed") if provenance is None else provenance.text,
            warnings=() if provenance is None else provenance.warnings,
        )

    def job(self, path: Path, target: Target | None) -> Job:
        if target is None:
            raise UsageError("No device is chosen.", remedy="Choose the one to upgrade.")
        profile = self.backend.profile(target)
        rate = self.backend.bitrate_bps(self.adapter())
        name = visible(path.name)
        return prepare(
            path,
            profile,
            bitrate_bps=rate,
            at_power_up=self.state.is_rescue,
            waived=[waiver for waived, waiver in self.state.waived if waived == name],
            images_here=self._images_here,
        ).checked()

    def _check_sample(self, image: Image) -> None:
        """Refuse a firmware sample on a real bus; the upgrade checks again. Raises ImageError."""
        adapter = self.adapter()
        if is_sample(image) and self.backend.is_physical(adapter):
            raise sample_error(image, adapter.name)

    def _check_device(self, job: Job) -> list[CheckResult]:
        """Refuse an image of another device than the one that answered; the upgrade asks again.
        Return what is known of the way back. Raises WrongDeviceError.
        """
        bike = self.state.bike
        if bike is None or self.state.is_rescue or job.plan.target is not bike.target:
            return []
        way_back = []
        answers = (each.answer for each in bike.readings)
        running = next((each for each in answers if isinstance(each, RunningInformation)), None)
        seen = DeviceAnswers(bike.version, running)
        for found in judge_device(job.plan.image, job.plan.target, job.identity, seen):
            error = None if found.check in OF_STATE else refusal(job.plan, found)
            if error is not None:
                raise error
            if found.check is IdentityCheck.WAY_BACK:
                way_back.append(found)
        return way_back

    def shown_offer(self, selection: str) -> Offer:
        """Return the selected image. Raises UsageError unless the page showed this selection when
        its button was pressed.
        """
        offer = self.state.offer
        if offer is None or selection != self.state.selection:
            raise UsageError(
                "Another device or image was chosen meanwhile; nothing was sent.",
                remedy="Check the selection, then start again.",
            )
        if self.has_new_files:
            raise UsageError(
                "A file came meanwhile; nothing was sent.",
                remedy="Check the selection, then start again.",
            )
        return offer

    def upgrade(self, selection: str) -> None:
        """Upgrade the selected device (`BenchState.selection`)."""
        offer = self.shown_offer(selection)
        self._begin()
        job = self.job(offer.path, self.state.target)
        if job.plan.image.sha256 != offer.sha256:
            raise changed_error(offer)
        self.carry_out(job, offer, self.state.battery)

    def check_same_bike(self, battery: str) -> None:
        """Raise WrongDeviceError if another battery answers than the one with this serial number;
        "" if it is unknown.
        """
        with self.connected() as connection:
            try:
                check_same_battery(
                    connection, self.backend.profile(BMS), battery, cancelled=self.cancelled
                )
            except FlasherError as error:
                error.remedy = text(
                    "Connect the first bike and press the same button again, or search for devices "
                    "again to upgrade this one."
                )
                raise

    def _begin(self) -> None:
        self.show(
            doing=Activity.UPGRADING, done=None, checks=(), notes=(), packet=0, furthest=0,
            repetitions=0, phase=None, transfer_began_s=None, power_cycle_s=None,
            adapter_left_s=None, watched=None, compared=None,
        )  # fmt: skip
        self._last_image = None

    def carry_out(self, job: Job, offer: Offer, battery: str) -> Done:
        """Run a prepared upgrade on the bike whose battery has this serial number, "" if it is
        unknown, and read what the device answers after it. Raises WrongDeviceError if another
        battery answers before it.
        """
        if job.plan.target is not BMS:  # its upgrade does not ask the battery
            self.check_same_bike(battery)
        self._begin()
        adapter = self.adapter()
        self._expected_serial = battery
        try:
            carried = self.backend.upgrade(
                adapter,
                job,
                self.connected,
                keeps_settings=bool(
                    self.state.keeps_settings and settings_of(job.plan.target, self.backend.dialect)
                ),
                on_event=self._happened,
                cancelled=self.cancelled,
            )
            other = self._other_serial
        finally:
            self._expected_serial, self._other_serial = "", None
        if other is not None and isinstance(carried.error, InterruptedByUserError):
            error = WrongDeviceError(
                text(
                    "The unit {other} answers now, and {serial} answered before: nothing was "
                    "written.",
                    other=other or text("without serial number"),
                    serial=battery,
                ),
                remedy=text("Leave one unit connected until its upgrade has ended."),
                code=ErrorCode.NOT_FOR_DEVICE,
            )
            carried = replace(carried, result=None, error=error)  # no user has cancelled it
        if carried.error is not None:
            again = RESCUE if carried.error.needs_rescue else _AGAIN
            advise(carried.error, again, AGAIN)
        state = self.state
        before = None if state.is_rescue else state.bike  # a bootloader does not report its unit
        done = Done(
            **vars(carried), at=self.date(), adapter=adapter, target=job.plan.target, offer=offer,
            checks=state.checks, before=before, packet=state.furthest,
        )  # fmt: skip
        self.show(done=done, power_cycle_s=None, adapter_left_s=None, phase=None)
        is_new = carried.result is not None and carried.result.outcome.ok
        serial = battery
        try:
            if is_new and done.target.has_version_query:
                self.show(doing=Activity.LOOKING_AGAIN)
                after = self.seen(done.target)
                serial = serial or serial_number(after.version)
                is_same = state.bike is not None and serial == serial_number(state.bike.version)
                done = replace(done, after=after, before=state.bike if is_same else done.before)
                self.show(done=done, bike=after if done.target is BMS else state.bike)
        finally:  # also if the adapter is lost meanwhile
            self.note_session(serial, offer, done.error, is_left_out=False)
        return done

    def note_session(
        self, serial: str, offer: Offer, error: FlasherError | None, *, is_left_out: bool = True
    ) -> None:
        """Add an upgrade to the list of the session, or a unit that was left out."""
        target = self.state.target or BMS
        entry = SessionEntry(self.date(), target, serial, offer.name, error, is_left_out)
        self.show(session=(*self.state.session, entry))

    def _check_unit(self, event: object) -> None:
        """End the upgrade before it writes to another unit than the expected one."""
        content = event.content if isinstance(event, events.QueryAnswered) else None
        if isinstance(content, VersionInformation) and self._expected_serial:
            serial = serial_number(content)
            if serial != self._expected_serial:
                self._other_serial = serial

    def _happened(self, event: object) -> None:
        """Process an event of an upgrade."""
        self._check_unit(event)
        changes: dict[str, object] = {}
        match event:
            case events.PacketAcknowledged(number, _, _):
                changes |= {"packet": number, "furthest": max(number, self.state.furthest)}
                changes["power_cycle_s"] = None
                began_s = self.state.transfer_began_s
                changes["transfer_began_s"] = self.now() if began_s is None else began_s
            case events.PhaseEntered(phase, _):
                changes["phase"] = phase
            case events.AttemptStarted():
                changes |= {"packet": 0, "transfer_began_s": None}
            case events.MessageRepeated():
                changes["repetitions"] = self.state.repetitions + 1
            case events.PowerCycleAwaited(limit_s):
                changes |= {"power_cycle_s": limit_s, "power_cycle_since_s": self.now()}
            case events.AdapterAwaited(left_s):
                changes["adapter_left_s"] = left_s
            case events.AdapterBack() | events.BootVersionSeen():
                changes |= {"adapter_left_s": None, "power_cycle_s": None}
            case events.CheckMade():
                changes["checks"] = (*self.state.checks, event)
        if note := _note_of(event):
            changes["notes"] = (*self.state.notes, note)[-NOTES_KEPT:]
        if changes:
            self.show(**changes)

    def rescue_it(self) -> None:
        """Select the same device, and the same image unless the device refused it."""
        done = self.state.done
        if done is None:
            raise UsageError("No upgrade has failed.", remedy="Start with the adapter.")
        self.show(
            is_rescue=True, is_bike=False, devices=(), target=done.target, done=None, offer=None,
            checks=(), notes=(),
        )  # fmt: skip
        self.judge()
        if self._last_image is not None:
            self._select_last()
        elif done.may_rescue_with_it:
            self._select(lambda offer: offer.sha256 == done.offer.sha256)

    def rescue_unfinished(self) -> None:
        """Rescue the device of the unfinished upgrade: on its adapter if that is here, with its
        image if that is still on the shelf.
        """
        flash = self.state.unfinished
        if flash is None:
            raise UsageError("No upgrade is unfinished.", remedy="Start with the adapter.")
        began = flash.began
        self.start_over(is_rescue=True)
        if began.adapter in {each.name for each in self.state.adapters}:
            self.use_adapter(began.adapter)
            self.choose_target(began.target)
            self._select(lambda offer: offer.sha256 == began.image_sha256)

    def adapter(self) -> Adapter:
        if self.state.adapter is None:
            raise UsageError("No adapter is chosen.", remedy="Choose one.")
        return self.state.adapter


def _note_of(event: object) -> str:
    """Text of an event; "" for checks, which are shown elsewhere."""
    line = progress_line(event)
    warning = warning_text(event) or (line[0] if line and line[1] < 2 else "")
    return "" if isinstance(event, events.CheckMade) else warning


def advise(error: FlasherError, advice: str, instead_of: str) -> None:
    """Replace a sentence of what an error advises."""
    if isinstance(error.remedy, Text):
        error.remedy = with_value(error.remedy, instead_of, advice)
    else:
        error.remedy = error.remedy.replace(instead_of, advice)


def changed_error(offer: Offer) -> ImageError:
    """Create the error for a file that is another one than when it was chosen."""
    return ImageError(
        f"{printable(offer.name)} has changed since it was chosen; nothing was sent.",
        remedy="Choose the image again.",
    )


def known(things: Mapping[str, T], name: str) -> T:
    """Look up a name. Raises UsageError for an entry that no longer exists."""
    found = things.get(name)
    if found is None:
        raise UsageError(f"{printable(name)} no longer exists.", remedy="Look again.")
    return found
