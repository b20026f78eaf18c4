"""One target of the unit in a socket: its `Device` and the station's own requests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from flasher.api import Connection
from flasher.bus.link import AT_ONCE
from flasher.errors import ErrorCode, InterruptedByUserError, NoAnswerError
from flasher.host.identify import identify
from flasher.host.identity import DeviceAnswers
from flasher.host.items import Readable, meaningful_fields
from flasher.host.query import Request
from flasher.host.runner import Runner, Stage
from flasher.jobs import prepare
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import Reset
from flasher.protocol.engine import Engine, Tap
from flasher.protocol.fields import Content
from flasher.protocol.spec import Command
from flasher.station.codes import Code
from flasher.station.continuity import Continuity
from flasher.station.power import PowerControl
from flasher.station.presence import SILENCE_S
from flasher.station.recipe_file import LoadedTarget

_LOOK_EVERY_S: Final = 0.05
_SHARE_OF_TRIES: Final = 0.8
"""Share of the time for all tries of a packet in which a present device sends a frame."""
_WAITING_MAX: Final = 10_000
"""Maximum number of frames processed at once, so that a babbling bus cannot block a run."""


class StepFailedError(Exception):
    """A try of a step failed; the run decides whether to try again."""

    def __init__(self, code: Code, text: str, *, needs_rescue: bool = False) -> None:
        super().__init__(text)
        self.code = code
        self.text = text
        self.needs_rescue = needs_rescue


@dataclass(frozen=True)
class Identified:
    """Identity that a device reports before the first write."""

    seen: DeviceAnswers
    is_in_bootloader: bool
    two_devices: str
    """Evidence of a second unit, as a sentence; "" without any."""

    @property
    def serial_number(self) -> str:
        """The reported serial number; "" without one."""
        return str(getattr(self.seen.version, "serial_number", ""))


class UnitTarget:
    """A target on the bus. Methods raise BusError, InterruptedByUserError."""

    def __init__(
        self,
        loaded: LoadedTarget,
        connection: Connection,
        continuity: Continuity,
        taps: Sequence[Tap],
        cancelled: Callable[[], bool],
        is_lost: Callable[[], bool],
    ) -> None:
        self.loaded = loaded
        self.name = loaded.name
        self.clock = connection.clock
        self.continuity = continuity
        self.watcher = continuity.watcher
        self.may_restart = continuity.may_restart
        self._taps = taps
        # No other program uses this adapter, and each flash listens for other tools itself.
        self.device = connection.device(
            profile=loaded.profile,
            is_alone=True,
            taps=taps,
            cancelled=cancelled,
            ends_write=is_lost,
        )
        rate = connection.bit_rate
        self.job = prepare(
            loaded.image,
            loaded.profile,
            bitrate_bps=None if rate is None else rate.bps,
            # A unit fails that does not take its image in one session (`may_restart`: in some
            # attempts); another tool is a fault of the station.
            options=loaded.profile.upgrade_options(
                attempts=loaded.profile.attempts,
                waits_for_other_tool=False,
                single_session=not self.may_restart,
            ),
            # Units without an application are flashed too.
            identity=loaded.identity,
        )
        self.version_request = self.job.options.version_request_for(loaded.target)
        """Version request for this target; None if unknown."""
        self._cancelled = cancelled

    # -- requests ---------------------------------------------------------------------------------

    def identify(self) -> Identified:
        """Request the version; no answer is not an error here. After power-up a device passes
        through its bootloader (R19): it has no application only if it keeps announcing itself.
        """
        identified = self._identify_once()
        if not identified.is_in_bootloader or self.version_request is None:
            return identified
        until = self.clock.now() + self.loaded.profile.timings.announcing_on_s
        with suppress(NoAnswerError):
            # Asked without a reset: the answer reveals the application of a second unit.
            self.device.version()
        self.listen(until - self.clock.now(), self._is_quiet)
        if not self._is_quiet(self.clock.now()) or self.await_application() is None:
            return identified
        return self._identify_once()

    def _identify_once(self) -> Identified:
        asking = identify(self.job.plan, self.job.options)
        before = self.watcher.announcements
        self.run(asking)
        asked = asking.result
        announced = asked.announcement is not None or self.watcher.announcements > before
        return Identified(asked.answers, announced, asked.two_devices)

    def is_silent(self, identified: Identified) -> bool:
        """True if the target did not answer a version request."""
        asked = self.version_request is not None
        return asked and identified.seen.version is None and not identified.is_in_bootloader

    def await_application(self) -> Content | None:
        """Request the version until the application answers. None if it does not start in time or
        no longer answers.
        """
        may_start = self.may_restart or not self.continuity.is_running
        start_s = self.loaded.profile.timings.application_start_timeout_s
        give_up_at = self.clock.now() + (start_s if may_start else SILENCE_S)
        while True:
            try:
                answer = self.device.version()
            except NoAnswerError:
                if self.clock.now() >= give_up_at:
                    return None
            else:
                self.check_cancelled()
                self.continuity.settle()
                return answer

    def identify_after_failure(self) -> None:
        """Request and receive after a failed transfer, so that `continuity` can compare the unit.
        Waits for a silent device, which announces itself when its power returns.
        """
        timings = self.loaded.profile.timings
        tried_s = timings.packet_tries * timings.ack_timeout_s
        received_at, silence_s = self.watcher.received_at, min(SILENCE_S, _SHARE_OF_TRIES * tried_s)
        is_silent = received_at is None or self.clock.now() - received_at >= silence_s
        if self.version_request is None:
            self.listen(timings.boot_version_timeout_s if is_silent else 0.0)
        elif is_silent:
            self.await_application()
        else:
            with suppress(NoAnswerError):
                self.device.version()

    def confirm(self) -> None:
        """Request the version again, unless the target has restarted since its last answer;
        `continuity` compares the answer. Raises StepFailedError if the application no longer
        answers.
        """
        self.process_queued_frames()
        self.check_cancelled()
        if not self.continuity.is_running or self.await_application() is not None:
            return
        if not self.may_restart:
            raise StepFailedError(Code.UNIT_CHANGED, f"The {self.name} stopped answering.")

    def process_queued_frames(self) -> None:
        """Process the frames that are queued in the driver."""
        link = self.device.connection.link
        for _ in range(_WAITING_MAX):
            frame = link.receive(AT_ONCE)
            if frame is None:
                return
            for tap in self._taps:
                tap(frame, sent=False, now=self.clock.now())

    def read(self, what: Readable) -> Mapping[str, tuple[object, str]]:
        """Read an item; returns value and text of each field. Raises NoAnswerError."""
        content = self.device.ask(Request(what.item))
        return {
            name: (getattr(content, name), codec.show(getattr(content, name)))
            for name, codec in meaningful_fields(type(content))
            if what.field in ("", name)
        }

    # -- restart ----------------------------------------------------------------------------------

    def restart(self, power: PowerControl | None) -> bool:
        """Switch the unit off and on, or reset the target by a message without `power`. True if its
        bootloader announced itself afterwards. Raises NoAnswerError.
        """
        watcher, before = self.watcher, self.watcher.announcements
        if power is not None:
            power.begin_cycle()
        else:
            item = BY_KEY.get((self.loaded.target.request_id, Command.RESET))
            if item is None:
                raise NoAnswerError(
                    f"The documents give no reset for the {self.name}.",
                    code=ErrorCode.NOT_IN_DOCUMENTS,
                )
            self.device.ask(Request(item, Reset()))

        def is_over(now: float) -> bool:
            return watcher.announcements > before and self._is_quiet(now)

        self.listen(self.loaded.profile.timings.boot_version_timeout_s, is_over)
        if power is not None:
            power.check()
        return watcher.announcements > before

    def _is_quiet(self, now: float) -> bool:
        announced_at = self.watcher.announced_at
        return announced_at is None or now - announced_at >= self.continuity.quiet_s

    # -- engines ----------------------------------------------------------------------------------

    def check_cancelled(self) -> None:
        """Check whether the run must end. Raises InterruptedByUserError."""
        if self._cancelled():
            raise InterruptedByUserError("The run has to end.")

    def listen(self, limit_s: float, enough: Callable[[float], bool] = lambda _now: False) -> None:
        """Receive without sending for `limit_s`, or until `enough(now)` is true."""

        def stage(run: Runner[None]) -> Stage[None]:
            ends_at = run.now + limit_s
            while run.now < ends_at and not run.is_cancelled and not enough(run.now):
                yield min(run.now + _LOOK_EVERY_S, ends_at)  # `enough` may wait for a silence

        self.run(Runner(stage, bitrate_bps=self.loaded.profile.dialect.bitrate_bps))

    def run(self, engine: Engine, on_event: Callable[[object], None] | None = None) -> None:
        self.device.run(engine, on_event=on_event)
        self.check_cancelled()
