"""Random walk: takes valid and invalid steps in any order and judges the answers by a model.

The model knows what a device must do, what it may do, and what the profile decides. Where the state
is not certain it is UNCLEAR, and only violations of general rules count. Two rules always apply:
only valid messages get a positive answer, and valid messages get an answer.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from enum import Enum
from functools import partial
from itertools import pairwise
from math import inf
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.fr import forms
from flasher.conformance.explore.stimuli import (
    PACKETS,
    REFUSED,
    UPDATES,
    TransferPosition,
    make_stimulus,
)
from flasher.conformance.patient_host import LEFTOVER_S, UPDATE_SPACING_S
from flasher.conformance.profile import choice_words
from flasher.conformance.wire import (
    PACKET_BYTES,
    RawFrame,
    Received,
    Reply,
    describe,
    inverted,
    joined,
    packet_count,
    packet_payload,
    padded_to_frame,
    version_in,
)

_GAP_S: Final = 0.02
_BUS_OFF_S: Final = 0.02
_FORM_NAKS: Final = 4
"""NAKs to a packet that is not sent in its plain form, at most."""
_UPDATES_MAX: Final = 8


class DevicePhase(Enum):
    """State of the device, as far as it is certain."""

    APPLICATION = "application"
    ANNOUNCING = "announcing"
    BEGUN = "before packet 1"
    TRANSFER = "transfer"
    STORED = "all stored"
    UNCLEAR = "unclear"


_IN_TRANSFER: Final = frozenset((DevicePhase.BEGUN, DevicePhase.TRANSFER, DevicePhase.STORED))


class EndOutcome(Enum):
    """Required result at the end of a transfer of this image."""

    RUNS = "complete"
    REFUSED = "NAK"
    NEVER_ENDED = ""
    """The image does not run, so its transfer is never ended."""


class Violation(Exception):  # noqa: N818  the device's error, and no error of the walk
    """The device violated a rule; `rule` is a short, stable name."""

    def __init__(self, rule: str, text: str) -> None:
        super().__init__(text)
        self.rule = rule


def filler(size_bytes: int) -> bytes:
    """An image for unfinished transfers: deterministic bytes that include headers and tails."""
    chance = random.Random(size_bytes)  # noqa: S311  the same at every replay
    parts = (b"\x55\xaa\x16\x87\xa3\x85", b"\xf0\x55\xaa", b"\x55\x55\xaa\xf0")
    data = b""
    while len(data) < size_bytes:
        data += chance.choice(parts) if chance.random() < 0.1 else chance.randbytes(7)
    blank = b"\xff" * PACKET_BYTES if size_bytes >= 3 * PACKET_BYTES else b""
    return (data[:PACKET_BYTES] + blank + data[PACKET_BYTES + len(blank) :])[:size_bytes]


class Walk:
    """Tracks the device during one walk, which starts with the good image running."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.phase = DevicePhase.APPLICATION
        self.has_application: bool | None = True
        """True when a complete application is installed; None when that is not certain."""
        self.update_accepted = False
        """True once the device accepted an update command in this walk."""
        self.running_image = bench.good_image
        """The image of the installed application."""
        self._image = filler(3 * PACKET_BYTES)
        self._expected_end = EndOutcome.NEVER_ENDED
        self._update_image = (self._image, self._expected_end)
        """Image and expected end of the last update command."""
        self._stored = 0
        self._updates_unanswered = 0
        self._acks_due: Counter[int] = Counter()
        self._naks_due = 0
        self._nak_numbers: frozenset[int] | None = frozenset()
        self._feedback_due = 0
        self._may_restart = False
        self._may_complete = False
        self._may_send_partial = False
        """A message of the device may have been cut off, so half of it may arrive next."""
        self._spoilt_until = -inf
        self._nodes_asked: frozenset[int] = frozenset()
        """Ids on which the device may answer other nodes whose messages the walk imitated."""
        self._requested_at = -inf
        self._version_at = -inf
        self._announced = 0
        """Boot versions of the burst so far."""
        self._stored_at = bench.now
        """Time of the last request transfer, or end of the last packet that was stored, from which
        a pause may count.
        """

    def take(self, name: str, argument: str = "") -> None:
        """Take a step of `STEPS`, or send an invalid message. Raises Violation and errors of the
        bench.
        """
        self._apply_elapsed_time()
        if name in REFUSED:
            self._send_refused(name)
        else:
            getattr(self, f"_{name.replace('-', '_')}")(argument)

    def check_application(self) -> None:
        """Check that the expected application runs. Raises Violation."""
        bench = self.bench
        if self.phase is not DevicePhase.APPLICATION and bench.encoder.has_version_query:
            bench.wait(bench.waits.burst_s)
        wanted = version_in(self.running_image)
        if wanted is None or not bench.encoder.has_version_query:
            found, wanted = ("answers" if bench.application_runs() else "no answer"), "answers"
        else:
            found = bench.application_version(bench.limit("start_s")) or "no answer"
        if found != wanted:
            raise Violation("application", f"the application does not run: {found}, not {wanted}")
        self.phase = DevicePhase.APPLICATION
        bench.forget()

    def check_stored(self, image: bytes) -> None:
        """Check that the flash holds `image`, where it is readable. Raises Violation."""
        if self.bench.subject.has_readback:
            at = self.bench.difference(image)
            if at is not None and not (
                self.phase in _IN_TRANSFER and self.bench.is_kept_aside(image)
            ):
                raise Violation("flash", f"the flash differs from the image from offset {at} on")

    # -- received messages -------------------------------------------------------------------------

    def _apply_elapsed_time(self) -> None:
        """Update the state for the time that passed since the last step."""
        bench = self.bench
        silent_s = bench.now - self._version_at
        if self.phase is DevicePhase.ANNOUNCING and silent_s > bench.waits.burst_s:
            if self.has_application:
                self._await_start()
            elif self.has_application is None:
                self.phase, self._may_restart = DevicePhase.UNCLEAR, True
        self._apply_pause(bench.limit("pause_s") - bench.waits.settle_s)

    def _apply_pause(self, begins_s: float = inf) -> None:
        """A pause that ends a transfer may be over, from `begins_s` on."""
        bench = self.bench
        begins_s = min(0.8 * bench.limit("pause_s"), begins_s)
        may_end = bench.choice("tx_12") != "waits" and bench.now - self._stored_at > begins_s
        if self.phase in _IN_TRANSFER and may_end:
            self.phase, self._may_restart = DevicePhase.UNCLEAR, True

    def _await_start(self) -> None:
        """After the burst, wait for the application, however long the window is."""
        bench = self.bench
        start_s = bench.limit("start_s")
        if bench.encoder.has_version_query:
            bench.application_version(start_s)
            bench.forget()
        else:
            # A reset at the end of the window may have restarted the application meanwhile.
            starts_s = bench.waits.burst_s + start_s
            while (left_s := self._version_at + starts_s - bench.now) > 0:
                self._listen(left_s)
        if self.phase is DevicePhase.ANNOUNCING:
            self.phase = DevicePhase.APPLICATION

    def _listen(
        self, within_s: float, until: Callable[[Received], bool] | None = None
    ) -> Received | None:
        """Judge all messages until one satisfies `until`, which is returned, or time runs out."""
        deadline = self.bench.now + within_s
        while (reply := self.bench.next_message(deadline - self.bench.now)) is not None:
            self._judge(reply)
            if until is not None and until(reply):
                return reply
        return None

    def _await(self, kind: Reply, within_s: float, after: str, number: int | None = None) -> None:
        """Wait for a message of `kind`. Raises Violation without one."""
        reply = self._listen(
            within_s, lambda one: one.kind is kind and number in (None, one.number)
        )
        if reply is None:
            named = kind.value if number is None else f"{kind.value} {number}"
            raise Violation(f"no {kind.value}", f"no {named} within {within_s:g} s after {after}")

    def _listen_for_answers(self) -> None:
        """Listen for as long as an answer or the rest of a partial message may take."""
        bench = self.bench
        broken_s = 2 * bench.limit("inter_frame_s")
        if self.phase is DevicePhase.ANNOUNCING:
            self._listen(broken_s)  # no longer, as the window is short
            return
        self._listen(bench.waits.settle_s)
        self._naks_due = 0

    def _judge(self, reply: Received) -> None:
        match reply.kind:
            case Reply.FEEDBACK:
                if not self._feedback_due:
                    raise Violation("feedback", "general feedback without a write")
                self._feedback_due -= 1
            case Reply.BOOT_VERSION:
                self._judge_version(reply)
            case Reply.REQUEST:
                if not self._updates_unanswered:
                    raise Violation("request", "request transfer without a valid update command")
                self._updates_unanswered -= 1
                self._begin_transfer(reply.at)
            case Reply.ACK | Reply.NAK:
                self._judge_number(reply)
            case Reply.COMPLETE:
                if not self._may_complete:
                    raise Violation(
                        "complete", "complete before all packets and a valid end of transfer"
                    )
            case Reply.OTHER if reply.can_id in self._nodes_asked:
                pass
            case Reply.DAMAGED if self._is_spoilt(reply):
                pass
            case Reply.OTHER | Reply.DAMAGED:
                raise Violation("form", f"{reply}: not a message of a device")

    def _is_spoilt(self, reply: Received) -> bool:
        """True for half a message, and for the rest of the next one, whose beginning was taken for
        its end.
        """
        if self._may_send_partial:
            self._may_send_partial = False
            self._spoilt_until = reply.at + self.bench.limit("inter_frame_s")
        return reply.at < self._spoilt_until

    def _judge_number(self, reply: Received) -> None:
        if reply.kind is Reply.ACK:
            if not self._acks_due[reply.number]:
                raise Violation("ack", f"{reply} without a valid packet of this number")
            self._acks_due[reply.number] -= 1
            if reply.number == self._stored + 1:
                self._store()
            return
        allowed = self._nak_numbers
        if not self._naks_due or not (allowed is None or reply.number in allowed):
            raise Violation("nak", f"{reply} without a message that has to be rejected")
        self._naks_due -= 1

    def _judge_version(self, reply: Received) -> None:
        self._apply_pause()
        is_leftover = reply.at < self._requested_at + LEFTOVER_S and not self._may_restart
        if self.phase in _IN_TRANSFER and is_leftover:
            return
        is_expected = self._may_restart or self.phase is DevicePhase.UNCLEAR
        if self.phase is not DevicePhase.ANNOUNCING and not is_expected:
            pause_s = self.bench.limit("pause_s")
            why = f"without reset, power cycle or pause (limits.pause_s = {pause_s:g})"
            raise Violation("restart", f"{reply} {why}, phase: {self.phase.value}")
        if reply.boot_name != self.bench.encoder.boot_name or not reply.has_good_version_text:
            raise Violation("form", f"{reply} is not a valid boot version of this device")
        is_burst = reply.at - self._version_at < self.bench.waits.next_version_s
        is_next = self.phase is DevicePhase.ANNOUNCING and is_burst
        self._announced = self._announced + 1 if is_next else 1
        self.phase = DevicePhase.ANNOUNCING
        self._version_at = reply.at
        self._may_complete = False
        self._acks_due.clear()

    def _begin_transfer(self, at: float) -> None:
        self.phase = DevicePhase.BEGUN
        self._image, self._expected_end = self._update_image
        self.has_application = {"erased": False, "kept": True}.get(self.bench.choice("rs_03_old"))
        self.update_accepted = True
        self._stored = 0
        self._requested_at = self._stored_at = at
        self._acks_due.clear()
        self._may_restart = self._may_complete = False

    def _store(self) -> None:
        self._stored += 1
        self._stored_at = self.bench.tester.left_at
        if self.phase is not DevicePhase.UNCLEAR:
            is_last = self._stored == packet_count(len(self._image))
            self.phase = DevicePhase.STORED if is_last else DevicePhase.TRANSFER

    # -- reset, power, time ------------------------------------------------------------------------

    def _reset(self, _: str) -> None:
        bench, before = self.bench, self.phase
        self._feedback_due += 1
        if before is DevicePhase.APPLICATION:
            feedback_due = self._feedback_due
            self._may_restart = True
            bench.send(bench.encoder.reset())
            self._await(Reply.BOOT_VERSION, bench.limit("first_version_s"), "reset")
            self._may_restart = False
            if self._feedback_due == feedback_due:
                raise Violation("no feedback", "no general feedback to a reset of the application")
            return
        choice = bench.choice("tx_13") if before in _IN_TRANSFER else ""
        self._may_restart = self._may_send_partial = choice != "ignored"
        bench.send(bench.encoder.reset())
        if choice == "restarts":
            self._await(Reply.BOOT_VERSION, bench.limit("first_version_s"), "reset")
        else:
            self._listen_for_answers()
            if choice not in ("", "ignored") and self.phase is before:
                self.phase = DevicePhase.UNCLEAR

    def _burst(self, argument: str) -> None:
        """Reset without an update command: expect a complete burst and the application. With
        `twice`, a second reset follows.
        """
        if self.phase is not DevicePhase.APPLICATION:
            self._reset("")
            return
        bench = self.bench
        bench.forget()
        self._feedback_due += 1
        bench.send(bench.encoder.reset())
        if argument == "twice":
            bench.send(bench.encoder.reset())
        replies = bench.collect(bench.limit("first_version_s"))
        if argument == "twice":
            versions = sum(one.kind is Reply.BOOT_VERSION for one in replies)
            bursts = 1 if bench.choice("rs_02") == "ignored" else 2
            if versions > bursts * bench.number("versions"):
                raise Violation("burst", f"{versions} boot versions after two resets")
            self._feedback_due = 0
            self.check_application()
            return
        times = [one.at for one in replies if one.kind is Reply.BOOT_VERSION]
        # Feedback to messages before the reset may come as late as its own.
        confirmed = len(replies) - len(times)
        is_first = all(one.kind is Reply.FEEDBACK for one in replies[:confirmed])
        if not (is_first and 1 <= confirmed <= self._feedback_due):
            raise Violation("burst", f"after a reset: {describe(replies)}")
        if len(times) != bench.number("versions"):
            raise Violation("burst", f"{len(times)} boot versions after a reset")
        spacing_s, off_s = bench.limit("version_spacing_s"), bench.port.uncertainty_s
        off_s += bench.limit("version_spacing_tolerance_s")
        gaps = [late - early for early, late in pairwise(times)]
        if any(abs(gap - spacing_s) > off_s for gap in gaps):
            shown = ", ".join(f"{1000 * gap:.1f}" for gap in gaps)
            raise Violation("burst", f"boot versions {shown} ms apart")
        self._feedback_due -= confirmed
        self.check_application()

    def _power(self, argument: str) -> None:
        bench = self.bench
        bench.power_cycle(float(argument or 0.5))
        self._acks_due.clear()
        self._updates_unanswered = self._naks_due = self._feedback_due = 0
        self._may_restart = self._may_send_partial = True
        self._await(Reply.BOOT_VERSION, bench.limit("first_version_s"), "power-up")
        self._may_restart = False

    def _wait(self, argument: str) -> None:
        bench = self.bench
        if argument != "pause":
            seconds = bench.waits.burst_s + _GAP_S if argument == "window" else float(argument)
            self._listen(seconds)
            return
        choice = bench.choice("tx_12")
        within_s = bench.limit("pause_s") + bench.limit("first_version_s")
        if self.phase not in _IN_TRANSFER or choice == "waits":
            self._may_restart = self._may_restart or self.phase is DevicePhase.UNCLEAR
            self._listen(1.2 * bench.limit("pause_s"))
            return
        self._may_restart = True
        if choice == "announces":
            self._await(Reply.BOOT_VERSION, within_s, "the last packet")
        else:
            self.phase = DevicePhase.UNCLEAR
            self._listen(within_s)

    def _bus_off(self, _: str) -> None:
        bench = self.bench
        bench.subject.bus_off(_BUS_OFF_S)
        self._may_send_partial = True
        self._listen(4 * _BUS_OFF_S + bench.limit("inter_frame_s"))

    def _query(self, _: str) -> None:
        if self.phase is DevicePhase.APPLICATION:
            self.check_application()
        else:
            self.bench.send(self.bench.encoder.query_version())
            self._listen_for_answers()

    # -- update command ----------------------------------------------------------------------------

    def _await_version(self, *, is_last: bool = False) -> None:
        """While the device announces itself, wait until it accepts an update command; with
        `is_last` until its burst is over.
        """
        if self.phase is not DevicePhase.ANNOUNCING:
            return
        bench = self.bench
        within_s = bench.waits.next_version_s
        if self.has_application is False:  # it may restart just now
            within_s = bench.limit("first_version_s")
        reply = self._listen(within_s, _is_version)
        if is_last or bench.choice("up_04_burst") != "accepted":
            while reply is not None and self._announced < bench.number("versions"):
                reply = self._listen(within_s, _is_version)
        if reply is None and self.has_application:  # its window is over, or nearly
            self._await_start()
        elif reply is None and self.has_application is None:
            self.phase = DevicePhase.UNCLEAR

    def _update(self, argument: str) -> None:
        bench = self.bench
        image, outcome = self._image_of(argument)
        frames = bench.encoder.update(len(image))
        self._await_version()
        self._feedback_due += 1
        if self.phase is DevicePhase.APPLICATION:
            bench.send(frames)
            self._listen_for_answers()
            return
        is_same = self.phase is DevicePhase.BEGUN and len(image) == len(self._image)
        if self.phase in _IN_TRANSFER and not is_same:
            self._update_in_transfer(frames, image, outcome)
            return
        self._update_image = image, outcome
        if is_same or self.phase is DevicePhase.UNCLEAR:
            self._updates_unanswered += 1
            self._naks_due, self._nak_numbers = 1, None
            self._may_restart = True  # to a device that ignores it this is a long pause
            bench.send(frames)
            self._listen(bench.limit("erase_s"), lambda one: one.kind is Reply.REQUEST)
            return
        for _ in range(_UPDATES_MAX):
            self._updates_unanswered += 1
            is_burst_over = self._announced >= bench.number("versions")
            sent = bench.send(frames)
            reply = self._listen(
                bench.limit("erase_s"),
                partial(_answers_update, not_before=sent.left_at + UPDATE_SPACING_S),
            )
            if reply is None or reply.kind is Reply.REQUEST:
                break
            is_late = reply.at > sent.left_at + LEFTOVER_S
            # In the burst: a device may process what it received after it (figure 2).
            if is_late and is_burst_over and bench.choice("up_04_burst") == "accepted":
                break
            self._feedback_due += 1
        if self.phase is not DevicePhase.BEGUN:
            raise Violation("no request", "no request transfer after a valid update command")
        # A second erase for the second command is correct too (R25).
        while self._updates_unanswered and self._listen(
            LEFTOVER_S, lambda one: one.kind is Reply.REQUEST
        ):
            pass

    def _update_in_transfer(
        self, frames: list[RawFrame], image: bytes, outcome: EndOutcome
    ) -> None:
        bench, choice = self.bench, self.bench.choice("up_08")
        if self.phase is DevicePhase.BEGUN:  # before packet 1 any answer is right (R25)
            choice = "either"
        self._naks_due, self._nak_numbers = 1, None
        if choice == "rejected":
            bench.send(frames)
            self._listen_for_answers()
            return
        self._update_image = image, outcome
        self._updates_unanswered += 1
        bench.send(frames)
        if choice == "starts_over":
            self._await(Reply.REQUEST, bench.limit("erase_s"), "an update command in a transfer")
            return
        self._may_restart = True  # to a device that ignores it this is a long pause
        if not self._listen(bench.limit("erase_s"), lambda one: one.kind is Reply.REQUEST):
            self.phase = DevicePhase.UNCLEAR

    def _update_reset(self, _: str) -> None:
        """Send an update command directly followed by a reset, which arrives during the erase."""
        bench = self.bench
        self._await_version(is_last=True)  # one that it takes only then is not sent another size
        if self.phase is not DevicePhase.ANNOUNCING:
            self._reset("")
            return
        self._update_image = self._image_of("good")
        self._updates_unanswered += 1
        self._feedback_due += 2
        self._may_restart = True
        bench.send([*bench.encoder.update(len(bench.good_image)), *bench.encoder.reset()])
        reply = self._listen(
            bench.limit("erase_s"), lambda one: one.kind in (Reply.REQUEST, Reply.BOOT_VERSION)
        )
        if reply is None:
            raise Violation("no request", "no answer to an update command followed by a reset")
        self.phase, self.has_application, self.update_accepted = DevicePhase.UNCLEAR, None, True
        self._may_restart = True
        self._listen_for_answers()

    def _cut(self, argument: str) -> None:
        """Cut the power halfway through a flash operation: of the erase after an update command or,
        when all packets are stored, of the end of transfer.
        """
        bench, is_end = self.bench, self.phase is DevicePhase.STORED
        if is_end and self._expected_end is not EndOutcome.RUNS:
            return
        if not is_end:
            self._await_version(is_last=True)  # a boot version shall mean that it was cut
            if self.phase is not DevicePhase.ANNOUNCING:
                return
        before = None if self.has_application is False else self.running_image
        after = self._image if is_end else None
        self._may_restart = self._may_send_partial = self._may_complete = True
        self._updates_unanswered += 1
        self._feedback_due += 1
        self.update_accepted, self.phase = True, DevicePhase.UNCLEAR
        bench.subject.cut_in_operation(int(argument), 0.5, _GAP_S)
        bench.send(bench.encoder.end() if is_end else bench.encoder.update(len(bench.good_image)))
        if not is_end:
            self._update_image = self._image_of("good")
        within_s = bench.limit("erase_s") + bench.limit("first_version_s")
        ends = (Reply.BOOT_VERSION, Reply.REQUEST, Reply.COMPLETE)
        reply = self._listen(within_s, lambda one: one.kind in ends)
        if not bench.subject.take_cut():  # it performs fewer operations
            if reply is not None and reply.kind is Reply.COMPLETE:
                self._completed()
            return
        self._updates_unanswered = 0
        self._listen(bench.waits.burst_s + _GAP_S)
        self._check_not_mixed([image for image in (before, after) if image is not None])
        self._may_complete = False

    def _check_not_mixed(self, images: Sequence[bytes]) -> None:
        """Check that after a power cut one of `images` runs completely, or no application."""
        bench = self.bench
        self.phase = DevicePhase.UNCLEAR
        self.has_application = None
        if not bench.encoder.has_version_query:
            return
        found = bench.application_version()
        bench.forget()
        if found is None:
            return
        whole = next((image for image in images if version_in(image) == found), None)
        if whole is None:
            raise Violation("mixed", f"application {found!a} runs after a power cut")
        self.check_stored(whole)
        self.running_image, self.has_application, self.phase = whole, True, DevicePhase.APPLICATION

    def _image_of(self, argument: str) -> tuple[bytes, EndOutcome]:
        """Image of a step, and its expected end."""
        bench = self.bench
        if argument in ("", "good"):
            return bench.good_image, EndOutcome.RUNS
        if argument == "second":
            return bench.subject.second_image or bench.good_image, EndOutcome.RUNS
        if argument == "wrong":
            image = bytes((bench.good_image[0] ^ 1,)) + bench.good_image[1:]
            has_checksum = bench.choice("en_04") != "none"
            return image, EndOutcome.REFUSED if has_checksum else EndOutcome.NEVER_ENDED
        size_bytes = min(int(argument), bench.number("largest_image_bytes"))
        return filler(size_bytes), EndOutcome.NEVER_ENDED

    # -- packets -----------------------------------------------------------------------------------

    @property
    def total(self) -> int:
        return packet_count(len(self._image))

    @property
    def wanted(self) -> int:
        """Number of the next packet."""
        return min(self._stored + 1, self.total)

    @property
    def _place(self) -> TransferPosition:
        bench = self.bench
        largest_bytes = bench.number("largest_image_bytes")
        return TransferPosition(bench.encoder, self._image, self.wanted, largest_bytes)

    def _packet(
        self, _: str, frames: Sequence[RawFrame] = (), gap_s: float = 0.0, naks: int = 0
    ) -> None:
        """Send the next packet, in these frames, which may be answered by so many NAKs too; outside
        a transfer it has to be rejected.
        """
        bench, number = self.bench, self.wanted
        self._feedback_due += 1
        is_next = self.phase in (DevicePhase.BEGUN, DevicePhase.TRANSFER)
        if is_next or self.phase is DevicePhase.UNCLEAR:
            self._acks_due[number] += 1
        self._naks_due, self._nak_numbers = max(naks, int(not is_next)), None
        bench.send(frames or self.bench.encoder.frames(self._place.packet(number)), gap_s=gap_s)
        if is_next:
            self._await(Reply.ACK, bench.limit("ack_s"), f"packet {number}", number)
        else:
            if self.phase is DevicePhase.STORED:  # the last packet again
                self._acks_due[number] += 1
            self._listen_for_answers()

    def _packets(self, argument: str) -> None:
        left = self.total - self._stored
        count = {"all": left, "most": left - 1}.get(argument)
        for _ in range(int(argument) if count is None else count):
            if self.phase not in (DevicePhase.BEGUN, DevicePhase.TRANSFER):
                break
            self._packet("")
        self._read("")

    def _read(self, _: str) -> None:
        """Check that acknowledged packets are in the flash, unless the device may buffer them."""
        if self.phase in _IN_TRANSFER and not self.bench.number("buffer_bytes"):
            self.check_stored(self._image[: self._stored * PACKET_BYTES])

    def _packet_again(self, argument: str) -> None:
        """Send the last or an older stored packet again, optionally with other data."""
        is_older = argument.startswith("older")
        number = self._stored - 1 if is_older else self._stored
        if self.phase not in (DevicePhase.TRANSFER, DevicePhase.STORED) or number < 1:
            self._packet("")
            return
        payload, has_other_data = packet_payload(self._image, number), argument.endswith("other")
        payload = inverted(payload) if has_other_data else payload
        choice = self.bench.choice("tx_03" if is_older else "tx_02")
        is_open = choice != "ack" and (is_older or self.phase is DevicePhase.STORED)
        right = [f"ACK {number}"] if is_older else self.bench.repetition_answers(number)
        self._feedback_due += 1
        self._acks_due[number] += is_open or f"ACK {number}" in right
        self._naks_due, self._nak_numbers = 1, frozenset((number, self.wanted, number + 1))
        self.bench.send(self.bench.encoder.packet(number, self.total, payload))
        within_s = self.bench.limit("ack_s")
        if is_open or (is_older and has_other_data):
            self._listen_for_answers()
        elif self._listen(within_s, lambda one: str(one) in right) is None:
            named = f"no {' or '.join(right)} within {within_s:g} s"
            raise Violation("no ACK", f"{named} after packet {number} again")
        self._acks_due[number] = 0

    def _packet_between(self, _: str) -> None:
        """Send the next packet with empty frames in between."""
        empty = RawFrame(self.bench.encoder.to_device, b"")
        frames = self.bench.encoder.frames(self._place.next_packet)
        between = [each for frame in frames for each in (frame, empty)]
        # One that rejects short frames within a message may ignore empty ones.
        self._packet_in_form("fr_01", between, may_be_taken=True)

    def _packet_slow(self, _: str) -> None:
        gap_s = min(_GAP_S, self.bench.limit("inter_frame_s") / 3)
        self._packet("", gap_s=gap_s)

    def _packet_behind(self, _: str) -> None:
        """Send a query and the next packet without a gap."""
        query = self.bench.encoder.query_version()
        self._packet("", [*query, *self.bench.encoder.frames(self._place.next_packet)])

    def _packet_open(self, argument: str) -> None:
        """Send the next packet in a form of `cases.fr.forms`: `fr_02-1` is one of fr_02."""
        bench, (key, _, index) = self.bench, argument.partition("-")
        form = forms(bench.encoder)[key][int(index)]
        raw = form.before + self._place.next_packet
        self._packet_in_form(key, bench.encoder.frames(raw, form.frame_bytes))

    def _packet_in_form(
        self, key: str, frames: Sequence[RawFrame], *, may_be_taken: bool = False
    ) -> None:
        """Send the next packet in these frames, which is accepted or not as the choice `key`
        says.
        """
        bench = self.bench
        taken, not_taken = choice_words(key)
        if not bench.profile.allows(key, not_taken):
            self._packet("", frames, naks=_FORM_NAKS)  # what precedes it may be a damaged message
            return
        is_next = self.phase in (DevicePhase.BEGUN, DevicePhase.TRANSFER, DevicePhase.UNCLEAR)
        if is_next and (may_be_taken or bench.profile.allows(key, taken)):
            self._acks_due[self.wanted] += 1
        self._naks_due, self._nak_numbers = _FORM_NAKS, None
        self._feedback_due += 1
        bench.send(frames)
        self._listen_for_answers()
        self._acks_due.clear()

    def _packet_filler(self, _: str) -> None:
        """Send the last packet with bytes other than FF after the image."""
        rest = len(self._image) % PACKET_BYTES
        if self.wanted != self.total or not rest or self.bench.choice("tx_08") != "ignored":
            self._packet("")
            return
        payload = packet_payload(self._image, self.wanted)[:rest].ljust(PACKET_BYTES, b"\x00")
        self._packet("", self.bench.encoder.packet(self.wanted, self.total, payload))

    # -- end of transfer ---------------------------------------------------------------------------

    def _end(self, argument: str) -> None:
        """Send end of transfer; with `twice`, again immediately."""
        bench = self.bench
        self._feedback_due += 1
        if self.phase is not DevicePhase.STORED:
            self._naks_due, self._nak_numbers = 1, None
            was_in_transfer = self.phase in _IN_TRANSFER
            if self.phase is DevicePhase.UNCLEAR and self._stored == self.total:
                return  # perhaps it is complete
            self._may_restart = was_in_transfer  # the upgrade has failed (figure 2)
            bench.send(bench.encoder.end())
            self._listen_for_answers()
            if was_in_transfer and self.phase in _IN_TRANSFER:
                self.phase = DevicePhase.UNCLEAR
            return
        if self._expected_end is EndOutcome.NEVER_ENDED:
            return
        refused = self._expected_end is EndOutcome.REFUSED
        self._naks_due, self._nak_numbers = int(refused), None
        self._may_complete = not refused
        frames = bench.encoder.end()
        if argument == "padded" and bench.choice("fr_07") == "ignored":
            frames = padded_to_frame(frames)
        bench.send(frames)
        if refused:
            self._may_restart = True
            self._await(Reply.NAK, bench.limit("complete_s"), "an image whose checksum is wrong")
            self.phase = DevicePhase.UNCLEAR
            return
        self._await(Reply.COMPLETE, bench.limit("complete_s"), "the end of the transfer")
        self.phase, self._may_restart = DevicePhase.UNCLEAR, True
        if argument == "twice":
            self._feedback_due += 1
            bench.send(bench.encoder.end())
            self._listen(bench.limit("ack_s"))
        self._completed()

    def _completed(self) -> None:
        """The image is complete: check its application."""
        self.running_image, self.has_application = self._image, True
        self.check_application()
        self._may_restart = self._may_complete = False
        self.check_stored(self.running_image)

    # -- invalid messages -------------------------------------------------------------------------

    def _send_refused(self, name: str) -> None:
        if name in UPDATES:
            self._await_version()
        refused = make_stimulus(name, self._place)
        self._feedback_due += refused.is_intact_write
        # In the short window nobody waits for the answers to the ones before.
        is_window = self.phase in (DevicePhase.ANNOUNCING, DevicePhase.UNCLEAR)
        earlier = self._naks_due if is_window else 0
        self._naks_due, self._nak_numbers = earlier + (1 if name in UPDATES else 2), None
        if name == "reset-nodes":  # each of them is answered by general feedback
            own = self.bench.encoder.to_all
            self._nodes_asked = frozenset(own | frame.can_id >> 4 & 0xF for frame in refused.frames)
        if name in PACKETS:
            self._naks_due = 1 if refused.is_intact_write else 4
            # When all packets are stored, any number in a NAK is correct, as in TX-03.
            is_judged = self.phase in (DevicePhase.BEGUN, DevicePhase.TRANSFER)
            if refused.is_intact_write and is_judged:
                named = int.from_bytes(joined(refused.frames)[7:9], "little")
                self._nak_numbers = frozenset((self.wanted, named, self.wanted - 1))
        self.bench.send(refused.frames)
        self._apply_elapsed_time()  # a flood takes a second
        self._listen_for_answers()


def _is_version(reply: Received) -> bool:
    return reply.kind is Reply.BOOT_VERSION


def _answers_update(reply: Received, not_before: float) -> bool:
    """True for request transfer, and for a boot version sent after the update command."""
    is_later = reply.kind is Reply.BOOT_VERSION and reply.at >= not_before
    return is_later or reply.kind is Reply.REQUEST


STEPS: Final = (
    *("reset", "burst", "power", "bus-off", "wait", "query", "update", "update-reset", "cut"),
    *("packet", "packets", "packet-again", "packet-between", "packet-slow", "packet-behind"),
    *("packet-filler", "packet-open", "read", "end"),
)
"""Steps implemented by methods of `Walk`; the other steps send invalid messages."""
ALL_STEPS: Final = (*STEPS, *REFUSED)
