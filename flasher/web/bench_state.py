"""What the bench shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path

from flasher import events
from flasher.api import DeviceInfo, Result
from flasher.errors import FlasherError
from flasher.protocol.spec import Target
from flasher.report.base import visible
from flasher.settings.area import Area
from flasher.trace.decoder import BusEvent


class Activity(Enum):
    """What the bench does now."""

    NOTHING = "nothing"
    ADAPTERS = "adapters"
    LOOKING = "looking"
    JUDGING = "judging"
    UPGRADING = "upgrading"
    LOOKING_AGAIN = "looking_again"
    WATCHING = "watching"
    SAVING = "saving"


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
    waived: tuple[str, ...] = ()
    """Names of the checks that somebody has waived for it (flasher.host.waivers)."""

    @property
    def name(self) -> str:
        """As a page shows it."""
        return visible(self.path.name)


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
    warning: str = ""
    """Why the history has nothing of it; empty where it has."""

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
class SeenMessage:
    """The latest message of one kind on the bus."""

    seen: BusEvent
    changed: frozenset[str]
    """Names of the fields that changed a moment ago."""
    count: int
    rate_hz: float | None


@dataclass(frozen=True)
class Watched:
    """What is said on the bus, since somebody watches."""

    since_s: float
    messages: int
    troubles: int
    board: tuple[SeenMessage, ...]


@dataclass(frozen=True)
class Saved:
    """A backup that was written."""

    path: Path
    size_bytes: int
    area: Area | None
    """The memory in it."""
    running_version: str
    """What the device answers; empty where it answers none."""
    names_running_version: bool | None
    """True when that stands in the memory; None where there is no memory, or no version."""
    items: tuple[str, ...]
    """What the device has answered."""
    missing: Mapping[str, str]
    """What is not in it, each with the reason."""


@dataclass(frozen=True)
class BenchState:
    """Everything that a page shows."""

    doing: Activity = Activity.NOTHING
    is_rescue: bool = False
    adapters: tuple[Adapter, ...] = ()
    was_looked_for: bool = False
    adapter: Adapter | None = None
    bike: DeviceInfo | None = None
    """What was heard and what the battery answered, before the upgrade."""
    areas: tuple[Area, ...] | None = None
    """Memory that a backup may hold, while that is to be chosen."""
    saved_bytes: int = 0
    """Memory that was read for a backup so far."""
    saved: Saved | None = None
    """The last backup."""
    watched: Watched | None = None
    dropped: tuple[str, ...] = ()
    """Names of files that were dropped on the page."""
    target: Target | None = None
    offers: tuple[Offer, ...] = ()
    offer: Offer | None = None
    waived: frozenset[tuple[str, str]] = frozenset()
    """Images by their names, each with a check that was waived for this device."""
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
    power_cycle_since_s: float = 0.0
    """On the clock of the bench."""
    adapter_left_s: int | None = None
    """The adapter is lost, and waited for so long."""
    checks: tuple[events.CheckMade, ...] = ()
    notes: tuple[str, ...] = ()
    is_stopping: bool = False
    done: Done | None = None
    trouble: FlasherError | None = None
    """What ended the last step, but for an upgrade."""

    @property
    def is_idle(self) -> bool:
        return self.doing is Activity.NOTHING

    def power_cycle_left_s(self, now_s: float) -> int:
        """Whole seconds that the device is still waited for."""
        if self.power_cycle_s is None:
            return 0
        return max(0, round(self.power_cycle_s - (now_s - self.power_cycle_since_s)))
