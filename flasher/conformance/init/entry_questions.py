"""Questions about reset, announcements, window and update command."""

from __future__ import annotations

from itertools import pairwise
from statistics import median
from typing import Final

from flasher.conformance.init.answers import Findings, Trial, tolerance_answer
from flasher.conformance.init.session import REPEATS, InitSession, answer_text
from flasher.conformance.judge import TimeName
from flasher.conformance.patient_host import UPDATE_SPACING_S
from flasher.conformance.results import KeyAnswer
from flasher.conformance.wire import IMAGE_BYTES_MAX, WRITE, RawFrame, Received, Reply, packet_count

_TOLERANCE_S: Final = 0.005
"""Smallest tolerance to write: a boot version may wait for other frames."""
_WINDOW_MAX_S: Final = 10.0
_RESTART_S: Final = 5.0
"""How long to wait for a restart after complete."""
_NAK_WATCHED_S: Final = 2.0
"""How long to wait for a first NAK: four times the default of limits.ack_s."""
_RESOLUTION_S: Final = 0.001
_SILENT_S: Final = 5.0
"""A bootloader without a boot version for this long is assumed to listen silently."""
_ERASE_LEAST_S: Final = 10.0
_ERASE_MOST_S: Final = 120.0
_UNKNOWN: Final = 0x7704
"""An unused command."""
_END_SHARES: Final = (0.0, 0.5, 0.9)
"""Parts of the time from end of transfer to complete after which to cut the power."""
_OFF_S: Final = 0.5


def burst(session: InitSession) -> Findings:
    """Determine reset command, number and spacing of boot versions, by resets and power cycles."""
    bench = session.bench
    counts: list[int] = []
    gaps_s: list[float] = []
    turns = [*("reset",) * REPEATS, *("power",) * (REPEATS if bench.subject.has_power else 0)]
    for turn in turns:
        if turn == "power":
            bench.power_cycle()
            on_at = bench.now
            first = bench.await_message(Reply.BOOT_VERSION)
            bench.measure(TimeName.POWERED, first.at - on_at)
        else:
            first = session.enter()
        versions = [first, *session.more_versions()]
        counts.append(len(versions))
        gaps_s += [after.at - before.at for before, after in pairwise(versions)]
        session.await_application()
    command = f"{bench.encoder.reset_command:04X}"
    yield KeyAnswer(
        "device.reset_command",
        bench.encoder.reset_command,
        f"{command} was followed by boot versions, {REPEATS} of {REPEATS} times",
    )
    text = bench.encoder.reset_data.decode()
    yield KeyAnswer("device.reset_data", text, f"{command} was sent with {text}")
    shown = ", ".join(map(str, counts))
    alike = len(set(counts)) == 1
    seen = f"{shown} boot versions after {REPEATS} resets"
    if len(turns) > REPEATS:
        seen += f" and {REPEATS} power cycles"
    yield KeyAnswer("device.versions", counts[0] if alike else None, seen)
    if not gaps_s:
        why = "a single boot version has no spacing"
        yield KeyAnswer("limits.version_spacing_s", None, why)
        yield KeyAnswer("limits.version_spacing_tolerance_s", None, why)
        return
    spacing_s = round(median(gaps_s), 3)
    seen = f"{len(gaps_s)} times, from {min(gaps_s) * 1000:.1f} to {max(gaps_s) * 1000:.1f} ms"
    off_s = max(abs(gap_s - spacing_s) for gap_s in gaps_s)
    off_s += bench.port.uncertainty_s
    yield KeyAnswer("limits.version_spacing_s", spacing_s, f"measured {seen}; the median")
    key = "limits.version_spacing_tolerance_s"
    yield tolerance_answer(key, off_s, _TOLERANCE_S, f"measured {seen}")


def upgrade(session: InitSession) -> Findings:
    """Determine what follows complete, and measure plain upgrades."""
    bench = session.bench
    for _ in range(REPEATS):
        session.begin()
        _measure_naks(session)
        session.packets()
        bench.end_transfer()
        complete_at = bench.now
        reply = _first_sign(session)
        if reply is not None and reply.kind is Reply.BOOT_VERSION:
            bench.measure(TimeName.RESTARTED, reply.at - complete_at)
            yield Trial("restarts", "a boot version", "complete", "after")
        else:
            yield Trial("starts", "no boot version", "complete", "after")
        has_query = bench.encoder.has_version_query
        session.await_application(TimeName.START if has_query else "", complete_at)
        last = session.enter(bench.number("versions"))
        session.await_application(TimeName.START_AGAIN, last.at)
        if not has_query:  # above, the wait for a boot version outlasted the start
            session.begin()
            session.packets()
            bench.end_transfer()
            session.await_application(TimeName.START, bench.now)
    _measure_larger_image(session)


def _measure_larger_image(session: InitSession) -> None:
    """Measure an upgrade to the larger image that the cases use, and put the good image back."""
    bench = session.bench
    image, query = bench.firmware.good, bench.encoder.has_version_query
    if len(image) <= len(session.image):
        return
    session.enter()
    if bench.request_transfer(len(image)) is None:  # larger than any that it accepts
        session.await_application()
        return
    bench.packets(image)
    bench.end_transfer()
    session.await_application(TimeName.START if query else "", bench.now)
    session.begin()
    session.finish()


def _measure_naks(session: InitSession) -> None:
    """Measure the time to a NAK, which is a part of all waits for answers to packets."""
    bench = session.bench
    stimuli = (
        bench.encoder.damaged_packet_of(session.image, 1),
        session.packet(1),  # the last one stored
        session.packet(1),  # an older one
    )
    for stored, frames in enumerate(stimuli[: session.total]):
        session.packets(stored)
        bench.forget()
        sent = bench.send(frames)
        kinds = (Reply.ACK, Reply.NAK, Reply.BOOT_VERSION)
        reply = bench.wait_for(*kinds, within_s=_NAK_WATCHED_S)
        if reply is not None and reply.kind is Reply.NAK:
            bench.measure(TimeName.REJECTED, reply.at - sent.left_at)
        elif reply is not None and reply.kind is Reply.BOOT_VERSION:  # it was a pause
            session.update()


def _first_sign(session: InitSession) -> Received | None:
    """The first boot version after complete, or the first answer of the application."""
    bench = session.bench
    if not bench.encoder.has_version_query:
        within_s = max(bench.limit("first_version_s"), _RESTART_S)
        return bench.wait_for(Reply.BOOT_VERSION, within_s=within_s)
    deadline = bench.now + bench.limit("start_s")
    reply: Received | None = None
    while reply is None and bench.now < deadline:
        bench.send(bench.encoder.query_version())
        reply = bench.wait_for(Reply.BOOT_VERSION, Reply.VERSION_INFORMATION, within_s=0.05)
    return reply


# -- the window -----------------------------------------------------------------------------------


def in_burst(session: InitSession) -> Findings:
    """Determine whether an update command between announcements is accepted."""
    bench = session.bench
    count = bench.number("versions")
    if count < 2:
        yield "the burst has only one boot version"
    for version in range(1, count):
        for _ in range(REPEATS):
            session.enter(version)
            taken = session.offer_update(bench.encoder.update(len(session.image)))
            answer = "request transfer" if taken else "no request transfer"
            stimulus = f"update command at boot version {version} of {count}"
            yield Trial("accepted" if taken else "rejected", answer, stimulus)
            session.finish() if taken else session.await_application()


def window(session: InitSession) -> Findings:
    """Determine the end of the window after the last announcement, by bisection."""
    bench = session.bench
    at_s, taken = _offer_at(session, 0.0)
    if not taken:
        yield "an update command at the last boot version is rejected"
        return
    low_s, high_s = at_s, max(0.1, 2 * at_s)
    while True:
        at_s, taken = _offer_at(session, high_s)
        if not taken:
            high_s = at_s
            break
        low_s, high_s = at_s, 2 * at_s
        if high_s > _WINDOW_MAX_S:
            yield f"an update command is accepted {low_s:.1f} s after the last"
            return
    resolution_s = max(_RESOLUTION_S, bench.port.uncertainty_s)
    while high_s - low_s > resolution_s:
        at_s, taken = _offer_at(session, (low_s + high_s) / 2)
        if low_s < at_s < high_s:
            low_s, high_s = (at_s, high_s) if taken else (low_s, at_s)
        else:  # limited by the bus's resolution
            break
    inside = [_offer_at(session, low_s - resolution_s) for _ in range(REPEATS)]
    outside = [_offer_at(session, high_s + resolution_s) for _ in range(REPEATS)]
    off_s = max(
        [low_s - at_s for at_s, taken in inside if not taken]
        + [at_s - high_s for at_s, taken in outside if taken],
        default=0.0,
    )
    window_s = round((low_s + high_s) / 2, 4)
    seen = (
        f"update command accepted up to {low_s * 1000:.1f} ms after the last boot version, "
        f"rejected from {high_s * 1000:.1f} ms on, by bisection"
    )
    yield KeyAnswer("limits.window_s", window_s, f"{seen}; the middle")
    off_s += (high_s - low_s) / 2 + bench.port.uncertainty_s
    yield tolerance_answer("limits.window_tolerance_s", off_s, _RESOLUTION_S, seen)
    stimulus = f"update command {(high_s + resolution_s) * 1000:.0f} ms after the last boot version"
    for _, taken in outside:
        answer = "request transfer" if taken else "no request transfer"
        yield Trial("accepted" if taken else "rejected", answer, stimulus)


def _offer_at(session: InitSession, offset_s: float) -> tuple[float, bool]:
    """Send the update command `offset_s` after the last boot version. Returns its actual offset and
    whether it was accepted. The good image runs again afterwards.
    """
    bench = session.bench
    frames = bench.encoder.update(len(session.image))
    wire_s = bench.tester.wire_s(frames)
    last = session.enter(bench.number("versions"))
    sent = bench.send(frames, at=last.at + max(offset_s - wire_s, 0.0))
    reply = bench.wait_for(Reply.REQUEST)
    if reply is None:
        session.await_application()
    else:
        bench.measure(TimeName.REQUEST, reply.at - sent.left_at)
        session.stored = 0
        session.finish()
    return sent.left_at - last.at, reply is not None


# -- what is not taken ----------------------------------------------------------------------------


def reset_in_bootloader(session: InitSession) -> Findings:
    """Determine the effect of a reset between announcements."""
    bench = session.bench
    count = bench.number("versions")
    place = min(2, count)
    for _ in range(REPEATS):
        session.enter(place)
        bench.send(bench.encoder.reset())
        # A restart may take as long as that of the application.
        first = bench.wait_for(Reply.BOOT_VERSION)
        more = 0 if first is None else 1 + len(session.more_versions())
        value = {count - place: "ignored", count: "restarts"}.get(more, "")
        stimulus = f"reset after boot version {place} of {count}"
        yield Trial(value, f"{more} more boot versions", stimulus, "after")
        session.await_application()


def rejected_update(session: InitSession) -> Findings:
    """Determine the answer to update commands that have to be rejected."""
    bench = session.bench
    other = next(iter(bench.encoder.others()))
    stimuli = {
        "update command for 0 bytes": bench.encoder.update(0),
        "update command for 2^32 - 1 bytes": bench.encoder.update(0xFFFF_FFFF),
        f"update command with the name {other.update_text.decode()}": bench.encoder.update(
            len(session.image), other.update_text
        ),
    }
    for stimulus, frames in stimuli.items():
        for _ in range(REPEATS):
            session.enter()
            bench.wait_for_window()
            bench.send(frames)
            replies = bench.collect(bench.waits.burst_s + bench.waits.silence_s)
            answers = [one for one in replies if one.kind is not Reply.BOOT_VERSION]
            yield Trial(_choice_for(answers), answer_text(answers), stimulus)
            session.await_application()


def feedback(session: InitSession) -> Findings:
    """Determine whether the bootloader sends general feedback to writes."""
    bench = session.bench
    unknown = bench.encoder.message(WRITE, _UNKNOWN, bytes(_UNKNOWN & 0xFF))
    for _ in range(REPEATS):
        first = session.enter()
        bench.send(unknown)
        session.update()
        session.packets(1)
        bench.send(unknown)
        bench.collect(bench.limit("ack_s") + bench.limit("inter_frame_s"))
        session.packets()
        count = session.feedback_since(first.at)
        answer = f"general feedback {count} times" if count else "no general feedback"
        stimulus = "an unknown write, update command and packets"
        yield Trial("either" if count else "silence", answer, stimulus)
        session.finish()


def update_twice(session: InitSession) -> Findings:
    """Determine the answer to two consecutive update commands."""
    bench = session.bench
    update = bench.encoder.update(len(session.image))
    for _ in range(REPEATS):
        session.enter()
        bench.wait_for_window()
        bench.send(update + update)
        count, reply = 0, bench.wait_for(Reply.REQUEST)
        kinds, within_s = (Reply.REQUEST, Reply.BOOT_VERSION), bench.limit("erase_s")
        while reply is not None and reply.kind is Reply.REQUEST:
            count += 1
            reply = bench.wait_for(*kinds, within_s=within_s)
        value = {1: "once", 2: "each"}.get(count, "")
        answer = f"request transfer {count} times"
        yield Trial(value, answer, "two update commands in a row")
        session.stored = 0
        if reply is not None:  # it was a pause
            session.update()
        session.finish() if count else session.await_application()


def application(session: InitSession) -> Findings:
    """Determine the running application's answer to upgrade messages."""
    bench = session.bench
    for stimulus, frames in bench.encoder.upgrade_messages(len(session.image)).items():
        for _ in range(REPEATS):
            bench.forget()
            with bench.tester.collecting_feedback():
                bench.send(frames)
                replies = bench.collect(bench.waits.silence_s)
            yield Trial(
                _choice_for(replies), answer_text(replies), f"{stimulus} to the application"
            )
    session.await_application()


def _choice_for(replies: list[Received]) -> str:
    """The value for one answer or silence; "" for anything else."""
    if not replies:
        return "silence"
    names = {Reply.NAK: "nak", Reply.FEEDBACK: "feedback"}
    return names.get(replies[0].kind, "") if len(replies) == 1 else ""


# -- without an application -----------------------------------------------------------------------


def old_application(session: InitSession) -> Findings:
    """Determine whether the old application runs after a transfer that was broken off: before
    packet 1, after it, after the last one, and at end of transfer.
    """
    bench = session.bench
    why = session.why_no_exit()
    if why:
        yield why
        return
    trials = list[Trial]()
    for stored in (0, 1, session.total):
        session.begin()
        session.packets(stored)
        bench.leave_transfer()
        place = f"after packet {stored}" if stored else "before packet 1"
        trials.append(_old_application_trial(session, place))
    # A device may buffer a whole image, and erase its application only then.
    if all(trial.value == "kept" for trial in trials):
        if not bench.subject.has_power:
            yield (
                "kept after each transfer that was broken off before its end; whether end of "
                "transfer erases it can only be seen with power control"
            )
            return
        for cut in range(len(_END_SHARES)):
            session.begin()
            session.packets()
            if _cut_after_end(session, cut):
                trials.append(_old_application_trial(session, "after end of transfer"))
            else:
                session.await_application()
    yield from trials


def _old_application_trial(session: InitSession, place: str) -> Trial:
    """After a restart: see whether an application runs, and upgrade the device."""
    bench = session.bench
    bench.collect(bench.waits.burst_s)
    runs = bench.application_runs()
    answer = "the application runs" if runs else "no application runs"
    session.begin() if runs else session.update()
    session.finish()
    stimulus = f"a transfer that was broken off {place}"
    return Trial("kept" if runs else "erased", answer, stimulus, "after")


def _cut_after_end(session: InitSession, cut: int) -> bool:
    """Send end of transfer and cut the power before complete: after a flash operation, or where
    these are not visible after a share of the shortest time that complete took. Returns whether it
    was cut; otherwise complete was sent first.
    """
    bench = session.bench
    bench.forget()
    if not bench.subject.has_timed_cuts:
        times_s = [one.value_s for one in bench.judge.measurements if one.name == TimeName.COMPLETE]
        bench.send(bench.encoder.end())
        if bench.wait_for(Reply.COMPLETE, within_s=_END_SHARES[cut] * min(times_s)) is not None:
            return False
        bench.power_cycle()
        bench.await_message(Reply.BOOT_VERSION)
        return True
    bench.subject.cut_in_operation(cut, 1.0, _OFF_S)
    bench.send(bench.encoder.end())
    within_s = bench.limit("complete_s") + _OFF_S + bench.limit("first_version_s")
    reply = bench.wait_for(Reply.COMPLETE, Reply.BOOT_VERSION, within_s=within_s)
    was_cut = bench.subject.take_cut()
    found = bench.require_received(reply, "complete or boot version", within_s)
    return was_cut and found.kind is Reply.BOOT_VERSION


def without_application(session: InitSession) -> Findings:
    """Determine what a bootloader without an application does."""
    bench = session.bench
    why = session.why_no_exit()
    if why:
        yield why
        return
    old = bench.choice("rs_03_old")
    if old == "kept":
        yield "the device keeps its old application until complete"
        return
    count = bench.number("versions")
    for _ in range(REPEATS):
        session.begin()
        session.packets(0 if old == "erased" else session.total)
        bench.leave_transfer()
        more, last_at = 0, bench.now
        while more < 2 * count:
            reply = bench.wait_for(Reply.BOOT_VERSION, within_s=_SILENT_S)
            if reply is None:
                break
            bench.measure(TimeName.GAP, reply.at - last_at)
            more, last_at = more + 1, reply.at
        if old != "erased" and more < 2 * count and bench.application_runs():
            session.begin()
            session.finish()
            yield "the old application runs after each transfer that was broken off before its end"
            return
        value = "listens" if more == count - 1 else "announces" if more >= 2 * count else ""
        answer = f"{more} more boot versions" + ("" if value == "announces" else ", then silence")
        stimulus = "the first one, without an application"
        yield Trial(value, answer, stimulus, "after")
        session.update()
        session.finish()


def largest_image(session: InitSession) -> Findings:
    """Determine the largest size for which an update command is accepted."""
    bench = session.bench
    keeps_old = bench.profile.allows("rs_03_old", "kept")
    restarts_at_once = bench.choice("up_08") == "starts_over"
    why = "" if restarts_at_once else session.why_no_exit()
    if why:
        yield why
        return

    session.begin()
    _prepare_for_next_size(session, len(session.image))
    erase_s = max(one.value_s for one in bench.judge.measurements if one.name == TimeName.REQUEST)

    in_transfer = restarts_at_once

    def is_taken(size_bytes: int) -> bool:
        nonlocal in_transfer
        if not in_transfer:
            bench.wait_for_window()
        share = packet_count(size_bytes) / session.total
        within_s = min(max(_ERASE_LEAST_S, 3 * erase_s * share), _ERASE_MOST_S)
        frames = bench.encoder.update(size_bytes)
        reply = _answer_to_size(session, frames, within_s)
        if in_transfer and reply is not None and reply.kind is Reply.BOOT_VERSION:
            # A pause had ended the transfer, and the command may have come in the restart.
            bench.wait_for_window()
            reply = _answer_to_size(session, frames, within_s)
        taken = reply is not None and reply.kind is Reply.REQUEST
        if taken:
            _prepare_for_next_size(session, size_bytes)
        in_transfer = restarts_at_once and (
            taken or (in_transfer and reply is not None and reply.kind is Reply.NAK)
        )
        within_s = bench.waits.burst_s + bench.limit("start_s")
        if keeps_old and not (taken or in_transfer) and bench.application_runs(within_s):
            session.enter()  # its announcements ended meanwhile
        return taken

    low, high = len(session.image), 0
    while not high and low < IMAGE_BYTES_MAX:
        size = min(2 * low, IMAGE_BYTES_MAX)
        if is_taken(size):
            low = size
        else:
            high = size
    while high - low > 1:
        size = (low + high) // 2
        low, high = (size, high) if is_taken(size) else (low, size)
    session.update()
    session.finish()
    seen = f"update command for {low} bytes accepted"
    if high:
        seen += f", for {high} bytes rejected, by bisection"
    yield KeyAnswer("device.largest_image_bytes", low, seen)


def _prepare_for_next_size(session: InitSession, size_bytes: int) -> None:
    """After request transfer for that size: make the device accept another update command."""
    bench = session.bench
    if bench.choice("up_08") == "starts_over":
        bench.packets(bytes(size_bytes), 1, 1)  # before packet 1 it may ignore one (R25)
    else:
        bench.leave_transfer()


def _answer_to_size(
    session: InitSession, frames: list[RawFrame], within_s: float
) -> Received | None:
    """Return request transfer, NAK, the last of several further announcements, or None."""
    bench = session.bench
    bench.forget()
    sent = bench.send(frames)
    deadline, versions = sent.left_at + within_s, 0
    # It may process the command after its burst.
    most = max(3, bench.number("versions"))
    reply: Received | None = None
    kinds = (Reply.REQUEST, Reply.NAK, Reply.BOOT_VERSION)
    while versions < most:
        reply = bench.wait_for(*kinds, within_s=deadline - bench.now)
        if reply is None or reply.kind is Reply.NAK:
            break
        if reply.kind is Reply.REQUEST:
            bench.measure(TimeName.REQUEST, reply.at - sent.left_at)
            return reply
        versions += reply.at > sent.left_at + UPDATE_SPACING_S
    if versions:  # a late NAK would be taken for the answer to the next size
        bench.collect(bench.waits.settle_s)
    return reply
