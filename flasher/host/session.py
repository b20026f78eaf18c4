"""A whole session: who is there, does the image belong there, the upgrade, the verification.

Composed from machines and itself one, so that the simulator, the command line and whoever else
runs the very same code. Beside the stages a guard watches the bus all the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from flasher import events
from flasher.events import Phase
from flasher.host.guard import Foreign, Guard
from flasher.host.identify import Identify
from flasher.host.identity import Finding, Identity, Seen, judge_device, judge_image
from flasher.host.options import UpgradeOptions, firmware_version, overall_timeout_s
from flasher.host.outcome import DeviceLeft, Outcome, before_the_start
from flasher.host.result import Result
from flasher.host.table import Ending
from flasher.host.upgrade import Upgrade
from flasher.host.verify import (
    NOT_ASKED,
    Check,
    Level,
    MemoryCheck,
    Verdict,
    Verification,
    VersionCheck,
)
from flasher.image.plan import Plan
from flasher.prose import prose
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.frame import Frame

__all__ = ["Result", "Session"]

_Stage = Identify | Upgrade | Check


class Session:
    """One session; an engine. Begins with the first `tick`.

    It listens for a second tool before it sends anything. With `identity` the device is then asked
    who it is, and the image is held against the answer, before anything is written; a device that
    is waited for at power-up cannot be asked.
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
        self._guard = Guard(plan.target, self._options.timings)
        self._foreign_queries: set[int] = set()
        """The commands of those that were reported."""
        self._began_at: float | None = None
        self._deadline_at: float | None = None
        self._losses = 0
        self._previous_version: str | None = None
        self._handed: Frame | None = None
        self._upgrade = Upgrade(plan, self._options)
        # At power-up no application runs, and nothing is sent before the device's announcement.
        self._stage: _Stage = self._upgrade if self._options.at_power_up else self._identify()
        self._events: list[object] = []
        self._result: Result | None = None

    @property
    def done(self) -> bool:
        """True when the result is known."""
        return self._result is not None

    @property
    def result(self) -> Result:
        """What it came to. Raises RuntimeError while it goes on."""
        if self._result is None:
            raise RuntimeError("the session has not ended yet")
        return self._result

    @property
    def deadline_at(self) -> float | None:
        """The overall deadline; None before the beginning."""
        return self._deadline_at

    @property
    def standing(self) -> str:
        """How far it has come, in words."""
        match self._stage:
            case Upgrade() as upgrade:
                return upgrade.standing
            case Identify() as asked:
                return prose(asked.phase)
            case Check() as check:
                return f"verifying by {check.level.value}"

    @property
    def device_left(self) -> DeviceLeft:
        """The state that the device would be left in if nothing more were sent."""
        return DeviceLeft.NEW if isinstance(self._stage, Check) else self._upgrade.device_left

    @property
    def has_begun_to_erase(self) -> bool:
        """True once an update command is sent, or being sent: to end then leaves the device
        without an application.
        """
        return self._upgrade.has_begun_to_erase

    @property
    def may_begin_again(self) -> bool:
        """True when a lost adapter may be opened again: an attempt is left for it."""
        has_left = not isinstance(self._stage, Upgrade) or self._stage.may_begin_again
        return has_left and self._losses + 1 < self._options.attempts and not self.done

    # -- the engine interface: that of the stage -------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        foreign = self._guard.see(frame, now)
        if foreign is not None:
            self._second_tool(foreign, now)
        elif not self.done:
            self._stage.receive(frame, now)
            self._go_on(now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if self._began_at is None:
            self._begin(now)
        if self.done:
            return
        if self._is_late(now):
            self._stage.cancel(now)
        else:
            self._stage.tick(now)
        self._go_on(now)

    def deadline(self) -> float | None:
        """When it next wants `tick`; at once before the beginning."""
        if self.done:
            return None
        if self._began_at is None:
            return 0.0
        wanted, limit = self._stage.deadline(), self._deadline_at
        if limit is None or isinstance(self._stage, Upgrade):
            return wanted
        return limit if wanted is None else min(wanted, limit)

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        if self.done:
            return None
        self._handed = self._stage.next_frame(now)
        return self._handed

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted it."""
        if self._handed is not None:
            self._guard.sent(self._handed, now)
        self._stage.frame_sent(now)
        self._go_on(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        if not self.done:
            self._stage.cancel(now)
            self._go_on(now)

    def link_back(self, now: float) -> None:
        """The adapter was lost and works again."""
        self._losses += 1
        self._guard.link_back(now)
        if isinstance(self._stage, Identify):
            # Queries are short and harmless: they are begun anew.
            self._stage = self._identify()
        elif isinstance(self._stage, Upgrade):
            self._stage.link_back(now)
        self._go_on(now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        self._events += self._guard.take_events()
        self._events += self._stage.take_events()
        taken, self._events = self._events, []
        return taken

    # -- from stage to stage ---------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        self._began_at = now
        self._deadline_at = now + overall_timeout_s(self._plan, self._options)
        self._upgrade.deadline_at = self._deadline_at
        if self._identity is not None:
            self._judge(judge_image(self._plan.image, self._plan.target, self._identity), now)
        if self._identity is not None and self._options.at_power_up and not self.done:
            self._judge_seen(self._identity, Seen(), now)

    def _identify(self) -> Identify:
        """What listens and, to hold the answers against the image, asks."""
        return Identify(self._plan, self._options, asks=self._identity is not None)

    def _is_late(self, now: float) -> bool:
        """The deadline passed in a stage that does not know it; the upgrade does."""
        limit = self._deadline_at
        return limit is not None and now >= limit and not isinstance(self._stage, Upgrade)

    def _go_on(self, now: float) -> None:
        stage = self._stage
        if not stage.done or self.done:
            return
        self._events += stage.take_events()
        match stage:
            case Identify():
                self._after_identify(stage, now)
            case Upgrade():
                self._after_upgrade(stage.outcome, now)
            case Check():
                self._after_check(stage, now)

    def _after_identify(self, asked: Identify, now: float) -> None:
        if asked.cancelled:
            ending = Ending.OUT_OF_TIME if self._is_late(now) else Ending.CANCELLED
            self._end_early(ending, "", now)
            return
        if len(asked.answers) > 1:
            versions = " and ".join(firmware_version(each) for each in asked.answers)
            self._end_early(Ending.TWO_DEVICES, f"they answer {versions}", now)
            return
        self._previous_version = asked.seen.firmware_version
        if self._identity is not None:
            self._judge_seen(self._identity, asked.seen, now)
        if not self.done:
            self._upgrade.heard = asked.heard
            self._stage = self._upgrade
            self._upgrade.tick(now)
            self._go_on(now)

    def _judge_seen(self, identity: Identity, seen: Seen, now: float) -> None:
        self._judge(judge_device(self._plan.image, self._plan.target, identity, seen), now)

    def _judge(self, findings: Iterable[Finding], now: float) -> None:
        """Report what was found; what is refused ends the session."""
        for finding in findings:
            self._events.append(finding.event)
            if finding.ending is not None and not self.done:
                self._end_early(finding.ending, finding.detail, now)

    def _after_upgrade(self, outcome: Outcome, now: float) -> None:
        if not outcome.ok or self._level is Level.NONE:
            self._end(outcome)
        elif outcome.ending is Ending.CONFIRMED_BY_VERSION:
            verified = Verification(Level.VERSION, Verdict.VERSION_RIGHT, outcome.running_version)
            self._after_version(verified, now)
        else:
            self._begin_check(VersionCheck(self._plan, self._options), now)

    def _after_check(self, check: Check, now: float) -> None:
        if check.verification is None:
            raise RuntimeError("a check without a verdict")
        verification = check.verification
        if verification.verdict is Verdict.INTERRUPTED and self._is_late(now):
            detail = "the overall deadline passed"
            verification = Verification(check.level, Verdict.NO_ANSWER, None, detail)
        if check.level is Level.VERSION:
            self._after_version(verification, now)
        else:
            self._end(self._upgrade.outcome, verification)

    def _after_version(self, verification: Verification, now: float) -> None:
        if self._level is Level.MEMORY and verification.ok:
            version = verification.running_version
            self._begin_check(MemoryCheck(self._plan, self._options, version), now)
        else:
            self._end(self._upgrade.outcome, verification)

    def _begin_check(self, check: Check, now: float) -> None:
        self._stage = check
        self._events.append(events.VerificationStarted(check.level.value))
        check.tick(now)

    # -- the end ---------------------------------------------------------------------------------

    def _second_tool(self, foreign: Foreign, now: float) -> None:
        seen = foreign.seen
        match self._stage:
            case _ if self.done:
                return
            case Upgrade(has_begun_to_erase=True) | Check() if foreign.is_harmless:
                # It writes nothing, CRC and repetition protect the data: to end here would leave a
                # device without an application.
                if foreign.query is not None:
                    self._report_query(foreign.query)
            case Upgrade() as upgrade:
                upgrade.second_tool(seen, now)
                self._go_on(now)
            case Identify():
                self._end_early(Ending.SECOND_TOOL, seen, now)
            case Check():
                # The device has the image; what it answers may be meant for the other tool.
                verification = Verification(self._stage.level, Verdict.SECOND_TOOL, None, seen)
                self._end(self._upgrade.outcome, verification)

    def _report_query(self, command: int) -> None:
        if command in self._foreign_queries:
            return
        self._foreign_queries.add(command)
        item = BY_KEY.get((self._plan.target.request_id, command))
        title = f"query {command:04X}" if item is None else item.title
        self._events.append(events.ForeignQuery(title))

    def _end_early(self, ending: Ending, detail: str, now: float) -> None:
        duration_s = now - (now if self._began_at is None else self._began_at)
        phase = self._stage.phase if isinstance(self._stage, Identify) else Phase.IDENTIFY
        self._end(before_the_start(self._plan, ending, detail, phase, duration_s=duration_s))

    def _end(self, outcome: Outcome, verification: Verification = NOT_ASKED) -> None:
        heard = self._guard.shutdown_heard
        self._result = Result(outcome, verification, heard, self._previous_version)
