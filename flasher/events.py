"""Events of upgrades, queries and the device model: one frozen dataclass per kind.

Engines create them, the driver passes them on, and the caller (command line, station, program)
decides which to show. Times are seconds on the engine's clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Final

WAY_BACK: Final = "way-back"
SETTINGS: Final = "settings"
ALWAYS_SHOWN: Final = frozenset({WAY_BACK, SETTINGS})
"""Checks that are shown when they pass too."""


# -- the host -------------------------------------------------------------------------------------


class Phase(Enum):
    """Phase of an upgrade."""

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
    """An upgrade entered a phase; attempts count from 1."""

    phase: Phase
    attempt: int


@dataclass(frozen=True)
class BootVersionSeen:
    """The bootloader announced itself for the first time in this attempt. Texts are escaped."""

    name: str
    version: str


@dataclass(frozen=True)
class PowerCycleAwaited:
    """The device must be switched off and on within `limit_s` seconds."""

    limit_s: float


@dataclass(frozen=True)
class CheckMade:
    """Result of the check named `check` before the first write. `verdict` is "passed", "unknown"
    (no value to compare with), "warned", "waived", "refused" or "skipped".
    """

    check: str
    verdict: str
    text: str


@dataclass(frozen=True)
class ShutdownHeard:
    """The battery announced that it switches off (0x1308)."""

    sender: str


@dataclass(frozen=True)
class ForeignQuery:
    """Another tool queries the device during the upgrade; `title` names the query. It writes
    nothing, so the upgrade continues. Reported once per query.
    """

    title: str


@dataclass(frozen=True)
class SecondToolAwaited:
    """Another tool writes to the device, which has no application any more; `seen` describes its
    frame. The upgrade starts over when that tool has been silent for `quiet_s` seconds.
    """

    seen: str
    quiet_s: float


@dataclass(frozen=True)
class AdapterLost:
    """The adapter failed; flasher tries to open it again for `wait_s` seconds."""

    reason: str
    wait_s: float


@dataclass(frozen=True)
class AdapterAwaited:
    """Seconds that the lost adapter has left to come back. Reported every second."""

    left_s: int


@dataclass(frozen=True)
class BusBlocked:
    """The adapter's frames are not sent. The upgrade of a device without application keeps trying
    for `limit_s` seconds, until the overall deadline.
    """

    reason: str
    limit_s: float


@dataclass(frozen=True)
class AdapterBack:
    """The adapter works again."""


@dataclass(frozen=True)
class HostStalled:
    """This computer paused the driver loop for `stalled_s` seconds."""

    stalled_s: float


@dataclass(frozen=True)
class PacketAcknowledged:
    """The device acknowledged packet `number` of `total` after `tries` transmissions."""

    number: int
    total: int
    tries: int


@dataclass(frozen=True)
class MessageRepeated:
    """A message is sent again; `what` names it, `reason` says why."""

    what: str
    reason: str
    tries: int


@dataclass(frozen=True)
class Reported:
    """Unexpected observation that does not stop the upgrade; `what` is one sentence."""

    what: str


@dataclass(frozen=True)
class UpgradeLeftOpen:
    """The upgrade begun at `at` with `image` has no end (`has_end` False), or may have left the
    device without an application. If the device stays silent, it may still be in that transfer, and
    gets an update command (R26).
    """

    at: str
    image: str
    has_end: bool


@dataclass(frozen=True)
class AttemptStarted:
    """The upgrade starts over; attempts count from 1. `left_s` is the time until the overall
    deadline if only that limits the attempts, else 0.
    """

    attempt: int
    reason: str
    left_s: float = 0.0


# -- queries --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class QueryAnswered:
    """The device answered a query with `content`."""

    title: str
    content: object
    tries: int


@dataclass(frozen=True)
class QueryUnanswered:
    """The device did not answer a query in time, after `tries` transmissions."""

    title: str
    tries: int


@dataclass(frozen=True)
class TwoDevicesSeen:
    """Two devices of one kind answered; `what` is the evidence."""

    what: str


@dataclass(frozen=True)
class VerificationStarted:
    """The device confirmed the image; its verification by `level` ("version", "memory") begins."""

    level: str


@dataclass(frozen=True)
class MemoryRead:
    """Number of bytes read back correctly, of `total_bytes`."""

    read_bytes: int
    total_bytes: int


# -- both sides -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class BytesDamaged:
    """Received bytes of a CAN id that are not a message."""

    can_id: int
    reason: str
    data: bytes


# -- the device model -----------------------------------------------------------------------------


@dataclass(frozen=True)
class DeviceStateEntered:
    """The device model changed its state. Alternation between storing a packet and waiting for the
    next is only reported as `PacketStored`.
    """

    state: str
    detail: str


@dataclass(frozen=True)
class PacketStored:
    """The device model stored packet `number` of `total` in its flash."""

    number: int
    total: int


@dataclass(frozen=True)
class ImageStored:
    """The device model stored a complete image of `size_bytes`; SHA-256 in hexadecimal."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class DeviceReported:
    """The device model refused or ignored a message; `what` is one sentence."""

    what: str


@dataclass(frozen=True)
class DeviceWritten:
    """A write changed a stored item of the device model; old and new value are escaped."""

    name: str
    before: str
    after: str


@dataclass(frozen=True)
class ShutdownAnnounced:
    """The BMS model announces that it switches off, and the reason."""

    why: str


@dataclass(frozen=True)
class ShutdownEnded:
    """The BMS model switches off; names of the nodes that were ready, and of the silent ones."""

    ready: tuple[str, ...]
    silent: tuple[str, ...]
