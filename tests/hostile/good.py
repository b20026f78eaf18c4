"""Small good files, for campaigns and fuzzing to damage."""

from __future__ import annotations

from pathlib import Path

from flasher.protocol.frame import Frame
from flasher.trace.recorder import Recorder
from tests.trace import traffic

TARGET_PROFILE = b"""\
attempts = 5
[timings]
ack_timeout_s = 1.0
[wmc]
frame_gap_s = 0.001
reset_data = 'RESET'
[wmc.version_query]
command = 0x3300
answer_id = 0x712
answer_command = 0x1510
offset = 0
size_bytes = 16
[bus]
interface = 'virtual'
channel = 'x'
bitrate = 250000
[bus.bus_kwargs]
receive_own_messages = true
"""
CONFORMANCE_PROFILE = b"""\
tx_02 = "nak_next"
tx_12 = { value = "waits", rationale = "by the charger" }
[limits]
erase_s = 2.5
[device]
largest_image_bytes = 0x1C000
reset_data = 'RESET'
[deviations]
"TX-03" = "an older packet restarts the transfer"
"""
FRAMES = (*traffic.running(), *traffic.reset())


def trace(path: Path, frames: tuple[Frame, ...] = FRAMES) -> bytes:
    """What is recorded of frames in the format of a suffix."""
    with Recorder(path) as record:
        for number, frame in enumerate(frames):
            record(frame, sent=number % 2 == 0, now=number / 100)
    return path.read_bytes()


def conformance_report() -> bytes:
    """The report of a run of one case, which failed."""
    from flasher.conformance.reports import to_bytes  # noqa: PLC0415  not for traces
    from flasher.conformance.results import (  # noqa: PLC0415
        CaseResult,
        CaseText,
        CaseVerdict,
        Histogram,
        RunReport,
        Times,
    )

    return to_bytes(
        RunReport(
            subject="mock",
            target="bms",
            bitrate_bps=250_000,
            timestamp_source="simulated",
            uncertainty_s=0.0,
            profile_source="defaults",
            profile={"tx_02": "either"},
            seed="1",
            strict=False,
            cases=(CaseText("TX-02", "TX", "NAK"),),
            results=(CaseResult("TX-02", CaseVerdict.FAIL, seed="1"),),
            times=(Times("ack", 1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0, Histogram((0.1, 0.2), (1,))),),
        )
    )
