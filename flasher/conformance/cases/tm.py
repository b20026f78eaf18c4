"""TM: timing. TM-01, TM-03 and TM-04 concern the host."""

from __future__ import annotations

from itertools import pairwise
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.probe import ACCEPTED, EITHER, Probe
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, TIMING, case
from flasher.conformance.judge import TimeName
from flasher.conformance.wire import PACKET_FRAMES, Received, Reply, packet_count

_SHARES: Final = (0.0, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9)
_RESETS: Final = 5
_PACKETS: Final = 64
"""Smallest number of packets that shows the distribution of answer times."""
_REST: Final = bytes(5)
"""Makes the image not a whole number of packets; UP-01 covers that."""
_PATIENCE: Final = 3
"""Wait this many times the limit for a late answer, so that the report shows its time."""


@case(
    "TM-02",
    "gap between the frames of a message",
    clause="R12",
    stimulus="packets with gaps between their frames, from 0 to just below the inter-frame timeout",
    expectation="accepted up to it (tm_02)",
    requires={DESTRUCTIVE, TIMING},
    choices=("tm_02", "limits.inter_frame_s"),
)
def gaps(bench: Bench) -> None:
    limit_s = bench.limit("inter_frame_s")
    wanted = ACCEPTED if bench.choice("tm_02") == "accepted" else EITHER
    probe = Probe(bench)
    probe.begin()
    for gap_s, gaps in bench.gaps(probe.frames(), _SHARES):
        with bench.step(f"{gap_s * 1000:.1f} ms"):
            began_at = bench.tester.elapsed_s
            taken = probe.offer(probe.frames(), EITHER, gap_s=gap_s, gaps=gaps)
            sent = [one.at_s for one in bench.tester.trace if one.sent and one.at_s > began_at]
            pairs = pairwise(sent[:PACKET_FRAMES])  # of the packet, as it was on the bus
            widest_s = max(after - before for before, after in pairs)
            bench.info(f"gap of {gap_s * 1000:.1f} ms: {'accepted' if taken else 'rejected'}")
            if wanted == EITHER:
                continue
            if widest_s < limit_s - bench.port.uncertainty_s:
                got = "accepted" if taken else "no ACK"
                expected = f"accepted with frames {widest_s * 1000:.1f} ms apart at most"
                bench.check(taken, expected, got)
            else:
                got = f"a frame was sent {widest_s * 1000:.1f} ms after the previous one"
                bench.unsupported(f"frames less than {limit_s * 1000:g} ms apart", got)
    probe.check_stored()


@case(
    "TM-05",
    "times of an upgrade",
    clause="Welling 5.1, figure 2 (begin); R12",
    stimulus="a transfer of many packets, an upgrade, and some resets",
    expectation="each time within the profile's limits: reset to the first boot version, their "
    "spacing, update command to request transfer, packet to ACK, end of transfer to complete",
    requires={DESTRUCTIVE, TIMING, LONG},
)
def times(bench: Bench) -> None:
    image = bench.good_image
    bench.reset_measured(_PATIENCE * bench.limit("first_version_s"))
    if packet_count(len(image)) < _PACKETS:
        with bench.step("transfer of many packets"):
            filler = (bench.filler(_PACKETS) + _REST)[: bench.number("largest_image_bytes")]
            bench.update(len(filler))
            measure_packets(bench, filler)
            bench.restart_transfer(len(image))
    else:
        bench.update(len(image))
    with bench.step("upgrade"):
        measure_packets(bench, image)
        measure_end(bench)
    for turn in range(_RESETS):
        # EN-01 and RS-03 check that it starts each time; judge the times measured so far.
        if not bench.application_runs():
            break
        with bench.step(f"reset {turn + 1}"):
            measure_burst(bench)
    check_times(bench)


def check_times(bench: Bench) -> None:
    """Compare all measured times with the profile's limits."""
    check, limit = bench.judge.check_measured, bench.limit
    spacing_s, tolerance_s = limit("version_spacing_s"), limit("version_spacing_tolerance_s")
    check(TimeName.FIRST, high_s=limit("first_version_s"))
    if bench.number("versions") > 1:
        check(TimeName.SPACING, low_s=spacing_s - tolerance_s, high_s=spacing_s + tolerance_s)
    check(TimeName.REQUEST, high_s=limit("erase_s"))
    check(TimeName.ANSWER, high_s=limit("ack_s"))
    check(TimeName.COMPLETE, high_s=limit("complete_s"))


def measure_burst(bench: Bench, *, wait: bool = True) -> Received:
    """Reset and measure the burst. Returns its last boot version, with `wait` after the burst."""
    last = bench.reset_measured(_PATIENCE * bench.limit("first_version_s"))
    for _ in range(bench.number("versions") - 1):
        within_s = _PATIENCE * bench.limit("version_spacing_s")
        reply = bench.wait_for(Reply.BOOT_VERSION, within_s=within_s)
        if reply is None:
            break
        bench.measure(TimeName.SPACING, reply.at - last.at)
        last = reply
    if wait:
        bench.collect(bench.waits.burst_s)
    return last


def measure_packets(bench: Bench, image: bytes) -> None:
    """Send all packets of `image` and measure each ACK."""
    limit_s = _PATIENCE * bench.limit("ack_s")
    for number in range(1, packet_count(len(image)) + 1):
        sent = bench.send_packet(image, number)
        reply = bench.expect(Reply.ACK, within_s=limit_s, number=number)
        bench.measure(TimeName.ANSWER, reply.at - sent.left_at)


def measure_end(bench: Bench) -> Received:
    """Send end of transfer and measure the time to complete, which is returned."""
    sent = bench.send(bench.encoder.end())
    within_s = _PATIENCE * bench.limit("complete_s")
    reply = bench.await_message(Reply.COMPLETE, within_s=within_s)
    bench.measure(TimeName.COMPLETE, reply.at - sent.left_at)
    return reply
