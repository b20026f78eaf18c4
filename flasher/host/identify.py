"""Asks a device who it is and how it is before anything is written to it; a pure machine.

Asked are the version information (where the target has a query for it) and, of the battery, the
running information. A device that sits in its bootloader announces itself instead of answering:
that is heard, and ends the asking at once, so that the announcement can be answered in its window.
Before the first question it listens for a moment, for another tool may be at work (`guard` hears
it); after the version was told it listens a moment longer, for another device may tell another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.events import Phase, PhaseEntered
from flasher.host.identity import Seen
from flasher.host.options import UpgradeOptions
from flasher.host.query import Queries, Request
from flasher.image.plan import Plan
from flasher.protocol import catalogue
from flasher.protocol.contents import RunningInformation
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion, decode
from flasher.protocol.spec import Node, Target
from flasher.protocol.wire import Message, Reassembler

LISTEN_FIRST_S: Final = 0.1
"""How long every command that asks listens before it does. A tool that flashes sends more often,
unless it waits for the device."""
LISTENS_ON_S: Final = 0.1
"""How much later than the first device a second one is still heard."""


class Identify:
    """Listens, then asks until it knows what can be known; an engine. With `asks` False it listens
    only.
    """

    def __init__(self, plan: Plan, options: UpgradeOptions, *, asks: bool = True) -> None:
        timings = options.timings
        requests = _requests(plan.target, options) if asks else []
        self.asks = bool(requests)
        """False where nothing is asked: other targets than the battery have no query (5.2)."""
        self._queries = Queries(
            requests, bitrate_bps=plan.bitrate_bps, timings=timings, stop_at_silence=True
        )
        self._announcements = Reassembler(plan.target.answer_id, timings.inter_frame_timeout_s)
        version = options.version_request_for(plan.target)
        self._version_item = None if version is None else version.answer_item
        version_id = -1 if self._version_item is None else self._version_item.can_id
        self._versions = Reassembler(version_id, timings.inter_frame_timeout_s)
        self.heard: Message | None = None
        """The boot version that the device announced; None when it did not."""
        self.answers: list[Content] = []
        """Every version answer that came, each different one once: two are two devices."""
        self.cancelled = False
        self._events: list[object] = []
        self._begun = False
        self._listens_first_until: float | None = None
        self._listens_until: float | None = None

    @property
    def has_listened(self) -> bool:
        """True once it may ask."""
        return self._begun and self._listens_first_until is None

    @property
    def phase(self) -> Phase:
        """Where it stands."""
        return Phase.IDENTIFY if self.has_listened else Phase.LISTEN

    @property
    def seen(self) -> Seen:
        """What the device told."""
        answers = self._queries.answers
        running = next((each for each in answers if isinstance(each, RunningInformation)), None)
        version = next(
            (each for each in answers if each and not isinstance(each, RunningInformation)), None
        )
        return Seen(version, running)

    @property
    def done(self) -> bool:
        """True when nothing more is asked, nor listened for."""
        return self.has_listened and self._queries.done and self._listens_until is None

    def receive(self, frame: Frame, now: float) -> None:
        """A CAN frame arrived."""
        self._queries.receive(frame, now)
        if not frame.is_payload:
            return
        if frame.can_id == self._announcements.can_id:
            for found in self._announcements.feed(frame.data, now):
                if isinstance(found, Message) and isinstance(decode(found), BootVersion):
                    self.heard = found
                    self._listens_until = None
                    self._queries.cancel(now)
        if frame.can_id == self._versions.can_id:
            for found in self._versions.feed(frame.data, now):
                if isinstance(found, Message):
                    self._note_version(found, now)

    def _note_version(self, message: Message, now: float) -> None:
        item = self._version_item
        if item is None or (message.mode, message.command) != (item.mode, item.command):
            return
        answer = item.content.from_data(message.data)
        if not self.answers and self.heard is None and not self.cancelled:
            self._listens_until = now + LISTENS_ON_S
        if answer not in self.answers:
            self.answers.append(answer)

    def tick(self, now: float) -> None:
        """The time that `deadline` asked for has come."""
        if not self._begun:
            self._begun = True
            self._listens_first_until = now + LISTEN_FIRST_S
            self._events.append(PhaseEntered(Phase.LISTEN, 1))
        if self._listens_first_until is not None and now >= self._listens_first_until:
            self._listens_first_until = None
            if self.asks and not self._queries.done:
                self._events.append(PhaseEntered(Phase.IDENTIFY, 1))
        if self._listens_until is not None and now >= self._listens_until:
            self._listens_until = None
        if self.has_listened:
            self._queries.tick(now)

    def deadline(self) -> float | None:
        """When it next wants `tick`; at once before the beginning."""
        if not self.has_listened:
            return self._listens_first_until if self._begun else 0.0
        wanted = self._queries.deadline()
        if self._listens_until is None or wanted is None:
            return self._listens_until if wanted is None else wanted
        return min(wanted, self._listens_until)

    def next_frame(self, now: float) -> Frame | None:
        """The next frame to send; nothing while it listens first."""
        return self._queries.next_frame(now) if self.has_listened else None

    def frame_sent(self, now: float) -> None:
        """The adapter has accepted it."""
        self._queries.frame_sent(now)

    def cancel(self, now: float) -> None:
        """End at the next message boundary."""
        self.cancelled = self._begun = True
        self._listens_first_until = self._listens_until = None
        self._queries.cancel(now)

    def take_events(self) -> Sequence[object]:
        """What happened since the last call."""
        taken, self._events = [*self._events, *self._queries.take_events()], []
        return taken


def _requests(target: Target, options: UpgradeOptions) -> list[Request]:
    """What this target can be asked; none where the document gives no query (chapter 3)."""
    requests = []
    version = options.version_request_for(target)
    if version is not None:
        requests.append(version)
    requests += [
        Request(item)
        for item in catalogue.ITEMS
        if item.sender is Node.CDL and item.receiver is target.node
        if (answer := catalogue.answer_of(item)) and answer.content is RunningInformation
    ]
    return requests
