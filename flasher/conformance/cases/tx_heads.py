"""TX: packets whose head is wrong: number, total, start byte."""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.tx import (
    answers,
    check_naks,
    check_rejected,
    nak_counts,
    stops,
    transfer_image,
)
from flasher.conformance.catalogue import DESTRUCTIVE, case
from flasher.conformance.wire import (
    PACKET_BYTES,
    describe,
    packet_count,
    packet_payload,
)

_NUMBER_MAX: Final = 0xFFFF
_STORED: Final = 3
_START_BYTES: Final = (0x00, 0x02, 0x04, 0x10, 0x81, 0xFF)


@case(
    "TX-03",
    "packet numbers out of order",
    clause="4.2, 4; R10",
    stimulus="before packet 1, after packet 3 and after the last one: a number skipped, the last "
    "one, 0, beyond the total, 65535; older ones, with right and with other data",
    expectation="rejected (tx_01), the older ones as the profile says (tx_03); nothing of it is "
    "stored",
    requires={DESTRUCTIVE},
    choices=("tx_01", "tx_03"),
)
def out_of_order(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    bench.start_transfer(len(image))
    _send_wrong_numbers(bench, image, 0)
    bench.packets(image, 1, _STORED)
    _send_wrong_numbers(bench, image, _STORED)
    for number in range(1, _STORED):
        for what, mask in (("the right", 0x00), ("other", 0xFF)):
            with bench.step(f"after packet {_STORED}, packet {number} with {what} data"):
                payload = bytes(byte ^ mask for byte in packet_payload(image, number))
                bench.send(bench.encoder.packet(number, total, payload))
                _check_older(bench, number)
    bench.packets(image, _STORED + 1)
    _send_wrong_numbers(bench, image, total)
    bench.finish(image, total + 1)


def _send_wrong_numbers(bench: Bench, image: bytes, stored: int) -> None:
    total = packet_count(len(image))
    payload = bytes(PACKET_BYTES)
    numbers = {stored + 2: True, total: True, 0: False, total + 1: True, _NUMBER_MAX: True}
    for number, is_plain in numbers.items():
        # The one stored last is a repetition (TX-02), and 65536 cannot be said.
        if 0 < number == stored or number > _NUMBER_MAX:
            continue
        with bench.step(f"after packet {stored}, number {number}"):
            bench.send(bench.encoder.packet(number, total, payload))
            if stored < total:
                check_rejected(bench, stored + 1, number, is_plain=is_plain)
            else:
                # All is there: which number is wanted is nobody's business.
                check_naks(bench, None, nak_counts(bench.choice("tx_01")))


def _check_older(bench: Bench, number: int) -> None:
    choice = bench.choice("tx_03")
    if choice == "ack":
        heard = answers(bench)
        bench.check(describe(heard) == f"ACK {number}", f"ACK {number}", describe(heard))
    else:
        check_naks(bench, {number, _STORED + 1}, (1,) if choice == "nak" else (0,))


@case(
    "TX-04",
    "total that does not fit the size",
    clause="4.1, A385",
    stimulus="packet 1, 4 and the last one with a total that is 1 less, 1 more, 0, 65535 or "
    "high byte first",
    expectation="rejected (tx_01); accepted with the right total",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def wrong_total(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    swapped = int.from_bytes(total.to_bytes(2, "little"), "big")
    wrong = dict.fromkeys((total - 1, total + 1, 0, _NUMBER_MAX, swapped))
    wrong.pop(total, None)
    for number in stops(bench, image, (1, _STORED + 1, total)):
        for named in wrong:
            with bench.step(f"packet {number} of {named}"):
                bench.send(bench.encoder.packet(number, named, packet_payload(image, number)))
                check_rejected(bench, number, number)


@case(
    "TX-06",
    "wrong start byte",
    clause="4.1, A385",
    stimulus="packet 1, 4 and the last one beginning with 00, 02, 04, 10, 81 and FF",
    expectation="rejected (tx_01); accepted with 01",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def wrong_start_byte(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    for number in stops(bench, image, (1, _STORED + 1, total)):
        for start in _START_BYTES:
            with bench.step(f"packet {number} with {start:02X}"):
                payload = packet_payload(image, number)
                bench.send(bench.encoder.packet(number, total, payload, start=start))
                check_rejected(bench, number, number)
