"""Flash memory that fails where the suite wants it to."""

from __future__ import annotations

import pytest

from flasher.conformance.dut.failing_flash import FailingFlash
from flasher.conformance.subject import FlashCall, FlashEffect, FlashFault
from flasher.mock.memory import FlashMemory, FlashNotErasedError, Operation

START = 0x8000
SECTOR = 64
DATA = bytes(range(8))


def flash(call: FlashCall, effect: FlashEffect, number: int = 0) -> FailingFlash:
    memory = FlashMemory(START, 4 * SECTOR, page_size_bytes=SECTOR, program_unit_bytes=8)
    made = FailingFlash(memory)
    made.fail(FlashFault(call, number, effect))
    return made


def write(made: FailingFlash, address: int, data: bytes = DATA) -> bool:
    return made.execute(Operation(address, data), 1.0)


def erase(made: FailingFlash, address: int = START) -> bool:
    return made.execute(Operation(address), 2.0)


def test_a_write_that_reports_an_error_stores_nothing_and_can_be_repeated() -> None:
    made = flash(FlashCall.WRITE, FlashEffect.ERROR, number=1)
    assert [write(made, START), write(made, START + 8), write(made, START + 8)] == [
        True,
        False,
        True,
    ]
    assert made.failed_at == 1.0
    assert made.calls == {FlashCall.WRITE: 3}
    assert made.read(START, 24, 0.0) == DATA + DATA + 8 * b"\xff"


def test_a_sector_that_was_not_erased_keeps_its_zeros_until_it_is() -> None:
    made = flash(FlashCall.ERASE, FlashEffect.ERROR)
    assert write(made, START, 8 * b"\xf0")
    assert not erase(made)
    assert write(made, START, 8 * b"\x3c")
    assert made.read(START, 8, 0.0) == 8 * b"\x30"
    assert erase(made)
    assert write(made, START)
    assert made.read(START, 8, 0.0) == DATA
    with pytest.raises(FlashNotErasedError):
        write(made, START)


def test_a_worn_out_sector_fails_until_the_fault_ends() -> None:
    made = flash(FlashCall.WRITE, FlashEffect.WORN_SECTOR)
    assert not write(made, START + SECTOR)
    assert not write(made, START + SECTOR + 8)
    assert not write(made, START + SECTOR - 8, 2 * DATA)  # it begins before the sector
    assert not erase(made, START + SECTOR)
    assert erase(made)
    assert write(made, START)
    made.fail(None)
    assert made.failed_at is None
    assert erase(made, START + SECTOR)
    assert write(made, START + SECTOR)
    assert made.read(START + SECTOR, 8, 0.0) == DATA


def test_a_write_over_two_sectors_of_which_one_was_not_erased() -> None:
    made = flash(FlashCall.ERASE, FlashEffect.ERROR)
    assert write(made, START + SECTOR, 8 * b"\xf0")
    assert not erase(made, START + SECTOR)
    assert write(made, START + SECTOR - 8, 8 * b"\x01" + 8 * b"\x3c")
    assert made.read(START + SECTOR - 8, 16, 0.0) == 8 * b"\x01" + 8 * b"\x30"


def test_a_bit_stays_1_in_each_write_of_its_byte() -> None:
    made = flash(FlashCall.WRITE, FlashEffect.WRONG_BIT)
    for _ in range(2):
        assert write(made, START, b"\xff\xf3" + bytes(6))
        assert made.read(START, 8, 0.0) == b"\xff\xf7" + bytes(6)
        assert erase(made)
    assert write(made, START + 8, 8 * b"\0")
    assert made.read(START + 8, 8, 0.0) == 8 * b"\0"


def test_a_bit_is_read_wrong_once() -> None:
    made = flash(FlashCall.READ, FlashEffect.WRONG_BIT, number=1)
    assert [made.read(START, 2, 3.0) for _ in range(3)] == [b"\xff\xff", b"\xfe\xff", b"\xff\xff"]
    assert made.failed_at == 3.0
