"""Bus monitor engine that sends nothing, and a table of the latest messages.

`Watcher` is driven like every other engine, so a live bus, the mock and a test share the same code;
`replay` feeds it the frames of a file. `MessageTable` keeps the latest message of each kind, its
changed fields, and its rate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.spec import Dialect
from flasher.trace.decoder import BusEvent, Decoder, Kind

RATE_WINDOW_S: Final = 5.0
"""Period over which rates are counted."""
CHANGE_SHOWN_S: Final = 1.0
"""Time for which a changed field stays marked."""
_RATE_SAMPLES: Final = 10_000
"""Maximum number of times kept for a rate: more than a bus carries in the window."""
_AFTER_LAST_S: Final = 1.0
"""Time after the last frame at which an incomplete message counts as damaged."""
_AT_ONCE: Final = float("-inf")


@dataclass(frozen=True)
class TimedFrame:
    """Received frame, not decoded."""

    at: float
    frame: Frame


@dataclass(frozen=True)
class Pulse:
    """Event at which a screen is refreshed."""

    at: float


@dataclass(frozen=True)
class Filter:
    """Selects events; an empty part accepts all.

    `nodes` match senders and receivers, `words` match parts of titles, ignoring case.
    """

    nodes: frozenset[str] = frozenset()
    words: tuple[str, ...] = ()
    trouble_only: bool = False

    def accepts(self, event: BusEvent) -> bool:
        if self.nodes and not self.nodes & {event.sender, event.receiver}:
            return False
        title = event.title.lower()
        if self.words and not any(word.lower() in title for word in self.words):
            return False
        return event.is_trouble or not self.trouble_only


EVERYTHING: Final = Filter()


class Watcher:
    """Bus monitor engine. Its events are `BusEvent`, `TimedFrame` if `raw`, `Pulse` if `pulse_s`.

    Ends after `count` accepted events, or `duration_s` seconds after its first `tick`; otherwise it
    runs until it is cancelled.
    """

    def __init__(
        self,
        shown: Filter = EVERYTHING,
        *,
        raw: bool = False,
        count: int | None = None,
        duration_s: float | None = None,
        pulse_s: float | None = None,
        dialect: Dialect | None = None,
    ) -> None:
        self._decoder = Decoder(dialect=dialect)
        self._filter = shown
        self._raw = raw
        self._left = count
        self._duration_s = duration_s
        self._pulse_s = pulse_s
        self._begun = False
        self._ends_at: float | None = None
        self._pulse_at: float | None = None
        self._cancelled = False
        self._events: list[object] = []
        self.frames = 0

    @property
    def done(self) -> bool:
        return self._cancelled or self._left == 0

    def receive(self, frame: Frame, now: float) -> None:
        if self.done or (self._ends_at is not None and now > self._ends_at):
            return
        self.frames += 1
        if self._raw:
            self._events.append(TimedFrame(now, frame))
        self._take(self._decoder.feed(frame, now))

    def tick(self, now: float) -> None:
        if not self._begun:
            self._begun = True
            self._ends_at = None if self._duration_s is None else now + self._duration_s
            self._pulse_at = None if self._pulse_s is None else now
        self._take(self._decoder.tick(now))
        if self._pulse_at is not None and self._pulse_s is not None and now >= self._pulse_at:
            self._events.append(Pulse(now))
            self._pulse_at = now + self._pulse_s
        if self._ends_at is not None and now >= self._ends_at:
            self._cancelled = True

    def deadline(self) -> float | None:
        if self.done:
            return None
        if not self._begun:
            return _AT_ONCE
        times = (self._decoder.deadline(), self._ends_at, self._pulse_at)
        return min((at for at in times if at is not None), default=None)

    def next_frame(self, now: float) -> Frame | None:
        return None  # watching does not disturb

    def frame_sent(self, now: float) -> None:
        pass

    def cancel(self, now: float) -> None:
        self._cancelled = True

    def take_events(self) -> Sequence[object]:
        taken, self._events = self._events, []
        return taken

    def _take(self, found: Iterable[BusEvent]) -> None:
        for event in found:
            if self._left != 0 and self._filter.accepts(event):
                self._events.append(event)
                if self._left is not None:
                    self._left -= 1


def replay(
    watcher: Watcher,
    frames: Iterable[tuple[float, Frame]],
    on_event: Callable[[object], None],
    cancelled: Callable[[], bool] = lambda: False,
) -> None:
    """Feed recorded frames to a watcher at their times, without waiting.

    A time before the previous frame's counts as the same.
    """
    now = _AT_ONCE
    for at, frame in frames:
        now = max(now, at)
        _pass_time(watcher, now)
        if not watcher.done:
            watcher.receive(frame, now)
        for event in watcher.take_events():
            on_event(event)
        if watcher.done or cancelled():
            return
    _pass_time(watcher, now + _AFTER_LAST_S)
    for event in watcher.take_events():
        on_event(event)


def _pass_time(watcher: Watcher, until: float) -> None:
    """Tick the watcher for every deadline before `until`."""
    while (due := watcher.deadline()) is not None and due < until:
        watcher.tick(until if due == _AT_ONCE else due)


# -- the latest messages -------------------------------------------------------------------------


@dataclass
class MessageHistory:
    """Latest message of one kind, with count, rate and changes."""

    event: BusEvent
    count: int = 0
    first_at: float = 0.0
    changed_at: dict[str, float] = field(default_factory=dict)
    """Time of each field's last change."""
    times: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_SAMPLES))

    def changed(self, now: float) -> set[str]:
        """Names of the fields that changed recently."""
        return {name for name, at in self.changed_at.items() if now - at <= CHANGE_SHOWN_S}

    def rate_hz(self, now: float) -> float | None:
        """Messages per second over the last seconds; None before the second message."""
        while self.times and now - self.times[0] > RATE_WINDOW_S:
            self.times.popleft()
        if self.count < 2:
            return None
        watched_s = min(RATE_WINDOW_S, now - self.first_at)
        return len(self.times) / watched_s if watched_s > 0 else None


Key = tuple[int, str, int]


class MessageTable:
    """Latest events, in the order of CAN ids and commands.

    Undocumented and damaged messages have one line for each kind and CAN id, and foreign frames
    share one line: a babbling bus cannot fill the memory.
    """

    def __init__(self) -> None:
        self._lines: dict[Key, MessageHistory] = {}

    def __len__(self) -> int:
        return len(self._lines)

    def add(self, event: BusEvent) -> frozenset[str]:
        """Add an event; return the names of the fields that changed."""
        key = _key(event)
        line = self._lines.get(key)
        if line is None:
            line = self._lines[key] = MessageHistory(event, first_at=event.at)
            changed = frozenset[str]()
        else:
            before = {shown.name: shown.value for shown in line.event.fields}
            changed = frozenset(
                shown.name
                for shown in event.fields
                if shown.name not in before or before[shown.name] != shown.value
            )
        line.event = event
        line.count += 1
        line.times.append(event.at)
        line.changed_at.update(dict.fromkeys(changed, event.at))
        return changed

    def lines(self) -> Iterator[MessageHistory]:
        for key in sorted(self._lines):
            yield self._lines[key]


def _key(event: BusEvent) -> Key:
    if event.kind is Kind.MESSAGE and event.command is not None:
        return event.can_id, "", event.command
    if event.kind in (Kind.FOREIGN, Kind.ERROR_FRAME):
        return 1 << 32, event.kind.value, 0  # after everything else
    return event.can_id, event.kind.value, 0
