"""Verification of what a device runs: version query, or reading the memory back.

`version`: the application reports the firmware version named in the image. `memory`: every byte of
the image is read back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from flasher import events
from flasher.errors import (
    BusError,
    ErrorCode,
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    UsageError,
    VerificationError,
    WrongDeviceError,
)
from flasher.host.options import UpgradeOptions, firmware_version, other_unit
from flasher.host.outcome import (
    TWO_DEVICES_CAUSE,
    TWO_DEVICES_REMEDY,
    TWO_UNTOUCHED,
    DeviceLeft,
    ErrorDescription,
    with_device_state,
)
from flasher.host.query import (
    READ_MEMORY,
    Query,
    ask,
    check_range,
    count_answers,
    memory_bytes,
    memory_requests,
)
from flasher.host.runner import Runner, Stage, StageInput, filtered
from flasher.image.image import AddressSpan
from flasher.image.plan import Plan
from flasher.protocol.contents import Memory, ReadMemory
from flasher.protocol.fields import Content
from flasher.protocol.messages import BootVersion, decode
from flasher.protocol.spec import Target
from flasher.protocol.timing import Announcing
from flasher.protocol.wire import Message
from flasher.wording import wording


class Level(Enum):
    """Level of a verification."""

    NONE = "none"
    VERSION = "version"
    MEMORY = "memory"


class Verdict(Enum):
    """Result of the verification."""

    NOT_ASKED = "not_asked"
    VERSION_RIGHT = "version_right"
    VERSION_UNJUDGED = "version_unjudged"
    MEMORY_RIGHT = "memory_right"
    VERSION_OTHER = "version_other"
    NO_ANSWER = "no_answer"
    IN_BOOTLOADER = "in_bootloader"
    MEMORY_OTHER = "memory_other"
    OTHER_UNIT = "other_unit"
    TWO_DEVICES = "two_devices"
    SECOND_TOOL = "second_tool"
    INTERRUPTED = "interrupted"


_LEFT: Final = {
    Verdict.NO_ANSWER: DeviceLeft.UNKNOWN,
    Verdict.IN_BOOTLOADER: DeviceLeft.NO_APPLICATION,
    Verdict.OTHER_UNIT: DeviceLeft.UNKNOWN,
    Verdict.TWO_DEVICES: DeviceLeft.UNKNOWN,
    Verdict.SECOND_TOOL: DeviceLeft.UNKNOWN,
    Verdict.VERSION_OTHER: DeviceLeft.OTHER,
    Verdict.MEMORY_OTHER: DeviceLeft.OTHER,
}
"""State of the device after verdicts that do not confirm that it runs the image."""
_JOINED_BYTES: Final = 16
GOOD: Final = frozenset(
    {Verdict.NOT_ASKED, Verdict.VERSION_RIGHT, Verdict.VERSION_UNJUDGED, Verdict.MEMORY_RIGHT}
)


_OTHER_IMAGE: Final = ErrorDescription(
    VerificationError,
    "the device runs another image, or fell back to an older one",
    "Power-cycle the device and look at it with flasher info; then flash the right image.",
)
_EXPLANATIONS: Final = {
    Verdict.INTERRUPTED: ErrorDescription(
        InterruptedByUserError, "", "Show its version with flasher info."
    ),
    Verdict.TWO_DEVICES: ErrorDescription(
        WrongDeviceError, TWO_DEVICES_CAUSE, TWO_DEVICES_REMEDY, code=ErrorCode.TWO_DEVICES
    ),
    Verdict.OTHER_UNIT: ErrorDescription(
        WrongDeviceError,
        "the unit was exchanged during the upgrade, or the new firmware reports "
        "another serial number",
        "One unit has the new image, and the other one perhaps not: connect one "
        "alone, look at it with flasher info, then at the other one.",
        code=ErrorCode.OTHER_UNIT,
    ),
    Verdict.SECOND_TOOL: ErrorDescription(
        BusError,
        "another program or dongle sends as the CAN dongle (CDL) on this bus",
        "End the other tool, then look at the device with flasher info.",
        code=ErrorCode.SECOND_TOOL,
    ),
    Verdict.IN_BOOTLOADER: ErrorDescription(
        VerificationError,
        "the device does not start the image that it confirmed, or a second device "
        "of its kind has lost its application",
        "Leave one {node} alone on the bus, then flash it again.",
        code=ErrorCode.IN_BOOTLOADER,
    ),
    Verdict.NO_ANSWER: ErrorDescription(
        VerificationError,
        "the application starts slowly (application_start_timeout_s of a profile), does "
        "not know the query, or does not start",
        "Look at the device with flasher info; if it does not answer, power-cycle it and "
        "look again, then flash it again. For one that answers all but its version, --verify none.",
    ),
    Verdict.VERSION_OTHER: _OTHER_IMAGE._replace(code=ErrorCode.OTHER_VERSION),
    Verdict.MEMORY_OTHER: _OTHER_IMAGE,
}
"""Errors of an upgrade by the verdict of its verification."""


@dataclass(frozen=True)
class Verification:
    """Level and verdict of a verification, and the reported firmware version (escaped)."""

    level: Level
    verdict: Verdict
    running_version: str | None = None
    detail: str = ""
    differing: tuple[AddressSpan, ...] = ()
    """Address ranges whose memory differs from the image."""

    @property
    def ok(self) -> bool:
        """True unless an answer contradicts the new image, or is missing."""
        return self.verdict in GOOD

    @property
    def device_left(self) -> DeviceLeft:
        """State of a device that has confirmed the image."""
        if self.running_version and self.verdict is Verdict.NO_ANSWER:
            return DeviceLeft.NEW  # it ran when it was asked for its version
        return _LEFT.get(self.verdict, DeviceLeft.NEW)

    def error(self, target: Target, *, is_after_upgrade: bool = True) -> FlasherError | None:
        """Create the error for the verdict; None for a good one. Without an upgrade before it, the
        device has confirmed nothing.
        """
        if self.ok:
            return None
        verdict = wording(self.verdict)
        ending = f"completed, but {verdict}" if is_after_upgrade else verdict
        what = f"{target.node.name}: {ending}"
        what += f" ({self.detail})." if self.detail else "."
        if is_after_upgrade:
            error = _EXPLANATIONS[self.verdict].create(what, target)
            error.needs_rescue = self.device_left.needs_rescue
            is_named = self.verdict in (Verdict.TWO_DEVICES, Verdict.OTHER_UNIT)
            if self.verdict is Verdict.INTERRUPTED or (error.needs_rescue and not is_named):
                error.remedy = with_device_state(error.remedy, self.device_left)
        else:
            error = self._error_of_comparison(target, what)
        error.where = f"verification by {self.level.value}"
        return error

    def _error_of_comparison(self, target: Target, what: str) -> FlasherError:
        if self.verdict is Verdict.TWO_DEVICES:
            return TWO_UNTOUCHED.create(what, target)
        if self.verdict is Verdict.SECOND_TOOL:
            return _EXPLANATIONS[self.verdict].create(what, target)
        if self.verdict is Verdict.IN_BOOTLOADER:
            return VerificationError(
                what,
                cause="an upgrade of it was broken off or refused: it has no application",
                remedy=f"Flash it: flasher flash IMAGE -t {target.name}.",
                code=ErrorCode.IN_BOOTLOADER,
            )
        if self.verdict is Verdict.NO_ANSWER:
            return NoAnswerError(
                what,
                cause="it is off, asleep or not connected, or an older device that does not know "
                "the query",
                remedy="Wake the device with its key; list the devices on the bus with flasher "
                "scan.",
            )
        is_other = self.verdict is Verdict.VERSION_OTHER
        cause = "it was flashed with another image"
        if not is_other:
            cause = "it was flashed with another image, or another build of the same version"
        return VerificationError(
            what,
            cause=cause,
            remedy=f"flasher flash IMAGE -t {target.name} upgrades it; "
            "flasher image-info shows what is in an image.",
            code=ErrorCode.OTHER_VERSION if is_other else None,
        )


NOT_ASKED: Final = Verification(Level.NONE, Verdict.NOT_ASKED)


def possible_levels(target: Target, options: UpgradeOptions | None = None) -> tuple[Level, ...]:
    """Return the verification levels of a target: the document has queries for the BMS only; a
    product may have its own version query.
    """
    levels = [Level.NONE]
    if (options or UpgradeOptions()).version_request_for(target) is not None:
        levels.append(Level.VERSION)
    if READ_MEMORY.receiver is target.node:
        levels.append(Level.MEMORY)
    return tuple(levels)


def as_level(level: Level | str) -> Level:
    """Return the verification level of this name. Raises UsageError."""
    try:
        return Level(level)
    except ValueError:
        names = ", ".join(each.value for each in Level)
        raise UsageError(
            f"There is no verification level {level!r}; the levels are {names}."
        ) from None


def default_level(target: Target, options: UpgradeOptions | None = None) -> Level:
    """Default verification level: by version for a target with a version query."""
    return Level.VERSION if Level.VERSION in possible_levels(target, options) else Level.NONE


def check_level(plan: Plan, level: Level, options: UpgradeOptions | None = None) -> None:
    """Raise UsageError if an upgrade cannot be verified at this level."""
    if level not in possible_levels(plan.target, options):
        raise UsageError(
            f"A {plan.target.node.name} cannot be verified by {level.value}.",
            cause="the document gives no query for it, and no profile names one",
            remedy="Leave --verify or --level out.",
        )
    if level is not Level.MEMORY:
        return
    if plan.image.base is None:
        raise UsageError(
            "The memory cannot be read back without addresses.",
            cause=f"{plan.image.source} is a raw binary",
            remedy="Give the address of its first byte with --base.",
        )
    check_range(plan.image.base, plan.image.base + plan.image.size_bytes)


def version_check(plan: Plan, options: UpgradeOptions) -> Runner[Verification]:
    """Create an engine that waits for the new application and queries its version."""
    return Runner(
        lambda run: check_version(run, plan, options),
        bitrate_bps=plan.bitrate_bps,
        timings=options.timings,
    )


def memory_check(
    plan: Plan, options: UpgradeOptions, running_version: str | None
) -> Runner[Verification]:
    """Create an engine that reads the image back. Raises ValueError for an image without base."""
    if plan.image.base is None:
        raise ValueError("an image without a base cannot be read back")
    return Runner(
        lambda run: check_memory(run, plan, running_version),
        bitrate_bps=plan.bitrate_bps,
        timings=options.timings,
    )


def check_version(
    run: Runner[Any], plan: Plan, options: UpgradeOptions, serial_before: str = ""
) -> Stage[Verification]:
    """Wait for the application and query its version; `serial_before` is its serial number before
    the upgrade, "" if unknown. Raises ValueError without a version query.
    """
    request = options.version_request_for(plan.target)
    if request is None:
        raise ValueError("this target has no version query")
    start_s = run.timings.application_start_timeout_s
    give_up_at = run.now + start_s
    announcing = Announcing(run.timings)
    run.also_listen_on(plan.target.answer_id)
    look = _note_boot_versions(run, plan.target, announcing)
    while True:
        asked_at = run.now
        query = yield from filtered(ask(run, Query(request, quiet=True)), look)
        if query.answer is not None:
            announced = announcing.count
            if not run.is_cancelled:
                again = yield from filtered(ask(run, Query(request, quiet=True)), look)
                yield from filtered(count_answers(run, [again]), look)
            # A device that restarted answers again; the bootloader of a second one goes on.
            is_settled = announcing.count == announced
            if is_settled or run.is_cancelled or run.duplicates.evidence:
                break
        if run.is_cancelled:
            return Verification(Level.VERSION, Verdict.INTERRUPTED)
        if run.now >= max(give_up_at, announcing.judged_at) and announcing.goes_on(run.now):
            return Verification(Level.VERSION, Verdict.IN_BOOTLOADER)
        # One that starts it through its bootloader may need as long again.
        if asked_at >= max(give_up_at, announcing.last_at + start_s):
            return Verification(Level.VERSION, Verdict.NO_ANSWER)
    return _judge_version(run, plan, query.answer, serial_before)


def _judge_version(
    run: Runner[Any], plan: Plan, answer: Content, serial_before: str
) -> Verification:
    version = firmware_version(answer)
    if run.duplicates.evidence:
        return Verification(Level.VERSION, Verdict.TWO_DEVICES, version, run.duplicates.evidence)
    other = other_unit(answer, serial_before)
    if other:
        return Verification(Level.VERSION, Verdict.OTHER_UNIT, version, other)
    expected = plan.image.version
    if expected is not None and version != expected:
        difference = f"{version} instead of {expected}"
        return Verification(Level.VERSION, Verdict.VERSION_OTHER, version, difference)
    if run.is_cancelled:  # no second device could answer
        return Verification(Level.VERSION, Verdict.INTERRUPTED, version)
    verdict = Verdict.VERSION_UNJUDGED if expected is None else Verdict.VERSION_RIGHT
    return Verification(Level.VERSION, verdict, version)


def _note_boot_versions(
    run: Runner[Any], target: Target, announcing: Announcing
) -> Callable[[StageInput], StageInput]:
    """Return a function that notes boot versions among the inputs of a query. It starts over after
    a pause of this computer: those that are read then were sent at an unknown time.
    """
    input_at = run.now
    paused_s = 2 * run.timings.command_repeat_s

    def look(came: StageInput) -> StageInput:
        nonlocal input_at
        if run.now - input_at > paused_s:
            announcing.forget()
        input_at = run.now
        match came:
            case Message(can_id=target.answer_id) if isinstance(decode(came), BootVersion):
                announcing.note(run.now)
        return came

    return look


def check_memory(run: Runner[Any], plan: Plan, running_version: str | None) -> Stage[Verification]:
    """Read the whole image back and compare it; the image must have a base address. Goes on after a
    difference, so that the result has all of them.
    """
    data, base = plan.image.data, plan.image.base or 0
    differing: list[AddressSpan] = []
    first = ""

    def found(verdict: Verdict, detail: str = "") -> Verification:
        return Verification(Level.MEMORY, verdict, running_version, detail, tuple(differing))

    for request in memory_requests(base, base + len(data)):
        query = yield from ask(run, Query(request, quiet=True))
        if query.answer is None and run.is_cancelled:
            return Verification(Level.MEMORY, Verdict.INTERRUPTED)
        assert isinstance(request.content, ReadMemory)  # noqa: S101  as memory_requests makes them
        start, end = request.content.start, request.content.end
        if not isinstance(query.answer, Memory):
            return found(Verdict.NO_ANSWER, f"to a memory read at 0x{start:08X}")
        expected, got = data[start - base : end - base], memory_bytes(query.answer)
        for at, byte in enumerate(expected):
            if got[at] != byte:
                first = first or f"first at 0x{start + at:08X}: {got[at]:02X} instead of {byte:02X}"
                _add_address(differing, start + at)
        run.emit(events.MemoryRead(end - base, len(data)))
        if run.is_cancelled and end - base < len(data):
            return Verification(Level.MEMORY, Verdict.INTERRUPTED)
    return found(Verdict.MEMORY_OTHER, first) if first else found(Verdict.MEMORY_RIGHT)


def _add_address(spans: list[AddressSpan], address: int) -> None:
    """Add an address after all others; a few equal bytes between do not separate two ranges."""
    is_near = bool(spans) and address - spans[-1].end <= _JOINED_BYTES
    start = spans.pop().start if is_near else address
    spans.append(AddressSpan(start, address + 1 - start))
