"""State of the bench, as shown on its page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path

from flasher import events
from flasher.api import DeviceInfo, Result
from flasher.errors import FlasherError
from flasher.history import Flash
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

    @property
    def name(self) -> str:
        """File name for display."""
        return visible(self.path.name)


@dataclass(frozen=True)
class Done:
    """A finished upgrade. Transferred, completed and running are separate facts; None: unknown."""

    at: datetime
    adapter: Adapter
    target: Target
    offer: Offer
    checks: tuple[events.CheckMade, ...]
    before: DeviceInfo | None
    packet: int
    """Number of packets that the device acknowledged in the best attempt."""
    result: Result | None
    """None if the adapter failed or a user ended the upgrade at once."""
    error: FlasherError | None
    bundle: Path | None
    after: DeviceInfo | None = None
    warning: str = ""
    """Reason why the history lacks the upgrade; "" if it has it."""

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
    def may_rescue_with_it(self) -> bool:
        """True if the device needs an image and has not refused this one."""
        error = self.error
        return error is not None and error.needs_rescue and not self.is_refused

    @property
    def is_refused(self) -> bool:
        return self.error is not None and self.error.exit_code is self.error.exit_code.REFUSED


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

    @property
    def is_sure(self) -> bool:
        """True if version or memory are the image's."""
        good = self.verification.verdict
        return good in (Verdict.VERSION_RIGHT, Verdict.MEMORY_RIGHT)


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
    offers: tuple[Offer, ...] = ()
    offer: Offer | None = None
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
    trouble: FlasherError | None = None
    """Error of the last step; upgrades have theirs in `done`."""

    @property
    def is_idle(self) -> bool:
        return self.doing is Activity.NOTHING

    def power_cycle_left_s(self, now_s: float) -> int:
        """Whole seconds left to switch the device off and on."""
        if self.power_cycle_s is None:
            return 0
        return max(0, round(self.power_cycle_s - (now_s - self.power_cycle_since_s)))
