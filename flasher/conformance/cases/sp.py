"""SP: speed. Runs only when selected by name, as it wears the flash.

Measures the times of TM-05 often enough to compare their distribution between two reports.
"""

from __future__ import annotations

from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.cases.tm import check_times, measure_burst, measure_end, measure_packets
from flasher.conformance.catalogue import DESTRUCTIVE, LONG, TIMING, WEAR, case
from flasher.conformance.judge import TimeName
from flasher.conformance.wire import Reply, reported_version

_START_AGAIN: Final = "window's end to an application that answers"
_TAKEN: Final = "last boot version to an update command that is taken"
_NOT_TAKEN: Final = "last boot version to an update command that is not taken"
_END: Final = "last boot version to the window's end"
_PATIENCE: Final = 3
_ASK_S: Final = 0.02
"""Query interval; the measured start time may be this much too long."""
_BEYOND: Final = 1.2
"""Offset of the last update command, in windows."""
_AT_THE_END: Final = 0.5
"""Share of the update commands sent within 5 % of the window's end."""


@case(
    "SP-01",
    "answer times of many upgrades",
    clause="Welling 5.1, figure 2 (begin); R12",
    stimulus=f"{WEAR['SP-01']} times (--upgrades) a reset, a start, and an upgrade to the good "
    "image",
    expectation="each time within the profile's limits: reset to the first boot version, their "
    "spacing, update command to request transfer, packet to ACK, end of transfer to complete, to "
    "an application that answers",
    requires={DESTRUCTIVE, TIMING, LONG},
    limit_s=float("inf"),
)
def answer_times(bench: Bench) -> None:
    image = bench.good_image
    tells = reported_version(bench.subject.target, image) is not None
    if not tells:
        why = "the device does not report which application runs"
        bench.unsupported("the time to an application that answers", why)
    for turn in range(1, bench.upgrades + 1):
        with bench.step(f"upgrade {turn}"):
            last = measure_burst(bench, wait=False)
            _measure_start(bench, _START_AGAIN, last.at + bench.limit("window_s"), is_asked=tells)
            bench.reset_to_bootloader()
            bench.update(len(image))
            measure_packets(bench, image)
            _measure_start(bench, TimeName.START, measure_end(bench).at, is_asked=tells)
    check_times(bench)
    for name in (TimeName.START, _START_AGAIN) if tells else ():
        bench.judge.check_measured(name, high_s=bench.limit("start_s"))
    bench.info(f"flash wear: the application was erased and written {bench.upgrades} times")


def _measure_start(bench: Bench, name: str, since: float, *, is_asked: bool) -> None:
    """Query the application until it answers; without `is_asked`, wait as long as it may take."""
    limit_s = bench.limit("start_s")
    if not is_asked:
        bench.wait_until(since + limit_s)
        return
    within_s = _PATIENCE * limit_s
    reply = bench.host.version_answer(since + within_s - bench.now, every_s=_ASK_S)
    found = bench.require_received(reply, "an application that answers", within_s)
    bench.measure(name, max(0.0, found.at - since))


@case(
    "SP-02",
    "the window, offset by offset",
    clause="Welling 5.1, figure 2 (begin); R2",
    stimulus=f"update command {WEAR['SP-02']} times (--upgrades) after the last boot version, "
    "half of them around the window's end; accepted ones continue as upgrades to the good image",
    expectation="accepted up to the window's end, and after it as the profile says (up_04)",
    requires={DESTRUCTIVE, TIMING, LONG},
    choices=("up_04",),
    limit_s=float("inf"),
)
def window(bench: Bench) -> None:
    window_s, choice = bench.limit("window_s"), bench.choice("up_04")
    edge_s = bench.window_edge_s
    frames = bench.encoder.update(len(bench.good_image))
    wire_s = bench.tester.wire_s(frames)
    taken: list[float] = []
    not_taken: list[float] = []
    close = round(bench.upgrades * _AT_THE_END)
    wide = max(bench.upgrades - close, 1)
    offsets_s = [_BEYOND * window_s * (at + 0.5) / wide for at in range(wide)]
    offsets_s += [window_s * (0.95 + 0.1 * (at + 0.5) / close) for at in range(close)]
    for offset_s in sorted(offsets_s):
        with bench.step(f"{offset_s * 1000:.1f} ms after the last boot version"):
            reply = bench.reset_to_bootloader()
            for _ in range(bench.number("versions") - 1):
                reply = bench.next_version()
            sent = bench.send(frames, at=reply.at + max(offset_s - wire_s, 0.0))
            at_s = sent.left_at - reply.at
            request = bench.wait_for(Reply.REQUEST)
            (not_taken if request is None else taken).append(at_s)
            bench.measure(_NOT_TAKEN if request is None else _TAKEN, at_s)
            got = "rejected" if request is None else "accepted"
            if at_s < window_s - edge_s:
                bench.check(request is not None, "accepted", got)
            elif at_s > window_s + edge_s and choice != "either":
                bench.check((request is not None) == (choice == "accepted"), choice, got)
            if request is None:
                bench.check_application()
            else:
                bench.finish(bench.good_image)
    if taken and not_taken:
        bench.measure(_END, (max(taken) + min(not_taken)) / 2)
        bench.info(
            f"accepted {len(taken)} of {bench.upgrades} times, up to {max(taken) * 1000:.1f} ms; "
            f"rejected from {min(not_taken) * 1000:.1f} ms on"
        )
    bench.info(f"flash wear: the application was erased and written {len(taken)} times")
