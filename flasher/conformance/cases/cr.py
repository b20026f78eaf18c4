"""CR: checksum. The stimuli stand in a transfer that is never ended (`probing`)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probing import PACKET_FRAMES, Probe, stream
from flasher.conformance.cases.vectors import Exact
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.tester import Fault, FaultKind
from flasher.conformance.wire import (
    PACKET_BYTES,
    Kind,
    Received,
    crc,
    describe,
    split,
)

_FIELDS: Final = (
    ("header", 0, 2),
    ("mode", 2, 3),
    ("length", 3, 4),
    ("command", 4, 6),
    ("start byte", 6, 7),
    ("number", 7, 9),
    ("total", 9, 11),
    ("data", 11, 139),
    ("CRC", 139, 143),
    ("tail", 143, 144),
)
"""The fields of a packet: name, first byte, byte behind the last."""
_LIKE_PACKETS: Final = range(6, 143)
"""Bytes whose damage leaves a message of the same size and kind: it is over with its last frame."""
_CALM: Final = bytes(byte for byte in range(256) if byte not in b"\x55\xaa\xf0")
"""Bytes that a single flip does not make a header of, as it takes two."""
_BURST_BITS: Final = 8
_BURSTS: Final = 250
_SILENT_BATCH: Final = 16
"""Damaged packets in a row, where a device does not answer them."""
_CALM_BYTES: Final = 16 * PACKET_BYTES
_DOCUMENT_SIZE: Final = 78351
Damage = tuple[str, Callable[[bytes], bytes]]
"""What is done to a packet, by name, and the function from its bytes to the damaged ones."""


@case(
    "CR-01",
    "every single-bit flip",
    clause="2, 3",
    stimulus="a packet once for each of its 1152 bits, with that bit the other way round",
    expectation="none accepted; the packet is taken afterwards, and stored as it is",
    requires={DESTRUCTIVE, LONG},
)
def single_bits(bench: Bench) -> None:
    probe = _calm_probe(bench)
    probe.begin()
    for name, first, behind in _FIELDS:
        with bench.step(name):
            bits = range(8 * first, 8 * behind)
            flips = [(f"bit {bit % 8} of byte {bit // 8}", _flipping(bit, 1)) for bit in bits]
            _check_none_taken(bench, probe, flips, framed=first in _LIKE_PACKETS)
    probe.plain()
    probe.check_stored()


@case(
    "CR-02",
    "bursts; lost, doubled and swapped frames",
    clause="2, 3",
    stimulus="packets with 2 to 8 bits in a row changed, chosen by the seed; each frame of a "
    "packet lost, doubled, swapped with the next one",
    expectation="none accepted; the packet is taken afterwards, and stored as it is",
    requires={DESTRUCTIVE, LONG},
)
def bursts(bench: Bench) -> None:
    probe = _calm_probe(bench)
    probe.begin()
    with bench.step("bursts"):
        chosen = [_burst(bench) for _ in range(_BURSTS)]
        _check_none_taken(bench, probe, chosen, framed=True)
    with bench.step("frames"):
        faults = list(_frame_faults())
        for fault in faults:
            probe.keep_alive()
            frames = probe.frames()
            with bench.disturb(fault):
                bench.send(frames)
                heard = bench.collect(probe.settle_s())
            _require_none_taken(bench, f"a packet whose {fault}", heard)
        bench.check(True, f"none of {len(faults)} packets is accepted", "none was")  # noqa: FBT003
    probe.plain()
    probe.check_stored()


@case(
    "CR-03",
    "a checksum of another kind",
    clause="3",
    stimulus="update commands and packets whose CRC is for another id, leaves the id out, or "
    "stands low byte first",
    expectation="rejected; update command and packet with the right one are taken",
    requires={DESTRUCTIVE},
)
def other_checksums(bench: Bench) -> None:
    probe = Probe(bench)
    kinds = list(_wrong_checksums(bench))
    update = stream(bench.encoder.update(len(probe.image)))
    with bench.step("update commands"):
        to_device = bench.encoder.to_device
        probe.enter_past(*(split(to_device, damage(update)) for _, damage in kinds))
    probe.plain()
    for kind in kinds:
        with bench.step(f"packet, {kind[0]}"):
            _check_none_taken(bench, probe, [kind], framed=True)
    probe.plain()
    probe.check_stored()


@case(
    "CR-04",
    "messages byte for byte",
    clause="2, 3",
    stimulus="an upgrade, then the beginning of one by written-out messages",
    expectation="they are taken, and each answer is the written-out one to the last byte",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def vectors(bench: Bench) -> None:
    exact, words = Exact(bench), bench.encoder
    limit, image = bench.limit, bench.good_image
    with bench.step("upgrade"):
        exact.enter(words.update(len(image)))
        bench.packets(image)
        bench.send(exact.frames("end"))
        exact.hear("complete", limit("complete_s"))
        bench.check_application(image)
    with bench.step("beginning of an upgrade"):
        if bench.number("largest_image_bytes") < _DOCUMENT_SIZE:
            exact.enter(exact.frames("small_update"))
            return
        exact.enter(exact.frames("update"))
        packet = exact.frames("packet")
        if bench.choice("tx_01") != "silence":
            damaged = packet[3]._replace(data=bytes(8))
            bench.send([*packet[:3], damaged, *packet[4:]])
            exact.hear_first_nak(limit("ack_s"))
        bench.send(packet)
        exact.hear("ack", limit("ack_s"))


# -- damage ---------------------------------------------------------------------------------------


def _calm_probe(bench: Bench) -> Probe:
    """A probe of packets in which no two neighbours are nearly a header."""
    return Probe(bench, bytes(bench.random.choice(_CALM) for _ in range(_CALM_BYTES)))


def _flipping(first_bit: int, pattern: int) -> Callable[[bytes], bytes]:
    """Flips the bits of `pattern` from `first_bit` of a message on."""

    def flip(raw: bytes) -> bytes:
        flipped = int.from_bytes(raw, "little") ^ pattern << first_bit
        return flipped.to_bytes(len(raw), "little")

    return flip


def _burst(bench: Bench) -> Damage:
    """A burst of 2 to 8 bits, its first and last one flipped, where the rest stays a packet."""
    length = bench.random.randint(2, _BURST_BITS)
    pattern = 1 | 1 << length - 1 | bench.random.getrandbits(length)
    last = 8 * _LIKE_PACKETS.stop - length
    first_bit = bench.random.randint(8 * _LIKE_PACKETS.start, last)
    return f"pattern {pattern:b} from bit {first_bit} on", _flipping(first_bit, pattern)


def _frame_faults() -> Iterator[Fault]:
    """Faults after which no intact packet is left: the first or the last frame doubled leaves one,
    and behind the last frame there is none to swap it with.
    """
    for index in range(PACKET_FRAMES):
        yield Fault(FaultKind.DROP, index)
        if 0 < index < PACKET_FRAMES - 1:
            yield Fault(FaultKind.DOUBLE, index)
        if index < PACKET_FRAMES - 1:
            yield Fault(FaultKind.SWAP, index)


def _wrong_checksums(bench: Bench) -> Iterator[Damage]:
    """Ways to get a CRC that is not the right one, each of a message that is right so far."""
    words = bench.encoder

    def by(between: bytes) -> Callable[[bytes], bytes]:
        """The CRC with these bytes in place of the id."""

        def seal(raw: bytes) -> bytes:
            value = crc(raw[:2] + between + raw[2:-5])
            return raw[:-5] + struct.pack(">I", value) + raw[-1:]

        return seal

    for can_id in (*(one.to_device for one in words.others()), words.to_tool, words.to_all, 0):
        yield f"CRC for id {can_id:03X}", by(struct.pack(">H", can_id))
    yield "CRC for the id low byte first", by(struct.pack("<H", words.to_device))
    yield "CRC without the id", by(b"")
    yield "CRC low byte first", lambda raw: raw[:-5] + raw[-5:-1][::-1] + raw[-1:]


# -- judging --------------------------------------------------------------------------------------


def _check_none_taken(
    bench: Bench, probe: Probe, damages: Sequence[Damage], *, framed: bool
) -> None:
    """Send the next packet damaged in these ways; the first one that is acknowledged ends the case,
    as something else is stored then than what follows is about.

    `framed` says that each is over with its last frame, so that the next one need not wait.
    """
    choice = bench.choice("tx_01")
    answers = choice in ("nak_expected", "nak_received")
    size = _SILENT_BATCH if framed and choice == "silence" else 1
    for start in range(0, len(damages), size):
        batch = damages[start : start + size]
        probe.keep_alive()
        raw = probe.raw()
        for _, damage in batch:
            bench.send(split(bench.encoder.to_device, damage(raw)))
        if framed and answers:
            one = bench.next_message(bench.limit("ack_s"))
            heard = [] if one is None else [one]
        else:
            heard = bench.collect(probe.settle_s())
        _require_none_taken(bench, f"a packet with {_name(batch)}", heard)
    _require_none_taken(bench, "the last ones", bench.collect(probe.settle_s()))
    bench.check(True, f"none of {len(damages)} packets is accepted", "none was")  # noqa: FBT003


def _name(batch: Sequence[Damage]) -> str:
    first, last = batch[0][0], batch[-1][0]
    return first if len(batch) == 1 else f"one of {len(batch)} damages, {first} to {last}"


def _require_none_taken(bench: Bench, what: str, heard: Sequence[Received]) -> None:
    """NAK or silence; which of them, with which number, is TX-01."""
    if any(one.kind is not Kind.NAK for one in heard):
        bench.require(False, f"NAK or no answer to {what}", describe(heard))  # noqa: FBT003
