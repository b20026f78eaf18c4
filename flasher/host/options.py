"""Options of an upgrade (attempts, gaps, version query, ...), and its overall deadline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.errors import UsageError
from flasher.host.query import Request
from flasher.i18n import text
from flasher.image.plan import Plan
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.fields import Content
from flasher.protocol.spec import Command, Target, data_size
from flasher.protocol.text import BOOT_VERSION_FORM, boot_version_number, printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings

DEFAULT_ATTEMPTS: Final = 3
PATIENT_TRIES: Final = 60
"""Maximum number of transmissions of a packet to a device without application: 30 s without an
answer."""
ERASURES_MAX: Final = 20
"""Maximum number of erasures in one upgrade without user limit, because flash wears out. No device
of a simulated campaign needed more than ten."""
OTHER_TOOL_QUIET_S: Final = 2.0
"""Silence required of another tool that wrote to an erased device, before the upgrade is
repeated."""
DEFAULT_POWER_UP_TIMEOUT_S: Final = 60.0
"""Time to walk to the bicycle and unplug its battery."""
DEFAULT_ADAPTER_RETURN_S: Final = 5.0
"""Time to plug in a USB adapter again."""
BRIEF_ADAPTER_RETURN_S: Final = 0.8
"""Maximum wait for a lost adapter before anything was sent, when only a bus-off is worth it."""
FRAME_GAP_SHARE: Final = 0.8
"""Maximum gap between two frames, as a share of the receiver's inter-frame timeout (R12); the rest
is a margin for late wake-ups."""
PACKET_GAP_MAX_S: Final = 10.0
"""Longer than a device waits for a packet."""


@dataclass(frozen=True)
class UpgradeOptions:
    """Options of an upgrade, from user and target profile.

    Raises UsageError for gaps that make an upgrade impossible, a boot version of another form, and
    reset data that the command does not carry.
    """

    timings: Timings = DEFAULT_TIMINGS
    attempts: int | None = None
    """Maximum number of attempts, each after a restart of the device, a lost and restored adapter,
    or a packet whose tries are exhausted. None: `DEFAULT_ATTEMPTS`, and until the overall deadline
    once the device has no application."""
    single_session: bool = False
    """Never start over, because a device that restarted may be another one. A lost adapter may be
    restored, up to `attempts` times, while the device continues."""
    waits_for_other_tool: bool = True
    """Repeat the upgrade of an erased device when another tool that wrote to it is silent, while an
    attempt is left. False: end at once."""
    patient_tries: int | None = None
    """Tries per packet and attempt once the device has no application and `attempts` is None. None:
    `PATIENT_TRIES`, or the value of `timings` if that is not the default."""
    timeout_s: float | None = None
    """Overall deadline in seconds; None computes it from the plan."""
    frame_gap_s: float = 0.0
    """Silence between frames of a message, in seconds, for slow receivers."""
    packet_gap_s: float = 0.0
    """Silence before each packet and before end of transfer, in seconds, for slow receivers."""
    nak_next_is_ack: bool = False
    """Accept NAK n+1 as ACK n if packet n was sent more than once (R10)."""
    reset_command: int = Command.RESET
    reset_data: bytes = b"RESET"
    """Command and data that restart the application into the bootloader (R3)."""
    version_request: Request | None = None
    """Version query for the new application; None uses the documented one, if any."""
    allow_boot_name: bool = False
    """Accept a bootloader with another name than the target's, or without a valid version."""
    minimum_boot_version: str | None = None
    """Oldest accepted bootloader version, as `Vx.x.x`; None accepts all."""
    at_power_up: bool = False
    """Send no reset; wait for the boot version of a device that is switched on."""
    in_session: bool = False
    """An earlier upgrade may have left the device in its transfer: if it stays silent after a
    reset, send an update command (R26) before asking for a power cycle."""
    power_up_timeout_s: float = DEFAULT_POWER_UP_TIMEOUT_S
    """Maximum wait for a boot version at power-up, in seconds."""
    adapter_return_s: float = DEFAULT_ADAPTER_RETURN_S
    """Maximum wait for a lost adapter, in seconds, once anything was sent."""

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
        minimum = self.minimum_boot_version
        if minimum is not None and boot_version_number(minimum) is None:  # it would pass any
            raise UsageError(f"{minimum!a} is not a boot version of the form {BOOT_VERSION_FORM}.")
        if len(self.reset_data) != data_size(self.reset_command):
            raise UsageError(
                f"The reset data have {len(self.reset_data)} bytes, but the command "
                f"0x{self.reset_command:04X} carries {data_size(self.reset_command)}, by its "
                "second byte."
            )
        if not 0 <= self.packet_gap_s <= PACKET_GAP_MAX_S:
            raise UsageError(
                f"A gap of {self.packet_gap_s:g} s before each packet is more than "
                f"{PACKET_GAP_MAX_S:g} s.",
                cause="the device would take the silence for the end of the transfer",
                remedy="Choose a shorter --packet-gap (packet_gap_s in a profile).",
            )

    @property
    def planned_attempts(self) -> int:
        """Maximum number of attempts while the device may still have its application."""
        return DEFAULT_ATTEMPTS if self.attempts is None else self.attempts

    @property
    def tries_without_application(self) -> int:
        """Maximum tries per packet and attempt when the device has no application to lose."""
        if self.patient_tries is not None:
            return self.patient_tries
        tries = self.timings.packet_tries
        return PATIENT_TRIES if tries == DEFAULT_TIMINGS.packet_tries else tries

    @property
    def boot_timeout_s(self) -> float:
        """Maximum wait for a boot version, in seconds."""
        return self.power_up_timeout_s if self.at_power_up else self.timings.boot_version_timeout_s

    def version_request_for(self, target: Target) -> Request | None:
        """Return the version query of a target; None if it has none."""
        if self.version_request is not None:
            return self.version_request
        item = BY_KEY.get((target.request_id, Command.READ_VERSION))
        return None if item is None else Request(item)


def firmware_version(answer: Content) -> str:
    """Firmware version in an answer to a version query, escaped."""
    return str(getattr(answer, "firmware_version", ""))


def serial_number(answer: Content | None) -> str:
    """Return the serial number in an answer to a version query, escaped; empty if it has none."""
    return printable(str(getattr(answer, "serial_number", ""))).strip()


def other_unit(answer: Content, serial_before: str) -> str:
    """Describe the serial number in an answer if it is not `serial_before`; "" if one is empty."""
    now = serial_number(answer)
    if not serial_before or now in ("", serial_before):
        return ""
    return text(
        "serial number {now}, it was {before} before the upgrade", now=now, before=serial_before
    )


def overall_timeout_s(plan: Plan, options: UpgradeOptions) -> float:
    """Overall deadline in seconds: the chosen one, else `default_timeout_s`."""
    return default_timeout_s(plan, options) if options.timeout_s is None else options.timeout_s


def gaps_s(plan: Plan, options: UpgradeOptions) -> float:
    """Total seconds of the requested gaps in an upgrade without errors."""
    between_frames = plan.host_frames - plan.host_messages
    return options.frame_gap_s * between_frames + options.packet_gap_s * (plan.total_packets + 1)


def default_timeout_s(plan: Plan, options: UpgradeOptions) -> float:
    """Overall deadline in seconds: every attempt with every wait at its limit. It stops only a
    device that needs repetition after repetition, never one that answers in time.
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
