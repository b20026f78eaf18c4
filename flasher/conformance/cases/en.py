"""EN: end of transfer, and the start of the new application."""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import QUIET_S, Bench
from flasher.conformance.cases.tx import check_out_of_turn, transfer_image
from flasher.conformance.catalogue import DESTRUCTIVE, Requirement, case
from flasher.conformance.wire import END, WRITE, Received, Reply, describe, packet_count, version_in

_RESET_PERIOD_S: Final = 0.2
"""Interval at which a tool repeats a command (4.3)."""
_RESET_TRIES: Final = 5
"""Tries within 1 s (4.3)."""
_SECTOR_BYTES: Final = 8192
"""Padded images are as large as whole sectors of this size, or of a smaller one."""
_PADDING_MIN: Final = 8
"""Room for a checksum of the padded image."""
_LIFETIME: Final = 260
"""More upgrades than a counter of 8 bits counts."""
_COUNTED: Final = 256
"""A counter of 8 bits is 0 again."""
_MARK: Final = 0x04
_FLIPPED_MARKS: Final = tuple(_MARK ^ 1 << bit for bit in range(8))
_WRONG_MARKS: Final = (
    *_FLIPPED_MARKS,
    *(mark for mark in (*range(0x20), 0xFF) if mark not in (_MARK, *_FLIPPED_MARKS)),
)
"""Values to send in place of 04: each flipped bit, every control character."""
_SILENT_MARKS: Final = 18
"""Values that a device which ignores the first one gets between two waits."""
_UPGRADE_KINDS: Final = (Reply.REQUEST, Reply.ACK, Reply.NAK, Reply.COMPLETE, Reply.FEEDBACK)
"""Possible answers to end of transfer; a starting application may send other reports."""


@case(
    "EN-01",
    "end of transfer",
    clause="Welling 5.1, figure 2 (end); Welling 5.2, table 9 (C502); R19",
    stimulus="all packets, then end of transfer; a restart afterwards; images of one packet, of "
    f"whole erase sectors, a byte more and a byte less; in virtual time {_LIFETIME} upgrades, and "
    f"{_COUNTED} transfers without a restart in between where one begins anew (up_08)",
    expectation="complete within the limit, then the new application, directly or through the "
    "bootloader (en_03), and again after the restart",
    requires={DESTRUCTIVE},
    choices=("en_03",),
    upgrades=300,
)
def end(bench: Bench) -> None:
    good, second, sizes = bench.firmware
    image = second or good
    if second is None:
        bench.unsupported(
            "an image other than the current one", "the bench has no second good image"
        )
    bench.start_transfer(len(image))
    bench.packets(image)
    bench.end_transfer()
    with bench.step("after complete"):
        reply = bench.wait_for(Reply.BOOT_VERSION)
        if bench.choice("en_03") != "either":
            restarts = bench.choice("en_03") == "restarts"
            expected = "the bootloader announces itself" if restarts else "no boot version"
            bench.check(restarts == (reply is not None), expected, reply or "no boot version")
        bench.check_image(image)
    with bench.step("after a restart"):
        bench.reset_to_bootloader()
        bench.collect(bench.waits.burst_s)
        bench.check_application(image)
    for image in (good, *sizes):
        with bench.step(f"an image of {len(image)} bytes"):
            bench.start_transfer(len(image))
            bench.finish(image)
    if sizes and bench.is_in_virtual_time:
        with bench.step(f"{_LIFETIME} upgrades in a row"):
            for number in range(1, _LIFETIME + 1):
                done = bench.upgrade(sizes[0])
                runs = done.ok and bench.application_runs()
                bench.require(runs, f"upgrade {number} succeeds", done.reason or "no application")
            bench.check_image(sizes[0])
        bench.check_upgrade(good)
        if bench.choice("up_08") == "starts_over":
            with bench.step(f"update command number {_COUNTED} since a restart"):
                bench.start_transfer(len(good))
                for _ in range(_COUNTED - 1):
                    bench.packet(good, 1)
                    bench.update(len(good))
                bench.finish(good)
    if not sizes:
        _end_padded(bench, good)


def _end_padded(bench: Bench, good: bytes) -> None:
    """Upgrade to the good image, padded to whole sectors, a byte more and a byte less."""
    whole = len(good) + _PADDING_MIN
    whole += -whole % _SECTOR_BYTES
    if whole >= bench.number("largest_image_bytes"):
        why = "the device takes none that is so much larger than the good image"
        bench.unsupported("an image that ends with a sector", why)
        return
    for size in (whole, whole + 1, whole - 1):
        with bench.step(f"the good image padded to {size} bytes"):
            image = bench.padded(size)
            bench.start_transfer(size)
            bench.packets(image)
            if not bench.end_padded_transfer():
                return
            bench.check_image(image)


@case(
    "EN-02",
    "end of transfer early, and twice",
    clause="Welling 5.1, figure 2 (end); Welling 5.2, table 8 (A401); R6",
    stimulus="end of transfer to the announcing bootloader, before packet 1, after it and before "
    "the last one; with another byte than 04; end of transfer again after complete",
    expectation="NAK; the transfer continues or can be restarted; the second end is answered as "
    "the profile says (en_02)",
    requires={DESTRUCTIVE},
    choices=("en_02", "rs_03"),
)
def end_early_and_twice(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    with bench.step("end of transfer without a transfer"):
        check_out_of_turn(bench, bench.encoder.end())
        bench.check_application()
    bench.start_transfer(len(image))
    done = 0
    for stored in (0, 1, total - 1):
        with bench.step(f"end of transfer after packet {stored} of {total}"):
            bench.packets(image, done + 1, stored)
            done = stored
            bench.send(bench.encoder.end())
            # A NAK of any number (R6) and no other message.
            bench.expect(Reply.NAK, within_s=bench.limit("complete_s"))
            bench.judge.note_stimulus(heard=True)
            quiet_s = bench.waits.in_transfer_s(bench.limit("ack_s"))
            bench.expect_silence(quiet_s, ignoring=(Reply.BOOT_VERSION,))
            bench.send_packet(image, stored + 1)
            reply = bench.wait_for(Reply.ACK, Reply.NAK, Reply.BOOT_VERSION)
            if str(reply) == f"ACK {stored + 1}":
                bench.succeed(f"ACK {stored + 1}", reply)
                done += 1
            else:
                bench.info(f"after packet {stored}, an early end of transfer ends the transfer")
                _restart_transfer(bench, image, stored, reply)
    bench.packets(image, done + 1)
    _check_wrong_marks(bench, image)
    bench.end_transfer()
    with bench.step("end of transfer after complete"):
        _check_second_end(bench, Reply.COMPLETE)
        bench.check_image(image)


def _check_wrong_marks(bench: Bench, image: bytes) -> None:
    """Send end of transfer with other values than 04 to a device that has stored all packets."""
    total = packet_count(len(image))
    left, size = list(_WRONG_MARKS), 1
    while left:
        marks, left = left[:size], left[size:]
        with bench.step(f"end of transfer with {bytes(marks).hex(' ').upper()}"):
            bench.stay_before(image, total + 1)
            for mark in marks:
                bench.send(bench.encoder.message(WRITE, END, bytes((mark,))))
            kinds = (*_UPGRADE_KINDS, Reply.BOOT_VERSION)
            reply = bench.wait_for(*kinds, within_s=bench.limit("ack_s"))
            answers = [] if reply is None else [reply, *bench.collect(QUIET_S)]
            ok = not any(one.kind in (Reply.COMPLETE, Reply.ACK) for one in answers)
            bench.require(ok, "rejected", describe(answers))
        if not any(one.kind in (Reply.NAK, Reply.BOOT_VERSION) for one in answers):
            size = _SILENT_MARKS
            continue
        bench.send_packet(image, total)
        if bench.wait_for(Reply.ACK, Reply.NAK, unlike=lambda one: one.number < total) is None:
            _restart_transfer(bench, image, total)
            left = [mark for mark in left if mark in _FLIPPED_MARKS]


def _restart_transfer(
    bench: Bench, image: bytes, stored: int, reply: Received | None = None
) -> None:
    """Send packets 1 to `stored` in a new transfer; `reply` is the last message received."""
    within_s = bench.limit("refused_s") + bench.limit("first_version_s")
    found = reply if reply is not None and reply.kind is Reply.BOOT_VERSION else None
    if found is None:
        bench.send(bench.encoder.reset())
        found = bench.wait_for(Reply.BOOT_VERSION, within_s=within_s)
    if found is None and bench.profile.allows("rs_03_old", "kept"):
        # The old application started while the early end and what followed it were judged.
        bench.update_again(len(image))
    else:
        if bench.choice("rs_03") == "announces":
            bench.require_received(found, "continued transfer or boot version", within_s)
        bench.update(len(image))
    bench.packets(image, 1, stored)


def _check_second_end(bench: Bench, first_answer: Reply) -> None:
    """Send end of transfer again, immediately after its answer, and check the second answer."""
    sent = bench.send(bench.encoder.end())
    reply = bench.wait_for(*_UPGRADE_KINDS, within_s=bench.limit("complete_s"))
    quiet_s = max(QUIET_S, sent.left_at + bench.limit("ack_s") - bench.now)
    replies = [] if reply is None else [reply, *bench.collect(quiet_s)]
    answers = [one for one in replies if one.kind in _UPGRADE_KINDS]
    # A running application may send general feedback to an unknown message (R17).
    silence: list[list[Reply]] = [[], [Reply.FEEDBACK]]
    allowed = {
        "same_answer": [[first_answer]],
        "silence": silence,
        "either": [[first_answer], *silence],
    }[bench.choice("en_02")]
    names = (", ".join(kind.value for kind in kinds) or "silence" for kinds in allowed)
    ok = [one.kind for one in answers] in allowed
    bench.check(ok, " or ".join(names), describe(answers))


@case(
    "EN-04",
    "image with a wrong checksum",
    clause="Welling 5.1, figure 2 (end); R6; R7",
    stimulus="a good image with another checksum, the second one where there is one; end of "
    "transfer twice; then the good image",
    expectation="NAK, the second time too (en_02); it is not started: no application runs, or the "
    "old one (rs_03_old); the device is rescuable",
    requires={DESTRUCTIVE, Requirement.CHECKSUM},
    choices=("en_02", "en_04", "rs_03", "rs_03_old"),
)
def wrong_checksum(bench: Bench) -> None:
    # The code is that of a good image, so a device that starts it anyway is not harmed.
    code = bench.subject.second_image or bench.good_image
    image = code[:-1] + bytes((code[-1] ^ 0xFF,))
    bench.start_transfer(len(image))
    bench.packets(image)
    bench.send(bench.encoder.end())
    bench.expect(Reply.NAK, within_s=bench.limit("complete_s"))
    with bench.step("end of transfer again"):
        _check_second_end(bench, Reply.NAK)
    with bench.step("afterwards"):
        within_s, old = bench.limit("refused_s"), bench.choice("rs_03_old")
        reply = bench.wait_for(Reply.BOOT_VERSION, within_s=within_s)
        # Otherwise it may listen silently, or start its old application.
        if bench.choice("rs_03") == "announces" and old == "erased":
            bench.require_received(reply, Reply.BOOT_VERSION.value, within_s)
        bench.wait(bench.waits.burst_s)
        runs = bench.application_runs()
        expected = {"erased": "no application runs", "kept": "the old application runs"}
        if old in expected:
            got = "it answers" if runs else "no answer"
            bench.check(runs == (old == "kept"), expected[old], got)
        if runs and old != "erased":
            bench.check_image(bench.good_image)
            if bench.subject.second_image is None and not bench.subject.has_readback:
                why = "the bench has neither a second good image nor readback"
                bench.unsupported("the image that runs is not the refused one", why)
    with bench.step("the good image"):
        if runs:
            bench.reset_to_bootloader()
        bench.update(len(bench.good_image))
        bench.finish(bench.good_image)


@case(
    "EN-07",
    "upgrades in a row",
    clause="Welling 5.1, figure 2 (end)",
    stimulus="three upgrades, each started as soon as the previous one is complete, to a smaller "
    "image and back",
    expectation="each image is correct: no bytes of the previous image are left",
    requires={DESTRUCTIVE},
)
def in_a_row(bench: Bench) -> None:
    good, second, _ = bench.firmware
    if second is None:
        bench.unsupported("a smaller image", "the bench has no second good image")
        second = good
    images = (good, second, good)
    bench.reset_to_bootloader()
    for turn, image in enumerate(images, 1):
        with bench.step(f"upgrade {turn}, {len(image)} bytes"):
            if turn > 1:
                # A device that is starting its application receives nothing: repeat the reset until
                # it answers (4.3). Each may restart a bootloader before it announces itself
                # (RS-02), so there is a pause after the tries of a second.
                first_s = bench.limit("first_version_s")
                within_s = bench.limit("start_s") + first_s + _RESET_TRIES * _RESET_PERIOD_S
                deadline, reply, tries = bench.now + within_s, None, 0
                while reply is None and bench.now < deadline:
                    tries += 1
                    pause_s = _RESET_PERIOD_S if tries % _RESET_TRIES else first_s
                    with bench.tester.collecting_feedback():
                        bench.send(bench.encoder.reset())
                        kinds = (Reply.FEEDBACK, Reply.BOOT_VERSION)
                        reply = bench.wait_for(*kinds, within_s=pause_s)
                    is_announced = reply is not None and reply.kind is Reply.BOOT_VERSION
                    # A reset that came into its announcements may restart it (RS-02). A bootloader
                    # that ignores it until it starts its application may confirm it (R15).
                    if reply is not None and not (is_announced and bench.number("versions") == 1):
                        reply = bench.wait_for(Reply.BOOT_VERSION)
                bench.require_received(reply, Reply.BOOT_VERSION.value, within_s)
            bench.update(len(image))
            bench.packets(image)
            bench.end_transfer()
    bench.check_image(images[-1])
    with bench.step("the smaller image runs"):
        bench.start_transfer(len(second))
        bench.finish(second)


@case(
    "EN-08",
    "version after an upgrade",
    clause="Welling 3.2, table 5 (1540)",
    stimulus="version query after an upgrade to another version, and after one back",
    expectation="the application reports the version of the image that it is",
    requires={DESTRUCTIVE, Requirement.SECOND_IMAGE},
)
def version(bench: Bench) -> None:
    before = bench.application_version(bench.limit("start_s"))
    good, second, _ = bench.firmware
    for image in filter(None, (second, good)):
        wanted = version_in(image)
        if wanted is None:
            bench.unsupported("the version of the image", "no version text is in it")
            continue
        with bench.step(f"upgrade from {before!a} to {wanted}"):
            bench.start_transfer(len(image))
            bench.packets(image)
            bench.end_transfer()
            before = bench.application_version(bench.limit("start_s"))
            bench.check(before == wanted, f"version {wanted}", f"{before!a}")
