"""Procedures of `flasher.api.Device`: query, read, write, identify, scan, verify, upgrade."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, inf
from typing import TYPE_CHECKING, Final, TypedDict

from flasher import events
from flasher.bus.health import LinkHealth, TroubleKind, bus_off_error
from flasher.bus.link import SEND_LIMIT_S, Clock, Link, suspended_s
from flasher.driver import STALL_S, drive
from flasher.errors import (
    BusError,
    ErrorCode,
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    TransmitBlockedError,
    UsageError,
    WrongDeviceError,
)
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.identity import Identity
from flasher.host.items import Readable, find_item, readable
from flasher.host.options import BRIEF_ADAPTER_RETURN_S, UpgradeOptions
from flasher.host.outcome import AGAIN, TWO_DEVICES_CAUSE
from flasher.host.query import (
    READ_MEMORY,
    Queries,
    Query,
    Request,
    check_range,
    memory_bytes,
    memory_requests,
)
from flasher.host.runner import Runner
from flasher.host.session import Result, UpgradeSession
from flasher.host.survey import Survey
from flasher.host.verify import (
    NOT_ASKED,
    Level,
    Verdict,
    Verification,
    check_level,
    default_level,
    memory_check,
    version_check,
)
from flasher.host.write import WritePlan, WriteResult, plan_write
from flasher.image.image import Image
from flasher.image.plan import Plan, make_plan
from flasher.image.sample import is_sample, sample_error
from flasher.log import log_event
from flasher.protocol.catalogue import BY_KEY, Item
from flasher.protocol.contents import Memory, Reset, VersionInformation
from flasher.protocol.engine import Engine, Tap
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, Command, Dialect, Target
from flasher.settings.profile import Profile
from flasher.wording import wording

if TYPE_CHECKING:
    from flasher.bus.bit_rate import BitRate

INFO_LISTEN_S: Final = 0.5
"""Time to receive faults twice: they are sent every 200 ms while any is set (table 5)."""
INFO_LISTEN_ONLY_S: Final = 3.0
"""Time to listen for devices without queries, which send about once a second."""
SCAN_LISTEN_S: Final = 1.0
_WAS_OFF: Final = frozenset({TroubleKind.BUS_OFF, TroubleKind.RESTARTED})
_REOPEN_PAUSE_S: Final = 0.1
"""Pause between two tries to open a lost adapter, in seconds."""


EventHandler = Callable[[object], None]


class CallOptions(TypedDict, total=False):
    """Callbacks of a call; those of the device apply if missing."""

    taps: Sequence[Tap]
    """Called with every frame in both directions."""
    on_event: EventHandler | None
    """Called with the events, dataclasses of `flasher.events`."""
    cancelled: Callable[[], bool] | None
    """Called repeatedly; True ends the call at the next message boundary."""
    ends_write: Callable[[], bool] | None
    """Like `cancelled`, while an item is written, which `cancelled` does not end: the device may
    have been exchanged, and the write must not be repeated to another one."""
    hung_up: Callable[[], bool] | None
    """Like `cancelled`, for a closed terminal: it does not end an upgrade that has begun to
    erase."""


@dataclass(frozen=True)
class ItemReading:
    """Query of `identify` with its answer (None without one). `misfit` describes an answer of
    another format; `was_asked` is False if the device was silent to earlier queries.
    """

    name: str
    item: Item
    answer: Content | None
    misfit: str = ""
    was_asked: bool = True

    @property
    def title(self) -> str:
        """Display name."""
        return self.name.replace("-", " ")

    @property
    def why(self) -> str:
        """Reason for a missing answer."""
        if not self.was_asked:
            return "not asked: the device is silent"
        if self.misfit:
            return f"came in another form: {self.misfit}"
        return "no answer"


@dataclass(frozen=True)
class DeviceInfo:
    """Answers of a device to all queries, and the traffic received meanwhile."""

    target: Target
    dialect: Dialect
    readings: tuple[ItemReading, ...]
    """Queries with answers, in the order of the document; empty for devices without queries."""
    survey: Survey

    @property
    def is_there(self) -> bool:
        """True if the device answered or sent a message."""
        return self.target.node in self.survey.heard

    @property
    def version(self) -> VersionInformation | None:
        """Answer to the version query; None without one."""
        answers = (reading.answer for reading in self.readings)
        return next((each for each in answers if isinstance(each, VersionInformation)), None)

    @property
    def no_faults(self) -> str:
        """Text for no received faults; only one document gives their interval."""
        is_periodic = self.dialect == WELLING
        proviso = "" if is_periodic else "; how often they are sent is not documented: see monitor"
        return f"none received{proviso}"


@dataclass(frozen=True)
class Procedures:
    """Procedures for the target of a profile on a link, for one call."""

    link: Link
    clock: Clock
    profile: Profile
    bit_rate: BitRate | None
    is_alone: bool
    """True if no other tool can be on this bus: queries need not listen for one first."""
    watch: CallOptions

    @property
    def target(self) -> Target:
        return self.profile.target

    # -- waiting ---------------------------------------------------------------------------------

    def run(
        self,
        engine: Engine,
        *,
        taps: Sequence[Tap] = (),
        may_cancel: bool = True,
        hang_up_ends: Callable[[], bool] | None = None,
        on_event: EventHandler | None = None,
    ) -> None:
        """Run an engine until it is done. `taps` see frames after those of the caller, and
        `on_event` gets events before the caller.

        Without `may_cancel`, only `ends_write` ends it. A closed terminal ends it only while
        `hang_up_ends` returns True.
        """
        drive(
            engine,
            self.link,
            self.clock,
            taps=(*self.watch.get("taps", ()), *taps),
            on_event=partial(self._emit, of_step=on_event),
            cancelled=(
                self._cancellation(hang_up_ends) if may_cancel else self.watch.get("ends_write")
            ),
        )

    def _wait_until(self, moment: float, hang_up_ends: Callable[[], bool]) -> bool:
        """Wait until `moment`. Return True if cancelled or ended by a closed terminal."""
        self.clock.wait_until(moment)
        is_cancelled = self._cancellation(hang_up_ends)
        return is_cancelled is not None and is_cancelled()

    def _cancellation(self, hang_up_ends: Callable[[], bool] | None) -> Callable[[], bool] | None:
        """Return what is asked between frames; None if nothing can cancel."""
        cancelled, hung_up = self.watch.get("cancelled"), self.watch.get("hung_up")
        if hang_up_ends is None or hung_up is None:
            return cancelled
        return lambda: (cancelled is not None and cancelled()) or (hung_up() and hang_up_ends())

    def _emit(self, event: object, of_step: EventHandler | None = None) -> None:
        log_event(event)
        for handle in (of_step, self.watch.get("on_event")):
            if handle is not None:
                handle(event)

    # -- queries -----------------------------------------------------------------------------------

    def listen_first(self, *, may_cancel: bool = True) -> None:
        """Listen for another tool before a query. Raises BusError if one is detected."""
        if not self.is_alone:
            check_no_other_tool(self._survey((), LISTEN_FIRST_S, may_cancel=may_cancel))

    def ask(self, request: Request, *, for_write: str = "") -> Content:
        """Send a request. Raises NoAnswerError, InterruptedByUserError and WrongDeviceError."""
        self.listen_first()
        query = self._query(request, for_write=for_write)
        if query.cancelled:
            raise _interrupted()
        if query.answer is None:
            raise self.link.health().error(str(self.link)) or _no_answer(query)
        return query.answer

    def read(self, item: str | type[Content]) -> Content:
        """Read an item by name, or by the type of its content."""
        return self.ask(Request(self._readable(item).item))

    def _readable(self, item: str | type[Content]) -> Readable:
        items = readable(self.target, self.profile.dialect)
        if isinstance(item, str):
            return find_item(item, items, self.target, "read")
        matching = [each for each in items.values() if each.content is item and not each.field]
        if len(matching) == 1:
            return matching[0]
        names = ", ".join(each.name for each in matching)
        raise UsageError(
            f"{item.__name__} is the content of {len(matching) or 'no'} items of the "
            f"{self.target.node.name}.",
            remedy=f"Read by name: {names or ', '.join(items) or 'there are none'}.",
        )

    def version(self) -> Content:
        """Send the documented version query, or the product's own."""
        request = self.profile.upgrade_options().version_request_for(self.target)
        if request is None:
            raise NoAnswerError(
                f"The {self.target.name} cannot be asked for its version.",
                code=ErrorCode.NOT_IN_DOCUMENTS,
            )
        return self.ask(request)

    def read_memory(self, start: int, end: int) -> bytes:
        """Read memory from `start` up to `end`, exclusive (R5)."""
        if READ_MEMORY.receiver is not self.target.node:
            node = self.target.node.name
            raise UsageError(f"The documents give no way to read memory of the {node}.")
        check_range(start, end)
        self.listen_first()
        reading = self._make_queries(memory_requests(start, end))
        self.run(reading)
        data = b"".join(memory_bytes(each) for each in reading.answers if isinstance(each, Memory))
        if len(data) == end - start:
            return data
        if reading.is_cancelled:
            raise _interrupted()
        error = _no_answer(reading.queries[-1])
        error.where = f"memory at 0x{start + len(data):08X}"
        error.cause = "the address is outside of the readable memory, or the device went away"
        raise error

    def reset(self) -> None:
        """Restart the application by the documented reset, or the product's own (R3)."""
        profile = self.profile
        reset = BY_KEY.get((self.target.request_id, Command.RESET))
        documented = (UpgradeOptions.reset_command, UpgradeOptions.reset_data)
        if reset is None or (profile.reset_command, profile.reset_data) != documented:
            raise NoAnswerError(
                f"The documents give no reset for the {self.target.name}.",
                code=ErrorCode.NOT_IN_DOCUMENTS,
            )
        self.ask(Request(reset, Reset()))

    # -- writing ---------------------------------------------------------------------------------

    def read_before_write(self, plan: WritePlan) -> Content:
        """Read the content before a write."""
        request = Request(plan.writable.read_back.item)
        try:
            return self.ask(request, for_write="Nothing was written.")
        except NoAnswerError as error:
            error.remedy = f"Nothing was written. {error.remedy}"
            raise

    def write_planned(self, plan: WritePlan, before: Content | None) -> WriteResult:
        """Write, wait for general feedback, read back. Failures are in the result.

        The user cannot cancel a write once it has begun; it takes seconds.
        """
        self.listen_first(may_cancel=False)
        request = Request(plan.writable.item, plan.content)
        possible_changes = "Each of them may hold the new value."
        query = self._query(request, may_cancel=False, for_write=possible_changes)
        written = WriteResult(plan, before, query.answer is not None, None)
        for _ in range(2):
            # An answer on a broadcast id may belong to another node's query before the write.
            request = Request(plan.writable.read_back.item)
            second_query = self._query(request, may_cancel=False)
            written = replace(written, read_back=second_query.answer)
            if not written.differences:
                break
        return written

    def write(self, name: str, values: Sequence[object], *, manufacturer: bool) -> WriteResult:
        """Write an item by name and read it back."""
        dialect = self.profile.dialect
        plan = plan_write(name, values, self.target, dialect=dialect, manufacturer=manufacturer)
        before = self.read_before_write(plan)
        written = self.write_planned(plan, before)
        error = written.error()
        if error is not None:
            raise error
        return written

    # -- identification ----------------------------------------------------------------------------

    def identify(self) -> DeviceInfo:
        """Send all documented queries; only listen if there are none."""
        items = readable(self.target, self.profile.dialect)
        queried = [entry for entry in items.values() if not entry.field]
        survey = self._survey(
            [Request(entry.item) for entry in queried],
            INFO_LISTEN_S if queried else INFO_LISTEN_ONLY_S,
        )
        if queried:
            check_no_other_tool(survey)
        queries = dict(zip((entry.name for entry in queried), survey.queries, strict=False))
        readings = tuple(_reading(entry, queries.get(entry.name)) for entry in queried)
        return DeviceInfo(self.target, self.profile.dialect, readings, survey)

    def is_present(self) -> bool:
        """Listen for the device, and send its version query, if any."""
        request = self.profile.upgrade_options().version_request_for(self.target)
        survey = self._survey(
            () if request is None else [request],
            INFO_LISTEN_ONLY_S if request is None else INFO_LISTEN_S,
        )
        check_no_other_tool(survey)
        heard = survey.heard.get(self.target.node)
        return heard is not None and bool(heard.messages)

    def scan(self) -> Survey:
        """Listen for a second, then query version and state of the BMS."""
        items = readable(BMS, self.profile.dialect)
        names = ("version-information", "running-information")
        return self._survey([Request(items[name].item) for name in names], SCAN_LISTEN_S)

    def _survey(
        self, requests: Sequence[Request], listen_s: float, *, may_cancel: bool = True
    ) -> Survey:
        survey = Survey(
            requests,
            listen_s=listen_s,
            bitrate_bps=self.profile.dialect.bitrate_bps,
            dialect=self.profile.dialect,
            timings=self.profile.timings,
        )
        self.run(survey, may_cancel=may_cancel)
        if survey.cancelled:
            raise _interrupted()
        return survey

    def _query(self, request: Request, *, may_cancel: bool = True, for_write: str = "") -> Query:
        """Send a request and return its query. Raises WrongDeviceError if two devices answer during
        a write; `for_write` describes the possible changes.
        """
        queries = self._make_queries([request])
        self.run(queries, may_cancel=may_cancel)
        if for_write and queries.duplicates.evidence:
            raise two_devices_error(self.target, queries.duplicates.evidence, for_write)
        return queries.queries[0]

    def _make_queries(self, requests: Iterable[Request]) -> Queries:
        return Queries(
            requests,
            bitrate_bps=self.profile.dialect.bitrate_bps,
            timings=self.profile.timings,
            stop_at_silence=True,
            counts=not self.is_alone,
        )

    # -- firmware --------------------------------------------------------------------------------

    def plan(self, image: Image | Plan) -> Plan:
        """Plan an upgrade with this image."""
        if isinstance(image, Plan):
            if image.target != self.target:
                planned, own = image.target.node.name, self.target.node.name
                raise UsageError(f"The plan is for a {planned}, and this device is a {own}.")
            return image
        rate = None if self.bit_rate is None else self.bit_rate.bps
        return plan_for(image, self.profile, rate)

    def verify(self, image: Image | Plan, level: Level) -> Verification:
        """Check whether the device runs this image: by its version, then by its memory."""
        plan, options = self.plan(image), self.profile.upgrade_options()
        check_level(plan, level, options)
        if level is Level.NONE:
            return NOT_ASKED
        self.listen_first()
        verification = self.checked(version_check(plan, options))
        if level is Level.MEMORY and verification.ok:
            check = memory_check(plan, options, verification.running_version)
            verification = self.checked(check)
        return verification

    def checked(self, check: Runner[Verification]) -> Verification:
        """Run a verification. Raises InterruptedByUserError if it was cancelled."""
        self.run(check)
        if check.result.verdict is Verdict.INTERRUPTED:
            raise _interrupted()
        return check.result

    def upgrade(
        self,
        image: Image | Plan,
        options: UpgradeOptions | None,
        verify: Level | None,
        identity: Identity | None,
    ) -> Result:
        """Run an upgrade, return its result, and verify a successful one. Raises ImageError for a
        firmware sample on a physical adapter.

        A lost adapter is opened again within the time of the options while an attempt is left.
        Raises BusError, with the progress and the state of the device, if the adapter fails
        permanently or no node on the bus acknowledges; InterruptedByUserError if the user
        interrupts a second time.
        """
        plan = self.plan(image)
        check_sample(plan.image, self.link)
        chosen = options or self.profile.upgrade_options()
        level = default_level(plan.target, chosen) if verify is None else verify
        check_level(plan, level, chosen)
        rate = self.bit_rate
        if rate is not None and rate.bps != plan.bitrate_bps:
            raise UsageError(
                f"The plan is for {plan.bitrate_bps / 1000:g} kbit/s, the bus runs at {rate}.",
                remedy="Make the plan with bitrate_bps of the connection.",
            )
        session = UpgradeSession(plan, chosen, level, identity or Identity())
        return self._session(session, chosen)

    def _session(self, session: UpgradeSession, options: UpgradeOptions) -> Result:
        stalls_s: list[float] = []

        def note_stall(event: object) -> None:
            if isinstance(event, events.HostStalled):
                stalls_s.append(event.stalled_s)

        watch = _LinkWatch(self.link)
        may_end = _may_end(session)
        before = self.link.health()
        self._check_bus("before anything was sent", session, before)
        received: int | None = None
        try:
            while True:
                try:
                    self.run(session, taps=(watch,), hang_up_ends=may_end, on_event=note_stall)
                    break
                except TransmitBlockedError as error:
                    received = self._await_contact(session, error, received)
                except BusError as error:
                    limit_s = inf if watch.has_sent else BRIEF_ADAPTER_RETURN_S
                    wait_s = min(options.adapter_return_s, limit_s)
                    self._await_adapter(session, error, wait_s)
                session.link_back(self.clock.now())
        except (BusError, InterruptedByUserError) as error:
            # The adapter does not know the session.
            error.where = f"{session.progress}; {error.where}".removesuffix("; ")
            _add_device_state(error, session)
            raise
        except KeyboardInterrupt as interrupt:
            interrupted = InterruptedByUserError(
                "Interrupted at once.",
                where=session.progress,
                cause="it may have ended in the middle of a message",
                remedy=AGAIN,
            )
            _add_device_state(interrupted, session)
            raise interrupted from interrupt
        outcome, slept_s = session.result.outcome, watch.slept_s()
        if slept_s > STALL_S:  # nothing was received then, and another unit may have been connected
            outcome = replace(outcome, unobserved_s=outcome.unobserved_s + slept_s)
        result = replace(session.result, outcome=outcome, stalled_s=sum(stalls_s))
        silence = result.error()
        if isinstance(silence, NoAnswerError):
            self._check_bus(silence.where, session, before)
        return result

    def _check_bus(self, where: str, session: UpgradeSession, before: LinkHealth) -> None:
        """Raise BusError if the bus is silent, not only the device, or if the adapter was bus-off
        since `before` and came back automatically, so that messages were lost.
        """
        health, where = self.link.health(), f"{where}; {self.link}"
        error, trouble = health.error(where), health.last_trouble
        is_new = trouble is not before.last_trouble
        if error is None and is_new and trouble is not None and trouble.kinds & _WAS_OFF:
            error = bus_off_error(where, "The adapter was off the bus for a while.")
        if error is not None:
            _add_device_state(error, session)
            raise error

    def _await_contact(
        self, session: UpgradeSession, blocked: TransmitBlockedError, reported_at: int | None
    ) -> int:
        """Continue a session whose frames are not sent, because a device without power does not
        acknowledge any. Reports it if frames arrived since the last report, at `reported_at`
        frames; returns the number of received frames. Raises the error if the device still has an
        application to lose, or if the overall deadline leaves no time.
        """
        left_s = (session.deadline_at or inf) - self.clock.now()
        if not session.goes_on or left_s <= SEND_LIMIT_S + _REOPEN_PAUSE_S:
            raise blocked
        received = self.link.health().frames_received
        if received != reported_at:
            self._emit(events.BusBlocked(blocked.what, left_s))
        self._wait_until(self.clock.now() + _REOPEN_PAUSE_S, _may_end(session))
        return received

    def _await_adapter(self, session: UpgradeSession, lost: BusError, wait_s: float) -> None:
        """Wait for a lost adapter while an attempt is left; else raise BusError."""
        if not session.may_begin_again or not wait_s:
            raise lost
        self._emit(events.AdapterLost(lost.what, wait_s))
        self._reopen(session, lost, wait_s)
        self._emit(events.AdapterBack())

    def _reopen(self, session: UpgradeSession, lost: BusError, wait_s: float) -> None:
        """Open a lost adapter again as soon as it is back. Raises BusError after the time limit or
        the overall deadline, InterruptedByUserError if the user cancels.
        """
        now = self.clock.now()
        give_up_at = now + wait_s
        if session.deadline_at is not None:
            if now >= session.deadline_at:
                raise lost
            give_up_at = min(give_up_at, session.deadline_at)
        reported_s = ceil(wait_s)
        self._emit(events.AdapterAwaited(reported_s))
        is_cancelled = self._wait_until(now, _may_end(session))
        while True:
            if is_cancelled:
                raise InterruptedByUserError(
                    "Interrupted while the adapter was away.",
                    where=lost.where,
                    cause=lost.what,
                    remedy=f"Plug the adapter in. {AGAIN}",
                ) from lost
            try:
                self.link.reopen()
            except BusError as error:
                now = self.clock.now()
                if now >= give_up_at:
                    # Why it does not open now determines the remedy; the loss itself may be over.
                    error.where = error.where or lost.where
                    error.remedy = f"{error.remedy} {AGAIN}" if error.remedy else lost.remedy
                    error.cause = f"{error.cause}; it was lost with: {lost.what.rstrip('.')}"
                    if error.code is ErrorCode.ADAPTER_NOT_OPENED:
                        error.code = ErrorCode.ADAPTER_LOST
                    raise
                left_s = ceil(give_up_at - now)
                if left_s < reported_s:
                    reported_s = left_s
                    self._emit(events.AdapterAwaited(left_s))
                until = min(give_up_at, now + _REOPEN_PAUSE_S)
                is_cancelled = self._wait_until(until, _may_end(session))
            else:
                return


def plan_for(image: Image, profile: Profile, bitrate_bps: int | None) -> Plan:
    """Plan an upgrade of a profile's device with this image. Raises ImageError and UsageError."""
    profile.check_fits(image)
    return make_plan(
        image,
        profile.target,
        profile.dialect,
        bitrate_bps=bitrate_bps,
        has_upgrade=profile.has_upgrade,
    )


def check_sample(image: Image, link: Link) -> None:
    """Raise ImageError for a firmware sample on a physical adapter."""
    if is_sample(image) and link.is_physical:
        raise sample_error(image, str(link))


class _LinkWatch:
    """Tap of an upgrade that notes its first sent frame, and ends it when the adapter is off."""

    def __init__(self, link: Link) -> None:
        self.has_sent = False
        self._link = link
        self._slept_before_s = 0.0

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent and not self.has_sent:
            self.has_sent, self._slept_before_s = True, suspended_s()
        elif frame.is_error and self._link.is_off:  # messages are lost until it ends
            raise bus_off_error(str(self._link))

    def slept_s(self) -> float:
        """Time for which this computer was suspended since the first frame was sent."""
        return suspended_s() - self._slept_before_s if self.has_sent else 0.0


def _may_end(session: UpgradeSession) -> Callable[[], bool]:
    """Return a function that is True until the device erases: a hang-up may end a session."""
    return lambda: not session.has_begun_to_erase


def _add_device_state(error: FlasherError, session: UpgradeSession) -> None:
    left = session.device_left
    error.remedy = f"{error.remedy} State of the device: {wording(left)}.".lstrip()
    error.needs_rescue = left.needs_rescue


def _interrupted() -> InterruptedByUserError:
    return InterruptedByUserError("Interrupted by the user.")


def check_no_other_tool(survey: Survey) -> None:
    if survey.other_tool_heard:
        raise BusError(
            "Another tool sends on this bus; nothing was queried or written.",
            where="while listening first",
            cause="an upgrade or a test is under way",
            remedy="Wait until it has ended. flasher monitor listens without asking.",
            code=ErrorCode.SECOND_TOOL,
        )


def _no_answer(query: Query) -> NoAnswerError:
    item = query.request.item
    node = item.receiver.name if item.receiver else "bus"
    misfit = query.misformatted
    if misfit is None:
        cause = "it is off, asleep or not connected, it speaks the other dialect, or it is an older"
        cause += " device that does not know the query"
    else:
        cause = f"it answers in another form: {misfit.command:04X} with {len(misfit.data)} bytes"
        cause += f", not {query.request.answer_item.command:04X}"
    return NoAnswerError(
        f"The {node} did not answer {item.title!r}.",
        where=f"message {item.name}, sent {query.tries} times",
        cause=cause,
        remedy="List the devices on the bus with flasher scan; wake the device with its key.",
    )


def two_devices_error(target: Target, evidence: str, written: str) -> WrongDeviceError:
    """Create the error for two devices instead of one; `written` describes possible changes."""
    return WrongDeviceError(
        f"{target.node.name}: two devices answer on the same id ({evidence}).",
        cause=TWO_DEVICES_CAUSE,
        remedy=f"{written} Disconnect one of them.",
        code=ErrorCode.TWO_DEVICES,
    )


def in_bootloader_error(target: Target, boot_version: str) -> NoAnswerError:
    """Create the error for a device that answers no query, because its bootloader runs."""
    node = target.node.name
    return NoAnswerError(
        f"The {node} is in its bootloader ({boot_version}): it answers no query there.",
        cause="an upgrade was interrupted, or its application does not start",
        remedy=f"A complete upgrade makes it run again: flasher flash IMAGE -t {target.name}.",
    )


def nothing_received_error(survey: Survey, bitrate_bps: int) -> NoAnswerError:
    """Create the error for a bus without messages of any documented node."""
    count = survey.foreign_frames
    foreign = f"{count:,} frame{'' if count == 1 else 's'} under ids of other protocols came"
    return NoAnswerError(
        f"No device of the drive system sent anything at {bitrate_bps / 1000:g} kbit/s"
        f"{f'; {foreign}' if count else ''}.",
        cause="everything is off or asleep, the wiring is open, or the bit rate is wrong",
        remedy="Switch the system on. Or try --dialect motinova (125 kbit/s) or welling (250).",
        code=ErrorCode.NOBODY_HEARD,
    )


def _reading(entry: Readable, query: Query | None) -> ItemReading:
    if query is None:
        return ItemReading(entry.name, entry.item, None, was_asked=False)
    misfit = ""
    if query.answer is None and query.misformatted is not None:
        answer = query.misformatted
        misfit = f"{answer.command:04X} with {len(answer.data)} bytes, mode {answer.mode:02X}"
    return ItemReading(entry.name, entry.item, query.answer, misfit)
