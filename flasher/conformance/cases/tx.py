"""TX: transfer. Damaged or repeated packets, wrong headers, the largest image, pauses, resets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.judge import TimeName
from flasher.conformance.patient_host import LEFTOVER_S, UPDATE_SPACING_S
from flasher.conformance.restore import needs_power
from flasher.conformance.results import Unsupported
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
)

_PACKETS_MIN: Final = 7
_DATA_AT: Final = 40
"""An offset inside the 128 data bytes of a packet."""
_LOST_FRAMES: Final = (0, 1, 9, 17)
"""The first frame, the frame in which the number ends, a data frame and the last frame."""
_NUMBER_IN: Final = 1
_BUFFER_BYTES: Final = 4096
"""Bytes that a device that writes whole pages may hold back until end of transfer."""
_REPEATS: Final = 2
_PAGE_ENDS: Final = (8, 16, 32)
"""Last packets of pages of 1, 2 and 4 KiB."""
_NUMBER_MAX: Final = 0xFFFF
_PAST_WRAP: Final = 257
"""The low byte of its number is that of packet 1."""
_STORED: Final = 3
"""Packets stored before packets with a wrong header are sent."""
_START_BYTES: Final = (0x00, 0x02, 0x04, 0x10, 0x81, 0xFF)
_UNFINISHED_PACKETS: Final = 3
"""Packets of an unfinished transfer."""
_SHORT: Final = 0.5
"""Share of limits.pause_s that does not count as a pause."""
_LONG: Final = 1.5
_JUST_NOT: Final = 0.9
_WRAP_S: Final = 66.0
"""Longer than 65.536 s, the range of a 16-bit millisecond counter."""
_APART_S: Final = 3.0


def transfer_image(bench: Bench, chosen: bytes | None = None) -> bytes:
    """An image for transfers with faults, by default one that looks like firmware. Raises
    Unsupported when it is too small.
    """
    image = bench.firmware.good if chosen is None else chosen
    if packet_count(len(image)) < _PACKETS_MIN:
        raise Unsupported(f"the good image has fewer than {_PACKETS_MIN} packets")
    return image


def _transfer_stopping_at(bench: Bench, image: bytes, numbers: Iterable[int]) -> Iterator[int]:
    """Transfer `image` and stop before each of these packets; after the case resumes, the packet is
    sent unchanged and has to be accepted. Ends with a check that the image runs.
    """
    bench.start_transfer(len(image))
    done = 0
    for number in numbers:
        bench.packets(image, done + 1, number - 1)
        yield number
        with bench.step(f"packet {number} as it should be"):
            bench.send_packet(image, number)
            # After a lost frame a NAK may come as late as the next message (FR-05).
            bench.expect(Reply.ACK, number=number, ignoring=(Reply.NAK,))
        done = number
    bench.finish(image, done + 1)


def check_out_of_turn(bench: Bench, frames: Sequence[RawFrame]) -> None:
    """Send a packet or end of transfer to the announcing bootloader and check that no ACK, complete
    or request transfer follows.
    """
    bench.reset_to_window()
    bench.send(frames)
    replies = bench.collect(bench.waits.burst_s + bench.limit("inter_frame_s"))
    bench.judge.note_stimulus(heard=any(one.kind is Reply.NAK for one in replies))
    bench.judge.note_listening(listens=False)  # silence does not show whether it listens
    positive = [one for one in replies if one.kind in (Reply.ACK, Reply.COMPLETE, Reply.REQUEST)]
    bench.check(not positive, "neither ACK nor complete", describe(positive or replies))


# -- damage ---------------------------------------------------------------------------------------


@case(
    "TX-01",
    "damaged packet",
    clause="Welling 5.1, figure 2 (packets); Welling 5.2, table 9 (C202, C302)",
    stimulus="first, second and last packet with a wrong CRC, with a wrong bit, without a frame",
    expectation="rejected (tx_01, tx_01_lost_frame); accepted when it is sent again",
    requires={DESTRUCTIVE},
    choices=("tx_01", "tx_01_lost_frame"),
)
def damaged(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    lost = {3 + place: index for place, index in enumerate(_LOST_FRAMES)}
    for number in _transfer_stopping_at(bench, image, (1, 2, *lost, total)):
        if number in lost:
            index, choice = lost[number], bench.choice("tx_01_lost_frame")
            trusts_it = bench.choice("tx_01") in ("nak_received", "either")
            with bench.step(f"packet {number} without its frame {index + 1}"):
                bench.stay_before(image, number)
                frames = bench.encoder.packet_of(image, number)
                bench.send(frames[:index] + frames[index + 1 :])
                # Without its first frame the message cannot be recognised as a packet.
                named = None if trusts_it and index <= _NUMBER_IN else number
                bench.check_naks([named], choice if index else "either")
            continue
        neighbours = {
            number: "wrong CRC",
            number + 1: "the next one came, with a wrong CRC",
            number - 1: "the one before came, with a wrong CRC",
        }
        for named, step in neighbours.items():
            if 1 <= named <= total:
                with bench.step(f"packet {number}, {step}"):
                    bench.stay_before(image, number)
                    bench.send(bench.encoder.damaged_packet_of(image, named))
                    bench.check_packet_rejected(number, named)
        with bench.step(f"packet {number}, a wrong bit"):
            bench.stay_before(image, number)
            raw = bytearray(joined(bench.encoder.packet_of(image, number)))
            raw[_DATA_AT] ^= 0x10
            bench.send(bench.encoder.frames(bytes(raw)))
            bench.check_packet_rejected(number, number)


# -- repetitions ----------------------------------------------------------------------------------


@case(
    "TX-02",
    "ACK lost",
    clause="Welling 5.1, figure 2 (packets); R10",
    stimulus="first, second and last packet, and the last one of a page, sent again after their "
    "ACK, twice each",
    expectation="ACK n again (tx_02), one answer per copy; nothing is written twice",
    requires={DESTRUCTIVE},
    choices=("tx_02",),
)
def repeated(bench: Bench) -> None:
    _repeat(bench, lambda payload: payload)


@case(
    "TX-05",
    "repeated number with other data",
    clause="R10",
    stimulus="first, second and last packet, and the last one of a page, again, with other data "
    "and a right CRC",
    expectation="answered as a repetition (tx_02); the first data are kept",
    requires={DESTRUCTIVE},
    choices=("tx_02",),
)
def other_data(bench: Bench) -> None:
    _repeat(bench, inverted)


def _repeat(bench: Bench, changed: Callable[[bytes], bytes]) -> None:
    """Transfer with repeated packets whose data are the `changed` data of the first copy."""
    image, choice = transfer_image(bench), bench.choice("tx_02")
    total = packet_count(len(image))
    ends = (number for number in _PAGE_ENDS if number < total)
    for number in bench.transfer_in_parts(image, (1, 2, *ends, total)):
        payload = changed(packet_payload(image, number))
        allowed = bench.repetition_answers(number)
        # After the last packet there is no next packet to request.
        more = [f"ACK {number}", f"NAK {number}"] if number == total and choice != "ack" else []
        for copy in range(1, _REPEATS + 1):
            with bench.step(f"packet {number}, repetition {copy}"):
                bench.stay_before(image, number + 1)
                bench.send(bench.encoder.packet(number, total, payload))
                replies = describe(bench.answers())
                expected = f"{' or '.join(allowed)} for the repeated packet"
                bench.check(replies in (*allowed, *more), expected, replies)


# -- wrong heads ----------------------------------------------------------------------------------


@case(
    "TX-03",
    "packet numbers out of order",
    clause="Welling 5.2, table 8 (A385); R10",
    stimulus="before packet 1, after packet 3 and after the last one: a number skipped, the last "
    "one, 0, beyond the total, the right one and 256, 65535; older ones, with right and with other "
    "data; packets to the announcing bootloader",
    expectation="rejected (tx_01), older packets as the profile says (tx_03); none of the data is "
    "stored",
    requires={DESTRUCTIVE},
    choices=("tx_01", "tx_03"),
)
def out_of_order(bench: Bench) -> None:
    image, choice = transfer_image(bench), bench.choice("tx_03")
    total = packet_count(len(image))
    with bench.step("without a transfer"):
        check_out_of_turn(bench, bench.encoder.packet_of(image, 1))
        bench.check_application()
    for stored in bench.transfer_in_parts(image, (0, _STORED, total)):
        beyond = (stored + 2, total, 0, total + 1, _NUMBER_MAX, stored + 1 + 256)
        for number in dict.fromkeys(beyond):
            # The packet stored last is a repetition (TX-02), and 65536 does not fit the field.
            if 0 < number == stored or number > _NUMBER_MAX:
                continue
            with bench.step(f"after packet {stored}, number {number}"):
                bench.stay_before(image, stored + 1)
                bench.send(bench.encoder.packet(number, total, bytes(PACKET_BYTES)))
                # When all packets are stored, any number in a NAK is correct.
                is_open = stored == total
                bench.check_packet_rejected(*(None, None) if is_open else (stored + 1, number))
        for number in range(1, _STORED) if stored == _STORED else ():
            payload = packet_payload(image, number)
            for what, data in (("the right", payload), ("other", inverted(payload))):
                with bench.step(f"after packet {stored}, packet {number} with {what} data"):
                    bench.stay_before(image, stored + 1)
                    bench.send(bench.encoder.packet(number, total, data))
                    if choice in ("nak", "silence"):
                        bench.check_naks([number, _STORED + 1], choice)
                        continue
                    allowed = [f"ACK {number}"]
                    if choice == "either":
                        allowed += ["nothing", f"NAK {number}", f"NAK {_STORED + 1}"]
                    answers = bench.answers()
                    bench.judge.note_stimulus(heard=bool(answers))
                    replies = describe(answers)
                    bench.check(replies in allowed, " or ".join(allowed), replies)


@case(
    "TX-04",
    "total that does not fit the size",
    clause="Welling 5.2, table 8 (A385)",
    stimulus="packet 1, 4 and the last one with a total that is 1 less, 1 more, 256 more, 0, 65535 "
    "or high byte first",
    expectation="rejected (tx_01); accepted with the right total",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def wrong_total(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    swapped = int.from_bytes(total.to_bytes(2, "little"), "big")
    wrong = dict.fromkeys((total - 1, total + 1, total + 256, 0, _NUMBER_MAX, swapped))
    wrong.pop(total, None)
    for number in _transfer_stopping_at(bench, image, (1, _STORED + 1, total)):
        for named in wrong:
            with bench.step(f"packet {number} of {named}"):
                bench.stay_before(image, number)
                bench.send(bench.encoder.packet(number, named, packet_payload(image, number)))
                bench.check_packet_rejected(number, number)


@case(
    "TX-06",
    "wrong start byte",
    clause="Welling 5.2, table 8 (A385)",
    stimulus="packet 1, 4 and the last one starting with 00, 02, 04, 10, 81 and FF",
    expectation="rejected (tx_01); accepted with 01",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def wrong_start_byte(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    for number in _transfer_stopping_at(bench, image, (1, _STORED + 1, total)):
        payload = packet_payload(image, number)
        for start in _START_BYTES:
            with bench.step(f"packet {number} with {start:02X}"):
                bench.stay_before(image, number)
                bench.send(bench.encoder.packet(number, total, payload, start=start))
                bench.check_packet_rejected(number, number)


# -- the ends of the range ------------------------------------------------------------------------


@case(
    "TX-07",
    "many packets",
    clause="Welling 5.2, table 8 (A385); R4; R9",
    stimulus="the largest image, begun anew after packet 257; all its packets: across 255/256, up "
    "to the last one; then the good image padded with FF, including end of transfer",
    expectation="every packet is accepted and stored at its place; the second image runs",
    requires={DESTRUCTIVE, LONG},
    largest=2,
    choices=("device.largest_image_bytes",),
)
def many_packets(bench: Bench) -> None:
    if needs_power(bench.profile) and not bench.subject.has_power:
        raise Unsupported(
            "only a power cycle ends a transfer of this product, and the bench cannot switch power"
        )
    size = bench.number("largest_image_bytes")
    image = bench.random.randbytes(size)
    bench.start_transfer(size)
    if packet_count(size) > _PAST_WRAP:
        if not _send_all(bench, image, _PAST_WRAP):
            return
        bench.restart_transfer(size)
    if not _send_all(bench, image):
        return
    # Not ended, since the image cannot run; skip what may still be buffered.
    buffer_bytes = max(_BUFFER_BYTES, bench.number("buffer_bytes"))
    if size > buffer_bytes:
        bench.check_stored(image[:-buffer_bytes])
    else:
        bench.unsupported("the flash holds the image", "all of it may still be buffered")
    with bench.step("once more, to its end"):
        bench.leave_transfer()
        whole = bench.padded(size)
        bench.update(len(whole))
        if not _send_all(bench, whole):
            return
        if bench.end_padded_transfer():
            bench.check_image(whole)


def _send_all(bench: Bench, image: bytes, last: int | None = None) -> bool:
    """Send all packets, or those up to `last`, and record one check, as up to 65535 would be too
    many; False on failure.
    """
    total = last or packet_count(len(image))
    for number in range(1, total + 1):
        sent = bench.send_packet(image, number)
        reply = bench.next_message(bench.limit("ack_s"))
        if reply is None or (reply.kind, reply.number) != (Reply.ACK, number):
            bench.fail(f"ACK {number}", reply or "nothing")
            return False
        bench.measure(TimeName.ANSWER, reply.at - sent.left_at)
    bench.succeed(f"ACK 1 to {total}", "all of them")
    return True


@case(
    "TX-08",
    "last packet not filled with FF",
    clause="Welling 5.2, table 8 (A385)",
    stimulus="bytes other than FF after the end of the image in the last packet",
    expectation="ignored or rejected (tx_08)",
    requires={DESTRUCTIVE},
    choices=("tx_08", "tx_01"),
)
def other_filler(bench: Bench) -> None:
    images = (bench.good_image, bench.subject.second_image or b"")
    image = next((one for one in images if len(one) % PACKET_BYTES), b"")
    if not image:
        raise Unsupported("every good image fills its last packet, so there are no filler bytes")
    total = packet_count(len(image))
    rest = image[(total - 1) * PACKET_BYTES :]
    bench.start_transfer(len(image))
    bench.packets(image, 1, total - 1)
    bench.send(bench.encoder.packet(total, total, rest.ljust(PACKET_BYTES, b"\x00")))
    if bench.choice("tx_08") == "either":
        reply = bench.next_message(bench.limit("ack_s"))
        is_there = reply is None or reply.kind is Reply.NAK or str(reply) == f"ACK {total}"
        bench.check(is_there, f"ACK {total}, NAK or silence", reply or "nothing")
        taken = reply is not None and reply.kind is Reply.ACK
        bench.finish(image, total + 1 if taken else total)
    elif bench.choice("tx_08") == "ignored":
        bench.expect(Reply.ACK, number=total)
        bench.finish(image, total + 1)
    else:
        bench.check_packet_rejected(total, total)
        bench.finish(image, total)


# -- pauses and resets ----------------------------------------------------------------------------


@case(
    "TX-12",
    "pause in a transfer",
    clause="R12; R14",
    stimulus="half of limits.pause_s before a packet; a longer pause before packet 1, between "
    "packets and before the end; a transfer of more than 66 s without a pause",
    expectation="announces again or keeps waiting (tx_12); reachable; the long transfer continues",
    requires={DESTRUCTIVE, LONG},
    choices=("tx_12", "limits.pause_s"),
    upgrades=80,
)
def pause(bench: Bench) -> None:
    with bench.step("a long transfer"):
        _send_slowly(bench)
    kinds = {"announces": _announces, "waits": _waits, "either": _announces_or_waits}
    kinds[bench.choice("tx_12")](bench)


def _send_slowly(bench: Bench) -> None:
    """Send packets up to half a pause apart until a 16-bit millisecond counter has overflowed, then
    leave the transfer: no packet may count as late.
    """
    if needs_power(bench.profile) and not bench.subject.has_power:
        why = (
            "only a power cycle ends a transfer of this product, and the bench cannot switch power"
        )
        bench.unsupported("a long transfer", why)
        return
    apart_s = min(_SHORT * bench.limit("pause_s"), _APART_S)
    count = int(_WRAP_S / max(apart_s, 0.01)) + 2
    if count > packet_count(bench.number("largest_image_bytes")):
        bench.unsupported("a long transfer", "the largest image has too few packets")
        return
    image = bench.filler(count)[: bench.number("largest_image_bytes")]
    bench.start_transfer(len(image))
    for number in range(1, count + 1):
        bench.packet(image, number)
        bench.wait(apart_s)
    bench.restart_transfer(len(bench.good_image))
    bench.finish(bench.good_image)


def _announces(bench: Bench) -> None:
    image = bench.filler(_UNFINISHED_PACKETS)[:-1]
    pause_s = bench.limit("pause_s")
    bench.start_transfer(len(image))
    with bench.step("a short pause"):
        bench.wait(_SHORT * pause_s)
        bench.packet(image, 1)
    for stored in (1, _UNFINISHED_PACKETS, 0):
        with bench.step(_step_text("a pause", stored)):
            # After the short pause packet 1 is stored; a long pause ended the transfer.
            if stored != 1:
                bench.update(len(image))
            bench.packets(image, 2 if stored == 1 else 1, stored)
            began_at = bench.now
            within_s = pause_s + bench.limit("first_version_s")
            reply = bench.expect(Reply.BOOT_VERSION, within_s=within_s)
            bench.measure("pause to boot version", reply.at - began_at)
    with bench.step("upgrade after the pauses"):
        bench.update(len(bench.good_image))
        bench.finish(bench.good_image)


def _announces_or_waits(bench: Bench) -> None:
    """Check that after a pause the transfer continues or restarts, and that an update command that
    ended a transfer before a pause still does so.
    """
    image = transfer_image(bench)
    # A device that restarts is not sent anything before it has announced itself.
    pause_s = _LONG * bench.limit("pause_s") + bench.limit("first_version_s")
    bench.start_transfer(len(image))
    with bench.step("a short pause"):
        bench.wait(_SHORT * bench.limit("pause_s"))
        bench.packet(image, 1)
    for stored in (1, packet_count(len(image))):
        with bench.step(_step_text("a pause", stored)):
            bench.packets(image, 2, stored)
            reply = bench.wait_for(Reply.BOOT_VERSION, within_s=pause_s)
            bench.info(f"after {pause_s:g} s: {reply or 'nothing'}")
            if reply is not None:
                bench.update(len(image))
                bench.packets(image, 1, stored)
    bench.finish(image, packet_count(len(image)) + 1)
    with bench.step("an update command before a pause, and after one"):
        bench.start_transfer(len(image))
        bench.packet(image, 1)
        bench.send(bench.encoder.update(len(image)))
        within_s = bench.limit("pause_s") / 2
        if bench.wait_for(Reply.REQUEST, within_s=within_s) is None:
            bench.unsupported("a new upgrade after a pause", "an update command does not start one")
            return
        bench.packet(image, 1)
        bench.collect(pause_s)
        bench.update_again(len(image))
        bench.finish(image)


def _waits(bench: Bench) -> None:
    image = transfer_image(bench)
    pause_s = _LONG * bench.limit("pause_s")
    for stored in bench.transfer_in_parts(image, (0, 1, packet_count(len(image)))):
        with bench.step(_step_text("a pause", stored)):
            bench.expect_silence(pause_s)
    with bench.step("a new upgrade after a pause"):
        starts_over = bench.choice("up_08") == "starts_over"
        can_leave = bench.choice("tx_13") == "restarts" or bench.subject.has_power
        if not (starts_over or can_leave):
            bench.unsupported("a new upgrade", "only a power cycle ends a transfer of this product")
            return
        bench.start_transfer(len(image))
        bench.expect_silence(pause_s)
        if not starts_over:
            bench.leave_transfer()
        bench.update(len(image))
        bench.finish(image)


@case(
    "TX-13",
    "reset in a transfer",
    clause="R18",
    stimulus="reset during the erase, before packet 1, between packets and before the end",
    expectation="ignored, or restarts (tx_13); a new upgrade succeeds",
    requires={DESTRUCTIVE},
    choices=("tx_13",),
)
def reset(bench: Bench) -> None:
    choice, image = bench.choice("tx_13"), transfer_image(bench)
    total = packet_count(len(image))
    with bench.step("reset during the erase"):
        _reset_while_it_erases(bench)
    bench.start_transfer(len(image))
    done = 0
    for stored in (0, 1, total):
        with bench.step(_step_text("reset", stored)):
            bench.packets(image, done + 1, stored)
            done = stored
            bench.send(bench.encoder.reset())
            if choice == "ignored":
                bench.expect_silence(why="silence, no restart")
                continue
            reply, done = restarted(bench, image, stored)
            if choice == "restarts":
                within_s = bench.limit("first_version_s")
                bench.require_received(reply, Reply.BOOT_VERSION.value, within_s)
            if reply is not None:
                bench.update(len(image))
                bench.packets(image, 1, stored)
    bench.finish(image, min(done, total) + 1)
    with bench.step("a new upgrade"):
        bench.start_transfer(len(image))
        bench.finish(image)


def restarted(bench: Bench, image: bytes, stored: int) -> tuple[Received | None, int]:
    """After a reset with `stored` packets stored: the boot version of a restart, or None, and how
    many packets are stored then. Raises CaseStopped for a device that does not answer.
    """
    reply = bench.wait_for(Reply.BOOT_VERSION, within_s=_restart_s(bench))
    if reply is not None or bench.limit("first_version_s") <= _restart_s(bench):
        return reply, stored
    reply = _restarts_later(bench, image, stored)
    return reply, stored + (reply is None and stored < packet_count(len(image)))


def _restart_s(bench: Bench) -> float:
    """How long to wait for a restart: the next packet has to be answered before a pause that ends
    the transfer.
    """
    within_s, pause_s = bench.limit("first_version_s"), bench.limit("pause_s")
    if bench.choice("tx_12") == "waits":
        return within_s
    return min(within_s, max(_JUST_NOT * pause_s - bench.limit("ack_s"), pause_s / 2))


def _restarts_later(
    bench: Bench, image: bytes, stored: int, early: Received | None = None
) -> Received | None:
    """Send what is next, to learn whether the device ignored a reset or is still restarting.
    Returns its boot version, or None when it answers; `early` when it does neither.
    """
    total, within_s = packet_count(len(image)), bench.limit("first_version_s")
    number = min(stored + 1, total)  # a repetition when all are stored
    bench.send_packet(image, number)
    kinds = (Reply.ACK, Reply.NAK, Reply.BOOT_VERSION)
    reply = bench.wait_for(*kinds, within_s=within_s) or early
    reply = bench.require_received(reply, "an answer, or boot version", within_s)
    return reply if reply.kind is Reply.BOOT_VERSION else None


def _reset_while_it_erases(bench: Bench) -> None:
    """Send a reset right after the update command. The device may request the transfer or announce
    itself, and has to accept an upgrade.
    """
    image = bench.good_image
    bench.reset_to_window()
    bench.send(bench.encoder.update(len(image)) + bench.encoder.reset())
    # Boot versions sent before the update command arrived do not count (R11).
    bench.wait(UPDATE_SPACING_S)
    within_s = bench.limit("erase_s") + bench.limit("first_version_s")
    reply = bench.wait_for(Reply.REQUEST, Reply.BOOT_VERSION, within_s=within_s)
    found = bench.require_received(reply, "request transfer, or boot version", within_s)
    restarts: Received | None = found
    early: Received | None = None
    is_begun = False
    if found.kind is Reply.REQUEST and bench.choice("tx_13") != "ignored":
        # The device may process the reset after the erase. What it announces at first may be from
        # before the update command (R11), or a whole burst of a few.
        early = bench.wait_for(Reply.BOOT_VERSION, within_s=LEFTOVER_S)
        restarts = early if bench.choice("tx_13") == "restarts" else None
        within_s = _restart_s(bench)
        restarts = restarts or bench.wait_for(Reply.BOOT_VERSION, within_s=within_s)
        if restarts is None and (early or bench.limit("first_version_s") > within_s):
            restarts = _restarts_later(bench, image, 0, early)
            is_begun = restarts is None
    if restarts is not None and restarts.kind is Reply.BOOT_VERSION:
        bench.collect(bench.waits.burst_s)  # what is left of a burst it may not listen in
        bench.update_again(len(image), may_be_whole=found.kind is Reply.BOOT_VERSION)
    bench.finish(image, 2 if is_begun else 1)


def _step_text(what: str, stored: int) -> str:
    return f"{what} after packet {stored}" if stored else f"{what} before packet 1"
