"""Who is signed in. The sign-ins are in the memory of the server alone: none outlives it, and an
ended one never comes back. Cookies hold nothing but the keys by which they are found.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Final

from flasher.station.operators import Person, Role
from flasher.station.records.model import AuditEvent, Clock

SHIFT_S: Final = 8 * 3600.0
"""Every sign-in ends after this time."""
IDLE_S: Final = 900.0
"""A supervisor who looked at no page for so long has left the screen."""
_OF_ONE_MAX: Final = 100
"""Sign-ins of one person, or by the password: the oldest one ends."""
_BY_PASSWORD: Final = "(password)"  # noqa: S105  what the audit trail has in place of a name

Note = Callable[[AuditEvent, Mapping[str, str]], None]
"""Takes what goes into the audit trail."""


@dataclass(frozen=True)
class Moment:
    """A moment by both clocks: the one for people may be set, the other one may stand still while
    the computer sleeps.
    """

    utc: datetime
    monotonic_s: float

    @classmethod
    def now(cls, clock: Clock) -> Moment:
        return cls(clock.utc(), clock.monotonic_s())

    def until_s(self, later: Moment) -> float:
        """The time from here to a later moment, by the clock that went further."""
        return max(later.monotonic_s - self.monotonic_s, (later.utc - self.utc).total_seconds())


@dataclass(frozen=True)
class SignIn:
    """Somebody at a browser. `name` and `role` are those of the badge; of the password: none."""

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
        """What the audit trail has of it."""
        name = self.name or _BY_PASSWORD
        return {"number": str(self.number), "name": name, "address": self.address, **more}

    def over(self, now: Moment) -> str:
        """Why it has ended by itself; "" while it goes on."""
        if self.begun.until_s(now) >= SHIFT_S:
            return f"{SHIFT_S / 3600:g} h"
        if self.is_supervisor and self.used.until_s(now) >= IDLE_S:
            return f"{IDLE_S / 60:g} min without use"
        return ""


class SignIns:
    """The sign-ins of a server. `note` is called for each that begins or ends. Used by one thread
    alone.
    """

    def __init__(self, clock: Clock, note: Note) -> None:
        self._clock = clock
        self._note = note
        self._known: dict[str, SignIn] = {}
        """By their keys, from the first that was begun to the last."""
        self._count = 0

    def begin(self, person: Person | None, address: str, keys: Iterable[str] = ()) -> list[str]:
        """Sign somebody in, None: by the password, at a browser that has these keys; gives those
        that it has from now on.

        A supervisor who looks something up at a screen of the line leaves it as it was.
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
        """The last of these that goes on; `is_use`: somebody looks at a page by it."""
        self._end_old()
        found = next((key for key in reversed(list(keys)) if key in self._known), None)
        if found is None:
            return None
        if is_use:
            self._known[found] = replace(self._known[found], used=Moment.now(self._clock))
        return self._known[found]

    def listed(self) -> list[SignIn]:
        """All that go on, the oldest first."""
        self._end_old()
        return list(self._known.values())

    def sign_out(self, sign_in: SignIn, *, everywhere: bool = False) -> None:
        """End a sign-in by its own wish; `everywhere`: also the others of the same person."""
        self._forget(sign_in)
        self._note(AuditEvent.SIGN_OUT, sign_in.data())
        for other in self.listed() if everywhere and sign_in.name else ():
            if other.name == sign_in.name:
                self._end(other, by=sign_in.name)

    def end(self, number: str, by: SignIn) -> None:
        """End the sign-in of somebody, by a supervisor. One that has ended is none."""
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
