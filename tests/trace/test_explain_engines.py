"""What `explain` says of upgrades that engines ran: the host's own outcome is its referee."""

from __future__ import annotations

import pytest

from flasher.host.options import UpgradeOptions
from flasher.host.table import Ending
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING
from flasher.trace.explain import explain
from flasher.trace.figures import LinkMeter
from flasher.trace.story import Cause, Story
from flasher.trace.taps import FlightRecorder
from tests.end_to_end.world import Traffic, upgrade
from tests.loops import each
from tests.peers.scripted_device import DeviceScript, ScriptedDevice


class Tapped(Traffic):
    """Keeps frames with their times, and measures the link live."""

    def __init__(self) -> None:
        super().__init__()
        self.flight = FlightRecorder()
        self.meter = LinkMeter(TARGETS["bms"], WELLING.bitrate_bps)

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        self.flight(frame, sent=sent, now=now)
        self.meter(frame, sent=sent, now=now)

    def story(self) -> Story:
        frames = ((at_s, Frame(*frame)) for at_s, frame, _ in self.flight)
        return explain(frames, source="engines")


@pytest.mark.slow
@each(
    "script, ending, cause",
    [
        (DeviceScript(), Ending.COMPLETED, Cause.COMPLETED),
        (DeviceScript(deaf_to_reset=True), Ending.NO_BOOT_VERSION, Cause.NO_BOOT_VERSION),
        (
            DeviceScript(versions_lost=frozenset({1, 2, 3, 4})),
            Ending.NO_BOOT_VERSION,
            Cause.RESET_IGNORED,
        ),
        (DeviceScript(wrong_name=True), Ending.WRONG_DEVICE, Cause.WRONG_DEVICE),
        (DeviceScript(no_request=True), Ending.NO_REQUEST, Cause.NO_REQUEST),
        (DeviceScript(nak={7: 2}), Ending.COMPLETED, Cause.COMPLETED),
        (DeviceScript(nak={7: 9999}), Ending.PACKET_FAILED, Cause.PACKET_REFUSED),
        (DeviceScript(silent_after=6), Ending.PACKET_FAILED, Cause.PACKET_UNANSWERED),
        (DeviceScript(restart_at=5), Ending.COMPLETED, Cause.COMPLETED),
        (DeviceScript(drop_ack=frozenset({3, 9})), Ending.COMPLETED, Cause.COMPLETED),
        (DeviceScript(double_ack=frozenset({2, 3, 4, 5})), Ending.TWO_DEVICES, Cause.TWO_DEVICES),
        (DeviceScript(end_nak=2), Ending.REFUSED, Cause.REFUSED),
        (DeviceScript(lose_complete=9), Ending.UNCONFIRMED, Cause.UNCONFIRMED),
        (DeviceScript(foreign_frames=True), Ending.COMPLETED, Cause.COMPLETED),
    ],
)
def test_the_verdict_is_the_hosts_outcome(
    script: DeviceScript, ending: Ending, cause: Cause
) -> None:
    tapped = Tapped()
    outcome = upgrade(ScriptedDevice("bms", script), traffic=tapped)
    assert outcome.ending is ending
    (printed,) = tapped.story().upgrades
    assert printed.verdict.cause is cause, printed.verdict.text
    assert printed.attempts == outcome.statistics.attempts
    if outcome.packet is not None:
        assert printed.verdict.packet == outcome.packet


def test_live_and_recorded_figures_are_the_same() -> None:
    tapped = Tapped()
    outcome = upgrade(
        ScriptedDevice("bms", DeviceScript(nak={7: 2}, drop_ack=frozenset({3}))), traffic=tapped
    )
    assert outcome.ok
    (printed,) = tapped.story().upgrades
    report = tapped.meter.report()
    assert report is not None
    assert printed.link is not None
    assert report.packets == printed.link.packets == 10
    assert report.repetitions == outcome.statistics.repetitions == 3
    assert report.naks == outcome.statistics.naks == 2
    assert report.transfer_s == pytest.approx(printed.link.transfer_s)


def test_a_transfer_without_waiting_reaches_the_line_rate() -> None:
    tapped = Tapped()
    upgrade(MockDevice(TARGETS["bms"], bitrate_bps=WELLING.bitrate_bps), traffic=tapped)
    report = tapped.meter.report()
    assert report is not None
    assert report.share_of_line_rate is not None
    assert 0.85 < report.share_of_line_rate <= 1.0
    assert report.host_turnaround is not None
    assert report.host_turnaround.maximum_s == pytest.approx(0.0)
    assert report.device_answer is not None
    # The ACK's own two frames take about 0.8 ms; the model takes 1 ms to answer.
    assert 0.0015 < report.device_answer.median_s < 0.0025


def test_a_host_that_leaves_gaps_shows_as_turnaround() -> None:
    tapped = Tapped()
    upgrade(
        MockDevice(TARGETS["bms"], bitrate_bps=WELLING.bitrate_bps),
        traffic=tapped,
        options=UpgradeOptions(packet_gap_s=0.01),
    )
    report = tapped.meter.report()
    assert report is not None
    assert report.host_turnaround is not None
    assert report.host_turnaround.median_s == pytest.approx(0.01, rel=0.2)
