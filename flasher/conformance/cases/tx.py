"""TX: packets that are damaged or repeated, and very many of them. Those with a wrong head are in
`tx_heads`, the ways out of a transfer in `tx_ways`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.restore import needs_power
from flasher.conformance.results import Unsupported
from flasher.conformance.wire import (
    PACKET_BYTES,
    Kind,
    RawFrame,
    Received,
    describe,
    packet_count,
    packet_payload,
    split,
)

_PACKETS_MIN: Final = 7
_CRC_AT: Final = slice(-5, -1)
_DATA_AT: Final = 40
"""An offset amid the 128 bytes of a packet."""
_LOST_FRAMES: Final = (0, 1, 9, 17)
"""The first frame of a packet, the one in which its number ends, one of the data, the last one."""
_NUMBER_IN: Final = 1
_BUFFER_BYTES: Final = 4096
"""What a device that writes whole pages may hold back until the end of transfer."""
_REPEATS: Final = 2
_QUIET_S: Final = 0.1
"""A second answer to one packet would come within that time of the first one."""


def transfer_image(bench: Bench) -> bytes:
    """The good image, for a transfer in which things go wrong. Raises Unsupported when it is too
    small for that.
    """
    image = bench.good_image
    if packet_count(len(image)) < _PACKETS_MIN:
        raise Unsupported(f"the good image has less than {_PACKETS_MIN} packets")
    return image


def stops(bench: Bench, image: bytes, numbers: Iterable[int]) -> Iterator[int]:
    """Transfer `image`, stopping before each of these packets: it is sent as it should be, and has
    to be accepted, when the case goes on. The whole ends with the application of the image.
    """
    bench.start_transfer(len(image))
    done = 0
    for number in numbers:
        bench.packets(image, done + 1, number - 1)
        yield number
        with bench.step(f"packet {number} as it should be"):
            bench.send_packet(image, number)
            # Where a frame was lost a NAK may come as late as the next message (FR-05).
            bench.expect(
                Kind.ACK,
                within_s=bench.limit("ack_s"),
                number=number,
                ignoring=(Kind.NAK,),
            )
        done = number
    bench.finish(image, done + 1)


def answers(bench: Bench) -> list[Received]:
    """What a packet is answered by: the first answer, and what follows it at once."""
    limit = bench.limit
    first = bench.next_message(limit("ack_s") + limit("inter_frame_s"))
    return [] if first is None else [first, *bench.collect(_QUIET_S)]


def check_rejected(bench: Bench, wanted: int, named: int, *, is_plain: bool = True) -> None:
    """A packet was rejected as tx_01 says: a NAK, or nothing. With `is_plain` false the device may
    have had reasons not to trust the number in it.
    """
    choice = bench.choice("tx_01")
    numbers = {wanted} if choice == "nak_expected" else {named}
    if not is_plain or choice == "either":
        numbers.add(wanted)
    check_naks(bench, numbers, counts=nak_counts(choice))


def nak_counts(choice: str) -> tuple[int, ...]:
    """How many NAKs a packet may get that has to be rejected, for a value of tx_01."""
    return {"silence": (0,), "either": (0, 1)}.get(choice, (1,))


def check_repeated(bench: Bench, number: int, total: int) -> None:
    """The packet stored last was answered once more, as tx_02 says."""
    heard = answers(bench)
    wanted = f"ACK {number}"
    allowed = {wanted}
    if bench.choice("tx_02") == "nak_next":
        wanted = f"NAK {number + 1}"
        # Behind the last packet there is no next one to ask for.
        allowed = {wanted, f"ACK {number}", f"NAK {number}"} if number == total else {wanted}
    bench.check(describe(heard) in allowed, f"{wanted} for the repeated packet", describe(heard))


def check_naks(bench: Bench, numbers: Collection[int] | None, counts: Collection[int]) -> None:
    """So many NAKs, with one of `numbers` (any for None), and nothing else."""
    heard = answers(bench)
    right = [one for one in heard if _is_nak(one, numbers)]
    which = "" if numbers is None else " " + " or ".join(map(str, sorted(numbers)))
    expected = {0: "silence", 1: f"NAK{which}"}
    wanted = " or ".join(expected[count] for count in sorted(counts, reverse=True))
    bench.check(len(heard) == len(right) in counts, f"rejected: {wanted}", describe(heard))


def _is_nak(heard: Received, numbers: Collection[int] | None) -> bool:
    return heard.kind is Kind.NAK and (numbers is None or heard.number in numbers)


# -- damage ---------------------------------------------------------------------------------------


@case(
    "TX-01",
    "damaged packet",
    clause="4.2, 4",
    stimulus="first, second and last packet with a wrong CRC, with a wrong bit, without a frame",
    expectation="rejected (tx_01, tx_01_lost_frame); accepted when it is sent again",
    requires={DESTRUCTIVE},
    choices=("tx_01", "tx_01_lost_frame"),
)
def damaged(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    lost = {3 + place: index for place, index in enumerate(_LOST_FRAMES)}
    for number in stops(bench, image, (1, 2, *lost, total)):
        if number in lost:
            _lose_frame(bench, image, number, lost[number])
            continue
        for step, named, frames in _damages(bench, image, number):
            with bench.step(f"packet {number}, {step}"):
                bench.send(frames)
                check_rejected(bench, number, named)


def _damages(bench: Bench, image: bytes, number: int) -> Iterator[tuple[str, int, list[RawFrame]]]:
    """Step, number in the packet, frames."""
    total = packet_count(len(image))
    for named in (number, number + 1):
        if named > total:
            continue
        raw = bytearray(_raw_packet(bench, image, named))
        raw[_CRC_AT] = bytes(byte ^ 0xFF for byte in raw[_CRC_AT])
        step = "wrong CRC" if named == number else "the next one came, with a wrong CRC"
        yield step, named, split(bench.encoder.to_device, bytes(raw))
    raw = bytearray(_raw_packet(bench, image, number))
    raw[_DATA_AT] ^= 0x10
    yield "a wrong bit", number, split(bench.encoder.to_device, bytes(raw))


def _raw_packet(bench: Bench, image: bytes, number: int) -> bytes:
    payload = packet_payload(image, number)
    frames = bench.encoder.packet(number, packet_count(len(image)), payload)
    return b"".join(frame.data for frame in frames)


def _lose_frame(bench: Bench, image: bytes, number: int, index: int) -> None:
    choice = bench.choice("tx_01_lost_frame")
    # Without the first frame there is nothing to know a packet by.
    counts = {"either": (0, 1), "nak": (1,), "silence": (0,)}[choice] if index else (0, 1)
    trusts_it = bench.choice("tx_01") in ("nak_received", "either")
    with bench.step(f"packet {number} without its frame {index + 1}"):
        frames = split(bench.encoder.to_device, _raw_packet(bench, image, number))
        bench.send(frames[:index] + frames[index + 1 :])
        check_naks(bench, None if trusts_it and index <= _NUMBER_IN else {number}, counts)


# -- repetitions ----------------------------------------------------------------------------------


@case(
    "TX-02",
    "ACK lost",
    clause="R10",
    stimulus="first, second and last packet sent again after their ACK, twice each",
    expectation="ACK n again (tx_02), one answer a copy; nothing is written twice",
    requires={DESTRUCTIVE},
    choices=("tx_02",),
)
def repeated(bench: Bench) -> None:
    _repeat(bench, mask=0x00)


@case(
    "TX-05",
    "repeated number with other data",
    clause="R10",
    stimulus="first, second and last packet again, with other data and a right CRC",
    expectation="answered as a repetition (tx_02); the first data stay",
    requires={DESTRUCTIVE},
    choices=("tx_02",),
)
def other_data(bench: Bench) -> None:
    _repeat(bench, mask=0xFF)


def _repeat(bench: Bench, mask: int) -> None:
    """A transfer with repetitions whose data differ from the first copy's by `mask`."""
    image = transfer_image(bench)
    total = packet_count(len(image))
    bench.start_transfer(len(image))
    done = 0
    for number in (1, 2, total):
        bench.packets(image, done + 1, number)
        done = number
        payload = bytes(byte ^ mask for byte in packet_payload(image, number))
        for copy in range(1, _REPEATS + 1):
            with bench.step(f"packet {number}, repetition {copy}"):
                bench.send(bench.encoder.packet(number, total, payload))
                check_repeated(bench, number, total)
    bench.finish(image, total + 1)


# -- the ends of the range ------------------------------------------------------------------------


@case(
    "TX-07",
    "many packets",
    clause="4.1, A385; R9",
    stimulus="the largest image, all its packets: across 255/256, up to the last one",
    expectation="every packet is accepted and stored at its place",
    requires={DESTRUCTIVE, LONG},
    limit_s=7200.0,
)
def many_packets(bench: Bench) -> None:
    if needs_power(bench.profile) and not bench.subject.has_power:
        raise Unsupported("only power ends a transfer of this product, and none is controlled")
    size = bench.number("largest_image_bytes")
    image = bench.random.randbytes(size)
    total = packet_count(size)
    bench.start_transfer(size)
    limit_s = bench.limit("ack_s")
    for number in range(1, total + 1):
        sent = bench.send_packet(image, number)
        heard = bench.next_message(limit_s)
        # One check for them all: 65535 are too many to read.
        if heard is None or (heard.kind, heard.number) != (Kind.ACK, number):
            bench.require(False, f"ACK {number}", heard or "nothing")  # noqa: FBT003
            return
        bench.measure("packet to ACK", heard.at - sent.left_at)
    bench.check(True, f"ACK 1 to {total}", "all of them")  # noqa: FBT003
    # Never ended, as nobody could start it; what may still be in a buffer is not looked at.
    buffer_bytes = max(_BUFFER_BYTES, bench.number("buffer_bytes"))
    if size > buffer_bytes:
        bench.check_stored(image[:-buffer_bytes])
    if bench.choice("tx_12") == "announces":
        bench.leave_transfer()


@case(
    "TX-08",
    "last packet not filled with FF",
    clause="4.1, A385",
    stimulus="other bytes than FF behind the end of the image in the last packet",
    expectation="ignored or rejected (tx_08)",
    requires={DESTRUCTIVE},
    choices=("tx_08", "tx_01"),
)
def other_filler(bench: Bench) -> None:
    images = (bench.good_image, bench.subject.second_image or b"")
    image = next((one for one in images if len(one) % PACKET_BYTES), b"")
    if not image:
        raise Unsupported("every good image is a whole number of packets: there is no filler")
    total = packet_count(len(image))
    rest = image[(total - 1) * PACKET_BYTES :]
    payload = rest.ljust(PACKET_BYTES, b"\x00")
    bench.start_transfer(len(image))
    bench.packets(image, 1, total - 1)
    bench.send(bench.encoder.packet(total, total, payload))
    if bench.choice("tx_08") == "ignored":
        bench.expect(Kind.ACK, within_s=bench.limit("ack_s"), number=total)
        bench.finish(image, total + 1)
    else:
        check_rejected(bench, total, total)
        bench.finish(image, total)
