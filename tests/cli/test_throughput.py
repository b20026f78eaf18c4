"""`flasher doctor --throughput`: figures, what is sent for them, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from flasher.api import Connection
from flasher.bus.simulated import SimulatedLink
from flasher.cli.look import throughput
from flasher.cli.look.findings import Finding, Severity
from flasher.cli.look.findings import throughput as judge
from flasher.cli.look.throughput import BURSTS, QUERIES, Throughput
from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from flasher.trace.figures import Distribution
from tests.api.battery import ANSWERS, Battery, wire_to
from tests.cli.conftest import Flasher
from tests.loops import each

WORDS = ("doctor", "--mock", "--mock-speed", "0", "--throughput", "--json")
FAST = Throughput(
    frames_sent=130,
    queries=20,
    answered=20,
    round_trip=Distribution.of([0.005]),
    frames_out_per_s=2000.0,
    line_frames_per_s=2000.0,
    worst_gap_out_s=0.001,
    frames_in_per_s=2000.0,
    worst_gap_in_s=0.001,
    echo_delay=None,
    worst_pause_s=0.002,
    set_aside=0,
    packet_s=0.012,
    line_packet_s=0.01,
)


@pytest.fixture
def on(monkeypatch: pytest.MonkeyPatch) -> Callable[[Connection], None]:
    """Puts the command on a bus."""

    def put(wire: Connection) -> None:
        @contextmanager
        def opened(*_arguments: object, **_options: object) -> Iterator[Connection]:
            yield wire

        monkeypatch.setattr("flasher.api.connect_mock", opened)

    return put


def severities(findings: list[Finding]) -> set[Severity]:
    return {found.severity for found in findings}


def test_only_version_queries_are_sent(flasher: Flasher, on: Callable[[Connection], None]) -> None:
    battery = Battery()
    wire = wire_to(battery)
    on(wire)
    run = flasher(*WORDS)
    assert run.code == ExitCode.OK
    assert {command for command, _ in battery.received} == {0x3300}
    measured = run.document["throughput"]
    # Two frames a query: 20 that are answered, and nine in each burst.
    assert measured["frames_sent"] == 2 * QUERIES + 18 * BURSTS == wire.link.health().frames_sent
    assert measured["answered"] == QUERIES
    assert measured["round_trip"]["median_s"] < 0.02
    assert 0 < measured["frames_in_per_s"] <= measured["line_frames_per_s"]


def test_a_silent_battery_is_asked_three_times(
    flasher: Flasher, on: Callable[[Connection], None]
) -> None:
    on(wire_to(Battery(silent=frozenset(ANSWERS))))
    run = flasher(*WORDS)
    measured = run.document["throughput"]
    assert (measured["queries"], measured["answered"], measured["round_trip"]) == (3, 0, None)
    assert any("no answer was measured" in each["what"] for each in run.document["findings"])


@each(
    "message, reason",
    [
        ((0x752, 0x3300, b""), "a problem was found above"),  # another tool
        ((0x725, 0xC109, b"BMSV1.2.3"), "a device is in its bootloader"),
    ],
)
def test_nothing_is_sent_where_it_could_disturb(
    flasher: Flasher,
    on: Callable[[Connection], None],
    message: tuple[int, int, bytes],
    reason: str,
) -> None:
    wire = wire_to(Battery(silent=frozenset(ANSWERS), repeats=(message,)))
    on(wire)
    run = flasher(*WORDS)
    assert run.document["throughput"] is None
    assert any(reason in each["what"] for each in run.document["findings"])
    assert wire.link.health().frames_sent == 0


def test_a_fast_adapter_needs_nothing() -> None:
    findings = list(judge(FAST))
    assert severities(findings) == {Severity.OK, Severity.NOTE}
    assert any("the default limits of a profile are enough" in found.what for found in findings)


@each(
    "changes, severity, fix",
    [
        ({"round_trip": Distribution.of([0.3])}, Severity.PROBLEM, "ack_timeout_s = 0.9"),
        ({"round_trip": Distribution.of([0.3])}, Severity.PROBLEM, "command_repeat_s = 0.6"),
        ({"worst_gap_in_s": 0.06}, Severity.WARNING, "inter_frame_timeout_s = 0.2"),
        ({"worst_gap_out_s": 0.09}, Severity.PROBLEM, "try another cable, port or adapter"),
        ({"set_aside": 3}, Severity.WARNING, "close other programs, and measure again"),
    ],
)
def test_a_slow_adapter_needs_a_profile(
    changes: dict[str, Any], severity: Severity, fix: str
) -> None:
    findings = list(judge(replace(FAST, **changes)))
    assert severity in severities(findings)
    assert fix in [command for found in findings for command in found.fix]


def test_limits_hold_at_their_end() -> None:
    at_end = replace(
        FAST, worst_gap_in_s=0.05, worst_gap_out_s=0.08, round_trip=Distribution.of([0.175])
    )
    assert severities(list(judge(at_end))) == {Severity.OK, Severity.NOTE}


def test_a_pause_of_this_computer_is_not_blamed_on_the_adapter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses = iter([0.5] + [0.0] * 100)

    @contextmanager
    def watched(**_: object) -> Iterator[Callable[[], float]]:
        yield lambda: next(pauses)

    monkeypatch.setattr(throughput, "_pauses_watched", watched)
    wire = wire_to(Battery())
    send, count = SimulatedLink.send, 0

    def slow_at_first(link: SimulatedLink, frame: Frame) -> None:
        nonlocal count
        count += 1
        if count == 2:
            wire.clock.wait_until(wire.clock.now() + 0.09)
        send(link, frame)

    monkeypatch.setattr(SimulatedLink, "send", slow_at_first)
    found = throughput.measure(wire.device("bms"))
    assert (found.set_aside, found.worst_pause_s) == (1, 0.5)
    assert found.round_trip is not None
    assert found.round_trip.count == QUERIES - 1
    assert found.round_trip.maximum_s < 0.05
