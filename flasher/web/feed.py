"""Event stream to pages: each message is the whole state of one subject.

A program's thread calls `put` and `beat`; pages follow in the server's event loop. A new page
receives all states, then each change in order. A newer state replaces an unsent one of its subject
if only the progress differs, so that no displayed word is skipped; a page too slow for that
receives all states again.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from flasher.bus.link import suspended_s

BEAT_S: Final = 0.5
"""Maximum interval between two messages to a page."""
GATHER_S: Final = 0.04
"""Changes within this time are sent as one message."""
PENDING_MAX: Final = 2000
"""Number of unsent changes from which a page receives all states instead."""
SHOWN_LIMIT_S: Final = 3.0
"""Maximum age of a page's last message when an order of it arrives; older pages are covered."""


def page_time() -> float:
    """Time of messages to pages, in seconds, which goes on while this computer is suspended."""
    return time.perf_counter() + suspended_s()


def is_late(shown_at: Any) -> bool:
    """True if an order was held up on its way since `shown_at`, the `page_time` of the last message
    that its page had, or this computer was restarted: units may have been exchanged meanwhile. So
    is an order with anything else in its place.
    """
    try:
        return not 0 <= page_time() - float(shown_at) <= SHOWN_LIMIT_S
    except (TypeError, ValueError, OverflowError):
        return True


@dataclass
class _Change:
    subject: str
    state: Any
    word: object


class _Follower:
    """Queue of unsent changes for one page."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.changes: deque[_Change] = deque()
        self.last: dict[str, _Change] = {}
        self.needs_all = True
        """True if the page needs all states."""
        self.woken = asyncio.Event()
        self._loop = loop

    def put(self, change: _Change) -> None:
        """Queue a change. Call with the feed's lock held."""
        if self.needs_all:
            return
        last = self.last.get(change.subject)
        if last is not None and last.word == change.word:
            last.state = change.state
            return
        if len(self.changes) >= PENDING_MAX:
            self.needs_all = True
            return
        self.last[change.subject] = change
        self.changes.append(change)

    def wake(self) -> None:
        with suppress(RuntimeError):  # the server is gone
            self._loop.call_soon_threadsafe(self.woken.set)


@dataclass(frozen=True)
class Batch:
    """Changes that are sent to a page together."""

    changes: tuple[tuple[str, Any], ...]
    """Subjects with their states, in the order of the changes."""
    is_all: bool = False
    """True if these are all subjects; others no longer exist."""


class Feed:
    """States of all subjects. `now`: a monotonic clock; `silence_limit_s`: time without a `beat`
    after which pages receive nothing until the next one.
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
        """Set the state of a subject; changes of `word` are never skipped."""
        with self._lock:
            known = self._states.get(subject)
            if known is not None and known.word == word and known.state == state:
                return
            self._states[subject] = _Change(subject, state, word)
            for follower in self._followers:
                follower.put(_Change(subject, state, word))
        self._wake()

    def beat(self) -> None:
        """Note that the program is running."""
        self._beat_at = self._now()

    @property
    def is_followed(self) -> bool:
        """True while a page is connected."""
        return bool(self._followers)

    def close(self) -> None:
        """End all followers."""
        self._is_closed = True
        self._wake()

    def _wake(self) -> None:
        for follower in tuple(self._followers):
            follower.wake()

    # -- the pages' side, in the server's loop -----------------------------------------------------

    async def follow(self) -> AsyncIterator[Batch]:
        """Yield all states, then every change; an empty batch after at most `BEAT_S` while the
        program is running.
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
            is_all, follower.needs_all = follower.needs_all, False
            changes = tuple(self._states.values() if is_all else follower.changes)
            follower.changes.clear()
            follower.last.clear()
            return Batch(tuple((each.subject, each.state) for each in changes), is_all)
