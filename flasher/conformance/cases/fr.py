"""FR: framing. Most stimuli are sent in a transfer that is never ended (`cases.probe`)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import ACCEPTED, EITHER, REJECTED, Probe, complies
from flasher.conformance.catalogue import DESTRUCTIVE, case
from flasher.conformance.judge import TimeName
from flasher.conformance.profile import choice_words
from flasher.conformance.results import Unsupported
from flasher.conformance.wire import (
    END,
    END_MARK,
    FRAME_BYTES,
    PACKET,
    PACKET_BYTES,
    QUERY_VERSION,
    READ,
    START,
    UPDATE,
    WRITE,
    Encoder,
    RawFrame,
    Reply,
    build,
    joined,
    message_crc,
    padded_to_frame,
)

_HEADER: Final = b"\x55\xaa"
_RANDOM_SPLITS: Final = 7
_JUNK_FRAMES: Final = (b"\x12", bytes(8), b"\xaa\x55\xf0", b"\xf0" * 8 + b"\xaa" * 8 + b"\x16" * 3)
"""Contain no header, and do not end with the first byte of one."""
_LONG_JUNK_BYTES: Final = 300
"""Longer than the longest message."""
JUNK_IN_FRAME: Final = (b"\x12", b"\x55", b"\x55\x55", b"\xaa", b"\xf0\x00\x34", b"\x12" * 7)
_CRCS: Final = tuple(
    map(
        bytes.fromhex,
        (
            *("F0123456", "12F03456", "1234F056", "123456F0", "F0F0F0F0"),
            *("55AA1687", "1255AA16", "AA0455AA", "00000000", "FFFFFFFF"),
        ),
    )
)
_FREE_BYTES: Final = 8
_WRONG_TAILS: Final = (0x00, 0x0F, 0xF1, 0x55, 0xFF)
PADDINGS: Final = (0x00, 0xFF, 0xAA, 0x55, 0xF0)
_UNKNOWN: Final = 0x77FD
"""Unused command with the largest possible data."""
_LONG_UNKNOWN: Final = (0x77F5, 0x77F7, _UNKNOWN)
"""Unused commands whose messages have 254 bytes, 256 bytes and the maximum."""
_UNKNOWN_COMMANDS: Final = (0x0000, 0x0100, 0x7704, 0xA202, 0xC601, 0xFF10, _UNKNOWN)
_PACKET: Final = PACKET.to_bytes(2, "big")
_END: Final = END.to_bytes(2, "big") + END_MARK
_WRONG_LENGTHS: Final[tuple[tuple[str, int, Callable[[bytes], bytes]], ...]] = (
    ("length 0", 0, lambda _: b""),
    ("length 0, a packet follows", 0, lambda data: _PACKET + data),
    ("length 0, end of transfer follows", 0, lambda _: _END),
    ("length 1", 1, lambda _: b"\xa4"),
    ("length 1, a packet follows", 1, lambda data: _PACKET + data),
    ("packet, length less by one", 134, lambda data: _PACKET + data),
    ("packet, length greater by one", 136, lambda data: _PACKET + data),
    ("packet with a byte more", 136, lambda data: _PACKET + data + b"\xff"),
    ("packet with a byte less", 134, lambda data: _PACKET + data[:-1]),
    ("end of transfer with a byte more", 4, lambda _: _END + b"\x00"),
    ("packet of 253 bytes", 255, lambda data: _PACKET + data.ljust(253, b"\xff")),
    ("255 with an unknown command", 255, lambda _: _UNKNOWN.to_bytes(2, "big") + bytes(253)),
    (
        "255, unknown, with other bytes",
        255,
        lambda data: _UNKNOWN.to_bytes(2, "big") + data.ljust(253),
    ),
)
"""Messages with a wrong length and a correct CRC: name, length byte, and a function that makes the
rest from the data of the next packet.
"""
_UNKNOWN_MODES: Final = (0x00, 0x0D, 0x17, 0x96, 0xFF)


@case(
    "FR-01",
    "splits of a message",
    clause="Welling 2.2.3, table 3; robustness, not in the document",
    stimulus="update command and packets in CAN frames of 1 to 8 bytes, equal or random",
    expectation="decoded normally or rejected (fr_01); packets in frames of 8 bytes are accepted",
    requires={DESTRUCTIVE},
    choices=("fr_01",),
)
def splits(bench: Bench) -> None:
    choice, probe = bench.choice("fr_01"), Probe(bench)
    with bench.step("update command in frames of 5 bytes"):
        update = joined(bench.encoder.update(len(probe.image)))
        probe.enter(bench.encoder.frames(update, 5), choice)
    _offer_forms(bench, probe, "fr_01")
    with bench.step("packet in frames of 8 bytes"):
        probe.offer(probe.frames(), ACCEPTED)
    for turn in range(_RANDOM_SPLITS):
        with bench.step(f"packet split randomly, {turn + 1}"):
            probe.offer(bench.encoder.frames_by_chance(probe.raw(), bench.random), choice)
    probe.check_stored()


@case(
    "FR-02",
    "junk before a message",
    clause="Welling 2.2.1 (1); R19; robustness, not in the document",
    stimulus="junk in frames of its own, in the frame of the header, 55 55 AA, 55 ending a frame",
    expectation="resynchronised on the next message; one in the frame of the junk: fr_02",
    requires={DESTRUCTIVE},
    choices=("fr_02",),
)
def junk(bench: Bench) -> None:
    in_frame = _expected_acceptance(bench, "fr_02")
    probe = Probe(bench)
    probe.begin()
    long_junk = bytes(bench.random.choice(b"\x00\x11\x16\xaa\xf0") for _ in range(_LONG_JUNK_BYTES))
    # If junk can hide a message, junk that ends with half a header can hide it too.
    after_half = ACCEPTED if in_frame == ACCEPTED else EITHER
    for own in (*_JUNK_FRAMES, b"\x12\x34\x55", long_junk):
        with bench.step(f"{len(own)} bytes before it, the last one {own[-1]:02X}"):
            wanted = after_half if own[-1] == 0x55 else ACCEPTED
            probe.offer(bench.encoder.frames(own) + probe.frames(), wanted)
    _offer_forms(bench, probe, "fr_02")
    probe.check_stored()


@case(
    "FR-03",
    "header and tail inside data",
    clause="Welling 2.2.1, table 1",
    stimulus="packets full of 55 AA and F0, at frame boundaries too; whole messages inside data; "
    "packets whose CRC reads as tail or header, or is 00000000 or FFFFFFFF; packets of FF or 00",
    expectation="no false start or end: each one is acknowledged once and stored unchanged",
    requires={DESTRUCTIVE},
)
def header_in_data(bench: Bench) -> None:
    payloads = dict(_payloads_like_messages(bench))
    total = len(payloads) + len(_CRCS) + 1  # the probe has some bytes more
    for wanted in _CRCS:
        number = len(payloads) + 1
        data = _data_for_crc(bench, number, total, wanted)
        payloads[f"CRC {wanted.hex().upper()}"] = data
    probe = Probe(bench, b"".join(payloads.values()))
    probe.begin()
    for name in payloads:
        with bench.step(name):
            probe.offer(probe.frames(), ACCEPTED)
    probe.check_stored()


@case(
    "FR-04",
    "wrong tail",
    clause="Welling 2.2.1 (1); robustness, not in the document",
    stimulus="packets that do not end with F0; a packet after a wrong tail, in the same frame",
    expectation="discarded; the next message is accepted; the one in the same frame: fr_04",
    requires={DESTRUCTIVE},
    choices=("fr_04",),
)
def wrong_tail(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    for tail in _WRONG_TAILS:
        with bench.step(f"packet that ends with {tail:02X}"):
            probe.check_discarded(bench.encoder.frames(probe.raw()[:-1] + bytes((tail,))))
    _offer_forms(bench, probe, "fr_04")
    probe.check_stored()


@case(
    "FR-05",
    "length greater than what follows",
    clause="Welling 2.2.1 (3); R12",
    stimulus="messages that end before their length is used up, then a packet: after the "
    "inter-frame timeout, and at once",
    expectation="a packet is accepted after the timeout; at once it may be accepted or lost",
    requires={DESTRUCTIVE},
)
def too_short(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    at_once = []
    encoder = bench.encoder
    packet = joined(encoder.packet(1, 1, bytes(range(PACKET_BYTES))))
    query = build(encoder.to_device, READ, QUERY_VERSION)
    broken_off = {
        "length 255, two bytes follow": b"\x55\xaa\x16\xff\x77\xfd\x01\x02",
        **{f"packet cut off after frame {end}": packet[: 8 * end] for end in (1, 9, 17)},
        "update command cut off after frame 1": joined(encoder.update(PACKET_BYTES))[:8],
        "length greater by one": _HEADER + bytes((READ, 3, QUERY_VERSION >> 8, 1)) + query[-5:],
    }
    for name, raw in broken_off.items():
        with bench.step(name):
            bench.send(bench.encoder.frames(raw))
            bench.wait(bench.waits.settle_s)
            probe.send_next()
        with bench.step(f"{name}, a packet at once"):
            frames = bench.encoder.frames(raw) + probe.frames()
            if probe.offer(frames, EITHER):
                at_once.append(name)
    bench.info(
        f"the immediately following packet was accepted after: {', '.join(at_once) or 'none'}"
    )


@case(
    "FR-06",
    "impossible lengths",
    clause="Welling 2.2.1 (3); Welling 2.2.1 (4, 5)",
    stimulus="length 0 and 1; length other than the command's second byte + 2, of update command "
    "too; 255 with an unknown command; all with the right CRC",
    expectation="discarded without overflow: the next packet is accepted, nothing else is stored",
    requires={DESTRUCTIVE},
)
def wrong_length(bench: Bench) -> None:
    probe, encoder = Probe(bench), bench.encoder
    update = encoder.update_text + struct.pack("<I", len(probe.image))
    with bench.step("update command, length greater by 1 and 4, and less by 1"):
        wrong = (update + b"\x00", update + bytes(4), update[:-1])
        probe.enter_after_rejected(*(encoder.message(WRITE, UPDATE, data) for data in wrong))
    probe.send_next()
    for name, length, make in _WRONG_LENGTHS:
        with bench.step(name):
            body = bytes((WRITE, length)) + make(probe.raw()[6:-5])
            crc = message_crc(bench.encoder.to_device, body)
            probe.check_discarded(bench.encoder.frames(_HEADER + body + crc + b"\xf0"))
    probe.check_stored()


@case(
    "FR-07",
    "last frame padded",
    clause="Welling 2.2.3, table 3; robustness, not in the document",
    stimulus="update command padded to 8 bytes with 00, FF, AA, 55 and F0; padded end of transfer",
    expectation="as the profile says (fr_07): padding ignored, or the message rejected",
    requires={DESTRUCTIVE},
    choices=("fr_07",),
)
def padded(bench: Bench) -> None:
    choice, probe = _expected_acceptance(bench, "fr_07"), Probe(bench, bench.filler(1))
    for index, filler in enumerate(PADDINGS):
        with bench.step(f"update command padded with {filler:02X}"):
            # Within a transfer where the device starts over, which allows no pause (UP-08).
            if index and bench.choice("up_08") != "starts_over":
                bench.leave_transfer()
                bench.wait_for_window()
            update = bench.encoder.update(len(probe.image))
            probe.enter(padded_to_frame(update, filler), choice, reset=not index)
            probe.send_next()
    image = bench.good_image
    with bench.step("end of transfer padded with 00"):
        bench.restart_transfer(len(image))
        bench.packets(image)
        sent = bench.send(padded_to_frame(bench.encoder.end()))
        within_s = bench.limit("complete_s")
        if choice != ACCEPTED:  # what follows needs a transfer that still lasts (TX-12)
            within_s = min(within_s, bench.limit("pause_s") / 2)
        reply = bench.wait_for(Reply.COMPLETE, within_s=within_s)
        ok = complies(choice, reply is not None)
        bench.check(ok, f"end of transfer {choice}", reply or "nothing")
        if reply is None:
            bench.end_transfer()
        else:
            bench.measure(TimeName.COMPLETE, reply.at - sent.left_at)
        bench.check_image(image)


@case(
    "FR-08",
    "two messages back to back",
    clause="Welling 2.2.1, table 1; R19",
    stimulus="a query and the update command without a pause; queries and a packet; the last "
    "packet again and the next one",
    expectation="both decoded",
    requires={DESTRUCTIVE},
    choices=("tx_02", "up_04_burst"),
)
def back_to_back(bench: Bench) -> None:
    query, probe = bench.encoder.query_version(), Probe(bench)
    with bench.step("query, then update command"):
        probe.enter(query + bench.encoder.update(len(probe.image)), ACCEPTED)
    for count in (1, 2, 3):
        with bench.step(f"{count} times a query, then a packet"):
            # CO-04 checks whether a bootloader answers a query.
            frames = count * query + probe.frames()
            probe.offer(frames, ACCEPTED, ignoring=(Reply.FEEDBACK, Reply.OTHER))
    with bench.step("the last packet again, then the next one"):
        bench.forget()
        frames, number = probe.frames(), probe.number
        bench.send(bench.encoder.packet_of(probe.image, number - 1) + frames)
        first = bench.next_message(bench.limit("ack_s"))
        allowed = bench.repetition_answers(number - 1)
        bench.require(str(first) in allowed, " or ".join(allowed), first or "nothing")
        bench.expect(Reply.ACK, number=number)


@case(
    "FR-09",
    "frames that carry no payload",
    clause="Welling 2.1; Welling 2.2.3, table 3",
    stimulus="frames of 0 bytes, remote, extended and error frames, and frames of the ids that "
    "differ in one bit, between the frames of a packet",
    expectation="never treated as payload: the packet is acknowledged, but for frames of 0 bytes "
    "that count as a split (fr_01)",
    requires={DESTRUCTIVE},
    choices=("fr_01",),
)
def no_payload(bench: Bench) -> None:
    probe = Probe(bench)
    probe.begin()
    own, junk = bench.encoder.to_device, b"\x12" * 8
    neighbours = [own ^ 1 << bit for bit in range(11)]
    strangers = {
        "a frame of 0 bytes": RawFrame(own, b""),
        "a remote frame": RawFrame(own, b"", is_remote=True),
        "a remote frame of 8 bytes": RawFrame(own, bytes(8), is_remote=True),
        "an extended frame": RawFrame(own, junk, is_extended=True),
        "an extended frame with a header": RawFrame(own, _HEADER, is_extended=True),
        "an extended frame of the same first 11 bits": RawFrame(own << 18, junk, is_extended=True),
        "an error frame": RawFrame(own, bytes(8), is_error=True),
        **{f"a frame of id {other:03X}": RawFrame(other, junk) for other in neighbours},
    }
    for name, stranger in strangers.items():
        with bench.step(f"{name} between all frames"):
            try:
                bench.send([stranger])
            except Unsupported as error:
                bench.unsupported("the packet is acknowledged", str(error))
                continue
            mixed = [one for frame in probe.frames() for one in (frame, stranger)]
            # A frame of the own id splits the message, which a device may reject (FR-01).
            is_split = stranger == RawFrame(own, b"") and bench.choice("fr_01") != ACCEPTED
            probe.offer(mixed, EITHER if is_split else ACCEPTED)
    probe.check_stored()


@case(
    "FR-10",
    "unknown mode, unknown command",
    clause="Welling 2.2.1 (2); R15; robustness, not in the document",
    stimulus="packets and update commands with unused modes; unused commands, "
    "with a whole packet in their data too",
    expectation="ignored: NAK, silence or general feedback (fr_10); update command and "
    "packets are accepted afterwards",
    requires={DESTRUCTIVE},
    choices=("fr_10",),
)
def unknown(bench: Bench) -> None:
    encoder = bench.encoder
    probe = Probe(bench)
    update = encoder.update_text + struct.pack("<I", len(probe.image))
    with bench.step("while it announces itself"):
        modes = [encoder.message(mode, UPDATE, update) for mode in _UNKNOWN_MODES]
        commands = [_write_of(bench, command) for command in _UNKNOWN_COMMANDS[:-1]]
        probe.enter_after_rejected(*modes, *commands)
    for mode in _UNKNOWN_MODES:
        with bench.step(f"packet of mode {mode:02X}"):
            probe.check_discarded(encoder.message(mode, PACKET, probe.raw()[6:-5]))
    for command in _UNKNOWN_COMMANDS:
        with bench.step(f"command {command:04X}"):
            probe.check_discarded(_write_of(bench, command))
    for command in _LONG_UNKNOWN:
        with bench.step(f"command {command:04X} with a packet at the start of a frame of it"):
            data = bytes(2) + probe.raw()
            probe.check_discarded(
                encoder.message(WRITE, command, data.ljust(command & 0xFF, b"\x00"))
            )
    probe.check_stored()


def _expected_acceptance(bench: Bench, key: str) -> str:
    """Translate a choice of the profile into ACCEPTED, REJECTED or EITHER."""
    taken, not_taken = choice_words(key)
    return {taken: ACCEPTED, not_taken: REJECTED}.get(bench.choice(key), EITHER)


def _offer_forms(bench: Bench, probe: Probe, key: str) -> None:
    """Offer the next packets in each form that this profile key decides about."""
    for form in forms(bench.encoder)[key]:
        with bench.step(form.step):
            frames = bench.encoder.frames(form.before + probe.raw(), form.frame_bytes)
            probe.offer(frames, _expected_acceptance(bench, key))


def _write_of(bench: Bench, command: int) -> list[RawFrame]:
    """A write of this command with zeros as data."""
    return bench.encoder.message(WRITE, command, bytes(command & 0xFF))


# -- stimuli --------------------------------------------------------------------------------------


class PacketForm(NamedTuple):
    """A form of an intact packet: `step` names it in a case, `asked` in a profile written by
    `init`; the bytes `before` precede it in its first frame.
    """

    step: str
    asked: str
    before: bytes = b""
    frame_bytes: int = FRAME_BYTES


def forms(encoder: Encoder) -> dict[str, list[PacketForm]]:
    """Packet forms by the profile key that decides about them; the key's first word means accepted,
    its second word not. Cases, `init` and walks send all of them.
    """
    splits = {size: f"packet in frames of {size} bytes" for size in range(1, FRAME_BYTES)}
    junk = {f"{own.hex(' ').upper()} in its first frame": own for own in JUNK_IN_FRAME}
    query = joined(encoder.query_version())[:-1]
    return {
        "fr_01": [PacketForm(step, f"a {step}", frame_bytes=size) for size, step in splits.items()],
        "fr_02": [PacketForm(step, f"a packet after {step}", own) for step, own in junk.items()],
        "fr_04": [
            PacketForm(
                f"query that ends with {tail:02X}, packet in the same frame",
                f"a packet after a tail {tail:02X} in its first frame",
                query + bytes((tail,)),
            )
            for tail in (0x00, 0x55)
        ],
    }


def _payloads_like_messages(bench: Bench) -> Iterator[tuple[str, bytes]]:
    """Yield data that resembles the start or end of a message, on and across frame boundaries."""
    encoder, to_device = bench.encoder, bench.encoder.to_device
    yield "55 AA throughout", _HEADER * (PACKET_BYTES // 2)
    yield "55 AA throughout, odd offset", (b"\x00" + _HEADER * PACKET_BYTES)[:PACKET_BYTES]
    for byte in (b"\xf0", b"\xff", b"\x00"):
        yield f"{byte.hex().upper()} throughout", byte * PACKET_BYTES
    yield "F0, then 55 AA", b"\xf0\x55\xaa\xf0" * (PACKET_BYTES // 4)
    whole = {
        "end of transfer": joined(encoder.end()),
        "update command": joined(encoder.update(PACKET_BYTES)),
        "reset": joined(encoder.reset()),
        "head of a packet": build(to_device, WRITE, PACKET, bytes(5 + PACKET_BYTES))[:16],
        "head of the longest message": b"\x55\xaa\x16\xff\x77\xfd",
    }
    # Data starts at byte 11 of a packet, so its sixth byte is the first of a frame.
    for name, raw in whole.items():
        for offset in (5, 3):
            where = "at a frame's start" if offset == 5 else "across frames"
            block = bytes(offset) + raw.ljust(24, b"\x00")
            yield f"{name} {where}", block.ljust(64, b"\x00") + block.ljust(64, b"\xf0")


def _data_for_crc(bench: Bench, number: int, total: int, wanted: bytes) -> bytes:
    """Find packet data with this CRC. A CRC is linear: compute the change that each of the last
    bits causes, then solve for the bits to flip.
    """
    body = bytes((WRITE, 2 + (PACKET & 0xFF))) + _PACKET + struct.pack("<BHH", START, number, total)
    start = bench.random.randbytes(PACKET_BYTES - _FREE_BYTES)

    def crc_of(free: int) -> int:
        data = start + free.to_bytes(_FREE_BYTES, "big")
        return int.from_bytes(message_crc(bench.encoder.to_device, body + data), "big")

    plain = crc_of(0)
    basis: dict[int, tuple[int, int]] = {}
    """Highest bit to a change of the CRC and the data bits that cause it."""
    for bit in range(8 * _FREE_BYTES):
        change, bits = _reduce(crc_of(1 << bit) ^ plain, 1 << bit, basis)
        if change:
            basis[change.bit_length()] = (change, bits)
    missing, free = _reduce(plain ^ int.from_bytes(wanted, "big"), 0, basis)
    assert not missing  # noqa: S101  the free bytes reach every CRC
    return start + free.to_bytes(_FREE_BYTES, "big")


def _reduce(change: int, bits: int, basis: Mapping[int, tuple[int, int]]) -> tuple[int, int]:
    """Eliminate from `change` what the basis can cause; return the rest and the bits used."""
    for top in sorted(basis, reverse=True):
        if change.bit_length() == top:
            change, bits = change ^ basis[top][0], bits ^ basis[top][1]
    return change, bits
