"""What an upgrade tells while it runs, and the figures it ends with."""

from __future__ import annotations

from collections.abc import Sequence

from flasher import events
from flasher.events import Phase
from flasher.host.outcome import Statistics
from flasher.host.situation import Situation
from flasher.host.table import Event
from flasher.protocol.fields import Content
from flasher.protocol.messages import Ack, BootVersion, Malformed, Nak, Row, Unknown
from flasher.protocol.text import printable
from flasher.protocol.wire import Damage

Received = Row | Malformed | Unknown | Content | None
"""The message behind an event; None for a timer or the user's word."""

_TIMEOUTS = frozenset(
    {
        Event.PACKET_UNANSWERED,
        Event.PACKET_LOST,
        Event.END_UNANSWERED,
        Event.END_LOST,
        Event.END_UNCONFIRMABLE,
    }
)


class Journal:
    """Collects events for the caller and counts what the statistics say. Device text is escaped."""

    def __init__(self) -> None:
        self._events: list[object] = []
        self._acknowledged = 0
        self._repetitions = 0
        self._naks = 0
        self._timeouts = 0
        self._transfer_s: float | None = None

    def take(self) -> Sequence[object]:
        """The events since the last call."""
        taken, self._events = self._events, []
        return taken

    def statistics(self, attempts: int, duration_s: float) -> Statistics:
        """The figures so far."""
        return Statistics(
            attempts=attempts,
            packets_acknowledged=self._acknowledged,
            repetitions=self._repetitions,
            naks=self._naks,
            timeouts=self._timeouts,
            duration_s=duration_s,
            transfer_s=self._transfer_s,
        )

    # -- what happened ----------------------------------------------------------------------------

    def phase(self, phase: Phase, attempt: int) -> None:
        """A phase was entered."""
        self._events.append(events.PhaseEntered(phase, attempt))

    def power_cycle(self, limit_s: float) -> None:
        """Somebody has to switch the device off and on."""
        self._events.append(events.PowerCycleAwaited(limit_s))

    def attempt(self, attempt: int, reason: Event) -> None:
        """The transfer starts over."""
        self._events.append(events.AttemptStarted(attempt, reason.value))

    def received(self, row: Received) -> None:
        """A message came, whatever it is."""
        self._naks += isinstance(row, Nak)

    def expired(self, event: Event) -> None:
        """A timer was over."""
        self._timeouts += event in _TIMEOUTS

    def damaged(self, damage: Damage) -> None:
        """Bytes came that were no message."""
        told = events.BytesDamaged(damage.can_id, damage.reason.value, damage.data)
        self._events.append(told)

    def boot_seen(self, boot: BootVersion, minimum: str | None) -> None:
        """The first boot version of the attempt came, and is not below the `minimum`."""
        version = printable(boot.version)
        self._events.append(events.BootVersionSeen(printable(boot.name), version))
        if minimum is not None:
            text = f"the bootloader {version} is not older than {minimum}, as the manifest asks"
            self._events.append(events.CheckMade("boot-version", "passed", text))

    def packet_done(self, at: Situation, total: int, now: float) -> None:
        """The packet in work is acknowledged; the last one ends the transfer."""
        self._acknowledged = at.number
        self._events.append(events.PacketAcknowledged(at.number, total, at.tries))
        if at.number == total:
            self._transfer_s = now - at.request_at

    def repeated(self, what: str, reason: Event, tries: int) -> None:
        """A message is sent again."""
        self._repetitions += 1
        self._events.append(events.MessageRepeated(what, reason.value, tries))

    def reported(self, event: Event, row: Received) -> None:
        """Something came that has no place there."""
        self._events.append(events.Reported(_describe(event, row)))


def _describe(event: Event, row: Received) -> str:
    """One sentence on a message that is reported."""
    match row:
        case Malformed(message, problem):
            return f"message {message.command:04X} from {message.can_id:03X} ignored: {problem}"
        case Unknown(message):
            return f"unknown message {message.command:04X} from {message.can_id:03X} ignored"
        case BootVersion(name, version):
            return f"{event.value}: {printable(name)} {printable(version)}"
        case Ack(number) | Nak(number):
            return f"{event.value}: {type(row).__name__.upper()} {number}"
        case _:
            return event.value
