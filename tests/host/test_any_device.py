"""Whatever a device says, and whenever: the host ends explicitly and does no harm (SE-01/03).

Hypothesis plays the device. What must hold is watched on the wire: update commands answer something
new, none follows end of transfer except to a device beyond its burst, every message is whole.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flasher import events
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import DeviceLeft
from flasher.protocol.frame import Frame
from flasher.protocol.messages import (
    Ack,
    BootVersion,
    Complete,
    EndOfTransfer,
    GeneralFeedbackMessage,
    Nak,
    RequestTransfer,
    UpdateCommand,
    UpgradeMessage,
)
from tests.host.bench import Bench

TIMEOUT_S = 60.0

rows = st.one_of(
    st.builds(Ack, st.integers(0, 4)),
    st.builds(Nak, st.integers(0, 4)),
    st.sampled_from([BootVersion("BMS", "V1.2.3"), BootVersion("BMS", "V1.2.4")]),
    st.just(BootVersion("BMS", "V1.2.3")),
    st.just(RequestTransfer()),
    st.just(Complete()),
    st.just(GeneralFeedbackMessage()),
)
frames = st.builds(
    Frame,
    st.sampled_from([0x725, 0x720, 0x752, 0x000]),
    st.binary(max_size=8),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
pauses = st.sampled_from([0.0, 0.001, 0.02, 0.05, 0.1, 0.5, 1.0, 5.0, 10.0])
script = st.lists(st.tuples(pauses, st.one_of(rows, rows, rows, frames)), max_size=40)


@pytest.mark.slow
@given(script)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_the_host_ends_explicitly_whatever_the_device_answers(
    steps: list[tuple[float, UpgradeMessage | Frame]],
) -> None:
    bench = Bench(300, options=UpgradeOptions(timeout_s=TIMEOUT_S, attempts=2))
    reported: list[tuple[float, UpgradeMessage]] = []
    for pause_s, what in steps:
        bench.wait(pause_s)
        if isinstance(what, Frame):
            bench.engine.receive(what, bench.now)
        else:
            reported.append((bench.now, what))
            bench.say(what)
    bench.wait(TIMEOUT_S + 1.0)
    outcome = bench.outcome
    assert (outcome.error() is None) == outcome.ok
    assert len(bench.seen(events.AttemptStarted)) <= 1
    _watch_update_commands(bench, reported)


def _watch_update_commands(bench: Bench, reported: list[tuple[float, UpgradeMessage]]) -> None:
    commands = [at for at, row in bench.sent if isinstance(row, UpdateCommand)]
    asking = [at for at, row in reported if isinstance(row, BootVersion | RequestTransfer)]
    assert len(commands) <= len(asking)
    for earlier, later in pairwise(commands):
        assert later - earlier >= 0.03
    ends = [at for at, row in bench.sent if isinstance(row, EndOfTransfer)]
    if ends and not bench.seen(events.AttemptStarted):
        assert all(at < ends[0] for at in commands)
    if not commands:
        assert bench.outcome.device_left is DeviceLeft.UNTOUCHED


@pytest.mark.slow
@given(script, st.booleans(), st.integers(1, 2))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_one_update_command_at_most_goes_into_silence_and_none_to_an_application(
    steps: list[tuple[float, UpgradeMessage | Frame]],
    at_power_up: bool,
    attempts: int,
) -> None:
    """R26, for a device that an earlier upgrade may have left in its session."""
    options = UpgradeOptions(
        timeout_s=120.0, attempts=attempts, in_session=True, at_power_up=at_power_up
    )
    bench = Bench(300, options=options)
    reported: list[tuple[float, UpgradeMessage]] = []
    for pause_s, what in steps:
        bench.wait(pause_s)
        if not isinstance(what, Frame):
            reported.append((bench.now, what))
            bench.say(what)
    bench.wait(121.0)
    commands = [at for at, row in bench.sent if isinstance(row, UpdateCommand)]
    asking = [at for at, row in reported if isinstance(row, BootVersion | RequestTransfer)]
    assert len(commands) <= len(asking) + bench.outcome.sent_into_silence

    def unheard(until_s: float) -> list[float]:
        """The commands before which nothing was sent for the erase limit, until so long before."""
        return [
            at
            for at in commands
            if not any(at - 9.9 < each <= at - until_s for each, _ in reported)
        ]

    leaving_s = 0.0015  # what arrives while it leaves does not call it back
    assert len(unheard(0.0)) <= bench.outcome.sent_into_silence <= len(unheard(leaving_s))
    for at in unheard(0.0):
        if at == commands[0]:
            assert GeneralFeedbackMessage() not in [
                row for sent_at, row in reported if sent_at < at
            ]


@pytest.mark.slow
@given(st.lists(rows, min_size=1, max_size=6))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_memory_and_time_are_bounded_when_a_device_repeats_itself_for_ever(
    babble: list[UpgradeMessage],
) -> None:
    """SE-01: endless valid messages of no use."""
    bench = Bench(300, options=UpgradeOptions(timeout_s=5.0))
    turns = 0
    while not bench.engine.done:
        bench.say(babble[turns % len(babble)])
        bench.wait(0.01)
        turns += 1
        assert turns < 600
    assert not bench.engine._listening
