"""Documents that `flasher station --json` prints; see `flasher.cli.documents`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.station.events import ScanRefused, StationEvent
from flasher.station.records.branch import BroughtIn
from flasher.station.records.model import (
    Backup,
    Examination,
    Figures,
    RunRecord,
    UnitLife,
    Verified,
)
from flasher.station.records.upgrade import Upgraded
from flasher.station.reports import Report
from flasher.station.sealed import CheckedCertificate
from flasher.trace.story import Cause, Story


@dataclass(frozen=True)
class RecipeFindingDocument:
    """A problem of a recipe."""

    where: str
    what: str
    remedy: str


@dataclass(frozen=True)
class CheckedTargetDocument:
    """A target of a recipe."""

    target: str
    image: str
    sha256: str
    size_bytes: int
    version: str
    """Empty when neither image nor manifest has one."""
    required: Verified


@dataclass(frozen=True)
class StationCheckDocument:
    """A valid recipe."""

    recipe: str
    part: str
    revision: str
    sha256: str
    targets: list[CheckedTargetDocument]
    sockets: dict[str, str]
    """With --sockets: the adapter of each socket."""
    clock_offset_s: float | None = None
    """With a plant: this computer's clock minus that of the plant's database; null: not known."""


@dataclass(frozen=True)
class FindingsDocument:
    """Problems of a recipe, as details of the error."""

    findings: list[RecipeFindingDocument]


@dataclass(frozen=True)
class StationRunDocument:
    """Result of `flasher station run`."""

    station: str
    recipe: str
    revision: str
    records: str
    """Path or URL of the records; "" for temporary records of virtual units."""
    is_complete: bool
    """False if the station ended before all scans, or all virtual units, were done."""
    figures: Figures | None
    """null when they cannot be read."""
    units: list[RunRecord]
    """The last run of each unit."""
    refused: list[ScanRefused]


@dataclass(frozen=True)
class UnitTraceDocument:
    """The explanation of a run's trace."""

    run_id: int
    sha256: str
    cause: Cause | None
    """null when it cannot be read."""
    text: str
    story: Story | None
    """Only with --story."""


@dataclass(frozen=True)
class UnitDocument:
    """A unit with all its runs."""

    unit: UnitLife
    traces: list[UnitTraceDocument]


@dataclass(frozen=True)
class SigningKeyDocument:
    """The key that signs a station's audit trail."""

    station: str
    fingerprint: str
    public: str
    """The public key, in hexadecimal digits."""
    file: str
    is_there: bool
    """True when the file exists."""
    heads: tuple[str, ...]
    """Places with the signed heads of the audit trail; the first is the one beside the key."""


@dataclass(frozen=True)
class ExportDocument:
    """A sealed export of a station."""

    station: str
    file: str
    members: list[str]
    left_out: list[str]
    """Files that are not beside the station file, and not in the export."""


@dataclass(frozen=True)
class BroughtInDocument:
    """A branch that was brought into a station's records; null: there was nothing to bring in."""

    station: str
    brought_in: BroughtIn | None


@dataclass(frozen=True)
class TakenOverDocument(BroughtInDocument):
    """A station that this PC has taken over."""

    rows: int
    """Audit rows that were made from the plant's database."""
    runs: int
    active: tuple[str, ...]
    """Serial numbers of units that were active at the other PC."""
    set_aside: str | None
    """Where the records are that this PC had as the station before."""
    written: list[str]
    """Files of the export that were missing here."""


@dataclass(frozen=True)
class AcceptedDocument:
    """Decision of a person that lets the station continue."""

    station: str
    what: str


@dataclass(frozen=True)
class PinDocument:
    """Hash of a typed PIN, for the badge table."""

    pin: str


DOCUMENTS: Final = (
    StationCheckDocument,
    FindingsDocument,
    StationRunDocument,
    Report,
    UnitDocument,
    Backup,
    Examination,
    CheckedCertificate,
    SigningKeyDocument,
    TakenOverDocument,
    AcceptedDocument,
    BroughtInDocument,
    ExportDocument,
    PinDocument,
    Upgraded,
)
LINES: Final[tuple[type, ...]] = tuple(StationEvent.__subclasses__())
"""Events that a station prints as JSON lines."""
