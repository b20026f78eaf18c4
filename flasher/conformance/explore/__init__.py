"""Random walks on a device until one finds a violation, which is shrunk to the fewest steps."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.explore.steps import WalkStep, next_step, parse_step, reachable_pairs
from flasher.conformance.explore.walk import DevicePhase, Violation, Walk
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.restore import BY_POWER, may_need_power, restore
from flasher.conformance.results import (
    CaseLimitReached,
    DeviceCrashed,
    ExploreResult,
    RunStopped,
    StepCoverage,
    TraceEntry,
    Unsupported,
    WalkFinding,
)
from flasher.conformance.shrink import shrink
from flasher.conformance.subject import Subject
from flasher.conformance.waits import Waits
from flasher.errors import BusError

WALK_STEPS: Final = 24
"""Steps of the longest walk."""
SHRINK_TRIES: Final = 60
_LARGE_BYTES: Final = 70_000
"""About as many bytes as the largest image of a walk has."""
_NO_CHANCE: Final = random.Random(0)  # noqa: S311  all steps are given


class Explorer:
    """Runs walks on one device; calls `progress` with the number of steps after each walk."""

    def __init__(
        self,
        subject: Subject,
        profile: ConformanceProfile,
        *,
        seed: str = "1",
        stopped: Callable[[], bool] = lambda: False,
        progress: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._subject = subject
        self._profile = profile
        self._seed = seed
        self._stopped = stopped
        self._progress = progress
        self._met: Counter[tuple[DevicePhase, str]] = Counter()
        self._steps = 0
        self._walks = 0
        self.trace: tuple[TraceEntry, ...] = ()
        """Frames of the last walk."""

    def explore(
        self, steps: float, *, is_over: Callable[[], bool] = lambda: False, shrinks: bool = True
    ) -> ExploreResult:
        """Walk for `steps` steps, until `is_over` after a walk, or until a violation is found,
        which is shrunk unless not `shrinks`. Raises BusError.
        """
        try:
            trouble = self._restore()
            if trouble:
                return self._result(_bring_up_finding(trouble))
            while self._steps < steps and not self._stopped():
                chance = random.Random(f"{self._seed}/{self._walks}")  # noqa: S311  by the seed
                length = int(min(chance.randint(3, WALK_STEPS), steps - self._steps))
                taken: list[WalkStep] = []
                found = self._walk([None] * length, taken, chance)
                self._progress(self._steps)
                if found is not None:
                    if not shrinks:
                        return self._result(self._finding(found, taken, taken))
                    finding = self._shrink(found, taken)
                    return self._result(finding, self._stop_reason() if self._stopped() else "")
                if is_over():
                    break
        except RunStopped:
            return self._result(stopped=self._stop_reason())
        return self._result(stopped="it was stopped" if self._stopped() else "")

    def replay(self, texts: Sequence[str], *, shrinks: bool = False) -> ExploreResult:
        """Take the steps of a finding, and shrink it if `shrinks`. Raises UsageError and
        BusError.
        """
        steps = [parse_step(text) for text in texts]
        taken: list[WalkStep] = []
        try:
            trouble = self._restore()
            if trouble:
                return self._result(_bring_up_finding(trouble))
            found = self._walk(steps, taken)
        except RunStopped:
            return self._result(stopped=self._stop_reason())
        if found is None:
            return self._result()
        if shrinks:
            return self._result(self._shrink(found, taken))
        return self._result(self._finding(found, taken, taken), self._restore_at_end())

    # -- one walk ----------------------------------------------------------------------------------

    def _walk(
        self,
        steps: Sequence[WalkStep | None],
        taken: list[WalkStep],
        chance: random.Random = _NO_CHANCE,
    ) -> tuple[Violation, Bench] | None:
        """Take these steps, choosing those that are None by `chance`; then upgrade the device to
        the good image.
        """
        self._walks += 1
        waits = Waits(self._profile, self._subject.port.bitrate_bps)
        limit_s = WALK_STEPS * waits.upgrade_s(_LARGE_BYTES)
        bench = Bench(self._subject, self._profile, limit_s=limit_s, stopped=self._stopped)
        bench.tester.collects_feedback = True
        walk = Walk(bench)
        try:
            for given in steps:
                step = given or next_step(walk, chance)
                taken.append(step)
                self._steps += 1
                self._met[walk.phase, step.name] += 1
                walk.take(*step)
            if not walk.update_accepted:
                walk.check_application()
            trouble = self._restore()
            if trouble:
                raise Violation("upgrade", f"the upgrade afterwards failed: {trouble}")  # noqa: TRY301
            walk.check_stored(bench.good_image)
        except Unsupported:
            return None
        except Violation as found:
            return found, bench
        except DeviceCrashed as crashed:
            return Violation("crash", str(crashed)), bench
        except CaseLimitReached as reached:
            return Violation("time", str(reached)), bench
        finally:
            self.trace = bench.tester.trace
        return None

    def _restore(self) -> str:
        """Flash the good image by the protocol alone; returns what went wrong, or ""."""
        done = restore(self._subject, self._profile, flash=True, stopped=self._stopped)
        if not done.ok:
            return "; ".join((done.reason, *(() if self._walks else done.diagnosis)))
        if done.how == BY_POWER and self._walks and not may_need_power(self._profile):
            return "only a power cycle restored the device"
        return ""

    def _stop_reason(self) -> str:
        """Restore the device and return why the run ended early."""
        return "; ".join(filter(None, ("it was stopped", self._restore_at_end())))

    def _restore_at_end(self) -> str:
        """Restore the good image even after a stop request; returns what went wrong, or ""."""
        try:
            why = restore(self._subject, self._profile, flash=False).reason
        except BusError as error:
            why = error.what
        return why and f"the good image could not be flashed: {why}"

    # -- shrinking ---------------------------------------------------------------------------------

    def _shrink(self, found: tuple[Violation, Bench], taken: list[WalkStep]) -> WalkFinding:
        """Shrink the walk by leaving out steps while it still violates the same rule. Returns the
        best result so far when the run is stopped or the adapter fails.
        """
        best, rule, is_lost = list(taken), found[0].rule, False

        def attempt(shorter: list[WalkStep]) -> list[WalkStep] | None:
            nonlocal best, found, is_lost
            again_taken: list[WalkStep] = []
            again = self._walk(shorter, again_taken)
            if again is None:
                return None
            is_shown = again[0].rule == rule
            if is_shown:
                best, found = again_taken, again
            is_lost = self._cannot_restore()
            return again_taken if is_shown else None

        with suppress(RunStopped, BusError):
            if not self._cannot_restore():
                shrink(best, attempt, tries=SHRINK_TRIES, is_over=lambda: is_lost)
        return self._finding(found, best, taken)

    def _cannot_restore(self) -> bool:
        """Restore the device for the next walk; True when that is impossible."""
        try:
            return not restore(self._subject, self._profile, flash=True, stopped=self._stopped).ok
        except RunStopped:
            return True

    def _finding(
        self, found: tuple[Violation, Bench], steps: Sequence[WalkStep], first: Sequence[WalkStep]
    ) -> WalkFinding:
        violation, bench = found
        return WalkFinding(
            violation.rule,
            str(violation),
            tuple(map(str, steps)),
            tuple(map(str, first)),
            bench.tester.trace,
        )

    def _result(self, finding: WalkFinding | None = None, stopped: str = "") -> ExploreResult:
        coverage = tuple(
            StepCoverage(phase.value, name, self._met[phase, name])
            for phase, name in reachable_pairs()
        )
        return ExploreResult(
            self._subject.name, self._seed, self._walks, self._steps, coverage, finding, stopped
        )


def _bring_up_finding(trouble: str) -> WalkFinding:
    return WalkFinding("upgrade", f"the good image could not be flashed: {trouble}", (), ())
