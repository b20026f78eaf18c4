"""PW: power cuts. Whatever the moment, no mixture of two images is ever started, and the device is
reachable again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.pw_cuts import (
    FAR_PACKET,
    PACKET_FRAMES,
    Cut,
    cuts_at_frames,
    name_of,
)
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, POWER, case
from flasher.conformance.wire import (
    PACKET_BYTES,
    Kind,
    Received,
    packet_count,
    version_in,
)

_OFF_S: Final = 0.3
_SHARES: Final = (0.0, 0.5, 1.0)
"""Before a flash operation, in its middle, and when it is over."""
_OPERATIONS_MAX: Final = 24
"""Operations of one upgrade that are cut; a large image has more, which are alike."""


@dataclass
class _World:
    """The images of a case and how far the upgrade went that was cut."""

    old: bytes
    new: bytes
    end_was_sent: bool = False
    runs: bool = True
    """True while an application runs, so that the way into the bootloader is a reset."""

    def turn(self) -> None:
        """The new image runs; the next upgrade is back to the other one."""
        self.old, self.new = self.new, self.old


@case(
    "PW-01",
    "power cuts in an upgrade",
    clause="R14, R19",
    stimulus="power cut at the frames of reset, update command, packets and end of transfer; "
    "before, in and after every flash operation",
    expectation="the device announces itself again, starts nothing but a whole image, and can be "
    "upgraded; what was acknowledged is stored",
    requires={DESTRUCTIVE, POWER, LONG},
    choices=("rs_03",),
    limit_s=7200.0,
)
def cuts(bench: Bench) -> None:
    world = _world(bench)
    _say_what_is_not_judged(bench, world)
    for frames in range(1, len(bench.encoder.reset()) + 1):
        with bench.step(f"after frame {frames} of reset"):
            bench.send(bench.encoder.reset()[:frames])
            _cut(bench)
            _check_after_cut(bench, world)
    total = packet_count(len(world.new))
    for cut in cuts_at_frames(bench, world.new):
        with bench.step(name_of(cut, total)):
            _go_to(bench, world, cut)
            _cut(bench)
            _check_after_cut(bench, world)
    _cut_operations(bench, world)
    _cut_after_ack(bench, world)
    _check_upgrade(bench)


@case(
    "PW-02",
    "a second power cut, in the rescue",
    clause="R14, R19",
    stimulus="power cut in a transfer, and again: during the announcements, the erase, a packet, "
    "between two of them, before and at end of transfer",
    expectation="the device announces itself again, starts nothing but a whole image, and can be "
    "upgraded",
    requires={DESTRUCTIVE, POWER, LONG},
    choices=("rs_03",),
    limit_s=3600.0,
)
def second_cut(bench: Bench) -> None:
    world = _world(bench)
    _say_what_is_not_judged(bench, world)
    total = packet_count(len(world.new))
    update, end = len(bench.encoder.update(1)), len(bench.encoder.end())
    second = [Cut(0, 1), Cut(0, update), Cut(1, 9), Cut(1, PACKET_FRAMES)]
    if total <= FAR_PACKET:
        second += [Cut(total, PACKET_FRAMES), Cut(total + 1, end - 1), Cut(total + 1, end)]
    for cut in second:
        with bench.step("first cut"):
            _go_to(bench, world, Cut(1, 9))
            _cut(bench)
            heard = bench.wait_for(Kind.BOOT_VERSION, within_s=bench.limit("first_version_s"))
            bench.require_received(heard, Kind.BOOT_VERSION.value, bench.limit("first_version_s"))
        with bench.step(f"second cut {name_of(cut, total)}"):
            world.runs = False
            _go_to(bench, world, cut)
            _cut(bench)
            _check_after_cut(bench, world)
    _check_upgrade(bench)


# -- the images -----------------------------------------------------------------------------------


def _world(bench: Bench) -> _World:
    """From the good image to another one where there is one, so that they can be told apart."""
    has_other = bench.subject.second_image is not None
    return _World(bench.good_image, bench.second_image() if has_other else bench.good_image)


def _say_what_is_not_judged(bench: Bench, world: _World) -> None:
    same = version_in(world.old) == version_in(world.new) or version_in(world.old) is None
    if not bench.subject.has_readback and (same or not bench.encoder.has_version_query):
        bench.unsupported(
            "what runs after a cut is a whole image",
            "it takes readback, or a version query and two images of different versions",
        )


# -- an upgrade up to the cut ---------------------------------------------------------------------


def _enter(bench: Bench, world: _World) -> None:
    """Request transfer, from the application or from a bootloader that waits for it."""
    world.end_was_sent = False
    if world.runs:
        bench.reset_to_bootloader()
    bench.update(len(world.new))
    world.runs = False


def _go_to(bench: Bench, world: _World, cut: Cut) -> None:
    """The upgrade up to those frames."""
    total, words = packet_count(len(world.new)), bench.encoder
    if not cut.packet:
        if world.runs:
            bench.reset_to_bootloader()
        bench.send(words.update(len(world.new))[: cut.frames])
        return
    _enter(bench, world)
    bench.packets(world.new, 1, min(cut.packet - 1, total))
    if cut.packet > total:
        world.end_was_sent = True
        bench.send(words.end()[: cut.frames])
    else:
        part = world.new[(cut.packet - 1) * PACKET_BYTES :][:PACKET_BYTES]
        frames = words.packet(cut.packet, total, part.ljust(PACKET_BYTES, b"\xff"))
        bench.send(frames[: cut.frames])


def _cut(bench: Bench) -> None:
    """Power off and on."""
    bench.power_cycle(_OFF_S)


def _check_upgrade(bench: Bench) -> None:
    """From a power-up, as a bootloader that only listens ignores the reset of a host (rs_03)."""
    with bench.step("afterwards"):
        _cut(bench)
        bench.check_upgrade()


def _check_after_cut(bench: Bench, world: _World, first: Received | None = None) -> None:
    """The device announces itself (`first` was heard), or starts an application, but only a whole
    one.
    """
    limit = bench.limit
    within_s = limit("first_version_s")
    if first is None:
        first = bench.wait_for(Kind.BOOT_VERSION, within_s=within_s)
    if first is None:
        # That it should have announced itself is another case (RS-05).
        world.runs = _check_whole(bench, world)
        bench.require(world.runs, Kind.BOOT_VERSION.value, "neither that nor an application")
        return
    spacing_s = limit("version_spacing_s") + limit("version_spacing_tolerance_s")
    heard = bench.collect(bench.host.burst_s + 2 * spacing_s)
    announced = 1 + sum(one.kind is Kind.BOOT_VERSION for one in heard)
    # More than a burst: it has nothing to start.
    world.runs = announced <= bench.number("versions") and _check_whole(bench, world)
    if not world.runs:
        bench.check(True, "no application is started", "none")  # noqa: FBT003


def _check_whole(bench: Bench, world: _World) -> bool:
    """What runs is the old image, or the new one that was sent to its end; false when nothing
    runs.
    """
    images = [world.old, world.new] if world.end_was_sent else [world.old]
    if bench.encoder.has_version_query:
        version = bench.application_version(bench.limit("start_s"))
        if version is None:
            return False
        known = [version_in(image) for image in images]
        expected = f"a whole image runs, of version {' or '.join(map(str, known))}"
        bench.require(None in known or version in known, expected, f"version {version!a}")
        images = [image for image in images if version_in(image) in (None, version)]
    elif not bench.application_runs():
        return False
    if bench.subject.has_readback:
        stored = bench.subject.readback()
        images = [image for image in images if stored[: len(image)] == image]
        got = "a whole one" if images else "a mixture"
        bench.require(bool(images), "the flash holds a whole image", got)
    if images == [world.new]:
        world.turn()
    return True


# -- in the flash ---------------------------------------------------------------------------------


def _cut_operations(bench: Bench, world: _World) -> None:
    """A cut before, in and after each operation, until an upgrade has no more of them."""
    if not bench.subject.has_timed_cuts:
        bench.unsupported(
            "power cuts before, in and after every flash operation",
            "nobody sees from outside when one is under way",
        )
        return
    for operation in range(_OPERATIONS_MAX):
        for share in _SHARES:
            with bench.step(f"flash operation {operation + 1}, {share:.0%} of it done"):
                if world.runs:
                    bench.reset_to_bootloader()
                world.end_was_sent = False
                bench.subject.cut_in_operation(operation, share, _OFF_S)
                version = _upgrade_until_cut(bench, world)
                if not bench.subject.take_cut():
                    # Whole, and not cut: what it left is for EN-01 and EN-07 to judge.
                    world.runs = bench.application_runs()
                    world.turn()
                    return
                _check_after_cut(bench, world, version)


def _upgrade_until_cut(bench: Bench, world: _World) -> Received | None:
    """Go on until the device announces itself again, and return that; None at the very end."""
    limit = bench.limit
    back_s = _OFF_S + limit("first_version_s")
    bench.forget()
    sent = bench.send(bench.encoder.update(len(world.new)))
    heard = bench.host.request_or_version(sent.left_at, limit("erase_s") + back_s)
    for number in range(1, packet_count(len(world.new)) + 1):
        if heard is None or heard.kind is Kind.BOOT_VERSION:
            return heard
        bench.send_packet(world.new, number)
        heard = bench.wait_for(Kind.ACK, Kind.BOOT_VERSION, within_s=limit("ack_s") + back_s)
    if heard is None or heard.kind is Kind.BOOT_VERSION:
        return heard
    world.end_was_sent = True
    bench.send(bench.encoder.end())
    heard = bench.wait_for(Kind.COMPLETE, Kind.BOOT_VERSION, within_s=limit("complete_s") + back_s)
    return heard if heard is not None and heard.kind is Kind.BOOT_VERSION else None


def _cut_after_ack(bench: Bench, world: _World) -> None:
    """What the device says it has received correctly is not lost with the power (R10)."""
    written = 2 * PACKET_BYTES
    last = packet_count(written + bench.number("buffer_bytes"))
    with bench.step(f"after ACK {last}"):
        if not bench.subject.has_readback or packet_count(len(world.new)) <= last:
            why = f"it takes readback and {last + 1} packets"
            bench.unsupported("what was acknowledged is stored", why)
            return
        _enter(bench, world)
        bench.packets(world.new, 1, last)
        bench.power_off()
        is_there = bench.subject.readback()[:written] == world.new[:written]
        got = "they are" if is_there else "they are not"
        bench.check(is_there, "the first two packets are in the flash", got)
        bench.wait(_OFF_S)
        bench.forget()
        bench.power_on()
        _check_after_cut(bench, world)
