"""State of the bench, as shown on its page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from hashlib import sha256
from pathlib import Path

from flasher import events
from flasher.api import DeviceInfo, Result
from flasher.errors import FlasherError
from flasher.history import Flash
from flasher.host.options import serial_number
from flasher.host.verify import Verdict, Verification
from flasher.protocol.spec import Target
from flasher.report.base import visible
from flasher.settings.area import Area
from flasher.trace.decoder import BusEvent


class Activity(Enum):
    """Work that the bench is doing, shown on its page."""

    NOTHING = "nothing"
    ADAPTERS = "adapters"
    LOOKING = "looking"
    JUDGING = "judging"
    UPGRADING = "upgrading"
    LOOKING_AGAIN = "looking_again"
    WATCHING = "watching"
    SAVING = "saving"
    COMPARING = "comparing"
    SERIES = "series"


@dataclass(frozen=True)
class Adapter:
    """A CAN adapter with a bike, or a virtual bike."""

    name: str
    note: str = ""
    was_last: bool = False
    """True for the adapter that was used last."""


@dataclass(frozen=True)
class Offer:
    """An image file that was checked for the target: it fits, or `refusal` has the reason."""

    path: Path
    version: str = ""
    size_bytes: int = 0
    packets: int = 0
    wire_s: float = 0.0
    sha256: str = ""
    checks: tuple[events.CheckMade, ...] = ()
    refusal: FlasherError | None = None
    waived: tuple[str, ...] = ()
    """Names of checks that were waived for the image (flasher.host.waivers)."""
    origin: str = ""
    """Who signed the image, or that nobody did, as a sentence."""
    warnings: tuple[str, ...] = ()
    parts: tuple[tuple[Target, Offer], ...] = ()
    """Images of a set for the whole bike, in the order of the upgrades."""

    @property
    def name(self) -> str:
        """File name for display."""
        return visible(self.path.name)


@dataclass(frozen=True)
class UpgradeEnding:
    """End of an upgrade: result or error, bundle and entry in the history."""

    result: Result | None
    """None if the adapter failed or a user ended the upgrade at once."""
    error: FlasherError | None
    bundle: Path | None
    warning: str = ""
    """Reason why the history lacks the upgrade; "" if it has it."""


@dataclass(frozen=True, kw_only=True)
class Done(UpgradeEnding):
    """A finished upgrade. Transferred, completed and running are separate facts; None: unknown."""

    at: datetime
    adapter: Adapter
    target: Target
    offer: Offer
    checks: tuple[events.CheckMade, ...]
    before: DeviceInfo | None
    packet: int
    """Number of packets that the device acknowledged in the best attempt."""
    after: DeviceInfo | None = None

    @property
    def is_transferred(self) -> bool | None:
        return None if self.result is None else self.result.outcome.is_transferred

    @property
    def is_completed(self) -> bool | None:
        return None if self.result is None else self.result.outcome.is_completed

    @property
    def is_running(self) -> bool | None:
        """True if the application answered and does not contradict the new version; False as well
        if a bootloader announces itself instead.
        """
        result = self.result
        if result is None:
            return None
        if (
            result.running_version is None
            and result.verification.verdict is not Verdict.IN_BOOTLOADER
        ):
            return None
        return result.ok

    @property
    def is_sure(self) -> bool:
        """True if the device runs the image, by its own report."""
        if self.error is not None or self.result is None:
            return False
        return self.result.outcome.nothing_to_do or bool(self.is_running and self.is_completed)

    @property
    def may_rescue_with_it(self) -> bool:
        """True if the device needs an image and has not refused this one."""
        error = self.error
        return error is not None and error.needs_rescue and not self.is_refused

    @property
    def is_refused(self) -> bool:
        return self.error is not None and self.error.exit_code is self.error.exit_code.REFUSED


@dataclass(frozen=True)
class SetDevice:
    """A device in the upgrade of a whole bike."""

    target: Target
    offer: Offer
    done: Done | None = None
    """None before its upgrade has ended."""
    battery: str = ""
    """Serial number of the battery at its upgrade; "" if unknown."""


@dataclass(frozen=True)
class SeenMessage:
    """Latest message of one kind on the bus."""

    seen: BusEvent
    changed: frozenset[str]
    """Names of fields that changed recently."""
    count: int
    rate_hz: float | None


@dataclass(frozen=True)
class BusWatch:
    """Bus traffic since the view was started."""

    since_s: float
    messages: int
    troubles: int
    board: tuple[SeenMessage, ...]


@dataclass(frozen=True)
class Saved:
    """A completed backup."""

    path: Path
    size_bytes: int
    area: Area | None
    """Memory area that was read; None without memory."""
    running_version: str
    """Firmware version that the device reported; "" without one."""
    names_running_version: bool | None
    """True if the memory contains that version; None if memory or version is missing."""
    items: tuple[str, ...]
    """Titles of the answers in the backup."""
    missing: Mapping[str, str]
    """Reason why each missing item could not be read, by item."""


@dataclass(frozen=True)
class Compared:
    """Comparison of the device with the chosen image."""

    offer: Offer
    verification: Verification
    memory_not_compared: str | None
    """Reason why the memory was not compared; None if it was."""
    error: FlasherError | None
    """Why the device does not run the image; None if it does, as far as it was compared."""
    serial: str | None = None
    """Serial number of the unit; "": it has none; None: it did not report any."""

    @property
    def is_sure(self) -> bool:
        """True if version or memory are the image's."""
        good = self.verification.verdict
        return good in (Verdict.VERSION_RIGHT, Verdict.MEMORY_RIGHT)


class SeriesStep(Enum):
    """What a series waits for or does."""

    REMOVAL = "removal"
    """The last unit is still connected."""
    UNIT = "unit"
    """Nothing is connected."""
    READING = "reading"
    ASKED = "asked"
    """A user has to agree first."""
    REFUSED = "refused"
    """The image is not for the unit that is connected."""
    SHOWN = "shown"
    """The upgrade starts when the time is over."""
    UPGRADING = "upgrading"
    ADAPTER = "adapter"
    """The adapter is lost."""


@dataclass(frozen=True)
class Series:
    """A series that is under way (flasher.web.series)."""

    step: SeriesStep
    serial: str = ""
    running: str = ""
    """Firmware version that the unit reports."""
    why: str = ""
    """Reason of a question."""
    question: int = 0
    """Number of the question, so that a late answer is not taken for the next one."""
    refusal: FlasherError | None = None
    left_s: int = 0
    """Seconds until the upgrade starts."""


@dataclass(frozen=True)
class SessionEntry:
    """An upgrade since the page's server was started, or a unit that was left out of a series."""

    at: datetime
    target: Target
    serial: str
    image: str
    error: FlasherError | None
    is_left_out: bool = False


@dataclass(frozen=True)
class BenchState:
    """Complete state of the bench page."""

    doing: Activity = Activity.NOTHING
    is_rescue: bool = False
    unfinished: Flash | None = None
    """Latest upgrade of this computer that left its device without an application, or perhaps."""
    adapters: tuple[Adapter, ...] = ()
    was_looked_for: bool = False
    adapter: Adapter | None = None
    bike: DeviceInfo | None = None
    """Detected devices and the battery's answers before the upgrade."""
    areas: tuple[Area, ...] | None = None
    """Memory areas offered for a backup; None if no choice is open."""
    saved_bytes: int = 0
    """Number of bytes of memory read for a backup so far."""
    saved: Saved | None = None
    compared: Compared | None = None
    compared_bytes: int = 0
    """Number of bytes of memory compared so far."""
    watched: BusWatch | None = None
    dropped: tuple[str, ...] = ()
    target: Target | None = None
    """The device to upgrade; of a whole bike the one that is being upgraded."""
    is_bike: bool = False
    """The whole bike is chosen, and the offers are sets of images."""
    devices: tuple[SetDevice, ...] = ()
    """Devices of the whole bike, in the order of their upgrades; empty before it began."""
    offers: tuple[Offer, ...] = ()
    offer: Offer | None = None
    keeps_settings: bool | None = None
    """Save the settings before an upgrade and restore them after it; None: the device has none."""
    waived: frozenset[tuple[str, str]] = frozenset()
    """Names of images, each with a check that was waived."""
    phase: events.Phase | None = None
    packet: int = 0
    """Number of packets that the device acknowledged in this attempt."""
    furthest: int = 0
    """Number of packets that the device acknowledged in the best attempt."""
    repetitions: int = 0
    transfer_began_s: float | None = None
    now_s: float = 0.0
    """Present time of the bench in monotonic seconds."""
    power_cycle_s: float | None = None
    """Seconds in which the user has to switch the device off and on; None: not needed."""
    power_cycle_since_s: float = 0.0
    """Time of the bench's clock at which that began."""
    adapter_left_s: int | None = None
    """Seconds left in which a lost adapter may return; None: not lost."""
    checks: tuple[events.CheckMade, ...] = ()
    notes: tuple[str, ...] = ()
    is_stopping: bool = False
    done: Done | None = None
    series: Series | None = None
    """None while it is switched off."""
    session: tuple[SessionEntry, ...] = ()
    trouble: FlasherError | None = None
    """Error of the last step; upgrades have theirs in `done`."""

    @property
    def battery(self) -> str:
        """Serial number of the battery that is shown; "" if it is unknown."""
        return "" if self.bike is None or self.is_rescue else serial_number(self.bike.version)

    @property
    def selection(self) -> str:
        """Digest of all that an upgrade depends on, so that only what a page shows is upgraded."""
        adapter = self.adapter and self.adapter.name
        shown = (adapter, self.battery, self.target, self.is_rescue, self.keeps_settings)
        offer = self.offer and (self.offer.path, self.offer.sha256, self.offer.waived)
        return sha256(repr((shown, offer)).encode()).hexdigest()

    @property
    def is_idle(self) -> bool:
        return self.doing is Activity.NOTHING

    @property
    def is_sure(self) -> bool:
        """True if the device, or each one of the bike, runs its image by its own report."""
        ended = [each.done for each in self.devices] or [self.done]
        return all(each is not None and each.is_sure for each in ended)

    @property
    def done_count(self) -> int:
        """Number of upgrades of the session that succeeded."""
        return sum(each.error is None for each in self.session)

    @property
    def failed_count(self) -> int:
        """Number of upgrades of the session that failed."""
        return sum(each.error is not None and not each.is_left_out for each in self.session)

    def power_cycle_left_s(self, now_s: float) -> int:
        """Whole seconds left to switch the device off and on."""
        if self.power_cycle_s is None:
            return 0
        return max(0, round(self.power_cycle_s - (now_s - self.power_cycle_since_s)))
