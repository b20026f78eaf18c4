"""Whether a unit is in the socket: something was heard of it lately, or nothing for long.

Units talk by themselves, announce themselves when their power comes, or are asked for their version
while the socket is idle. A target that can do none of it is not seen; then only a person knows.
"""

from __future__ import annotations

from collections.abc import Sequence

from flasher.protocol import catalogue
from flasher.protocol.frame import Frame
from flasher.protocol.wire import encode, split
from flasher.station.listening import BootWatcher
from flasher.station.messages import PresenceChanged
from flasher.station.unit_device import UnitDevice


class Presence:
    """Watches an idle bus; pure: frames and times come from outside."""

    def __init__(self, devices: Sequence[UnitDevice], *, silence_s: float, probe_s: float) -> None:
        self._silence_s = silence_s
        self._probe_s = probe_s
        self._watchers = [BootWatcher(device.loaded.target) for device in devices]
        self._requests = [device.version_request for device in devices]
        self._probed_at: float | None = None
        self._heard_at: float | None = None
        self._announcements = 0
        self.is_there: bool | None = None
        """None: not known yet."""
        self._began_at: float | None = None

    @property
    def sees_units(self) -> bool:
        """True when a unit that is there can be asked."""
        return any(self._requests)

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """One frame, of an idle bus or as a tap of a run."""
        for watcher in self._watchers:
            watcher(frame, sent=sent, now=now)
            if watcher.heard_at == now:
                self._heard_at = now

    def probe(self, now: float) -> list[Frame]:
        """What is to be sent now: a question to each target that can be asked, in its time."""
        if self._probed_at is not None and now - self._probed_at < self._probe_s:
            return []
        self._probed_at = now
        frames: list[Frame] = []
        for request in self._requests:
            if request is not None:
                message = catalogue.encode(request.item, request.content)
                frames += split(message.can_id, encode(message))
        return frames

    def go_on(self, now: float) -> None:
        """Nothing could be heard for a while: who was there counts as heard now."""
        if self.is_there:
            self._heard_at = now

    def change(self, now: float) -> PresenceChanged | None:
        """What changed since it was asked last."""
        if self._began_at is None:
            self._began_at = now
        heard = self._heard_at is not None and now - self._heard_at < self._silence_s
        is_soon = self.is_there is None and now - self._began_at < self._silence_s
        if heard == self.is_there or (is_soon and not heard):
            return None
        self.is_there = heard
        if not heard:
            return PresenceChanged(is_there=False, how=f"nothing heard for {self._silence_s:g} s")
        announced = sum(watcher.announcements for watcher in self._watchers)
        how = "boot version" if announced > self._announcements else "traffic"
        self._announcements = announced
        return PresenceChanged(is_there=True, how=how)
