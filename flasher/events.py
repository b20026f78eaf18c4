"""What flasher reports while it works: frozen dataclasses, one a kind of event.

The engines make them, the driver hands them on, and whoever called (the command line, a station, a
program) decides what to show. Times are seconds on the clock that the engine was given.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

# -- the host -------------------------------------------------------------------------------------


class Phase(Enum):
    """Where an upgrade stands, in the words of the protocol."""

    LISTEN = "listen"
    IDENTIFY = "identify"
    RESET = "reset"
    BOOT = "boot"
    UPDATE = "update"
    TRANSFER = "transfer"
    END = "end"
    CONFIRM = "confirm"


@dataclass(frozen=True)
class PhaseEntered:
    """The upgrade entered a phase; attempts count from 1."""

    phase: Phase
    attempt: int


@dataclass(frozen=True)
class BootVersionSeen:
    """The bootloader announced itself for the first time in this attempt. Texts are escaped."""

    name: str
    version: str


@dataclass(frozen=True)
class PowerCycleAwaited:
    """The device has to be switched off and on now; its announcement is waited for so long."""

    limit_s: float


@dataclass(frozen=True)
class CheckMade:
    """Something was checked before the first write: `check` names it, `verdict` is "passed",
    "unknown" (nothing to check against), "warned", "waived", "refused" or "skipped", `text` is one
    sentence.
    """

    check: str
    verdict: str
    text: str


@dataclass(frozen=True)
class ShutdownHeard:
    """The battery announces that it switches off (0x1308)."""

    sender: str


@dataclass(frozen=True)
class ForeignQuery:
    """Another tool asks the device that is upgraded for something; `title` names it. It writes
    nothing, so the upgrade goes on. Reported once for each question.
    """

    title: str


@dataclass(frozen=True)
class SecondToolAwaited:
    """Another tool writes to the device, which has no application any more; `seen` is what it sent.
    Nothing is sent until it was silent for `quiet_s`, then the upgrade begins again.
    """

    seen: str
    quiet_s: float


@dataclass(frozen=True)
class AdapterLost:
    """The adapter failed; for `wait_s` it is tried to be opened again."""

    reason: str
    wait_s: float


@dataclass(frozen=True)
class AdapterAwaited:
    """The lost adapter is waited for `left_s` seconds more. Reported every second."""

    left_s: int


@dataclass(frozen=True)
class BusBlocked:
    """The adapter's frames do not leave any more; for `limit_s`, until the overall deadline, the
    upgrade of a device that has no application goes on trying.
    """

    reason: str
    limit_s: float


@dataclass(frozen=True)
class AdapterBack:
    """The adapter works again; the attempt that follows is reported as every other."""


@dataclass(frozen=True)
class HostStalled:
    """This computer did not run the loop for `stalled_s` longer than it meant to wait."""

    stalled_s: float


@dataclass(frozen=True)
class PacketAcknowledged:
    """The device has packet `number` of `total`; it was sent `tries` times."""

    number: int
    total: int
    tries: int


@dataclass(frozen=True)
class MessageRepeated:
    """A message is sent again; `what` names it, `reason` says why, in one word."""

    what: str
    reason: str
    tries: int


@dataclass(frozen=True)
class Reported:
    """Something unexpected that does not stop the upgrade; one sentence."""

    what: str


@dataclass(frozen=True)
class UpgradeLeftOpen:
    """The upgrade that began at `at` with `image` has no end (`has_end` False), or left the device
    without an application, or perhaps so. A device that stays silent may still sit in it, and gets
    an update command (R26).
    """

    at: str
    image: str
    has_end: bool


@dataclass(frozen=True)
class AttemptStarted:
    """The transfer starts over; attempts count from 1. `left_s` is the time until the overall
    deadline where only that ends the attempts, 0 where their number does.
    """

    attempt: int
    reason: str
    left_s: float = 0.0


# -- queries --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class QueryAnswered:
    """The device answered; `content` is the answer (a `flasher.protocol.fields.Content`)."""

    title: str
    content: object
    tries: int


@dataclass(frozen=True)
class QueryUnanswered:
    """The device did not answer within the time allowed."""

    title: str
    tries: int


@dataclass(frozen=True)
class TwoDevicesSeen:
    """Two devices of one kind have answered; `what` was seen, in words."""

    what: str


@dataclass(frozen=True)
class VerificationStarted:
    """The device has confirmed the image; now it is verified by `level` ("version", "memory")."""

    level: str


@dataclass(frozen=True)
class MemoryRead:
    """So many of `total_bytes` were read back and are right."""

    read_bytes: int
    total_bytes: int


# -- both sides -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class BytesDamaged:
    """Received bytes on a CAN id that made no message."""

    can_id: int
    reason: str
    data: bytes


# -- the device model -----------------------------------------------------------------------------


@dataclass(frozen=True)
class DeviceStateEntered:
    """The device model is in another state. Storing a packet and waiting for the next one take
    turns unreported: `PacketStored` tells.
    """

    state: str
    detail: str


@dataclass(frozen=True)
class PacketStored:
    """The device model has packet `number` of `total` in its flash."""

    number: int
    total: int


@dataclass(frozen=True)
class ImageStored:
    """The device model has a whole new image of `size_bytes`; SHA-256 in hexadecimal."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class DeviceReported:
    """The device model refused or ignored something; one sentence."""

    what: str


@dataclass(frozen=True)
class DeviceWritten:
    """A write changed what the device model keeps: name of the item, old and new value, escaped."""

    name: str
    before: str
    after: str


@dataclass(frozen=True)
class ShutdownAnnounced:
    """The BMS model announces that it switches off, and why."""

    why: str


@dataclass(frozen=True)
class ShutdownEnded:
    """The BMS model switches off; names of the nodes that were ready for it, and of the others."""

    ready: tuple[str, ...]
    silent: tuple[str, ...]
