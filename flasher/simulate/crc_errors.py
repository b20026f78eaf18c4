"""Decides which errors of a few bits a receiver of messages detects, for all of them at once.

The CRC is affine: the difference that an error makes, its syndrome, is the exclusive or of those of
its bits, whatever the message contains. An error is undetected if its syndrome is 0. So errors of
two and three bits need the syndromes of single bits only, and bursts the linear dependence of up to
16 syndromes in a row. Errors of one bit are given to the receiver itself.

Five bytes are compared before the CRC: header and tail, which are constant, and the length, which
the second byte of the command repeats. An error there is detected by that, unless it changes the
length in both places alike. Those of up to three bits are given to the receiver one by one; a burst
of 16 bits has none, since bits of the same value are 16 apart.

Bits are counted in the order of the message, the most significant bit of a byte first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from flasher.protocol.crc import crc32
from flasher.protocol.spec import (
    COMMAND_SIZE,
    CRC_SIZE,
    HEADER,
    LENGTH_MIN,
    MESSAGE_MAX_SIZE,
    OVERHEAD_SIZE,
    TAIL,
)
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Message, Reassembler, encode
from flasher.simulate.oracle import Violation

BURST_BITS: Final = 16
_DETECTED, _UNDETECTED = ": detected", ": undetected"
_CAN_ID: Final = 0x752
_LENGTH_AT, _REPEATED_AT = 3, 5


@dataclass(frozen=True)
class ErrorsOfSize:
    """All errors of 1, 2 and 3 bits and all bursts in a message of `size` bytes."""

    size: int

    def __str__(self) -> str:
        return f"errors of a message of {self.size} bytes"

    def examine(self) -> tuple[Mapping[str, int], Sequence[Violation]]:
        """Return the number of errors by kind and fate, and a violation for each kind of which some
        are undetected.
        """
        message = message_of(self.size)
        encoded = encode(message)
        wire = int.from_bytes(encoded, "big")
        counts = received("1 bit", message, (1 << bit for bit in range(8 * self.size)))
        # Enough of it to complete a message whose length has grown.
        following = encoded * (MESSAGE_MAX_SIZE // self.size + 1)
        counts += received("length", message, self._other_lengths(wire), following)
        counts += self._by_syndromes(wire)
        violations = [
            Violation("UNDETECTED", f"{number} of {self} ({kind.removesuffix(_UNDETECTED)})")
            for kind, number in counts.items()
            if kind.endswith(_UNDETECTED)
        ]
        return counts, violations

    def _other_lengths(self, wire: int) -> Iterator[int]:
        """Errors of 2 and 3 bits that change the length in both places alike."""
        at, repeated_at = (8 * (self.size - 1 - each) for each in (_LENGTH_AT, _REPEATED_AT))
        length = wire >> at & 0xFF
        repeated = wire >> repeated_at & 0xFF
        for other in range(LENGTH_MIN, 0x100):
            changed = (other ^ length) << at | ((other - COMMAND_SIZE) ^ repeated) << repeated_at
            bits = changed.bit_count()
            if 0 < bits <= 3:
                yield changed
            if bits == 2:
                for bit in range(8 * self.size):
                    # One more in a length makes them differ.
                    if bit // 8 not in (at // 8, repeated_at // 8):
                        yield changed | 1 << bit

    def _by_syndromes(self, wire: int) -> Counter[str]:
        """Count errors of 2 and 3 bits, and bursts, that leave the five bytes alone."""
        size = self.size
        intact = _checksum(wire, size)
        places = [*range(len(HEADER), size - len(TAIL))]
        numbers = [
            bit
            for place in places
            if place not in (_LENGTH_AT, _REPEATED_AT)
            for bit in range(8 * place, 8 * place + 8)
        ]
        syndromes = {
            bit: _checksum(wire ^ 1 << 8 * size - 1 - bit, size) ^ intact for bit in numbers
        }
        values = [*syndromes.values()]
        bits = len(values)
        undetected = {"2 bits": 0, "3 bits": 0, "burst": 0}
        later: dict[int, int] = {}
        for index in range(bits - 1, -1, -1):
            value = values[index]
            undetected["2 bits"] += later.get(value, 0)
            undetected["3 bits"] += sum(later.get(value ^ each, 0) for each in values[:index])
            later[value] = later.get(value, 0) + 1
        all_of_them = {
            "2 bits": bits * (bits - 1) // 2,
            "3 bits": bits * (bits - 1) * (bits - 2) // 6,
            "burst": 0,
        }
        for first in numbers:
            others = [
                syndromes[bit] for bit in range(first + 1, first + BURST_BITS) if bit in syndromes
            ]
            all_of_them["burst"] += 1 << len(others)
            undetected["burst"] += _sums_to(syndromes[first], others)
        counts = Counter({kind + _UNDETECTED: number for kind, number in undetected.items()})
        for kind, number in all_of_them.items():
            counts[kind + _DETECTED] = number - undetected[kind]
        return +counts


def message_of(size: int) -> Message:
    """Message whose encoding has so many bytes."""
    data_bytes = size - OVERHEAD_SIZE - COMMAND_SIZE
    return Message(_CAN_ID, 0x0C, 0xA300 | data_bytes, bytes(range(data_bytes)))


def received(
    kind: str, message: Message, errors: Iterable[int], following: bytes = b""
) -> Counter[str]:
    """Give a message with each of the errors, and what follows, to a receiver; return the number of
    errors by fate.

    An error is the bits that it changes, as a number with the size of the message.
    """
    wire = encode(message)
    intact, size = int.from_bytes(wire, "big"), len(wire)
    counts: Counter[str] = Counter()
    for error in errors:
        receiver = Reassembler(message.can_id, DEFAULT_TIMINGS.inter_frame_timeout_s)
        found = receiver.feed((intact ^ error).to_bytes(size, "big") + following, 0.0)
        is_accepted = any(isinstance(each, Message) and each != message for each in found)
        counts[kind + (_UNDETECTED if is_accepted else _DETECTED)] += 1
    return counts


def _checksum(wire: int, size: int) -> int:
    """Return the difference between the CRC of a message and the one that it contains."""
    message = wire.to_bytes(size, "big")
    end = size - CRC_SIZE - len(TAIL)
    covered = HEADER + _CAN_ID.to_bytes(2, "big") + message[len(HEADER) : end]
    return crc32(covered) ^ int.from_bytes(message[end : -len(TAIL)], "big")


def _sums_to(value: int, others: Sequence[int]) -> int:
    """Return the number of selections of `others` whose exclusive or is `value`."""
    basis: list[int] = []
    for each in others:
        rest = _reduced(each, basis)
        if rest:
            basis.append(rest)
    return 0 if _reduced(value, basis) else 1 << len(others) - len(basis)


def _reduced(value: int, basis: Sequence[int]) -> int:
    for each in basis:
        value = min(value, value ^ each)
    return value
