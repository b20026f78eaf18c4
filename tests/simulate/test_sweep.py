"""Sweeps: their counts, that each part finds a mistake, and the arithmetic of errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from itertools import combinations
from typing import Final

import pytest

from flasher.protocol.timing import Timings
from flasher.simulate import crc_errors, sweep
from flasher.simulate import plan as plans
from flasher.simulate.crc_errors import ErrorsOfSize
from flasher.simulate.independent import ACK, BOOT_VERSION, END, PACKET
from flasher.simulate.plan import Plan, When
from flasher.simulate.planting import Bug, Edit, swapped, upgrade_bugs
from flasher.simulate.play import play
from flasher.simulate.sweep import DEVICES, Limit, Part, Trace, limits, parts, run, traced
from tests.loops import each

INDEPENDENT, MOCK = map(traced, DEVICES)
ACK_FRAMES = [When("frame", each.last) for each in MOCK.messages if each.command == ACK]
NOT_REACHED: Final[Mapping[str, str]] = {
    "packet_tries": "a number, not a time",
    "end_tries": "a number, not a time",
    "power_up_timeout_s": "the operator of a simulation follows each prompt within 4 s",
    "frame_gap_s": "a pause that the user asks for; no answer is awaited in it",
    "packet_gap_s": "a pause that the user asks for; no answer is awaited in it",
    "refused_hold_s": "the host has ended before a device that refused announces itself",
    "verification by memory": "plans verify by version",
}
"""Limits that no plan reaches, with the reason."""


def part_of(name: str, chosen: Callable[[Plan], bool] = lambda _plan: True) -> Part:
    """Return a part, with the cases that are chosen."""
    part = next(each for each in parts() if each.name == name)
    cases = [each for each in part.cases() if isinstance(each, Plan) and chosen(each)]
    return replace(part, count=len(cases), cases=lambda: iter(cases))


def mistake(name: str) -> Bug:
    return next(each for each in upgrade_bugs() if each.name == name)


def named(trace: Trace, name: str) -> list[Limit]:
    return [limit for limit in limits(trace) if limit.name == name]


# -- counts ----------------------------------------------------------------------------------------


def test_the_trace_of_an_upgrade_has_all_of_its_messages_and_flash_operations() -> None:
    for trace, erasures in ((INDEPENDENT, 1), (MOCK, 2)):
        assert len({each.command for each in trace.messages}) == 13
        assert len(trace.operations) == erasures + 4 + 1
        assert [trace.of(PACKET, turn).last for turn in (0, 3)] == [48, 108]
        assert sum(each.last - each.first + 1 for each in trace.messages) == len(trace.frames)


@pytest.mark.slow
def test_the_parts_have_as_many_cases_as_they_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep, "_PAIRED", [plans.Drop()])
    for part in parts():
        number, sample = 0, []
        for number, case in enumerate(part.cases(), 1):
            if number % 50 == 0:
                sample.append(str(case))
        assert number == part.count, part.name
        assert len({*sample}) == len(sample)
        assert all(str(Plan.parse(text)) == text for text in sample)


@pytest.mark.slow
def test_the_pairs_are_of_all_frames_and_all_faults() -> None:
    number = len(INDEPENDENT.frames)
    pairs = next(each for each in parts() if each.name == "pairs")
    assert len(MOCK.frames) == number
    assert pairs.count == 2 * 16 * number * (number - 1) // 2


@pytest.mark.slow
def test_each_frame_has_each_fault_and_each_bit() -> None:
    part = part_of("frames")
    faults = [next(iter(case.events)) for case in part.cases() if isinstance(case, Plan)]
    ends = (8 * len(frame.data) for trace in (INDEPENDENT, MOCK) for _, _, frame in trace.frames)
    assert sum(isinstance(each, plans.Flip) for each in faults) == sum(ends)
    for kind in (plans.Drop, plans.Double, plans.Swap, plans.Delay):
        numbers = [each.when.number for each in faults if isinstance(each, kind) and each.when]
        assert numbers == [*range(1, len(INDEPENDENT.frames) + 1)] * 2


@each("every, expected", [(1, "abcdefg"), (3, "adg"), (9, "a")])
def test_a_share_of_a_part_has_every_so_manyth_case(every: int, expected: str) -> None:
    part = Part("letters", "", 7, lambda: iter("abcdefg")).taken(every)  # type: ignore[arg-type]
    assert "".join(map(str, part.cases())) == expected
    assert part.count == len(expected)


def test_each_time_limit_of_the_timings_is_met_or_has_a_reason() -> None:
    met = {limit.name for trace in (INDEPENDENT, MOCK) for limit in limits(trace)}
    timings = {each.name for each in fields(Timings)}
    assert timings <= met | NOT_REACHED.keys()
    assert not met & NOT_REACHED.keys()


# -- running ---------------------------------------------------------------------------------------


def test_a_part_reports_its_progress_and_can_be_stopped() -> None:
    seen: list[tuple[int, int]] = []
    part = part_of("limits")
    result = run(part, lambda: len(seen) == 2, lambda *counts: seen.append(counts))
    assert seen == [(1, 0), (2, 0)]
    assert (result.name, result.runs, result.endings) == ("limits", 2, {"completed": 2})


def test_a_part_ends_at_its_first_violation_and_gives_its_plan() -> None:
    part = part_of("limits")
    with swapped(mistake("crc-without-the-id").codes()):
        result = run(part, violations_max=1)
    assert result.runs == 1
    first = next(part.cases())
    assert [each.plan for each in result.violations] == [str(first)]


# -- each part finds a mistake ---------------------------------------------------------------------


def drops_an_answer(case: Plan) -> bool:
    [fault] = case.events
    return is_mock(case) and isinstance(fault, plans.Drop) and fault.when in ACK_FRAMES


def cuts_a_flash_operation(case: Plan) -> bool:
    cut, *more = case.events
    return is_mock(case) and not more and cut.when is not None and cut.when.what == "flash"


def has_early_deadline(case: Plan) -> bool:
    return 0 < case.job.timeout < MOCK.of(END).ends


def is_mock(case: Plan) -> bool:
    return isinstance(case.devices[0], plans.Mock)


@pytest.mark.slow
@each(
    "name, chosen, bug, kind",
    [
        ("frames", drops_an_answer, "repeated-packet-stored-as-the-next", "CRASH"),
        ("power", cuts_a_flash_operation, "cut-ends-the-flash-operation", "CRASH"),
        ("limits", has_early_deadline, "deadline-waits-for-a-timer", "LATE"),
    ],
)
def test_a_part_finds_a_planted_mistake(
    name: str, chosen: Callable[[Plan], bool], bug: str, kind: str
) -> None:
    part = part_of(name, chosen)
    with swapped(mistake(bug).codes()):
        [found] = run(part, violations_max=1).violations
    assert found.kind == kind
    assert play(Plan.parse(found.plan)).violations == ()


# -- the limits are met ----------------------------------------------------------------------------


@each("name, command", [("ack_timeout_s", PACKET), ("complete_timeout_s", END)])
def test_a_message_is_repeated_if_its_answer_is_later_than_the_limit(
    name: str, command: int
) -> None:
    for trace in (INDEPENDENT, MOCK):
        early, late = (traced_of(named(trace, name)[0].plan(beside)) for beside in (-1e-3, 1e-3))
        sent = [sum(each.command == command for each in trace.messages) for trace in (early, late)]
        assert sent[1] == sent[0] + 1


def test_a_device_leaves_its_transfer_when_the_host_pauses_longer_than_the_limit() -> None:
    for trace in (INDEPENDENT, MOCK):
        [limit] = named(trace, "session")
        early, late = (traced_of(limit.plan(beside)) for beside in (-1e-3, 1e-3))
        boots = [
            sum(each.command == BOOT_VERSION for each in trace.messages) for trace in (early, late)
        ]
        assert boots[0] == 1 < boots[1]


def traced_of(plan: Plan) -> Trace:
    device = plan.devices[0]
    return traced(device, *(each for each in plan.clauses if each not in (device, plan.job)))


# -- errors of messages ----------------------------------------------------------------------------


def short_crc() -> Bug:
    end = '.translate(_MIRROR), "big")'
    return Bug("short-crc", "", [Edit("flasher/protocol/crc.py", end, f"{end} & 0x3F")])


def test_a_crc_of_messages_detects_all_errors_of_few_bits() -> None:
    counts, violations = ErrorsOfSize(13).examine()
    assert violations == []
    assert counts["1 bit: detected"] == 8 * 13
    assert counts["2 bits: detected"] == 64 * 63 // 2
    assert counts["3 bits: detected"] == 64 * 63 * 62 // 6


def test_a_receiver_that_compares_no_crc_is_found() -> None:
    edit = Edit("flasher/protocol/wire.py", "if not self._crc_fits(wire):", "if False:")
    with swapped(Bug("no-crc", "", [edit]).codes()):
        _, violations = ErrorsOfSize(13).examine()
    assert {each.kind for each in violations} == {"UNDETECTED"}
    assert "errors of a message of 13 bytes (1 bit)" in violations[0].text


@pytest.mark.slow
def test_the_errors_that_a_short_crc_misses_are_as_many_as_those_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A CRC of 6 bits misses many, and is affine too."""
    monkeypatch.setattr(crc_errors, "BURST_BITS", 10)
    size = 11
    bits = [1 << 8 * (size - place) - 1 - bit for place in (2, 4, 6, 7, 8, 9) for bit in range(8)]
    rest = sum(1 << 8 * (size - 1 - place) for place in (0, 1, 3, 5, 10)) * 0xFF
    tried = {
        "2 bits": map(sum, combinations(bits, 2)),
        "3 bits": map(sum, combinations(bits, 3)),
        "burst": (
            pattern << low
            for low in range(8 * size)
            for pattern in range(1, 1 << 10, 2)
            if not (pattern << low) & rest and pattern << low < 1 << 8 * size
        ),
    }
    with swapped(short_crc().codes()):
        counts, violations = ErrorsOfSize(size).examine()
        for kind, each_error in tried.items():
            found = crc_errors.received(kind, crc_errors.message_of(size), each_error)
            assert found == {name: counts[name] for name in found}
            assert found[f"{kind}: undetected"] > 0
    assert len(violations) >= len(tried)
