"""A correct independent device, the referee of tests/peers, which shares no code with flasher.

With a profile of its choices it passes, when it is slow and when it behaves differently where the
document allows it. `python -m tests.campaigns.whole_suites` includes the longest cases.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Final

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.conformance.catalogue import CASES, Selection
from flasher.conformance.profile import ConformanceProfile, Value
from flasher.conformance.real import RealPort, RealSubject
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import SuiteOptions, run
from flasher.protocol.spec import WELLING
from tests.loops import each
from tests.peers.scripted_device import ScriptedDevice

_AREA_BYTES: Final = 12 * 1024
IMAGE: Final = b"V1r2r3_20220512." + random.Random(7).randbytes(9 * 128 - 3)
_PROFILE: Final[dict[str, Value]] = {
    "fr_01": "either",  # wants the whole header in its first frame
    "fr_02": "lost",
    "fr_04": "dropped",
    "tx_03": "nak",
    "tx_12": "waits",
    "limits.window_s": 0.05,
    "device.application_bytes": _AREA_BYTES,
    "device.largest_image_bytes": _AREA_BYTES,
}
_AT_THE_BURST: Final = ("FR-07", "FR-08", "UP-04", "UP-05", "CO-01", "CO-02")
_LONGEST: Final = ("CR-01", "CR-02", "TX-07", "BU-01", "PW-01", "SE-01")
_HELD: Final = (CaseVerdict.PASS, CaseVerdict.PASS_IN_PART, CaseVerdict.UNSUPPORTED)
"""Its bench has no second image, and its adapter only sends standard data frames."""
_BAD_PACKETS: Final = ("CR-03", "TX-01", "TX-03", "TX-04", "TX-06")


class SlowDevice(ScriptedDevice):
    """Writes each packet before its ACK, and verifies the whole image at the end. Its application
    answers more slowly than the tool repeats a query.
    """

    def _ack(self, number: int, at: float) -> None:
        super()._ack(number, at + 0.4)

    def _answer(self, what: str, frames: list[bytes], at: float, number: int = 0) -> None:
        super()._answer(what, frames, at + (6.0 if what == "complete" else 0.0), number)

    def _hear_version_query(self, now: float) -> None:
        if self.state == "application":
            self.alarm(now + 0.25, super()._hear_version_query)


class LateListener(ScriptedDevice):
    """Accepts the update command only for 0.2 s after the burst (R2)."""

    def _hear_update(self, data: bytes, now: float) -> None:
        has_application = self.completed or self.old_application_whole
        if self.state != "announcing" or self._announced == 4 or not has_application:
            super()._hear_update(data, now)

    def _announce(self, now: float) -> None:
        super()._announce(now)
        if self.state == "announcing" and self._announced == 4:
            self.clear_alarms()
            self.alarm(now + 0.2, self._announce)


class BurstAnnouncer(ScriptedDevice):
    """Without an application it announces itself in bursts, one second apart."""

    def _announce(self, now: float) -> None:
        whole = self.completed or self.old_application_whole
        if self._announced == 4 and not whole:
            self._announced = 0
            self.alarm(now + 1.0, self._announce)
            return
        super()._announce(now)


class ChoosyDevice(ScriptedDevice):
    """Answers NAK to a damaged packet, and nothing to an impossible one."""

    def _nak(self, number: int, at: float) -> None:
        if self.log[-1].what in ("damaged", "end"):
            super()._nak(number, at)


class PageDevice(ScriptedDevice):
    """Buffers packets until a page of 1 KiB is full or the transfer ends."""

    @property
    def image(self) -> bytes:
        written = len(self._stored) // 1024 * 1024
        return super().image if self.completed else super().image[:written]


def bench(device: ScriptedDevice) -> RealSubject:
    """The device on a simulated bus, like a real one: no echoes, power by a function."""
    clock = VirtualClock()
    bus = SimulatedBus(WELLING.bitrate_bps, clock)
    bus.attach(device)

    def power(on: bool) -> None:
        device.hush()
        device.clear_alarms()
        device.state = "off"
        if on:
            device.power_on(clock.now())

    port = RealPort(bus.link(), clock, WELLING.bitrate_bps)
    return RealSubject(
        port, "bms", IMAGE, name="another", power=power, readback=lambda: device.image
    )


def judged(kind: type[ScriptedDevice], cases: Sequence[str], **given: Value) -> dict[str, str]:
    """The first failure of each case on such a device."""
    keys = {key.replace("__", "."): value for key, value in given.items()}
    device = kind("bms", capacity_bytes=_AREA_BYTES)
    profile = ConformanceProfile({**_PROFILE, **keys}, source="another product")
    selection, options = Selection(cases=tuple(cases)), SuiteOptions(upgrades=4)
    report = run(bench(device), profile, selection=selection, options=options)
    assert report.final_image == "verified"
    return {
        result.case_id: f"{result.verdict.text}: {result.first_failure}"
        for result in report.results
        if result.verdict not in _HELD
    }


def check_right_device(cases: Sequence[str]) -> None:
    """It fails none of these cases."""
    assert judged(ScriptedDevice, cases) == {}


@pytest.mark.slow
def test_a_right_device_of_others_passes() -> None:
    check_right_device([case_id for case_id in CASES if case_id not in _LONGEST])


@pytest.mark.slow
@each(
    "kind, cases, choices",
    [
        (
            SlowDevice,
            ("CR-03", "RS-01", "RS-02", "UP-03", "TX-02", "EN-01", "TM-05", "SE-01"),
            {"en_02": "either"},
        ),
        (LateListener, _AT_THE_BURST, {"up_04_burst": "rejected", "limits__window_s": 0.2}),
        (LateListener, ("UP-04",), {"up_04_burst": "either", "limits__window_s": 0.2}),
        (BurstAnnouncer, ("RS-03",), {}),
        (ChoosyDevice, _BAD_PACKETS, {"tx_01": "either", "tx_03": "silence"}),
        (PageDevice, ("FR-03", "CR-03", "PW-01"), {"device__buffer_bytes": 1024}),
    ],
)
def test_other_ways_that_the_document_leaves_open_pass(
    kind: type[ScriptedDevice], cases: Sequence[str], choices: dict[str, Value]
) -> None:
    assert judged(kind, cases, **choices) == {}


@pytest.mark.slow
@pytest.mark.no_cover
@each(
    "kind, cases, choices",
    [
        (LateListener, ("UP-04",), {"up_04_burst": "accepted"}),
        (ChoosyDevice, ("TX-04", "TX-06"), {"tx_01": "nak_expected"}),
        (PageDevice, ("FR-03", "PW-01"), {}),
    ],
)
def test_a_profile_with_another_choice_fails_them(
    kind: type[ScriptedDevice], cases: Sequence[str], choices: dict[str, Value]
) -> None:
    assert set(judged(kind, cases, **choices)) == set(cases)
