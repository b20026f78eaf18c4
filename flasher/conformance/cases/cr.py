"""CR: checksum. Most stimuli are sent in a transfer that is never ended (`cases.probe`)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import Probe
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.patient_host import UPDATE_SPACING_S, UPDATES_MAX
from flasher.conformance.tester import FaultKind, LineFault
from flasher.conformance.wire import (
    BOOT_VERSION,
    PACKET_BYTES,
    PACKET_FRAMES,
    REPORT,
    RESET,
    RESET_TEXT,
    RawFrame,
    Received,
    Reply,
    build,
    crc,
    describe,
    inverted,
    joined,
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
"""Fields of a packet: name, first byte, end (exclusive)."""
_PACKET_LIKE_BYTES: Final = range(6, 143)
"""Bytes that can be damaged without changing the message's size and kind, so that it still ends
with its last frame.
"""
_NO_HEADER_BYTES: Final = bytes(byte for byte in range(256) if byte not in b"\x55\xaa\xf0")
"""Byte values that a single bit flip cannot turn into a header."""
_BURST_BITS: Final = 8
_BURSTS: Final = 250
_SILENT_BATCH: Final = 16
"""Damaged packets to send in a row where the device does not answer them."""
_NO_HEADER_SIZE: Final = 16 * PACKET_BYTES
_DOCUMENT_SIZE: Final = 78351
Damage = tuple[str, Callable[[bytes], bytes]]
"""A name, and a function that damages the bytes of a packet."""


@case(
    "CR-01",
    "every single-bit flip",
    clause="Welling 2.2.1 (6); robustness, not in the document",
    stimulus="a packet once for each of its 1152 bits, with that bit inverted",
    expectation="none accepted; afterwards the correct packet is accepted and stored unchanged",
    requires={DESTRUCTIVE, LONG},
    upgrades=200,
)
def single_bits(bench: Bench) -> None:
    probe = _probe_without_headers(bench)
    probe.begin()
    for name, first, stop in _FIELDS:
        with bench.step(name):
            bits = range(8 * first, 8 * stop)
            flips = [(f"bit {bit % 8} of byte {bit // 8}", _flipping(bit, 1)) for bit in bits]
            _check_none_accepted(bench, probe, flips, framed=first in _PACKET_LIKE_BYTES)
    probe.send_next()
    probe.check_stored()


@case(
    "CR-02",
    "bursts; lost, doubled and swapped frames",
    clause="Welling 2.2.1 (6); Welling 2.2.3, table 3",
    stimulus="packets with 2 to 8 bits in a row changed, chosen by the seed; each frame of a "
    "packet lost, doubled, swapped with the next one",
    expectation="none accepted; afterwards the correct packet is accepted and stored unchanged",
    requires={DESTRUCTIVE, LONG},
    upgrades=200,
)
def bursts(bench: Bench) -> None:
    probe = _probe_without_headers(bench)
    probe.begin()
    with bench.step("bursts"):
        chosen = [_burst(bench) for _ in range(_BURSTS)]
        _check_none_accepted(bench, probe, chosen, framed=True)
    with bench.step("frames"):
        # Only faults that leave no intact packet: doubling the first or last frame leaves one, and
        # the last frame has no next frame to swap with.
        last = PACKET_FRAMES - 1
        faults: list[LineFault] = []
        for index in range(PACKET_FRAMES):
            faults.append(LineFault(FaultKind.DROP, index))
            if 0 < index < last:
                faults.append(LineFault(FaultKind.DOUBLE, index))
            if index < last:
                faults.append(LineFault(FaultKind.SWAP, index))
        for fault in faults:
            probe.keep_alive()
            if (
                probe.number == probe.total
            ):  # its frames of filler are equal: a swap changes nothing
                probe.send_next()
            frames = probe.frames()
            with bench.disturb(fault):
                bench.send(frames)
                replies = _late_answers(bench)
            _require_none_accepted(bench, f"a packet whose {fault}", replies)
            bench.judge.note_stimulus(heard=bool(replies))
        bench.succeed(f"none of {len(faults)} packets is accepted", "none was")
    probe.send_next()
    probe.check_stored()


@case(
    "CR-03",
    "a checksum of another kind",
    clause="Welling 2.2.1 (6); Welling 4.2",
    stimulus="update commands and packets whose CRC is for another id, leaves the id out, is sent "
    "low byte first, is inverted, 00000000 or FFFFFFFF",
    expectation="rejected; update command and packet with the right CRC are accepted",
    requires={DESTRUCTIVE},
)
def other_checksums(bench: Bench) -> None:
    probe = Probe(bench)
    kinds = list(_wrong_checksums(bench))
    update = joined(bench.encoder.update(len(probe.image)))
    with bench.step("update commands"):
        probe.enter_after_rejected(*(bench.encoder.frames(damage(update)) for _, damage in kinds))
    probe.send_next()
    for kind in kinds:
        with bench.step(f"packet, {kind[0]}"):
            _check_none_accepted(bench, probe, [kind], framed=True)
    probe.send_next()
    probe.check_stored()


@case(
    "CR-04",
    "messages byte for byte",
    clause="Welling 2.2.1, table 1; Welling 4.1; Welling 4.2",
    stimulus="an upgrade, then the beginning of one, both with literal messages",
    expectation="accepted, and each answer equals the expected message byte for byte, its last "
    "frame without padding",
    requires={DESTRUCTIVE},
    choices=("tx_01",),
)
def vectors(bench: Bench) -> None:
    exact, encoder = _WrittenMessages(bench), bench.encoder
    limit, image = bench.limit, bench.good_image
    with bench.step("upgrade"):
        exact.enter(encoder.update(len(image)))
        bench.packets(image)
        bench.send(exact.frames("end"))
        exact.expect("complete", limit("complete_s"))
        runs = bench.application_runs()  # which one it is, is EN-08
        bench.check(runs, "the application runs", "it answers" if runs else "no answer")
    with bench.step("beginning of an upgrade"):
        if bench.number("largest_image_bytes") < _DOCUMENT_SIZE:
            exact.enter(exact.frames("small_update"))
            packet = encoder.packet_of(bench.filler(1), 1)
        else:
            exact.enter(exact.frames("update"))
            packet = exact.frames("packet")
        if bench.choice("tx_01") != "silence":
            damaged = packet[3]._replace(data=bytes(8))
            bench.send([*packet[:3], damaged, *packet[4:]])
            exact.expect_first_nak(limit("ack_s"))
        bench.send(packet)
        exact.expect("ack", limit("ack_s"))


# -- literal messages ------------------------------------------------------------------------------

VECTORS: Final[dict[str, dict[str, str]]] = {
    "wmc": {
        "reset": "55aa1607420552455345545fa4a5abf0",
        "feedback": "55aa0c05550341434b7cecb1d9f0",
        "update": "55aa160da10b574d435f5550440f3201007b315327f0",
        "small_update": "55aa160da10b574d435f5550448000000092324155f0",
        "request": "55aa0c04c402000001ea2f13f0",
        "packet": (
            "55aa1687a385010100650238b4e652e44da7f2370d9e260e27136550a4a3a6d07f5c0c332f8b1224"
            "083fd22b902f8911e81818f8c99d5d5d9831957504d90e945de2e8f54ee781cc75f636d85099095a"
            "a300165a67036f9b540d6b8f0be21124179c3dd9f73817ce6e118d264aad6cb6dd210faf94acd3cf"
            "92c190237cb11f5d108cf25930263938b370a1b4db6380f0"
        ),
        "ack": "55aa0c04c202010032bc87eef0",
        "nak": "55aa0c04c3020100da18d1ebf0",
        "end": "55aa1603a401046636c0fbf0",
        "complete": "55aa0c04c5020000e94e7916f0",
    },
    "bms": {
        "reset": "55aa160742055245534554a41da484f0",
        "feedback": "55aa0c05550341434bb209fc46f0",
        "update": "55aa160da10b424d535f5550440f320100327275d1f0",
        "small_update": "55aa160da10b424d535f55504480000000db7167a3f0",
        "request": "55aa0c04c4020000337142f8f0",
        "packet": (
            "55aa1687a3850101006502b405420fb169779edfb5b9342405157f54b12eae62d11e887eb0766d18"
            "77f8c6eff26b5010af3177d161e79587a766ec30e4037458a9905cad87bd4c77e2983f27745ccb9a"
            "31052e944cf1b220eaa2c7fb1b7d3e3f73f414af6e0d935520dd4c2147738606f2bf7ec70209e0cd"
            "05ee5720edbcba3acce672084ab649fcbce49b57331025f0"
        ),
        "ack": "55aa0c04c20201000027ea05f0",
        "nak": "55aa0c04c3020100e883bc00f0",
        "end": "55aa1603a401042c3d8a98f0",
        "complete": "55aa0c04c5020000dbd514fdf0",
    },
    "obc": {
        "reset": "55aa160742055245534554f28aa461f0",
        "feedback": "55aa0c05550341434bf7aac733f0",
        "update": "55aa160da10b4f42435f5550440f320100838eea16f0",
        "small_update": "55aa160da10b4f42435f555044800000006a8df864f0",
        "request": "55aa0c04c4020000deb892ccf0",
        "packet": (
            "55aa1687a385010100650229825e79455971b21ae105aab2d6a3100b08880f0f422dbb36fb94b3cb"
            "6d424f813caaa5b348f4930b893bfe338f65aea5a969d270831572af40db4852eb74b74f3ac36288"
            "1215e31ed32cab3d56d55807afc6053558cef092a9317629b2ff5ae637052b3839659c78fdf91d0a"
            "aa627e00a3170ffb76dc37c1eaaac4992395494a839ef9f0"
        ),
        "ack": "55aa0c04c2020100edee3a31f0",
        "nak": "55aa0c04c3020100054a6c34f0",
        "end": "55aa1603a40104e98447d4f0",
        "complete": "55aa0c04c5020000361cc4c9f0",
    },
}
"""Messages in hexadecimal by target and name: `update` is for 78351 bytes, `small_update` for 128
bytes, `packet` is number 1 of 613.
"""


class _WrittenMessages:
    """Sends and expects the literal messages in `VECTORS`."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        texts = VECTORS[bench.encoder.target]
        self._written = {name: bytes.fromhex(text) for name, text in texts.items()}

    def frames(self, name: str) -> list[RawFrame]:
        return self._bench.encoder.frames(self._written[name])

    def expect(self, name: str, within_s: float) -> None:
        """Require that the next message is exactly this one."""
        self._judge(name, self._written[name], self._bench.next_message(within_s))

    def expect_first_nak(self, within_s: float) -> None:
        """Require that the next message is exactly NAK 1; another or no NAK is TX-01's concern."""
        reply = self._bench.next_message(within_s)
        if (
            reply is None
            or reply.kind is Reply.ACK
            or (reply.kind is Reply.NAK and reply.number != 1)
        ):
            why = f"the damaged packet 1 got {reply or 'no answer'}"
            self._bench.unsupported("NAK 1, byte for byte", why)
        else:
            self._judge("nak", self._written["nak"], reply)

    def enter(self, update: list[RawFrame]) -> None:
        """Reset the application and send this update command until request transfer."""
        bench, encoder, limit = self._bench, self._bench.encoder, self._bench.limit
        bench.forget()
        is_own = (encoder.reset_command, encoder.reset_data) != (RESET, RESET_TEXT)
        with bench.tester.collecting_feedback():
            bench.send(encoder.reset() if is_own else self.frames("reset"))
            reply = bench.next_message(limit("first_version_s"))
        if reply is None or reply.kind is not Reply.BOOT_VERSION:  # one without feedback: RS-01
            self._judge("feedback", self._written["feedback"], reply)
            reply = bench.next_message(limit("first_version_s"))
        # The version text is the product's own.
        text = reply.data[3:] if reply is not None else b""
        version = build(encoder.to_tool, REPORT, BOOT_VERSION, encoder.boot_name.encode() + text)
        self._judge("boot version", version, reply)
        bench.wait_for_window()
        for _ in range(UPDATES_MAX):
            sent = bench.send(update)
            for _ in range(UPDATES_MAX):
                reply = bench.next_message(limit("erase_s"))
                # Boot versions sent before the update command was received do not count (R2).
                is_version = reply is not None and reply.kind is Reply.BOOT_VERSION
                if reply is None or not is_version or reply.at > sent.left_at + UPDATE_SPACING_S:
                    break
            if reply is None or reply.kind is not Reply.BOOT_VERSION:
                break
        self._judge("request", self._written["request"], reply)

    def _judge(self, name: str, wanted: bytes, reply: Received | None) -> None:
        where = self._bench.encoder.to_tool
        raw = b"" if reply is None else reply.raw + reply.padding
        got = "nothing" if reply is None else f"{reply.can_id:03X} {raw.hex(' ').upper()}"
        ok = reply is not None and (reply.can_id, raw) == (where, wanted)
        self._bench.require(ok, f"{name}: {where:03X} {wanted.hex(' ').upper()}", got)


# -- damage ---------------------------------------------------------------------------------------


def _probe_without_headers(bench: Bench) -> Probe:
    """Create a probe whose data cannot turn into a header by one bit flip."""
    return Probe(
        bench, bytes(bench.random.choice(_NO_HEADER_BYTES) for _ in range(_NO_HEADER_SIZE))
    )


def _flipping(first_bit: int, pattern: int) -> Callable[[bytes], bytes]:
    """Return a function that flips the bits of `pattern`, starting at `first_bit` of a message."""

    def flip(raw: bytes) -> bytes:
        flipped = int.from_bytes(raw, "little") ^ pattern << first_bit
        return flipped.to_bytes(len(raw), "little")

    return flip


def _burst(bench: Bench) -> Damage:
    """A random burst of 2 to 8 bits whose ends are flipped, inside the packet's data."""
    length = bench.random.randint(2, _BURST_BITS)
    pattern = 1 | 1 << length - 1 | bench.random.getrandbits(length)
    last = 8 * _PACKET_LIKE_BYTES.stop - length
    first_bit = bench.random.randint(8 * _PACKET_LIKE_BYTES.start, last)
    return f"pattern {pattern:b} from bit {first_bit} on", _flipping(first_bit, pattern)


def _wrong_checksums(bench: Bench) -> Iterator[Damage]:
    """Yield changes that replace the correct CRC of a message by a wrong one."""
    encoder = bench.encoder

    def by(between: bytes) -> Callable[[bytes], bytes]:
        """Compute the CRC with `between` in place of the id."""

        def seal(raw: bytes) -> bytes:
            value = crc(raw[:2] + between + raw[2:-5])
            return raw[:-5] + struct.pack(">I", value) + raw[-1:]

        return seal

    others = [other.to_device for other in encoder.others()]
    for can_id in (*others, encoder.to_tool, encoder.to_all, 0):
        yield f"CRC for id {can_id:03X}", by(struct.pack(">H", can_id))
    yield "CRC for the id low byte first", by(struct.pack("<H", encoder.to_device))
    yield "CRC without the id", by(b"")
    yield "CRC low byte first", lambda raw: raw[:-5] + raw[-5:-1][::-1] + raw[-1:]
    yield "CRC inverted", lambda raw: raw[:-5] + inverted(raw[-5:-1]) + raw[-1:]
    for filler in (b"\x00", b"\xff"):
        yield f"CRC of {filler.hex().upper()}", _with_crc(4 * filler)


def _with_crc(field: bytes) -> Callable[[bytes], bytes]:
    """Return a function that replaces the CRC of a message."""
    return lambda raw: raw[:-5] + field + raw[-1:]


# -- judging --------------------------------------------------------------------------------------


def _check_none_accepted(
    bench: Bench, probe: Probe, damages: Sequence[Damage], *, framed: bool
) -> None:
    """Send the next packet with each kind of damage. The first one that is acknowledged ends the
    case, since the device then holds other data than the following checks assume.

    With `framed` every damaged packet ends with its last frame, so the next one need not wait for
    the inter-frame timeout. Where the profile leaves the answer open (tx_01), the answer to the
    first packet decides what to wait for.
    """
    choice = bench.choice("tx_01")
    answers = choice in ("nak_expected", "nak_received")
    left = list(damages)
    if choice == "either":
        name, damage = left.pop(0)
        probe.keep_alive()
        bench.send(bench.encoder.frames(damage(probe.raw())))
        replies = _late_answers(bench)
        _require_none_accepted(bench, f"a packet with {name}", replies)
        answers = bool(replies)
        bench.judge.note_stimulus(heard=answers)
    size = _SILENT_BATCH if framed and not answers else 1
    for start in range(0, len(left), size):
        batch = left[start : start + size]
        probe.keep_alive(len(batch))
        raw = probe.raw()
        for _, damage in batch:
            bench.send(bench.encoder.frames(damage(raw)))
        if framed and answers:
            one = bench.next_message(bench.limit("ack_s"))
            replies = [] if one is None else [one]
        else:
            replies = _late_answers(bench)
        first, last = batch[0][0], batch[-1][0]
        names = first if len(batch) == 1 else f"one of {len(batch)} damages, {first} to {last}"
        _require_none_accepted(bench, f"a packet with {names}", replies)
        bench.judge.note_stimulus(len(batch), heard=bool(replies))
    if left and framed and answers:  # else it was waited for
        _require_none_accepted(bench, "the last ones", _late_answers(bench))
    bench.succeed(f"none of {len(damages)} packets is accepted", "none was")


def _late_answers(bench: Bench) -> list[Received]:
    """Messages until all damaged packets are answered, or a pause is near; no partial message is
    left then.
    """
    waits = bench.waits
    return bench.collect(max(waits.incomplete_s, bench.before_pause_s(waits.settle_s)))


def _require_none_accepted(bench: Bench, what: str, replies: Sequence[Received]) -> None:
    """Require NAK or silence; TX-01 checks which, and with which number."""
    if any(one.kind is not Reply.NAK for one in replies):
        by = bench.judge.ends_of_transfer(replies)
        bench.require(False, f"NAK or no answer to {what}", describe(replies), by=by)  # noqa: FBT003
