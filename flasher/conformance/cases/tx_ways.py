"""TX, the end of it: what becomes of a transfer in which nothing comes, or a reset."""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.tx import transfer_image
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, case
from flasher.conformance.wire import (
    Kind,
    packet_count,
)

_PACKETS: Final = 3
"""Packets of a transfer that is only begun."""
_PLACES: Final = (0, 1, _PACKETS)
"""Packets stored when it happens: before the first one, amid them, before the end."""
_SHORT: Final = 0.5
"""A pause that is no pause, as a part of limits.pause_s."""
_LONG: Final = 1.5
_JUST_NOT: Final = 0.9


@case(
    "TX-12",
    "pause in a transfer",
    clause="R12, R14",
    stimulus="half of limits.pause_s before a packet; more than it before packet 1, amid the "
    "packets and before the end",
    expectation="announces again, or waits on (tx_12); reachable in both",
    requires={DESTRUCTIVE, LONG},
    choices=("tx_12",),
)
def pause(bench: Bench) -> None:
    if bench.choice("tx_12") == "announces":
        _announces(bench)
    else:
        _waits(bench)


def _announces(bench: Bench) -> None:
    image = bench.filler(_PACKETS)[:-1]
    pause_s = bench.limit("pause_s")
    bench.start_transfer(len(image))
    with bench.step("a short pause"):
        bench.wait(_SHORT * pause_s)
        bench.packet(image, 1)
    for stored in _PLACES[1:] + _PLACES[:1]:
        with bench.step(f"a pause after packet {stored}" if stored else "a pause before packet 1"):
            bench.packets(image, _next(bench, image, stored), stored)
            began_at = bench.now
            heard = bench.expect(
                Kind.BOOT_VERSION, within_s=pause_s + bench.limit("first_version_s")
            )
            bench.measure("pause to boot version", heard.at - began_at)
    with bench.step("upgrade after the pauses"):
        bench.update(len(bench.good_image))
        bench.finish(bench.good_image)


def _next(bench: Bench, image: bytes, stored: int) -> int:
    """The packet to go on with: the short pause left packet 1 stored, a long one ended all."""
    if stored == _PLACES[1]:
        return stored + 1
    bench.update(len(image))
    return 1


def _waits(bench: Bench) -> None:
    image = transfer_image(bench)
    total = packet_count(len(image))
    pause_s = _LONG * bench.limit("pause_s")
    bench.start_transfer(len(image))
    done = 0
    for stored in (0, 1, total):
        bench.packets(image, done + 1, stored)
        done = stored
        with bench.step(f"a pause after packet {stored}" if stored else "a pause before packet 1"):
            bench.expect_silence(pause_s)
    bench.finish(image, total + 1)
    with bench.step("a new upgrade after a pause"):
        if bench.choice("up_08") == "starts_over":
            bench.start_transfer(len(image))
            bench.expect_silence(pause_s)
            bench.update(len(image))
        elif bench.choice("tx_13") == "restarts" or bench.subject.has_power:
            bench.start_transfer(len(image))
            bench.expect_silence(pause_s)
            bench.leave_transfer()
            bench.update(len(image))
        else:
            bench.unsupported("a new upgrade", "only power ends a transfer of this product")
            return
        bench.finish(image)


@case(
    "TX-13",
    "reset in a transfer",
    clause="R18",
    stimulus="reset before packet 1, amid the packets and before the end",
    expectation="ignored, or restarts (tx_13); a new upgrade succeeds",
    requires={DESTRUCTIVE},
    choices=("tx_13",),
)
def reset(bench: Bench) -> None:
    ignored = bench.choice("tx_13") == "ignored"
    image = transfer_image(bench) if ignored else bench.filler(_PACKETS)[:-1]
    total = packet_count(len(image))
    within_s = bench.limit("first_version_s")
    if bench.choice("tx_12") == "announces":
        # Later than that, it is the pause that ends the transfer.
        within_s = min(within_s, _JUST_NOT * bench.limit("pause_s"))
    bench.start_transfer(len(image))
    done = 0
    for stored in (0, 1, total):
        with bench.step(f"reset after packet {stored}" if stored else "reset before packet 1"):
            if stored and not ignored:
                bench.update(len(image))
                done = 0
            bench.packets(image, done + 1, stored)
            done = stored
            bench.send(bench.encoder.reset())
            if ignored:
                bench.expect_silence(why="silence, no restart")
            else:
                bench.expect(Kind.BOOT_VERSION, within_s=within_s, ignoring=(Kind.FEEDBACK,))
    if ignored:
        bench.finish(image, total + 1)
    with bench.step("a new upgrade"):
        if ignored:
            bench.reset_to_bootloader()
        bench.update(len(bench.good_image))
        bench.finish(bench.good_image)
