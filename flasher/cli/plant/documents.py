"""Documents that `flasher plant --json` prints; see `flasher.cli.documents`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.plant.alerts import StationOverview
from flasher.plant.claim_list import ReleasedClaim, UnitClaim
from flasher.plant.deliveries import DeliveryState, RunDocument
from flasher.plant.delivery_list import Delivery, ReceiverStatus
from flasher.plant.fetcher import Fetched
from flasher.plant.forwarder import ForwarderState
from flasher.plant.recipes import RecipeEvent
from flasher.plant.reconcile import Reconciliation
from flasher.plant.retire import DueMonth, RetiredMonth
from flasher.plant.verify import PlantExamination
from flasher.station.records.model import PassedTwice
from flasher.station.records.overview import ImageRecord, InstalledUnit
from flasher.station.reports import Report


@dataclass(frozen=True)
class PlantInitDocument:
    """Result of `flasher plant init`."""

    is_new: bool
    """True if the tables were created now."""
    roles: dict[str, str]
    """Role of each station by its name."""
    to_run: list[str]
    """What an administrator has to run or write, line by line."""


@dataclass(frozen=True)
class PlantStatusDocument:
    """The stations of a plant."""

    stations: list[StationOverview]
    passed_twice: list[PassedTwice]
    """The newest 100 units that passed at two stations, without a recipe that asked for it."""


@dataclass(frozen=True)
class PlantSendDocument:
    """State after `flasher plant send`."""

    state: ForwarderState


@dataclass(frozen=True)
class PlantFetchDocument:
    """Recipes that the plant gives to a station, after `flasher plant fetch`."""

    fetched: Fetched


@dataclass(frozen=True)
class PlantPublishDocument:
    """A recipe that was published."""

    recipe: str
    revision: str
    digest: str
    files: dict[str, str]
    """SHA-256 of each file."""
    stations: list[str]
    """Empty: all."""
    sockets: list[str]
    """Empty: all."""


@dataclass(frozen=True)
class PlantRecipesDocument:
    """What was published and withdrawn, oldest first."""

    events: list[RecipeEvent]


@dataclass(frozen=True)
class PlantRetireDocument:
    """Result of `flasher plant retire`."""

    before: str
    """First month that stays."""
    months: list[RetiredMonth]
    due: list[DueMonth]
    """With --dry-run: what would be retired."""


@dataclass(frozen=True)
class PlantUnitsDocument:
    """Units whose last transfer to a target was of an image."""

    images: list[ImageRecord]
    """The images that were asked for."""
    units: list[InstalledUnit]


@dataclass(frozen=True)
class PlantClaimsDocument:
    """Units that stations claim, and claims that were released."""

    claims: list[UnitClaim]
    """Oldest first."""
    released: list[ReleasedClaim]
    """The newest 100, newest first."""


@dataclass(frozen=True)
class PlantDeliverDocument:
    """Result of `flasher plant deliver`."""

    attempts: dict[DeliveryState, int]
    """Number of attempts by the state after them."""


@dataclass(frozen=True)
class PlantDeliveriesDocument:
    """Hand-over of runs to the plant's systems."""

    receivers: list[ReceiverStatus]
    deliveries: list[Delivery]
    """Newest first."""
    document: RunDocument | None
    """With --key: the run as it is handed over."""


DOCUMENTS: Final = (
    PlantExamination,
    PlantRetireDocument,
    PlantUnitsDocument,
    Report,
    PlantInitDocument,
    PlantStatusDocument,
    PlantSendDocument,
    PlantFetchDocument,
    PlantPublishDocument,
    PlantRecipesDocument,
    PlantClaimsDocument,
    PlantDeliverDocument,
    PlantDeliveriesDocument,
    Reconciliation,
)
LINES: Final[tuple[type, ...]] = ()
