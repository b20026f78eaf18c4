"""BU: bus faults.

Frames are lost, doubled, delayed and swapped one at a time; the device goes bus-off; another node
uses the device's id.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, Requirement, case
from flasher.conformance.patient_host import is_leftover
from flasher.conformance.tester import FaultKind, LineFault, Sent
from flasher.conformance.wire import (
    ACK,
    FEEDBACK,
    REQUEST,
    RawFrame,
    Received,
    Reply,
    describe,
    packet_count,
)

_ENTRIES_MAX: Final = 60
"""Resets and update commands to try before giving up on entering a transfer."""
_ANSWER_FRAMES: Final = 2
"""General feedback, ACK and complete have two frames each."""
_OFF_BUS_S: Final = 0.2
_BACK_ON_BUS_S: Final = 1.1 * _OFF_BUS_S
_POLL_S: Final = 0.0002
"""Shorter than a frame, so that an answer can be interrupted halfway."""
_REPORTS_AT_ONCE: Final = 4


# -- faults of a message ---------------------------------------------------------------------------

_Sending = Callable[[Bench, Sequence[RawFrame]], AbstractContextManager[Sent]]


class _Disturbance(NamedTuple):
    """A fault during one message: `send` is a context manager that sends the message; the answer is
    awaited inside it.
    """

    name: str
    send: _Sending
    hits_answer: bool = False
    """True when the message itself arrives, so that the device continues."""


_PendingFaults = dict[str, deque[_Disturbance]]
"""Faults still to be applied to each message, in order."""


@contextmanager
def _faulty(
    bench: Bench, frames: Sequence[RawFrame], faults: Sequence[LineFault] = ()
) -> Iterator[Sent]:
    """Send a message while `faults` apply to it and its answer."""
    with bench.disturb(*faults):
        yield bench.send(frames)


_UNDISTURBED: Final = _Disturbance("", _faulty)


@contextmanager
def _off_bus_after(bench: Bench, frames: Sequence[RawFrame], after: int) -> Iterator[Sent]:
    """Send a message; the device goes bus-off after `after` of its frames."""
    bench.send(frames[:after])
    bench.subject.bus_off(_OFF_BUS_S)
    yield bench.send(frames[after:])


@contextmanager
def _off_bus_in_answer(bench: Bench, frames: Sequence[RawFrame]) -> Iterator[Sent]:
    """Send a message; the device goes bus-off during its answer."""
    before = bench.tester.frames_received
    sent = bench.send(frames)
    give_up_at = bench.now + bench.limit("ack_s")
    while bench.tester.frames_received == before and bench.now < give_up_at:
        bench.wait(_POLL_S)
    bench.subject.bus_off(_OFF_BUS_S)
    yield sent


# -- the cases -----------------------------------------------------------------------------------


@case(
    "BU-01",
    "frames lost, doubled, late and swapped",
    clause="R10; R12",
    stimulus="each frame of reset, update command, packet and end of transfer dropped, doubled, "
    "delayed and swapped with the next one, in turn; frames of the answers dropped and doubled",
    expectation="the upgrade by a patient host completes correctly, or is refused explicitly",
    requires={DESTRUCTIVE, LONG},
    upgrades=200,
)
def disturbed_frames(bench: Bench) -> None:
    delay_s = 1.5 * bench.limit("inter_frame_s")

    def faults(frames: int) -> Iterator[LineFault]:
        for index in range(frames):
            yield LineFault(FaultKind.DROP, index)
            yield LineFault(FaultKind.DOUBLE, index)
            if index:
                yield LineFault(FaultKind.DELAY, index, delay_s=delay_s)
                yield LineFault(FaultKind.SWAP, index - 1)
        for index in range(_ANSWER_FRAMES):
            for kind in (FaultKind.DROP, FaultKind.DOUBLE):
                yield LineFault(kind, index, incoming=True)

    def disturbances(frames: int) -> Iterator[_Disturbance]:
        for fault in faults(frames):
            faulty = partial(_faulty, faults=(fault,))
            yield _Disturbance(str(fault), faulty, fault.incoming)

    _upgrade_disturbed(bench, disturbances)


@case(
    "BU-02",
    "the device goes bus-off",
    clause="robustness, not in the document",
    stimulus="the device's controller leaves the bus for 0.2 s before, between and after the "
    "frames of every message, and in the middle of its answers; from a power-up on, for as long "
    "as its application takes to start",
    expectation="the device recovers, and the upgrade by a patient host completes correctly; alone "
    "on the bus, where no frame of it is acknowledged, it starts its application too",
    requires={DESTRUCTIVE, Requirement.BUS_OFF},
    upgrades=200,
)
def bus_off(bench: Bench) -> None:
    def disturbances(frames: int) -> Iterator[_Disturbance]:
        for after in range(frames + 1):
            name = f"bus-off after {after} of {frames} frames"
            send = partial(_off_bus_after, after=after)
            yield _Disturbance(name, send, hits_answer=after == frames)
        yield _Disturbance(
            "bus-off in the middle of the answer", _off_bus_in_answer, hits_answer=True
        )

    _upgrade_disturbed(bench, disturbances)
    with bench.step("off the bus from a power-up on"):
        if not bench.subject.has_power:
            bench.unsupported("the application starts", "needs power control")
            return
        off_s = bench.waits.restart_s
        bench.power_cycle()
        bench.subject.bus_off(off_s)
        bench.wait(off_s / 2)
        bench.forget()
        replies = bench.collect(off_s / 2 + bench.waits.burst_s)
        versions = [one for one in replies if one.kind is Reply.BOOT_VERSION]
        bench.check(not versions, "the application runs by then", describe(versions))
        bench.check_application()


@case(
    "BU-06",
    "another node uses the device's id",
    clause="Welling 2.2.2, table 2; robustness, not in the document",
    stimulus="answers from another node on the device's own id, before its answer to each message "
    "and between two of them",
    expectation="the device ignores them, or recovers afterwards",
    requires={DESTRUCTIVE},
)
def same_id(bench: Bench) -> None:
    image = bench.good_image
    with bench.step("to the application"):
        _answer_as_device(bench)
        bench.check_application()
    with bench.step("to the announcing bootloader"):
        bench.reset_to_bootloader()
        _answer_as_device(bench)
        bench.update(len(image))
    with bench.step("in the transfer"):
        for number in range(1, packet_count(len(image)) + 1):
            if number <= _REPORTS_AT_ONCE:
                _answer_as_device(bench)
            bench.packet(image, number)
        bench.end_transfer()
        bench.check_image(image)


# -- an upgrade in which something happens to every message --------------------------------------


def _upgrade_disturbed(bench: Bench, make: Callable[[int], Iterator[_Disturbance]]) -> None:
    """Repeat the upgrade until every fault was applied, at most one per message."""
    image, encoder = bench.good_image, bench.encoder
    left: _PendingFaults = {
        "reset": deque(make(len(encoder.reset()))),
        "update command": deque(make(len(encoder.update(len(image))))),
        "packet": deque(make(len(encoder.packet_of(image, 1)))),
        "end of transfer": deque(make(len(encoder.end()))),
    }
    for _ in range(1 + max(map(len, left.values()))):
        if not any(left.values()):
            break
        _enter(bench, image, left)
        if _send_packets(bench, image, left) and _end(bench, image, left):
            bench.check_image(image)
    done = not any(left.values())
    bench.check(done, "the upgrades are completed", "the device restarts in each one")


def _next(left: _PendingFaults, message: str) -> _Disturbance:
    """Take the next fault for this message, or an undisturbed send when none is left."""
    return left[message].popleft() if left[message] else _UNDISTURBED


def _enter(bench: Bench, image: bytes, left: _PendingFaults) -> None:
    """Send reset and update command until request transfer. A device that received only part of
    them may announce, run, erase or wait for packet 1, but has to request the transfer in the end.
    """
    limit = bench.limit
    names: list[str] = []
    reply: Received | None = None
    message = "reset"
    bench.forget()
    for _ in range(_ENTRIES_MAX):
        disturbance = _next(left, message)
        names += [f"{message}, {disturbance.name}"] if disturbance.name else []
        if message == "reset":
            within_s = limit("feedback_s") if disturbance.name else limit("first_version_s")
            with disturbance.send(bench, bench.encoder.reset()):
                reply = bench.wait_for(Reply.BOOT_VERSION, Reply.REQUEST, within_s=within_s)
            if reply is not None and reply.kind is Reply.REQUEST:
                # It may have come while the reset was being sent, which may restart the device.
                restart_s = {"ignored": 0.0, "restarts": limit("first_version_s")}.get(
                    bench.choice("tx_13"), bench.waits.silence_in_transfer_s
                )
                reply = bench.wait_for(Reply.BOOT_VERSION, within_s=restart_s) or reply
        else:
            within_s = bench.waits.burst_s if disturbance.name else limit("erase_s")
            with disturbance.send(bench, bench.encoder.update(len(image))) as sent:
                reply = bench.host.request_or_version(sent.left_at, within_s)
            # The device may still be in the bootloader: request transfer may be lost (UP-05).
            if reply is None and not (
                bench.encoder.has_version_query and bench.application_version() is not None
            ):
                sent = bench.send(bench.encoder.update(len(image)))
                reply = bench.host.request_or_version(sent.left_at, bench.waits.silence_s)
        if reply is not None and reply.kind is Reply.REQUEST:
            break
        # A device that ignores the reset may wait for packet 1: request transfer was lost (R26).
        is_deaf = message == "reset" and not disturbance.name
        message = "update command" if reply is not None or is_deaf else "reset"
    with bench.step("; ".join(names) or "undisturbed"):
        is_there = reply is not None and reply.kind is Reply.REQUEST
        bench.require(is_there, Reply.REQUEST.value, reply or "nothing after many tries")


def _send_packets(bench: Bench, image: bytes, left: _PendingFaults) -> bool:
    """Send every packet, first with its fault, then undisturbed until it is acknowledged. False
    when the device announced a restart: the upgrade starts over (R11).
    """
    total, began_at = packet_count(len(image)), bench.now
    kinds = (Reply.ACK, Reply.NAK, Reply.BOOT_VERSION)
    leftovers: list[Received] = []

    def is_old(one: Received) -> bool:
        if is_leftover(one, began_at):
            leftovers.append(one)
        return one in leftovers

    for number in range(1, total + 1):
        disturbance = _next(left, "packet")
        with bench.step(f"packet {number}, {disturbance.name}" if disturbance.name else "packets"):
            with disturbance.send(bench, bench.encoder.packet_of(image, number)):
                reply = bench.wait_for(*kinds, unlike=is_old)
            last = ""
            if reply is not None and reply.kind is Reply.BOOT_VERSION:
                last = str(reply)  # request transfer came while a reset was being sent
            elif reply is None or reply.kind is not Reply.ACK or reply.number != number:
                last = bench.host.deliver_packet(image, number, began_at)
            if last and leftovers and number == 1 and bench.profile.allows("tx_13", "restarts"):
                # A reset sent before that waited for the end of the erase: it was no leftover.
                last = str(leftovers[0])
            if last.startswith(Reply.BOOT_VERSION.value):
                bench.info(f"the device restarts: {disturbance.name}")
                return False
            if disturbance.name or last:
                bench.require(not last, f"ACK {number} in the end", last or "it")
    return True


def _end(bench: Bench, image: bytes, left: _PendingFaults) -> bool:
    """Send end of transfer with one fault after another until it is answered. False when the device
    rejected the image explicitly, with two NAKs (R6).
    """
    names: list[str] = []
    reply: Received | None = None
    # Stop before the device takes the silence for a pause in the transfer (TX-12).
    give_up_at = bench.now + bench.limit("pause_s") / 2
    while reply is None and bench.now < give_up_at and left["end of transfer"]:
        disturbance = _next(left, "end of transfer")
        names.append(disturbance.name)
        with disturbance.send(bench, bench.encoder.end()):
            # Until no partial message is left, and it is back on the bus.
            left_s = max(give_up_at - bench.now, bench.waits.incomplete_s, _BACK_ON_BUS_S)
            within_s = min(bench.waits.silence_s, left_s)
            reply = bench.wait_for(Reply.COMPLETE, Reply.NAK, within_s=within_s)
        if disturbance.hits_answer:
            break
    if reply is not None and reply.kind is Reply.COMPLETE:
        return True
    with bench.step("; ".join(names) or "end of transfer"):
        done = bench.host.deliver_end(image)
    if not done.ok:
        bench.info(f"{done.reason}: {'; '.join(names)}")
    return "rejected" not in done.reason


# -- another device -------------------------------------------------------------------------------


def _answer_as_device(bench: Bench) -> None:
    """Send complete answers, and the first frame of another, on the device's own id."""
    answer = bench.encoder.answer
    for command, data in ((FEEDBACK, b"ACK"), (REQUEST, bytes(2)), (ACK, b"\x01\x00")):
        bench.send(answer(command, data))
    bench.send(answer(ACK, b"\x02\x00")[:1])
