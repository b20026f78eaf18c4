"""Judge of one case: records checks and measurements, and derives the verdict.

After a failed `check` the case continues; `require` and `expect` end it when the rest depends on
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import ceil, inf
from types import MappingProxyType
from typing import Final

from flasher.conformance.profile_time import limits_of
from flasher.conformance.results import (
    CaseLimitReached,
    CaseStopped,
    CaseVerdict,
    Check,
    CheckOutcome,
    DeviceCrashed,
    MeasuredTime,
)
from flasher.conformance.tester import BusTester
from flasher.conformance.wire import Received, Reply, describe

_IN_TRANSFER: Final = (Reply.ACK, Reply.COMPLETE)
"""Answers of a device that has not left the transfer."""


class TimeName:
    """Names of measured times that several cases or questions use."""

    FEEDBACK: Final = "reset to general feedback"
    FIRST: Final = "reset to first boot version"
    POWERED: Final = "power to first boot version"
    SPACING: Final = "boot version to boot version"
    GAP: Final = "boot version to boot version without an application"
    LATE: Final = "pause to boot version, beyond the pause of the profile"
    REQUEST: Final = "update command to request transfer"
    ANSWER: Final = "packet to ACK"
    REJECTED: Final = "bad packet to NAK"
    COMPLETE: Final = "end of transfer to complete"
    RESTARTED: Final = "complete to boot version"
    START: Final = "complete to an application that answers"
    START_AGAIN: Final = "last boot version to an application that answers"


class Judge:
    """Judges the messages that the tester of a case receives. `choices` are those of the profile
    that decide the verdict.
    """

    def __init__(
        self, tester: BusTester, choices: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self._choices = choices
        self.checks: list[Check] = []
        self.measurements: list[MeasuredTime] = []
        self.infos: list[str] = []
        self.stall = ""
        """How this program stalled in the wait of the first failed check; "" when it did not."""
        self.ended_in = ""
        """The step in which the device crashed or the case ran out of time."""
        self._tester = tester
        self._step = ""
        self._stimuli = self._heard = self._unanswered = 0

    @property
    def verdict(self) -> CaseVerdict:
        outcomes = {check.outcome for check in self.checks}
        if CheckOutcome.FAIL in outcomes:
            return CaseVerdict.FAIL
        if CheckOutcome.INCONCLUSIVE in outcomes:
            return CaseVerdict.INCONCLUSIVE
        if outcomes == {CheckOutcome.PASS}:
            return CaseVerdict.PASS
        if CheckOutcome.PASS in outcomes:
            return CaseVerdict.PASS_IN_PART
        if outcomes:
            return CaseVerdict.UNSUPPORTED
        return CaseVerdict.INFO if self.infos or self.measurements else CaseVerdict.ERROR

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Context manager that names the step for the checks inside it ("size 128")."""
        before, self._step = self._step, f"{self._step}, {name}" if self._step else name
        try:
            yield
        except (CaseLimitReached, DeviceCrashed):
            self.ended_in = self.ended_in or self._step
            raise
        finally:
            self._step = before

    # -- checks -----------------------------------------------------------------------------------

    def check(
        self,
        ok: bool,  # noqa: FBT001
        expected: str,
        got: object,
        *,
        by: Mapping[str, str | float] | None = None,
    ) -> bool:
        """Record a check; returns `ok`. `by` are the profile keys that decide it (default: the
        choices of the case, and the limits of the last wait if no message came in it).
        """
        self._record(CheckOutcome.PASS if ok else CheckOutcome.FAIL, expected, str(got), by)
        return ok

    def require(
        self,
        ok: bool,  # noqa: FBT001
        expected: str,
        got: object,
        *,
        by: Mapping[str, str | float] | None = None,
    ) -> None:
        """Record a check; a failure ends the case by CaseStopped."""
        if not self.check(ok, expected, got, by=by):
            raise CaseStopped(expected)

    def succeed(self, expected: str, got: object) -> None:
        self.check(True, expected, got)  # noqa: FBT003

    def fail(self, expected: str, got: object) -> None:
        self.check(False, expected, got)  # noqa: FBT003

    def require_received(
        self, received: Received | None, expected: str, within_s: float
    ) -> Received:
        """Return `received`; records a failed check and raises CaseStopped when it is None."""
        if received is None:
            self.fail(expected, f"nothing within {within_s:g} s")
            raise CaseStopped(expected)
        return received

    def await_message(self, kind: Reply, *, within_s: float | None = None) -> Received:
        """Wait for a message of `kind`, skipping others, by default for the profile's limit for it.
        Ends the case without one.
        """
        limit_s = self._tester.limit_s(kind) if within_s is None else within_s
        received = self._tester.wait_for(kind, within_s=limit_s)
        return self.require_received(received, kind.value, limit_s)

    def expect(
        self,
        kind: Reply,
        *,
        within_s: float | None = None,
        number: int | None = None,
        ignoring: Sequence[Reply] = (),
    ) -> Received:
        """Require that the next message is of `kind` (with this packet number) and arrives
        `within_s`, by default the profile's limit for it. Messages of the kinds `ignoring` are
        skipped; any other message or none ends the case.
        """
        expected = kind.value if number is None else f"{kind.value} {number}"
        limit_s = self._tester.limit_s(kind) if within_s is None else within_s
        deadline = self._tester.now + limit_s
        received = self._tester.next_message(limit_s)
        while received is not None and received.kind in ignoring and received.kind is not kind:
            received = self._tester.next_message(deadline - self._tester.now)
        found = self.require_received(received, expected, limit_s)
        by = self.ends_of_transfer([found]) if kind in _IN_TRANSFER else None
        self.require(found.kind is kind and number in (None, found.number), expected, found, by=by)
        return found

    def ends_of_transfer(self, replies: Sequence[Received]) -> dict[str, str | float] | None:
        """The keys that decide whether a device may leave a transfer, when it announces itself."""
        if all(one.kind is not Reply.BOOT_VERSION for one in replies):
            return None
        profile = self._tester.profile
        pause = {"tx_12": profile.choice("tx_12"), "tx_13": profile.choice("tx_13")}
        return {**pause, **limits_of(profile.limit("pause_s"))}

    def expect_silence(
        self, for_s: float | None = None, *, ignoring: Sequence[Reply] = (), why: str = "no answer"
    ) -> bool:
        """Check that no message arrives for `for_s` (default: `Waits.silence_in_transfer_s`),
        except the kinds `ignoring`.
        """
        silence_s = self._tester.waits.silence_in_transfer_s if for_s is None else for_s
        found = [one for one in self._tester.collect(silence_s) if one.kind not in ignoring]
        return self.check(not found, why, describe(found))

    def check_only(self, received: Sequence[Received], *kinds: Reply, why: str) -> bool:
        """Check that only messages of these kinds were received."""
        others = [one for one in received if one.kind not in kinds]
        return self.check(not others, why, describe(others))

    def unsupported(self, what: str, why: str) -> None:
        """Record that this bench cannot judge a part of the case; the case continues."""
        self._record(CheckOutcome.UNSUPPORTED, what, why)

    def info(self, text: str) -> None:
        """Record an observation without judging it."""
        self.infos.append(text)

    # -- stimuli ----------------------------------------------------------------------------------

    def note_stimulus(self, count: int = 1, *, heard: bool = False) -> None:
        """Count stimuli that the device may reject or ignore. Without `heard` they count as heard
        once an answer shows that the device listened at the time (`note_listening`).
        """
        self._stimuli += count
        if heard:
            self._heard += count
        else:
            self._unanswered += count

    def note_listening(self, *, listens: bool = True) -> None:
        """The device did listen when the stimuli so far were sent, or did not."""
        self._heard += self._unanswered if listens else 0
        self._unanswered = 0

    def conclude(self) -> None:
        """Record how many stimuli were received. A case of which none was does not pass."""
        if not self._stimuli:
            return
        got = f"{self._heard} of {self._stimuli} stimuli were received"
        self.info(got)
        if not self._heard:
            expected = "the device listens when a stimulus is sent"
            self._record(CheckOutcome.INCONCLUSIVE, expected, got)

    # -- times ------------------------------------------------------------------------------------

    def measure(self, name: str, value_s: float) -> None:
        """Record a time without judging it."""
        self.measurements.append(MeasuredTime(name, value_s, self._tester.port.uncertainty_s))

    def check_time(
        self, name: str, value_s: float, *, low_s: float = 0.0, high_s: float | None = None
    ) -> None:
        """Record and judge a time; inconclusive when it is within the uncertainty of a limit."""
        self.measure(name, value_s)
        unsure_s = self._tester.port.uncertainty_s
        limits = [limit for limit in (low_s or None, high_s) if limit is not None]
        expected = f"{name} {_range_ms(low_s, high_s)}"
        got = f"{value_s * 1000:.1f} ms"
        if any(abs(value_s - limit) < unsure_s for limit in limits):
            got = f"{got} +- {unsure_s * 1000:.1f} ms"
            self._record(CheckOutcome.INCONCLUSIVE, expected, got, limits_of(*limits))
            return
        ok = low_s <= value_s and (high_s is None or value_s <= high_s)
        self.check(ok, expected, got, by=limits_of(*limits))

    def check_measured(self, name: str, *, low_s: float = 0.0, high_s: float | None = None) -> None:
        """Judge all recorded times of this name in one check that reports their distribution. Fails
        without any.
        """
        values_s = sorted(one.value_s for one in self.measurements if one.name == name)
        expected = f"{name} {_range_ms(low_s, high_s)}"
        if not values_s:
            self.fail(expected, "never measured")
            return
        unsure_s = self._tester.port.uncertainty_s
        below_s = low_s - values_s[0]
        above_s = values_s[-1] - (inf if high_s is None else high_s)
        if max(below_s, above_s) > unsure_s:
            outcome = CheckOutcome.FAIL
        elif max(below_s if low_s else -inf, above_s) > -unsure_s:
            outcome = CheckOutcome.INCONCLUSIVE
        else:
            outcome = CheckOutcome.PASS
        got = f"{_spread(values_s)} +- {unsure_s * 1000:.1f} ms"
        self._record(outcome, expected, got, limits_of(low_s, high_s or 0.0))

    def _record(
        self,
        outcome: CheckOutcome,
        expected: str,
        got: str,
        by: Mapping[str, str | float] | None = None,
    ) -> None:
        is_failure, stalled_s = outcome is CheckOutcome.FAIL, self._tester.stalled_s
        if is_failure and stalled_s and all(one.outcome is not outcome for one in self.checks):
            self.stall = f"this program stalled for {stalled_s * 1000:.0f} ms"
        judged_by: dict[str, str | float] = {}
        if outcome in (CheckOutcome.FAIL, CheckOutcome.INCONCLUSIVE):
            judged_by |= {**self._choices, **self._tester.expired} if by is None else by
        at_s = self._tester.elapsed_s
        self.checks.append(Check(self._step, outcome, expected, got, at_s, judged_by))


def _spread(ranked_s: Sequence[float]) -> str:
    """Distribution of sorted times as text. Percentiles use the nearest rank."""
    count = len(ranked_s)
    parts = [("min", 0.0), ("median", 0.5), ("p95", 0.95), ("p99", 0.99), ("max", 1.0)]
    shown = [
        f"{name} {ranked_s[max(0, ceil(share * count) - 1)] * 1000:.1f}" for name, share in parts
    ]
    return f"{count} times, {', '.join(shown)} ms"


def _range_ms(low_s: float, high_s: float | None) -> str:
    if high_s is None:
        return f"at least {low_s * 1000:g} ms"
    if not low_s:
        return f"at most {high_s * 1000:g} ms"
    return f"from {low_s * 1000:g} to {high_s * 1000:g} ms"
