"""A device on a link, like a real one: no echoes, power and readback by commands."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import Selection
from flasher.conformance.mock import GOOD_IMAGE, MOCK_PROFILE, profile_of_mock
from flasher.conformance.real import DevicePowerCommand, ReadbackCommand, RealPort, RealSubject
from flasher.conformance.results import CaseVerdict, CheckOutcome, Unsupported
from flasher.conformance.runner import run
from flasher.conformance.wire import RawFrame
from flasher.errors import BusError, UsageError
from flasher.mock.model import MockDevice
from flasher.mock.store import AREA_START
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING
from tests.loops import each

SCRIPT = "import sys; open(sys.argv[1], 'w').write(sys.argv[2])"

KNOWS_ADDRESS = replace(
    profile_of_mock(), given={**profile_of_mock().given, "device.application_address": AREA_START}
)


def bench(*, has_power: bool) -> tuple[RealSubject, MockDevice]:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    device = MockDevice(BMS, bitrate_bps=WELLING.bitrate_bps, profile=MOCK_PROFILE)
    bus.attach(device)

    def power(on: bool) -> None:
        (device.power_on if on else device.power_cut)(clock.now())

    port = RealPort(bus.link(), clock, WELLING.bitrate_bps)
    real = RealSubject(port, "bms", GOOD_IMAGE, name="a bench", power=power if has_power else None)
    return real, device


@pytest.mark.slow
def test_a_device_without_power_control_passes_what_it_can() -> None:
    real, device = bench(has_power=False)
    report = run(real, profile_of_mock(), selection=Selection(groups=("RS", "UP")))
    statuses = {result.case_id: result.verdict for result in report.results}
    assert statuses.pop("RS-05") is CaseVerdict.UNSUPPORTED
    in_full = [name for name, verdict in statuses.items() if verdict is CaseVerdict.PASS]
    assert in_full == ["RS-01", "RS-02", "RS-04"]
    assert report.in_full == f"3 of {len(statuses)} passes were judged in full"
    assert list(report.not_tried) == ["the bench has no readback"]
    assert report.final_image_text == "flashed and verified by version; no readback was possible"
    assert device.stored_image == GOOD_IMAGE


def test_power_control_by_a_function_is_used() -> None:
    real, _ = bench(has_power=True)
    report = run(real, profile_of_mock(), selection=Selection(cases=("RS-05",)))
    assert [result.verdict for result in report.results] == [CaseVerdict.PASS]


def test_own_frames_that_come_back_are_not_taken_for_others() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    port = RealPort(bus.link(), clock, WELLING.bitrate_bps)
    other = bus.link()
    frame = RawFrame(0x752, b"\x01\x02")
    port.send(frame)
    assert other.receive(1.0) is not None
    for sent in (frame, RawFrame(0x752, b"\x03")):
        other.send(Frame(*sent))
    arrival = port.receive(2.0)
    assert arrival is not None
    assert arrival.frame.data == b"\x03"


def test_an_adapter_that_echoes_nothing_hides_no_frame_that_the_bench_has_sent_too() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    port, device = RealPort(bus.link(), clock, WELLING.bitrate_bps), bus.link()
    request = RawFrame(0x725, b"\x33\x71\x42\xf8\xf0")
    for number in range(600):
        is_request = number == 600 - 256
        port.send(request if is_request else RawFrame(0x752, number.to_bytes(2, "little")))
    while device.receive(clock.now() + 1.0) is not None:
        pass
    device.send(Frame(*request))
    arrival = port.receive(2.0)
    assert arrival is not None
    assert arrival.frame == request


def test_one_echo_that_is_lost_does_not_hide_those_after_it() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock, collides=False)
    port = RealPort(bus.link(), clock, WELLING.bitrate_bps, echoes=True)
    others = bus.link()
    frames = [RawFrame(0x752, bytes((number,))) for number in range(3)]
    for frame in frames:
        port.send(frame)
    for frame in frames[1:]:
        others.send(frame)  # type: ignore[arg-type]
    arrivals = [port.receive(5.0) for _ in frames[1:]]
    assert [(arrival.frame, arrival.is_echo) for arrival in arrivals if arrival] == [
        (frame, True) for frame in frames[1:]
    ]


@pytest.mark.slow
def test_the_flash_is_compared_over_the_bus_where_nothing_else_reads_it() -> None:
    real, _ = bench(has_power=False)
    report = run(real, KNOWS_ADDRESS, selection=Selection(cases=("UP-03", "UP-08")))
    for case_id in ("UP-03", "UP-08"):
        (found,) = (each for each in report.results if each.case_id == case_id)
        assert found.verdict is CaseVerdict.PASS
        assert any(check.got.endswith("read over the bus") for check in found.checks)
    assert report.final_image_text == "flashed and verified by version and memory over the bus"
    assert not any("readback" in str(gap) for gap in report.gaps)


def test_an_image_that_is_torn_in_the_flash_is_seen_over_the_bus() -> None:
    real, device = bench(has_power=False)
    device.store.flash.erase_page(AREA_START)
    device.store.flash.program(AREA_START, GOOD_IMAGE[:-5] + bytes(8))
    seen = Bench(real, KNOWS_ADDRESS, limit_s=60.0)
    seen.check_stored(GOOD_IMAGE, runs=True)
    assert [check.outcome for check in seen.judge.checks] == [CheckOutcome.FAIL]


def test_remote_and_extended_frames_are_sent_and_known_again() -> None:
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    port = RealPort(bus.link(), clock, WELLING.bitrate_bps)
    other = bus.link()
    for frame in (
        RawFrame(0x752, bytes(8), is_remote=True),
        RawFrame(0x752 << 18, b"\x01", is_extended=True),
    ):
        port.send(frame)
        reply = other.receive(1.0)
        assert reply is not None
        assert (reply.is_remote, reply.is_extended) == (frame.is_remote, frame.is_extended)
        assert not reply.is_payload


def test_what_a_link_cannot_send_is_unsupported() -> None:
    real, _ = bench(has_power=False)
    with pytest.raises(Unsupported):
        real.port.send(RawFrame(0x752, b"", is_error=True))
    for action in (lambda: real.power(on=True), real.readback, lambda: real.bus_off(1.0)):
        with pytest.raises(Unsupported):
            action()


@pytest.mark.parametrize(("on", "reported"), [(True, "on"), (False, "off")])
def test_the_power_command_gets_on_or_off(tmp_path: Path, on: bool, reported: str) -> None:
    path = tmp_path / "power"
    DevicePowerCommand(f'{sys.executable} -c "{SCRIPT}" {path} {{on|off}}')(on)
    assert path.read_text() == reported


@each(
    "command, reported",
    [
        ("no-such-relay {on|off}", "cannot be run"),
        (f'{sys.executable} -c "raise SystemExit(3)" {{on|off}}', "exit code 3"),
    ],
)
def test_a_power_command_that_fails_is_an_error_of_the_bench(command: str, reported: str) -> None:
    with pytest.raises(BusError, match=reported):
        DevicePowerCommand(command)(True)


def test_a_power_command_that_hangs_is_cut() -> None:
    command = DevicePowerCommand(
        f'{sys.executable} -c "import time; time.sleep(60)" {{on|off}}', 0.1
    )
    with pytest.raises(BusError, match="longer than"):
        command(True)


@each("template", ["relay on", "relay {on}", "relay '{on|off}"])
def test_a_power_command_that_makes_no_sense_is_refused(template: str) -> None:
    with pytest.raises(UsageError):
        DevicePowerCommand(template)


def test_the_readback_command_yields_the_file_that_it_wrote() -> None:
    assert ReadbackCommand(f'{sys.executable} -c "{SCRIPT}" {{file}} dump')() == b"dump"


def test_a_readback_command_without_a_file_is_refused() -> None:
    with pytest.raises(UsageError, match=r"has no \{file\}"):
        ReadbackCommand("st-flash read")
    with pytest.raises(BusError, match="no readable file"):
        ReadbackCommand(f'{sys.executable} -c "" {{file}}')()
