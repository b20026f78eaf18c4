"""Story of a trace as data, which `flasher explain` prints, draws and exports.

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
    """Result of an upgrade with its reason, or the content of a trace without upgrade."""

    # It went well.
    COMPLETED = "completed"
    """The device reported complete. The verdict's text has the version answered later, if any."""
    CONFIRMED_BY_VERSION = "confirmed_by_version"

    # It did not begin.
    NOBODY_ACKNOWLEDGES = "nobody_acknowledges"
    NO_BOOT_VERSION = "no_boot_version"
    RESET_IGNORED = "reset_ignored"
    """The application confirmed the reset, and no boot version followed."""
    NO_REQUEST = "no_request"
    UPDATE_NOT_TAKEN = "update_not_taken"
    WRONG_DEVICE = "wrong_device"
    TWO_DEVICES = "two_devices"

    # It broke off.
    PACKET_REFUSED = "packet_refused"
    PACKET_UNANSWERED = "packet_unanswered"
    PACKET_ANSWERED_OTHERWISE = "packet_answered_otherwise"
    PACKET_DAMAGED = "packet_damaged"
    DEVICE_RESTARTED = "device_restarted"
    SECOND_TOOL = "second_tool"
    SHUTDOWN = "shutdown"
    BUS_TROUBLE = "bus_trouble"
    TOOL_STOPPED = "tool_stopped"
    TOOL_ENDED = "tool_ended"
    """The tool's report in the bundle says that it ended."""

    # The end.
    REFUSED = "refused"
    UNCONFIRMED = "unconfirmed"
    COMPLETE_TOO_EARLY = "complete_too_early"
    OTHER_VERSION = "other_version"
    IN_BOOTLOADER = "in_bootloader"
    """The device reported complete, and its bootloader went on announcing itself."""

    # What the trace is.
    RECORDING_ENDS = "recording_ends"
    QUERIES_ONLY = "queries_only"
    FOREIGN_ONLY = "foreign_only"
    EMPTY = "empty"

    @property
    def is_good(self) -> bool:
        """True if the device reported that it has the new image."""
        return self in {Cause.COMPLETED, Cause.CONFIRMED_BY_VERSION}

    @property
    def is_upgrade(self) -> bool:
        """False for a trace without an upgrade."""
        return self not in {Cause.QUERIES_ONLY, Cause.FOREIGN_ONLY, Cause.EMPTY}


@dataclass(frozen=True)
class TraceVerdict:
    """Verdict on a trace: result, phase and packet, likely cause and next step."""

    cause: Cause
    phase: Phase | None
    """Phase in which the result was decided; None outside of an upgrade."""
    packet: int | None
    """Current packet, from 1; None outside of the transfer."""
    attempt: int
    """Number of the attempt, from 1; 0 without an upgrade."""
    text: str
    """Description in one or two sentences."""
    likely: str = ""
    """Likely cause; empty when none is needed."""
    remedy: str = ""
    """Next step; empty when none is needed."""


class StepKind(Enum):
    """Kind of a step, which decides how it is drawn."""

    MESSAGE = "message"
    """Intact message, documented or not: an arrow from sender to receiver."""
    DAMAGED = "damaged"
    """Bytes without a valid message, on the CAN id of sender and receiver."""
    ERROR_FRAMES = "error frames"
    """Consecutive error frames; no sender."""
    GAP = "gap"
    """Notable silence of tool and device; no sender."""
    NOTE = "note"
    """Remark of the explanation; no sender."""


@dataclass(frozen=True)
class Step:
    """Message or notable event in a story."""

    at_s: float
    """Time of the last frame."""
    kind: StepKind
    sender: str
    """Node name ("CDL", "BMS"); empty without one."""
    receiver: str
    """Node name, "all" for a broadcast; empty without one."""
    title: str
    """"reset", "boot version", "packet", "NAK", ..."""
    text: str
    """Field labels and values; may be empty."""
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
"""Entry in a list of steps."""


@dataclass(frozen=True)
class PhaseSpan:
    """Phase of an attempt, from begin to end."""

    phase: Phase
    attempt: int
    begin_s: float
    end_s: float


@dataclass(slots=True)
class PacketStory:
    """Packet in an attempt: tries, NAKs, answer time."""

    number: int
    """Packet number, from 1."""
    attempt: int
    tries: int
    """Number of copies sent."""
    naks: int
    """Number of NAKs."""
    sent_at_s: float
    """Last frame of the first copy."""
    answered_at_s: float | None
    """Time of the ACK; None without one."""
    answer_s: float | None
    """Time from the last frame of the latest copy to the ACK; None without one."""

    @property
    def is_clean(self) -> bool:
        """True for a packet that was sent once and got no NAK."""
        return self.tries == 1 and not self.naks


@dataclass(frozen=True)
class UpgradeStory:
    """Upgrade of one target, with all its attempts."""

    target: str
    """Node name in capitals."""
    begin_s: float
    end_s: float
    image_size_bytes: int | None
    """Image size from the update command; None if that is not in the trace."""
    total_packets: int | None
    """Packet total stated in the packets; None without any."""
    boot_version: str | None
    """Name and version of the bootloader; None if not announced."""
    running_version: str | None
    """Firmware version that the application answered after the upgrade; None without an answer."""
    attempts: int
    phases: tuple[PhaseSpan, ...]
    packets: tuple[PacketStory, ...]
    """Packets in the order of their first copies; attempts one after the other."""
    steps: tuple[StoryLine, ...]
    steps_left_out: int
    """Number of steps dropped."""
    link: LinkReport | None
    """Bus usage; None if no packet was sent."""
    remarks: tuple[str, ...]
    """Remarks besides the verdict: recovered restarts, error frames, queries, SHUTDOWN."""
    verdict: TraceVerdict


class TalkerKind(Enum):
    """Kind of a sender outside of upgrades."""

    NODE = "node"
    FOREIGN = "foreign"


@dataclass(frozen=True)
class Talker:
    """CAN id with traffic that belongs to no upgrade."""

    can_id: int
    is_extended: bool
    name: str
    """"BMS > all" for a node's CAN id; empty for a foreign one."""
    frames: int
    kind: TalkerKind


@dataclass(frozen=True)
class BusFigures:
    """Bus load, error frames and damage during a whole trace."""

    duration_s: float
    """Time from the first frame to the last."""
    frames: int
    """Number of frames, without error frames."""
    load: float | None
    """Mean bus load, 0 to 1; None for a trace without duration."""
    peak_load: float | None
    """Bus load in the busiest second; None for a shorter trace."""
    error_frames: int
    damaged: int
    """Stretches of bytes on documented CAN ids without a valid message (wrong CRC, incomplete)."""
    malformed: int
    """Intact messages that are not documented, or whose content breaks the document."""
    longest_gap_s: float
    """Longest time without any frame."""
    longest_gap_at_s: float
    """Begin of that time."""


@dataclass(frozen=True)
class Recorded:
    """Result of a command as stored in a bundle's report.json."""

    command: str
    exit_code: int | None
    error: str
    """Error of the command: what, where, likely cause, next step; may be empty."""


@dataclass(frozen=True)
class Story:
    """Explanation of a trace: bus figures, upgrades, other traffic and a verdict."""

    source: str
    """Name of the file or bundle, safe to show."""
    format: str
    """Suffix of the trace file, without the dot."""
    started_at: float | None
    """Wall time of the first frame in seconds since 1970; None if the format lacks it."""
    duration_s: float
    bitrate_bps: int
    """Bit rate used to compute times on the wire."""
    frames: int
    bus: BusFigures
    upgrades: tuple[UpgradeStory, ...]
    """Upgrades in the order of their beginnings."""
    talkers: tuple[Talker, ...]
    """Most frames first."""
    verdict: TraceVerdict
    """First bad verdict among the last upgrades of each target; without an upgrade, the content of
    the trace."""
    steps: tuple[StoryLine, ...]
    """Messages outside of upgrades."""
    steps_left_out: int
    talkers_left_out: int = 0
    recorded: Recorded | None = None
    """Facts recorded by the tool, for a bundle."""
    damage: str = ""
    """Place and reason at which reading stopped; the story covers the part before."""
