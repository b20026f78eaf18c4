"""Active sign-ins, in memory only: none survives a restart, and an ended one never returns.

Cookies contain only the keys of sign-ins.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final

from flasher.station.operators import Person, Role
from flasher.station.records.model import AuditEvent, StationClock

SHIFT_S: Final = 8 * 3600.0
"""Maximum length of a sign-in."""
IDLE_S: Final = 900.0
"""Maximum time without a page view, for a supervisor."""
_OF_ONE_MAX: Final = 100
"""Maximum number of sign-ins of one person, or by the password; then the oldest one ends."""
_BY_PASSWORD: Final = "(password)"  # noqa: S105  what the audit trail has in place of a name

Note = Callable[[AuditEvent, Mapping[str, str]], None]
"""Appends an entry to the audit trail."""


@dataclass(frozen=True)
class Moment:
    """A time on two clocks: wall time may be set, the monotonic one may stop during sleep."""

    utc: datetime
    monotonic_s: float

    @classmethod
    def now(cls, clock: StationClock) -> Moment:
        return cls(clock.utc(), clock.monotonic_s())

    def until_s(self, later: Moment) -> float:
        """Seconds to a later moment, by the clock that advanced further."""
        return max(later.monotonic_s - self.monotonic_s, (later.utc - self.utc).total_seconds())


@dataclass(frozen=True)
class SignIn:
    """A person signed in at a browser. `name` and `role`: of the badge; "" for the password."""

    number: int
    name: str
    role: Role | None
    address: str
    begun: Moment
    used: Moment

    @property
    def is_supervisor(self) -> bool:
        return self.role is Role.SUPERVISOR

    def data(self, **more: str) -> dict[str, str]:
        """Data for the audit trail."""
        name = self.name or _BY_PASSWORD
        return {"number": str(self.number), "name": name, "address": self.address, **more}

    def over(self, now: Moment) -> str:
        """Reason why it has expired; "" while it is active."""
        if self.begun.until_s(now) >= SHIFT_S:
            return f"{SHIFT_S / 3600:g} h"
        if self.is_supervisor and self.used.until_s(now) >= IDLE_S:
            return f"{IDLE_S / 60:g} min without use"
        return ""


class SignIns:
    """Active sign-ins. `note` is called when one begins or ends. Not thread-safe."""

    def __init__(self, clock: StationClock, note: Note) -> None:
        self._clock = clock
        self._note = note
        self._known: dict[str, SignIn] = {}
        """Active sign-ins by key, oldest first."""
        self._count = 0

    def begin(self, person: Person | None, address: str, keys: Iterable[str] = ()) -> list[str]:
        """Sign a person in (None: by password) at a browser with these keys; returns the new keys.

        A supervisor who signs in at a page of the line does not end the operator's sign-in.
        """
        self._count += 1
        now = Moment.now(self._clock)
        name, role = ("", None) if person is None else (person.name, person.role)
        made = SignIn(self._count, name, role, address, now, now)
        same = [each for each in self.listed() if each.name == name]
        for oldest in same[: max(len(same) - _OF_ONE_MAX + 1, 0)]:
            self._end(oldest, why=f"more than {_OF_ONE_MAX}")
        kept = []
        for known in (each for each in keys if each in self._known):
            if made.is_supervisor and not self._known[known].is_supervisor:
                kept.append(known)
            else:
                self._end(self._known[known], why="another one at this browser")
        key = secrets.token_urlsafe(32)
        self._known[key] = made
        self._note(AuditEvent.SIGN_IN, made.data(role="" if role is None else role.value))
        return [*kept, key]

    def find(self, keys: Iterable[str], *, is_use: bool) -> SignIn | None:
        """The last active sign-in of these keys; `is_use`: a page is viewed."""
        self._end_old()
        found = next((key for key in reversed(list(keys)) if key in self._known), None)
        if found is None:
            return None
        if is_use:
            self._known[found] = replace(self._known[found], used=Moment.now(self._clock))
        return self._known[found]

    def listed(self) -> list[SignIn]:
        """All active sign-ins, oldest first."""
        self._end_old()
        return list(self._known.values())

    def sign_out(self, sign_in: SignIn, *, everywhere: bool = False) -> None:
        """End a sign-in for its owner; `everywhere`: all sign-ins of that person."""
        self._forget(sign_in)
        self._note(AuditEvent.SIGN_OUT, sign_in.data())
        for other in self.listed() if everywhere and sign_in.name else ():
            if other.name == sign_in.name:
                self._end(other, by=sign_in.name)

    def end(self, number: str, by: SignIn) -> None:
        """End a sign-in for a supervisor, if it is still active."""
        for each in self.listed():
            if str(each.number) == number:
                self._end(each, by=by.name or _BY_PASSWORD)

    def end_all(self, by: SignIn) -> None:
        for each in self.listed():
            self._end(each, by=by.name or _BY_PASSWORD)

    def _end_old(self) -> None:
        now = Moment.now(self._clock)
        for each in tuple(self._known.values()):
            if why := each.over(now):
                self._end(each, why=why)

    def _end(self, sign_in: SignIn, **how: str) -> None:
        self._forget(sign_in)
        self._note(AuditEvent.SIGN_IN_ENDED, sign_in.data(**how))

    def _forget(self, sign_in: SignIn) -> None:
        self._known = {
            key: each for key, each in self._known.items() if each.number != sign_in.number
        }
