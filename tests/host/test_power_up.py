"""The upgrade of a device that is waited for at power-up: nothing is sent before it speaks."""

from __future__ import annotations

from flasher import events
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending
from flasher.protocol.messages import (
    BootVersion,
    GeneralFeedbackMessage,
    Packet,
    RequestTransfer,
    ResetCommand,
    UpdateCommand,
)
from flasher.protocol.timing import Timings
from tests.host.bench import BOOT, Bench
from tests.loops import each

WAITING = UpgradeOptions(at_power_up=True, power_up_timeout_s=30.0)


def test_the_user_is_asked_to_cycle_the_power_and_nothing_is_sent() -> None:
    bench = Bench(options=WAITING)
    bench.wait(29.9)
    assert bench.unread == []
    assert bench.seen(events.PowerCycleAwaited) == [events.PowerCycleAwaited(30.0)]
    assert not bench.engine.done


def test_the_announcement_is_answered_before_the_next_one() -> None:
    bench = Bench(options=WAITING)
    bench.wait(12.0)
    bench.say(BOOT)
    before = bench.now
    bench.expect(UpdateCommand)
    assert bench.now - before < 0.03
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


def test_every_announcement_of_the_burst_is_answered_until_one_is_received() -> None:
    bench = Bench(options=WAITING)
    for _ in range(4):
        bench.say(BOOT)
        bench.expect(UpdateCommand)
        bench.wait(0.05)
    bench.say(RequestTransfer())
    assert bench.expect(Packet).number == 1


@each("row", [GeneralFeedbackMessage(), RequestTransfer()])
def test_nothing_else_that_the_device_sends_is_answered(row: GeneralFeedbackMessage) -> None:
    bench = Bench(options=WAITING)
    bench.say(row)
    bench.wait(1.0)
    assert bench.unread == []


def test_a_device_that_never_announces_itself_ends_the_wait_and_is_untouched() -> None:
    bench = Bench(options=WAITING)
    bench.wait(31.0)
    assert bench.outcome.ending is Ending.NO_ANNOUNCEMENT
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED
    assert bench.sent == []
    error = bench.outcome.error()
    assert error is not None
    assert "--wait" in error.remedy


def test_another_device_at_power_up_is_refused_without_an_update_command() -> None:
    bench = Bench(options=WAITING)
    bench.say(BootVersion("WMC", "V1.2.3"))
    bench.wait(1.0)
    assert bench.outcome.ending is Ending.WRONG_DEVICE
    assert bench.sent == []


def test_an_adapter_that_was_lost_and_is_back_goes_on_waiting_and_takes_no_attempt() -> None:
    bench = Bench(options=WAITING)
    for _ in range(5):
        bench.engine.link_back(bench.now)
        bench.wait(1.0)
    assert bench.sent == []
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    assert bench.seen(events.AttemptStarted) == []


def test_after_a_lost_packet_the_device_is_reset_and_the_power_is_asked_for_again() -> None:
    """A device in its bootloader does not know the reset (R18): only the power helps."""
    timings = Timings(ack_timeout_s=0.05, packet_tries=2)
    bench = Bench(options=UpgradeOptions(at_power_up=True, timings=timings))
    bench.say(BOOT)
    bench.expect(UpdateCommand)
    bench.say(RequestTransfer())
    bench.expect(Packet)
    bench.expect(Packet)
    bench.expect(ResetCommand)
    bench.wait(2.0)
    assert len(bench.seen(events.PowerCycleAwaited)) == 2
    assert all(isinstance(row, ResetCommand) for row in bench.unread)
    bench._read = len(bench.sent)
    bench.say(BOOT)
    bench.expect(UpdateCommand)


def test_the_deadline_ends_the_wait() -> None:
    bench = Bench(options=UpgradeOptions(at_power_up=True, timeout_s=3.0))
    bench.wait(3.1)
    assert bench.outcome.ending is Ending.OUT_OF_TIME
    assert bench.sent == []


def test_the_wait_can_be_cancelled() -> None:
    bench = Bench(options=WAITING)
    bench.wait(1.0)
    bench.engine.cancel(bench.now)
    assert bench.outcome.ending is Ending.CANCELLED
    assert bench.outcome.device_left is DeviceLeft.UNTOUCHED
