"""Upgrade session: identification, identity checks, upgrade and verification of one device.

The stages run one after the other under one runner, so that simulator, command line and station run
the same code. A guard watches the bus during all stages.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf
from typing import Final

from flasher import events
from flasher.errors import (
    ExitCode,
    FlasherError,
    NoAnswerError,
    TransferError,
    UnconfirmedError,
    VerificationError,
)
from flasher.events import Phase
from flasher.host.guard import Guard
from flasher.host.identify import IdentifyStage
from flasher.host.identity import (
    CheckResult,
    CheckVerdict,
    DeviceAnswers,
    Identity,
    judge_device,
    judge_image,
)
from flasher.host.options import UpgradeOptions, overall_timeout_s, serial_number
from flasher.host.outcome import DeviceLeft, Outcome, ended_before_start
from flasher.host.runner import Runner, Stage
from flasher.host.table import Ending
from flasher.host.upgrade import LinkRestored, SecondToolSeen, UpgradeStage
from flasher.host.verify import (
    NOT_ASKED,
    Level,
    Verdict,
    Verification,
    check_memory,
    check_version,
)
from flasher.i18n import text
from flasher.image.plan import Plan
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Node, can_id
from flasher.wording import wording

_NO_CONTACT: Final = (NoAnswerError, TransferError, UnconfirmedError, VerificationError)
"""Errors that may be caused by a switched-off battery or a pause of this computer."""


@dataclass(frozen=True)
class Result:
    """Result of a session: outcome of the upgrade, and verification."""

    outcome: Outcome
    verification: Verification = NOT_ASKED
    shutdown_heard: bool = False
    """The battery sent SHUTDOWN during the session."""
    previous_version: str | None = None
    """Firmware version before the upgrade, escaped; None if not answered."""
    stalled_s: float = 0.0
    """Seconds for which this computer paused during the session (`events.HostStalled`)."""

    @property
    def ok(self) -> bool:
        """True if the upgrade succeeded and the verification found no problem."""
        return self.outcome.ok and self.verification.ok

    @property
    def exit_code(self) -> ExitCode:
        if self.outcome.nothing_to_do:
            return ExitCode.NOTHING_TO_DO
        error = self.error()
        return ExitCode.OK if error is None else error.exit_code

    @property
    def running_version(self) -> str | None:
        """Firmware version that the application reported, escaped; None if not answered."""
        return self.verification.running_version or self.outcome.running_version

    def error(self) -> FlasherError | None:
        """Create the error for this result; None for a success, and if there was nothing to do."""
        error = self.outcome.error() or self.verification.error(self.outcome.target)
        if isinstance(error, _NO_CONTACT):
            if self.stalled_s:
                paused = f"this computer paused for {self.stalled_s:.1f} s meanwhile"
                error.cause = f"{paused}; else {error.cause}"
            if self.shutdown_heard:
                error.cause = f"the battery sent SHUTDOWN and switched off; else {error.cause}"
        return error


class UpgradeSession(Runner[Result]):
    """Engine of an upgrade session; begins with the first `tick`.

    It listens for a second tool before it sends anything. With `identity` it then identifies the
    device, and checks the image against the answers before anything is written. A device awaited at
    power-up is not queried, unless an earlier upgrade may have left it in its transfer.
    """

    def __init__(
        self,
        plan: Plan,
        options: UpgradeOptions | None = None,
        level: Level = Level.NONE,
        identity: Identity | None = None,
    ) -> None:
        self._plan = plan
        self._options = options or UpgradeOptions()
        self._level = level
        self._identity = identity
        super().__init__(
            lambda _run: self._stages(),
            bitrate_bps=plan.bitrate_bps,
            timings=self._options.timings,
            frame_gap_s=self._options.frame_gap_s,
        )
        self.deadline_at: float | None = None
        """Overall deadline; None before the first tick."""
        self._guard = Guard(plan.target, self._options.timings)
        self.watch = self._watch_frame
        self._foreign_queries: set[int] = set()
        """Commands of another tool's queries that were reported."""
        self._losses = 0
        self._unobserved_s = 0.0
        """Time since `complete` in which the adapter was away."""
        self._began_at = 0.0
        # At power-up no application runs, and nothing is sent before the device announces itself. A
        # device that may be in an open session is asked first: a running application would answer.
        waits = self._options.at_power_up and not self._options.in_session
        self._identify = None if waits else self._new_identify()
        receivers = (each for each in (*Node, None) if each not in (plan.target.node, Node.CDL))
        self._application_ids = frozenset(can_id(plan.target.node, each) for each in receivers)
        self._upgrade = UpgradeStage(self, plan, self._options)
        self._checking: Level | None = None
        """Current level of verification; None during the upgrade."""

    @property
    def progress(self) -> str:
        """Phase, packet and attempt, as text."""
        if self._checking is Level.NONE:
            return "listening for a second device"
        if self._checking is not None:
            return f"verifying by {self._checking.value}"
        if self._identify is not None:
            return wording(self._identify.phase)
        return self._upgrade.progress

    @property
    def device_left(self) -> DeviceLeft:
        """State of the device if the session ended now."""
        return self._upgrade.device_left if self._checking is None else DeviceLeft.NEW

    @property
    def has_begun_to_erase(self) -> bool:
        """True once an update command is being sent or was sent, so that the device may erase."""
        return self._upgrade.has_begun_to_erase

    @property
    def goes_on(self) -> bool:
        """True while only the overall deadline limits the number of attempts."""
        return self._is_upgrading and self._upgrade.goes_on

    @property
    def may_begin_again(self) -> bool:
        """True if the session can continue after a lost adapter is opened again."""
        is_last = self._losses + 1 >= self._options.planned_attempts
        if self.done or (is_last and not self.goes_on):
            return False
        return self._upgrade.may_begin_again

    @property
    def _is_upgrading(self) -> bool:
        return self._identify is None and self._checking is None

    def link_back(self, now: float) -> None:
        """Continue after the lost adapter was opened again."""
        away_s, self.now = now - self.now, now
        self._losses += 1
        if self._checking is None:
            self.interrupt(LinkRestored(away_s))
        else:
            self._unobserved_s += away_s

    # -- from stage to stage ---------------------------------------------------------------------

    def _stages(self) -> Stage[Result]:
        self._began_at = self.now
        self.deadline_at = self.now + overall_timeout_s(self._plan, self._options)
        identity = self._identity
        if identity is not None:
            refused = self._judge(judge_image(self._plan.image, self._plan.target, identity))
            if refused is None and self._identify is None:
                refused = self._judge_device(identity, DeviceAnswers())
            if refused is not None:
                return refused
        previous = None
        if self._identify is not None:
            self.limit_at = self.deadline_at
            try:
                asked = yield from self._identified(self._identify)
            except SecondToolSeen as tool:
                return self._end_early(Ending.SECOND_TOOL, tool.description)
            refused = self._refused(asked)
            if refused is not None:
                return refused
            previous = asked.answers.firmware_version
            self._upgrade.serial_before = serial_number(asked.answers.version)
            self._upgrade.announcement = asked.announcement
            self._identify = None
        self.limit_at = inf  # the upgrade observes its deadline itself
        outcome = yield from self._upgrade.stage(self.deadline_at)
        verification = NOT_ASKED
        if outcome.ok:
            self.limit_at = self.deadline_at
            verification = yield from self._verified()
            outcome = replace(
                outcome,
                device_left=verification.device_left,
                unobserved_s=outcome.unobserved_s + self._unobserved_s,
            )
        return Result(outcome, verification, self._guard.shutdown_heard, previous)

    def _new_identify(self) -> IdentifyStage:
        return IdentifyStage(self._plan, self._options, asks=self._identity is not None)

    def _identified(self, identify: IdentifyStage) -> Stage[IdentifyStage]:
        while True:
            try:
                return (yield from identify.stage(self))
            except LinkRestored:
                # Queries are short and harmless: repeat them.
                self.tx.abandon(self.now)
                self._identify = identify = self._new_identify()

    def _refused(self, asked: IdentifyStage) -> Result | None:
        """End the session if it was cancelled, or a second device or check forbids it."""
        if asked.cancelled:
            is_late = self.deadline_at is not None and self.now >= self.deadline_at
            return self._end_early(Ending.OUT_OF_TIME if is_late else Ending.CANCELLED, "")
        if asked.two_devices:
            return self._end_early(Ending.TWO_DEVICES, asked.two_devices)
        if asked.answers != DeviceAnswers():
            self._upgrade.in_session = False
        if self._identity is None:
            return None
        return self._judge_device(
            self._identity, asked.answers, is_silent=asked.announcement is None
        )

    def _judge_device(
        self, identity: Identity, answers: DeviceAnswers, *, is_silent: bool = False
    ) -> Result | None:
        findings = judge_device(self._plan.image, self._plan.target, identity, answers)
        if is_silent and self._upgrade.in_session:
            return self._judge(map(self._postponed, findings))
        return self._judge(findings)

    def _postponed(self, finding: CheckResult) -> CheckResult:
        """Postpone a rule that a silent device cannot answer, until its application runs."""
        if finding.ending is None or not finding.is_unchecked:
            return finding
        self._upgrade.unchecked = finding
        sentence = text("{text}: only a device in an open session is upgraded", text=finding.text)
        return finding._replace(verdict=CheckVerdict.WARNED, text=sentence)

    def _judge(self, findings: Iterable[CheckResult]) -> Result | None:
        """Report all check results; the first refusal ends the session."""
        refused = None
        for finding in findings:
            self.emit(finding.event)
            if finding.ending is not None and refused is None:
                refused = self._end_early(finding.ending, finding.detail, finding.waiver)
        return refused

    def _end_early(self, ending: Ending, detail: str, waiver: str = "") -> Result:
        phase = Phase.IDENTIFY if self._identify is None else self._identify.phase
        duration_s = self.now - self._began_at
        outcome = ended_before_start(
            self._plan, ending, detail, phase, duration_s=duration_s, waiver=waiver
        )
        return Result(outcome, shutdown_heard=self._guard.shutdown_heard)

    # -- verification ----------------------------------------------------------------------------

    def _verified(self) -> Stage[Verification]:
        level, self._checking = self._level, Level.NONE
        self.listen_always(self._plan.target.answer_id)
        try:
            was_cancelled = yield from self.await_second_device()
        except SecondToolSeen as tool:
            return Verification(level, Verdict.SECOND_TOOL, None, tool.description)
        if self.duplicates.evidence:
            return Verification(level, Verdict.TWO_DEVICES, None, self.duplicates.evidence)
        found = NOT_ASKED
        if was_cancelled and level is not Level.NONE:
            found = self._interrupted(Verification(level, Verdict.INTERRUPTED))
        elif level is not Level.NONE:
            found = yield from self._checked(Level.VERSION)
        if level is Level.MEMORY and found.ok:
            found = yield from self._checked(Level.MEMORY, found.running_version)
        return found

    def _checked(self, level: Level, running_version: str | None = None) -> Stage[Verification]:
        self._checking = level
        self.emit(events.VerificationStarted(level.value))
        try:
            if level is Level.VERSION:
                found = yield from check_version(
                    self, self._plan, self._options, self._upgrade.serial_before
                )
            else:
                found = yield from check_memory(self, self._plan, running_version)
        except SecondToolSeen as tool:
            # The device has the image; its answers may be for the other tool.
            return Verification(level, Verdict.SECOND_TOOL, None, tool.description)
        return self._interrupted(found)

    def _interrupted(self, found: Verification) -> Verification:
        """Return a verification that the user, or the overall deadline, has ended."""
        if found.verdict is Verdict.INTERRUPTED and self.now >= (self.deadline_at or inf):
            return Verification(found.level, Verdict.NO_ANSWER, None, "the overall deadline passed")
        return found

    # -- beside the stages -----------------------------------------------------------------------

    def _watch_frame(self, frame: Frame) -> bool:
        """Detect a second tool and the battery's SHUTDOWN; True hides a frame from the stage."""
        if frame[0] == self._plan.target.answer_id:
            return False
        if frame[0] in self._application_ids and frame.is_payload:
            self._upgrade.note_application()
        foreign = self._guard.see(frame, self.now)
        for event in self._guard.take_events():
            self.emit(event)
        if foreign is None:
            return frame.is_echo
        has_its_program = self._is_upgrading and not self._upgrade.has_begun_to_erase
        ends = self._identify is not None or has_its_program or not foreign.is_harmless
        if ends or self._upgrade.is_yielding:
            self.interrupt(SecondToolSeen(foreign.description))
        elif foreign.query is not None and foreign.query not in self._foreign_queries:
            # It writes nothing, and CRC and repetition protect the data: ending here would leave a
            # device without an application.
            self._foreign_queries.add(foreign.query)
            item = BY_KEY.get((self._plan.target.request_id, foreign.query))
            title = f"query {foreign.query:04X}" if item is None else item.title
            self.emit(events.ForeignQuery(title))
        return True
