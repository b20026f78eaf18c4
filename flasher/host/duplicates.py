"""Detection of a second device of the same kind on the bus (R27); pure.

One device answers each message once. `request_sent` and `upgrade_message_sent` take every message
sent, `received` and `frame_received` all that arrives. Evidence of a second device:

- the reset, a packet or end of transfer has more answers than copies sent; or a query has, twice in
  a row (an answer on a broadcast id may belong to an unseen query);
- answers differ in version or serial number, or bootloaders announce different versions;
- the announcements of two bootloaders alternate, or one continues while an application sends;
- a packet is acknowledged after a bootloader announced itself, or requested the transfer again,
  since the last update command;
- packets have ACK and NAK, though every copy has its ACK, more often than damaged frames explain.

Not evidence, because a single device or a bad line may cause it: a late answer to a repetition
(R10), a refusal of the part of a packet that was sent before this computer paused (R12), general
feedback besides the bootloader's own answers (R15), another request transfer before the first ACK
(R16), an ACK of end of transfer (figure 2 asks whether it came correctly; not for an image of one
packet, where nothing else would show a second device), an answer doubled by the link.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf
from typing import Final

from flasher.i18n import text
from flasher.protocol import messages
from flasher.protocol.catalogue import BY_KEY, Item, answer_of
from flasher.protocol.fields import Content, label
from flasher.protocol.frame import Frame
from flasher.protocol.messages import BootVersion
from flasher.protocol.spec import COMMAND_SIZE, FRAME_DATA_SIZE, PREFIX_SIZE, Command, Node
from flasher.protocol.text import printable
from flasher.protocol.timing import Timings
from flasher.protocol.wire import Damage, Message

SECOND_DEVICE_WAIT_S: Final = 0.1
"""Wait after an answer for the answer of a second device, in seconds."""
_DOUBLED_S: Final = 0.0003
"""Maximum time between a message and its copy made by the link, in seconds."""
_CLEARLY_APART_S: Final = 0.002
"""Minimum interval of answers that were sent separately; frames of one message, or of consecutive
messages, are closer."""
_TOLERANCE: Final = 0.25
"""Relative tolerance of the interval between announcements of one bootloader."""
_ODD_ANSWERS: Final = 2.0
"""Number of packets with two answers that proves two devices: with the decay below, three of
twenty. A bad line makes one when it doubles the first frame of a packet: NAK, then ACK."""
_DECAY: Final = 0.05
"""Decrease of that number with every packet."""
_RUN_MIN: Final = 5
"""Length of a run of ACKs that is not accidental, although a bad line loses feedbacks."""
_STORED_MAX: Final = 8
"""Maximum number of stored packets, and of different answers to one query."""
_TRANSFER_ANSWERS: Final = (messages.RequestTransfer, messages.Ack, messages.Nak)
_SENDER_MASK, _RECEIVER_MASK = 0x7F0, 0x00F
_TOOL: Final = Node.CDL.value

Key = tuple[int, int]
"""CAN id and command of an answer."""


@dataclass
class _Question:
    """Query or write with its answers, counted in rounds. A round ends when every copy is answered,
    or no answer can follow.
    """

    key: Key
    item: Item | None = None
    copies: int = 0
    """Copies sent in this round, by any node."""
    answers: int = 0
    asked_at: float = -inf
    answered_at: float = -inf
    is_odd: bool = False
    """There were more answers than copies in this round."""
    odd_rounds: int = 0
    """Number of consecutive rounds with more answers than copies."""
    contents: list[Content] = field(default_factory=list)
    """All different answers to the query."""


@dataclass
class _Packet:
    """Copies and answers of one packet."""

    unacknowledged: int = 0
    """Copies sent without an ACK, also in earlier attempts, because an ACK may be late; negative
    for more ACKs than copies in this attempt.
    """
    has_ack: bool = False
    has_nak: bool = False
    acked_at: float = -inf
    is_odd: bool = False

    def begin(self) -> None:
        self.unacknowledged = max(0, self.unacknowledged)
        self.has_ack = self.has_nak = self.is_odd = False

    @property
    def has_two_answers(self) -> bool:
        """True if each copy has its ACK, and there were more answers. A line that damages many
        frames causes several NAKs per copy, but no ACK.
        """
        all_acked = self.has_ack and self.unacknowledged <= 0
        return all_acked and (self.has_nak or self.unacknowledged < 0)


@dataclass
class _Announcements:
    """Boot versions on one CAN id."""

    boot: BootVersion | None = None
    last_at: float = -inf
    times: deque[float] = field(default_factory=lambda: deque(maxlen=4))
    """Times of the last boot versions since a reset or an update command."""
    rhythm: deque[tuple[float, bool]] = field(default_factory=lambda: deque(maxlen=4))
    """Times of the last boot versions since a reset, and whether each came early although no update
    command was sent since the previous one.
    """
    is_documented: bool = False
    """Two consecutive boot versions came at the documented interval."""


class _OpenFeedbacks:
    """Counts messages without feedback yet; a device that hung may send it late."""

    def __init__(self) -> None:
        self._open = 0
        self._has_left = False

    def left(self) -> None:
        self._open += 1
        self._has_left = True

    def is_odd(self) -> bool:
        """Count a feedback; True for one without a message (never before the first message)."""
        if not self._open:
            return self._has_left
        self._open -= 1
        return False


class _FeedbackRuns:
    """Runs of ACKs with and without general feedback: one device sends all or none (R15)."""

    def __init__(self) -> None:
        self._has_feedback = False
        self._length = 0
        self._is_confirmed = False
        self._seen: set[bool] = set()

    def note_feedback(self) -> None:
        self._has_feedback = True

    def note_ack(self) -> bool:
        """Count an ACK; True once there were runs of both kinds."""
        self._length = self._length + 1 if self._has_feedback is self._is_confirmed else 1
        self._is_confirmed, self._has_feedback = self._has_feedback, False
        if self._length >= _RUN_MIN:
            self._seen.add(self._is_confirmed)
        return len(self._seen) > 1


class DuplicateDetector:
    """Detects a second device by messages that a single one does not send."""

    def __init__(self, timings: Timings) -> None:
        self._evidence = ""
        """First evidence; may be empty."""
        self._timings = timings
        self._questions: dict[Key, _Question] = {}
        self._announced: dict[int, _Announcements] = {}
        self._application_at: dict[int, float] = {}
        """Time of the last message of an application, by sender id."""
        self.application_beside = False
        """An application answered the last reset while a bootloader announced itself."""

        # The upgrade.
        self._update_was_sent = False
        self._requested_at = inf
        self._left_at = -inf
        self._transfer_lost_by = ""
        """Message since the last update command after which a single device cannot continue the
        transfer."""
        self._packets: dict[int, _Packet] = {}
        self._packet = _Packet()
        """Current packet."""
        self._has_ack = False
        """A packet was acknowledged since the last update command."""
        self._feedbacks = _OpenFeedbacks()
        """General feedback of the application, and of a bootloader that sends it too."""
        self._confirmed = _FeedbackRuns()
        self._last_row: tuple[object, float] = (None, -inf)
        self._has_ended = self._is_complete = False
        self._odd_answers = 0.0
        self._refusals_expected = 0
        """Parts of messages that a device may refuse, because this computer paused in them."""

    # -- what is sent -----------------------------------------------------------------------------

    def request_sent(self, key: Key, now: float, item: Item | None = None) -> None:
        """Record that a copy of a request was sent; `key` and `item` are those of its answer."""
        question = self._questions.setdefault(key, _Question(key))
        is_answered = question.answers >= question.copies
        timings = self._timings
        wait_s = timings.quiet_after_repeat_s if is_answered else timings.command_timeout_s
        if now - max(question.asked_at, question.answered_at) >= wait_s:
            question.odd_rounds = question.odd_rounds if question.is_odd else 0
            question.copies, question.answers, question.is_odd = 0, 0, False
        question.item = item or question.item
        question.copies += 1
        question.asked_at = now

    def upgrade_message_sent(self, command: Command, now: float, packet: int = 0) -> None:
        """Record that an upgrade message was sent; `packet` is the number of a packet."""
        if command is Command.RESET:
            self._forget_announcements(is_reset=True)
            self.application_beside = False
            self._feedbacks.left()
            return
        if command is Command.UPDATE:
            self._forget_announcements(is_reset=False)
            self.application_beside = False
            self._questions.clear()  # another application answers from now on
            for each in self._packets.values():
                each.begin()
            self._packet = _Packet()
            self._update_was_sent = True
            self._transfer_lost_by, self._requested_at = "", inf
            self._is_complete = self._has_ack = False
        elif command is Command.PACKET:
            self._packet = self._packet_of(packet)
            self._packet.unacknowledged += 1
        elif command is Command.END_OF_TRANSFER and len(self._packets) > 1:
            self._packet.unacknowledged += 1  # an ACK of it repeats the number of the last packet
        self._left_at = now
        self._has_ended = command is Command.END_OF_TRANSFER
        self._feedbacks.left()

    def message_dropped(self) -> None:
        """Record that this computer paused in a message, which is sent again: a device may refuse
        the part that it received.
        """
        self._refusals_expected += 1

    def _packet_of(self, number: int) -> _Packet:
        """Return the record of a packet, the last one from now on; drop one of a packet that was
        sent long ago, if possible an answered one.
        """
        if number in self._packets:
            packet = self._packets.pop(number)
        else:
            packet = _Packet()
            self._odd_answers = max(0.0, self._odd_answers - _DECAY)
            if len(self._packets) >= _STORED_MAX:
                oldest = [*self._packets][: _STORED_MAX // 2]
                answered = (each for each in oldest if self._packets[each].unacknowledged <= 0)
                del self._packets[next(answered, oldest[0])]
        self._packets[number] = packet
        return packet

    def _forget_announcements(self, *, is_reset: bool) -> None:
        """Drop boot versions from before a reset or update command."""
        for announced in self._announced.values():
            announced.times.clear()
            if is_reset:
                announced.boot = None
                announced.rhythm.clear()

    # -- what comes -------------------------------------------------------------------------------

    def frame_received(self, frame: Frame, now: float) -> None:
        """Record a frame of any node: only applications send to other nodes than the tool."""
        if self._announced and frame[0] & _RECEIVER_MASK != _TOOL and frame.is_payload:
            self._application_at[frame[0] & _SENDER_MASK] = now

    def received(self, incoming: Message | Damage, now: float) -> None:
        """Process a received message or damaged bytes."""
        if isinstance(incoming, Damage):
            self._take_damage(incoming, now)
            return
        key = incoming.can_id, incoming.command
        item = BY_KEY.get(key)
        answer = None if item is None or item.mode != incoming.mode else answer_of(item)
        if answer is not None:
            self.request_sent(answer.key, now, answer)
            return
        if key in self._questions:
            self._answered(self._questions[key], incoming, now)
        else:
            self._upgrade(incoming, now)

    # -- answers to questions ---------------------------------------------------------------------

    @property
    def ambiguous_queries(self) -> list[Item]:
        """Queries with more answers than copies, to be repeated."""
        return [each.item for each in self._questions.values() if each.item and each.odd_rounds]

    @property
    def contents(self) -> dict[Key, list[Content]]:
        """All different answers to each query."""
        return {key: each.contents for key, each in self._questions.items()}

    @property
    def evidence(self) -> str:
        """Evidence of a second device with the values in which the answers differ; may be empty."""
        differences = "; ".join(
            f"{name} {' / '.join(values)}"
            for question in self._questions.values()
            for name, values in _differences(question.contents)
        )
        if not self._evidence or not differences:
            return self._evidence
        return text("{seen}: {differences}", seen=self._evidence, differences=differences)

    def _take_damage(self, damage: Damage, now: float) -> None:
        """Count a damaged answer, because two simultaneous answers destroy each other."""
        data = damage.data
        command = int.from_bytes(data[PREFIX_SIZE : PREFIX_SIZE + COMMAND_SIZE], "big")
        second = data[FRAME_DATA_SIZE : 2 * FRAME_DATA_SIZE]
        if second and data.startswith(second):
            return  # the first frame was doubled
        question = self._questions.get((damage.can_id, command))
        if question is not None:
            self._count(question, now)
        elif command == Command.GENERAL_FEEDBACK:
            self._take_feedback(damage.can_id, now)

    def _answered(self, question: _Question, message: Message, now: float) -> None:
        item, contents = question.item, question.contents
        if item is not None and len(message.data) == item.content.SIZE_BYTES:
            content = item.content.from_data(message.data)
            if content not in contents and len(contents) < _STORED_MAX:
                contents.append(content)
        self._count(question, now)
        if len(contents) > 1 and hasattr(contents[0], "firmware_version"):
            self._set_evidence(text("two devices answered"))
        elif question.is_odd and question.key[1] == Command.GENERAL_FEEDBACK:
            self._set_evidence(text("one message was confirmed twice"))

    def _count(self, question: _Question, now: float) -> None:
        if now - question.answered_at < _DOUBLED_S:
            return
        if now - question.asked_at > self._timings.command_timeout_s:
            return
        question.answers += 1
        question.answered_at = now
        if question.answers > question.copies and not question.is_odd:
            question.is_odd = True
            question.odd_rounds += 1
            if question.odd_rounds > 1:
                self._set_evidence(text("two devices answered"))

    # -- the upgrade ------------------------------------------------------------------------------

    def announces(self, answer_id: int, now: float) -> bool:
        """True while a bootloader repeats its boot version."""
        announced = self._announced.get(answer_id)
        return announced is not None and now - announced.last_at <= self._longest_s

    def _take_feedback(self, answer_id: int, now: float) -> None:
        is_odd = self._feedbacks.is_odd()
        if self._update_was_sent:
            self._confirmed.note_feedback()
        else:
            self.application_beside = self.application_beside or self.announces(answer_id, now)
        if is_odd and not self._packets:
            self._set_evidence(text("one message was confirmed twice"))
        elif is_odd:
            self._note_odd()

    def has_announced(self, answer_id: int) -> bool:
        """True if a boot version arrived since the last reset or update command."""
        announced = self._announced.get(answer_id)
        return announced is not None and bool(announced.times)

    def overlap(self, answer_id: int) -> bool:
        """True if the last two boot versions came too close together for one bootloader."""
        announced = self._announced.get(answer_id)
        if announced is None or len(announced.times) < 2:
            return False
        earlier, later = list(announced.times)[-2:]
        return later - earlier < self.shortest_interval_s

    @property
    def shortest_interval_s(self) -> float:
        """Shortest interval of two boot versions of one bootloader, in seconds."""
        return self._timings.boot_version_spacing_s * (1 - _TOLERANCE)

    @property
    def _longest_s(self) -> float:
        return self._timings.boot_version_spacing_s * (1 + _TOLERANCE)

    def _upgrade(self, message: Message, now: float) -> None:
        row = messages.decode(message)
        last, at = self._last_row
        self._last_row = row, now
        if row == last and now - at < _DOUBLED_S:
            return
        if isinstance(row, BootVersion):
            self._announce(message.can_id, row, now)
            return
        if isinstance(row, messages.GeneralFeedbackMessage):
            self._take_feedback(message.can_id, now)
        if not self._update_was_sent:
            return
        if self._is_complete and isinstance(row, _TRANSFER_ANSWERS):
            self._set_evidence(
                text("one device continued a transfer that another one had completed")
            )
        match row:
            case messages.RequestTransfer():
                self._requested_at = min(self._requested_at, now)
                if self._has_ack:
                    self._transfer_lost_by = text("request transfer came again")
            case messages.Ack(number):
                self._acknowledged(number, now)
            case messages.Nak():
                self._refused()
            case messages.Complete():
                if self._transfer_lost_by:
                    self._set_evidence(
                        text("{what}, yet the transfer was completed", what=self._transfer_lost_by)
                    )
                self._is_complete = self._has_ended

    def _refused(self) -> None:
        if self._refusals_expected:
            self._refusals_expected -= 1
        elif not self._has_ended:
            self._packet.has_nak = True
            self._check_two_answers(self._packet)

    def _announce(self, can_id: int, boot: BootVersion, now: float) -> None:
        announced = self._announced.setdefault(can_id, _Announcements())
        times = announced.times
        if announced.boot is None:
            announced.boot = boot
        elif boot != announced.boot:
            texts = [printable(f"{each.name} {each.version}") for each in (announced.boot, boot)]
            self._set_evidence(
                text("bootloaders announced {one} and {other}", one=texts[0], other=texts[1])
            )
        # Received frames are processed before anything is sent, so this one came after it.
        after_request_s = self._left_at - self._requested_at
        if after_request_s > self._timings.leftover_boot_version_s and not self._has_ended:
            self._transfer_lost_by = text("a bootloader announced itself")
        application_at = self._application_at.get(can_id & _SENDER_MASK, -inf)
        is_between = bool(times) and times[-1] < application_at < now
        if is_between and max(application_at - times[-1], now - application_at) <= self._longest_s:
            self._set_evidence(
                text("a bootloader announced itself while an application was running")
            )
        gap_s = now - (times[-1] if times else announced.last_at)
        is_documented = self.shortest_interval_s <= gap_s <= self._longest_s
        announced.is_documented = announced.is_documented or is_documented
        announced.last_at = now
        announced.rhythm.append((now, bool(times) and gap_s < self.shortest_interval_s))
        times.append(now)
        if self._alternate(announced.rhythm, is_documented=announced.is_documented):
            self._set_evidence(text("two bootloaders announced themselves alternately"))

    def _alternate(self, rhythm: Collection[tuple[float, bool]], *, is_documented: bool) -> bool:
        """True if the last four boot versions come from two bootloaders. One that is twice as fast
        as documented has equal intervals; one may restart its burst at an update command.
        """
        times = [each for each, _ in rhythm]
        if len(times) < 4 or not all(
            self.shortest_interval_s <= later - earlier <= self._longest_s
            for earlier, later in zip(times, times[2:], strict=False)
        ):
            return False
        gaps = [later - earlier for earlier, later in pairwise(times)]
        if sum(is_early for _, is_early in [*rhythm][1:]) < 2:  # one may be doubled by the line
            return False
        is_uneven = max(gaps) - min(gaps) > _TOLERANCE * self._timings.boot_version_spacing_s
        return is_documented or is_uneven

    def _acknowledged(self, number: int, now: float) -> None:
        self._has_ack = True
        self._refusals_expected = 0
        if self._confirmed.note_ack():
            self._set_evidence(
                text("some packets were confirmed by general feedback, others were not")
            )
        if self._transfer_lost_by:
            what = self._transfer_lost_by
            self._set_evidence(
                text("{what}, yet packet {number} was acknowledged", what=what, number=number)
            )
        packet = self._packets.get(number)
        if packet is None and self._has_ended:
            return
        if packet is None:  # never sent, or long ago
            self._packet.has_nak = True
            self._check_two_answers(self._packet)
            return
        packet.has_ack = True
        packet.unacknowledged -= 1
        if packet.unacknowledged < 0 and now - packet.acked_at > _CLEARLY_APART_S:
            self._set_evidence(
                text("packet {number} was acknowledged more often than it was sent", number=number)
            )
        packet.acked_at = now
        self._check_two_answers(packet)

    def _check_two_answers(self, packet: _Packet) -> None:
        if packet.has_two_answers and not packet.is_odd:
            packet.is_odd = True
            self._note_odd()

    def _note_odd(self) -> None:
        self._odd_answers += 1
        if self._odd_answers >= _ODD_ANSWERS:
            self._set_evidence(text("packets were answered more often than they were sent"))

    def _set_evidence(self, what: str) -> None:
        self._evidence = self._evidence or what


def _differences(contents: list[Content]) -> Iterator[tuple[str, list[str]]]:
    """Yield label and values of each field in which contents differ."""
    for name, codec in contents[0].LAYOUT if contents else ():
        values = [f"{codec.show(getattr(each, name))} {codec.unit}".strip() for each in contents]
        if len(set(values)) > 1:
            yield label(name, codec), list(dict.fromkeys(values))
