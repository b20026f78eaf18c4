"""Judges a simulated upgrade: compares the claims of its result with the flash of every device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from flasher.errors import ExitCode
from flasher.host.outcome import DeviceLeft
from flasher.protocol.frame import Frame
from flasher.simulate import plan as plans

DOCUMENTED: Final = frozenset(
    {
        ExitCode.OK,
        ExitCode.IMAGE,
        ExitCode.BUS,
        ExitCode.NO_ANSWER,
        ExitCode.WRONG_DEVICE,
        ExitCode.TRANSFER,
        ExitCode.REFUSED,
        ExitCode.UNCONFIRMED,
        ExitCode.VERIFICATION,
        ExitCode.INTERRUPTED,
    }
)
"""Exit codes of `flasher flash --help` that a plan can cause."""
LATEST: Final = 1.001
"""Latest end as a share of the announced deadline: a message that has begun is finished."""
REPEAT_MARGIN_S: Final = 0.05
"""A repetition that was queued before the ACK came begins at most so much later."""
_CAUSES_REPETITION: Final = (
    plans.OnFrames, plans.Noise, plans.Unsolicited, plans.Answer, plans.Tool, plans.Load,
    plans.Stall, plans.Kill, plans.Restart, plans.Power, plans.Hang, plans.Unplug, plans.BusOff,
)  # fmt: skip


class Violation(NamedTuple):
    """Broken promise: FALSE (a success that is none), DISHONEST (a wrong statement about the
    device), OVERDUE (the run did not end), LATE (it ended after its deadline), UNDOCUMENTED (an
    exit code), FOREIGN (a frame to another device), REPEATED (a packet sent again after its ACK),
    LOST (a device that the tool cannot bring back), UNDETECTED (a damaged message was taken),
    CRASH; UNSEEN is none (`is_excused`).
    """

    kind: str
    text: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}"

    @property
    def is_excused(self) -> bool:
        """True for a success beside a device that sent nothing in the transfer: nothing on the bus
        shows that it is there (docs/explanation/safety.md, "What stays unseen").
        """
        return self.kind == "UNSEEN"


@dataclass
class Claim:
    """What a run reports of itself."""

    ending: str
    exit_code: int
    is_ok: bool
    left: DeviceLeft | None
    """None where only `needs_rescue` is reported."""
    needs_rescue: bool
    attempts: int = 0
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


@dataclass
class Facts:
    """What was observed of a run, from outside of the host."""

    plan: plans.Plan
    request_id: int
    host_ids: set[int] = field(default_factory=set)
    """CAN ids of the host's frames."""
    before: str = "old"
    """Content of the device when the run began."""
    may_have_erased: bool = False
    """The run sent an update command."""
    units: Sequence[UnitFacts] = ()
    took_s: float = 0.0
    limit_s: float = 1.0
    """Announced deadline."""
    repeated: int = 0
    """Packets that were sent again after their ACK."""
    _acknowledged: dict[int, float] = field(default_factory=dict)

    def begin_run(self, before: str) -> None:
        self.before, self.may_have_erased = before, False
        self._acknowledged.clear()

    def host_begins(self, what: str, number: int, now: float) -> None:
        """Record a message of the host; `number` is the low byte of its packet's."""
        if what == "update":
            self._acknowledged.clear()
        elif what == "packet":
            acknowledged_at = self._acknowledged.get(number)
            if acknowledged_at is not None and now - acknowledged_at > REPEAT_MARGIN_S:
                self.repeated += 1

    def device_sends(self, frame: Frame, now: float) -> None:
        if frame.data[:6] == b"\x55\xaa\x0c\x04\xc2\x02" and len(frame.data) == 8:
            number = frame.data[6]
            self._acknowledged.setdefault(number, now)
            self._acknowledged.pop((number + 1) % 256, None)  # numbers come round after 255


def judge(facts: Facts, claim: Claim) -> Iterator[Violation]:
    """Return what a run claims wrongly, or does against the protocol."""
    if claim.is_overdue:
        yield Violation("OVERDUE", f"not at an end {facts.limit_s:.0f} s after its deadline")
        return
    if claim.exit_code not in DOCUMENTED:
        yield Violation("UNDOCUMENTED", f"exit code {claim.exit_code}")
    if claim.is_ok != (claim.exit_code == ExitCode.OK):
        yield Violation("UNDOCUMENTED", "success and exit code differ")
    if facts.took_s > LATEST * facts.limit_s:
        share = facts.took_s / facts.limit_s
        yield Violation("LATE", f"ended at {share:.4f} of the announced deadline")
    if facts.host_ids - {facts.request_id}:
        ids = ", ".join(f"0x{each:03X}" for each in sorted(facts.host_ids - {facts.request_id}))
        yield Violation("FOREIGN", f"frames with the id {ids}")
    is_steady = len(facts.units) == 1 and not any(
        isinstance(each, _CAUSES_REPETITION) for each in facts.plan.clauses
    )
    if facts.repeated and is_steady:
        yield Violation("REPEATED", f"{facts.repeated} packets were sent again after their ACK")
    yield from _judge_contents(facts, claim)


def _judge_contents(facts: Facts, claim: Claim) -> Iterator[Violation]:
    contents = [each.now for each in facts.units]
    if any(isinstance(each, plans.Tool) for each in facts.plan.clauses):
        # What another tool did after the end is not the host's.
        contents = ["new" if each.at_end == "new" else each.now for each in facts.units]
    present = [each for each in facts.units if each.was_at_update]
    # Of two devices, one that sends nothing of its own in the transfer cannot be seen.
    is_unseen = len(present) > 1 and not all(each.was_heard for each in present)
    false = "UNSEEN" if is_unseen else "FALSE"
    content, *twins = contents
    if claim.is_ok and content != "new":
        yield Violation(false, f"success, and the device has {content}")
    for twin, unit in zip(twins, facts.units[1:], strict=True):
        if claim.is_ok and twin != "new" and unit.took_part:
            yield Violation(false, f"success, and its twin has {twin}")
    if not facts.may_have_erased:
        return  # whoever erased it, it was not the host
    # Another tool may erase a device that was complete, while its version is asked.
    is_others = claim.left is DeviceLeft.NEW and "second_tool" in claim.ending
    has_lost = content == "none" != facts.before
    if not (claim.needs_rescue or claim.is_ok or is_others) and has_lost:
        yield Violation("DISHONEST", "no need of rescue, and the device has no application")
    if claim.left is DeviceLeft.UNTOUCHED and content != facts.before:
        yield Violation("DISHONEST", f"untouched, and the device has {content}")
