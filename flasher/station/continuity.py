"""Detects that the unit in a socket may have been exchanged or lost power since identification.

A `Continuity` is a driver's tap for one target of a run; it does no I/O. `lost` is the evidence:

- its bootloader announces itself, although the run has neither reset it, nor ended a transfer, nor
switched its power (R28); or after a silence in which it has not confirmed the reset or its image;
- it announces itself in the middle of a transfer, or an application answers, which is erased then;
- before the run has sent anything that restarts it, the watcher counts another power-up of a device
that it knew, also in the time before the run; or the first one of a device that was silent for
some time when the run began;
- a version answer, to any tool, or an announced boot version, differs from the first one in a field
that the run has not written.

An application that stops answering is not detected here, but by its next request.

Not evidence, because one unit may cause it: announcements of one burst, however many; another burst
after every reset that was sent and not ignored, as the first one may have come too late; a burst so
soon after a reset that no unit can have been exchanged, although the confirmation was lost; a burst
after the end of a transfer, or none; a restart of devices that the battery supplies while the
battery restarts. Time in which this computer did not read the bus does not count; if another unit
could have been connected in it unnoticed, `unobserved` reports it.
"""

from __future__ import annotations

from math import inf
from typing import Final

from flasher.protocol.fields import Content
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    BMS,
    COMMAND_SIZE,
    HEADER,
    MODE_SIZE,
    PREFIX_SIZE,
    Command,
    Mode,
)
from flasher.protocol.wire import Message, Reassembler
from flasher.station.presence import BACKLOG_S, TargetWatcher
from flasher.station.recipe_file import LoadedTarget

_FIELDS: Final = ("model", "serial_number", "hardware_version")
"""Fields of a version answer that must not change; the firmware version may."""
_WRITE: Final = HEADER + Mode.WRITE.to_bytes(MODE_SIZE, "big")
"""First bytes of a message that may restart a device."""
_SPACINGS_OF_QUIET: Final = 6
_QUIET_MIN_S: Final = 0.3
_PACE_TOLERANCE: Final = 1.5
_EXCHANGE_S: Final = 0.25
"""A unit cannot be exchanged within so short a silence."""
_ANNOUNCED_ON: Final = 2
"""Announcements after a reset, without a pause, from which a bootloader is regarded as ignoring it
(R18): one may have been queued."""
_UNOBSERVED: Final = (
    "This computer did not listen {}: another unit could have been connected, and would"
    " announce itself in the same way."
)

_SUSPENDED: Final = (
    "This computer was suspended for {}: another unit could have been connected meanwhile."
)


class Continuity:
    """Watches the traffic of one target for evidence of an exchange since it was identified.

    `blind_s`: a longer time between two calls is unobserved.
    """

    def __init__(
        self,
        loaded: LoadedTarget,
        watcher: TargetWatcher,
        *,
        blind_s: float,
        may_restart: bool = False,
        was_exchanged: bool = False,
        was_missed: bool = False,
        was_silent: bool = False,
    ) -> None:
        timings = loaded.profile.timings
        self.watcher = watcher
        self.lost = ""
        """Evidence of an exchange, as a sentence; "" without any."""
        self.unobserved = (
            _UNOBSERVED.format("before the run began") if was_missed and not may_restart else ""
        )
        """Unobserved time in which a unit could have been exchanged, as a sentence, or ""."""
        self.is_running = False
        """The application has answered since the last restart."""
        self.has_update_command = False
        """An update command was sent, and no application has answered since."""
        self.power_cycles = 0
        self.may_restart, self._was_silent = may_restart, was_silent and not may_restart
        """The recipe allows restarts (`AfterRestart.CONTINUE`); the bus was silent before the run,
        so that any start is evidence."""
        self._name = loaded.name
        self._reset_command = loaded.profile.reset_command
        self._sent = Reassembler(loaded.target.request_id, timings.inter_frame_timeout_s)
        # The battery supplies the others: when it restarts, they may.
        self._supply_id = None if loaded.target is BMS else BMS.request_id
        self._supplied_until = -inf
        self._timings = timings
        self.quiet_s = max(_QUIET_MIN_S, _SPACINGS_OF_QUIET * timings.boot_version_spacing_s)
        """Time without an announcement after which the burst (4 of them, 50 ms apart) is over."""
        self._gap_s = self.quiet_s
        self._longest_pause_s = 0.0
        """Longest pause between two announcements before identification."""
        self._blind_s, self._missed_s = blind_s, 0.0
        """Unobserved time since the last announcement, or since a reset without one."""
        self._now, self._listened_s, self._reset_s = -inf, 0.0, -inf
        """Time of the last call, observed time up to then, and observed time up to the last reset.
        """
        self._announced_s: float | None = None
        """Observed time up to the last announcement of the current burst; None: no burst."""
        self._burst_until = -inf
        """Time until which a burst may begin that the run has caused."""
        self._received_s, self._missed_silent_s, self._resumed_s = 0.0, 0.0, -inf
        """Observed time up to the last frame of the unit; unobserved time since then (frames
        that had waited to be read do not end it); observed time up to its end.
        """
        self._announced_on = 0
        """Announcements of the current burst since the last reset."""
        self._awaits_confirmation = self._awaits_complete = self._awaits_application = False
        """Awaited: the confirmation of a reset; that of the end of the transfer; a frame of the
        application then."""
        self._requested_s: float | None = None
        """Observed time up to the request of the current transfer; None: no transfer."""
        self._is_identified = False
        self._has_acted = False
        """The run has sent a message that may restart the unit, or switched its power."""
        self._boot_version = ""
        self._known: dict[str, frozenset[str]] = {}
        """Valid values of each identity field; empty before the first answer."""
        if watcher.answer is not None:
            self._compare(watcher.answer)
        if was_exchanged:
            self._lose("was exchanged, or had no power, before the run began")

    # -- reports of the run -----------------------------------------------------------------------

    def begin(self, content: Content | None) -> None:
        """Note the first version answer of the unit; None: no answer. It must remain from now on; a
        unit without a version query, from the first update command.
        """
        if self._is_identified or self.watcher.request is None:
            return
        self._stay()
        if content is not None:
            self._compare(content)
            self.settle()

    @property
    def has_answered(self) -> bool:
        """True if the unit has sent a version answer, before the run or in it."""
        return bool(self._known)

    def _stay(self) -> None:
        self._is_identified = True
        self._boot_version = self.watcher.version
        # A bootloader without an application may announce itself at a pace of its own.
        self._gap_s = max(self.quiet_s, _PACE_TOLERANCE * self._longest_pause_s)

    def settle(self) -> None:
        """Note that its application has answered the run, so it has started again."""
        self.is_running, self.has_update_command = True, False
        self._awaits_confirmation = self._awaits_complete = False
        self._requested_s = None
        self._burst_until, self._announced_s = -inf, None

    def complete(self) -> None:
        """Note a complete image on a target without a version query, which may now start."""
        self.has_update_command = False
        if self._awaits_application:
            self._burst_until = self._now + self._timings.application_start_timeout_s

    def cycle_power(self) -> None:
        """Note that the run switches its power off and on."""
        self.power_cycles += 1
        self._restart()
        self._announced_on = _ANNOUNCED_ON  # the power may go a moment later

    def allow(self, content: Content) -> None:
        """Note that the run is about to write these values: old and new ones are valid."""
        for name, text in _identity(content).items():
            if name in self._known:
                self._known[name] |= {text}

    def wrote(self, content: Content) -> None:
        """Note that these values were written and read back: only the new ones are valid."""
        for name, text in _identity(content).items():
            if name in self._known:
                self._known[name] = frozenset({text})

    # -- traffic ----------------------------------------------------------------------------------

    def listened(self, now: float) -> None:
        """Note that the bus was observed up to now; called repeatedly during a run."""
        passed_s = now - self._now
        if passed_s <= self._blind_s:
            self._listened_s += passed_s
        elif passed_s < inf:
            self._miss(passed_s)
        self._now = now

    def was_suspended(self, missed_s: float) -> None:
        """Note that this computer was suspended: a restart of the unit was not received."""
        self.unobserved = self.unobserved or _SUSPENDED.format(f"{missed_s:.0f} s")

    def was_away(self, away_s: float) -> None:
        """Note that the adapter was away for `away_s` up to now."""
        self._listened_s -= away_s
        self._miss(away_s)

    def _miss(self, missed_s: float) -> None:
        self._missed_s += missed_s
        self._missed_silent_s += missed_s
        self._resumed_s = self._listened_s
        self.watcher.miss(missed_s)

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        self.listened(now)
        if sent:
            self._note_sent(frame, now)
            return
        watcher = self.watcher
        requests, announcements = watcher.transfer_requests, watcher.announcements
        begun = watcher.begun_announcements
        answers, confirmations = watcher.answers, watcher.confirmations
        was_heard, power_ups = watcher.is_known, watcher.power_ups
        completions, application_frames = watcher.completions, watcher.application_frames
        watcher(frame, sent=False, now=now)
        if watcher.power_ups > power_ups and (was_heard or self._was_silent):
            self._take_power_up(now, was_heard=was_heard)
        missed_unheard_s = self._missed_silent_s
        has_returned = watcher.received_at == now and self._returns()
        if watcher.confirmations > confirmations and self._awaits_confirmation:
            self.is_running = self._awaits_confirmation = False
        if watcher.confirmations > confirmations and (self._announced_s or 0.0) <= self._reset_s:
            # Its application runs: the burst before the reset is over.
            self._announced_s = None
        self._awaits_complete = self._awaits_complete and watcher.completions == completions
        if watcher.transfer_requests > requests and self.has_update_command:
            self._requested_s, self._burst_until = self._listened_s, -inf
        if watcher.application_frames > application_frames and self._awaits_application:
            # The new application runs: the burst after the end of the transfer is over.
            self._awaits_application, self._burst_until = False, -inf
        if watcher.begun_announcements > begun:  # it may be pulled before the last frame
            if self._awaits_confirmation or self._awaits_complete:
                # The unit may have been exchanged before the command reached it.
                self._missed_s = max(self._missed_s, missed_unheard_s)
            self._take_announcement(now, has_returned=has_returned)
        if watcher.announcements > announcements and self._is_identified:
            self._compare_boot_version()
        if watcher.answers > answers and watcher.answer is not None and self._is_identified:
            if self._requested_s is not None and not self.may_restart:
                self._lose("runs an application in the middle of its transfer")
            self._compare(watcher.answer)

    def _returns(self) -> bool:
        """Process a frame of the unit. Returns True after a silence that allows an exchange."""
        before, self._received_s = self._received_s, self._listened_s
        if self._listened_s - self._resumed_s > BACKLOG_S:
            self._missed_silent_s = 0.0
        return self._listened_s - before > _EXCHANGE_S

    def _note_sent(self, frame: Frame, now: float) -> None:
        if frame.can_id == self._supply_id and frame.data.startswith(_WRITE):
            command = int.from_bytes(frame.data[PREFIX_SIZE : PREFIX_SIZE + COMMAND_SIZE], "big")
            if command != Command.PACKET:
                is_long = command == Command.UPDATE
                self._supplied_until = (
                    inf if is_long else now + self._timings.application_start_timeout_s
                )
        if frame.can_id != self._sent.can_id:
            return
        for message in self._sent.feed(frame.data, now):
            if not isinstance(message, Message) or message.mode != Mode.WRITE:
                continue
            # An application that does not answer requests confirms its first reset too.
            may_be_running = self.watcher.request is not None and not self.is_announcing
            awaits = self._awaits_confirmation or (may_be_running and not self._has_acted)
            self._has_acted = True
            is_reset = message.command in (self._reset_command, Command.RESET)
            self._reset_s = self._listened_s if is_reset else self._reset_s
            self._announced_on = 0 if is_reset else self._announced_on
            if is_reset and not self.is_announcing:
                self._missed_s = 0.0
            if message.command == Command.RESET and self.is_running:
                # Without a confirmation it keeps running.
                self._awaits_confirmation = True
                self._burst_until, self._requested_s = inf, None
            elif is_reset:
                self._restart()
                self._awaits_confirmation = awaits and message.command == Command.RESET
            elif message.command == Command.UPDATE:
                if not self._is_identified:
                    self._stay()
                self.is_running = self._awaits_confirmation = self._awaits_complete = False
                self.has_update_command, self._awaits_application = True, False
                # A burst that an earlier reset has caused may still come.
                self._requested_s = None
            elif message.command == Command.END_OF_TRANSFER:
                self._end_transfer()

    @property
    def is_announcing(self) -> bool:
        """True while the bootloader announces itself, at its own pace."""
        return self._pause_s < self._gap_s

    @property
    def _pause_s(self) -> float:
        """Time since the last announcement of a burst that may continue."""
        return inf if self._announced_s is None else self._listened_s - self._announced_s

    def _end_transfer(self) -> None:
        if self._requested_s is not None:
            # The burst before the transfer is over, and the unit has stayed: it took the transfer.
            self._requested_s = self._announced_s = None
            self._missed_s = 0.0
        self._burst_until, self._awaits_complete, self._awaits_application = inf, True, True
        self._announced_on = _ANNOUNCED_ON

    def _restart(self) -> None:
        self.is_running = self._awaits_confirmation = self._awaits_complete = False
        self._has_acted, self._awaits_application = True, False
        self._requested_s = None
        # Without a time limit: only an answer of the application shows that no burst will follow.
        self._burst_until = inf

    def _take_power_up(self, now: float, *, was_heard: bool) -> None:
        """Check a power-up of a device that was known or silent before."""
        if self._has_acted or now <= self._supplied_until:
            return
        # A socket holds its unit from the identification on; before, another one may be put in.
        if self.may_restart and (self._is_identified or self.watcher.request is None):
            return
        if not was_heard:
            self._lose("was silent when the run began, and announces its bootloader now")
        elif self.watcher.is_in_bootloader:
            self._lose("announced its bootloader although this run had not restarted it")
        else:
            self._lose("only announced its bootloader before, and runs an application now")

    def _take_announcement(self, now: float, *, has_returned: bool) -> None:
        """Check an announcement; `has_returned`: it follows a silence that allows an exchange."""
        since_s = self._pause_s
        in_burst, self._announced_s = since_s < self._gap_s, self._listened_s
        self._judge_missed(since_s, in_burst=in_burst, is_caused=now <= self._burst_until)
        if not self._is_identified:
            if since_s < inf:
                self._longest_pause_s = max(self._longest_pause_s, since_s)
            if self.watcher.request is None:
                # The unit must remain from the update command on; the reset caused this one.
                self._count_caused(in_burst=in_burst)
            return
        if self._requested_s is not None:
            if self._listened_s - self._requested_s > self._timings.leftover_boot_version_s:
                self._lose_by_restart("in the middle of the transfer")
            return
        is_caused = self._count_caused(in_burst=in_burst)
        if in_burst:
            return
        if is_caused:
            if (self._awaits_confirmation or self._awaits_complete) and has_returned:
                what = "the reset" if self._awaits_confirmation else "its image"
                self._lose_by_restart(f"and had not confirmed {what} before")
            self.is_running = self._awaits_confirmation = self._awaits_complete = False
        elif now > self._supplied_until:
            self._lose_by_restart("although this run had not restarted it")

    def _compare_boot_version(self) -> None:
        version, self._boot_version = self._boot_version, self.watcher.version
        if version and version != self._boot_version:
            self._lose(f"announced boot version {version} before, and {self._boot_version} now")

    def _count_caused(self, *, in_burst: bool) -> bool:
        """Count an announcement. Returns True for the first one of a burst that the run has caused;
        no further burst is expected then.
        """
        is_caused = self._now <= self._burst_until
        if in_burst:
            self._announced_on += 1
        if not in_burst or self._announced_on == _ANNOUNCED_ON:
            self._burst_until = -inf
        return is_caused and not in_burst

    def _judge_missed(self, since_s: float, *, in_burst: bool, is_caused: bool) -> None:
        """Check whether a unit may have been exchanged during unobserved time."""
        missed_s, self._missed_s = self._missed_s, 0.0
        if is_caused:
            was_sent = self._announced_on < _ANNOUNCED_ON or self.has_update_command
            could_be_other = was_sent and not in_burst and missed_s >= _EXCHANGE_S
        else:
            could_be_other = in_burst and missed_s > 0.0 and since_s + missed_s >= self._gap_s
        if could_be_other and not self.may_restart and not self.unobserved:
            self.unobserved = _UNOBSERVED.format(f"to the {self._name} for {missed_s:.1f} s")

    def _lose_by_restart(self, when: str) -> None:
        self.is_running = False
        if not self.may_restart:
            self._lose(f"announced its bootloader {when}")

    def _compare(self, content: Content) -> None:
        identity = _identity(content)
        if not self._known:
            self._known = {name: frozenset({text}) for name, text in identity.items()}
        for name, text in identity.items():
            known = self._known.get(name, frozenset({text}))
            if text not in known:
                first = " or ".join(f"{each!a:.40}" for each in sorted(known))
                self._lose(f"had the {name.replace('_', ' ')} {first}, and has {text!a:.40} now")

    def _lose(self, what: str) -> None:
        self.lost = self.lost or f"The {self._name} {what}."


def _identity(content: Content) -> dict[str, str]:
    return {name: str(getattr(content, name)) for name in _FIELDS if hasattr(content, name)}
