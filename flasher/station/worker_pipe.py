"""The pipe between the process of a socket and the station, as the process sees it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, Protocol

from flasher.station.messages import (
    Abort,
    Ask,
    Beat,
    Begin,
    Done,
    FromWorker,
    Intent,
    Note,
    Quit,
    Reply,
    ToWorker,
)
from flasher.station.records.model import WriteId
from flasher.station.run_model import JournalError, RunNote, StepReport

BEAT_S: Final = 0.5
"""How often it says that it is alive."""
IDLE_S: Final = 0.05
_LOOK_S: Final = 0.1
"""How often the pipe is looked at while a run goes on: between frames, it must cost nothing."""


class Channel(Protocol):
    """The pipe to the station; `multiprocessing.connection.Connection` is one."""

    def send(self, obj: Any, /) -> None:
        """Raises OSError when the station is gone."""
        ...

    def recv(self) -> Any:
        """Raises EOFError when the station is gone."""
        ...

    def poll(self, timeout: float = 0.0) -> bool:
        """True when there is something to receive, or the station is gone."""
        ...


class StationGoneError(Exception):
    """The pipe is broken: nobody would record what is done now."""


class StationPipe:
    """The pipe, with beats, and what arrived out of its time."""

    def __init__(self, channel: Channel, now: Callable[[], float]) -> None:
        self._channel = channel
        self._now = now
        self._looked_at = float("-inf")
        self._beat_at = float("-inf")
        self._begin: Begin | None = None
        self._replies: dict[int, Reply] = {}
        self.is_aborted = False
        self.is_over = False
        """The station is gone, or wants the process to end."""
        self.is_gone = False

    def send(self, message: FromWorker) -> None:
        """Tell the station. Raises StationGoneError."""
        try:
            self._channel.send(message)
        except (OSError, ValueError) as error:
            self.is_gone = self.is_over = True
            raise StationGoneError from error

    def tell(self, note: RunNote) -> None:
        """Tell what goes on; a dead station is noticed elsewhere, between two messages."""
        with suppress(StationGoneError):
            self.send(Note(note))

    def look(self, wait_s: float = 0.0) -> None:
        """Take in what the station said, and tell it that this process is alive."""
        now = self._now()
        self._looked_at = now
        if now - self._beat_at >= BEAT_S and not self.is_gone:
            self._beat_at = now
            with suppress(StationGoneError):
                self.send(Beat())
        try:
            while not self.is_gone and self._channel.poll(wait_s):
                wait_s = 0.0
                self._take(self._channel.recv())
        except (EOFError, OSError):
            self.is_gone = self.is_over = True

    def is_stopped(self) -> bool:
        """Asked between frames: a person aborted, or the station is gone."""
        if self._now() - self._looked_at >= _LOOK_S:
            self.look()
        return self.is_aborted or self.is_over

    def take_begin(self) -> Begin | None:
        """The order to run a unit, once."""
        begin, self._begin = self._begin, None
        if begin is not None:
            self.is_aborted = False
        return begin

    def await_reply(self, number: int, limit_s: float) -> Reply:
        """The reply to an `Ask`. Raises StationGoneError, JournalError after the limit."""
        give_up_at = self._now() + limit_s
        while number not in self._replies:
            if self.is_gone:
                raise StationGoneError
            if self._now() >= give_up_at:
                raise JournalError(f"The station did not save within {limit_s:g} s.")
            self.look(IDLE_S)
        return self._replies.pop(number)

    def _take(self, message: ToWorker) -> None:
        match message:
            case Begin():
                self._begin = message
            case Reply():
                self._replies[message.number] = message
            case Abort():
                self.is_aborted = True
            case Quit():
                self.is_over = True


class PipeJournal:
    """A `Journal` kept by the station."""

    def __init__(self, pipe: StationPipe, limit_s: float) -> None:
        self._pipe = pipe
        self._limit_s = limit_s
        self._number = 0

    def intent(self, target: str, what: str, value: str) -> WriteId:
        """Before an act that cannot be taken back."""
        write_id = self._ask(Intent(target, what, value)).write_id
        if write_id is None:
            raise JournalError("The station did not say what it saved.")
        return write_id

    def verified(self, write_id: WriteId, read_back: str | None) -> None:
        """After it."""
        self._ask(Done(write_id, read_back))

    def step(self, report: StepReport) -> None:
        """A try of a step ended."""
        self._ask(report)

    def _ask(self, what: Intent | Done | StepReport) -> Reply:
        self._number += 1
        self._pipe.send(Ask(self._number, what))
        reply = self._pipe.await_reply(self._number, self._limit_s)
        if reply.error:
            raise JournalError(reply.error)
        return reply
