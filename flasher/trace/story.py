"""The story of a recorded trace, as data: what `flasher explain` prints, draws, and gives as JSON.

Dataclasses and nothing else; those of packets grow while the trace is read. All times named
`..._s` are seconds since the first frame of the trace. Every text is safe to show in a terminal; a
page still has to escape it for HTML.
JSON is made of them by `flasher.cli.documents.as_json`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from flasher.events import Phase
from flasher.trace.figures import LinkReport


class Cause(Enum):
    """How an upgrade ended and why, or what a trace without one holds; the value is a headline."""

    # It went well.
    COMPLETED = "completed"
    """The device said complete. A version that it answered afterwards is in the verdict's text."""
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
    """By its own word, in a bundle."""

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
        """True when the device has the new image, by its own word."""
        return self in {Cause.COMPLETED, Cause.CONFIRMED_BY_VERSION}

    @property
    def is_upgrade(self) -> bool:
        """False for a trace in which there is none."""
        return self not in {Cause.QUERIES_ONLY, Cause.FOREIGN_ONLY, Cause.EMPTY}


@dataclass(frozen=True)
class TraceVerdict:
    """What went wrong (or right), where, most likely why, and what to do."""

    cause: Cause
    phase: Phase | None
    """The phase in which it was decided; None outside of an upgrade."""
    packet: int | None
    """The packet that was in work, from 1; None outside of the transfer."""
    attempt: int
    """From 1; 0 without an upgrade."""
    text: str
    """What happened, one or two sentences."""
    likely: str = ""
    """Most likely why; empty when there is nothing to explain."""
    remedy: str = ""
    """What to do; empty when there is nothing to do."""


class StepKind(Enum):
    """What a step is, to choose how to draw it."""

    MESSAGE = "message"
    """An intact message of the documents, or an unknown one: an arrow from sender to receiver."""
    DAMAGED = "damaged"
    """Bytes that were no message, on the id of sender and receiver."""
    ERROR_FRAMES = "error frames"
    """One or more error frames in a row; no sender."""
    GAP = "gap"
    """Neither tool nor device sent anything for a notable time; no sender."""
    NOTE = "note"
    """A remark of the explanation itself; no sender."""


@dataclass(frozen=True)
class Step:
    """One message or one notable thing."""

    at_s: float
    """When it was complete: its last frame."""
    kind: StepKind
    sender: str
    """Name of the node ("CDL", "BMS"); empty where there is none."""
    receiver: str
    """Name of the node, "all" for a broadcast; empty where there is none."""
    title: str
    """"reset", "boot version", "packet", "NAK", ..."""
    text: str
    """Its fields in words; may be empty."""
    is_trouble: bool
    can_id: int | None = None


@dataclass(frozen=True)
class PacketRun:
    """Packets `first` to `last`, each sent once and acknowledged: one line in place of hundreds."""

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
"""What a list of steps holds, in the order of time."""


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
    """Its ACK; None when there was none."""
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
    """As the update command says; None when it is not in the trace."""
    total_packets: int | None
    """As the packets say; None when there are none."""
    boot_version: str | None
    """Name and version as announced; None when it never was."""
    running_version: str | None
    """Version that the application answered after the upgrade; None when it did not."""
    attempts: int
    phases: tuple[PhaseSpan, ...]
    packets: tuple[PacketStory, ...]
    """In the order of their first copies; attempts one after the other."""
    steps: tuple[StoryLine, ...]
    steps_left_out: int
    """Steps beyond the number that is kept."""
    link: LinkReport | None
    """None when no packet was sent."""
    remarks: tuple[str, ...]
    """What else was remarkable, whatever the verdict: restarts that were recovered from, error
    frames, queries in the middle, SHUTDOWN."""
    verdict: TraceVerdict


class TalkerKind(Enum):
    """Who else was heard."""

    NODE = "node"
    FOREIGN = "foreign"


@dataclass(frozen=True)
class Talker:
    """One CAN id on which somebody spoke outside of the upgrades' dialogues."""

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
    """Mean share of the time that was taken, 0 to 1; None for a trace of no duration."""
    peak_load: float | None
    """The same in the busiest second; None for a trace that is shorter than one."""
    error_frames: int
    damaged: int
    """Pieces of bytes on the drive system's ids that were no message (wrong CRC, cut short ...)."""
    malformed: int
    """Intact messages that break their row of the documents, or that no row knows."""
    longest_gap_s: float
    """The longest time without any frame."""
    longest_gap_at_s: float
    """When it began."""


@dataclass(frozen=True)
class Recorded:
    """What the flasher that wrote a bundle said itself; read from its report.json."""

    command: str
    exit_code: int | None
    error: str
    """What it reported, in its own words: what, where, likely cause, what to do; may be empty."""


@dataclass(frozen=True)
class Story:
    """All that a trace tells."""

    source: str
    """Name of the file or bundle, safe to show."""
    format: str
    """Suffix of the trace file, without the dot."""
    started_at: float | None
    """Wall time of the first frame in seconds since 1970; None where the format does not say."""
    duration_s: float
    bitrate_bps: int
    """The rate for which times on the wire were computed."""
    frames: int
    bus: BusFigures
    upgrades: tuple[UpgradeStory, ...]
    """In the order of their beginnings."""
    talkers: tuple[Talker, ...]
    """Most frames first."""
    verdict: TraceVerdict
    """That of the upgrade which matters most: the last one of each target, the first bad of these;
    or what the trace holds instead."""
    steps: tuple[StoryLine, ...]
    """What was said outside of upgrades."""
    steps_left_out: int
    talkers_left_out: int = 0
    recorded: Recorded | None = None
    """For a bundle only."""
    damage: str = ""
    """Where and why the file could not be read on: the story is that of what stands before."""
