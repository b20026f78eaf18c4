"""A whole session: the upgrade, then the wait for the new application and the verification.

Composed from machines and itself one, so that the simulator, the command line and whoever else
runs the very same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flasher import events
from flasher.errors import FlasherError
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft, Outcome
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
from flasher.protocol.frame import Frame


@dataclass(frozen=True)
class Result:
    """What a session came to: the upgrade's outcome, and what the verification found."""

    outcome: Outcome
    verification: Verification = NOT_ASKED

    @property
    def ok(self) -> bool:
        """True when the upgrade is good and nothing speaks against the new image."""
        return self.outcome.ok and self.verification.ok

    @property
    def running_version(self) -> str | None:
        """What the application answered, wherever it was asked; escaped."""
        return self.verification.running_version or self.outcome.running_version

    def error(self) -> FlasherError | None:
        """The error that stands for it; None when it is good."""
        return self.outcome.error() or self.verification.error(self.outcome.target)


class Session:
    """One session; an engine. Begins with the first `tick`."""

    def __init__(
        self, plan: Plan, options: UpgradeOptions | None = None, level: Level = Level.NONE
    ) -> None:
        self._plan = plan
        self._options = options or UpgradeOptions()
        self._level = level
        self._upgrade = Upgrade(plan, self._options)
        self._stage: Upgrade | Check = self._upgrade
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
    def standing(self) -> str:
        """How far it has come, in words."""
        if isinstance(self._stage, Upgrade):
            return self._stage.standing
        return f"verifying by {self._stage.level.value}"

    @property
    def device_left(self) -> DeviceLeft:
        """The state that the device would be left in if nothing more were sent."""
        return DeviceLeft.NEW if self._stage is not self._upgrade else self._upgrade.device_left

    # -- the engine interface: that of the stage -------------------------------------------------

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        self._stage.receive(frame, now)
        self._go_on(now)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        self._stage.tick(now)
        self._go_on(now)

    def deadline(self) -> float | None:
        """When it next wants `tick`."""
        return None if self.done else self._stage.deadline()

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send."""
        return self._stage.next_frame(now)

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted it."""
        self._stage.frame_sent(now)
        self._go_on(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        self._stage.cancel(now)
        self._go_on(now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        self._events += self._stage.take_events()
        taken, self._events = self._events, []
        return taken

    # -- from stage to stage ---------------------------------------------------------------------

    def _go_on(self, now: float) -> None:
        if not self._stage.done or self.done:
            return
        self._events += self._stage.take_events()
        if isinstance(self._stage, Upgrade):
            self._after_upgrade(self._stage.outcome, now)
        else:
            self._after_check(self._stage, now)

    def _after_upgrade(self, outcome: Outcome, now: float) -> None:
        if not outcome.ok or self._level is Level.NONE:
            self._result = Result(outcome)
        elif outcome.ending is Ending.CONFIRMED_BY_VERSION:
            verified = Verification(Level.VERSION, Verdict.VERSION_RIGHT, outcome.running_version)
            self._after_version(verified, now)
        else:
            self._begin(VersionCheck(self._plan, self._options), now)

    def _after_check(self, check: Check, now: float) -> None:
        if check.verification is None:
            raise RuntimeError("a check without a verdict")
        if check.level is Level.VERSION:
            self._after_version(check.verification, now)
        else:
            self._result = Result(self._upgrade.outcome, check.verification)

    def _after_version(self, verification: Verification, now: float) -> None:
        if self._level is Level.MEMORY and verification.ok:
            version = verification.running_version
            self._begin(MemoryCheck(self._plan, self._options, version), now)
        else:
            self._result = Result(self._upgrade.outcome, verification)

    def _begin(self, check: Check, now: float) -> None:
        self._stage = check
        self._events.append(events.VerificationStarted(check.level.value))
        check.tick(now)
