"""Detects whether a unit is in the socket, and when another one may have been put in.

Units send messages on their own, announce themselves at power-up, or answer version requests while
the socket is idle; the answer may contain the serial number. Others are not detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from flasher.protocol import catalogue
from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    BootVersion,
    Complete,
    GeneralFeedbackMessage,
    RequestTransfer,
    decode,
)
from flasher.protocol.spec import COMMAND_SIZE, HEADER, Command, Mode, data_size
from flasher.protocol.text import printable
from flasher.protocol.wire import Message, Reassembler, encode, split
from flasher.settings.profile import Profile, sent_ids
from flasher.station.messages import PresenceChanged

BLIND_S: Final = 0.15
"""Seconds of real time between two polls of the bus from which it counts as unobserved. Polls are
0.1 s apart. It must stay below `PAUSE_S`, with the frames discarded before the next poll."""
SILENCE_S: Final = 2.0
"""Silence after which a unit counts as removed."""
PROBE_S: Final = 0.5
"""Interval between requests to a unit."""
PAUSE_S: Final = 0.25
"""Announcements of one power-up are less than this apart."""
_ANNOUNCEMENT: Final = (
    HEADER
    + bytes((Mode.REPORT, COMMAND_SIZE + data_size(Command.BOOT_VERSION)))
    + Command.BOOT_VERSION.to_bytes(COMMAND_SIZE, "big")
)
"""First bytes of the first frame of an announcement."""
BACKLOG_S: Final = 0.1
"""Frames read this soon after unobserved time may have been sent in it."""
_RHYTHM_S: Final = 1.0
"""Maximum interval after which an equal pause of a repeating bootloader occurs again."""
_ALIKE: Final = 1.2
"""Factor within which two pauses count as equal."""
_RECURRENCES: Final = 2
"""Units that are exchanged one after another make equal pauses once, but hardly this often."""


class TargetWatcher:
    """Driver tap that records a device's announcements, frames and version answers."""

    def __init__(self, profile: Profile) -> None:
        timings, target = profile.timings, profile.target
        limit_s = timings.inter_frame_timeout_s
        self._boot = Reassembler(target.answer_id, limit_s)
        self._own_ids = frozenset(sent_ids(target))
        self.request = profile.upgrade_options().version_request_for(target)
        """Version request for this target; None if unknown."""
        item = None if self.request is None else self.request.answer_item
        self._item = item
        self._answers = None if item is None else Reassembler(item.can_id, limit_s)
        self.announcements = self.begun_announcements = 0
        """Numbers of announcements of its bootloader: complete ones, and first frames."""
        self.version = ""
        """The last announced boot version, escaped."""
        self.received_at: float | None = None
        """Time of the last frame of the device."""
        self.has_sent_message = False
        """A complete message of its bootloader, or any frame of its application, was received."""
        self.announced_at: float | None = None
        self.transfer_requests = 0
        """Number of transfer requests from its bootloader."""
        self.confirmations = 0
        """Number of confirmed writes and resets."""
        self.completions = 0
        """Number of images that its bootloader confirmed as complete."""
        self.answers = 0
        """Number of version answers, to any tool."""
        self.answer: Content | None = None
        self.power_ups = 0
        """Number of times that another unit may have been put in: announcements after a pause or
        after frames of the application, or frames of the application after unlimited
        announcements."""
        self.has_application = False
        """The application has sent a frame since the last announcement."""
        self.application_frames = 0
        self._announcing_on_s = timings.announcing_on_s
        self._announcing_s = 0.0
        """Duration of the present burst of announcements."""
        self._burst = self._recurrences = 0
        """Announcements since the last pause, and how often an equal pause has occurred again."""
        self._paused = (0.0, 0)
        """The last pause between announcements (0 before the first), and the number of
        announcements in the burst before it."""
        self._paused_at = float("-inf")
        """Time at which that pause ended."""
        self._is_pace_unknown = False
        """Before the last pause there was only one announcement."""
        self._missed_s = 0.0
        """Unobserved time since the last announcement."""
        self.serial: str | None = None
        """Serial number in its last answer, "" without one; None: no answer yet."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        if sent or not frame.is_payload:
            return
        if frame.can_id in self._own_ids:
            self.received_at = now
            if frame.can_id != self._boot.can_id:
                self._process_application()
                self.has_sent_message = True
        if frame.can_id == self._boot.can_id:
            self.begun_announcements += frame.data.startswith(_ANNOUNCEMENT)
            for message in self._boot.feed(frame.data, now):
                if isinstance(message, Message):
                    self._process_bootloader(message, now)
        if self._answers is not None and frame.can_id == self._answers.can_id:
            for message in self._answers.feed(frame.data, now):
                if isinstance(message, Message):
                    self._take(message)

    @property
    def is_in_bootloader(self) -> bool:
        """True if the device has sent only announcements since the first one."""
        return self.announcements > 0 and not self.has_application

    @property
    def is_known(self) -> bool:
        """True if the device has announced itself or its application has sent a frame."""
        return self.announcements > 0 or self.has_application

    def _process_bootloader(self, message: Message, now: float) -> None:
        self.has_sent_message = True
        match decode(message):
            case BootVersion(version=version):
                self._announced(now)
                self.version = printable(version)
            case RequestTransfer():
                self.transfer_requests += 1
            case GeneralFeedbackMessage():
                self.confirmations += 1
            case Complete():
                self.completions += 1

    def _process_application(self) -> None:
        if self.is_in_bootloader and self._announcing_s > self._announcing_on_s:
            self._powered_up()  # a device without an application does not start one
        self.has_application = True
        self.application_frames += 1

    def miss(self, missed_s: float) -> None:
        """Add unobserved time: it counts neither as a pause of the device nor as silence."""
        self._missed_s += missed_s
        self._paused_at += missed_s
        if self.received_at is not None:
            self.received_at += missed_s

    def _announced(self, now: float) -> None:
        pause_s = float("inf")
        if self.announced_at is not None:
            pause_s = now - self.announced_at - self._missed_s
        self._missed_s = 0.0
        is_pause = pause_s > PAUSE_S
        is_rhythm = is_pause and self._recurs(now, pause_s)
        # After one announcement, a pause may be the pace of this bootloader: the next one shows it.
        is_first_pause = self._announcing_s == 0.0 and pause_s < _RHYTHM_S
        is_sooner = self._is_pace_unknown and not is_rhythm
        if (
            not self.is_in_bootloader
            or is_sooner
            or (is_pause and not is_rhythm and not is_first_pause)
        ):
            self._powered_up()
            is_first_pause = False
        else:
            self._announcing_s += pause_s
        self._is_pace_unknown = is_pause and is_first_pause
        if is_pause:
            self._paused, self._paused_at, self._burst = (pause_s, self._burst), now, 0
        self._burst += 1
        self.announcements += 1
        self.announced_at, self.has_application = now, False

    def _recurs(self, now: float, pause_s: float) -> bool:
        """True for a pause of a bootloader that keeps announcing itself: at once if one
        announcement is between two equal pauses, else if such a burst occurs again.
        """
        before_s, burst = self._paused
        is_alike = (
            self.is_in_bootloader
            and before_s / _ALIKE < pause_s < min(before_s * _ALIKE, SILENCE_S)
            and now - pause_s - self._paused_at < _RHYTHM_S
            and self._burst == burst
        )
        self._recurrences = self._recurrences + 1 if is_alike else 0
        return self._recurrences >= (1 if self._burst == 1 else _RECURRENCES)

    def _powered_up(self) -> None:
        """Discard earlier answers, which may be of another unit."""
        self.power_ups += 1
        self._announcing_s = 0.0
        self.serial = self.answer = None

    def _take(self, message: Message) -> None:
        """Process a message that may be the version answer."""
        item = self._item
        if item is None or (message.mode, message.command) != (item.mode, item.command):
            return
        if data_size(message.command) == item.content.SIZE_BYTES:
            self.answer = item.content.from_data(message.data)
            self.answers += 1
            self.serial = str(getattr(self.answer, "serial_number", ""))


class Presence:
    """Presence of a unit on an idle bus, without I/O: frames and times are arguments."""

    def __init__(self, profiles: Sequence[Profile]) -> None:
        self._profiles = profiles
        self._probed_at: float | None = None
        self._number = 0
        """Number of the last change."""
        self._missed = (0.0, float("-inf"))
        """Begin and end of the last unobserved time."""
        self.begin()
        self._requests = [each.request for each in self.watchers if each.request is not None]

    @property
    def sees_units(self) -> bool:
        """True if a present unit can be detected by a request."""
        return bool(self._requests)

    @property
    def _power_ups(self) -> int:
        return sum(watcher.power_ups for watcher in self.watchers)

    def _is_in_bootloader(self, now: float) -> bool:
        """True if only announcements are received."""
        return all(
            watcher.is_in_bootloader
            for watcher in self.watchers
            if watcher.received_at is not None and now - watcher.received_at < SILENCE_S
        )

    def begin(self) -> None:
        """Reset after a run or unobserved time, when everything may have changed."""
        self.is_there: bool | None = None
        """None while unknown."""
        self._received_at: float | None = None
        self._began_at: float | None = None
        self._reported_in_bootloader = False
        self.exchanged_number = self.missed_number = 0
        """Number of the last change after which another unit may be present, and of the last
        change after unobserved time."""
        self._forget_unit()

    def _forget_unit(self) -> None:
        self.watchers = [TargetWatcher(each) for each in self._profiles]
        """A watcher for each target of the present unit."""
        self._reported_serial: str | None = None
        self._reported_power_ups = 0
        self._was_missed = False
        """Another unit may have been put in during unobserved time."""
        self._resumed_at = float("-inf")
        """End of the last unobserved time in which a unit could be exchanged."""
        self._has_backlog = False
        """Frames that were received, or wait, may have been sent in that time."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Process a frame of an idle bus."""
        for watcher in self.watchers:
            watcher(frame, sent=sent, now=now)
            # The rest of an announcement that began earlier does not count.
            if watcher.received_at == now and watcher.has_sent_message:
                self._received_at = now
                self._has_backlog |= now - self._resumed_at <= BACKLOG_S

    def miss(self, missed_s: float, now: float) -> None:
        """Add unobserved time, up to now."""
        if missed_s > PAUSE_S:
            self._resumed_at, self._has_backlog = now, True
            self._missed = (now - missed_s, now)
        for watcher in self.watchers:
            watcher.miss(missed_s)
        if self._received_at is not None:
            self._received_at += missed_s
        if self._began_at is not None:
            self._began_at += missed_s

    def probe(self, now: float) -> list[Frame]:
        """Frames to send now: a version request to each target that has one, when due."""
        if self._probed_at is not None and now - self._probed_at < PROBE_S:
            return []
        self._probed_at = now
        frames: list[Frame] = []
        for request in self._requests:
            message = catalogue.encode(request.item, request.content)
            frames += split(message.can_id, encode(message))
        return frames

    def change(self, now: float) -> PresenceChanged | None:
        """Change since the last call; None without one."""
        if self._began_at is None:
            self._began_at = now
        is_present = self._received_at is not None and now - self._received_at < SILENCE_S
        in_bootloader = is_present and self._is_in_bootloader(now)
        if self._has_backlog:
            self._was_missed |= in_bootloader
            self._has_backlog = False
        is_soon = self.is_there is None and now - self._began_at < SILENCE_S
        if is_soon and not is_present:
            return None
        is_power_up = is_present and self._power_ups > self._reported_power_ups
        # The serial number that the unit reports; None before its first answer.
        serials = [each.serial for each in self.watchers if each.serial is not None]
        serial = next(filter(None, serials), "") if serials else None
        reported = (self.is_there, self._reported_serial, self._reported_in_bootloader)
        # Report the unit first; the next call reports that it may be another one.
        was_missed = is_present and self._was_missed and self.is_there is True
        self._was_missed &= is_present and not was_missed
        if (is_present, serial, in_bootloader) == reported and not (is_power_up or was_missed):
            return None
        self._number += 1
        is_other = None not in (self._reported_serial, serial) and self._reported_serial != serial
        if self.is_there and (is_power_up or is_other or not is_present):
            self.exchanged_number = self._number
        if was_missed or self._was_missed:  # a run may begin before the next call
            self.missed_number = self._number
        self.is_there, self._reported_in_bootloader = is_present, in_bootloader
        self._reported_power_ups = self._power_ups
        if not is_present:
            self._forget_unit()
            return PresenceChanged(is_there=False, number=self._number)
        self._reported_serial = serial
        missed_since, missed_until = self._missed
        return PresenceChanged(
            is_there=True,
            unobserved_s=now - missed_since if now - missed_until <= SILENCE_S else 0.0,
            how="boot version" if is_power_up or in_bootloader else "traffic",
            serial=serial,
            is_power_up=is_power_up,
            was_missed=was_missed,
            is_in_bootloader=in_bootloader,
            number=self._number,
        )
