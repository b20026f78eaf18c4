"""CO: concurrency. Bus load, a babbling node, a second upgrade, application traffic (chapter 3).

The suite itself sends the frames of the other nodes, between its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.wire import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    READ,
    REPORT,
    REQUEST,
    Encoder,
    RawFrame,
    Received,
    Reply,
    build,
    inverted,
    packet_count,
    packet_payload,
    split,
)

_FOREIGN_IDS: Final = (0x0A0, 0x1F4, 0x3C3, 0x555, 0x6FF)
"""Ids that no node of this protocol uses."""
_FOREIGN_DATA: Final = bytes.fromhex("A5C30F96D2E17B4C")
_FOREIGN_BITS: Final = 111
"""Bits of an 8-byte frame without stuff bits: the length of a free gap."""
_SHARE: Final = 9
"""Foreign frames for each frame of the upgrade or free gap: 90 % bus load."""
_FOREIGN: Final = [
    RawFrame(_FOREIGN_IDS[index % len(_FOREIGN_IDS)], _FOREIGN_DATA) for index in range(_SHARE)
]
_LOAD_S: Final = 0.3
_LOADED_PACKETS: Final = 24
"""Packets to send under load; more would show nothing new."""
_BABBLE_ID: Final = 0x001
_BABBLE_S: Final = 1.0
_BABBLE_BURST: Final = 16
_SHORT_BABBLE: Final = 10 * (RawFrame(_BABBLE_ID, bytes(8)),)

_REPORTS: Final = (
    # Motor controller.
    (0x710, REPORT, 0x1305, b"READY"),
    (0x710, REPORT, 0x1808, b"SHUTDOWN"),
    (0x712, READ, 0x3009, b"HANDSHAKE"),
    (0x712, READ, 0x3100, b""),
    (0x712, READ, 0x3200, b""),
    (0x712, READ, 0x3300, b""),
    # Battery.
    (0x720, REPORT, 0x1010, bytes(16)),
    (0x720, REPORT, 0x1120, bytes(32)),
    (0x720, REPORT, 0x1204, b"\x01\x00\x00\x00"),
    (0x720, REPORT, 0x1308, b"SHUTDOWN"),
    (0x720, REPORT, 0x1410, bytes(16)),
    (0x720, REPORT, 0x1540, bytes(64)),
    (0x720, REPORT, 0x160C, bytes(12)),
    (0x721, REPORT, 0x3005, b"READY"),
    # On-board computer and display.
    (0x730, REPORT, 0x1405, b"READY"),
    (0x732, READ, 0x5000, b""),
    (0x732, READ, 0x5100, b""),
    (0x732, READ, 0x5200, b""),
    (0x732, READ, 0x5300, b""),
    (0x740, REPORT, 0x1305, b"READY"),
    (0x742, READ, 0x5000, b""),
    (0x742, READ, 0x5100, b""),
)
"""Application traffic (chapter 3) between other nodes: id, mode, command, data."""
_QUERIES: Final = (
    *(0x3000, 0x3100, 0x3300, 0x3400, 0x3500, 0x3600),
    *(0x3700, 0x3800, 0x3900, 0x3B00, 0x3D00),
)
"""Read queries from the tool to an application. Writes are left out: a device that accepted one by
mistake would lose settings that only its manufacturer can restore.
"""
_MEMORY_READ: Final = 0x4308


@case(
    "CO-01",
    "bus load and a babbling node",
    clause="Welling 2.2.2, table 2; robustness, not in the document",
    stimulus="90 % bus load of other ids around reset, update command and packets; a node that "
    "takes the whole bus with id 001 for 1 s, in the announcements and in the transfer, and for "
    "5 ms after end of transfer",
    expectation="nothing fails under load; the upgrade continues after the babbling node stops",
    requires={DESTRUCTIVE, LONG},
)
def load(bench: Bench) -> None:
    image = bench.good_image
    total = packet_count(len(image))
    loaded = min(total, _LOADED_PACKETS)
    with bench.step("a babbling node in the announcements"):
        bench.reset_to_bootloader()
        _babble(bench, _BABBLE_S)
        bench.check_application()
    with bench.step("reset under load"):
        until = bench.now + _LOAD_S
        while bench.now < until:
            bench.send(_FOREIGN)
            bench.wait(_FOREIGN_BITS / bench.port.bitrate_bps)
        bench.send(_under_load(bench.encoder.reset()))
        _expect_under_load(bench, Reply.BOOT_VERSION)
        bench.wait_for_window()
    with bench.step("update command under load"):
        bench.send(_under_load(bench.encoder.update(len(image))))
        _expect_under_load(bench, Reply.REQUEST)
    with bench.step("packets under load"):
        for number in range(1, loaded):
            bench.send(_under_load(bench.encoder.packet_of(image, number)))
            reply = _expect_under_load(bench, Reply.ACK)
            bench.require(reply.number == number, f"ACK {number}", reply)
    with bench.step("a babbling node in the transfer"):
        began_at = bench.now
        bench.send_packet(image, loaded)
        _babble(bench, bench.waits.in_transfer_s(_BABBLE_S))
        # The node took part of a pause (TX-12), so no wait follows the ACK.
        if bench.wait_for(Reply.ACK, unlike=lambda one: one.number != loaded) is None:
            trouble = bench.host.deliver_packet(image, loaded, began_at)
            bench.require(not trouble, f"ACK {loaded}", trouble or "it")
    with bench.step("end of transfer, then a busy bus"):
        bench.packets(image, loaded + 1)
        bench.send([*bench.encoder.end(), *_SHORT_BABBLE])
        bench.expect(Reply.COMPLETE)
        bench.check_image(image)


@case(
    "CO-02",
    "another target is upgraded at the same time",
    clause="Welling 2.2.2, table 2",
    stimulus="the upgrade of each other target, both sides of it, frame by frame between the "
    "frames of the device's own upgrade",
    expectation="no crosstalk: every packet is acknowledged once, and the image is right",
    requires={DESTRUCTIVE, LONG},
)
def two_upgrades(bench: Bench) -> None:
    image = bench.good_image
    total = packet_count(len(image))
    for other in bench.encoder.others():
        with bench.step(f"beside the {other.target.upper()}"):
            bench.reset_to_window()
            _send_interleaved(bench, bench.encoder.update(len(image)), other.update(len(image)))
            bench.expect(Reply.REQUEST, ignoring=(Reply.BOOT_VERSION,))
            bench.send(other.answer(REQUEST, bytes(2)))
            for number in range(1, total + 1):
                # The other target's packet has other data; its next packet is sent alone.
                inverse = inverted(packet_payload(image, number))
                own = bench.encoder.packet_of(image, number)
                _send_interleaved(bench, own, other.packet(number, total, inverse))
                bench.expect(Reply.ACK, number=number)
                bench.send(other.answer(ACK, number.to_bytes(2, "little")))
                if number < total:
                    bench.send(other.packet(number + 1, total, inverse))
                if number == 1:
                    bench.send(other.answer(BOOT_VERSION, other.boot_name.encode() + b"V1.0.0"))
                    bench.expect_silence(bench.waits.in_transfer_s(bench.limit("ack_s")))
            # A device that wrongly takes this for its own end of transfer fails here.
            bench.send(other.end())
            bench.send(other.answer(COMPLETE, bytes(2)))
            bench.expect_silence()
            bench.end_transfer()
            bench.check_image(image)


@case(
    "CO-04",
    "traffic of the application in the bootloader",
    clause="Welling 3, tables 4 to 7; R15",
    stimulus="messages of chapter 3 to the device and between other nodes, during the "
    "announcements, before packet 1, between packets and before the end",
    expectation="ignored: no answer, and the upgrade continues normally",
    requires={DESTRUCTIVE},
)
def application_traffic(bench: Bench) -> None:
    image = bench.good_image
    total = packet_count(len(image))
    traffic = list(_chapter_3_frames(bench.encoder))
    with bench.step("during the announcements"):
        announced = bench.reset_to_bootloader()
        bench.send(traffic)
        quiet_s = bench.limit("version_spacing_s")
        if bench.number("versions") == 1:  # no other follows at which to repeat the update command
            quiet_s = announced.at + bench.limit("window_s") / 2 - bench.now
        replies = bench.collect(quiet_s)
        bench.check_only(replies, Reply.BOOT_VERSION, why="no answer")
        bench.update(len(image))
    middle = max(1, total // 2)
    for before, first, last in (("packet 1", 1, middle), ("a packet", middle + 1, total)):
        with bench.step(f"before {before}"):
            bench.send(traffic)
            bench.expect_silence(ignoring=(Reply.BOOT_VERSION,) if first == 1 else ())
            bench.packets(image, first, last)
    with bench.step("before the end"):
        bench.send(traffic)
        bench.expect_silence()
        bench.end_transfer()
        bench.check_image(image)


# -- load -----------------------------------------------------------------------------------------


def _under_load(frames: Sequence[RawFrame]) -> list[RawFrame]:
    """Insert nine foreign frames before each frame of the upgrade."""
    return [one for frame in frames for one in (*_FOREIGN, frame)]


def _expect_under_load(bench: Bench, kind: Reply) -> Received:
    """Wait for a message of this kind while the load continues."""
    within_s = bench.tester.limit_s(kind)
    until = bench.now + within_s
    reply: Received | None = None
    while reply is None and bench.now < until:
        bench.send(_FOREIGN)
        reply = bench.wait_for(kind, within_s=_FOREIGN_BITS / bench.port.bitrate_bps)
    return bench.require_received(reply, kind.value, within_s)


def _babble(bench: Bench, for_s: float) -> None:
    until = bench.now + for_s
    while bench.now < until:
        bench.send([RawFrame(_BABBLE_ID, bytes(8))] * _BABBLE_BURST)


# -- another upgrade ------------------------------------------------------------------------------


def _send_interleaved(bench: Bench, own: Sequence[RawFrame], others: Sequence[RawFrame]) -> None:
    """Send the frames of two messages alternately, the device's own message ending last."""
    frames: list[RawFrame] = []
    for index in range(max(len(own), len(others))):
        frames += others[index : index + 1]
        frames += own[index : index + 1]
    bench.send(frames)


# -- chapter 3 ------------------------------------------------------------------------------------


def _chapter_3_frames(encoder: Encoder) -> Iterator[RawFrame]:
    """Application messages of chapter 3, without those that the device itself sends."""
    for can_id, mode, command, data in _REPORTS:
        if can_id & 0x0F0 != encoder.to_all & 0x0F0:
            yield from split(can_id, build(can_id, mode, command, data))
    for command in _QUERIES:
        yield from encoder.message(READ, command)
    yield from encoder.message(READ, _MEMORY_READ, bytes(4) + (128).to_bytes(4, "little"))
