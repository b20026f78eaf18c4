"""Test bench of one case: the fixture that cases and users' own pytest tests work with.

`Bench` combines `tester` (frames and messages on the bus), `judge` (checks and measurements),
`host` (upgrades the device from any state) and `subject` (power, readback and faults of the
device). Calls that most cases need are available on the bench itself. Its own methods perform
single steps of an upgrade, check the answer, and end the case when it is wrong.
"""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from math import inf
from types import MappingProxyType
from typing import Final

from flasher.conformance.firmware import Firmware
from flasher.conformance.judge import Judge, TimeName
from flasher.conformance.patient_host import UPDATES_MAX, PatientHost
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import Unsupported
from flasher.conformance.subject import BY_BUS, SIMULATED_BUS, Subject, readback_source
from flasher.conformance.tester import BusTester, Sent
from flasher.conformance.wire import (
    MEMORY_BYTES,
    PACKET_FRAMES,
    Encoder,
    RawFrame,
    Received,
    Reply,
    describe,
    packet_count,
    reported_version,
)

_PIECES: Final = 64
"""Pieces of a large image that are read over the bus; takes about a second."""
_CHECKSUM_BYTES: Final = 4
_EDGE_S: Final = 0.001
QUIET_S: Final = 0.1
"""A second answer to the same message would arrive within this time."""
_PAUSES: Final = 4
"""Longest pause to try, in units of limits.pause_s, when the profile does not know the pause."""


class Bench:
    """The bench of one case, which may take up to `limit_s` on the bench's clock."""

    def __init__(
        self,
        subject: Subject,
        profile: ConformanceProfile,
        *,
        limit_s: float,
        seed: str = "",
        stopped: Callable[[], bool] = lambda: False,
        upgrades: int = 0,
        choices: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.subject = subject
        self.port = subject.port
        self.profile = profile
        self.encoder = Encoder(
            subject.target, profile.number("reset_command"), profile.text("reset_data").encode()
        )
        self.tester = tester = BusTester(subject.port, self.encoder, profile, limit_s, stopped)
        self.judge = judge = Judge(tester, choices)
        self.host = host = PatientHost(tester)
        self.random = random.Random(seed)  # noqa: S311  chosen by the seed on purpose
        self.upgrades = upgrades
        """Number of upgrades for a case that wears the flash."""
        self.is_off = False
        """True while the case keeps the device switched off."""
        self.update_tries = 0
        """How often the last `update` sent its command."""
        self._good_since = inf
        self.continued_at = -inf
        """When the transfer last went on: the last packet that was acknowledged was sent, or
        request transfer arrived. A pause may count from there (TX-12).
        """

        self.waits = tester.waits
        self.choice, self.limit, self.number = profile.choice, profile.limit, profile.number
        self.send, self.disturb = tester.send, tester.disturb
        self.wait, self.wait_until = tester.wait, tester.wait_until
        self.next_message, self.wait_for = tester.next_message, tester.wait_for
        self.collect, self.forget = tester.collect, tester.forget
        self.step, self.check, self.require = judge.step, judge.check, judge.require
        self.require_received, self.expect = judge.require_received, judge.expect
        self.await_message, self.expect_silence = judge.await_message, judge.expect_silence
        self.succeed, self.fail, self.check_only = judge.succeed, judge.fail, judge.check_only
        self.measure, self.check_time = judge.measure, judge.check_time
        self.info, self.unsupported = judge.info, judge.unsupported
        self.upgrade, self.application_version = host.upgrade, host.application_version
        self.application_runs, self.send_packet = host.application_runs, host.send_packet

    @property
    def now(self) -> float:
        return self.port.now()

    @property
    def is_restored(self) -> bool:
        """True when `check_image` saw the good image run, by its version or in the flash, and
        nothing was sent to the device afterwards.
        """
        return not self.is_off and self.tester.left_at <= self._good_since < inf

    @property
    def is_in_virtual_time(self) -> bool:
        """True when waiting takes no time."""
        return self.port.timestamp_source == SIMULATED_BUS

    @property
    def good_image(self) -> bytes:
        """The image that the device runs before and after every case."""
        return self.subject.good_image

    def second_image(self) -> bytes:
        """A smaller image that also runs on the device. Raises Unsupported without one."""
        image = self.subject.second_image
        if image is None:
            raise Unsupported("the bench has no second good image")
        return image

    @property
    def firmware(self) -> Firmware:
        """Images for cases about content and size, short ones where the device takes no larger."""
        firmware = self.subject.firmware
        if len(firmware.good) > self.number("largest_image_bytes"):
            return Firmware(self.good_image, self.subject.second_image)
        return firmware

    def padded(self, size_bytes: int) -> bytes:
        """The good image padded with FF to `size_bytes`, with a new checksum where the product's
        images have one (en_04). Unchanged when it does not fit.
        """
        image = self.good_image
        if self.choice("en_04") == "none":
            return image.ljust(size_bytes, b"\xff")
        if len(image) > size_bytes - _CHECKSUM_BYTES:
            return image
        body = image.ljust(size_bytes - _CHECKSUM_BYTES, b"\xff")
        return body + zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little")

    def filler(self, packets: int) -> bytes:
        """Random bytes by the seed, for a transfer that is never ended."""
        return self.random.randbytes(packets * 128)

    # -- into a transfer --------------------------------------------------------------------------

    def reset_to_bootloader(self) -> Received:
        """Reset the device and return its first boot version; does not judge general feedback."""
        self.forget()
        self.send(self.encoder.reset())
        return self.await_message(Reply.BOOT_VERSION)

    def reset_measured(self, within_s: float) -> Received:
        """Like `reset_to_bootloader`, and measure general feedback and boot version."""
        self.forget()
        with self.tester.collecting_feedback():
            sent = self.send(self.encoder.reset())
            reply = self.wait_for(Reply.FEEDBACK, Reply.BOOT_VERSION, within_s=within_s)
        if reply is not None and reply.kind is Reply.FEEDBACK:
            self.measure(TimeName.FEEDBACK, reply.at - sent.left_at)
            reply = self.wait_for(Reply.BOOT_VERSION, within_s=within_s)
        found = self.require_received(reply, Reply.BOOT_VERSION.value, within_s)
        self.measure(TimeName.FIRST, found.at - sent.left_at)
        return found

    def wait_for_window(self) -> None:
        """After the first boot version, wait for the middle of the window after the burst: there
        each device accepts an update command, and answers it by no further boot version (figure 2).
        """
        gaps = self.number("versions") - 1
        spacing_s = self.limit("version_spacing_s") + self.limit("version_spacing_tolerance_s")
        last_at = self.now + gaps * spacing_s
        for _ in range(gaps):
            self.wait_for(Reply.BOOT_VERSION, within_s=last_at - self.now)
        self.wait(self.limit("window_s") / 2)
        self.forget()

    def reset_to_window(self) -> None:
        """Reset the device and wait for its window."""
        self.reset_to_bootloader()
        self.wait_for_window()

    @property
    def window_edge_s(self) -> float:
        """Margin around the window's end within which early and late cannot be distinguished."""
        return max(self.limit("window_tolerance_s"), 2 * self.port.uncertainty_s) + _EDGE_S

    def next_version(self) -> Received:
        """Wait for the next boot version of the burst."""
        return self.expect(Reply.BOOT_VERSION, within_s=self.waits.next_version_s)

    def update(self, size_bytes: int) -> Received:
        """Send the update command, repeated at every boot version (R2), until request transfer."""
        found = self.request_transfer(size_bytes)
        return self.require_received(found, Reply.REQUEST.value, self.limit("erase_s"))

    def request_transfer(self, size_bytes: int) -> Received | None:
        """Like `update`, for an image that the device may reject; then returns None."""
        for tries in range(1, UPDATES_MAX + 1):
            self.update_tries = tries
            sent = self.send(self.encoder.update(size_bytes))
            reply = self.await_request(sent)
            if reply is None:  # it may be deaf between two bursts (R14)
                left_s = sent.left_at + self.limit("first_version_s") - self.now
                reply = self.wait_for(Reply.BOOT_VERSION, within_s=left_s)
            if reply is None:
                break
            if reply.kind is Reply.REQUEST:
                self.measure(TimeName.REQUEST, reply.at - sent.left_at)
                return reply
        return None

    def await_request(self, sent: Sent) -> Received | None:
        """Wait for request transfer, with which a transfer begins, or a boot version."""
        reply = self.host.request_or_version(sent.left_at, self.limit("erase_s"))
        if reply is not None and reply.kind is Reply.REQUEST:
            # The request may have waited for NAKs of update commands before it.
            pause_s, ack_s = self.limit("pause_s"), self.limit("ack_s")
            late_s = min(ack_s, pause_s - self.waits.in_transfer_s(pause_s))
            self.continued_at = max(sent.left_at, reply.at - late_s)
        return reply

    def update_again(self, size_bytes: int, *, may_be_whole: bool = False) -> None:
        """Get request transfer after a transfer that was broken off or refused: from the waiting
        bootloader, or from the old application where the device kept it (rs_03_old) or, with
        `may_be_whole`, had not erased it yet.
        """
        within_s = self.waits.burst_s + self.limit("start_s")
        may_run = may_be_whole or self.profile.allows("rs_03_old", "kept")
        if may_run and self.application_runs(within_s):
            self.reset_to_bootloader()
        self.update(size_bytes)

    def start_transfer(self, size_bytes: int) -> None:
        """Reset the running application and send the update command until request transfer."""
        self.reset_to_bootloader()
        self.update(size_bytes)

    # -- packets and the end ----------------------------------------------------------------------

    def packet(self, image: bytes, number: int) -> None:
        """Send a packet of `image` and require its ACK."""
        sent = self.send_packet(image, number)
        reply = self.expect(Reply.ACK, number=number)
        self.continued_at = sent.left_at
        self.judge.note_listening()
        self.measure(TimeName.ANSWER, reply.at - sent.left_at)

    def packets(self, image: bytes, first: int = 1, last: int | None = None) -> None:
        """Send packets `first` to `last` (default: the last of the image) and require each ACK."""
        final = packet_count(len(image)) if last is None else last
        for number in range(first, final + 1):
            self.packet(image, number)

    def check_packet_rejected(self, wanted: int | None, named: int | None = None) -> bool:
        """Check that the packet just sent was rejected as the profile says (tx_01): NAK with the
        number that the device `wanted`, or with the one that the packet `named` (None: any number).
        A packet number of 0 allows both.
        """
        choice = self.choice("tx_01")
        numbers = {"nak_expected": [wanted], "either": [wanted, named]}.get(choice, [named])
        return self.check_naks([wanted, 0] if numbers == [0] else numbers, choice)

    def check_naks(self, numbers: Collection[int | None], choice: str) -> bool:
        """Check for a NAK with one of `numbers` (None: any), for silence, or for either. `choice`
        is "silence", "either" or a word for a NAK.
        """
        replies = self.answers()
        self.judge.note_stimulus(heard=bool(replies))
        known = sorted({number for number in numbers if number is not None})
        is_open = None in numbers
        right = [
            one for one in replies if one.kind is Reply.NAK and (is_open or one.number in known)
        ]
        nak = "NAK" if is_open else f"NAK {' or '.join(map(str, known))}"
        expected = {"silence": {0: "silence"}, "either": {1: nak, 0: "silence"}}
        wanted = expected.get(choice, {1: nak})
        ok = len(replies) == len(right) in wanted
        return self.check(ok, f"rejected: {' or '.join(wanted.values())}", describe(replies))

    def repetition_answers(self, number: int) -> list[str]:
        """Correct answers when the last stored packet is sent again (tx_02)."""
        words = {"ack": f"ACK {number}", "nak_next": f"NAK {number + 1}"}
        return [answer for word, answer in words.items() if self.profile.allows("tx_02", word)]

    def answers(self) -> list[Received]:
        """Wait for the first answer and any that follow it immediately."""
        first = self.next_message(self.waits.settle_s)
        return [] if first is None else [first, *self.collect(QUIET_S)]

    def gaps(
        self, packet: Sequence[RawFrame], shares: Iterable[float]
    ) -> Iterator[tuple[float, int]]:
        """Gaps to insert between frames: `shares` of `limits.inter_frame_s`, and just below it,
        each with the number of frames to apply it to so that the packet stays shorter than a pause
        (TX-12).
        """
        limit_s, pause_s = self.limit("inter_frame_s"), self.limit("pause_s")
        frame_s = self.tester.wire_s(packet[:1], is_stuffed=True)
        edge_s = frame_s + 2 * self.port.uncertainty_s + _EDGE_S
        for gap_s in (*(share * limit_s for share in shares), max(limit_s - edge_s, 0.0)):
            yield gap_s, min(int(pause_s / 2 / max(gap_s, frame_s)), PACKET_FRAMES) or 1

    def is_pause_near(self, for_s: float) -> bool:
        """True when the silence since the transfer last went on becomes a pause (TX-12) before
        `for_s` more have passed.
        """
        return self.now + for_s >= self.continued_at + self.limit("pause_s")

    def before_pause_s(self, for_s: float) -> float:
        """As much of `for_s` as is left before the silence becomes a pause (TX-12)."""
        if self.choice("tx_12") == "waits":
            return for_s
        return max(0.0, min(for_s, self.continued_at + self.limit("pause_s") - self.now))

    def stay_before(self, image: bytes, number: int) -> None:
        """Where packet `number` of `image` is next: when a pause may end the transfer before a
        stimulus is answered, finish it and begin it again up to here. Several stimuli in a row
        that the device does not take for progress would become a pause.
        """
        stimulus_s = 2 * self.waits.packet_s + self.waits.settle_s + QUIET_S
        if self.choice("tx_12") != "waits" and self.is_pause_near(stimulus_s):
            self.finish(image, number)
            self.start_transfer(len(image))
            self.packets(image, 1, number - 1)

    def end_transfer(self) -> None:
        """Send end of transfer and require complete."""
        sent = self.send(self.encoder.end())
        reply = self.expect(Reply.COMPLETE)
        self.measure(TimeName.COMPLETE, reply.at - sent.left_at)

    def end_padded_transfer(self) -> bool:
        """End the transfer of a `padded` image and require complete. False, recorded as
        unsupported, when the device rejects the image.
        """
        self.send(self.encoder.end())
        within_s = self.limit("complete_s")
        reply = self.wait_for(Reply.COMPLETE, Reply.NAK, within_s=within_s)
        if reply is not None and reply.kind is Reply.NAK:
            why = "the device rejects the padded good image by a check of its own"
            self.unsupported("the padded image runs", why)
            return False
        self.require_received(reply, Reply.COMPLETE.value, within_s)
        return True

    def finish(self, image: bytes, first: int = 1) -> None:
        """Send the packets from `first` on and the end of transfer; check that the image runs."""
        self.packets(image, first)
        self.end_transfer()
        self.check_image(image)

    def transfer_in_parts(self, image: bytes, stops: Iterable[int]) -> Iterator[int]:
        """Transfer `image`, yielding after each packet number in `stops` (0: before packet 1); then
        finish the transfer and check that the image runs.
        """
        self.start_transfer(len(image))
        done = 0
        for stored in stops:
            self.packets(image, done + 1, stored)
            done = stored
            yield stored
        self.finish(image, done + 1)

    def check_upgrade(self, image: bytes | None = None) -> None:
        """Check that the device can be upgraded from its current state, to `image` or the good
        image.
        """
        chosen = self.good_image if image is None else image
        done = self.upgrade(chosen, blind=self.choice("rs_03") == "either")
        self.require(done.ok, "the device can be upgraded", done.reason or "it was")
        self.check_image(chosen)

    # -- what the device holds --------------------------------------------------------------------

    def check_image(self, image: bytes) -> None:
        """Check that the application of `image` runs and that the flash holds it."""
        runs = self._check_runs(image)
        is_stored = self.check_stored(image, runs=True)
        if is_stored is None:  # then the version has to tell them apart
            is_stored = reported_version(self.subject.target, image) is not None
        is_good = runs and is_stored and image == self.good_image
        self._good_since = self.now if is_good else inf

    def check_application(self, image: bytes | None = None) -> None:
        """Check that the application of `image` (default: the good image) runs. Where it reports no
        version, compare the flash if the case may have changed it.
        """
        chosen = self.good_image if image is None else image
        self._check_runs(chosen)
        if self.tester.update_was_sent and reported_version(self.subject.target, chosen) is None:
            self.check_stored(chosen, runs=True)

    def _check_runs(self, image: bytes) -> bool:
        wanted = reported_version(self.subject.target, image)
        if wanted is not None:
            found = self.application_version(self.limit("start_s"))
            got = "no answer" if found is None else f"{found!a}"
            return self.check(found == wanted, f"application {wanted} runs", got)
        runs = self.application_runs()
        return self.check(runs, "the application runs", "it answers" if runs else "no answer")

    def check_stored(self, image: bytes, *, runs: bool = False) -> bool | None:
        """Check that the flash holds exactly `image`; `runs` says that its application is running.
        None, recorded as unsupported, where the bench cannot read the flash.
        """
        expected = "the flash holds the image"
        try:
            differs_at = self.difference(image, runs=runs)
        except Unsupported as missing:
            reports = reported_version(self.subject.target, self.good_image) is not None
            why = "" if reports else ", and the device does not report which application runs"
            self.unsupported(expected, f"{missing}{why}")
            return None
        if differs_at is not None and not runs and self.is_kept_aside(image):
            why = "the device keeps its old application until complete (rs_03_old)"
            self.unsupported(expected, why)
            return None
        got = "the image"
        if differs_at is not None:
            got = f"different bytes from offset {differs_at}"
        elif not self.subject.has_readback:
            total = packet_count(len(image))
            got = f"{min(total, _PIECES)} of {total} pieces, read over the bus"
        # During a transfer, a part of it may still be in a buffer.
        name = "buffer_bytes"
        by = {} if runs else {f"device.{name}": float(self.number(name))}
        return self.check(differs_at is None, expected, got, by=by)

    def is_kept_aside(self, image: bytes) -> bool:
        """True when the device stores a transfer in another place, so that its flash still holds
        the old application and not the `image` received so far.
        """
        choice, size = self.choice("rs_03_old"), len(image)
        if choice != "either" or not self.subject.has_readback:
            return choice != "erased"
        stored = self.subject.readback()[:size]
        known = (self.good_image, self.subject.second_image or self.good_image)
        return any(stored[: len(old)] == old[:size] for old in known)

    def difference(self, image: bytes, *, runs: bool = False) -> int | None:
        """Offset of the first byte in flash that differs from `image`, or None. `runs` says that
        its application is running. Raises Unsupported.
        """
        source = readback_source(self.subject, self.profile)
        if not source:
            raise Unsupported("the bench has no readback")
        if source != BY_BUS:
            stored = self.subject.readback()[: len(image)]
            self.tester.forgive_stall()
            if stored == image:
                return None
            pairs = enumerate(zip(stored, image, strict=False))
            at = next((at for at, (one, other) in pairs if one != other), len(stored))
            return None if at == len(image) else at
        if not runs:
            raise Unsupported("only a running application answers memory queries")
        # Of a large image, read only some pieces, chosen by the seed.
        total = packet_count(len(image))
        numbers = list(range(total))
        if total > _PIECES:
            numbers = sorted({0, total - 1, *self.random.sample(numbers, _PIECES - 2)})
        for number in numbers:
            offset = number * MEMORY_BYTES
            part = image[offset : offset + MEMORY_BYTES]
            memory = self.host.read_memory(self.number("application_address") + offset, len(part))
            if memory is None:
                raise Unsupported("the application answers no memory query")
            if memory != part:
                return offset
        return None

    # -- power, and out of a transfer -------------------------------------------------------------

    def power_off(self) -> None:
        """Switch the device off. Raises Unsupported."""
        self._good_since = inf
        self.subject.power(on=False)
        self.tester.forgive_stall()
        self.is_off = True

    def power_on(self) -> None:
        """Switch the device on. Raises Unsupported."""
        self.subject.power(on=True)
        self.tester.forgive_stall()
        self.is_off = False

    def power_cycle(self, off_s: float = 0.5) -> None:
        """Switch off, wait `off_s`, switch on; discards messages received earlier. Raises
        Unsupported.
        """
        self.power_off()
        self.wait(off_s)
        self.forget()
        self.power_on()

    def restart_transfer(self, size_bytes: int) -> None:
        """Abandon a transfer and start another one: by an update command where the profile allows
        it (up_08), else by `leave_transfer`, which raises Unsupported.
        """
        if self.choice("up_08") == "either" and not self.subject.has_power:
            reply = self.await_request(self.send(self.encoder.update(size_bytes)))
            if reply is not None and reply.kind is Reply.REQUEST:
                return
        if self.choice("up_08") != "starts_over":
            self.leave_transfer()
        self.update(size_bytes)

    def leave_transfer(self) -> None:
        """Abandon a transfer so that the bootloader announces itself without an application: by the
        reset or pause that the profile documents, else by a power cycle, else by trying both.

        Raises Unsupported where none of these is possible.
        """
        self.forget()
        within_s = self.limit("first_version_s")
        pause, reset = self.choice("tx_12"), self.choice("tx_13")
        if reset == "restarts":
            self.send(self.encoder.reset())
        elif pause == "announces":
            within_s += self.limit("pause_s")
        elif self.subject.has_power:
            within_s = 0.0
        elif "either" in (pause, reset):
            self.send(self.encoder.reset())
            within_s += _PAUSES * self.limit("pause_s")
            if self.wait_for(Reply.BOOT_VERSION, within_s=within_s) is None:
                raise Unsupported("no power control, and neither reset nor a pause ends a transfer")
            return
        else:
            raise Unsupported("no power control, and nothing else ends a transfer (tx_12, tx_13)")
        if not self.subject.has_power:
            self.await_message(Reply.BOOT_VERSION, within_s=within_s)
        elif self.wait_for(Reply.BOOT_VERSION, within_s=within_s) is None:
            self.power_cycle()
            self.await_message(Reply.BOOT_VERSION)
