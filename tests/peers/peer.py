"""What both scripted peers are: frames in, whole messages out, alarms, and a log of everything.

A peer has the methods that a simulated bus expects of an engine and takes its time from outside. It
reads a stream as plainly as the documents describe it: a message starts with a CAN frame (R19) and
has the size that its length says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from .wording import Frame, intact

_PARTIAL_TIMEOUT_S: Final = 0.1
_OVERHEAD_SIZE: Final = 9
"""Header, mode, length, CRC and tail."""


class Entry(NamedTuple):
    """One line of a peer's log: `kind` is received, sent or note."""

    at: float
    kind: str
    what: str
    number: int = 0


class _Outgoing(NamedTuple):
    not_before: float
    order: int
    what: str
    number: int
    frames: list[Frame]
    then: Callable[[float], None] | None


class Peer:
    """One end of the dialogue; subclasses say what to answer in `hear`."""

    def __init__(self, hears_id: int, says_id: int) -> None:
        self.log: list[Entry] = []
        self.hears_id = hears_id
        self.says_id = says_id
        self._partial = b""
        self._partial_at = 0.0
        self._outbox: list[_Outgoing] = []
        self._sent_frames = 0
        self._order = 0
        self._alarms: list[tuple[float, int, Callable[[float], None]]] = []
        self._taken = 0
        self._cancelled = False

    # -- what subclasses use ------------------------------------------------------------------

    def hear(self, mode: int, command: int, data: bytes, now: float) -> None:
        """An intact message arrived."""
        raise NotImplementedError

    def hear_damaged(self, wire: bytes, now: float) -> None:
        """A message with a wrong CRC or tail arrived."""
        raise NotImplementedError

    def heard(self, what: str, now: float, number: int = 0) -> None:
        self.log.append(Entry(now, "received", what, number))

    def note(self, what: str, now: float, number: int = 0) -> None:
        self.log.append(Entry(now, "note", what, number))

    def say(
        self,
        what: str,
        payloads: Sequence[bytes],
        *,
        not_before: float = 0.0,
        number: int = 0,
        can_id: int | None = None,
        then: Callable[[float], None] | None = None,
    ) -> None:
        """Send a message, not sooner than `not_before`; `then` is called when it has left."""
        used_id = self.says_id if can_id is None else can_id
        frames = [Frame(used_id, payload) for payload in payloads]
        self.say_frames(what, frames, not_before=not_before, number=number, then=then)

    def say_frames(
        self,
        what: str,
        frames: list[Frame],
        *,
        not_before: float = 0.0,
        number: int = 0,
        then: Callable[[float], None] | None = None,
    ) -> None:
        """The same with frames of any kind."""
        self._order += 1
        self._outbox.append(_Outgoing(not_before, self._order, what, number, frames, then))

    def hush(self) -> None:
        """Send nothing that is not begun."""
        self._outbox = self._outbox[:1] if self._sent_frames else []

    def alarm(self, at: float, action: Callable[[float], None]) -> None:
        """Call `action` at that time."""
        self._order += 1
        self._alarms.append((at, self._order, action))

    def clear_alarms(self) -> None:
        self._alarms.clear()

    def times(self, what: str, kind: str = "received") -> list[float]:
        """When a message was received (or sent), or a note made."""
        return [entry.at for entry in self.log if (entry.kind, entry.what) == (kind, what)]

    def numbers(self, what: str, kind: str = "received") -> list[int]:
        """The packet numbers of the messages of that name."""
        return [entry.number for entry in self.log if (entry.kind, entry.what) == (kind, what)]

    # -- what a bus uses ----------------------------------------------------------------------

    @property
    def done(self) -> bool:
        """True after `cancel`, when nothing is left to say."""
        return self._cancelled and not self._outbox

    def receive(self, frame: Any, now: float) -> None:
        """Take a frame: any tuple of id, data and three flags."""
        can_id, data, *flags = frame
        if can_id != self.hears_id or not data or any(flags[:3]):
            return
        if now - self._partial_at > _PARTIAL_TIMEOUT_S:
            self._partial = b""
        self._partial_at = now
        if not self._partial and bytes(data[:2]) != b"\x55\xaa":
            self.note("junk", now)
            return
        self._partial += bytes(data)
        if len(self._partial) < 4 or len(self._partial) < _OVERHEAD_SIZE + self._partial[3]:
            return
        # What follows the tail in the last frame is padding.
        wire = self._partial[: _OVERHEAD_SIZE + self._partial[3]]
        self._partial = b""
        if wire[3] >= 2 and wire[5] == wire[3] - 2 and intact(can_id, wire):
            self.hear(wire[2], int.from_bytes(wire[4:6], "big"), wire[6:-5], now)
        else:
            self.hear_damaged(wire, now)

    def tick(self, now: float) -> None:
        """Let the alarms ring that are due."""
        while due := sorted(alarm for alarm in self._alarms if alarm[0] <= now):
            self._alarms.remove(due[0])
            due[0][2](now)

    def deadline(self) -> float | None:
        """The next alarm, or when there is something to say."""
        times = [alarm[0] for alarm in self._alarms]
        times += [reported.not_before for reported in self._outbox]
        return min(times, default=None)

    def next_frame(self, now: float) -> Any:
        """The next frame, the same one until it was sent; None when nothing is due."""
        if not self._sent_frames:
            self._outbox.sort(key=lambda reported: (reported.not_before > now, reported.order))
            if not self._outbox or self._outbox[0].not_before > now:
                return None
        return self._outbox[0].frames[self._sent_frames]

    def frame_sent(self, now: float) -> None:
        """The bus took the frame."""
        reported = self._outbox[0]
        self._sent_frames += 1
        if self._sent_frames < len(reported.frames):
            return
        self._outbox.pop(0)
        self._sent_frames = 0
        self.log.append(Entry(now, "sent", reported.what, reported.number))
        if reported.then is not None:
            reported.then(now)

    def cancel(self, now: float) -> None:
        """End after the message that is begun."""
        self.note("cancelled", now)
        self._cancelled = True
        self.clear_alarms()
        self.hush()

    def take_events(self) -> Sequence[object]:
        """The lines of the log since the last call."""
        new = self.log[self._taken :]
        self._taken = len(self.log)
        return new
