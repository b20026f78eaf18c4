"""UP: update command. Sizes, names, the time window and repetitions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import Probe
from flasher.conformance.catalogue import APPLICATION, DESTRUCTIVE, LONG, TIMING, case
from flasher.conformance.judge import TimeName
from flasher.conformance.wire import (
    PACKET_BYTES,
    READ,
    UPDATE,
    WRITE,
    Encoder,
    RawFrame,
    Received,
    Reply,
    describe,
    inverted,
    joined,
    packet_count,
)

_SIZES: Final = (1, 127, 128, 129, 78351)
_SENT_PACKETS: Final = 2
"""Packets of an image that are sent at most, to check the expected number of packets."""
_SIZE_BITS: Final = (16, 24, 31)
"""A device that stores the size in fewer bits would take it for a small image."""
_UPDATE_HEAD: Final = joined(Encoder("bms").update(0))[:6]
"""Start of a write of the update command, to any target."""
_FIRST_PACKETS: Final = 3
_MANY: Final = 24
"""Transfers started without a restart in between, to find state that remains."""


@case(
    "UP-01",
    "accepted sizes",
    clause="Welling 5.2, table 8 (A10B); Welling 2.2.1 (7); Welling 5.2, table 9 (C402); R9",
    stimulus="update command for 1, 127, 128, 129, 78351 bytes and the largest image",
    expectation="request transfer within the erase limit; the packets of that size are accepted",
    requires={DESTRUCTIVE, LONG},
    choices=("device.largest_image_bytes",),
)
def sizes(bench: Bench) -> None:
    largest = bench.number("largest_image_bytes")
    if largest < max(_SIZES):
        bench.info(f"sizes above {largest} bytes, the largest image of the device, were left out")
    bench.reset_to_bootloader()
    for index, size in enumerate([*(size for size in _SIZES if size < largest), largest]):
        with bench.step(f"{size} bytes"):
            if index:
                bench.restart_transfer(size)
            else:
                bench.update(size)
            # With a packet stored, an update command starts over or is rejected (UP-08); before
            # that it may also be ignored (R25).
            bench.packets(bench.random.randbytes(size), 1, min(packet_count(size), _SENT_PACKETS))
    bench.restart_transfer(len(bench.good_image))
    bench.finish(bench.good_image)


@case(
    "UP-02",
    "rejected sizes",
    clause="Welling 5.2, table 8 (A10B); R9",
    stimulus="update command for 0 bytes, more than the largest image, 2^32 - 1 bytes, the size "
    "of the good image with a bit more beyond the largest image",
    expectation="rejected before anything is erased: the old application starts",
    requires={APPLICATION, DESTRUCTIVE},
    choices=("up_02", "device.largest_image_bytes"),
)
def wrong_sizes(bench: Bench) -> None:
    largest = bench.number("largest_image_bytes")
    good = len(bench.good_image)
    more = (good | 1 << bit for bit in _SIZE_BITS)
    sizes = (0, largest + 1, *(size for size in more if size > largest), 0xFFFF_FFFF)
    check_updates_rejected(bench, {f"{size} bytes": bench.encoder.update(size) for size in sizes})


@case(
    "UP-03",
    "update command to the running application",
    clause="R17",
    stimulus="update command, packet and end of transfer without a reset before",
    expectation="nothing erased; silence or general feedback (up_03)",
    requires={APPLICATION, DESTRUCTIVE},
    choices=("up_03",),
)
def without_reset(bench: Bench) -> None:
    image = bench.good_image
    choice = bench.choice("up_03")
    for step, frames in bench.encoder.upgrade_messages(len(image)).items():
        with bench.step(step), bench.tester.collecting_feedback():
            bench.send(frames)
            replies = bench.collect(bench.waits.silence_s)
            bench.judge.note_stimulus(heard=bool(replies))
            _check_answer(bench, replies, Reply.FEEDBACK, choice)
    bench.check_application()
    bench.judge.note_listening()
    with bench.step("after a restart"):
        bench.reset_to_bootloader()
        bench.collect(bench.waits.burst_s)
        bench.check_image(image)


@case(
    "UP-04",
    "when the update command is accepted",
    clause="Welling 5.1, figure 2 (begin); R2",
    stimulus="update command at each boot version, just before and just after the window's end",
    expectation="accepted inside the window; between the announcements and after the window as the "
    "profile says (up_04_burst, up_04)",
    requires={DESTRUCTIVE, TIMING},
    choices=("up_04", "up_04_burst", "limits.window_s"),
)
def window(bench: Bench) -> None:
    count = bench.number("versions")
    image = bench.good_image
    for version in range(1, count + 1):
        with bench.step(f"at boot version {version}"):
            _enter_at(bench, version)
            choice = bench.choice("up_04_burst") if version < count else "accepted"
            _offer_update(bench, choice)
    edge_s = bench.window_edge_s
    window_s = bench.limit("window_s")
    if bench.choice("up_04") == "either":
        with bench.step(f"{window_s * 500:g} ms after the last boot version"):
            _enter_at(bench, count)
            bench.wait(window_s / 2)
            _offer_update(bench, "accepted")
        return
    with bench.step("just before the window's end"):
        last_at = _enter_at(bench, count)
        frames = bench.encoder.update(len(image))
        wire_s = bench.tester.wire_s(frames, is_stuffed=True)
        bench.send(frames, at=last_at + window_s - edge_s - wire_s)
        _expect_request(bench)
        bench.finish(image)
    with bench.step("just after the window's end"):
        last_at = _enter_at(bench, count)
        bench.wait_until(last_at + window_s + edge_s)
        _offer_update(bench, bench.choice("up_04"))


@case(
    "UP-05",
    "update command repeated",
    clause="R2; R25; robustness, not in the document",
    stimulus="update command twice before request transfer; again before packet 1",
    expectation="request transfer once, or for each of them (up_05); the transfer starts at packet "
    "1 and ends well",
    requires={DESTRUCTIVE},
    choices=("up_05",),
)
def repeated(bench: Bench) -> None:
    image = bench.good_image
    update = bench.encoder.update(len(image))
    with bench.step("before request transfer"):
        bench.reset_to_window()  # for a device that listens there only (UP-04)
        bench.send(update + update)
        _expect_request(bench)
        _finish_requested(bench, bench.choice("up_05"))
    with bench.step("before packet 1"):
        bench.start_transfer(len(image))
        bench.send(update)
        _finish_requested(bench, "either")


@case(
    "UP-06",
    "update command that is not for this device",
    clause="Welling 5.2, table 8 (A10B); Welling 2.2.2, table 2",
    stimulus="names of other targets, each letter another one, small letters; payload too short, "
    "too long, longer than the command states; as a read; a valid one after other targets' names",
    expectation="rejected; the old application starts; the valid one is accepted",
    requires={APPLICATION, DESTRUCTIVE},
    choices=("up_02",),
)
def wrong_names(bench: Bench) -> None:
    encoder, size = bench.encoder, len(bench.good_image)
    own = encoder.update_text
    names = {f"name {other.update_text.decode()}": other.update_text for other in encoder.others()}
    for at in range(len(own)):
        name = own[:at] + b"X" + own[at + 1 :]
        names[f"name {name.decode()}"] = name
    names |= {"name in small letters": own.lower(), "name of zeros": bytes(7)}
    stimuli = {step: encoder.update(size, name) for step, name in names.items()}
    payload = own + size.to_bytes(4, "little")
    for step, mode, command, data in (
        ("payload too short", WRITE, 0xA10A, payload[:-1]),
        ("payload too long", WRITE, 0xA10C, payload + b"\0"),
        ("length greater by four", WRITE, UPDATE, payload + bytes(4)),
        ("as a read", READ, UPDATE, payload),
    ):
        stimuli[step] = encoder.message(mode, command, data)
    check_updates_rejected(bench, stimuli)
    with bench.step("names of other targets, then a valid update command"):
        others = (encoder.update(size, other.update_text) for other in encoder.others())
        probe = Probe(bench)
        probe.enter_after_rejected(*others)
        probe.send_next()


@case(
    "UP-08",
    "update command in the middle of a transfer",
    clause="R2; robustness, not in the document",
    stimulus="update command of the same size, and of another one, after packet 3; 24 in a row, "
    "each one after packet 1",
    expectation="starts over cleanly or rejects it (up_08), and never mixes two images",
    requires={DESTRUCTIVE},
    choices=("up_08",),
)
def in_transfer(bench: Bench) -> None:
    image = bench.firmware.good
    total = packet_count(len(image))
    if total <= _FIRST_PACKETS:
        bench.unsupported("a transfer of 4 packets or more", "the good image is too small")
        return
    starts_over = bench.choice("up_08") == "starts_over"
    if bench.choice("up_08") == "either":
        with bench.step("the same image"):
            starts_over = _starts_over(bench)
    for step, size in (("same size", len(image)), ("one packet less", len(image) - PACKET_BYTES)):
        with bench.step(step):
            begun_size = size if starts_over else len(image)
            begun = inverted(image[:begun_size]) if starts_over else image
            bench.start_transfer(begun_size)
            bench.packets(begun, 1, _FIRST_PACKETS)
            bench.send(bench.encoder.update(len(image) if starts_over else size))
            if starts_over:
                bench.expect(Reply.REQUEST)
                bench.finish(image)
            else:
                bench.expect_silence(ignoring=(Reply.NAK,), why="no request transfer")
                bench.finish(image, _FIRST_PACKETS + 1)
    if starts_over:
        with bench.step("many in a row"):
            short = bench.good_image
            bench.start_transfer(len(short))
            for _ in range(_MANY):
                bench.packet(short, 1)
                bench.send(bench.encoder.update(len(short)))
                bench.expect(Reply.REQUEST)
            bench.finish(short)


def _starts_over(bench: Bench) -> bool:
    """True when an update command during a transfer of the same image starts it over. Ends with the
    application running.
    """
    image, number = bench.firmware.good, _FIRST_PACKETS + 1
    bench.start_transfer(len(image))
    bench.packets(image, 1, _FIRST_PACKETS)
    bench.send(bench.encoder.update(len(image)))
    reply = bench.wait_for(Reply.REQUEST, within_s=bench.limit("pause_s") / 2)
    if reply is None:
        bench.send_packet(image, number)
        reply = bench.wait_for(Reply.ACK, Reply.REQUEST, within_s=bench.limit("erase_s"))
        if reply is not None and reply.kind is Reply.REQUEST:
            bench.collect(bench.limit("ack_s"))  # a NAK of the packet, which came too early
    found = bench.require_received(reply, "request transfer, or the transfer continues", 0.0)
    starts_over = found.kind is Reply.REQUEST
    bench.info("the device starts over" if starts_over else "the device continues")
    bench.finish(image, 1 if starts_over else number + 1)
    return starts_over


def _finish_requested(bench: Bench, choice: str) -> None:
    """Finish the transfer after a second update command: send packet 1 at request transfer, and
    again at a second one (R16); `choice` says how many may come.
    """
    image, erase_s = bench.good_image, bench.limit("erase_s")
    # It may erase again first. Where it need not, a later request is met after packet 1.
    within_s = erase_s if choice == "each" else bench.waits.settle_s
    again = bench.wait_for(*Reply, within_s=within_s, unlike=_is_version)
    replies = [] if again is None else [again]
    bench.check_only(replies, Reply.REQUEST, why="request transfer, or nothing")
    more = sum(one.kind is Reply.REQUEST for one in replies)
    if choice == "each":
        bench.require(more == 1, "request transfer twice", "twice" if more else "once")
    copies = 0
    acknowledged: Received | None = None
    while acknowledged is None:
        copies += 1
        sent = bench.send_packet(image, 1)
        found = bench.wait_for(Reply.ACK, Reply.REQUEST, within_s=erase_s)
        found = bench.require_received(found, "ACK 1, or request transfer", erase_s)
        if found.kind is Reply.ACK:
            acknowledged = found
        else:
            more += 1
            bench.require(more <= 1, "request transfer at most twice", f"{more + 1} times")
    bench.require(acknowledged.number == 1, "ACK 1", acknowledged)
    if copies == 1:
        bench.measure(TimeName.ANSWER, acknowledged.at - sent.left_at)
    else:  # each of them may be answered (R10)
        late = bench.collect(sent.left_at + bench.limit("ack_s") - bench.now)
        bench.check_only(late, Reply.ACK, Reply.NAK, why="answers to packet 1")
    if choice == "once":
        bench.check(not more, "request transfer once", "twice" if more else "once")
    bench.finish(image, 2)


def _is_version(one: Received) -> bool:
    return one.kind is Reply.BOOT_VERSION


def _offer_update(bench: Bench, choice: str) -> None:
    """Send an update command for the good image, accepted or rejected as `choice` says; then check
    that the old or new application runs.
    """
    image, limit = bench.good_image, bench.limit
    bench.send(bench.encoder.update(len(image)))
    if choice == "accepted":
        _expect_request(bench)
        bench.finish(image)
        return
    # A device that accepted it against the profile has no application when this time is over.
    within_s = limit("erase_s") if choice == "either" else bench.waits.silence_s
    request = bench.wait_for(Reply.REQUEST, within_s=within_s)
    ok = request is None or choice == "either"
    bench.check(ok, f"update command {choice}", request or "no request transfer")
    if request is None:
        bench.check_application()
    else:
        bench.finish(image)


def _expect_request(bench: Bench) -> None:
    """Expect request transfer, ignoring boot versions still on their way."""
    bench.expect(Reply.REQUEST, ignoring=(Reply.BOOT_VERSION,))


def _enter_at(bench: Bench, version: int) -> float:
    """Reset, wait for boot version number `version` of the burst (from 1) and return its time."""
    reply = bench.reset_to_bootloader()
    for _ in range(version - 1):
        reply = bench.next_version()
    return reply.at


def check_updates_rejected(bench: Bench, stimuli: Mapping[str, list[RawFrame]]) -> None:
    """Send these frames to the listening bootloader, by the names of their steps, and check that it
    does not request the transfer, answers as up_02 says, and starts the old application.

    A valid update command, sent at the same moment after a reset, shows that it listens then.
    """
    for step, frames in stimuli.items():
        # To an unknown command or a read, silence is always right (FR-10).
        is_update = joined(frames).startswith(_UPDATE_HEAD)
        choice = bench.choice("up_02") if is_update else "either"
        _check_update_rejected(bench, step, frames, choice)
    with bench.step("a valid update command at the same moment"):
        bench.reset_to_window()
        bench.send(bench.encoder.update(len(bench.good_image)))
        listens = bench.wait_for(Reply.REQUEST) is not None
        bench.judge.note_listening(listens=listens)
        if listens:
            bench.finish(bench.good_image)


def _check_update_rejected(bench: Bench, step: str, frames: list[RawFrame], choice: str) -> None:
    with bench.step(step):
        bench.reset_to_window()
        bench.send(frames)
        replies = bench.collect(bench.waits.burst_s + bench.waits.silence_s)
        answers = [one for one in replies if not _is_version(one)]
        bench.judge.note_stimulus(heard=bool(answers))
        _check_answer(bench, answers, Reply.NAK, choice, "rejected by ")
        bench.check_image(bench.good_image)


def _check_answer(
    bench: Bench, answers: list[Received], kind: Reply, choice: str, prefix: str = ""
) -> None:
    """Check for one message of `kind` or none, as `choice` says: "silence", "either" or a word for
    the message.
    """
    counts = {"silence": (0,), "either": (0, 1)}.get(choice, (1,))
    wanted = {"silence": "silence", "either": f"{kind.value} or silence"}.get(choice, kind.value)
    ok = len(answers) in counts and all(one.kind is kind for one in answers)
    bench.check(ok, f"{prefix}{wanted}", describe(answers))
