"""What a user or a product may set for an upgrade, and the overall deadline that follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.errors import UsageError
from flasher.host.query import Request
from flasher.image.plan import Plan
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.fields import Content
from flasher.protocol.spec import Command, Target
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

DEFAULT_ATTEMPTS: Final = 3
PATIENT_TRIES: Final = 60
"""How often a packet is sent to a device that has no application to lose before the transfer begins
anew: for 30 s where nothing answers."""
ERASURES_MAX: Final = 20
"""How often a device may erase in one upgrade that nobody has limited: flash wears. In the campaign
of tests/campaigns/world no device was saved after more than ten."""
OTHER_TOOL_QUIET_S: Final = 2.0
"""Silence of another tool that wrote to an erased device, before the device is upgraded again."""
DEFAULT_POWER_UP_TIMEOUT_S: Final = 60.0
"""Long enough to walk to the bicycle and unplug its battery."""
DEFAULT_ADAPTER_RETURN_S: Final = 5.0
"""Long enough to plug a USB adapter in again."""
BRIEF_ADAPTER_RETURN_S: Final = 0.8
"""As long as nothing was sent there is nothing to be saved. A bus-off recovers within this."""
FRAME_GAP_SHARE: Final = 0.8
"""The largest gap between two frames, as a share of the time after which their receiver drops the
message (R12): the rest is for a computer that wakes up late."""
PACKET_GAP_MAX_S: Final = 10.0
"""A device that waits for longer is as likely to have given up."""


@dataclass(frozen=True)
class UpgradeOptions:
    """What a user or a product may set for an upgrade; the defaults are the document's readings.

    Raises UsageError for gaps that no upgrade survives.
    """

    timings: Timings = DEFAULT_TIMINGS
    attempts: int | None = None
    """How often the upgrade may begin: after a restart of the device, an adapter that was lost and
    came back, or a packet whose tries are exhausted. None: `DEFAULT_ATTEMPTS` times, and as often
    as the overall deadline allows once the device has no application."""
    single_session: bool = False
    """Never begin again: a device that has restarted may be another one. A lost adapter may come
    back, up to `attempts` times, as long as the device goes on where it stood."""
    waits_for_other_tool: bool = True
    """Upgrade an erased device again when another tool that wrote to it is silent, as long as an
    attempt is left. False: end at once."""
    patient_tries: int | None = None
    """How often a packet is sent in one attempt once the device has no application and `attempts`
    is None. None: `PATIENT_TRIES` times, or as often as `timings` says where that is not the
    default."""
    timeout_s: float | None = None
    """Overall deadline; None computes one from the plan."""
    frame_gap_s: float = 0.0
    """Silence between the frames of one message, for slow receivers."""
    packet_gap_s: float = 0.0
    """Silence before each packet and before end of transfer, for slow receivers."""
    nak_next_is_ack: bool = False
    """Take NAK n+1 for ACK n when n was sent more than once (R10)."""
    reset_command: int = Command.RESET
    reset_data: bytes = b"RESET"
    """What makes the application restart into the bootloader; a product may have its own (R3)."""
    version_request: Request | None = None
    """How to ask the new application for its version; None is the document's way, where the target
    has one."""
    allow_boot_name: bool = False
    """Upgrade a device whose bootloader gives another name, or no version, than the target's."""
    minimum_boot_version: str | None = None
    """Oldest bootloader, as `Vx.x.x`, that may be given the image; None is any."""
    at_power_up: bool = False
    """Send no reset: wait for the announcement of a device that is switched on."""
    in_session: bool = False
    """An earlier upgrade may have left the device in its session: when it stays silent, and answers
    no reset, it gets an update command (R26); only after that is a power cycle asked for."""
    power_up_timeout_s: float = DEFAULT_POWER_UP_TIMEOUT_S
    """How long such an announcement is waited for."""
    adapter_return_s: float = DEFAULT_ADAPTER_RETURN_S
    """How long a lost adapter may take to come back, once anything was sent."""

    def __post_init__(self) -> None:
        limit_s = FRAME_GAP_SHARE * self.timings.inter_frame_timeout_s
        if not 0 <= self.frame_gap_s <= limit_s:
            raise UsageError(
                f"A gap of {self.frame_gap_s:g} s between frames is more than {limit_s:g} s.",
                cause="the device drops a message whose frames are "
                f"{self.timings.inter_frame_timeout_s:g} s apart",
                remedy="Choose a shorter --frame-gap (frame_gap_s in a profile); a device that is "
                "slow between packets needs --packet-gap.",
            )
        if not 0 <= self.packet_gap_s <= PACKET_GAP_MAX_S:
            raise UsageError(
                f"A gap of {self.packet_gap_s:g} s before each packet is more than "
                f"{PACKET_GAP_MAX_S:g} s.",
                cause="the device takes the silence for the end of the transfer",
                remedy="Choose a shorter --packet-gap (packet_gap_s in a profile).",
            )

    @property
    def planned_attempts(self) -> int:
        """How often the upgrade may begin while the device may still have its application."""
        return DEFAULT_ATTEMPTS if self.attempts is None else self.attempts

    @property
    def tries_without_application(self) -> int:
        """How often a packet is sent in one attempt where nothing is lost by trying on."""
        if self.patient_tries is not None:
            return self.patient_tries
        tries = self.timings.packet_tries
        return PATIENT_TRIES if tries == DEFAULT_TIMINGS.packet_tries else tries

    @property
    def boot_timeout_s(self) -> float:
        """How long a boot version is waited for."""
        return self.power_up_timeout_s if self.at_power_up else self.timings.boot_version_timeout_s

    def version_request_for(self, target: Target) -> Request | None:
        """How to ask this target for its version; None where nobody knows."""
        if self.version_request is not None:
            return self.version_request
        item = BY_KEY.get((target.request_id, Command.READ_VERSION))
        return None if item is None else Request(item)


def firmware_version(answer: Content) -> str:
    """The firmware version that an answer to a version request names, safe to show."""
    return str(getattr(answer, "firmware_version", ""))


def overall_timeout_s(plan: Plan, options: UpgradeOptions) -> float:
    """The overall deadline: the one that was chosen, else the default of the plan."""
    return default_timeout_s(plan, options) if options.timeout_s is None else options.timeout_s


def gaps_s(plan: Plan, options: UpgradeOptions) -> float:
    """The silence that the options ask for in a faultless upgrade, all gaps together."""
    between_frames = plan.host_frames - plan.host_messages
    return options.frame_gap_s * between_frames + options.packet_gap_s * (plan.total_packets + 1)


def default_timeout_s(plan: Plan, options: UpgradeOptions) -> float:
    """The overall deadline for a plan: every attempt with every wait at its limit, so that it cuts
    off no device that answers in time, only one that needs repetition after repetition.
    """
    timings = options.timings
    answers_s = timings.ack_timeout_s * plan.total_packets
    begin_s = timings.command_timeout_s + options.boot_timeout_s
    begin_s += timings.request_transfer_timeout_s
    transfer_s = plan.wire_s + gaps_s(plan, options) + answers_s
    end_s = timings.complete_timeout_s * timings.end_tries + timings.application_start_timeout_s
    away_s = (options.planned_attempts - 1) * options.adapter_return_s
    silence_s = 0.0
    if options.in_session:
        silence_s = max(timings.boot_version_timeout_s, timings.request_transfer_timeout_s)
        silence_s += timings.command_timeout_s + timings.request_transfer_timeout_s
    return silence_s + options.planned_attempts * (begin_s + transfer_s) + away_s + end_s
