"""One target of the unit in the socket: asked, restarted, compared, on an open connection.

Nothing here decides what a bad answer means: `unit_run` does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from flasher.api import Connection, make_plan, release_checked, release_options
from flasher.driver import Tap, drive
from flasher.errors import NoAnswerError
from flasher.host.identify import Identify
from flasher.host.identity import Identity, Seen
from flasher.host.items import Readable, meaningful_fields
from flasher.host.options import UpgradeOptions, firmware_version
from flasher.host.query import Request
from flasher.host.verify import MemoryCheck, Verification
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.contents import Reset
from flasher.protocol.engine import Engine
from flasher.protocol.fields import Content
from flasher.protocol.spec import Command
from flasher.station.listening import BootWatcher, Listen
from flasher.station.messages import CancelledError, PowerControl
from flasher.station.recipe_file import LoadedTarget

BURST_QUIET_S: Final = 0.3
"""No further announcement for so long: the burst (4 of them, 50 ms apart) is over."""
NO_SERIAL: Final = ""


@dataclass(frozen=True)
class Identified:
    """What a device said of itself before the first write."""

    seen: Seen
    is_in_bootloader: bool
    answers: int
    """Different version answers: two are two devices."""

    @property
    def serial_number(self) -> str:
        """Its own; empty where it does not say it."""
        return str(getattr(self.seen.version, "serial_number", NO_SERIAL))


class UnitDevice:
    """A target on the bus. Methods raise BusError, and CancelledError when the run is to end."""

    def __init__(
        self,
        loaded: LoadedTarget,
        connection: Connection,
        taps: Sequence[Tap],
        cancelled: Callable[[], bool],
    ) -> None:
        self.loaded = loaded
        self.connection = connection
        profile = loaded.profile
        self.watcher = BootWatcher(loaded.target, profile.timings)
        self.taps: tuple[Tap, ...] = (*taps, self.watcher)
        self.cancelled = cancelled
        self.image = release_checked(loaded.image, loaded.release)
        rate = connection.bit_rate
        self.plan = make_plan(
            self.image,
            loaded.target,
            profile.dialect,
            bitrate_bps=None if rate is None else rate.bps,
            has_upgrade=profile.has_upgrade,
        )

    @property
    def identity(self) -> Identity:
        """What is checked before an upgrade. A unit without an application is rescued here."""
        loaded = self.loaded
        return loaded.profile.identity(release=loaded.release, goes_on_unchecked=True)

    @property
    def name(self) -> str:
        """The target's name."""
        return self.loaded.name

    @property
    def version_request(self) -> Request | None:
        """How it is asked for its version; None where nobody knows."""
        return self.options().version_request_for(self.loaded.target)

    def options(self, **overrides: object) -> UpgradeOptions:
        """The options of an upgrade, those of the product."""
        profile = self.loaded.profile
        return release_options(profile.upgrade_options(**overrides), self.loaded.release)

    # -- asking -----------------------------------------------------------------------------------

    def identify(self) -> Identified:
        """Ask it who it is; silence is no error here. One that has just been switched on passes
        through its bootloader (R19): only one that goes on announcing itself has no application.
        """
        found = self._identify_once()
        if not found.is_in_bootloader or self.version_request is None:
            return found
        if not self._is_burst_over() or self.await_application() is None:
            return found
        return self._identify_once()

    def _is_burst_over(self) -> bool:
        """Listen; False when the announcements go on for longer than a burst takes."""
        self.run(Listen(self.loaded.profile.timings.announcing_on_s, self._is_quiet))
        return self._is_quiet(self.connection.clock.now())

    def _is_quiet(self, now: float) -> bool:
        announced_at = self.watcher.announced_at
        return announced_at is None or now - announced_at >= BURST_QUIET_S

    def _identify_once(self) -> Identified:
        asked = Identify(self.plan, self.options())
        before = self.watcher.announcements
        self.run(asked)
        announced = asked.heard is not None or self.watcher.announcements > before
        return Identified(asked.seen, announced, len(asked.answers))

    def version(self) -> Content:
        """Its answer to the version request. Raises NoAnswerError."""
        request = self.version_request
        if request is None:
            raise NoAnswerError(f"The {self.name} cannot be asked for its version.")
        return self.query(request)

    def running_version(self) -> str:
        """The firmware version that it answers, escaped. Raises NoAnswerError."""
        return firmware_version(self.version())

    def await_application(self) -> Content | None:
        """Its version answer as soon as it runs; None when it does not in the time of a start."""
        clock = self.connection.clock
        give_up_at = clock.now() + self.loaded.profile.timings.application_start_timeout_s
        while True:
            try:
                return self.version()
            except NoAnswerError:
                if clock.now() >= give_up_at:
                    return None

    def query(self, request: Request) -> Content:
        """Ask one question. Raises NoAnswerError."""
        # Nobody else has this adapter, and each flash listens itself.
        device = self.connection.device(profile=self.loaded.profile, is_alone=True)
        answer = device.ask(request, taps=self.taps, cancelled=self.cancelled)
        self.check_cancelled()
        return answer

    def read(self, what: Readable) -> Mapping[str, tuple[object, str]]:
        """The fields of something readable: value, and as it is shown. Raises NoAnswerError."""
        content = self.query(Request(what.item))
        return {
            name: (getattr(content, name), codec.show(getattr(content, name)))
            for name, codec in meaningful_fields(type(content))
            if what.field in ("", name)
        }

    def check_memory(self, version: str, on_event: Callable[[object], None]) -> Verification:
        """Read the whole image back."""
        check = MemoryCheck(self.plan, self.options(), version)
        self.run(check, on_event)
        if check.verification is None:
            raise CancelledError
        return check.verification

    # -- restarting -------------------------------------------------------------------------------

    def restart(self, power: PowerControl | None) -> bool:
        """Switch it off and on, or reset it; True when its bootloader then announced itself."""
        before = self.watcher.announcements
        if power is not None:
            power.begin_cycle()
        else:
            self.reset()
        self.await_burst(before)
        if power is not None:
            power.check()
        return self.watcher.announcements > before

    def reset(self) -> None:
        """Tell its application to restart, by the documented command. Raises NoAnswerError."""
        item = BY_KEY.get((self.loaded.target.request_id, Command.RESET))
        if item is None:
            raise NoAnswerError(f"The documents give no reset for the {self.name}.")
        self.query(Request(item, Reset()))

    def await_burst(self, before: int) -> None:
        """Listen until the bootloader announced itself, more often than `before`, and went on."""
        watcher = self.watcher

        def over(now: float) -> bool:
            return watcher.announcements > before and self._is_quiet(now)

        self.run(Listen(self.loaded.profile.timings.boot_version_timeout_s, over))

    # -- running ----------------------------------------------------------------------------------

    def check_cancelled(self) -> None:
        """Raises CancelledError when the run is to end."""
        if self.cancelled():
            raise CancelledError

    def run(self, engine: Engine, on_event: Callable[[object], None] | None = None) -> None:
        drive(
            engine,
            self.connection.link,
            self.connection.clock,
            taps=self.taps,
            on_event=on_event,
            cancelled=self.cancelled,
        )
        self.check_cancelled()


def is_silent(device: UnitDevice, found: Identified) -> bool:
    """It could have answered, and did not."""
    asked = device.version_request is not None
    return asked and found.seen.version is None and not found.is_in_bootloader
