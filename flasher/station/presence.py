"""Whether a unit is in the socket, and which: what was heard of it lately.

Units talk by themselves, announce themselves when their power comes, or are asked for their version
while the socket is idle; the answer may name the unit's serial number. A target that can do none of
it is not seen; then only a person knows.
"""

from __future__ import annotations

from collections.abc import Sequence

from flasher.host.query import Request
from flasher.protocol import catalogue
from flasher.protocol.frame import Frame
from flasher.protocol.spec import data_size
from flasher.protocol.wire import Message, Reassembler, encode, split
from flasher.station.listening import BootWatcher
from flasher.station.messages import PresenceChanged
from flasher.station.unit_device import UnitDevice


class Presence:
    """Watches an idle bus; pure: frames and times come from outside."""

    def __init__(self, devices: Sequence[UnitDevice], *, silence_s: float, probe_s: float) -> None:
        self._silence_s = silence_s
        self._probe_s = probe_s
        self._watchers = [BootWatcher(device.loaded.target) for device in devices]
        self._answers: list[tuple[Request, Reassembler]] = []
        for device in devices:
            request = device.version_request
            if request is not None:
                limit_s = device.loaded.profile.timings.inter_frame_timeout_s
                answers = Reassembler(request.answer_item.can_id, limit_s)
                self._answers.append((request, answers))
        self._probed_at: float | None = None
        self._announcements = 0
        self.begin()

    @property
    def sees_units(self) -> bool:
        """True when a unit that is there can be asked."""
        return bool(self._answers)

    def begin(self) -> None:
        """Forget what was heard: after a run, or while nothing could be heard, all may differ."""
        self.is_there: bool | None = None
        """None: not known yet."""
        self._heard_at: float | None = None
        self._began_at: float | None = None
        self._serials: dict[int, str] = {}
        """What the targets said in their version answers, by the ids of these."""
        self._told_serial: str | None = None
        self._announcements = sum(watcher.announcements for watcher in self._watchers)

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

    @property
    def _serial(self) -> str | None:
        """What the unit says that it is; None before it has said anything."""
        return next(filter(None, self._serials.values()), "") if self._serials else None

    def probe(self, now: float) -> list[Frame]:
        """What is to be sent now: a question to each target that can be asked, in its time."""
        if self._probed_at is not None and now - self._probed_at < self._probe_s:
            return []
        self._probed_at = now
        frames: list[Frame] = []
        for request, _ in self._answers:
            message = catalogue.encode(request.item, request.content)
            frames += split(message.can_id, encode(message))
        return frames

    def change(self, now: float) -> PresenceChanged | None:
        """What changed since it was asked last."""
        if self._began_at is None:
            self._began_at = now
        heard = self._heard_at is not None and now - self._heard_at < self._silence_s
        is_soon = self.is_there is None and now - self._began_at < self._silence_s
        if is_soon and not heard:
            return None
        if heard == self.is_there and self._serial == self._told_serial:
            return None
        self.is_there = heard
        if not heard:
            self._serials, self._told_serial = {}, None
            return PresenceChanged(is_there=False, how=f"nothing heard for {self._silence_s:g} s")
        self._told_serial = self._serial
        announced = sum(watcher.announcements for watcher in self._watchers)
        how = "boot version" if announced > self._announcements else "traffic"
        self._announcements = announced
        return PresenceChanged(is_there=True, how=how, serial=self._serial)
