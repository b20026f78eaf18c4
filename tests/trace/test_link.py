"""The link report, where a trace alone could tell more than is known."""

from __future__ import annotations

from flasher.protocol.spec import BMS, WELLING
from flasher.trace.figures import LinkMeter
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
    # An ACK is two frames and may lag behind the reckoned end of its packet.
    assert 0 < report.device_answer.median_s < 5 * FRAME_S


def test_where_frames_take_less_time_than_on_the_line_it_is_not_known() -> None:
    """A network in place of a bus: when a packet had left there is nothing to reckon from."""
    report = measured(20).report()
    assert report is not None
    assert report.share_of_line_rate is not None
    assert report.share_of_line_rate > 1
    assert report.device_answer is None
    assert report.host_turnaround is not None
