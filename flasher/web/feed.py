"""States for pages that follow them: each message is the whole state of one subject.

A program's thread calls `put` and `beat`; pages follow in the server's event loop. A page that
connects gets all states, then each change in its order. A state that was not sent yet is replaced
by a newer one of its subject when only its progress changed, so no word that a subject shows is
left out; a page that is too slow for that gets all states anew.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

BEAT_S: Final = 0.5
"""Time between two messages to a page at the most."""
GATHER_S: Final = 0.04
"""Changes in this time are one message."""
PENDING_MAX: Final = 2000
"""Changes that a page may be behind."""


@dataclass
class _Change:
    subject: str
    state: Any
    word: object


class _Follower:
    """What one page has not got yet."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.changes: deque[_Change] = deque()
        self.last: dict[str, _Change] = {}
        self.is_behind = True
        """It needs all states."""
        self.woken = asyncio.Event()
        self._loop = loop

    def put(self, change: _Change) -> None:
        """Called with the feed's lock held."""
        if self.is_behind:
            return
        last = self.last.get(change.subject)
        if last is not None and last.word == change.word:
            last.state = change.state
            return
        if len(self.changes) >= PENDING_MAX:
            self.is_behind = True
            return
        self.last[change.subject] = change
        self.changes.append(change)

    def wake(self) -> None:
        with suppress(RuntimeError):  # the server is gone
            self._loop.call_soon_threadsafe(self.woken.set)


@dataclass(frozen=True)
class Batch:
    """What a page gets at a time."""

    changes: tuple[tuple[str, Any], ...]
    """Subjects with their whole states, in the order in which they changed."""
    is_all: bool = False
    """These are all subjects: others are gone."""


class Feed:
    """The states of all subjects. `now`: a monotonic clock; `silence_limit_s`: a program that calls
    `beat` less often is not at work, and pages hear nothing until it does again.
    """

    def __init__(self, now: Callable[[], float], *, silence_limit_s: float) -> None:
        self._now = now
        self._silence_limit_s = silence_limit_s
        self._lock = threading.Lock()
        self._states: dict[str, _Change] = {}
        self._followers: set[_Follower] = set()
        self._beat_at = now()
        self._is_closed = False

    # -- the program's side, any thread ------------------------------------------------------------

    def put(self, subject: str, state: Any, *, word: object) -> None:
        """The state of a subject; `word`: what of it must not be left out when it changes."""
        with self._lock:
            known = self._states.get(subject)
            if known is not None and known.word == word and known.state == state:
                return
            self._states[subject] = _Change(subject, state, word)
            for follower in self._followers:
                follower.put(_Change(subject, state, word))
        self._wake()

    def beat(self) -> None:
        """The program is at work."""
        self._beat_at = self._now()

    def close(self) -> None:
        """No page is followed any more."""
        self._is_closed = True
        self._wake()

    def _wake(self) -> None:
        for follower in tuple(self._followers):
            follower.wake()

    # -- the pages' side, in the server's loop -----------------------------------------------------

    async def follow(self) -> AsyncIterator[Batch]:
        """All states, then every change; an empty batch at the latest after `BEAT_S`, as long as
        the program is at work.
        """
        follower = _Follower(asyncio.get_running_loop())
        with self._lock:
            self._followers.add(follower)
        try:
            is_last = False
            while not is_last:
                is_last = self._is_closed  # before it is taken what there is then
                if self._now() - self._beat_at < self._silence_limit_s:
                    yield self._take(follower)
                if is_last:
                    return
                await asyncio.sleep(GATHER_S)
                try:
                    await asyncio.wait_for(follower.woken.wait(), BEAT_S)
                except TimeoutError:
                    continue
                follower.woken.clear()
        finally:
            with self._lock:
                self._followers.discard(follower)

    def _take(self, follower: _Follower) -> Batch:
        with self._lock:
            is_all, follower.is_behind = follower.is_behind, False
            changes = tuple(self._states.values() if is_all else follower.changes)
            follower.changes.clear()
            follower.last.clear()
            return Batch(tuple((each.subject, each.state) for each in changes), is_all)
