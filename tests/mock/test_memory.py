"""The flash is as strict as a real part, and an operation cut short stays torn."""

from __future__ import annotations

from math import inf

import pytest

from flasher.mock.memory import (
    FlashAlignmentError,
    FlashController,
    FlashMemory,
    FlashNotErasedError,
    FlashRangeError,
    Operation,
)
from tests.loops import each

START = 0x1000
PAGE = 32
UNIT = 8


def make_flash() -> FlashMemory:
    return FlashMemory(START, 4 * PAGE, page_size_bytes=PAGE, program_unit_bytes=UNIT)


def make_controller(flash: FlashMemory) -> FlashController:
    return FlashController(flash, erase_time_s=1.0, program_time_s=0.1)


def test_a_fresh_flash_reads_as_erased() -> None:
    assert make_flash().read(START, 4 * PAGE) == b"\xff" * 4 * PAGE


def test_what_is_programmed_is_read_back_and_its_neighbours_are_untouched() -> None:
    flash = make_flash()
    flash.program(START + 8, bytes(range(16)))
    assert flash.read(START, PAGE) == b"\xff" * 8 + bytes(range(16)) + b"\xff" * 8
    assert (flash.erase_count, flash.program_count) == (0, 1)


def test_erasing_a_page_leaves_the_others() -> None:
    flash = make_flash()
    flash.program(START, b"\x00" * 2 * PAGE)
    flash.erase_page(START)
    assert flash.read(START, 2 * PAGE) == b"\xff" * PAGE + b"\x00" * PAGE
    assert flash.erase_count == 1


@each("content", [b"\x00" * UNIT, b"\xff" * UNIT])
def test_a_unit_is_programmed_only_once_even_with_ff(content: bytes) -> None:
    flash = make_flash()
    flash.program(START, content)
    with pytest.raises(FlashNotErasedError, match="without having been erased"):
        flash.program(START, content)
    flash.erase_page(START)
    flash.program(START, b"\x55" * UNIT)
    assert flash.read(START, UNIT) == b"\x55" * UNIT


def test_a_program_that_reaches_into_a_programmed_unit_changes_nothing() -> None:
    flash = make_flash()
    flash.program(START + UNIT, b"\x00" * UNIT)
    with pytest.raises(FlashNotErasedError):
        flash.program(START, b"\x11" * 2 * UNIT)
    assert flash.read(START, 2 * UNIT) == b"\xff" * UNIT + b"\x00" * UNIT


@each("address, size", [(START + 4, 8), (START, 7), (START, 0), (START, 12)])
def test_a_program_off_the_unit_is_refused(address: int, size: int) -> None:
    with pytest.raises(FlashAlignmentError, match="8 bytes a unit"):
        make_flash().program(address, b"\x00" * size)


@each("address", [START - 8, START + 4 * PAGE - 8, START + 4 * PAGE, 0])
def test_outside_nothing_is_programmed_or_read(address: int) -> None:
    flash = make_flash()
    with pytest.raises(FlashRangeError, match="outside the flash"):
        flash.program(address, b"\x00" * 16)
    with pytest.raises(FlashRangeError):
        flash.read(address, 16)


def test_a_page_is_erased_from_its_beginning_and_inside_only() -> None:
    flash = make_flash()
    with pytest.raises(FlashAlignmentError, match="no page begins"):
        flash.erase_page(START + UNIT)
    with pytest.raises(FlashRangeError):
        flash.erase_page(START + 4 * PAGE)
    assert flash.erase_count == 0


@each("size, page, unit", [(100, 32, 8), (128, 32, 5)])
def test_sizes_that_do_not_divide_each_other_are_an_error(size: int, page: int, unit: int) -> None:
    with pytest.raises(ValueError, match="whole"):
        FlashMemory(START, size, page_size_bytes=page, program_unit_bytes=unit)


# -- torn operations ------------------------------------------------------------------------------


def test_a_torn_erase_is_erased_in_part_and_cannot_be_programmed_anywhere() -> None:
    flash = make_flash()
    flash.program(START + UNIT, b"\x00" * (PAGE - UNIT))
    flash.tear_erase(START, 0.5)
    assert flash.read(START, PAGE) == b"\xff" * 16 + b"\x00" * 16
    assert flash.erase_count == 0
    with pytest.raises(FlashNotErasedError):
        flash.program(START, b"\x00" * UNIT)
    flash.erase_page(START)
    flash.program(START, b"\x00" * UNIT)


def test_a_torn_program_has_whole_units_and_half_a_unit() -> None:
    flash = make_flash()
    flash.tear_program(START, b"\x00" * PAGE, 0.5)
    assert flash.read(START, PAGE) == b"\x00" * 20 + b"\xff" * 12
    with pytest.raises(FlashNotErasedError):
        flash.program(START + 16, b"\x00" * UNIT)
    flash.program(START + 24, b"\x00" * UNIT)


def test_a_tear_at_the_very_end_leaves_the_size_of_the_memory() -> None:
    flash = make_flash()
    flash.tear_program(START, b"\x00" * PAGE, 1.0)
    flash.tear_erase(START + PAGE, 1.0)
    assert flash.read(START, PAGE) == b"\x00" * 28 + b"\xff" * 4
    assert len(flash.read(START, 4 * PAGE)) == 4 * PAGE


# -- the controller -------------------------------------------------------------------------------


def test_operations_take_their_time_one_after_another() -> None:
    flash = make_flash()
    controller = make_controller(flash)
    controller.run([Operation(START), Operation(START, b"\x00" * UNIT)], 10.0)
    assert controller.ends_at == 11.0
    assert not controller.advance(10.9)
    assert flash.erase_count == 0
    assert not controller.advance(11.0)
    assert (flash.erase_count, flash.program_count) == (1, 0)
    assert controller.ends_at == pytest.approx(11.1)
    assert controller.advance(11.2)
    assert flash.program_count == 1
    assert controller.ends_at == inf


def test_late_attention_does_not_delay_what_follows() -> None:
    flash = make_flash()
    controller = make_controller(flash)
    controller.run([Operation(START), Operation(START + PAGE)], 10.0)
    assert controller.advance(12.0)
    assert flash.erase_count == 2


def test_new_operations_wait_for_the_one_under_way_and_replace_the_waiting_ones() -> None:
    flash = make_flash()
    controller = make_controller(flash)
    controller.run([Operation(START, b"\x00" * UNIT), Operation(START + PAGE)], 10.0)
    controller.run([Operation(START)], 10.05)
    assert controller.ends_at == pytest.approx(10.1)
    assert controller.advance(20.0)
    assert (flash.program_count, flash.erase_count) == (1, 1)
    assert flash.read(START, UNIT) == b"\xff" * UNIT


@each("cut_at_s, erased_bytes", [(10.0, 0), (10.25, 8), (10.75, 24), (11.0, 32), (99.0, 32)])
def test_an_aborted_erase_is_as_torn_as_its_time(cut_at_s: float, erased_bytes: int) -> None:
    flash = make_flash()
    flash.program(START, b"\x00" * PAGE)
    controller = make_controller(flash)
    controller.run([Operation(START)], 10.0)
    controller.abort(cut_at_s)
    assert flash.read(START, PAGE) == b"\xff" * erased_bytes + b"\x00" * (PAGE - erased_bytes)
    assert flash.erase_count == (erased_bytes == PAGE)
    assert controller.ends_at == inf


def test_an_aborted_program_is_torn_and_the_operations_after_it_are_forgotten() -> None:
    flash = make_flash()
    controller = make_controller(flash)
    controller.run(
        [Operation(START, b"\x00" * PAGE), Operation(START + PAGE, b"\x00" * UNIT)], 10.0
    )
    controller.abort(10.05)
    assert controller.advance(99.0)
    assert flash.read(START, PAGE) == b"\x00" * 20 + b"\xff" * 12
    assert flash.read(START + PAGE, UNIT) == b"\xff" * UNIT
    assert flash.program_count == 0
