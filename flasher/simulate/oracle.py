"""Judges a simulated upgrade: compares the claims of its result with the flash of every device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

from flasher.bus.link import SEND_LIMIT_S
from flasher.errors import ExitCode
from flasher.host.outcome import DeviceLeft
from flasher.protocol.spec import FRAMES_PER_PACKET
from flasher.protocol.timing import DEFAULT_TIMINGS as TIMES
from flasher.simulate import plan as plans
from flasher.simulate.wire_rules import WireRules

DOCUMENTED: Final = frozenset(ExitCode) - {
    ExitCode.INTERNAL, ExitCode.USAGE, ExitCode.IMAGE, ExitCode.NOTHING_TO_DO, ExitCode.PARTIAL,
}  # fmt: skip
"""Exit codes that a plan can cause; the image of a plan is always one for its device."""
LATEST: Final = 1.001
"""Latest end as a share of the announced deadline."""
_FINISH_S: Final = 0.012
"""Time on the bus of a packet that had begun at the deadline, without gaps."""
_BLOCKS: Final = (plans.Load, plans.Unplug, plans.BusOff)
"""Faults in which the adapter may take no frame for some time."""
_LIES_AT_THE_END: Final = (
    plans.Answer, plans.Unsolicited, plans.Tool, plans.Noise, plans.OnFrames, plans.FlashFails,
)  # fmt: skip
"""Faults after which a right host may take a complete image for a refused one."""
_ATTEMPTS: Final = 3
"""Attempts of an upgrade, unless the plan has another number (docs/explanation/upgrade.md)."""
_BEGIN_S: Final = TIMES.boot_version_timeout_s + TIMES.request_transfer_timeout_s
"""Longest time in which a device begins an attempt (R12)."""
_BOOT_VERSION_S: Final = 0.002
"""Longer than a boot version is on the bus after the message before it."""
_COMPLETE_S: Final = TIMES.complete_timeout_s * TIMES.end_tries
_INTERRUPTED_S: Final = TIMES.command_timeout_s + 0.5
"""Longest time from Ctrl-C to the end: a message that has begun is finished."""
_CANNOT_SUCCEED: Final = ("battery_use=riding", "answers=false", "image_checksum=crc32")
"""Choices of a device that is not upgraded, or does not show that it was."""
_LOOKS_LIKE_TWO: Final = (
    plans.Unsolicited, plans.Tool, plans.Noise, plans.OnFrames, plans.Load,
)  # fmt: skip
"""Faults after which one device may look like two: other traffic may have its CAN ids."""


class SubjectFailedError(BaseException):
    """The bootloader under test crashed, hung or used its flash wrongly; no code of the host may
    catch it.
    """


@dataclass(frozen=True)
class Violation:
    """Broken promise, of one of these kinds.

    FALSE         a success that is none, or a version that no device reported
    DISHONEST     a wrong statement about what the device has
    OVERDUE       the run did not end
    LATE          it ended after its deadline
    FAILED        no success, though nothing was disturbed, or earlier than its attempts may take
    UNDOCUMENTED  an exit code
    FOREIGN       a frame to another device
    WIRE          a message that must not be sent then
    STATISTICS    impossible counts
    ACCUSED       one device reported as two
    CORRUPT       a device that would start what is no image
    LOST          a device that the tool cannot bring back
    CRASH         an exception of the code under test
    SUBJECT       a bootloader under test that crashed, hung, or used its flash wrongly
    KILLED        the process of the simulation died
    UNSEEN        a success beside a device that cannot be seen; it is excused
    """

    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}"

    @property
    def is_excused(self) -> bool:
        """True for a success beside a device that sent nothing in the transfer, or one that reports
        that the adapter was away while another tool or device may have sent: the bus shows
        neither (docs/explanation/safety.md, "What stays unseen").
        """
        return self.kind == "UNSEEN"


@dataclass
class Reported:
    """What a run reports of itself."""

    ending: str
    exit_code: int
    is_ok: bool
    left: DeviceLeft | None
    """None where only `needs_rescue` is reported."""
    needs_rescue: bool
    attempts: int = 0
    acknowledged: int = 0
    """Packets."""
    reports_version: bool = False
    """It names the version that the new application reports."""
    unobserved_s: float = 0.0
    """Time of the transfer in which the adapter was away."""
    where: str = ""
    is_overdue: bool = False


@dataclass
class UnitFacts:
    """A device after a run; contents are new, old, none or other."""

    at_end: str
    """Content when the run ended."""
    now: str
    took_part: bool
    """It was on the bus at the update command, or its flash has changed."""
    was_at_update: bool
    was_heard: bool
    """A message of its own reached the tool during the transfer."""
    runs_nothing: bool = False
    """Its application is reported to run, and its flash holds none."""


@dataclass
class Facts:
    """What was observed of a run, from outside of the host."""

    plan: plans.Plan
    request_id: int
    rules: WireRules
    host_ids: set[int] = field(default_factory=set)
    """CAN ids of the host's frames."""
    before: str = "old"
    """Content of the device when the run began."""
    may_have_erased: bool = False
    """The run sent an update command."""
    units: Sequence[UnitFacts] = ()
    started: Sequence[str] = ()
    """What a bootloader under test would have started after each power-up and reset."""
    took_s: float = 0.0
    limit_s: float = 1.0
    """Announced deadline."""
    interrupted_s: float = 0.0
    """Duration from the first Ctrl-C to the end; 0 without one."""

    def begin_run(self, before: str) -> None:
        """Begin with another process of the host."""
        self.before, self.may_have_erased = before, False
        self.rules.begin_run()


def judge(facts: Facts, reported: Reported) -> Iterator[Violation]:
    """Return what a run claims wrongly, or does against the protocol."""
    if reported.is_overdue:
        yield Violation("OVERDUE", f"not at an end {facts.limit_s:.0f} s after its deadline")
        return
    if reported.exit_code not in DOCUMENTED:
        yield Violation("UNDOCUMENTED", f"exit code {reported.exit_code}")
    if reported.is_ok != (reported.exit_code == ExitCode.OK):
        yield Violation("UNDOCUMENTED", "success and exit code differ")
    # An adapter that can send nothing is waited for.
    blocked_s = SEND_LIMIT_S if not facts.plan.job.others or _has(facts.plan, _BLOCKS) else 0.0
    paused_s = sum(each.seconds for each in facts.plan.clauses if isinstance(each, plans.Stall))
    if facts.took_s > LATEST * facts.limit_s + _FINISH_S + blocked_s + paused_s:
        share = facts.took_s / facts.limit_s
        yield Violation("LATE", f"ended at {share:.4f} of the announced deadline")
    if facts.interrupted_s > _INTERRUPTED_S + blocked_s + paused_s:
        yield Violation("LATE", f"ended {facts.interrupted_s:.1f} s after Ctrl-C")
    if reported.ending == "cancelled" and facts.rules.has_half_message:
        yield Violation("WIRE", "cancelled in the middle of a message")
    if facts.host_ids - {facts.request_id}:
        ids = ", ".join(f"0x{each:03X}" for each in sorted(facts.host_ids - {facts.request_id}))
        yield Violation("FOREIGN", f"frames with the id {ids}")
    for text in facts.rules.broken():
        yield Violation("WIRE", text)
    if reported.ending == "refused" and facts.rules.ends < 2 and not _has(facts.plan, _BLOCKS):
        yield Violation("WIRE", "refused, and end of transfer was sent once only (R6)")
    yield from _judge_failure(facts, reported)
    yield from _judge_report(facts, reported)
    yield from _judge_contents(facts, reported)


def _judge_report(facts: Facts, reported: Reported) -> Iterator[Violation]:
    """Check what a run reports beside its success."""
    plan = facts.plan
    device = plan.devices[0]
    is_running = device.begins == "application" and device.application == "old"
    is_riding = "battery_use=riding" in str(device) and is_running
    if is_riding and len(plan.devices) == 1 and facts.may_have_erased and not [*plan.events]:
        yield Violation("WIRE", "an update command to a battery that is in use")
    if reported.acknowledged > plan.job.packets:
        text = f"{reported.acknowledged} acknowledged packets of {plan.job.packets}"
        yield Violation("STATISTICS", text)
    # Of a killed run, the device may be left in its transfer: the way out of it is not counted.
    counts_attempts = plan.job.attempts and not _has(plan, (plans.Kill,))
    if counts_attempts and reported.attempts > plan.job.attempts:
        text = f"{reported.attempts} attempts, and {plan.job.attempts} were allowed"
        yield Violation("STATISTICS", text)
    if not facts.rules.has_version_answer:
        if reported.reports_version:
            yield Violation("FALSE", "a version is reported, and the device sent none")
        elif reported.is_ok and plan.job.target == "bms":
            yield Violation("FALSE", "success, and the new application never sent its version")
    looks_like_two = [each for each in plan.clauses if isinstance(each, _LOOKS_LIKE_TWO)]
    # A message that comes again at once is doubled by the line.
    looks_like_two = [each for each in looks_like_two if not getattr(each, "whole", False)]
    is_single = len(plan.devices) == 1 and not looks_like_two
    # Answers that come twice again and again are those of two devices.
    answers = [each for each in plan.clauses if isinstance(each, plans.Answer)]
    is_single &= not answers or answers == [plans.Answer(when=answers[0].when, becomes="twice")]
    # While a host waits for room in a short queue, it cannot read how close two answers are.
    is_single &= not answers or plan.adapter.queue >= FRAMES_PER_PACKET
    if "two_devices" in reported.ending and is_single:
        yield Violation("ACCUSED", "two devices are reported, and there is one")


def _restart_s(device: plans.Device) -> float:
    """Time from a reset to the first boot version, which is the device's choice."""
    match device:
        case plans.Independent():
            return device.chosen().restart
        case plans.Mock():
            return device.chosen().reset_delay_s
    return 0.0


def _listens_s(device: plans.Device) -> float:
    """Time in which a device listens after its last boot version, its choice."""
    if isinstance(device, plans.Independent):
        chosen = device.chosen()
        return chosen.window if chosen.listens == "after_burst" else inf
    return inf


def _judge_failure(facts: Facts, reported: Reported) -> Iterator[Violation]:
    """Check that a run without success had a reason, and enough time."""
    plan, job = facts.plan, facts.plan.job
    if reported.is_ok or job.timeout:
        return
    packets_s = job.packets * TIMES.ack_timeout_s
    least_s = (job.attempts or _ATTEMPTS) * (_BEGIN_S + packets_s) + _COMPLETE_S
    if facts.limit_s <= facts.took_s < least_s:
        text = f"given up after {facts.took_s:.0f} s, and its attempts may take {least_s:.0f} s"
        yield Violation("FAILED", text)
    (device, *twins) = plan.devices
    is_ready = device.begins == "application" and device.application == "old"
    is_ready &= not any(each in device.choices for each in _CANNOT_SUCCEED)
    is_ready &= _restart_s(device) < TIMES.boot_version_timeout_s - _BOOT_VERSION_S
    # An update command has two frames, with a gap before each.
    is_ready &= _listens_s(device) > TIMES.update_spacing_s + 2 * job.gap
    if is_ready and not twins and not [*plan.events]:
        yield Violation("FAILED", "no success, and nothing was disturbed")


def _judge_contents(facts: Facts, reported: Reported) -> Iterator[Violation]:
    contents = [each.now for each in facts.units]
    if any(each.runs_nothing for each in facts.units):
        yield Violation("CORRUPT", "the device runs an application that it does not have")
    if _has(facts.plan, (plans.Tool,)):
        # What another tool did after the end is not the host's.
        contents = ["new" if each.at_end == "new" else each.now for each in facts.units]
    present = [each for each in facts.units if each.was_at_update]
    # Of two devices, one that sends nothing of its own in the transfer cannot be seen.
    # A changed answer is not its own.
    shows = all(each.was_heard for each in present) and not _has(facts.plan, (plans.Answer,))
    is_unseen = len(present) > 1 and not shows
    may_be_unseen = len(present) > 1 or _has(facts.plan, (plans.Tool,))
    is_unseen |= reported.unobserved_s > 0 and may_be_unseen
    false = "UNSEEN" if is_unseen else "FALSE"
    content, *twins = contents
    if reported.is_ok and content != "new":
        yield Violation(false, f"success, and the device has {content}")
    for twin, unit in zip(twins, facts.units[1:], strict=True):
        if reported.is_ok and twin != "new" and unit.took_part:
            yield Violation(false, f"success, and its twin has {twin}")
    if (
        "other" in (content, *facts.started)
        and len(contents) == 1
        and not _has(facts.plan, (plans.Tool,))
    ):
        yield Violation("CORRUPT", "the device would start what is neither old nor new")
    if not facts.may_have_erased:
        return  # whoever erased it, it was not the host
    is_refused = reported.left is DeviceLeft.NO_APPLICATION and content == "new"
    if is_refused and len(contents) == 1 and not _has(facts.plan, _LIES_AT_THE_END):
        yield Violation("DISHONEST", "no application is reported, and the device has the new one")
    has_lost = content == "none" != facts.before
    if not (reported.needs_rescue or reported.is_ok) and has_lost:
        yield Violation("DISHONEST", "no need of rescue, and the device has no application")
    is_claimed = reported.left is DeviceLeft.NEW and not (reported.is_ok or is_unseen)
    if is_claimed and content != "new":
        yield Violation("DISHONEST", f"the new image is reported, and the device has {content}")
    if reported.left is DeviceLeft.UNTOUCHED and content != facts.before:
        yield Violation("DISHONEST", f"untouched, and the device has {content}")


def _has(plan: plans.Plan, kinds: tuple[type[plans.Clause], ...]) -> bool:
    return any(isinstance(each, kinds) for each in plan.clauses)
