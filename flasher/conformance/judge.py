"""Judging: checks, measurements, and what the bench can do to the device from outside.

A failed check is recorded and the case goes on; `require` and `expect` stop it, as what follows
would judge nothing.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import ceil, inf

from flasher.conformance.hearing import Heard, Kind, describe
from flasher.conformance.line import Line
from flasher.conformance.model import CaseStopped, Check, Findings, Measurement, Outcome
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.subject import Subject
from flasher.conformance.wire import Words


class Judge(Line):
    """A line whose case writes down what it finds."""

    def __init__(
        self,
        subject: Subject,
        profile: ConformanceProfile,
        *,
        limit_s: float,
        seed: str = "",
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        words = Words(
            subject.target, profile.number("reset_command"), profile.text("reset_data").encode()
        )
        super().__init__(subject.port, words, limit_s, stopped)
        self.subject = subject
        self.profile = profile
        self.findings = Findings()
        self.random = random.Random(seed)  # noqa: S311  chosen by the seed on purpose
        self.is_off = False
        """True while the case has the device's power cut."""
        self._step = ""

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Checks inside the `with` belong to this step ("size 128")."""
        before, self._step = self._step, f"{self._step}, {name}" if self._step else name
        try:
            yield
        finally:
            self._step = before

    def check(self, ok: bool, expected: str, got: object) -> bool:  # noqa: FBT001
        """Record whether something is as expected; returns `ok`."""
        self._note(Outcome.PASS if ok else Outcome.FAIL, expected, str(got))
        return ok

    def require(self, ok: bool, expected: str, got: object) -> None:  # noqa: FBT001
        """The same, but a failure ends the case: raises CaseStopped."""
        if not self.check(ok, expected, got):
            raise CaseStopped(expected)

    def require_heard(self, heard: Heard | None, expected: str, within_s: float) -> Heard:
        """What was waited for has to be there; raises CaseStopped, which ends the case, else."""
        if heard is None:
            self.check(False, expected, f"nothing within {within_s:g} s")  # noqa: FBT003
            raise CaseStopped(expected)
        return heard

    def expect(
        self,
        kind: Kind,
        *,
        within_s: float,
        number: int | None = None,
        ignoring: Sequence[Kind] = (),
    ) -> Heard:
        """The next message has to be of `kind` (with that packet number) and come `within_s`;
        messages of the kinds `ignoring` do not count. Another message, or none, ends the case.
        """
        expected = kind.value if number is None else f"{kind.value} {number}"
        deadline = self.now + within_s
        heard = self.next_message(within_s)
        while heard is not None and heard.kind in ignoring and heard.kind is not kind:
            heard = self.next_message(deadline - self.now)
        found = self.require_heard(heard, expected, within_s)
        self.require(found.kind is kind and number in (None, found.number), expected, found)
        return found

    def expect_silence(
        self, for_s: float | None = None, *, ignoring: Sequence[Kind] = (), why: str = "no answer"
    ) -> bool:
        """Nothing is heard for that long (`limits.silence_s`), but for the kinds `ignoring`."""
        found = self.collect(self.profile.limit("silence_s") if for_s is None else for_s)
        found = [heard for heard in found if heard.kind not in ignoring]
        return self.check(not found, why, describe(found))

    def check_time(
        self, name: str, value_s: float, *, low_s: float = 0.0, high_s: float | None = None
    ) -> None:
        """Measure a time and judge it; within the uncertainty of a limit it is inconclusive."""
        self.measure(name, value_s)
        unsure_s = self.port.uncertainty_s
        limits = [limit for limit in (low_s or None, high_s) if limit is not None]
        expected = f"{name} {_range_ms(low_s, high_s)}"
        got = f"{value_s * 1000:.1f} ms"
        if any(abs(value_s - limit) < unsure_s for limit in limits):
            self._note(Outcome.INCONCLUSIVE, expected, f"{got} +- {unsure_s * 1000:.1f} ms")
            return
        self.check(low_s <= value_s and (high_s is None or value_s <= high_s), expected, got)

    def measure(self, name: str, value_s: float) -> None:
        """Record a time without judging it."""
        self.findings.measurements.append(Measurement(name, value_s, self.port.uncertainty_s))

    def check_measured(self, name: str, *, low_s: float = 0.0, high_s: float | None = None) -> None:
        """Judge all times of that name that this case has measured, in one check, which tells how
        they are spread. Without any it fails.
        """
        values_s = sorted(one.value_s for one in self.findings.measurements if one.name == name)
        expected = f"{name} {_range_ms(low_s, high_s)}"
        if not values_s:
            self._note(Outcome.FAIL, expected, "never measured")
            return
        lowest_s, highest_s, unsure_s = values_s[0], values_s[-1], self.port.uncertainty_s
        too_low_s, too_high_s = low_s - lowest_s, highest_s - (inf if high_s is None else high_s)
        if max(too_low_s, too_high_s) > unsure_s:
            outcome = Outcome.FAIL
        elif max(too_low_s if low_s else -inf, too_high_s) > -unsure_s:
            outcome = Outcome.INCONCLUSIVE
        else:
            outcome = Outcome.PASS
        self._note(outcome, expected, f"{_spread(values_s)} +- {unsure_s * 1000:.1f} ms")

    def info(self, text: str) -> None:
        """Record what was observed, without judging it."""
        self.findings.infos.append(text)

    def unsupported(self, what: str, why: str) -> None:
        """Record that a part of the case cannot be judged here; the other parts go on."""
        self._note(Outcome.UNSUPPORTED, what, why)

    def _note(self, outcome: Outcome, expected: str, got: str) -> None:
        self.findings.checks.append(Check(self._step, outcome, expected, got, self.elapsed_s))

    # -- the device's surroundings ----------------------------------------------------------------

    def power_off(self) -> None:
        """Cut the device's power. Raises Unsupported."""
        self.subject.power(on=False)
        self.is_off = True

    def power_on(self) -> None:
        """Give the device its power back. Raises Unsupported."""
        self.subject.power(on=True)
        self.is_off = False

    def power_cycle(self, off_s: float = 0.5) -> None:
        """Off, a pause, on; what was heard until then is forgotten. Raises Unsupported."""
        self.power_off()
        self.wait(off_s)
        self.forget()
        self.power_on()

    def bus_off(self, for_s: float) -> None:
        """Take the device's controller off the bus for a time. Raises Unsupported."""
        self.subject.bus_off(for_s)

    def check_stored(self, image: bytes) -> None:
        """The flash holds exactly `image`; nothing is judged on a bench without readback."""
        if not self.subject.has_readback:
            self.unsupported("the flash holds the image", "the bench has no readback")
            return
        stored = self.subject.readback()[: len(image)]
        differs = next(
            (at for at, pair in enumerate(zip(stored, image, strict=False)) if pair[0] != pair[1]),
            len(stored),
        )
        got = "the image" if stored == image else f"other bytes from offset {differs} on"
        self.check(stored == image, "the flash holds the image", got)


def _spread(ranked_s: Sequence[float]) -> str:
    """How times, in ascending order, are spread. A percentile is one of them: the nearest rank."""
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
