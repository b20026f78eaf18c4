"""States reach a page whole, in order, and none that somebody must see is left out."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher.station.board import Board
from flasher.station.events import Progressed, RunEnded, StationEvent, StationStarted
from flasher.station.health import HealthWatch
from flasher.station.shift_counts import ShiftCounts
from flasher.web import feed as module
from flasher.web.feed import Batch, Feed, _Follower, is_late
from flasher.web.operator import Screen
from tests.web.own_loop import in_own_loop


@pytest.fixture(autouse=True)
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "GATHER_S", 0.0)
    monkeypatch.setattr(module, "BEAT_S", 0.01)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def _followed(feed: Feed, *steps: Any) -> list[Batch]:
    """What a page gets: one batch at its start, and one after each step."""

    async def follow() -> list[Batch]:
        stream: AsyncIterator[Batch] = feed.follow()
        batches = [await anext(stream)]
        for step in steps:
            step()
            batches.append(await anext(stream))
        return batches

    return in_own_loop(follow())


def _feed() -> Feed:
    return Feed(Clock(), silence_limit_s=1.0)


def test_a_page_that_connects_gets_all_states() -> None:
    feed = _feed()
    feed.put("A", 1, word="empty")
    feed.put("B", 2, word="empty")
    feed.put("A", 3, word="pass")
    (first,) = _followed(feed)
    assert first == Batch((("A", 3), ("B", 2)), is_all=True)


def test_a_change_of_the_word_is_never_left_out() -> None:
    feed = _feed()

    def change() -> None:
        for word in ("running", "saving", "pass", "empty"):
            feed.put("A", word.upper(), word=word)

    _, then = _followed(feed, change)
    assert [state for _, state in then.changes] == ["RUNNING", "SAVING", "PASS", "EMPTY"]


def test_of_mere_progress_the_newest_is_sent() -> None:
    feed = _feed()

    def change() -> None:
        for share in (0.1, 0.2, 0.3):
            feed.put("A", share, word="running")

    _, then = _followed(feed, change)
    assert then.changes == (("A", 0.3),)


def test_what_did_not_change_is_not_sent_again() -> None:
    feed = _feed()
    feed.put("A", 1, word="empty")
    _, then = _followed(feed, lambda: feed.put("A", 1, word="empty"))
    assert then == Batch(())


def test_without_changes_there_are_beats() -> None:
    _, second, third = _followed(_feed(), lambda: None, lambda: None)
    assert second == third == Batch(())


def test_a_page_that_is_too_slow_gets_all_states_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PENDING_MAX", 3)
    feed = _feed()
    feed.put("B", 0, word=0)

    def change() -> None:
        for number in range(1, 10):
            feed.put("A", number, word=number)

    _, then = _followed(feed, change)
    assert then == Batch((("B", 0), ("A", 9)), is_all=True)


def test_a_program_that_hangs_is_not_vouched_for() -> None:
    """No beat comes from a server whose program does not turn: pages must not look alive."""
    clock = Clock()
    feed = Feed(clock, silence_limit_s=1.0)
    clock.now = 5.0

    async def follow() -> tuple[bool, Batch]:
        waiting = asyncio.ensure_future(anext(feed.follow()))
        heard, _ = await asyncio.wait({waiting}, timeout=0.1)
        feed.put("A", 1, word=1)  # something may come from another thread
        feed.beat()
        return bool(heard), await waiting

    was_heard, then = in_own_loop(follow())
    assert not was_heard
    assert then.changes == (("A", 1),)


def test_a_closed_feed_ends_its_streams_after_the_last_state() -> None:
    feed = _feed()
    feed.put("a", 1, word=None)

    async def follow() -> list[object]:
        seen: list[object] = []
        async for batch in feed.follow():
            seen += [state for _, state in batch.changes]
            feed.put("a", 2, word=None)
            feed.close()
        return seen

    assert in_own_loop(follow()) == [1, 2]


# -- any course of a station ----------------------------------------------------------------------


STARTED = StationStarted("line-2", "BAT-36", "4", "BAT-36", ("A", "B"), ())


def at_the_line(event: Any) -> StationEvent:
    """The event, now and at a socket of this station."""
    now = datetime.now(UTC)
    changes: dict[str, Any] = {}
    if hasattr(event, "socket"):
        changes = {"socket": "AB"[len(event.socket) % 2]}
    if isinstance(event, RunEnded):
        changes = {"run": replace(event.run, begun_at=now, ended_at=now, **changes)}
    return replace(event, at=now.isoformat(), **changes)  # type: ignore[no-any-return]


OTHERS = [each for each in StationEvent.__subclasses__() if each is not StationStarted]
ANY = st.one_of(*map(st.from_type, OTHERS))
# Of mere progress only the newest is sent: there has to be a lot of it.
EVENTS = st.lists(st.one_of(ANY, st.from_type(Progressed)).map(at_the_line), max_size=20)


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(EVENTS, st.sets(st.integers(0, 20), max_size=4))
def test_a_page_that_was_open_shows_what_one_shows_that_is_opened_later(
    events: list[StationEvent], looks: set[int]
) -> None:
    """It receives changes; the other one receives all states."""
    watch = HealthWatch(Path("/"), lambda: datetime.now(UTC), lambda: 0.0)
    screen, board = Screen(ShiftCounts(), watch), Board()
    screen.feed = Feed(Clock(), silence_limit_s=1.0)
    shown: dict[str, Any] = {}
    with closing(asyncio.new_event_loop()) as loop:
        page, late_page = _Follower(loop), _Follower(loop)
        screen.feed._followers.add(page)
        for number, event in enumerate([STARTED, *events]):
            board.apply(event)
            screen.show(event, board)
            if number in {0, *looks, len(events)}:
                batch = screen.feed._take(page)
                shown = dict(batch.changes) if batch.is_all else shown | dict(batch.changes)
        assert shown == dict(screen.feed._take(late_page).changes)
        for name, row in board.rows.items():
            assert replace(shown[f"socket {name}"], state=row.state) == row


@pytest.mark.parametrize(
    ("shown_at", "late"),
    [
        (100.0, False), (97.0, False), (96.9, True), (100.1, True), (100, False), ("x", True),
        (None, True), ([], True), (10**400, True), (float("nan"), True), (float("inf"), True),
    ],
)  # fmt: skip
def test_an_order_is_late_unless_its_page_was_shown_a_moment_ago(
    monkeypatch: pytest.MonkeyPatch, shown_at: object, late: bool
) -> None:
    monkeypatch.setattr(module, "page_time", lambda: 100.0)
    assert is_late(shown_at) is late
