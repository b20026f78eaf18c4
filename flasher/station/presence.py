"""What is heard on a bus: announcements of a bootloader, and whether a unit is in the socket.

Units talk by themselves, announce themselves when their power comes, or are asked for their version
while the socket is idle; the answer may name the unit's serial number. A target that can do none of
it is not seen; then only a person knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.host.query import Request
from flasher.protocol import catalogue
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion, decode
from flasher.protocol.spec import Target, data_size
from flasher.protocol.text import printable
from flasher.protocol.timing import DEFAULT_TIMINGS, Timings
from flasher.protocol.wire import Message, Reassembler, encode, split
from flasher.settings.profile import sent_ids
from flasher.station.messages import PresenceChanged
from flasher.station.recipe_file import LoadedTarget

SILENCE_S: Final = 2.0
"""A unit of which nothing was heard for so long is out."""
PROBE_S: Final = 0.5
"""How often a unit is asked whether it is there."""


class BootWatcher:
    """A driver's tap that counts the announcements of a device's bootloader."""

    def __init__(self, target: Target, timings: Timings = DEFAULT_TIMINGS) -> None:
        self._answers = Reassembler(target.answer_id, timings.inter_frame_timeout_s)
        self._own_ids = frozenset(sent_ids(target))
        self.announcements = 0
        self.version = ""
        """As announced last, escaped."""
        self.heard_at: float | None = None
        """When the device last said anything."""
        self.announced_at: float | None = None

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent or not frame.is_payload or frame.can_id not in self._own_ids:
            return
        self.heard_at = now
        if frame.can_id != self._answers.can_id:
            return
        for found in self._answers.feed(frame.data, now):
            row = decode(found) if isinstance(found, Message) else None
            if isinstance(row, BootVersion):
                self.announcements += 1
                self.announced_at = now
                self.version = printable(row.version)


class Presence:
    """Watches an idle bus; pure: frames and times come from outside."""

    def __init__(self, targets: Sequence[LoadedTarget]) -> None:
        self._watchers = [BootWatcher(each.target) for each in targets]
        self._answers: list[tuple[Request, Reassembler]] = []
        for each in targets:
            request = each.profile.upgrade_options().version_request_for(each.target)
            if request is not None:
                limit_s = each.profile.timings.inter_frame_timeout_s
                answers = Reassembler(request.answer_item.can_id, limit_s)
                self._answers.append((request, answers))
        self._probed_at: float | None = None
        self.begin()

    @property
    def sees_units(self) -> bool:
        """True when a unit that is there can be asked."""
        return bool(self._answers)

    @property
    def _announced(self) -> int:
        return sum(watcher.announcements for watcher in self._watchers)

    def begin(self) -> None:
        """Forget what was heard: after a run, or while nothing could be heard, all may differ."""
        self.is_there: bool | None = None
        """None: not known yet."""
        self._heard_at: float | None = None
        self._began_at: float | None = None
        self._serials: dict[int, str] = {}
        """What the targets said in their version answers, by the ids of these."""
        self._told_serial: str | None = None
        self._announcements = self._announced

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """One frame of an idle bus."""
        for watcher in self._watchers:
            watcher(frame, sent=sent, now=now)
            if watcher.heard_at == now:
                self._heard_at = now
        if sent or not frame.is_payload:
            return
        for request, answers in self._answers:
            if frame.can_id == answers.can_id:
                for found in answers.feed(frame.data, now):
                    if isinstance(found, Message):
                        self._take(request, found)

    def _take(self, request: Request, message: Message) -> None:
        """A message that may answer the question for the version."""
        item = request.answer_item
        is_answer = (message.mode, message.command) == (item.mode, item.command)
        if is_answer and data_size(message.command) == item.content.SIZE_BYTES:
            version = item.content.from_data(message.data)
            self._serials[item.can_id] = str(getattr(version, "serial_number", ""))

    def probe(self, now: float) -> list[Frame]:
        """What is to be sent now: a question to each target that can be asked, in its time."""
        if self._probed_at is not None and now - self._probed_at < PROBE_S:
            return []
        self._probed_at = now
        frames: list[Frame] = []
        for request, _ in self._answers:
            message = catalogue.encode(request.item, request.content)
            frames += split(message.can_id, encode(message))
        return frames

    def change(self, now: float) -> PresenceChanged | None:
        """The change since the last call; None without one."""
        if self._began_at is None:
            self._began_at = now
        heard = self._heard_at is not None and now - self._heard_at < SILENCE_S
        is_soon = self.is_there is None and now - self._began_at < SILENCE_S
        if is_soon and not heard:
            return None
        # What the unit says that it is; None before it has said anything.
        serial = next(filter(None, self._serials.values()), "") if self._serials else None
        if heard == self.is_there and serial == self._told_serial:
            return None
        self.is_there = heard
        if not heard:
            self._serials, self._told_serial = {}, None
            return PresenceChanged(is_there=False, how=f"nothing heard for {SILENCE_S:g} s")
        how = "boot version" if self._announced > self._announcements else "traffic"
        self._told_serial, self._announcements = serial, self._announced
        return PresenceChanged(is_there=True, how=how, serial=serial)
