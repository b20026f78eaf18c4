"""The run of one unit, from the first question to the last: blocking, on an open connection.

It knows no database: what must be on disk before it may go on is handed to a `Journal`, and an act
that cannot be noted is not done. What each step does stands in `unit_steps`; here is how steps are
begun, tried again, timed, recorded and judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

from flasher.api import Connection
from flasher.driver import Tap
from flasher.errors import (
    BusError,
    FlasherError,
    InterruptedByUserError,
    NoAnswerError,
    VerificationError,
    WrongDeviceError,
)
from flasher.station import codes
from flasher.station.codes import Code
from flasher.station.listening import Listen
from flasher.station.messages import (
    CancelledError,
    Journal,
    JournalError,
    PowerControl,
    Progress,
    RunOrder,
    RunResult,
    StepBegan,
    StepFailedError,
    StepReport,
    Tell,
)
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records.model import Measurement, RunState, StepName, StepState
from flasher.station.unit_device import UnitDevice
from flasher.station.unit_steps import Act, UnitSteps

_PROGRESS_S: Final = 0.25
"""Progress is told this often at the most: it must never fill the way to the station."""
_STATES: Final = {
    RunState.FAIL: StepState.FAIL,
    RunState.ERROR: StepState.ERROR,
    RunState.ABORTED: StepState.ERROR,
}
_BY_ERROR: Final[tuple[tuple[type[FlasherError], Code], ...]] = (
    (BusError, codes.BUS),
    (NoAnswerError, codes.NO_ANSWER),
    (WrongDeviceError, codes.NOT_FOR_DEVICE),
    (VerificationError, codes.WRITE_DIFFERS),
)


class UnitRun:
    """A run. `cancelled` is asked again and again while it runs, and stays True once it was."""

    def __init__(
        self,
        order: RunOrder,
        recipe: LoadedRecipe,
        connection: Connection,
        journal: Journal,
        *,
        taps: Sequence[Tap] = (),
        tell: Tell = lambda _note: None,
        cancelled: Callable[[], bool] = lambda: False,
        power: PowerControl | None = None,
    ) -> None:
        self._order = order
        self._recipe = recipe
        self._connection = connection
        self._journal = journal
        self._taps = taps
        self._tell = tell
        self._cancelled = cancelled
        self._power = power
        self._step_ends_at: float | None = None
        self._step: tuple[StepName, str] = (StepName.CONNECT, "")
        self._step_began_at = 0.0
        self._told_at = float("-inf")
        self._steps: UnitSteps | None = None

    def run(self) -> RunResult:
        """Do it. Raises nothing but what is a bug."""
        clock = self._connection.clock
        began_at = clock.now()
        code, text = codes.OK, ""
        try:
            for step, target, act in self._acts():
                self._do(step, target, act)
        except StepFailedError as failed:
            code, text = failed.code, failed.text
        except JournalError as error:
            code, text = codes.RECORD_NOT_SAVED, error.what
        steps = self._steps
        verified = steps.verified if steps is not None and code is codes.OK else {}
        return RunResult(code.outcome, code.name, text, clock.now() - began_at, dict(verified))

    def _acts(self) -> Sequence[tuple[StepName, str, Act | None]]:
        try:
            devices = [
                UnitDevice(target, self._connection, self._taps, self._is_over)
                for target in self._recipe.targets
            ]
            self._steps = UnitSteps(
                self._order, self._recipe, devices, self._journal, self._power, self._progress
            )
            self._steps.flashing.tell = self._tell
        except FlasherError as error:
            raise StepFailedError(codes.RECIPE, error.what) from error
        return self._steps.acts()

    # -- one step ---------------------------------------------------------------------------------

    def _do(self, step: StepName, target: str, act: Act | None) -> None:
        """Try a step as often as the recipe says. Raises StepFailedError."""
        rule = self._recipe.recipe.rule(step)
        if act is None:
            self._journal.step(StepReport(step, target, 1, StepState.SKIPPED, 0.0))
            return
        for try_number in range(1, rule.tries + 1):
            failed = self._try(step, target, act, try_number, rule.time_limit_s)
            if failed is None:
                return
            if not failed.code.may_retry or try_number == rule.tries:
                raise failed
            self._before_next_try(failed, rule.pause_s, power_cycle=rule.power_cycle)

    def _try(
        self, step: StepName, target: str, act: Act, try_number: int, limit_s: float | None
    ) -> StepFailedError | None:
        clock = self._connection.clock
        began_at = clock.now()
        self._step, self._step_began_at = (step, target), began_at
        self._told_at = float("-inf")
        self._step_ends_at = None if limit_s is None else began_at + limit_s
        self._tell(StepBegan(step, target, try_number))
        measured: list[Measurement] = []
        failed, text = None, ""
        try:
            self._check_cancelled()
            text = act(measured)
        except StepFailedError as error:
            failed = error
        except (CancelledError, InterruptedByUserError) as error:
            failed = self._why_over(step, getattr(error, "what", ""))
        except JournalError:
            raise
        except FlasherError as error:
            failed = self._known(error)
        finally:
            self._step_ends_at = None
        duration_s = clock.now() - began_at
        if limit_s is not None:
            measured.append(Measurement("duration", duration_s, "s", high=limit_s))
            if failed is None and duration_s > limit_s:
                failed = StepFailedError(
                    codes.TOO_SLOW, f"{step.value}: {duration_s:.1f} s, {limit_s:g} s are allowed."
                )
        report = StepReport(
            step, target, try_number, StepState.PASS, duration_s, "", text, tuple(measured)
        )
        if failed is not None:
            state = _STATES[failed.code.outcome]
            report = replace(report, state=state, code=failed.code.name, text=failed.text)
        self._journal.step(report)
        return failed

    def _check_cancelled(self) -> None:
        if self._cancelled():
            raise CancelledError

    def _why_over(self, step: StepName, what: str) -> StepFailedError:
        """The run was cancelled, or the step's time is over."""
        left = self._steps.flashing.left_behind if self._steps is not None else ""
        if self._cancelled():
            return StepFailedError(codes.OPERATOR_ABORT, f"Stopped in {step.value}. {left}".strip())
        return StepFailedError(
            codes.TOO_SLOW, f"{what or 'It was not done in time.'} {left}".strip()
        )

    @staticmethod
    def _known(error: FlasherError) -> StepFailedError:
        code = next((code for kind, code in _BY_ERROR if isinstance(error, kind)), codes.RECIPE)
        words = f"{error.what} ({error.cause})" if error.cause else error.what
        return StepFailedError(code, words)

    def _before_next_try(
        self, failed: StepFailedError, pause_s: float, *, power_cycle: bool
    ) -> None:
        if failed.code is codes.BUS:
            # It may be back; when it is not, the next try says so.
            with suppress(BusError):
                self._connection.link.reopen()
        try:
            if power_cycle and self._power is not None:
                self._power.begin_cycle()
            if pause_s and self._steps is not None:
                self._steps.devices[0].run(Listen(pause_s, lambda _now: False))
        except CancelledError:
            return
        except BusError as error:
            raise StepFailedError(codes.BUS, error.what) from error

    def _is_over(self) -> bool:
        """Asked between frames: a person stopped it, or the step's time is over."""
        if self._cancelled():
            return True
        ends_at = self._step_ends_at
        return ends_at is not None and self._connection.clock.now() >= ends_at

    def _progress(self, share: float) -> None:
        now = self._connection.clock.now()
        if now - self._told_at < _PROGRESS_S and share < 1:
            return
        self._told_at = now
        passed_s = now - self._step_began_at
        left_s = passed_s / share * (1 - share) if share > 0 else None
        self._tell(Progress(*self._step, share, left_s))
