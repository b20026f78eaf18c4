"""The story of a recorded trace as data: `flasher explain` prints, draws and exports it.

Dataclasses only; those of packets grow while the trace is read. Times named `..._s` are seconds
since the first frame of the trace. Every text is safe to show in a terminal; a page still has to
escape it for HTML. `flasher.cli.documents.as_json` makes the JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from flasher.events import Phase
from flasher.trace.figures import LinkReport


class Cause(Enum):
    """Result of an upgrade and its reason, or the content of a trace without one; the value is a
    headline.
    """

    # It went well.
    COMPLETED = "completed"
    """The device reported complete. The verdict's text has any version it answered later."""
    CONFIRMED_BY_VERSION = "confirmed_by_version"

    # It did not begin.
    NOBODY_ACKNOWLEDGES = "nobody_acknowledges"
    NO_BOOT_VERSION = "no_boot_version"
    NO_REQUEST = "no_request"
    UPDATE_NOT_TAKEN = "update_not_taken"
    WRONG_DEVICE = "wrong_device"
    TWO_DEVICES = "two_devices"

    # It broke off.
    PACKET_REFUSED = "packet_refused"
    PACKET_UNANSWERED = "packet_unanswered"
    PACKET_DAMAGED = "packet_damaged"
    DEVICE_RESTARTED = "device_restarted"
    SECOND_TOOL = "second_tool"
    SHUTDOWN = "shutdown"
    BUS_TROUBLE = "bus_trouble"
    TOOL_STOPPED = "tool_stopped"
    TOOL_ENDED = "tool_ended"
    """As the tool's report in the bundle states."""

    # The end.
    REFUSED = "refused"
    UNCONFIRMED = "unconfirmed"
    COMPLETE_TOO_EARLY = "complete_too_early"
    OTHER_VERSION = "other_version"

    # What the trace is.
    RECORDING_ENDS = "recording_ends"
    QUERIES_ONLY = "queries_only"
    FOREIGN_ONLY = "foreign_only"
    EMPTY = "empty"

    @property
    def is_good(self) -> bool:
        """True when the device reported that it has the new image."""
        return self in {Cause.COMPLETED, Cause.CONFIRMED_BY_VERSION}

    @property
    def is_upgrade(self) -> bool:
        """False for a trace without an upgrade."""
        return self not in {Cause.QUERIES_ONLY, Cause.FOREIGN_ONLY, Cause.EMPTY}


@dataclass(frozen=True)
class TraceVerdict:
    """The result of a trace: cause, place, likely reason and next step."""

    cause: Cause
    phase: Phase | None
    """Phase of the decision; None outside of an upgrade."""
    packet: int | None
    """The current packet, from 1; None outside of the transfer."""
    attempt: int
    """From 1; 0 without an upgrade."""
    text: str
    """Description of the event, one or two sentences."""
    likely: str = ""
    """Likely cause; empty when nothing needs an explanation."""
    remedy: str = ""
    """Next step; empty when none is needed."""


class StepKind(Enum):
    """Kind of a step, which decides how it is drawn."""

    MESSAGE = "message"
    """An intact message, in the documents or not: an arrow from sender to receiver."""
    DAMAGED = "damaged"
    """Bytes without a valid message, on the id of sender and receiver."""
    ERROR_FRAMES = "error frames"
    """Consecutive error frames; no sender."""
    GAP = "gap"
    """Notable silence of tool and device; no sender."""
    NOTE = "note"
    """A remark of the explanation; no sender."""


@dataclass(frozen=True)
class Step:
    """One message or one notable event."""

    at_s: float
    """Time of its last frame."""
    kind: StepKind
    sender: str
    """Name of the node ("CDL", "BMS"); empty without one."""
    receiver: str
    """Name of the node, "all" for a broadcast; empty without one."""
    title: str
    """"reset", "boot version", "packet", "NAK", ..."""
    text: str
    """Its fields in words; may be empty."""
    is_trouble: bool
    can_id: int | None = None


@dataclass(frozen=True)
class PacketRun:
    """Packets `first` to `last`, each sent once and acknowledged: one line instead of hundreds."""

    first: int
    last: int
    begin_s: float
    """First frame of the first packet."""
    end_s: float
    """ACK of the last packet."""

    @property
    def count(self) -> int:
        return self.last - self.first + 1


StoryLine = Step | PacketRun
"""An entry of a list of steps."""


@dataclass(frozen=True)
class PhaseSpan:
    """One phase of one attempt."""

    phase: Phase
    attempt: int
    begin_s: float
    end_s: float


@dataclass(slots=True)
class PacketStory:
    """One packet in one attempt."""

    number: int
    """From 1."""
    attempt: int
    tries: int
    """Copies sent."""
    naks: int
    """NAKs for it."""
    sent_at_s: float
    """Last frame of its first copy."""
    answered_at_s: float | None
    """Time of its ACK; None without one."""
    answer_s: float | None
    """From the last frame of the latest copy to the ACK; None without one."""

    @property
    def is_clean(self) -> bool:
        """True while nothing went wrong with it."""
        return self.tries == 1 and not self.naks


@dataclass(frozen=True)
class UpgradeStory:
    """One upgrade of one target, with all its attempts."""

    target: str
    """Name of the node in capitals."""
    begin_s: float
    end_s: float
    image_size_bytes: int | None
    """From the update command; None if that is not in the trace."""
    total_packets: int | None
    """From the packets; None without any."""
    boot_version: str | None
    """Announced name and version; None if never announced."""
    running_version: str | None
    """Version that the application answered after the upgrade; None without an answer."""
    attempts: int
    phases: tuple[PhaseSpan, ...]
    packets: tuple[PacketStory, ...]
    """In the order of first copies; attempts one after the other."""
    steps: tuple[StoryLine, ...]
    steps_left_out: int
    """Number of steps dropped."""
    link: LinkReport | None
    """None when no packet was sent."""
    remarks: tuple[str, ...]
    """Remarkable events, whatever the verdict: recovered restarts, error frames, queries,
    SHUTDOWN."""
    verdict: TraceVerdict


class TalkerKind(Enum):
    """Kind of a sender outside of the upgrades."""

    NODE = "node"
    FOREIGN = "foreign"


@dataclass(frozen=True)
class Talker:
    """One CAN id with traffic outside of the upgrades' dialogues."""

    can_id: int
    is_extended: bool
    name: str
    """"BMS > all" for a node's id; empty for a foreign one."""
    frames: int
    kind: TalkerKind


@dataclass(frozen=True)
class BusFigures:
    """The bus during the whole trace."""

    duration_s: float
    """From the first frame to the last."""
    frames: int
    """All frames, error frames not counted."""
    load: float | None
    """Mean bus load, 0 to 1; None for a trace of no duration."""
    peak_load: float | None
    """Bus load in the busiest second; None for a shorter trace."""
    error_frames: int
    damaged: int
    """Byte pieces on the drive system's ids without a valid message (wrong CRC, cut short ...)."""
    malformed: int
    """Intact messages that the documents lack, or with content they forbid."""
    longest_gap_s: float
    """The longest time without any frame."""
    longest_gap_at_s: float
    """When it began."""


@dataclass(frozen=True)
class Recorded:
    """Outcome that the flasher stored in a bundle's report.json."""

    command: str
    exit_code: int | None
    error: str
    """The reported error: what, where, likely cause, next step; may be empty."""


@dataclass(frozen=True)
class Story:
    """Everything that a trace shows."""

    source: str
    """Name of the file or bundle, safe to show."""
    format: str
    """Suffix of the trace file, without the dot."""
    started_at: float | None
    """Wall time of the first frame in seconds since 1970; None if the format lacks it."""
    duration_s: float
    bitrate_bps: int
    """Rate used to compute times on the wire."""
    frames: int
    bus: BusFigures
    upgrades: tuple[UpgradeStory, ...]
    """In the order of their beginnings."""
    talkers: tuple[Talker, ...]
    """Most frames first."""
    verdict: TraceVerdict
    """The first bad verdict among the last upgrades of each target; without an upgrade, what the
    trace holds."""
    steps: tuple[StoryLine, ...]
    """Messages outside of upgrades."""
    steps_left_out: int
    talkers_left_out: int = 0
    recorded: Recorded | None = None
    """For a bundle only."""
    damage: str = ""
    """Where and why reading stopped; the story covers the part before."""
