"""Rate limits against guessing PINs and passwords. Times are seconds on a monotonic clock.

A try is counted before it is checked, so that parallel tries count too.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

TRIES_MAX: Final = 5
"""Tries for one badge before the first pause."""
PAUSE_S: Final = 60.0
"""The first pause; each following one takes twice as long."""
PAUSE_MAX_S: Final = 960.0
FORGOTTEN_S: Final = 3600.0
"""Time without a try after which earlier ones are forgotten."""
RATE_S: Final = 60.0
"""Period of the rate limits."""
PER_ADDRESS_MAX: Final = 20
"""Tries from one address in `RATE_S`, so that one client cannot use up `ALL_MAX`."""
ALL_MAX: Final = 60
"""Tries from all addresses in `RATE_S`, which bounds the processor time for checks."""
_PRUNED_ABOVE: Final = 1000
_NEVER: Final = float("-inf")


class BackOff:
    """Counts wrong tries; after each `TRIES_MAX` of them a pause begins."""

    def __init__(self) -> None:
        self._tries = 0
        self._pauses = 0
        self._open_at_s = _NEVER
        self._last_s = _NEVER

    def wait_s(self, now: float) -> float:
        """Seconds until the next try is allowed; 0 if it is allowed now."""
        return max(self._open_at_s - now, 0.0)

    def count(self, now: float) -> None:
        if self.is_forgotten(now):
            self.reset()
        self._last_s = now
        self._tries += 1
        if self._tries >= TRIES_MAX:
            pause_s = min(PAUSE_S * 2**self._pauses, PAUSE_MAX_S)
            self._tries, self._pauses, self._open_at_s = 0, self._pauses + 1, now + pause_s

    def reset(self) -> None:
        """Forget all tries, after a correct one."""
        self._tries, self._pauses, self._open_at_s = 0, 0, _NEVER

    def is_forgotten(self, now: float) -> bool:
        return now - self._last_s > FORGOTTEN_S


class Rate:
    """Limits tries, correct ones included, to `limit` in any period of `RATE_S`."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._begun_s: deque[float] = deque()

    def wait_s(self, now: float) -> float:
        """Seconds until the next try is allowed; 0 if it is allowed now."""
        while self._begun_s and now - self._begun_s[0] >= RATE_S:
            self._begun_s.popleft()
        if len(self._begun_s) < self._limit:
            return 0.0
        return self._begun_s[0] + RATE_S - now

    def count(self, now: float) -> None:
        self._begun_s.append(now)

    def is_forgotten(self, now: float) -> bool:
        return self.wait_s(now) == 0.0 and not self._begun_s


@dataclass
class _OfBadge:
    rate: Rate = field(default_factory=lambda: Rate(TRIES_MAX))
    back_off: BackOff = field(default_factory=BackOff)


class Attempts:
    """Limits the tries of all clients: for each badge at each address, for each address, and in
    total. Guessing the PIN of a badge does not lock out its owner at another address.
    """

    def __init__(self) -> None:
        self._all = Rate(ALL_MAX)
        self._addresses: dict[str, Rate] = {}
        self._badges: dict[tuple[str, str], _OfBadge] = {}

    def begin(self, address: str, badge: str | None, now: float) -> float:
        """Start a try. Returns 0 if it may be checked; else the seconds to wait, and it does not
        count.

        `badge`: the badge whose PIN is tried; "" for the password; None: nothing is compared.
        """
        self._prune(now)
        limits: list[Rate | BackOff] = [
            self._all,
            self._addresses.setdefault(address, Rate(PER_ADDRESS_MAX)),
        ]
        wait_s = max(each.wait_s(now) for each in limits)
        # Refused tries must not use memory for their badges.
        if badge is not None and wait_s == 0.0:
            of_badge = self._badges.setdefault((badge, address), _OfBadge())
            limits += [of_badge.rate, of_badge.back_off]
            wait_s = max(each.wait_s(now) for each in limits)
        if wait_s == 0.0:
            for each in limits:
                each.count(now)
        return wait_s

    def pause_s(self, address: str, badge: str, now: float) -> float:
        """Seconds that remain of a pause after too many tries of a badge; 0 without a pause."""
        of_badge = self._badges.get((badge, address), _OfBadge())
        return of_badge.back_off.wait_s(now)

    def forget(self, address: str, badge: str) -> None:
        """Forget the tries of a badge at an address, after a correct one."""
        self._badges[badge, address].back_off.reset()

    def _prune(self, now: float) -> None:
        if len(self._addresses) > _PRUNED_ABOVE:
            kept = {
                key: rate for key, rate in self._addresses.items() if not rate.is_forgotten(now)
            }
            self._addresses = kept
        if len(self._badges) > _PRUNED_ABOVE:
            self._badges = {
                key: each
                for key, each in self._badges.items()
                if not each.back_off.is_forgotten(now)
            }
