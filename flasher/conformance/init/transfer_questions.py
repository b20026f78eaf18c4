"""Questions about packets, pauses and resets in a transfer, and about its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import floor
from typing import Final

from flasher.conformance.cases.fr import PADDINGS, PacketForm, forms
from flasher.conformance.cases.tx import restarted
from flasher.conformance.init.answers import LONGEST, Findings, Trial, gap_answer, pause_answer
from flasher.conformance.init.session import ANSWER_S, REPEATS, InitSession, answer_text
from flasher.conformance.judge import TimeName
from flasher.conformance.profile import choice_words
from flasher.conformance.results import KeyAnswer
from flasher.conformance.wire import (
    PACKET_BYTES,
    RawFrame,
    Received,
    Reply,
    joined,
    packet_count,
    packet_payload,
    padded_to_frame,
)

_LOST_FRAMES: Final = (1, 9, 17)
_RANDOM_SPLITS: Final = 4
_SHARES: Final = (0.1, 0.25, 0.5, 0.75, 0.9)
_FIRST_GAP_S: Final = 0.05
_GAP_WATCHED_S: Final = 1.6
_GAP_RESOLUTION_S: Final = 0.002
_LATER_S: Final = 0.5
_PAUSE_WATCHED_S: Final = 30.0
_PAUSE_RESOLUTION_S: Final = 0.05
"""Of a pause of 1 s, and a share of a longer one."""
_END_ANSWERS: Final = (Reply.REQUEST, Reply.ACK, Reply.NAK, Reply.COMPLETE)
_SEVERAL_PAGES: Final = 65
"""Packets, one more than 8 KiB."""


# -- repetitions and bad packets ------------------------------------------------------------------


def _repeat_trial(
    session: InitSession, stimulus: str, frames: Sequence[RawFrame], words: Mapping[str, str]
) -> Iterator[Trial]:
    """Send `frames` several times; `words` maps answers to values, with "NAK" for any other NAK."""
    for _ in range(REPEATS):
        session.bench.stay_before(session.image, session.number)
        session.bench.forget()
        session.bench.send(frames)
        replies = session.bench.answers()
        is_nak = [one.kind for one in replies] == [Reply.NAK]
        value = words.get(answer_text(replies)) or words.get(Reply.NAK.value if is_nak else "", "")
        yield Trial(value, answer_text(replies), stimulus)


def repeated_packet(session: InitSession) -> Findings:
    """Determine the answer to a repetition of the last stored packet."""
    session.begin()
    for stored in (1, 2):
        session.reach(stored, 1)
        words = {f"ACK {stored}": "ack", f"NAK {stored + 1}": "nak_next"}
        yield from _repeat_trial(session, f"packet {stored} again", session.packet(stored), words)
    session.finish()


def older_packet(session: InitSession) -> Findings:
    """Determine the answer to a packet older than the last stored one."""
    session.begin()
    session.reach(3, 1)
    for number in (1, 2):
        words = {f"ACK {number}": "ack", "silence": "silence", "NAK": "nak"}
        stimulus = f"packet {number} after packet {session.stored}"
        yield from _repeat_trial(session, stimulus, session.packet(number), words)
    session.finish()


def bad_packet(session: InitSession) -> Findings:
    """Determine the answer to damaged or impossible packets."""
    trials = list[Trial]()
    session.begin()
    session.reach(2, 3)
    wanted, after, encoder = session.stored + 1, session.stored + 2, session.bench.encoder
    payload = packet_payload(session.image, wanted)
    stimuli = {
        f"packet {wanted} with a wrong CRC": (
            wanted,
            encoder.damaged_packet_of(session.image, wanted),
        ),
        f"packet {after} with a wrong CRC": (
            after,
            encoder.damaged_packet_of(session.image, after),
        ),
        f"packet {after} instead of {wanted}": (after, session.packet(after)),
        f"packet {wanted} of {session.total + 1}": (
            wanted,
            encoder.packet(wanted, session.total + 1, payload),
        ),
        f"packet {wanted} with the start byte 02": (
            wanted,
            encoder.packet(wanted, session.total, payload, start=2),
        ),
    }
    for stimulus, (named, frames) in stimuli.items():
        words = {f"NAK {named}": "nak_received", f"NAK {wanted}": "nak_expected"}
        if wanted == named:
            words = {f"NAK {named}": "nak"}
        trials += _repeat_trial(session, stimulus, frames, {**words, "silence": "silence"})
    session.deliver_packet()
    session.finish()
    # A NAK with the only number that both rules give does not tell them apart.
    telling = {trial.value for trial in trials} - {"nak"}
    if len(telling) == 1:
        (value,) = telling
        mixed = value == "silence" and any(trial.value == "nak" for trial in trials)
        word = "either" if mixed else value
    else:
        word = "either" if telling else ""
    if "" in telling:
        word = ""
    yield from (trial._replace(value=word) for trial in trials)


def lost_frame(session: InitSession) -> Findings:
    """Determine the answer to packets with a lost frame."""
    bench = session.bench
    session.begin()
    for index in _LOST_FRAMES:
        for _ in range(REPEATS):
            session.reach(1, 2)
            bench.forget()
            frames = session.frames()
            sent = bench.send(frames[:index] + frames[index + 1 :])
            late_at = bench.now + bench.waits.settle_s
            until = late_at + _LATER_S
            replies, has_left = list[Received](), False
            while (one := bench.next_message(until - bench.now)) is not None:
                has_left = one.kind is Reply.BOOT_VERSION
                if has_left:  # an update command later in the burst may not be received
                    break
                replies.append(one)
                until = min(until, bench.now + _LATER_S)
                if one.kind is Reply.NAK:  # counted from when the device may notice the gap
                    noticed_at = sent.left_at + bench.limit("inter_frame_s")
                    bench.measure(TimeName.REJECTED, max(one.at - noticed_at, 0.0))
            kinds = [one.kind for one in replies]
            value = {0: "silence", 1: "nak"}.get(len(kinds), "")
            if kinds not in ([], [Reply.NAK]):
                value = ""
            is_late = any(one.at > late_at for one in replies)
            answer = answer_text(replies) + (", late" if is_late else "")
            stimulus = f"a packet without its frame {index + 1}"
            yield Trial(value, answer.replace(f" {session.stored + 1}", ""), stimulus)
            if has_left:
                session.begin_again(session.stored + 1)
            else:
                session.deliver_packet()
    session.finish()


def filler(session: InitSession) -> Findings:
    """Determine whether bytes other than FF after the end of the image are accepted."""
    bench = session.bench
    rest = session.image[(session.total - 1) * PACKET_BYTES :]
    if len(rest) == PACKET_BYTES:
        yield "the good image fills its last packet"
        return
    for _ in range(REPEATS):
        session.begin()
        session.packets(session.total - 1)
        other = bench.encoder.packet(session.total, session.total, rest.ljust(PACKET_BYTES, b"\0"))
        bench.send(other)
        replies = answer_text(bench.answers())
        taken = replies == f"ACK {session.total}"
        value = "ignored" if taken else "rejected"
        yield Trial(value, replies, f"packet {session.total}, filled with 00")
        if taken:
            session.stored = session.total
        session.finish()


# -- framing --------------------------------------------------------------------------------------


def splits(session: InitSession) -> Findings:
    """Determine whether messages in other frame sizes are accepted."""
    bench = session.bench
    for _ in range(REPEATS):
        session.enter()
        bench.wait_for_window()
        update = joined(bench.encoder.update(len(session.image)))
        taken = session.offer_update(bench.encoder.frames(update, 5))
        yield _accepted_trial(taken, "update command in frames of 5 bytes")
        if not taken:  # the window has ended
            session.await_application()
            session.begin()
        for form in forms(bench.encoder)["fr_01"]:
            yield _offer_form(session, form, "fr_01")
        for _ in range(_RANDOM_SPLITS):
            session.reach(0, 1)
            taken = session.offer(bench.encoder.frames_by_chance(session.raw(), bench.random))
            yield _accepted_trial(taken, "a packet in frames of 1 to 8 bytes")
        session.finish()


def in_forms(session: InitSession, key: str) -> Findings:
    """Determine whether the packet forms of one profile key are accepted."""
    session.begin()
    for form in forms(session.bench.encoder)[key]:
        for _ in range(REPEATS):
            yield _offer_form(session, form, key)
    session.finish()


def _offer_form(session: InitSession, form: PacketForm, key: str) -> Trial:
    session.reach(0, 1)
    taken = session.offer(
        session.bench.encoder.frames(form.before + session.raw(), form.frame_bytes)
    )
    return _accepted_trial(taken, form.asked, *choice_words(key))


def padded(session: InitSession) -> Findings:
    """Determine whether padded update commands and ends of transfer are accepted."""
    bench = session.bench
    for byte in PADDINGS:
        session.enter()
        bench.wait_for_window()
        taken = session.offer_update(
            padded_to_frame(bench.encoder.update(len(session.image)), byte)
        )
        form = f"padded with {byte:02X}"
        yield _accepted_trial(taken, f"update command {form}", "ignored", "rejected")
        if not taken:  # the window has ended
            session.await_application()
            session.begin()
        session.packets()
        bench.forget()
        sent = bench.send(padded_to_frame(bench.encoder.end(), byte))
        # Without complete, the transfer lasts, or ends by a pause and a restart.
        within_s = bench.limit("complete_s")
        if bench.profile.allows("tx_12", "announces"):
            within_s = max(within_s, bench.limit("pause_s") + bench.limit("first_version_s"))
        reply = bench.wait_for(Reply.COMPLETE, Reply.BOOT_VERSION, within_s=within_s)
        taken = reply is not None and reply.kind is Reply.COMPLETE
        yield _accepted_trial(taken, f"end {form}", "ignored", "rejected")
        if reply is not None and taken:
            bench.measure(TimeName.COMPLETE, reply.at - sent.left_at)
            session.await_application()
            continue
        if reply is not None:
            session.update()
        session.finish()


def frame_gap(session: InitSession) -> Findings:
    """Determine the longest gap between two frames of a packet that is accepted, by bisection."""
    bench = session.bench
    low_s, high_s = 0.0, 0.0
    longest_s = _GAP_WATCHED_S
    if bench.choice("tx_12") == "announces":
        longest_s = min(longest_s, bench.limit("pause_s") / 2)
    resolution_s = max(_GAP_RESOLUTION_S, 2 * bench.port.uncertainty_s)
    session.begin()
    while not high_s or high_s - low_s > resolution_s:
        if low_s >= longest_s:
            yield f"frames {low_s:.2f} s apart are accepted; the default is kept"
            break
        asked_s = (low_s + high_s) / 2 if high_s else min(max(2 * low_s, _FIRST_GAP_S), longest_s)
        session.reach(0, 1)
        # One that still writes the last packet sees a shorter gap.
        bench.wait_until(bench.tester.left_at + bench.limit("ack_s") / LONGEST)
        taken = session.offer(session.frames(), gap_s=asked_s, gaps=1)
        low_s, high_s = (asked_s, high_s) if taken else (low_s, asked_s)
    else:
        # The device counts from the end of a frame to the end of the next one.
        low_s, high_s = (
            each_s + bench.tester.wire_s(session.packet(1)[:1]) for each_s in (low_s, high_s)
        )
        seen = (
            f"a frame accepted {low_s * 1000:.0f} ms after the previous one, rejected after "
            f"{high_s * 1000:.0f} ms, by bisection"
        )
        yield gap_answer("limits.inter_frame_s", low_s, seen, bench.port.uncertainty_s)
    session.finish()


def gaps(session: InitSession) -> Findings:
    """Determine whether packets with gaps between their frames are accepted."""
    session.begin()
    for gap_s, count in session.bench.gaps(session.frames(), _SHARES):
        for _ in range(REPEATS):
            session.reach(0, 1)
            taken = session.offer(session.frames(), gap_s=gap_s, gaps=count)
            stimulus = f"a packet with {gap_s * 1000:.1f} ms between its frames"
            yield _accepted_trial(taken, stimulus, "accepted", "either")
    session.finish()


def _accepted_trial(
    taken: bool,  # noqa: FBT001
    stimulus: str,
    yes: str = "accepted",
    no: str = "rejected",
) -> Trial:
    return Trial(yes if taken else no, "accepted" if taken else "rejected", stimulus, "")


# -- update command, pause and reset in a transfer ------------------------------------------------


def update_again(session: InitSession) -> Findings:
    """Determine the effect of an update command after packet 3, for the same and another size."""
    bench = session.bench
    for _ in range(REPEATS):
        session.begin()
        for step, size in (("the same size", 0), ("one packet less", PACKET_BYTES)):
            session.reach(3, 1)
            stored = session.stored
            bench.forget()
            sent = bench.send(bench.encoder.update(len(session.image) - size))
            reply = bench.wait_for(
                Reply.REQUEST, Reply.BOOT_VERSION, within_s=bench.limit("erase_s")
            )
            taken = reply is not None and reply.kind is Reply.REQUEST
            answer = "request transfer" if taken else "no request transfer"
            stimulus = f"update command for {step} after packet {stored}"
            yield Trial("starts_over" if taken else "rejected", answer, stimulus)
            if reply is None:
                session.deliver_packet()
                continue
            if taken:
                bench.measure(TimeName.REQUEST, reply.at - sent.left_at)
                session.stored = 0
            if size and taken:
                bench.packets(session.image[:-size], 1, 1)  # before packet 1 it may ignore one
            if size or not taken:  # the other size, or it was a pause
                session.update()
        session.finish()


def pause(session: InitSession) -> Findings:
    """Determine the effect of a pause in the transfer."""
    bench = session.bench
    places, found_s = (1, 0, session.total), list[float]()
    for stored in places:
        session.begin()
        session.packets(stored)
        began_at = bench.now
        reply = bench.wait_for(Reply.BOOT_VERSION, within_s=_PAUSE_WATCHED_S)
        stimulus = f"a pause after packet {stored}" if stored else "a pause before packet 1"
        if reply is None:
            answer = f"no boot version in {_PAUSE_WATCHED_S:g} s"
            yield Trial("waits", answer, stimulus, "after")
        else:
            found_s.append(reply.at - began_at)
            yield Trial("announces", "boot version", stimulus, "after")
            session.update()
        session.finish()
    if len(found_s) < len(places):
        why = f"no boot version in a pause of {_PAUSE_WATCHED_S:g} s; the default is kept"
        yield KeyAnswer("limits.pause_s", None, why)
        return
    stated = pause_answer("limits.pause_s", found_s, bench.port.uncertainty_s)
    # The transfer may have ended long before the first boot version.
    low_s, high_s = 0.0, min(found_s) - max(_PAUSE_RESOLUTION_S, 2 * bench.port.uncertainty_s)
    if not _continues_after(session, high_s):
        while high_s - low_s > _PAUSE_RESOLUTION_S * min(found_s):
            asked_s = (low_s + high_s) / 2
            continues = _continues_after(session, asked_s)
            low_s, high_s = (asked_s, high_s) if continues else (low_s, asked_s)
        seen = f"a packet is accepted after a pause of {low_s:.2f} s, and not after {high_s:.2f} s"
        value = floor(low_s * 10) / 10 or low_s
        stated = KeyAnswer("limits.pause_s", value, f"{seen}, by bisection")
    # After the pause that the profile states, each boot version came in this time.
    for one_s in found_s:
        bench.measure(TimeName.LATE, one_s - float(stated.value or 0.0))
    yield stated


def _continues_after(session: InitSession, pause_s: float) -> bool:
    """Whether packet 2 is acknowledged after a pause; the good image runs again afterwards."""
    bench = session.bench
    session.begin()
    session.packets(1)
    bench.wait_until(bench.continued_at + pause_s)
    bench.forget()
    bench.send(session.packet(2))
    kinds = (Reply.ACK, Reply.BOOT_VERSION)
    reply = bench.wait_for(*kinds, within_s=bench.limit("ack_s"))
    continues = reply is not None and reply.kind is Reply.ACK
    if continues:
        session.stored = 2
    elif reply is not None or bench.wait_for(Reply.BOOT_VERSION) is not None:
        session.update()
    session.finish()
    return continues


def reset_again(session: InitSession) -> Findings:
    """Determine the effect of a reset before, between and after the packets."""
    bench = session.bench
    for stored in (0, 1, session.total):
        session.begin()
        session.packets(stored)
        bench.forget()
        bench.send(bench.encoder.reset())
        reply, session.stored = restarted(bench, session.image, stored)
        stimulus = f"reset after packet {stored}" if stored else "reset before packet 1"
        value, answer = ("restarts", "boot version") if reply else ("ignored", "no boot version")
        yield Trial(value, answer, stimulus, "after")
        if reply is not None:
            session.update()
        session.finish()


# -- the end, and what is stored ------------------------------------------------------------------


def end_again(session: InitSession) -> Findings:
    """Determine the answer to a second end of transfer after complete."""
    bench = session.bench
    for _ in range(REPEATS):
        session.begin()
        session.packets()
        bench.end_transfer()
        bench.send(bench.encoder.end())
        replies = bench.collect(bench.limit("ack_s"))
        replies = [one for one in replies if one.kind in _END_ANSWERS]
        kinds = [one.kind for one in replies]
        words = {(): "silence", (Reply.COMPLETE,): "same_answer"}
        yield Trial(words.get(tuple(kinds), ""), answer_text(replies), "end of transfer again")
        session.await_application()


def buffer(session: InitSession) -> Findings:
    """Determine how many acknowledged bytes are not yet in the flash, and measure ACKs across
    several flash pages. The transfer is not ended, and of random bytes: the flash may still hold
    the good image.
    """
    bench = session.bench
    why = "" if bench.choice("up_08") == "starts_over" else session.why_no_exit()
    if why:
        yield why
        return
    image = bench.filler(_SEVERAL_PAGES)[: bench.number("largest_image_bytes")]
    bench.start_transfer(len(image))
    total, lacking, written = packet_count(len(image)), 0, False
    for number in range(1, total + 1):
        left_at = bench.send_packet(image, number).left_at
        reply = bench.expect(Reply.ACK, within_s=ANSWER_S, number=number)
        bench.measure(TimeName.ANSWER, reply.at - left_at)
        if bench.subject.has_readback:
            stored = image[: number * PACKET_BYTES]
            same = bench.difference(stored)
            lacking = max(lacking, 0 if same is None else len(stored) - same)
            written = written or same is None or same >= PACKET_BYTES
    if bench.subject.has_readback and not written and bench.is_kept_aside(image):
        why = "the device keeps its old application until complete"
    bench.restart_transfer(len(session.image))
    session.stored = 0
    session.finish()
    if why or not bench.subject.has_readback:
        yield why or "the bench has no readback"
        return
    held = -(-lacking // PACKET_BYTES) * PACKET_BYTES
    seen = f"after ACK 1 to {total} at most {lacking} bytes were not in the flash"
    if not written:
        held = bench.number("largest_image_bytes")
        seen += ", none was in it: all of an image may be buffered"
    yield KeyAnswer("device.buffer_bytes", held, seen)
