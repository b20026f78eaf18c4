"""Each deliberately wrong device does the one thing that it declares wrong, and the right one
does not; apart from that it can be upgraded.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest

from flasher.errors import UsageError
from flasher.mock.model import MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderState
from flasher.mock.variants import VARIANTS, HangingDevice, Variant, find, make
from flasher.mock.variants.base import variant
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, OBC, WELLING, WMC, Target
from tests.end_to_end import world
from tests.loops import each
from tests.mock.bench import image_of
from tests.mock.tool import REQUEST_ID, Tool, packet_wire, update_wire
from tests.peers.wording import READ, REPORT, WRITE, build, crc, payloads

PROFILE = DeviceProfile(application_area_bytes=128 * 1024)
IMAGE = image_of(600)
OTHER = image_of(600, seed=11)
LONG = image_of(257 * 128 - 1)
GROUPS: dict[str, Sequence[int]] = {
    "FR": range(1, 11),
    "CR": range(1, 5),
    "RS": range(1, 6),
    "UP": (1, 2, 3, 4, 5, 6, 8),
    "TX": (1, 2, 3, 4, 5, 6, 7, 8, 12, 13),
    "EN": (1, 2, 4, 7, 8),
    "TM": (2, 5),
    "BU": (1, 2, 6),
    "PW": (1, 2),
    "SE": (1, 3, 4),
    "CO": (1, 2, 4),
}
DEVICE_CASES = [f"{group}-{at:02}" for group, numbers in GROUPS.items() for at in numbers]
"""Cases of the catalogue that are about a bootloader."""

Act = Callable[[Tool], object]
ACTS: dict[str, tuple[Act, object, object]] = {}
"""For each variant: what is done, and what comes of it with a right device and with the variant."""


def does(variant: str, *, right: object, wrong: object) -> Callable[[Act], Act]:
    def keep(act: Act) -> Act:
        ACTS[variant] = (act, right, wrong)
        return act

    return keep


def requests_for(tool: Tool, size_bytes: int) -> int:
    """How many request transfers an update command brings."""
    tool.update(size_bytes)
    tool.run(0.03)
    return len(tool.heard("request"))


def requests_after(*parts: bytes, gap_s: float = 0.0) -> Act:
    """Payloads to the announcing bootloader: how many request transfers come."""

    def act(tool: Tool) -> object:
        tool.boot()
        tool.put_payloads(parts, gap_s)
        tool.run(0.03)
        return len(tool.heard("request"))

    return act


def answers_in_transfer(*wires: bytes, stored: int = 0) -> Act:
    """Messages in a transfer of IMAGE: what is answered."""

    def act(tool: Tool) -> object:
        tool.transfer(IMAGE, stored)
        for wire in wires:
            tool.put_wire(wire)
            tool.run(0.15)
        return tool.heard()

    return act


def damaged(wire: bytes) -> bytes:
    changed = bytearray(wire)
    changed[60] ^= 0x04
    return bytes(changed)


UPDATE = update_wire(600)
PARTS = payloads(UPDATE)
FIRST = packet_wire(1, IMAGE)
SECOND = packet_wire(2, IMAGE)
QUERY = build(REQUEST_ID, READ, 0x3300, b"")

# -- framing and checksum -------------------------------------------------------------------------

IN_FIVES = [UPDATE[at : at + 5] for at in range(0, len(UPDATE), 5)]
BEHIND_JUNK = [b"\x12\x34" + UPDATE[:6], UPDATE[6:14], UPDATE[14:]]
PADDED = [*PARTS[:-1], PARTS[-1].ljust(8, b"\x00")]
MIRRORED = UPDATE[:-5] + UPDATE[-5:-1][::-1] + UPDATE[-1:]
WITHOUT_ID = UPDATE[:-5] + crc(UPDATE[:-5]).to_bytes(4, "big") + UPDATE[-1:]

does("short-frame-ends-message", right=1, wrong=0)(requests_after(*IN_FIVES))
does("header-at-frame-start-only", right=1, wrong=0)(requests_after(*BEHIND_JUNK))
does("ignores-tail", right=0, wrong=1)(requests_after(*payloads(UPDATE[:-1] + b"\xf1")))
does("short-length-hangs", right=1, wrong=0)(
    requests_after(bytes.fromhex("55AA160042FE0000"), *PARTS)
)
does("padding-is-fatal", right=1, wrong=0)(requests_after(*PADDED))
does("back-to-back-lost", right=1, wrong=0)(requests_after(*payloads(QUERY), *PARTS))
does("either-crc-order", right=0, wrong=1)(requests_after(*payloads(MIRRORED)))
does("crc-without-id", right=0, wrong=1)(requests_after(*payloads(WITHOUT_ID)))
does("drops-after-20-ms-gap", right=1, wrong=0)(requests_after(*PARTS, gap_s=0.05))
does("no-crc-check", right=["nak 1"], wrong=["ack 1"])(answers_in_transfer(damaged(FIRST)))


@does("header-in-data-restarts", right=["ack 1"], wrong=[])
def a_header_in_data_at_a_frame_boundary(tool: Tool) -> object:
    image = IMAGE[:5] + b"\x55\xaa" + IMAGE[7:]
    tool.transfer(image)
    tool.packet(1, image)
    tool.run(0.15)
    return tool.heard()


@does("trusts-length", right=1, wrong=0)
def a_message_broken_off_and_an_update_command_later(tool: Tool) -> object:
    tool.boot()
    tool.put_payloads([FIRST[:8]])
    tool.run(0.12)
    return requests_for(tool, 600)


@does("every-frame-is-payload", right=1, wrong=0)
def an_extended_frame_in_the_midst(tool: Tool) -> object:
    tool.boot()
    first, *rest = (Frame(REQUEST_ID, part) for part in PARTS)
    tool.put(first, Frame(REQUEST_ID, b"\x00" * 8, is_extended=True), *rest)
    tool.run(0.03)
    return len(tool.heard("request"))


@does("unknown-restarts", right=["ack 2"], wrong=[])
def an_unknown_command_in_the_transfer(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    tool.say(0x7E01, b"\x00")
    tool.run(0.1)
    tool.packet(2, IMAGE)
    return tool.heard("ack")


@does("short-packet-filled", right=["nak 1"], wrong=["ack 1"])
def a_packet_that_lost_a_frame(tool: Tool) -> object:
    tool.transfer(IMAGE)
    frames = payloads(FIRST)
    tool.put_payloads(frames[:9] + frames[10:])
    tool.run(0.15)
    return tool.heard()


# -- reset and boot version -----------------------------------------------------------------------


@does("feedback-crc-mirrored", right=["feedback"], wrong=["damaged"])
@does("no-feedback", right=["feedback"], wrong=[])
@does("feedback-on-wrong-id", right=["feedback"], wrong=["720 feedback"])
def the_answer_to_a_reset(tool: Tool) -> object:
    tool.reset()
    tool.run(0.01)
    return tool.heard()


@does("announces-three-times", right=[50, 50, 50], wrong=[50, 50])
@does("announces-every-60-ms", right=[50, 50, 50], wrong=[60, 60, 60])
def the_announcements_apart_in_ms(tool: Tool) -> object:
    tool.reset()
    tool.run(1.0)
    times = [at_s for at_s, _ in tool.heard_at("version")]
    return [round(1000 * (late - early)) for early, late in pairwise(times)]


@does("two-restarts", right=4, wrong=8)
def two_resets(tool: Tool) -> object:
    tool.reset()
    tool.run(0.02)
    tool.reset()
    tool.run(2.0)
    return len(tool.heard("version"))


@does("stays-in-bootloader", right=["720 1540"], wrong=[])
def a_reset_and_no_update_command(tool: Tool) -> object:
    tool.reset()
    tool.run(1.0)
    return tool.asks_version()


@does("gives-up-without-application", right=True, wrong=False)
def announcements_long_after_a_transfer_was_broken_off(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    tool.cycle_power()
    tool.run(2.0)
    tool.heard()
    tool.run(1.0)
    return bool(tool.heard("version"))


@does("resets-at-any-text", right=0, wrong=4)
def a_reset_with_another_text(tool: Tool) -> object:
    tool.say(0x4205, b"RESEX")
    tool.run(1.0)
    return len(tool.heard("version"))


@does("resets-on-read", right=[], wrong=["feedback"])
def a_reset_that_is_a_read(tool: Tool) -> object:
    tool.say(0x4205, b"RESET", mode=READ)
    return tool.heard()


@does("silent-power-up", right=(4, ["720 1540"]), wrong=(0, ["720 1540"]))
def the_announcements_of_a_power_up_and_the_application_after_it(tool: Tool) -> object:
    tool.cycle_power()
    tool.run(1.0)
    return len(tool.heard("version")), tool.asks_version()


# -- update command -------------------------------------------------------------------------------

does("any-target-name", right=0, wrong=1)(requests_after(*payloads(update_wire(600, b"WMC_UPD"))))


@does("queues-updates", right=(1, ["ack 1"]), wrong=(1, ["ack 1", "request"]))
def two_update_commands_and_packet_1(tool: Tool) -> object:
    requested = requests_after(*PARTS, *PARTS)(tool)
    tool.packet(1, IMAGE)
    tool.run(0.05)
    return requested, tool.heard()


@does("listens-until-third-version", right=(["version"] * 3, 1), wrong=(["version"] * 3, 0))
def an_update_command_after_the_third_announcement(tool: Tool) -> object:
    tool.cycle_power()
    tool.run(0.155)
    announced = tool.heard()
    tool.update(600)
    tool.run(0.03)
    return announced, len(tool.heard("request"))


@does("full-last-packet-fails", right=["complete"], wrong=["nak 1"])
def an_image_of_two_full_packets(tool: Tool) -> object:
    return tool.upgrade(IMAGE[:256])


@does("erases-before-checking-size", right=["720 1540"], wrong=[])
def an_impossible_size(tool: Tool) -> object:
    tool.boot()
    tool.update(0xFFFFFFFF)
    tool.run(1.0)
    return tool.asks_version()


@does("erases-from-application", right=(True, ["720 1540"]), wrong=(False, []))
def an_update_command_to_the_application(tool: Tool) -> object:
    before = tool.device.readback()[:500]
    tool.update(600)
    tool.cycle_power()
    tool.run(1.0)
    return tool.device.readback()[:500] == before, tool.asks_version()


@does("mixes-transfers", right=(["complete"], True), wrong=(["complete"], False))
def an_update_command_in_the_midst(tool: Tool) -> object:
    tool.transfer(IMAGE, 2)
    tool.update(600)
    tool.run(0.03)
    for number in range(1, 6):
        tool.packet(number, OTHER)
    tool.heard()
    tool.end()
    return tool.heard(), tool.device.readback()[:600] == OTHER


# -- transfer -------------------------------------------------------------------------------------

does("nak-wrong-number", right=["nak 1"], wrong=["nak 2"])(answers_in_transfer(damaged(FIRST)))
does("swallows-after-bad", right=["nak 1", "ack 1"], wrong=["nak 1"])(
    answers_in_transfer(damaged(FIRST), FIRST)
)
does("accepts-skipped-number", right=["nak 2"], wrong=["ack 3"])(
    answers_in_transfer(packet_wire(3, IMAGE), stored=1)
)
does("ignores-total", right=["nak 1"], wrong=["ack 1"])(
    answers_in_transfer(packet_wire(1, IMAGE, total=6))
)
does("ignores-start-byte", right=["nak 1"], wrong=["ack 1"])(
    answers_in_transfer(packet_wire(1, IMAGE, start=2))
)
does("filler-checked", right=["ack 5"], wrong=["nak 5"])(
    answers_in_transfer(packet_wire(5, IMAGE, filler=b"\x00"), stored=4)
)
does("big-endian-numbers", right=["ack 1"], wrong=["ack 256"])(answers_in_transfer(FIRST))
does("big-endian-nak", right=["nak 1", "ack 1"], wrong=["nak 256", "ack 1"])(
    answers_in_transfer(damaged(FIRST), FIRST)
)
does("reset-in-transfer-hangs", right=["ack 2"], wrong=[])(
    answers_in_transfer(build(REQUEST_ID, 0x16, 0x4205, b"RESET"), SECOND, stored=1)
)
does("writes-anywhere", right=["nak 1"], wrong=["ack 6"])(
    answers_in_transfer(packet_wire(6, IMAGE, total=5))
)


@does("writes-repeated-twice", right=(["complete"], True), wrong=(["complete"], False))
def a_packet_that_is_repeated(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    for number in range(1, 6):
        tool.packet(number, IMAGE)
    tool.heard()
    tool.end()
    return tool.heard(), tool.device.readback()[:600] == IMAGE


@does("repeat-overwrites", right=(["ack 1"], True), wrong=(["ack 1"], False))
def a_packet_that_is_repeated_with_other_data(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    tool.packet(1, OTHER)
    return tool.heard(), tool.device.readback()[:128] == IMAGE[:128]


@does("eight-bit-numbers", right=["ack 256"], wrong=["nak 0"])
def packet_256(tool: Tool) -> object:
    tool.transfer(LONG, 255)
    tool.packet(256, LONG)
    return tool.heard()


@does("hangs-after-256-packets", right=(["ack 256"], ["ack 257"]), wrong=(["ack 256"], []))
def packet_257(tool: Tool) -> object:
    tool.transfer(LONG, 255)
    answers = []
    for number in (256, 257):
        tool.packet(number, LONG)
        answers.append(tool.heard())
    return tuple(answers)


@does("never-times-out", right=1, wrong=0)
def a_transfer_that_was_left_and_an_update_command(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    tool.run(6.0)
    tool.reset()
    return requests_for(tool, 600)


# -- end and power --------------------------------------------------------------------------------

does("accepts-early-end", right=["nak 2"], wrong=["complete"])(
    answers_in_transfer(build(REQUEST_ID, 0x16, 0xA401, b"\x04"), stored=1)
)


@does("announces-after-complete", right=[0, True], wrong=[5, True])
def after_complete_and_after_a_power_cut(tool: Tool) -> object:
    assert tool.upgrade(IMAGE) == ["complete"]
    tool.run(0.2)
    versions = len(tool.heard("version"))
    tool.cycle_power()
    tool.run(1.0)
    return [min(versions, 5), tool.asks_version() == ["720 1540"]]


@does("ignores-image-checksum", right=["nak 5"], wrong=["complete"])
def an_image_without_a_right_checksum(tool: Tool) -> object:
    return tool.upgrade(IMAGE)


@does("keeps-longer-rest", right=(["complete"], True), wrong=(["complete"], False))
def a_smaller_image_after_a_longer_one(tool: Tool) -> object:
    tool.upgrade(image_of(900, seed=5))
    return tool.upgrade(IMAGE), tool.device.readback()[:600] == IMAGE


@does("reports-old-version", right="V2r0r0_20260101", wrong="V1r0r0_20220512")
def the_version_after_an_upgrade(tool: Tool) -> object:
    tool.upgrade(IMAGE)
    tool.asks_version()
    return tool.version_texts[-1]


@does("starts-torn-image", right=[], wrong=["720 1540"])
@does("record-first", right=[], wrong=["720 1540"])
def a_power_cut_in_the_transfer(tool: Tool) -> object:
    tool.transfer(IMAGE, 2)
    tool.cycle_power()
    tool.run(2.0)
    return tool.asks_version()


@does("ack-before-write", right=True, wrong=False)
def what_was_acknowledged_before_a_power_cut(tool: Tool) -> object:
    tool.transfer(IMAGE, 2)
    tool.device.power_cut(tool.now)
    assert tool.device.readback()[:128] == IMAGE[:128]
    return tool.device.readback()[:256] == IMAGE[:256]


@does("dark-after-second-cut", right=[True, True, True], wrong=[True, False, True])
def power_cuts_in_a_row(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    announced = []
    for _ in range(3):
        tool.cycle_power()
        tool.run(0.3)
        announced.append(bool(tool.heard("version")))
    return announced


# -- timing, bus, bad input, other traffic --------------------------------------------------------

does("doubled-frame-hangs", right=["nak 1", "ack 1"], wrong=[])(
    answers_in_transfer(FIRST[:48] + FIRST[40:], FIRST)
)
does("logs-useless-messages", right=["ack 1"], wrong=[])(answers_in_transfer(QUERY * 460, FIRST))
does("noise-hangs", right=1, wrong=0)(
    requests_after(*payloads(build(REQUEST_ID, REPORT, 0x1010, bytes(16))), *PARTS)
)


@does("slow-sixteenth-packet", right=["ack 15", "ack 16"], wrong=["ack 15"])
def the_answer_to_packet_16_within_half_a_second(tool: Tool) -> object:
    tool.transfer(LONG, 14)
    tool.packet(15, LONG)
    tool.packet(16, LONG)
    tool.run(0.49)
    return tool.heard()


@does("stays-off-after-bus-off", right=["feedback"], wrong=[])
def a_reset_after_bus_off(tool: Tool) -> object:
    tool.device.bus_off(tool.now)
    tool.run(1.0)
    tool.reset()
    return tool.heard()


@does("collision-hangs", right=["feedback"], wrong=[])
def somebody_else_with_its_answer_id(tool: Tool) -> object:
    tool.put(Frame(0x725, b"\x55\xaa\x0c\x04\xc2\x02\x01\x00"))
    tool.reset()
    return tool.heard()


@does("load-hangs", right=["feedback"], wrong=[])
def a_bus_that_is_full(tool: Tool) -> object:
    tool.put(*(Frame(0x100, bytes(8)) for _ in range(200)))
    tool.reset()
    return tool.heard()


@does("hears-other-targets", right=[], wrong=["ack 1"])
def a_packet_for_another_target(tool: Tool) -> object:
    tool.transfer(IMAGE)
    tool.packet(1, IMAGE, can_id=0x751)
    return tool.heard()


@does("answers-in-bootloader", right=[], wrong=["feedback"])
def a_query_to_the_bootloader(tool: Tool) -> object:
    tool.boot()
    return tool.asks_version()


# -- the tests ------------------------------------------------------------------------------------


def make_wrong(name: str) -> MockDevice:
    return make(name, BMS, bitrate_bps=WELLING.bitrate_bps, profile=PROFILE)


END = build(0x752, WRITE, 0xA401, b"\x04")
UNKNOWN = build(0x752, READ, 0x6F00, b"")
BEYOND_64K = image_of(64 * 1024 + 200)


does("repeat-unanswered", right=["ack 2"], wrong=[])(answers_in_transfer(SECOND, stored=2))
does("total-looked-at-once", right=["nak 2"], wrong=["ack 2"])(
    answers_in_transfer(packet_wire(2, IMAGE, total=6), stored=1)
)
does("believes-second-early-end", right=["nak 2", "nak 2"], wrong=["nak 2", "complete"])(
    answers_in_transfer(END, END, stored=1)
)


@does("damage-ends-transfer", right=["ack 1"], wrong=[])
def a_packet_after_a_damaged_one(tool: Tool) -> object:
    tool.transfer(IMAGE)
    for wire in (damaged(FIRST), FIRST):
        tool.put_wire(wire)
        tool.run(0.01)
    return tool.heard("ack")


@does("older-overwrites", right=(["ack 1"], True), wrong=(["ack 1"], False))
def an_older_packet_with_other_data(tool: Tool) -> object:
    tool.transfer(IMAGE, 2)
    tool.packet(1, OTHER)
    return tool.heard(), tool.device.readback()[:128] == IMAGE[:128]


@does("sixteen-bit-offsets", right=True, wrong=False)
def an_image_beyond_64_kib(tool: Tool) -> object:
    tool.transfer(BEYOND_64K)
    tool.run(0.2)
    for number in range(1, 514):
        tool.packet(number, BEYOND_64K)
    return tool.device.readback()[:128] == BEYOND_64K[:128]


@does("runs-new-application-once", right=["720 1540"], wrong=[])
def a_restart_after_an_upgrade(tool: Tool) -> object:
    tool.upgrade(IMAGE)
    tool.reset()
    tool.run(1.0)
    return tool.asks_version()


@does("second-end-refused", right=["complete"], wrong=["nak 5"])
def the_end_of_transfer_again(tool: Tool) -> object:
    tool.transfer(IMAGE, 5)
    tool.end()
    tool.heard()
    tool.end()
    return tool.heard()


@does("refusal-is-final", right=1, wrong=0)
def an_update_command_after_a_refused_image(tool: Tool) -> object:
    assert tool.upgrade(IMAGE) == ["nak 5"]
    tool.run(2.0)
    return requests_for(tool, 600)


@does("size-rounds-to-small", right=0, wrong=1)
def a_size_of_nearly_2_to_the_32(tool: Tool) -> object:
    tool.boot()
    return requests_for(tool, 0xFFFF_FFFF)


@does("any-message-is-life", right=True, wrong=False)
def useless_messages_in_a_pause(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    for _ in range(10):
        tool.put_wire(UNKNOWN)
        tool.run(0.6)
    return bool(tool.heard("version"))


# -- mistakes of bootloader engineers -------------------------------------------------------------


def with_crc(wire: bytes, crc_field: bytes) -> bytes:
    return wire[:-5] + crc_field + wire[-1:]


def longer(command: int, data: bytes) -> bytes:
    """A write with four bytes more than its command says, and a CRC over all of it."""
    wire = build(REQUEST_ID, WRITE, command, data + bytes(4))
    assert wire[3] == (command & 0xFF) + 6
    return wire


F0_IN_CRC = next(
    image
    for image in (bytes((at & 0xFF, at >> 8)) + IMAGE[2:] for at in range(1 << 16))
    if packet_wire(1, image)[-5] == 0xF0
)
BLANK = b"\xff" * 128 + IMAGE[128:]
READS = build(REQUEST_ID, READ, 0xA401, b"\x04")

does("crc-zero-accepted", right=0, wrong=1)(requests_after(*payloads(with_crc(UPDATE, bytes(4)))))
does("crc-ones-accepted", right=0, wrong=1)(
    requests_after(*payloads(with_crc(UPDATE, b"\xff" * 4)))
)
does("long-commands-accepted", right=0, wrong=1)(
    requests_after(*payloads(longer(0xA10B, b"BMS_UPD\x58\x02\x00\x00")))
)
does("update-text-of-four", right=0, wrong=1)(
    requests_after(*payloads(update_wire(600, b"BMS_XYZ")))
)
does("ignores-mode", right=[], wrong=["nak 1"])(answers_in_transfer(READS))
does("any-end-byte", right=[], wrong=["nak 1"])(
    answers_in_transfer(build(REQUEST_ID, WRITE, 0xA401, b"\x05"))
)
does("numbers-modulo-256", right=["nak 1"], wrong=["ack 1"])(
    answers_in_transfer(build(REQUEST_ID, WRITE, 0xA385, b"\x01\x01\x01\x05\x00" + IMAGE[:128]))
)
does("totals-modulo-256", right=["nak 1"], wrong=["ack 1"])(
    answers_in_transfer(packet_wire(1, IMAGE, total=261))
)
does("number-zero-is-first", right=["nak 1"], wrong=["ack 1"])(
    answers_in_transfer(build(REQUEST_ID, WRITE, 0xA385, b"\x01\x00\x00\x05\x00" + IMAGE[:128]))
)
does("acks-damaged-repetition", right=["nak 2"], wrong=["ack 1"])(
    answers_in_transfer(damaged(FIRST), stored=1)
)
does("acks-twice", right=["ack 1"], wrong=["ack 1", "ack 1"])(answers_in_transfer(FIRST))


@does("answers-padded", right=["feedback"], wrong=["damaged"])
def the_bytes_of_an_answer(tool: Tool) -> object:
    tool.reset()
    tool.run(0.01)
    return tool.heard()


@does("tail-in-crc", right=["ack 1"], wrong=["nak 1"])
def a_packet_whose_crc_begins_with_f0(tool: Tool) -> object:
    tool.transfer(F0_IN_CRC)
    tool.packet(1, F0_IN_CRC)
    return tool.heard()


@does("reset-text-of-four", right=0, wrong=4)
def a_reset_whose_last_letter_is_another(tool: Tool) -> object:
    tool.say(0x4205, b"RESEX")
    tool.run(1.0)
    return len(tool.heard("version"))


@does("reset-from-any-node", right=0, wrong=4)
def a_reset_by_the_motor_controller(tool: Tool) -> object:
    tool.say(0x4205, b"RESET", can_id=0x712)
    tool.run(1.0)
    return len(tool.heard("version"))


@does("dies-after-255-announcements", right=True, wrong=False)
def announcements_a_quarter_of_a_minute_after_a_power_cut(tool: Tool) -> object:
    tool.transfer(IMAGE, 1)
    tool.cycle_power()
    tool.run(14.0)
    tool.heard()
    tool.run(1.0)
    return bool(tool.heard("version"))


@does("feedback-after-version", right=["feedback", "version"], wrong=["version", "feedback"])
def what_is_sent_first_after_a_reset(tool: Tool) -> object:
    tool.reset()
    tool.run(0.06)
    return tool.heard()


@does("leftover-announcement", right=[], wrong=["version"])
def a_moment_after_request_transfer(tool: Tool) -> object:
    tool.transfer(IMAGE)
    tool.run(0.2)
    return tool.heard()


@does("sixteen-bit-size", right=0, wrong=1)
def a_size_beyond_64_kib(tool: Tool) -> object:
    tool.boot()
    return requests_for(tool, 0x10000 + 600)


@does("hangs-at-20th-update", right=20, wrong=19)
def twenty_transfers_that_are_left(tool: Tool) -> object:
    tool.boot()
    for _ in range(20):
        tool.update(600)
        tool.run(0.03)
        tool.packet(1, IMAGE)
    return len(tool.heard("request"))


@does("reset-while-erasing-hangs", right=1, wrong=0)
def a_reset_just_after_the_update_command(tool: Tool) -> object:
    tool.boot()
    tool.update(100_000)
    tool.reset()
    tool.run(1.0)
    return len(tool.heard("request"))


@does("completes-without-transfer", right=[], wrong=["complete"])
def an_end_of_transfer_to_the_announcing_bootloader(tool: Tool) -> object:
    tool.boot()
    tool.put_wire(END)
    return tool.heard()


@does("acks-without-transfer", right=[], wrong=["ack 1"])
def a_packet_to_the_announcing_bootloader(tool: Tool) -> object:
    tool.boot()
    tool.packet(1, IMAGE)
    return tool.heard("ack")


@does("blank-packet-unanswered", right=["ack 1", "ack 1"], wrong=["ack 1"])
def a_packet_of_nothing_but_ff_twice(tool: Tool) -> object:
    tool.transfer(BLANK)
    tool.packet(1, BLANK)
    tool.packet(1, BLANK)
    return tool.heard()


@does("pause-counts-from-start", right=[], wrong=["version"])
def packets_a_second_apart(tool: Tool) -> object:
    tool.transfer(IMAGE)
    for number in (1, 1, 2, 2, 3, 3):
        tool.run(0.9)
        tool.packet(number, IMAGE)
    return tool.heard("version")[:1]


@does("timer-wraps", right=[], wrong=["version"])
def a_transfer_of_more_than_a_minute(tool: Tool) -> object:
    tool.transfer(IMAGE)
    for _ in range(20):
        tool.run(3.5)
        tool.packet(1, IMAGE)
    return tool.heard("version")[:1]


@does("single-packet-image-fails", right=["complete"], wrong=["nak 1"])
def an_image_of_one_packet(tool: Tool) -> object:
    return tool.upgrade(IMAGE[:100])


@does("record-erased-last", right=[], wrong=["720 1540"])
def a_power_cut_in_the_midst_of_erasing(tool: Tool) -> object:
    tool.upgrade(LONG)
    tool.boot()
    tool.update(len(LONG))
    tool.run(0.005)
    tool.cycle_power()
    tool.run(1.0)
    return tool.asks_version()


@does("complete-before-record", right=["720 1540"], wrong=[])
def a_power_cut_just_after_complete(tool: Tool) -> object:
    tool.transfer(IMAGE, 5)
    tool.end()
    assert tool.heard() == ["complete"]
    tool.cycle_power()
    tool.run(1.0)
    return tool.asks_version()


@does("answer-lost-on-busy-bus", right=["ack 1"], wrong=[])
def a_frame_of_others_just_before_an_answer_is_due(tool: Tool) -> object:
    tool.transfer(IMAGE)
    tool.put_wire(FIRST)
    tool.put(Frame(0x100, bytes(8)))
    tool.run(0.01)
    return tool.heard()


def make_right(variant: Variant) -> MockDevice:
    profile = dataclasses.replace(PROFILE, **variant.profile)  # type: ignore[arg-type]
    return MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)


@pytest.mark.slow
@each("name", ACTS)
def test_a_variant_does_wrong_what_the_right_device_does_right(name: str) -> None:
    act, right, wrong = ACTS[name]
    assert act(Tool(make_right(VARIANTS[name]))) == right
    assert act(Tool(make_wrong(name))) == wrong


@pytest.mark.slow
@each("name", VARIANTS)
def test_apart_from_its_fault_a_variant_can_be_upgraded(name: str) -> None:
    body = image_of(1100)
    image = body + zlib.crc32(body).to_bytes(4, "little")
    device = make_wrong(name)
    outcome = world.upgrade(device, image=image)
    runs = device.state is BootloaderState.APPLICATION and device.stored_image == image
    assert (outcome.ok and runs) == VARIANTS[name].upgrade_works


def test_every_variant_is_shown_to_be_wrong() -> None:
    assert set(ACTS) == set(VARIANTS)


def test_every_case_about_a_bootloader_has_a_variant_that_fails_it() -> None:
    assert sorted({variant.clause for variant in VARIANTS.values()}) == sorted(DEVICE_CASES)


@each("name", VARIANTS)
def test_a_variant_is_described_in_one_line_and_names_cases_that_exist(name: str) -> None:
    variant = VARIANTS[name]
    assert variant.name == name
    assert set(variant.also) <= set(DEVICE_CASES) - {variant.clause}
    assert 0 < len(variant.summary) <= 90
    assert "\n" not in variant.summary


@each("target", [WMC, OBC])
@each("name", VARIANTS)
def test_a_variant_is_made_for_every_target_with_or_without_an_application(
    name: str, target: Target
) -> None:
    for has_application, state in (
        (True, BootloaderState.APPLICATION),
        (False, BootloaderState.ANNOUNCING),
    ):
        device = make(
            name,
            target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=PROFILE,
            has_application=has_application,
        )
        assert (device.target, device.state) == (target, state)


def test_an_unknown_variant_is_wrong_usage_that_names_the_one_meant() -> None:
    with pytest.raises(UsageError, match="no variant 'no-crc'") as caught:
        find("no-crc")
    assert "no-crc-check" in caught.value.remedy


def test_what_hangs_sends_nothing_until_its_power_is_cut() -> None:
    device = make_wrong("reset-in-transfer-hangs")
    assert isinstance(device, HangingDevice)
    tool = Tool(device)
    tool.transfer(IMAGE, 1)
    tool.reset()
    seen = [device.hangs]
    tool.run(100.0)
    tool.update(600)
    assert tool.heard() == []
    tool.cycle_power()
    tool.run(1.0)
    seen.append(device.hangs)
    assert seen == [True, False]
    assert len(tool.heard("version")) > 4


def test_what_is_no_part_of_a_device_is_no_variant() -> None:
    with pytest.raises(TypeError, match="not a part of a device"):
        variant("a name", "RS-01")(int)


def test_a_device_that_hangs_does_nothing_at_its_time_either() -> None:
    device = HangingDevice(BMS, bitrate_bps=WELLING.bitrate_bps)
    device._hang()
    device.tick(1000.0)
    assert device.hangs
    assert device.next_frame(1000.0) is None
    device.power_cut(1000.0)
    device.power_on(1000.0)
    device.tick(1001.0)
    assert device.next_frame(1001.0) is not None
