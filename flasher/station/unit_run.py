"""Runs one unit in a socket: blocking, on an open connection.

It does not use the database: a `Journal` stores what must be on disk before the run continues, and
a write that cannot be recorded is not sent. `unit_steps` has the steps; this module starts,
repeats, times and records them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import Final

from flasher.api import Connection
from flasher.bus.link import suspended_s
from flasher.errors import (
    BusError,
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    VerificationError,
    WrongDeviceError,
)
from flasher.protocol.engine import Tap
from flasher.station.codes import OF_SILENCE, Code
from flasher.station.continuity import Continuity
from flasher.station.events import OperatorPrompted, Progressed, StepEnded, StepStarted
from flasher.station.messages import Journal, JournalError, RunEvent
from flasher.station.power import PowerControl
from flasher.station.presence import BLIND_S, PAUSE_S, TargetWatcher
from flasher.station.recipe import AfterRestart, StepRule
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import (
    Claim,
    Measurement,
    RunResult,
    RunState,
    StepName,
    StepState,
)
from flasher.station.unit_steps import Act, UnitSteps
from flasher.station.unit_target import StepFailedError, UnitTarget

_PROGRESS_S: Final = 0.25
"""Minimum interval between reports of progress, so that they never fill the pipe."""
_STATES: Final = {
    RunState.FAIL: StepState.FAIL,
    RunState.ERROR: StepState.ERROR,
    RunState.ABORTED: StepState.ERROR,
}
_BY_ERROR: Final = (
    (BusError, Code.BUS),
    (NoAnswerError, Code.NO_ANSWER),
    (WrongDeviceError, Code.NOT_FOR_DEVICE),
    (VerificationError, Code.WRITE_DIFFERS),
    (FlasherError, Code.RECIPE),
)


class _NotedPower:
    """Power of a socket. Notes each cycle, so that the restart is not taken for an exchange."""

    def __init__(self, power: PowerControl, units: Iterable[Continuity]) -> None:
        self._power = power
        self._units = units
        self.check = power.check

    def begin_cycle(self) -> None:
        for each in self._units:
            each.cycle_power()
        self._power.begin_cycle()


class UnitRun:
    """One run. `cancelled` is called repeatedly, and stays True once it was.

    `watchers`: the traffic of each target before the run. `was_exchanged`: another unit may have
    been put in since the label was assigned; `was_missed`: part of that time was unobserved;
    `was_silent`: no frame was received in it.
    """

    def __init__(  # noqa: PLR0913  all parts of a run
        self,
        claim: Claim,
        recipe: LoadedRecipe,
        connection: Connection,
        journal: Journal,
        *,
        taps: Sequence[Tap] = (),
        send_progress: Callable[[RunEvent], None] = lambda _event: None,
        cancelled: Callable[[], bool] = lambda: False,
        power: PowerControl | None = None,
        watchers: Sequence[TargetWatcher] | None = None,
        was_exchanged: bool = False,
        was_missed: bool = False,
        was_silent: bool = False,
    ) -> None:
        self._claim = claim
        self._recipe = recipe
        self._connection = connection
        self._clock = connection.clock
        self._journal = journal
        self._taps = taps
        self._send_progress = send_progress
        self._cancelled = cancelled
        may_restart = recipe.recipe.after_restart is AfterRestart.CONTINUE
        blind_s = BLIND_S * connection.clock.speed
        watchers = watchers or [TargetWatcher(each.profile) for each in recipe.targets]
        self._continuity = {
            each.name: Continuity(
                each,
                watcher,
                blind_s=blind_s,
                may_restart=may_restart,
                was_exchanged=was_exchanged,
                was_missed=was_missed,
                was_silent=was_silent,
            )
            for each, watcher in zip(recipe.targets, watchers, strict=True)
        }
        for each in self._continuity.values():
            each.listened(self._clock.now())
        self._suspended_s = suspended_s()
        self._may_restart = may_restart
        self._power = None if power is None else _NotedPower(power, self._continuity.values())
        self._step: tuple[StepName, str] = (StepName.CONNECT, "")
        self._step_began_at = 0.0
        self._step_ends_at: float | None = None
        self._progress_at = float("-inf")
        self._process_queued: Callable[[], None] = lambda: None

    def listen_meanwhile(self) -> None:
        """Read the bus while the station saves a record, so that the time counts as observed."""
        with suppress(BusError):  # the next use of the adapter raises it again
            self._process_queued()

    def run(self) -> RunResult:
        """Run all steps and return the result. Any exception is a bug."""
        began_at = self._clock.now()
        code, text, verified = Code.OK, "", {}
        try:
            steps = self._steps()
            for step, target, act in steps.acts():
                self._do(steps, step, target, act)
            verified = dict(steps.verified)
        except StepFailedError as failed:
            code, text = failed.code, failed.text
        except JournalError as error:
            code, text = Code.RECORD_NOT_SAVED, error.what
        duration_s = self._clock.now() - began_at
        return RunResult(code.outcome, code.name, text, duration_s, verified)

    def _steps(self) -> UnitSteps:
        def prompt(text: str, limit_s: float | None) -> None:
            self._send_progress(OperatorPrompted("", text, limit_s))

        try:
            taps = (*self._taps, *self._continuity.values())
            targets = [
                UnitTarget(
                    each,
                    self._connection,
                    self._continuity[each.name],
                    taps,
                    self._is_over,
                    self._is_lost,
                )
                for each in self._recipe.targets
            ]
            self._process_queued = targets[0].process_queued_frames
            return UnitSteps(
                self._claim,
                self._recipe,
                targets,
                self._journal,
                self._power,
                self._progress,
                prompt,
            )
        except FlasherError as error:
            raise StepFailedError(Code.RECIPE, error.what) from error

    # -- one step ---------------------------------------------------------------------------------

    def _do(self, steps: UnitSteps, step: StepName, target: str, act: Act | None) -> None:
        """Try a step as often as the recipe allows. Raises StepFailedError."""
        rule = self._recipe.recipe.rule(step)
        if act is None:
            serial = self._claim.serial
            self._journal.step(
                StepEnded("", serial, step, 1, StepState.SKIPPED, 0.0, target=target)
            )
            return
        self._step = step, target
        for try_number in range(1, rule.tries + 1):
            failed = self._try(steps, act, try_number, rule.time_limit_s)
            if failed is None:
                return
            is_final = not failed.code.may_retry or steps.has_lost_its_session
            if is_final or try_number == rule.tries:
                raise failed
            try:
                self._before_next_try(steps, failed, rule)
            except StepFailedError as changed:
                raise self._changed(steps) or changed from failed

    def _try(
        self, steps: UnitSteps, act: Act, try_number: int, limit_s: float | None
    ) -> StepFailedError | None:
        step, target = self._step
        began_at = self._step_began_at = self._clock.now()
        self._progress_at = float("-inf")
        self._step_ends_at = None if limit_s is None else began_at + limit_s
        self._send_progress(StepStarted("", self._claim.serial, step, try_number, target))
        measured: list[Measurement] = []
        failed, text = None, ""
        try:
            if step is not StepName.CONNECT:
                steps.targets[0].process_queued_frames()
            steps.targets[0].check_cancelled()
            text = act(measured)
        except StepFailedError as error:
            failed = error
        except InterruptedByUserError:
            code, text = Code.TOO_SLOW, "It was not done in time."
            if self._cancelled():
                code, text = Code.OPERATOR_ABORT, f"Stopped in {step.value}."
            failed = StepFailedError(code, f"{text} {steps.device_state}".strip())
        except JournalError:
            raise
        except FlasherError as error:
            code = next(code for kind, code in _BY_ERROR if isinstance(error, kind))
            words = f"{error.what} ({error.cause})" if error.cause else error.what
            failed = StepFailedError(code, words)
        finally:
            self._step_ends_at = None
        if failed is not None and failed.code in OF_SILENCE:
            failed = self._of_silence(steps, failed)
        failed = self._changed(steps) or failed
        duration_s = self._clock.now() - began_at
        if limit_s is not None:
            measured.append(Measurement("duration", duration_s, "s", high=limit_s))
            if failed is None and duration_s > limit_s:
                failed = StepFailedError(
                    Code.TOO_SLOW, f"{step.value}: {duration_s:.1f} s, {limit_s:g} s are allowed."
                )
        state, code_name = StepState.PASS, ""
        if failed is not None:
            state, code_name, text = _STATES[failed.code.outcome], failed.code.name, failed.text
        ended = StepEnded(
            "", self._claim.serial, step, try_number, state, duration_s, code_name, text, target
        )
        self._journal.step(ended, measured)
        return failed

    def _changed(self, steps: UnitSteps) -> StepFailedError | None:
        """The error for a unit that may have been exchanged; it precedes all others."""
        self._note_suspension()
        lost = next((each.lost for each in self._continuity.values() if each.lost), "")
        unobserved = next((e.unobserved for e in self._continuity.values() if e.unobserved), "")
        if not (lost or unobserved):
            return None
        code = Code.UNIT_CHANGED if lost else Code.NOT_OBSERVED
        return StepFailedError(code, f"{lost or unobserved} {steps.device_state}".strip())

    def _of_silence(self, steps: UnitSteps, failed: StepFailedError) -> StepFailedError:
        """The error for a missing answer: the unit was removed if an application that answered
        before does not any more. A lost adapter leaves that open.
        """
        try:
            for target in steps.targets:
                target.confirm()
        except StepFailedError as silent:
            return silent
        except BusError as error:
            return StepFailedError(Code.BUS, error.what)
        except InterruptedByUserError:
            pass  # the next step raises it again
        return failed

    def _before_next_try(self, steps: UnitSteps, failed: StepFailedError, rule: StepRule) -> None:
        if failed.code is Code.BUS:
            # The adapter may be back; if not, the next try fails.
            with suppress(BusError):
                self._connection.link.reopen()
        try:
            if rule.power_cycle and self._power is not None:
                steps.targets[0].restart(self._power)
            steps.wait(rule.pause_s)
        except InterruptedByUserError:
            return
        except BusError as error:
            raise StepFailedError(Code.BUS, error.what) from error

    def _is_over(self) -> bool:
        """True if a person aborted the run, the step's time is over, or the unit may have been
        exchanged; called between frames.
        """
        ends_at = self._step_ends_at
        is_late = ends_at is not None and self._clock.now() >= ends_at
        return self._is_lost() or self._cancelled() or is_late

    def _is_lost(self) -> bool:
        """True if the unit may have been exchanged; called between frames."""
        now = self._clock.now()
        self._note_suspension()
        for each in self._continuity.values():
            each.listened(now)
            if each.lost or each.unobserved:
                return True
        return False

    def _note_suspension(self) -> None:
        missed_s = suspended_s() - self._suspended_s
        if missed_s > PAUSE_S and not self._may_restart:
            for each in self._continuity.values():
                each.was_suspended(missed_s)

    def _progress(self, share: float) -> None:
        now = self._clock.now()
        if now - self._progress_at < _PROGRESS_S and share < 1:
            return
        self._progress_at = now
        passed_s = now - self._step_began_at
        left_s = passed_s / share * (1 - share) if share > 0 else None
        step, target = self._step
        self._send_progress(Progressed("", self._claim.serial, step, share, left_s, target))
