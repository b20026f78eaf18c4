"""Questions inside a transfer of the good image, and about its end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import floor
from typing import Final

from flasher.conformance.init.answers import Answer, Trial, decided
from flasher.conformance.init.session import COMPLETE, LATE, REPEATS, Session, told
from flasher.conformance.wire import (
    FRAME_BYTES,
    PACKET_BYTES,
    PACKET_FRAMES,
    Kind,
    RawFrame,
    Received,
    filled_up,
    inverted,
    joined,
    packet_payload,
)

_CRC_AT: Final = slice(-5, -1)
_LOST_FRAMES: Final = (1, 9, 17)
_JUNK: Final = (b"\x12", b"\x55", b"\x55\x55", b"\xaa", b"\xf0\x00\x34", b"\x12" * 7)
_WRONG_TAILS: Final = (0x00, 0x55)
_PADDINGS: Final = (0x00, 0xFF, 0xAA, 0x55, 0xF0)
_RANDOM_SPLITS: Final = 4
_SHARES: Final = (0.1, 0.25, 0.5, 0.75, 0.9)
_EDGE_S: Final = 0.001
_LATER_S: Final = 0.5
_PAUSE_WATCHED_S: Final = 30.0
_BEFORE_PAUSE: Final = 0.9
_END_ANSWERS: Final = (Kind.REQUEST, Kind.ACK, Kind.NAK, Kind.COMPLETE, Kind.FEEDBACK)
_PACKETS_READ_BACK: Final = 33


# -- repetitions and bad packets ------------------------------------------------------------------


def repeated_packet(it: Session) -> Iterator[Answer]:
    """The packet stored last, again."""
    bench, trials = it.bench, []
    it.begin()
    for stored in (1, 2):
        it.reach(stored, 1)
        for _ in range(REPEATS):
            bench.forget()
            bench.send_packet(it.image, it.stored)
            heard = told(it.answers())
            words = {f"ACK {it.stored}": "ack", f"NAK {it.stored + 1}": "nak_next"}
            trials.append(Trial(words.get(heard, ""), heard, f"packet {it.stored} again"))
    it.finish()
    yield decided("tx_02", trials)


def older_packet(it: Session) -> Iterator[Answer]:
    """A packet before the one stored last."""
    bench, trials = it.bench, []
    it.begin()
    it.reach(3, 1)
    for number in (1, 2):
        for _ in range(REPEATS):
            bench.forget()
            bench.send_packet(it.image, number)
            heard = it.answers()
            words = {"silence": "silence", f"ACK {number}": "ack"}
            is_nak = [one.kind for one in heard] == [Kind.NAK]
            value = "nak" if is_nak else words.get(told(heard), "")
            trials.append(Trial(value, told(heard), f"packet {number} after packet {it.stored}"))
    it.finish()
    yield decided("tx_03", trials)


def bad_packet(it: Session) -> Iterator[Answer]:
    """Packets that are damaged, or make no sense."""
    bench, trials = it.bench, []
    it.begin()
    it.reach(2, 3)
    wanted, encoder = it.stored + 1, bench.encoder
    payload = packet_payload(it.image, wanted)
    stimuli: dict[str, tuple[int, Sequence[RawFrame]]] = {
        f"packet {wanted} with a wrong CRC": (wanted, _damaged(it, wanted)),
        f"packet {wanted + 1} with a wrong CRC": (wanted + 1, _damaged(it, wanted + 1)),
        f"packet {wanted + 1} in the place of {wanted}": (
            wanted + 1,
            encoder.packet_of(it.image, wanted + 1),
        ),
        f"packet {wanted} of {it.total + 1}": (
            wanted,
            encoder.packet(wanted, it.total + 1, payload),
        ),
        f"packet {wanted} with the start byte 02": (
            wanted,
            encoder.packet(wanted, it.total, payload, start=2),
        ),
    }
    for stimulus, (named, frames) in stimuli.items():
        for _ in range(REPEATS):
            bench.forget()
            bench.send(frames)
            heard = it.answers()
            trials.append(Trial(_nak_word(heard, wanted, named), told(heard), stimulus))
    it.insist()
    it.finish()
    # A NAK with the one number that both ways give says only that there is a NAK.
    telling = {trial.value for trial in trials} - {"nak"}
    if len(telling) == 1:
        (value,) = telling
        mixed = value == "silence" and any(trial.value == "nak" for trial in trials)
        word = "either" if mixed else value
    else:
        word = "either" if telling else ""
    if "" in telling:
        word = ""
    yield decided("tx_01", [trial._replace(value=word) for trial in trials])


def _damaged(it: Session, number: int) -> list[RawFrame]:
    raw = bytearray(joined(it.bench.encoder.packet_of(it.image, number)))
    raw[_CRC_AT] = inverted(raw[_CRC_AT])
    return it.bench.encoder.frames(bytes(raw))


def _nak_word(heard: Sequence[Received], wanted: int, named: int) -> str:
    """The value of tx_01 that one answer shows; `nak` where both kinds of NAK are the same."""
    if not heard:
        return "silence"
    if [one.kind for one in heard] != [Kind.NAK] or heard[0].number not in (wanted, named):
        return ""
    if wanted == named:
        return "nak"
    return "nak_expected" if heard[0].number == wanted else "nak_received"


def lost_frame(it: Session) -> Iterator[Answer]:
    """Packets of which a frame is lost."""
    bench, trials = it.bench, []
    it.begin()
    for index in _LOST_FRAMES:
        for _ in range(REPEATS):
            it.reach(1, 2)
            bench.forget()
            frames = it.frames()
            bench.send(frames[:index] + frames[index + 1 :])
            heard = it.answers()
            late = bench.collect(_LATER_S)
            kinds = [one.kind for one in (*heard, *late)]
            value = {0: "silence", 1: "nak"}.get(len(kinds), "")
            if kinds not in ([], [Kind.NAK]):
                value = ""
            elif late:
                value = "either"
            answer = told([*heard, *late]) + (", late" if late else "")
            stimulus = f"a packet without its frame {index + 1}"
            trials.append(Trial(value, answer.replace(f" {it.stored + 1}", ""), stimulus))
            it.insist()
    it.finish()
    yield decided("tx_01_lost_frame", trials)


def filler(it: Session) -> Iterator[Answer]:
    """Other bytes than FF behind the end of the image, in the last packet."""
    bench, trials = it.bench, []
    rest = it.image[(it.total - 1) * PACKET_BYTES :]
    if len(rest) == PACKET_BYTES:
        yield Answer("tx_08", None, "the good image is a whole number of packets")
        return
    for _ in range(REPEATS):
        it.begin()
        it.packets(it.total - 1)
        other = bench.encoder.packet(it.total, it.total, rest.ljust(PACKET_BYTES, b"\0"))
        bench.send(other)
        heard = told(it.answers())
        taken = heard == f"ACK {it.total}"
        value = "ignored" if taken else "rejected"
        trials.append(Trial(value, heard, f"packet {it.total}, filled with 00"))
        if taken:
            it.stored = it.total
        it.finish()
    yield decided("tx_08", trials)


# -- framing --------------------------------------------------------------------------------------


def splits(it: Session) -> Iterator[Answer]:
    """Messages in frames of other sizes."""
    bench, trials = it.bench, []
    for _ in range(REPEATS):
        it.enter()
        bench.wait_to_be_heard()
        update = joined(bench.encoder.update(len(it.image)))
        taken = it.offer_update(bench.encoder.frames(update, 5))
        trials.append(_taken(taken, "update command in frames of 5 bytes"))
        if not taken:  # the window is over by now
            it.await_application()
            it.begin()
        for size in range(1, FRAME_BYTES):
            it.reach(0, 1)
            taken = it.offer(bench.encoder.frames(it.raw(), size))
            trials.append(_taken(taken, f"a packet in frames of {size} bytes"))
        for _ in range(_RANDOM_SPLITS):
            it.reach(0, 1)
            taken = it.offer(bench.encoder.frames_by_chance(it.raw(), bench.random))
            trials.append(_taken(taken, "a packet in frames of 1 to 8 bytes"))
        it.finish()
    yield decided("fr_01", trials)


def junk(it: Session) -> Iterator[Answer]:
    """Junk in the frame in which a packet begins."""
    trials = []
    it.begin()
    for own in _JUNK:
        for _ in range(REPEATS):
            it.reach(0, 1)
            taken = it.offer(it.bench.encoder.frames(own + it.raw()))
            stimulus = f"a packet behind {own.hex(' ').upper()} in its first frame"
            trials.append(_taken(taken, stimulus, "found", "lost"))
    it.finish()
    yield decided("fr_02", trials)


def wrong_tail(it: Session) -> Iterator[Answer]:
    """A packet in the frame in which a message with a wrong tail ends."""
    bench, trials = it.bench, []
    query = joined(bench.encoder.query_version())
    it.begin()
    for tail in _WRONG_TAILS:
        for _ in range(REPEATS):
            it.reach(0, 1)
            taken = it.offer(bench.encoder.frames(query[:-1] + bytes((tail,)) + it.raw()))
            stimulus = f"a packet behind a tail {tail:02X} in its first frame"
            trials.append(_taken(taken, stimulus, "rescanned", "dropped"))
    it.finish()
    yield decided("fr_04", trials)


def padded(it: Session) -> Iterator[Answer]:
    """Update command and end of transfer, their last frames filled up."""
    bench, trials = it.bench, []
    for byte in _PADDINGS:
        it.enter()
        bench.wait_to_be_heard()
        taken = it.offer_update(filled_up(bench.encoder.update(len(it.image)), byte))
        said = f"padded with {byte:02X}"
        trials.append(_taken(taken, f"update command {said}", "ignored", "rejected"))
        if not taken:  # the window is over by now
            it.await_application()
            it.begin()
        it.packets()
        bench.forget()
        sent = bench.send(filled_up(bench.encoder.end(), byte))
        heard = bench.wait_for(Kind.COMPLETE, within_s=_end_s(it))
        trials.append(_taken(heard is not None, f"end {said}", "ignored", "rejected"))
        if heard is None:
            bench.forget()
            bench.end_transfer()
        else:
            bench.measure(COMPLETE, heard.at - sent.left_at)
        it.await_application()
    yield decided("fr_07", trials)


def _end_s(it: Session) -> float:
    """How long complete is waited for, while the transfer still lasts (TX-12)."""
    within_s = it.bench.limit("complete_s")
    if it.bench.choice("tx_12") == "announces":
        within_s = min(within_s, it.bench.limit("pause_s") / 2)
    return within_s


def gaps(it: Session) -> Iterator[Answer]:
    """Packets with gaps between their frames."""
    bench, trials = it.bench, []
    limit_s, pause_s = bench.limit("inter_frame_s"), bench.limit("pause_s")
    frame_s = bench.tester.wire_s(it.frames()[:1], is_stuffed=True)
    edge_s = frame_s + 2 * bench.port.uncertainty_s + _EDGE_S
    it.begin()
    for gap_s in (*(share * limit_s for share in _SHARES), max(limit_s - edge_s, 0.0)):
        for _ in range(REPEATS):
            it.reach(0, 1)
            count = min(int(pause_s / 2 / max(gap_s, frame_s)), PACKET_FRAMES) or 1
            taken = it.offer(it.frames(), gap_s=gap_s, gaps=count)
            stimulus = f"a packet with {gap_s * 1000:.1f} ms between its frames"
            trials.append(_taken(taken, stimulus, "accepted", "either"))
    it.finish()
    yield decided("tm_02", trials)


def _taken(taken: bool, stimulus: str, yes: str = "accepted", no: str = "rejected") -> Trial:  # noqa: FBT001
    return Trial(yes if taken else no, "taken" if taken else "not taken", stimulus, "")


# -- update command, pause and reset in a transfer ------------------------------------------------


def update_again(it: Session) -> Iterator[Answer]:
    """Update command after packet 3, for the same size and for another one."""
    bench, trials = it.bench, []
    for _ in range(REPEATS):
        it.begin()
        for step, size in (("the same size", 0), ("one packet less", PACKET_BYTES)):
            it.reach(3, 1)
            stored = it.stored
            bench.forget()
            taken = it.offer_update(bench.encoder.update(len(it.image) - size))
            answer = "request transfer" if taken else "no request transfer"
            stimulus = f"update command for {step} after packet {stored}"
            trials.append(Trial("starts_over" if taken else "rejected", answer, stimulus))
            if taken and size:
                it.update()
            elif not taken:
                it.insist()
        it.finish()
    yield decided("up_08", trials)


def pause(it: Session) -> Iterator[Answer]:
    """Pauses in the transfer."""
    bench, trials = it.bench, []
    found_s: list[float] = []
    for stored in (1, 0, it.total):
        it.begin()
        it.packets(stored)
        began_at = bench.now
        heard = bench.wait_for(Kind.BOOT_VERSION, within_s=_PAUSE_WATCHED_S)
        stimulus = f"a pause after packet {stored}" if stored else "a pause before packet 1"
        if heard is None:
            answer = f"no boot version in {_PAUSE_WATCHED_S:g} s"
            trials.append(Trial("waits", answer, stimulus, "after"))
        else:
            found_s.append(heard.at - began_at)
            trials.append(Trial("announces", "boot version", stimulus, "after"))
            it.update()
        it.finish()
    yield decided("tx_12", trials)
    if len(found_s) < len(trials):
        why = f"no boot version in a pause of {_PAUSE_WATCHED_S:g} s; the default stands"
        yield Answer("limits.pause_s", None, why)
        return
    digit = 10 if min(found_s) >= 1 else 100
    shortest_s = floor(min(found_s) * digit + 1e-6) / digit
    for one_s in found_s:
        bench.measure(LATE, one_s - shortest_s)
    seen = f"a boot version after pauses of {min(found_s):.3f} to {max(found_s):.3f} s"
    yield Answer("limits.pause_s", shortest_s, f"{seen}; the shortest, rounded down")


def reset_again(it: Session) -> Iterator[Answer]:
    """Reset before packet 1, amid the packets and before the end."""
    bench, trials = it.bench, []
    within_s = bench.limit("first_version_s")
    if bench.choice("tx_12") == "announces":
        # Later than that, it is the pause that ends the transfer.
        within_s = min(within_s, _BEFORE_PAUSE * bench.limit("pause_s"))
    for stored in (0, 1, it.total):
        it.begin()
        it.packets(stored)
        bench.forget()
        bench.send(bench.encoder.reset())
        heard = bench.wait_for(Kind.BOOT_VERSION, within_s=within_s)
        stimulus = f"reset after packet {stored}" if stored else "reset before packet 1"
        value, answer = ("restarts", "boot version") if heard else ("ignored", "no boot version")
        trials.append(Trial(value, answer, stimulus, "after"))
        if heard is not None:
            it.update()
        it.finish()
    yield decided("tx_13", trials)


# -- the end, and what is stored ------------------------------------------------------------------


def end_again(it: Session) -> Iterator[Answer]:
    """End of transfer once more, right after complete."""
    bench, trials = it.bench, []
    for _ in range(REPEATS):
        it.begin()
        it.packets()
        bench.end_transfer()
        with bench.tester.hearing_feedback():
            bench.send(bench.encoder.end())
            heard = bench.collect(bench.limit("ack_s"))
        heard = [one for one in heard if one.kind in _END_ANSWERS]
        kinds = [one.kind for one in heard]
        # An application that runs already may confirm what it does not know (R17).
        words = {(): "silence", (Kind.FEEDBACK,): "silence", (Kind.COMPLETE,): "same_answer"}
        trials.append(Trial(words.get(tuple(kinds), ""), told(heard), "end of transfer again"))
        it.await_application()
    yield decided("en_02", trials)


def buffer(it: Session) -> Iterator[Answer]:
    """What is acknowledged and not yet in the flash."""
    key, bench = "device.buffer_bytes", it.bench
    if not bench.subject.has_readback:
        yield Answer(key, None, "the bench has no readback")
        return
    lacking, count = 0, min(it.total - 1, _PACKETS_READ_BACK)
    it.begin()
    for number in range(1, count + 1):
        it.packets(number)
        wanted = it.image[: number * PACKET_BYTES]
        same = bench.difference(wanted)
        lacking = max(lacking, 0 if same is None else len(wanted) - same)
    it.finish()
    # The last packet may be on its way into the flash when its ACK comes (PW-01).
    held = max(0, -(-lacking // PACKET_BYTES) * PACKET_BYTES - PACKET_BYTES)
    seen = f"after ACK 1 to {count} at most {lacking} bytes were not in the flash"
    yield Answer(key, held, f"{seen}; one packet may be on its way")
