"""What "verified" means after an upgrade, and the machines that find it out.

`version`: the new application answers, and names the version that the image names. `memory`: every
byte of the image is read back. Both are machines like all others; `session` runs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from flasher import events
from flasher.errors import (
    BusError,
    FlasherError,
    InterruptedByUserError,
    UsageError,
    VerificationError,
)
from flasher.host.options import UpgradeOptions, firmware_version
from flasher.host.outcome import DeviceLeft
from flasher.host.query import Query, Request
from flasher.host.read import READ_MEMORY, memory_requests, piece_of
from flasher.image.plan import Plan
from flasher.protocol.contents import (
    MEMORY_PIECE_SIZE,
    Memory,
)
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Target


class Level(Enum):
    """How far an upgrade is verified after the device has confirmed it."""

    NONE = "none"
    VERSION = "version"
    MEMORY = "memory"


class Verdict(Enum):
    """What the verification found; the value completes "verification: ..."."""

    NOT_ASKED = "not asked for"
    VERSION_RIGHT = "the application runs and names the version of the image"
    VERSION_UNJUDGED = "the application runs; the image names no version to compare with"
    MEMORY_RIGHT = "every byte read back is the image's"
    VERSION_OTHER = "the application runs another version than the image names"
    NO_ANSWER = "the application does not answer"
    MEMORY_OTHER = "the memory differs from the image"
    SECOND_TOOL = "a second tool speaks on the bus"
    INTERRUPTED = "interrupted by the user"


_IT_HAS: Final = f"State of the device: {DeviceLeft.NEW.value}."
GOOD: Final = frozenset(
    {Verdict.NOT_ASKED, Verdict.VERSION_RIGHT, Verdict.VERSION_UNJUDGED, Verdict.MEMORY_RIGHT}
)


@dataclass(frozen=True)
class Verification:
    """The result: level asked for, verdict, version that the application answers (escaped)."""

    level: Level
    verdict: Verdict
    running_version: str | None = None
    detail: str = ""

    @property
    def ok(self) -> bool:
        """True when nothing speaks against the new image."""
        return self.verdict in GOOD

    def error(self, target: Target) -> FlasherError | None:
        """The error that stands for it; None when there is none."""
        if self.ok:
            return None
        what = f"{target.node.name}: completed, but {self.verdict.value}"
        what += f" ({self.detail})." if self.detail else "."
        if self.verdict is Verdict.INTERRUPTED:
            return InterruptedByUserError(
                what,
                where=f"verification by {self.level.value}",
                remedy=f"See with flasher info what it runs. {_IT_HAS}",
            )
        if self.verdict is Verdict.SECOND_TOOL:
            return BusError(
                what,
                where=f"verification by {self.level.value}",
                cause="another program or dongle speaks as the CAN dongle (CDL) on this bus",
                remedy=f"End the other tool, then look at the device with flasher info. {_IT_HAS}",
            )
        return VerificationError(
            what,
            where=f"verification by {self.level.value}",
            cause="the device runs another image, fell back to an older one, or does not start",
            remedy="Power-cycle the device and look at it with flasher info; then flash the right "
            "image.",
        )


NOT_ASKED: Final = Verification(Level.NONE, Verdict.NOT_ASKED)


def possible_levels(target: Target, options: UpgradeOptions | None = None) -> tuple[Level, ...]:
    """What can be verified on a target: the document gives queries for the BMS only, a product may
    have a version query of its own.
    """
    levels = [Level.NONE]
    if (options or UpgradeOptions()).version_request_for(target) is not None:
        levels.append(Level.VERSION)
    if READ_MEMORY.receiver is target.node:
        levels.append(Level.MEMORY)
    return tuple(levels)


def as_level(level: Level | str) -> Level:
    """A level of verification by its name. Raises UsageError."""
    try:
        return Level(level)
    except ValueError:
        names = ", ".join(each.value for each in Level)
        raise UsageError(f"There is no verification {level!r}; there are {names}.") from None


def default_level(target: Target, options: UpgradeOptions | None = None) -> Level:
    """How far an upgrade of a target is verified unless somebody says otherwise: by its version
    where there is a query for it.
    """
    return Level.VERSION if Level.VERSION in possible_levels(target, options) else Level.NONE


def check_level(plan: Plan, level: Level, options: UpgradeOptions | None = None) -> None:
    """Raise UsageError when an upgrade cannot be verified so."""
    if level not in possible_levels(plan.target, options):
        raise UsageError(
            f"A {plan.target.node.name} cannot be verified by {level.value}.",
            cause="the document gives no query for it, and no profile names one",
            remedy="Leave --verify out, or use --verify none.",
        )
    if level is Level.MEMORY and plan.image.base is None:
        raise UsageError(
            "The memory cannot be read back without addresses.",
            cause=f"{plan.image.source} is a raw binary",
            remedy="Say with --base where its first byte lies.",
        )


class Check:
    """A machine that asks one query after another until it knows its verdict; an engine."""

    def __init__(self, plan: Plan, options: UpgradeOptions) -> None:
        self._plan = plan
        self._options = options
        self._timings = options.timings
        self._began_at: float | None = None
        self._query: Query | None = None
        self._events: list[object] = []
        self._cancelled = False
        self.verification: Verification | None = None

    # -- what the two checks differ in -----------------------------------------------------------

    level = Level.NONE

    def _first(self) -> Request:
        raise NotImplementedError

    def _judge(self, answer: Content | None, now: float) -> Request | None:
        """The next request, or None after `_conclude`."""
        raise NotImplementedError

    def _conclude(self, verdict: Verdict, version: str | None = None, detail: str = "") -> None:
        self.verification = Verification(self.level, verdict, version, detail)

    # -- the engine interface --------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True when the verdict is known."""
        return self.verification is not None

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        if self._query is not None:
            self._query.receive(frame, now)
            self._go_on(now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._began_at is None:
            self._began_at = now
            self._ask(self._first())
        if self._query is not None:
            self._query.tick(now)
            self._go_on(now)

    def deadline(self) -> float | None:
        """When it next wants `tick`; at once before the beginning."""
        if self._query is None:
            return 0.0 if not self.done else None
        return self._query.deadline()

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        return None if self._query is None else self._query.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted it."""
        if self._query is not None:
            self._query.frame_sent(now)
            self._go_on(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        self._cancelled = True
        if self._query is None:
            self._conclude(Verdict.INTERRUPTED)
        else:
            self._query.cancel(now)
            self._go_on(now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        taken, self._events = self._events, []
        return taken

    def _ask(self, request: Request) -> None:
        self._query = Query(request, bitrate_bps=self._plan.bitrate_bps, timings=self._timings)

    def _go_on(self, now: float) -> None:
        query = self._query
        if query is None or not query.done:
            return
        self._query = None
        if self._cancelled and query.answer is None:
            self._conclude(Verdict.INTERRUPTED)
            return
        following = self._judge(query.answer, now)
        if following is None:
            return
        if self._cancelled:
            self._conclude(Verdict.INTERRUPTED)
            return
        self._ask(following)
        self.tick(now)


class VersionCheck(Check):
    """Waits for the new application and asks for its version."""

    level = Level.VERSION

    def _first(self) -> Request:
        request = self._options.version_request_for(self._plan.target)
        if request is None:
            raise ValueError("nobody knows how to ask this target for its version")
        return request

    def _judge(self, answer: Content | None, now: float) -> Request | None:
        if answer is None:
            began_at = now if self._began_at is None else self._began_at
            if now - began_at < self._timings.application_start_timeout_s:
                return self._first()
            self._conclude(Verdict.NO_ANSWER)
            return None
        version = firmware_version(answer)
        expected = self._plan.image.version
        if expected is None:
            self._conclude(Verdict.VERSION_UNJUDGED, version)
        elif version == expected:
            self._conclude(Verdict.VERSION_RIGHT, version)
        else:
            self._conclude(Verdict.VERSION_OTHER, version, f"{version} instead of {expected}")
        return None


class MemoryCheck(Check):
    """Reads the whole image back and compares it. The image needs a base."""

    level = Level.MEMORY

    def __init__(self, plan: Plan, options: UpgradeOptions, running_version: str | None) -> None:
        super().__init__(plan, options)
        if plan.image.base is None:
            raise ValueError("an image without a base cannot be read back")
        self._base = plan.image.base
        self._offset = 0
        self._running_version = running_version

    def _first(self) -> Request:
        end = self._base + self._plan.image.size_bytes
        return next(memory_requests(self._base + self._offset, end))

    def _judge(self, answer: Content | None, now: float) -> Request | None:
        data = self._plan.image.data
        where = f"at 0x{self._base + self._offset:08X}"
        if not isinstance(answer, Memory):
            self._conclude(Verdict.NO_ANSWER, self._running_version, f"to a memory read {where}")
            return None
        expected = data[self._offset : self._offset + MEMORY_PIECE_SIZE]
        got = piece_of(answer)
        if got != expected:
            at = next(index for index, byte in enumerate(expected) if got[index] != byte)
            address = self._base + self._offset + at
            detail = f"first at 0x{address:08X}: {got[at]:02X} instead of {expected[at]:02X}"
            self._conclude(Verdict.MEMORY_OTHER, self._running_version, detail)
            return None
        self._offset += len(expected)
        self._events.append(events.MemoryRead(self._offset, len(data)))
        if self._offset >= len(data):
            self._conclude(Verdict.MEMORY_RIGHT, self._running_version)
            return None
        return self._first()
