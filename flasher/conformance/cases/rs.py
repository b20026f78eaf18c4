"""RS: reset and boot version."""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import APPLICATION, DESTRUCTIVE, POWER, TIMING, case
from flasher.conformance.judge import TimeName
from flasher.conformance.wire import (
    READ,
    REPORT,
    RESET,
    RESET_TEXT,
    WRITE,
    RawFrame,
    Received,
    Reply,
    build,
    describe,
    split,
)

_IGNORED_RESETS: Final = (
    *((f"text {text}", WRITE, RESET, text.encode()) for text in ("RESTE", "RESEX", "XESET")),
    ("text reset", WRITE, RESET, b"reset"),
    ("text of zeros", WRITE, RESET, bytes(5)),
    ("length greater by four", WRITE, RESET, RESET_TEXT + bytes(4)),
    ("text RESE, too short", WRITE, 0x4204, b"RESE"),
    ("text RESETS, too long", WRITE, 0x4206, b"RESETS"),
    ("as a read", READ, RESET, RESET_TEXT),
    ("as a report", REPORT, RESET, RESET_TEXT),
)
"""Messages that resemble a reset: step, mode, command, data."""
_OTHER_SENDERS: Final = (1, 2, 3, 4)
"""Sender digits in an id: motor controller, battery, on-board computer, display."""
_STAY_S: Final = 70.0
"""Longer than 16 bits of milliseconds, and than 255 announcements 50 ms apart."""
_LONG_STAY_S: Final = 4320.0
"""Longer than 32 bits of microseconds: 72 min, which takes no time on a simulated bus."""


@case(
    "RS-01",
    "reset of the application",
    clause="Welling 5.1, figure 2 (begin); Welling 3.4, table 7 (4205); "
    "Welling 3.2, table 5 (5503); Welling 5.2; Welling 5.2, table 9 (C109); R3",
    stimulus="reset to the running application",
    expectation="general feedback, then boot version 4 times, 50 ms apart",
    requires={APPLICATION, TIMING},
    choices=("device.versions",),
)
def reset(bench: Bench) -> None:
    with bench.tester.collecting_feedback():
        sent = bench.send(bench.encoder.reset())
        within_s, expected = bench.tester.limit_s(Reply.FEEDBACK), Reply.FEEDBACK.value
        feedback = bench.require_received(bench.next_message(within_s), expected, within_s)
        # No key allows another message.
        bench.require(feedback.kind is Reply.FEEDBACK, expected, feedback, by={})
    bench.measure(TimeName.FEEDBACK, feedback.at - sent.left_at)
    first = bench.expect(Reply.BOOT_VERSION)
    bench.measure(TimeName.FIRST, first.at - sent.left_at)
    _check_burst(bench, first)


@case(
    "RS-02",
    "reset twice, and during the announcements",
    clause="Welling 5.1, figure 2 (begin); R18",
    stimulus="two resets in a row; reset after the second boot version",
    expectation="one clean restart; inside the bootloader as the profile says (rs_02)",
    requires={APPLICATION},
    choices=("rs_02", "device.versions"),
)
def reset_again(bench: Bench) -> None:
    count = bench.number("versions")
    with bench.step("two resets in a row"):
        bench.send(bench.encoder.reset() + bench.encoder.reset())
        first = bench.wait_for(Reply.BOOT_VERSION)
        bench.require(first is not None, "boot version", first or "nothing")
        # The second reset may reach a bootloader that already announces itself.
        restarts = bench.choice("rs_02") != "ignored"
        again = (count,) if restarts else ()
        _check_count(bench, count - 1, "one burst", *again)
        bench.check_application()
    with bench.step("reset after the second boot version"):
        bench.reset_to_bootloader()
        left = max(count - 2, 0)  # the burst may have just one
        if count > 1:
            bench.next_version()
        bench.send(bench.encoder.reset())
        if bench.choice("rs_02") == "either":
            # One boot version may be under way when the reset arrives.
            _check_count(bench, left, "the burst continues or restarts", count, count + 1)
        elif bench.choice("rs_02") == "ignored":
            _check_count(bench, left, "the burst continues")
        else:
            bench.expect(Reply.BOOT_VERSION)
            # One boot version may be under way when the reset arrives.
            _check_count(bench, count - 1, "a new complete burst", count)
        bench.check_application()


@case(
    "RS-03",
    "no update command",
    clause="Welling 5.1, figure 2 (begin); R14; R19",
    stimulus="silence after the announcements, with an application and, for 70 s, without one; for "
    "72 min in virtual time, longer than microseconds in 32 bits",
    expectation="a valid application is started; without one the bootloader stays (rs_03)",
    requires={APPLICATION, DESTRUCTIVE},
    choices=("rs_03", "rs_03_old"),
    limit_s=300.0 + _LONG_STAY_S,
)
def no_update(bench: Bench) -> None:
    count = bench.number("versions")
    with bench.step("with an application"):
        bench.reset_to_bootloader()
        bench.collect(bench.waits.burst_s)
        bench.check_application()
    with bench.step("without an application"):
        if not _erase_application(bench):
            why = "the device keeps its old application until complete (rs_03_old)"
            bench.unsupported("a bootloader without an application", why)
            return
        can_stay = bench.is_in_virtual_time and bench.subject.has_own_clock
        stay_s = _LONG_STAY_S if can_stay else _STAY_S
        if bench.choice("rs_03") == "either":
            more = _versions(bench.collect(stay_s))
            bench.info(f"without an application, {more + 1} boot versions in {stay_s:g} s")
            bench.update(len(bench.good_image))
            bench.finish(bench.good_image)
        elif bench.choice("rs_03") == "announces":
            # The document gives no period (R14); each may take as long as the first one.
            more, wanted, began_at = 0, 2 * count + 1, bench.now
            while more < wanted or bench.now - began_at < stay_s:
                if bench.wait_for(Reply.BOOT_VERSION) is None:
                    break
                more += 1
            took_s = bench.now - began_at
            expected = (
                f"it continues to announce: {wanted} more boot versions, and for {stay_s:g} s"
            )
            is_kept = more >= wanted and took_s >= stay_s
            bench.check(is_kept, expected, f"{more} boot versions in {took_s:.1f} s")
            bench.check_upgrade()
        else:
            spacing_s = bench.limit("version_spacing_s")
            more = _versions(bench.collect(3 * count * spacing_s + bench.waits.burst_s))
            expected = f"one burst of {count}, then silence"
            bench.check(more == count - 1, expected, f"{more + 1} boot versions")
            bench.collect(stay_s)
            bench.update(len(bench.good_image))
            bench.finish(bench.good_image)


@case(
    "RS-04",
    "messages that are not a reset",
    clause="Welling 3.4, table 7 (4205); Welling 2.2.1 (2); Welling 2.2.2, table 2",
    stimulus="reset with another text or length, as a read, as a report, to another target's id, "
    "from other nodes",
    expectation="no restart; the application keeps running",
    requires={APPLICATION},
)
def no_reset(bench: Bench) -> None:
    encoder = bench.encoder
    for step, mode, command, data in _IGNORED_RESETS:
        _check_ignored(bench, step, encoder.message(mode, command, data))
    for other in encoder.others():
        _check_ignored(bench, f"to the {other.target.upper()}", other.reset())
    for sender in _OTHER_SENDERS:
        can_id = (encoder.to_device & 0x00F) | 0x700 | sender << 4
        if can_id & 0x0F0 != encoder.to_all & 0x0F0:
            raw = build(can_id, WRITE, encoder.reset_command, encoder.reset_data)
            _check_ignored(bench, f"on id {can_id:03X}", split(can_id, raw))
    bench.check_application()
    bench.judge.note_listening()


@case(
    "RS-05",
    "power-up",
    clause="Welling 5.1, figure 2 (begin); R19",
    stimulus="power off and on",
    expectation="boot version 4 times, 50 ms apart",
    requires={APPLICATION, POWER, TIMING},
)
def power_up(bench: Bench) -> None:
    bench.power_cycle()
    on_at = bench.now
    first = bench.expect(Reply.BOOT_VERSION)
    bench.measure(TimeName.POWERED, first.at - on_at)
    _check_burst(bench, first)


def _check_burst(bench: Bench, first: Received) -> None:
    """Check the rest of a burst after its first boot version: spacing, text and end."""
    limit, count = bench.limit, bench.number("versions")
    spacing_s, tolerance_s = limit("version_spacing_s"), limit("version_spacing_tolerance_s")
    burst = [first]
    for _ in range(count - 1):
        burst.append(bench.next_version())
        bench.check_time(
            TimeName.SPACING,
            burst[-1].at - burst[-2].at,
            low_s=spacing_s - tolerance_s,
            high_s=spacing_s + tolerance_s,
        )
    name = bench.encoder.boot_name
    for reply in burst:
        ok = reply.boot_name == name and reply.has_good_version_text
        bench.check(ok, f"boot version of name {name} and text Vx.x.x", reply)
    _check_count(bench, 0, f"a burst has {count}")


def _check_count(bench: Bench, count: int, expected: str, *others: int) -> None:
    """Check that exactly `count` boot versions, or one of `others` after a restart, and no other
    messages arrive until burst and window are over.
    """
    next_s = bench.limit("first_version_s") if others else bench.waits.next_version_s
    replies = bench.collect(bench.waits.burst_s + next_s)
    wanted = " or ".join(map(str, (count, *others)))
    expected = f"{wanted} more boot versions ({expected})"
    bench.check(_versions(replies) in (count, *others), expected, describe(replies))
    bench.check_only(replies, Reply.BOOT_VERSION, Reply.FEEDBACK, why="nothing but boot versions")


def _erase_application(bench: Bench) -> bool:
    """Erase the application by a transfer that is left, so that a burst begins. False when the
    device keeps its application.
    """
    old, size = bench.choice("rs_03_old"), len(bench.good_image)
    if old == "kept":
        return False
    bench.start_transfer(size)
    bench.leave_transfer()
    if old == "either":
        bench.collect(bench.waits.burst_s)
        if bench.application_runs():
            return False
        bench.update(size)
        bench.leave_transfer()
    return True


def _versions(replies: list[Received]) -> int:
    return sum(one.kind is Reply.BOOT_VERSION for one in replies)


def _check_ignored(bench: Bench, step: str, frames: list[RawFrame]) -> None:
    """Check that the device does not restart; an application may confirm every write."""
    with bench.step(step):
        bench.send(frames)
        bench.judge.note_stimulus()
        bench.expect_silence(
            bench.waits.silence_s,
            ignoring=(Reply.FEEDBACK, Reply.OTHER, Reply.VERSION_INFORMATION),
            why="no restart",
        )
