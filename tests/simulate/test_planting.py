"""Mistakes that are planted in the running process, and those that a campaign has to find."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from types import CodeType, FunctionType

import pytest

from flasher.bus.link import VirtualClock
from flasher.bus.simulated import SimulatedBus
from flasher.host.options import UpgradeOptions
from flasher.host.query import memory_requests
from flasher.image.image import Image
from flasher.protocol.crc import crc32
from flasher.protocol.spec import WELLING
from flasher.simulate.plan import Plan
from flasher.simulate.planting import ROOT, Bug, Edit, UpgradeBug, swapped, upgrade_bugs
from flasher.simulate.play import play
from tests.loops import each

BUGS = upgrade_bugs()
PARTS = {"host": 23, "bootloader": 12, "driver": 8, "bus": 7, "image": 4}


def bug(file: str, old: str, new: str) -> Bug:
    return Bug("wrong-one", "", [Edit(file, old, new)])


def functions_of(file: str) -> Iterator[FunctionType]:
    """Functions and methods of a module."""
    module = import_module(file.removesuffix(".py").replace("/", "."))
    classes = [found for found in vars(module).values() if isinstance(found, type)]
    for names in (vars(module), *map(vars, classes)):
        for found in names.values():
            parts = [getattr(found, key, None) for key in ("__func__", "fget", "fset")]
            yield from (part for part in (found, *parts) if isinstance(part, FunctionType))


def codes_of(bug: Bug) -> dict[FunctionType, CodeType]:
    """Code that the functions of all changed modules have now."""
    files = {edit.file for edit in bug.edits}
    return {each: each.__code__ for file in files for each in functions_of(file)}


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_mistake_is_in_the_process_until_the_end_of_its_block(bug: Bug) -> None:
    codes = bug.codes()
    before = codes_of(bug)
    changed = dict(codes)

    with swapped(codes):
        inside = codes_of(bug)
        with swapped(codes):
            assert codes_of(bug) == before
        assert codes_of(bug) == inside

    assert {one: code for one, code in inside.items() if code is not before[one]} == changed
    assert all(code is before[one] for one, code in codes_of(bug).items())


@pytest.mark.slow
@each("bug", [bug for bug in BUGS if len(bug.edits) > 1])
def test_every_edit_of_a_mistake_changes_a_function(bug: Bug) -> None:
    for edit in bug.edits:
        assert replace(bug, edits=[edit]).codes()


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_mistake_spoils_its_plan(bug: UpgradeBug) -> None:
    plan = Plan.parse(bug.plan)
    verdict = play(plan)
    with swapped(bug.codes()):
        spoiled = play(plan)

    assert verdict.violations == ()
    assert bug.kind in {each.kind for each in spoiled.violations}, spoiled


def test_the_mistakes_are_as_many_as_promised_and_have_names_of_their_own() -> None:
    assert len({bug.name for bug in BUGS}) == len(BUGS) == sum(PARTS.values())
    assert {part: sum(bug.part == part for bug in BUGS) for part in PARTS} == PARTS
    assert all(bug.breaks.endswith(".") and 1 <= len(bug.edits) <= 2 for bug in BUGS)


def test_a_mistake_is_taken_out_after_an_exception() -> None:
    codes = bug("flasher/protocol/crc.py", "^ 0xFFFFFFFF", "").codes()
    right = crc32(b"1")

    with suppress(KeyError), swapped(codes):
        assert crc32(b"1") != right
        raise KeyError
    assert crc32(b"1") == right


def test_a_property_a_class_method_and_a_generator_can_be_changed() -> None:
    options = UpgradeOptions()
    fewer = bug(
        "flasher/host/options.py",
        "return DEFAULT_ATTEMPTS if self.attempts is None",
        "return 1 if self.attempts is None",
    )
    nameless = bug("flasher/image/image.py", "source=source,", 'source="",')
    none = bug("flasher/host/query.py", "for at in range(start, end, ", "for at in range(0, 0, ")
    with swapped(fewer.codes()), swapped(nameless.codes()), swapped(none.codes()):
        assert options.planned_attempts == 1
        assert Image.from_bytes(b"1", source="a").source == ""
        assert list(memory_requests(0, 1)) == []
    assert options.planned_attempts == 3
    assert Image.from_bytes(b"1", source="a").source == "a"
    assert len(list(memory_requests(0, 1))) == 1


def test_a_setter_is_not_taken_for_its_getter() -> None:
    bus = SimulatedBus(WELLING.bitrate_bps, VirtualClock())
    never = bug("flasher/bus/simulated.py", "alone=alone)", "alone=False)")
    with swapped(never.codes()):
        bus.is_unacknowledged = True
        assert bus.is_unacknowledged is False
    bus.is_unacknowledged = True
    assert bus.is_unacknowledged is True


def test_a_changed_line_number_changes_no_function() -> None:
    below = bug("flasher/protocol/crc.py", "    widened =", "\n\n    widened =")
    with pytest.raises(ValueError, match="wrong-one: changes no function"):
        below.codes()


@each(
    "file, old, new, problem",
    [
        ("driver.py", "no such text", "", "wrong-one: 'no such text' is 0 times in"),
        ("driver.py", "now", "then", "wrong-one: 'now' is [0-9]+ times in flasher/driver.py"),
        ("driver.py", "MAX_WAIT_S: Final = 0.1", "MAX_WAIT_S: Final = 1", "more than bodies"),
        ("driver.py", "link.drain()", "link.drain(", "wrong-one: .* is not Python any more"),
        ("protocol/crc.py", "(data: bytes)", "(data: bytes, seed: int = 0)", "more than bodies"),
        (
            "mock/machine.py",
            "return self._runs_application\n",
            "return super()._runs_application\n",
            "wrong-one: Unit.has_power in flasher/mock/machine.py uses other variables",
        ),
    ],
)
def test_a_bad_edit_is_refused_with_its_name(file: str, old: str, new: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        bug(f"flasher/{file}", old, new).codes()


def test_a_function_that_is_not_as_in_its_file_is_refused() -> None:
    one = bug("flasher/protocol/crc.py", "^ 0xFFFFFFFF", "")
    another = bug("flasher/protocol/crc.py", "widened[3::4]", "widened[2::4]")
    with swapped(one.codes()), pytest.raises(ValueError, match="is not in this process"):
        another.codes()


def test_files_are_read_where_the_package_is() -> None:
    assert (ROOT / "flasher" / "simulate" / "planting.py").is_file()
