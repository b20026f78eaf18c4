"""FR: framing. Most stimuli stand in a transfer that is never ended (`probing`)."""

from __future__ import annotations

import struct
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.fr_stimuli import (
    UNKNOWN,
    messages_broken_off,
    pad,
    split_by_chance,
    strangers,
    treacherous_payloads,
    wrong_lengths,
)
from flasher.conformance.cases.probing import ACCEPTED, EITHER, REJECTED, Probe, is_as, stream
from flasher.conformance.catalogue import DESTRUCTIVE, case
from flasher.conformance.results import Unsupported
from flasher.conformance.wire import (
    PACKET,
    UPDATE,
    WRITE,
    Kind,
    RawFrame,
    split,
)

_FRAME_BYTES: Final = 8
_SIZES: Final = range(1, _FRAME_BYTES)
_RANDOM_SPLITS: Final = 7
_JUNK_FRAMES: Final = (
    b"\x12",
    b"\x00" * 8,
    b"\xaa\x55\xf0",
    b"\xf0" * 8 + b"\xaa" * 8 + b"\x16" * 3,
)
"""None of them holds a header, nor the beginning of one at its end."""
_LONG_JUNK_BYTES: Final = 300
"""More than the longest message."""
_JUNK_IN_FRAME: Final = (b"\x12", b"\x55", b"\x55\x55", b"\xaa", b"\xf0\x00\x34", b"\x12" * 7)
_WRONG_TAILS: Final = (0x00, 0x0F, 0xF1, 0x55, 0xFF)
_PADDINGS: Final = (0x00, 0xFF, 0xAA, 0x55, 0xF0)
_UNKNOWN_COMMANDS: Final = (0x0000, 0x0100, 0x7704, 0xA202, 0xC601, 0xFF10, UNKNOWN)
_UNKNOWN_MODES: Final = (0x00, 0x0D, 0x17, 0x96, 0xFF)


@case(
    "FR-01",
    "splits of a message",
    clause="2, R19",
    stimulus="update command and packets in CAN frames of 1 to 8 bytes, all alike or by chance",
    expectation="decoded alike, or rejected (fr_01); packets in frames of 8 bytes are accepted",
    requires={DESTRUCTIVE},
    choices=("fr_01", "up_04_burst"),
)
def splits(bench: Bench) -> None:
    choice, to_device = bench.choice("fr_01"), bench.encoder.to_device
    probe = Probe(bench)
    with bench.step("update command in frames of 5 bytes"):
        update = stream(bench.encoder.update(len(probe.image)))
        probe.enter(split(to_device, update, 5), choice)
    for size in _SIZES:
        with bench.step(f"packet in frames of {size} bytes"):
            probe.offer(split(to_device, probe.raw(), size), choice)
    with bench.step("packet in frames of 8 bytes"):
        probe.offer(probe.frames(), ACCEPTED)
    for turn in range(_RANDOM_SPLITS):
        with bench.step(f"packet split by chance, {turn + 1}"):
            probe.offer(list(split_by_chance(bench, probe.raw())), choice)
    probe.check_stored()


@case(
    "FR-02",
    "junk before a message",
    clause="2, 2.2",
    stimulus="junk in frames of its own, in the frame of the header, 55 55 AA, 55 ending a frame",
    expectation="resynchronised on the next message; one in the frame of the junk: fr_02",
    requires={DESTRUCTIVE},
    choices=("fr_02",),
)
def junk(bench: Bench) -> None:
    to_device = bench.encoder.to_device
    in_frame = {"found": ACCEPTED, "lost": REJECTED}.get(bench.choice("fr_02"), EITHER)
    probe = Probe(bench)
    probe.begin()
    long_junk = bytes(bench.random.choice(b"\x00\x11\x16\xaa\xf0") for _ in range(_LONG_JUNK_BYTES))
    # Where junk may hide a message, the beginning of a header at its end may do so, too.
    after_half = ACCEPTED if in_frame == ACCEPTED else EITHER
    for own in (*_JUNK_FRAMES, b"\x12\x34\x55", long_junk):
        with bench.step(f"{len(own)} bytes before it, the last one {own[-1]:02X}"):
            wanted = after_half if own[-1] == 0x55 else ACCEPTED
            probe.offer(split(to_device, own) + probe.frames(), wanted)
    for own in _JUNK_IN_FRAME:
        with bench.step(f"{own.hex(' ').upper()} in its first frame"):
            probe.offer(split(to_device, own + probe.raw()), in_frame)
    probe.check_stored()


@case(
    "FR-03",
    "header and tail inside data",
    clause="2",
    stimulus="packets full of 55 AA and F0, at frame boundaries too; whole messages inside data",
    expectation="no false start or end: each one acknowledged once, and stored as it is",
    requires={DESTRUCTIVE},
)
def header_in_data(bench: Bench) -> None:
    payloads = dict(treacherous_payloads(bench))
    probe = Probe(bench, b"".join(payloads.values()))
    probe.begin()
    for name in payloads:
        with bench.step(name):
            probe.offer(probe.frames(), ACCEPTED)
    probe.check_stored()


@case(
    "FR-04",
    "wrong tail",
    clause="2",
    stimulus="packets with another last byte than F0; a packet behind a wrong tail, in its frame",
    expectation="discarded, the next message is taken; the one in the same frame: fr_04",
    requires={DESTRUCTIVE},
    choices=("fr_04",),
)
def wrong_tail(bench: Bench) -> None:
    to_device = bench.encoder.to_device
    behind = {"rescanned": ACCEPTED, "dropped": REJECTED}.get(bench.choice("fr_04"), EITHER)
    probe = Probe(bench)
    probe.begin()
    for tail in _WRONG_TAILS:
        with bench.step(f"packet that ends with {tail:02X}"):
            probe.discard(split(to_device, probe.raw()[:-1] + bytes((tail,))))
    query = stream(bench.encoder.query_version())
    for tail in (0x00, 0x55):
        with bench.step(f"query that ends with {tail:02X}, packet in the same frame"):
            broken = query[:-1] + bytes((tail,))
            probe.offer(split(to_device, broken + probe.raw()), behind)
    probe.check_stored()


@case(
    "FR-05",
    "length greater than what follows",
    clause="2, R12",
    stimulus="messages that end before their length is used up, then a packet: after the "
    "inter-frame timeout, and at once",
    expectation="a packet is taken after the timeout; at once it may be taken or lost",
    requires={DESTRUCTIVE},
)
def broken_off(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    at_once = []
    for name, raw in messages_broken_off(bench):
        with bench.step(name):
            bench.send(split(bench.encoder.to_device, raw))
            bench.wait(probe.settle_s())
            probe.plain()
        with bench.step(f"{name}, a packet at once"):
            frames = split(bench.encoder.to_device, raw) + probe.frames()
            if probe.offer(frames, EITHER):
                at_once.append(name)
    bench.info(f"the packet that followed at once was taken after: {', '.join(at_once) or 'none'}")


@case(
    "FR-06",
    "lengths that cannot be",
    clause="2",
    stimulus="length 0 and 1; length other than the command's second byte + 2; 255 with an "
    "unknown command; all with the right CRC",
    expectation="discarded, no overflow: the next packet is taken, nothing else is stored",
    requires={DESTRUCTIVE},
)
def wrong_length(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    probe.plain()
    for index in range(len(wrong_lengths(bench, probe.raw()))):
        name, raw = wrong_lengths(bench, probe.raw())[index]
        with bench.step(name):
            probe.discard(split(bench.encoder.to_device, raw))
    probe.check_stored()


@case(
    "FR-07",
    "last frame padded",
    clause="2",
    stimulus="update command padded to 8 bytes with 00, FF, AA, 55 and F0; padded end of transfer",
    expectation="as the profile says (fr_07): padding ignored, or the message rejected",
    requires={DESTRUCTIVE},
    choices=("fr_07", "up_04_burst"),
)
def padded(bench: Bench) -> None:
    choice = {"ignored": ACCEPTED}.get(bench.choice("fr_07"), bench.choice("fr_07"))
    probe = Probe(bench, bench.filler(1))
    for index, filler in enumerate(_PADDINGS):
        with bench.step(f"update command padded with {filler:02X}"):
            # In the midst of a transfer where the device starts over, which takes no pause (UP-08).
            if index and bench.choice("up_08") != "starts_over":
                bench.leave_transfer()
            update = pad(bench.encoder.update(len(probe.image)), filler)
            probe.enter(update, choice, reset=not index)
            probe.plain()
    image = bench.good_image
    with bench.step("end of transfer padded with 00"):
        bench.leave_transfer()
        bench.update(len(image))
        bench.packets(image)
        sent = bench.send(pad(bench.encoder.end(), 0x00))
        within_s = bench.limit("complete_s")
        if choice != ACCEPTED:  # what follows needs a transfer that still lasts (TX-12)
            within_s = min(within_s, bench.limit("pause_s") / 2)
        heard = bench.wait_for(Kind.COMPLETE, within_s=within_s)
        bench.check(
            is_as(choice, heard is not None), f"end of transfer {choice}", heard or "nothing"
        )
        if heard is None:
            bench.end_transfer()
        else:
            bench.measure("end of transfer to complete", heard.at - sent.left_at)
        bench.check_application(image)
        bench.check_stored(image)


@case(
    "FR-08",
    "two messages back to back",
    clause="2",
    stimulus="a query and the update command without a pause; queries and a packet; the last "
    "packet again and the next one",
    expectation="both decoded",
    requires={DESTRUCTIVE},
    choices=("tx_02", "up_04_burst"),
)
def back_to_back(bench: Bench) -> None:
    words = bench.encoder
    probe = Probe(bench)
    with bench.step("query, then update command"):
        query = words.query_version()
        probe.enter(query + words.update(len(probe.image)), ACCEPTED)
    for count in (1, 2, 3):
        with bench.step(f"{count} times a query, then a packet"):
            # Whether a bootloader answers a query is CO-04.
            frames = count * words.query_version() + probe.frames()
            probe.offer(frames, ACCEPTED, ignoring=(Kind.FEEDBACK, Kind.OTHER))
    with bench.step("the last packet again, then the next one"):
        bench.forget()
        frames = probe.frames()
        bench.send(probe.previous() + frames)
        number = probe.number
        if bench.choice("tx_02") == "nak_next":
            bench.expect(Kind.NAK, within_s=bench.limit("ack_s"), number=number)
        else:
            bench.expect(Kind.ACK, within_s=bench.limit("ack_s"), number=number - 1)
        bench.expect(Kind.ACK, within_s=bench.limit("ack_s"), number=number)


@case(
    "FR-09",
    "frames that carry no payload",
    clause="2",
    stimulus="frames of 0 bytes, remote, extended and error frames between the frames of a packet",
    expectation="never taken for payload: the packet is acknowledged",
    requires={DESTRUCTIVE},
)
def no_payload(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    for name, stranger in strangers(bench.encoder.to_device):
        with bench.step(f"{name} between all frames"):
            try:
                bench.send([stranger])
            except Unsupported as error:
                bench.unsupported("the packet is acknowledged", str(error))
                continue
            mixed = [one for frame in probe.frames() for one in (frame, stranger)]
            probe.offer(mixed, ACCEPTED)
    probe.check_stored()


@case(
    "FR-10",
    "unknown mode, unknown command",
    clause="2, 4.1",
    stimulus="packets and update commands with modes that nobody has; commands that nobody has",
    expectation="rejected with NAK or silence; update command and packets are taken as before",
    requires={DESTRUCTIVE},
)
def unknown(bench: Bench) -> None:
    words = bench.encoder
    probe = Probe(bench)
    update = words.update_text + struct.pack("<I", len(probe.image))
    with bench.step("while it announces itself"):
        modes = [words.message(mode, UPDATE, update) for mode in _UNKNOWN_MODES]
        commands = [_of_command(bench, command) for command in _UNKNOWN_COMMANDS[:-1]]
        probe.enter_past(*modes, *commands)
    for mode in _UNKNOWN_MODES:
        with bench.step(f"packet of mode {mode:02X}"):
            data = probe.raw()[6:-5]
            probe.discard(words.message(mode, PACKET, data))
    for command in _UNKNOWN_COMMANDS:
        with bench.step(f"command {command:04X}"):
            probe.discard(_of_command(bench, command))
    probe.check_stored()


def _of_command(bench: Bench, command: int) -> list[RawFrame]:
    """A write of that command, with as many zeros as it says."""
    return bench.encoder.message(WRITE, command, bytes(command & 0xFF))
