"""Engine of one upgrade alone, as its tests and benchmarks drive it."""

from __future__ import annotations

from flasher.host.options import UpgradeOptions, overall_timeout_s
from flasher.host.outcome import Outcome
from flasher.host.runner import Runner
from flasher.host.table import UpgradeState
from flasher.host.upgrade import LinkRestored, SecondToolSeen, UpgradeStage
from flasher.image.plan import Plan


class Upgrade(Runner[Outcome]):
    """Engine of one upgrade, without identification and verification."""

    def __init__(self, plan: Plan, options: UpgradeOptions | None = None) -> None:
        chosen = options or UpgradeOptions()
        super().__init__(
            lambda run: self._upgrade.stage(run.now + overall_timeout_s(plan, chosen)),
            bitrate_bps=plan.bitrate_bps,
            timings=chosen.timings,
            frame_gap_s=chosen.frame_gap_s,
        )
        self._upgrade = UpgradeStage(self, plan, chosen)

    @property
    def outcome(self) -> Outcome:
        """Outcome of the upgrade. Raises RuntimeError before its end."""
        return self.result

    @property
    def state(self) -> UpgradeState:
        """Current state in the table."""
        return self._upgrade.state

    def link_back(self, now: float) -> None:
        """Continue after the lost adapter was opened again."""
        away_s, self.now = now - self.now, now
        self.interrupt(LinkRestored(away_s))

    def second_tool(self, description: str, now: float) -> None:
        """Handle a frame of a second tool, described by `description`."""
        self.now = now
        self.interrupt(SecondToolSeen(description))
