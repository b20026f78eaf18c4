"""The link report, where a trace alone could tell more than is known."""

from __future__ import annotations

from collections import deque
from dataclasses import astuple
from typing import Final

import pytest

from flasher.protocol.spec import BMS, WELLING
from flasher.trace.decoder import bits_of
from flasher.trace.figures import LinkMeter, LinkReport
from tests.trace.tape import FRAME_S, Tape


def measured(pace: float) -> LinkMeter:
    """A whole transfer, `pace` times as fast as on the line."""
    meter = LinkMeter(BMS, WELLING.bitrate_bps)
    tape = Tape().to_packet(7)
    for now, frame in tape.frames:
        at_s = (now - tape.frames[0][0]) / pace
        meter(frame, sent=frame.can_id == BMS.request_id, now=at_s)
    return meter


def test_on_a_line_the_answer_time_of_the_device_is_measured() -> None:
    report = measured(1).report()
    assert report is not None
    assert report.device_answer is not None
    # An ACK is two frames and may come after the computed end of its packet.
    assert 0 < report.device_answer.median_s < 5 * FRAME_S


def test_where_frames_take_less_time_than_on_the_line_it_is_not_known() -> None:
    """A network in place of a bus: when a packet had left there is nothing to reckon from."""
    report = measured(20).report()
    assert report is not None
    assert report.share_of_line_rate is not None
    assert report.share_of_line_rate > 1
    assert report.device_answer is None
    assert report.host_turnaround is not None


QUEUE_FRAMES: Final = 10
"""A driver takes so many at once, then one for each that has left."""


def recorded(*, by_candump: bool) -> LinkReport:
    """Seven packets on a wire, by candump, which stamps what was sent when it has ended, or by a
    recorder of our own, which stamps it when it was handed over.
    """
    meter, now, ends = LinkMeter(BMS, WELLING.bitrate_bps), 10.0, deque([0.0], QUEUE_FRAMES)
    is_sent = False
    for _, frame in Tape().to_packet(7).frames:
        if is_sent != (frame.can_id == BMS.request_id):
            is_sent = not is_sent
            now += 0.002  # either side thinks
            ends.extend([now] * QUEUE_FRAMES)
        handed_over_s = ends[0]
        now += bits_of(frame) / WELLING.bitrate_bps
        ends.append(now)
        meter(frame, sent=is_sent, now=now if by_candump or not is_sent else handed_over_s)
    report = meter.report()
    assert report is not None
    return report


def test_the_figures_are_the_same_whether_what_was_sent_is_stamped_before_or_after() -> None:
    """`candump` and a recorder of our own, on one bus."""
    theirs, ours = recorded(by_candump=True), recorded(by_candump=False)
    assert ours.host_turnaround is not None
    assert theirs.host_turnaround is not None
    assert ours.host_turnaround.median_s == pytest.approx(0.002, abs=1e-6)
    assert theirs.host_turnaround.median_s == pytest.approx(0.002, abs=1e-6)
    assert ours.device_answer is not None
    assert theirs.device_answer is not None
    assert astuple(ours.device_answer) == pytest.approx(astuple(theirs.device_answer))
    assert ours.transfer_s == pytest.approx(theirs.transfer_s)
