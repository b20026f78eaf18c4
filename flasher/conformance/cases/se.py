"""SE: bad input. Floods, random noise, and writes outside the application area."""

from __future__ import annotations

from itertools import cycle
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.tx import transfer_image
from flasher.conformance.cases.up import check_updates_rejected
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.wire import (
    BOOT_VERSION,
    END,
    IMAGE_BYTES_MAX,
    PACKET,
    PACKET_BYTES,
    QUERY_VERSION,
    READ,
    REPORT,
    UPDATE,
    WRITE,
    RawFrame,
    Received,
    Reply,
    describe,
    packet_count,
)

_FLOOD_FRAMES: Final = 600
"""Frames of one flood: 4.8 kB, more than a small device can buffer."""
_HEADS: Final = bytes((0x55, 0xAA, WRITE, 0xFF))
_UNKNOWN: Final = 0x6F00
"""Unused command; its second byte is set to the length of the data."""
_SLOW_GAP_S: Final = 0.04
"""Gap between useless messages where the time matters, not their number."""
_RANDOM_FRAMES: Final = 120
_RANDOM_MESSAGES: Final = 30
_LIKELY: Final = (BOOT_VERSION, UPDATE, PACKET, END, QUERY_VERSION)
_SETTINGS: Final = range(0x30, 0x50)
"""First bytes of commands that write settings to the application, which a device would keep."""


# -- floods ---------------------------------------------------------------------------------------


@case(
    "SE-01",
    "endless bytes and useless messages",
    clause="R12; robustness, not in the document",
    stimulus="repeated headers, endless data, useless long and short messages: to the "
    "application, in the announcements and in a transfer",
    expectation="the device continues normally; the window and the pause (tx_12) end in time",
    requires={DESTRUCTIVE, LONG},
    choices=("tx_12",),
)
def endless(bench: Bench) -> None:
    encoder, image = bench.encoder, transfer_image(bench)
    # Sent as reads, so that an application does not write anything.
    long_message = encoder.message(READ, _UNKNOWN + 253, bytes(range(253)))
    short_message = encoder.message(READ, _UNKNOWN)
    floods = {
        "repeated headers": encoder.frames((_HEADS * 2) * _FLOOD_FRAMES),
        "endless data": encoder.frames(_HEADS + b"\x55\xaa" * (4 * _FLOOD_FRAMES - 2)),
        "long messages": long_message * (_FLOOD_FRAMES // len(long_message)),
        "short messages": short_message * (_FLOOD_FRAMES // len(short_message)),
    }
    for name, frames in floods.items():
        with bench.step(f"to the application: {name}"):
            bench.send(frames)
            bench.check_application()
        with bench.step(f"in the announcements: {name}"):
            _flood_window(bench, frames)
    bench.start_transfer(len(image))
    for number, (name, frames) in enumerate(floods.items(), 1):
        with bench.step(f"in a transfer, before packet {number}: {name}"):
            bench.send(frames)
            late_s = bench.limit("ack_s") + bench.limit("inter_frame_s")
            bench.collect(bench.waits.in_transfer_s(late_s))
            bench.packet(image, number)
    with bench.step("in a pause of the transfer"):
        if bench.choice("tx_12") == "announces":
            limit_s = bench.limit("pause_s") + bench.limit("first_version_s")
            reply = _send_slowly_until(bench, Reply.BOOT_VERSION, limit_s, [])
            bench.check(reply is not None, f"boot version within {limit_s:g} s", reply or "none")
        elif bench.choice("tx_12") == "either":
            limit_s = bench.limit("pause_s") + bench.limit("first_version_s")
            _send_slowly_until(bench, Reply.BOOT_VERSION, limit_s, [])
            bench.collect(2 * bench.limit("inter_frame_s"))
            bench.send_packet(image, len(floods) + 1)
            reply = bench.wait_for(Reply.ACK, Reply.BOOT_VERSION)
            if reply is not None and reply.kind is Reply.ACK:
                bench.finish(image, len(floods) + 2)
            else:  # it gave the transfer up
                bench.update_again(len(image))
                bench.finish(image)
        else:
            bench.finish(image, len(floods) + 1)


def _flood_window(bench: Bench, frames: list[RawFrame]) -> None:
    """Send useless data beyond the end of the window; the application still has to start."""
    bench.reset_to_bootloader()
    ends_at = bench.now + bench.waits.burst_s
    for _ in range(1 + int(bench.waits.burst_s / (_FLOOD_FRAMES * 0.0004))):
        if bench.now < ends_at:
            bench.send(frames)
    if bench.encoder.has_version_query:
        limit_s = bench.limit("start_s")
        reply = _send_slowly_until(
            bench, Reply.VERSION_INFORMATION, limit_s, bench.encoder.query_version()
        )
        expected = f"an application that answers within {limit_s:g} s"
        bench.check(reply is not None, expected, reply or "none")
        # Many queries were sent: discard late answers.
        bench.collect(bench.waits.silence_s)
    else:
        expected = "an application that answers while useless data continue"
        bench.unsupported(expected, "the document has no version query for this target")
    bench.check_application()


def _send_slowly_until(
    bench: Bench, kind: Reply, within_s: float, query: list[RawFrame]
) -> Received | None:
    """Send useless messages slowly, with `query` between them, until `kind` is received."""
    deadline = bench.now + within_s
    encoder = bench.encoder
    drops = cycle((encoder.message(READ, _UNKNOWN), encoder.frames(_HEADS * 2)))
    reply: Received | None = None
    while reply is None and bench.now < deadline:
        # A pause, so that the query is not taken for the rest of a partial message.
        bench.send([*next(drops)])
        bench.wait(bench.limit("inter_frame_s") + _SLOW_GAP_S if query else 0.0)
        if query:
            bench.send(query)
        reply = bench.wait_for(kind, within_s=_SLOW_GAP_S)
    return reply


# -- noise ----------------------------------------------------------------------------------------


@case(
    "SE-03",
    "random input in every state",
    clause="R19; robustness, not in the document",
    stimulus="random frames and random intact messages (by the seed) to the application, in the "
    "announcements, during the erase, before, between and after packets, and after complete",
    expectation="reachable, and the old or the new application is intact",
    requires={DESTRUCTIVE, LONG},
    choices=("up_08",),
)
def noise(bench: Bench) -> None:
    image = transfer_image(bench, bench.good_image)
    with bench.step("the application"):
        _send_noise(bench)
        bench.check_application()
    with bench.step("the announcements"):
        bench.reset_to_bootloader()
        _send_noise(bench)
        bench.collect(bench.waits.burst_s)
        bench.check_image(image)
    with bench.step("while it erases"):
        bench.reset_to_window()  # one that is deaf in its burst would not erase
        bench.send(bench.encoder.update(len(image)))
        _send_noise(bench)
        bench.wait_for(Reply.REQUEST)
        done = _continue_transfer(bench, image, 0)
    for stored in (1, 3, packet_count(len(image))):
        with bench.step(f"after packet {stored}"):
            if not done:
                bench.start_transfer(len(image))
            bench.packets(image, done + 1, stored)
            _send_noise(bench)
            done = _continue_transfer(bench, image, stored)
    with bench.step("after complete"):
        _send_noise(bench)
        bench.collect(bench.waits.silence_s)  # a bootloader's feedback is not its application's
        bench.check_image(image)


def _continue_transfer(bench: Bench, image: bytes, stored: int) -> int:
    """Send the next packet or end of transfer. A device that left the transfer has to accept a
    complete upgrade instead. Returns the packets stored, 0 without a transfer.
    """
    late_s = bench.limit("ack_s") + bench.limit("inter_frame_s")
    bench.collect(bench.waits.in_transfer_s(late_s))
    if stored < packet_count(len(image)):
        bench.send_packet(image, stored + 1)
        if bench.wait_for(Reply.ACK, unlike=lambda one: one.number != stored + 1) is not None:
            return stored + 1
    else:
        bench.send(bench.encoder.end())
        if bench.wait_for(Reply.COMPLETE) is not None:
            return 0
    bench.info(f"the noise after packet {stored} ended the transfer")
    if bench.profile.allows("rs_03_old", "kept"):  # while that starts, it hears no reset
        bench.application_runs(bench.waits.restart_s)
    done = bench.upgrade(image, blind=bench.choice("up_08") != "rejected")
    bench.require(done.ok, "the transfer continues, or the device can be upgraded", done.reason)
    bench.check_application(image)
    return 0


def _send_noise(bench: Bench) -> None:
    """Send random frames, then random messages with a correct CRC."""
    chance, encoder = bench.random, bench.encoder
    frames = []
    for _ in range(_RANDOM_FRAMES):
        data = chance.randbytes(chance.randrange(9))
        if not chance.randrange(4):
            data = (_HEADS[: chance.randrange(1, 5)] + data)[:8]
        frames.append(RawFrame(encoder.to_device, data))
    bench.send(frames)
    bench.wait(bench.limit("inter_frame_s") + _SLOW_GAP_S if chance.randrange(2) else 0.0)
    bench.send([frame for _ in range(_RANDOM_MESSAGES) for frame in _random_message(bench)])


def _random_message(bench: Bench) -> list[RawFrame]:
    """A message of random mode, command and data; a write of a setting becomes a read. Random data
    are too unlikely to form a correct reset, update command or packet to exclude these.
    """
    chance = bench.random
    if chance.randrange(2):
        command = chance.choice((*_LIKELY, bench.encoder.reset_command))
        data = chance.randbytes(command & 0xFF)
    else:
        data = chance.randbytes(chance.choice((0, 1, 2, 8, 31, 133, 253)))
        command = chance.randrange(256) << 8 | len(data)
    mode = chance.choice((READ, WRITE, REPORT, chance.randrange(256)))
    is_reset = command == bench.encoder.reset_command
    if mode == WRITE and command >> 8 in _SETTINGS and not is_reset:
        mode = READ
    if mode == WRITE and command == END:
        data = bytes((data[0] & 0xFB,))  # never the true one
    return bench.encoder.message(mode, command, data)


# -- addresses ------------------------------------------------------------------------------------


@case(
    "SE-04",
    "writes outside of the application area",
    clause="R8; R9",
    stimulus="update command for sizes beyond the area, also those that overflow when they are "
    "rounded up; packets with number 0 and beyond the total, with the total to match as well",
    expectation="rejected; nothing is stored, and application and bootloader are intact",
    requires={DESTRUCTIVE, LONG},
    choices=("up_02", "tx_01"),
)
def outside(bench: Bench) -> None:
    area = bench.number("application_bytes")
    sizes = (area + 1, IMAGE_BYTES_MAX + 1, 0x8000_0000, 0xFFFF_FF80, 0xFFFF_FF81, 0xFFFF_FFFF)
    beyond_area = dict.fromkeys(size for size in sizes if size > area)
    check_updates_rejected(
        bench, {f"size {size:X}": bench.encoder.update(size) for size in beyond_area}
    )
    image = transfer_image(bench)
    total = packet_count(len(image))
    marker = bench.random.randbytes(PACKET_BYTES)
    beyond = (0, total + 1, packet_count(area) + 1, 0x8000, 0xFFFF)
    numbers = [
        (number, named)
        for number in dict.fromkeys(beyond)
        if number <= 0xFFFF and not 0 < number <= total
        for named in dict.fromkeys((total, number))
    ]
    for stored in bench.transfer_in_parts(image, (0, 1, total)):
        for number, named in numbers:
            with bench.step(f"after packet {stored}, packet {number} of {named}"):
                bench.stay_before(image, stored + 1)
                bench.send(bench.encoder.packet(number, named, marker))
                replies = bench.answers()
                bench.judge.note_stimulus(heard=bool(replies))
                ok = all(one.kind is Reply.NAK for one in replies)
                bench.check(ok, "NAK or silence", describe(replies))
    expected = "none of the rejected data in the flash"
    if not bench.subject.has_readback:
        bench.unsupported(expected, "the bench has no readback")
        return
    found = bench.subject.readback().find(marker)
    bench.check(found < 0, expected, "not there" if found < 0 else f"at offset {found}")
