"""Outcome of an upgrade: ending, state of the device, statistics, and the error to raise.

Three claims are distinct: "transferred" (every packet acknowledged), "completed" (confirmed by the
device), and "running version X" (answered by the new application).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, assert_never

from flasher.errors import (
    BusError,
    ErrorCode,
    FlasherError,
    ImageError,
    InterruptedByUserError,
    NoAnswerError,
    RefusedError,
    TransferError,
    UnconfirmedError,
    VerificationError,
    WrongDeviceError,
)
from flasher.events import Phase
from flasher.host import waivers
from flasher.host.table import Ending
from flasher.i18n import Text, text
from flasher.image.plan import Plan
from flasher.image.plausible import LIKELY_CAUSES
from flasher.protocol.spec import Target
from flasher.validation import json_keys
from flasher.wording import wording


class DeviceLeft(Enum):
    """State in which an upgrade left the device, as far as the tool can know."""

    UNTOUCHED = "untouched"
    PERHAPS_ERASED = "perhaps_erased"
    NO_APPLICATION = "no_application"
    UNKNOWN = "unknown"
    NEW = "new"
    OTHER = "other"
    """Its application answers as another one than the image."""

    @property
    def needs_rescue(self) -> bool:
        """True if the device has no application, or perhaps none."""
        return self not in (DeviceLeft.UNTOUCHED, DeviceLeft.NEW, DeviceLeft.OTHER)


def with_device_state(remedy: str, left: DeviceLeft) -> Text:
    """Add the state of the device to a remedy."""
    state = text(wording(left))
    return text("{remedy} State of the device: {state}.", remedy=remedy, state=state)


@dataclass(frozen=True)
class Statistics:
    """Statistics of an upgrade; times in seconds."""

    attempts: int = 0
    packets_acknowledged: int = 0
    repetitions: int = 0
    naks: int = 0
    timeouts: int = 0
    duration_s: float = 0.0
    """Time from the first reset to the end."""
    transfer_s: float | None = None
    """Time from request transfer to the ACK of the last packet, in the last attempt with one."""


def describe_progress(phase: Phase, packet: int | None, total_packets: int, attempt: int) -> str:
    """Describe phase, packet and attempt of an upgrade."""
    where = text(wording(phase))
    if packet:
        where = text(
            "{where}, packet {packet} of {packets}",
            where=where,
            packet=packet,
            packets=total_packets,
        )
    return (
        text("{where}, attempt {attempt}", where=where, attempt=attempt) if attempt > 1 else where
    )


@json_keys(
    "ending phase packet device_left boot_version running_version detail statistics"
    " sent_into_silence unobserved_s"
)
@dataclass(frozen=True)
class Outcome:
    """Result of an upgrade: ending, phase, state of the device, statistics."""

    ending: Ending
    phase: Phase
    device_left: DeviceLeft
    target: Target
    total_packets: int
    # Current packet, from 1; None outside the transfer.
    packet: int | None
    # Announced name and version of the bootloader, escaped.
    boot_version: str | None
    # Version answered by the application, escaped; None if not asked or not answered.
    running_version: str | None
    statistics: Statistics
    # Observation that the ending alone does not convey.
    detail: str = ""
    waiver: str = ""
    """Check that refused the upgrade, if it can be waived and the ending does not imply it."""
    sent_into_silence: bool = False
    """A silent device got an update command, in case an earlier upgrade left it in its transfer
    (R26)."""
    unobserved_s: float = 0.0
    """Time since the update command in which the adapter was away, and in which this computer was
    suspended, in seconds: whether another tool wrote to the device then, or another unit was
    connected, is not known, and the device cannot be asked."""
    frame_gap_s: float = 0.0
    """Silence between the frames of a message, as chosen by the options."""
    was_answered_otherwise: bool = False
    """The packet that failed has answers, but none by table 9; `detail` names one."""
    application_runs: bool = False
    """The device's application sent something shortly before the end."""

    @property
    def ok(self) -> bool:
        """True if the device confirmed the new image."""
        return self.ending in {Ending.COMPLETED, Ending.CONFIRMED_BY_VERSION}

    @property
    def is_transferred(self) -> bool:
        """True when every packet was acknowledged."""
        return self.statistics.transfer_s is not None

    @property
    def is_completed(self) -> bool:
        """True if the device confirmed the complete image."""
        return self.ending is Ending.COMPLETED

    @property
    def where(self) -> str:
        """Phase, packet and attempt, as text."""
        return describe_progress(
            self.phase, self.packet, self.total_packets, self.statistics.attempts
        )

    @property
    def nothing_to_do(self) -> bool:
        """True if the device already runs the version and was skipped, as requested."""
        return self.ending is Ending.UP_TO_DATE

    def error(self) -> FlasherError | None:
        """Create the error for this outcome; None for a success, and if there was nothing to do."""
        if self.ok or self.nothing_to_do:
            return None
        explained = _EXPLANATIONS.get(self.ending)
        if self.was_answered_otherwise:
            explained = _ANSWERED_OTHERWISE
        elif explained is None:
            explained = _late(self.phase, self.device_left)
        elif self.application_runs and self.ending in _APPLICATION_RUNS:
            explained = _APPLICATION_RUNS[self.ending]
        elif self.ending is Ending.NO_BOOT_VERSION and self.sent_into_silence:
            explained = _NO_SESSION_EITHER
        elif self.ending is Ending.TWO_DEVICES and self.device_left.needs_rescue:
            explained = _TWO_PERHAPS_ERASED
        error = explained.error(self.ending, self.target, self.detail)
        if self.ending in _UNANSWERED and self.frame_gap_s > UNUSUAL_FRAME_GAP_S:
            error.cause = text(
                "the device may drop messages whose frames are {gap_ms} ms apart; otherwise"
                " {cause}",
                gap_ms=f"{1000 * self.frame_gap_s:g}",
                cause=error.cause,
            )
            shorter = text("Choose a shorter --frame-gap (frame_gap_s in a profile).")
            error.remedy = text("{shorter} {remedy}", shorter=shorter, remedy=error.remedy)
        error.where = self.where
        if self.ending is Ending.SECOND_TOOL and self.device_left is DeviceLeft.UNTOUCHED:
            error.remedy = text(
                "{remedy} This run erased nothing; what the other tool has done is not known.",
                remedy=error.remedy,
            )
        else:
            error.remedy = with_device_state(error.remedy, self.device_left)
        error.needs_rescue = self.device_left.needs_rescue
        error.waiver = self.waiver or _WAIVERS.get(self.ending, "")
        return error


UNUSUAL_FRAME_GAP_S: Final = 0.01
"""Adapters and computers cause shorter gaps by themselves. The documents give no limit for a
device (R12)."""
_UNANSWERED: Final = frozenset(
    {Ending.NO_BOOT_VERSION, Ending.NO_REQUEST, Ending.UNHEARING, Ending.PACKET_FAILED}
)
_WAIVERS: Final = {
    Ending.WRONG_DEVICE: waivers.BOOT_NAME,
    Ending.BOOT_TOO_OLD: waivers.BOOT_VERSION,
}


def ended_before_start(
    plan: Plan,
    ending: Ending,
    detail: str,
    phase: Phase = Phase.IDENTIFY,
    *,
    duration_s: float,
    waiver: str = "",
) -> Outcome:
    """Create the outcome of a session that ended before its upgrade began."""
    return Outcome(
        ending=ending,
        phase=phase,
        device_left=DeviceLeft.UNTOUCHED,
        target=plan.target,
        total_packets=plan.total_packets,
        packet=None,
        boot_version=None,
        running_version=None,
        statistics=Statistics(duration_s=duration_s),
        detail=detail,
        waiver=waiver,
    )


class ErrorDescription(NamedTuple):
    """Error class, likely cause and remedy of an ending or a verdict."""

    kind: type[FlasherError]
    cause: str
    remedy: str
    code: ErrorCode | None = None
    """None for the code of the class."""

    def error(self, ending: Ending, target: Target, detail: str) -> FlasherError:
        """Create the error, without what it says of the device."""
        node, shown = target.node.name, text(wording(ending))
        what = text("{node}: {ending}.", node=node, ending=shown)
        if detail:
            what = text("{node}: {ending} ({detail}).", node=node, ending=shown, detail=detail)
        return self.create(what, target)

    def create(self, what: str, target: Target) -> FlasherError:
        """Create the error for what happened to a target."""
        node = target.node.name
        names = {"node": node, "boot_name": target.boot_name, "again": text(AGAIN)}
        cause, remedy = Text(self.cause, names), Text(self.remedy, names)
        return self.kind(what, cause=cause, remedy=remedy, code=self.code)


AGAIN: Final = "Run the same command again."
"""Text of {again} in remedies."""

TWO_DEVICES_CAUSE: Final = (
    "two devices of the same kind are on the bus, or one whose bootloader answers twice"
)
TWO_DEVICES_REMEDY: Final = (
    "Each of the two may have the new image, half of it, or no application: connect one alone, "
    "flash it, then the other one alone."
)
TWO_UNTOUCHED: Final = ErrorDescription(
    WrongDeviceError,
    TWO_DEVICES_CAUSE,
    "Disconnect one of them. {again}",
    code=ErrorCode.TWO_DEVICES,
)
_EXPLANATIONS: Final = {
    Ending.NO_BOOT_VERSION: ErrorDescription(
        NoAnswerError,
        "the device has no power, sleeps, is not on this bus, the bit rate differs, or its "
        "bootloader announces itself only at power-up",
        "Check supply, wiring, termination and bit rate (flasher doctor). A device whose upgrade "
        "was broken off may still wait in it: --in-session reaches that. One that announces itself "
        "at power-up only is reached by flasher rescue and a power cycle.",
        code=ErrorCode.NO_BOOT_VERSION,
    ),
    Ending.NO_ANNOUNCEMENT: ErrorDescription(
        NoAnswerError,
        "it was not switched off and on, it has no power, it is not on this bus, or the bit rate "
        "differs",
        "{again} Disconnect the device's supply for some seconds when asked (a battery wakes by "
        "its key or charger); --wait allows more time.",
        code=ErrorCode.NO_ANNOUNCEMENT,
    ),
    Ending.NO_REQUEST: ErrorDescription(
        NoAnswerError,
        "erasing takes longer than allowed, or the device refuses this size or target",
        "{again} Power-cycle the device if it stays silent.",
        code=ErrorCode.NO_REQUEST,
    ),
    Ending.UNHEARING: ErrorDescription(
        NoAnswerError,
        "it is not the target device, it refuses this size, or it does not receive",
        "Check that the device is the {node} and that the image fits it.",
        code=ErrorCode.UNHEARING,
    ),
    Ending.WRONG_DEVICE: ErrorDescription(
        WrongDeviceError,
        "another device is connected, or the version of this one has another form: the bootloader "
        "of the {node} reports {boot_name} Vx.x.x",
        "Check -t/--target and what is connected; --allow-boot-name takes the device as it is.",
    ),
    Ending.BOOT_TOO_OLD: ErrorDescription(
        WrongDeviceError,
        "the image's manifest asks for a newer bootloader",
        "Look for an image for this bootloader. --allow-boot-version takes the device as it is.",
        code=ErrorCode.BOOT_TOO_OLD,
    ),
    Ending.NOT_FOR_DEVICE: ErrorDescription(
        WrongDeviceError,
        "another file was meant, another device is connected, or the manifest is not up to date",
        "Compare the image (flasher image-info) with the device (flasher info).",
        code=ErrorCode.NOT_FOR_DEVICE,
    ),
    Ending.NOT_TRUSTED: ErrorDescription(
        WrongDeviceError,
        "an older release than the device has received: faults that were fixed would come back",
        "Take the newest release of the maker.",
        code=ErrorCode.NOT_TRUSTED,
    ),
    Ending.IMPLAUSIBLE: ErrorDescription(
        ImageError,
        LIKELY_CAUSES,
        "Name the firmware file itself; flasher image-info shows what is in a file.",
        code=ErrorCode.IMAGE_IMPLAUSIBLE,
    ),
    Ending.UNCHECKED: ErrorDescription(
        WrongDeviceError,
        "no application runs on the device, or it has no query for a value of the manifest",
        "Look at the device's label, then waive the check; flasher rescue goes on without it.",
        code=ErrorCode.UNCHECKED,
    ),
    Ending.IN_USE: ErrorDescription(
        WrongDeviceError,
        "the bike is being ridden, or a load draws current",
        "Let it stand still and switch its loads off. --allow-in-use upgrades it all the same.",
        code=ErrorCode.VEHICLE_IN_USE,
    ),
    Ending.LOW_CHARGE: ErrorDescription(
        WrongDeviceError,
        "it was used or stored without being charged; an empty battery switches itself off, in the "
        "middle of its upgrade too",
        "Connect its charger: while it charges, the upgrade is allowed. "
        "--allow-low-charge upgrades it all the same.",
        code=ErrorCode.LOW_CHARGE,
    ),
    Ending.SECOND_TOOL: ErrorDescription(
        BusError,
        "another program or dongle sends as the CAN dongle (CDL) on this bus",
        "End the other tool and disconnect it. {again}",
        code=ErrorCode.SECOND_TOOL,
    ),
    Ending.TWO_DEVICES: TWO_UNTOUCHED,
    Ending.PACKET_FAILED: ErrorDescription(
        TransferError,
        "the device lost power or contact, the line is disturbed, or the device cannot store this "
        "packet",
        "Check supply and wiring. {again} A device that stays silent needs flasher rescue and a "
        "power cycle.",
        code=ErrorCode.PACKET_FAILED,
    ),
    Ending.RESTARTED: ErrorDescription(
        TransferError,
        "its supply drops, its watchdog resets it, it refuses a packet, or two devices "
        "of the same kind answer",
        "Check the supply, and that there is one {node} only. {again}",
        code=ErrorCode.RESTARTED,
    ),
    Ending.BROKEN_PROTOCOL: ErrorDescription(
        TransferError,
        "its bootloader does not follow the protocol",
        "Report the boot version to its maker. {again}",
        code=ErrorCode.BROKEN_PROTOCOL,
    ),
    Ending.REFUSED: ErrorDescription(
        RefusedError,
        "the image is not meant for this device, or the checksum that it carries is wrong",
        "Look at the image (flasher image-info) and flash one that the device accepts.",
    ),
    Ending.UNCONFIRMED: ErrorDescription(
        UnconfirmedError,
        "the answer was lost, or the device restarted without sending it",
        "Unconfirmed is not complete: check whether the new application runs, or flash again.",
    ),
    Ending.OTHER_VERSION: ErrorDescription(
        VerificationError,
        "the device runs another image than the one sent, or the image names its version wrongly",
        "Compare with flasher image-info, then flash the right image.",
        code=ErrorCode.OTHER_VERSION,
    ),
    Ending.CANCELLED: ErrorDescription(
        InterruptedByUserError,
        "",
        "{again} A bootloader that was receiving may need some seconds to time out first.",
    ),
}
_NO_SESSION_EITHER: Final = _EXPLANATIONS[Ending.NO_BOOT_VERSION]._replace(
    remedy="Check supply, wiring, termination and bit rate (flasher doctor), then reach the device "
    "by flasher rescue and a power cycle."
)
"""Explanation for a device that was silent to the update command as well (R26)."""
_ANSWERED_OTHERWISE: Final = ErrorDescription(
    TransferError,
    "its bootloader numbers packets in another way than table 9 (two bytes, the low one first) or "
    "answers them with another message, or an application runs again",
    "Report it to the maker of the bootloader, with the bundle. {again}",
    code=ErrorCode.PACKET_FAILED,
)
_APPLICATION_RUNS: Final = {
    Ending.NO_BOOT_VERSION: ErrorDescription(
        NoAnswerError,
        "its application runs: it ignores the reset in its state, its profile needs another "
        "reset_command, its announcement was lost, or its bootloader announces itself only at "
        "power-up",
        "{again} If it does not help, flasher rescue and a power cycle reach its bootloader.",
        code=ErrorCode.NO_BOOT_VERSION,
    ),
    Ending.NO_ANNOUNCEMENT: ErrorDescription(
        NoAnswerError,
        "its application runs: it was not switched off and on, or its bootloader does not announce "
        "itself at power-up",
        "Upgrade it with flasher flash, which resets the application itself.",
        code=ErrorCode.NO_ANNOUNCEMENT,
    ),
}
"""Explanations for a device whose application sent something shortly before."""


_TWO_PERHAPS_ERASED: Final = ErrorDescription(
    WrongDeviceError, TWO_DEVICES_CAUSE, TWO_DEVICES_REMEDY, code=ErrorCode.TWO_DEVICES
)


def image_refused(ending: Ending, target: Target, detail: str) -> FlasherError:
    """Create the error for an image that a check refuses where no device is concerned."""
    explained = _EXPLANATIONS[ending]
    if ending is Ending.NOT_FOR_DEVICE:
        explained = explained._replace(
            cause="another file or another target was meant, or the manifest is not up to date",
            remedy="Name the target of the image with -t, or another file.",
        )
    return explained.error(ending, target, detail)


def _late(phase: Phase, left: DeviceLeft) -> ErrorDescription:
    """Explain a missed deadline by the phase that was reached."""
    remedy = "Allow more time with --timeout, or find what is slow. {again}"
    match phase:
        case Phase.LISTEN | Phase.IDENTIFY | Phase.RESET | Phase.BOOT | Phase.UPDATE:
            cause = "the device is not there, or not ready in the time allowed"
            return ErrorDescription(NoAnswerError, cause, remedy)
        case Phase.END if left is not DeviceLeft.UNKNOWN:
            cause = "no time was left to send end of transfer"
            return ErrorDescription(TransferError, cause, remedy)
        case Phase.TRANSFER:
            cause = (
                "the device lost power or contact, it answers late again and again, or the bus is "
                "congested"
            )
            return ErrorDescription(TransferError, cause, remedy)
        case Phase.END | Phase.CONFIRM:
            cause = "the final answer did not come in the time allowed"
            return ErrorDescription(UnconfirmedError, cause, remedy)
        case _:
            assert_never(phase)
