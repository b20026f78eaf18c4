"""How a write ended, by what was confirmed and what was read back."""

from __future__ import annotations

import pytest

from flasher.errors import ErrorCode, UsageError
from flasher.host.write import WriteResult, plan_write
from flasher.protocol.contents import CheckCode, ProductionInformation
from flasher.protocol.fields import Content, WireText
from flasher.protocol.spec import BMS
from tests.loops import each

MADE = ProductionInformation.from_data(b"ACME.   SUZHOU. 20260517" + bytes(8))
ELSEWHERE = ProductionInformation.from_data(b"ACME.   WUXI.   20260518" + bytes(8))
PLAN = plan_write("production-information", [MADE], manufacturer=True)


def test_what_is_confirmed_and_reads_back_as_it_was_written_is_good() -> None:
    written = WriteResult(PLAN, ELSEWHERE, is_confirmed=True, read_back=MADE)
    assert written.error() is None
    assert written.differences == ()
    changes = {each.name: (each.old, each.new, each.read_back) for each in written.changes}
    assert changes == {
        "manufacturer": ("ACME", "ACME", "ACME"),
        "place": ("WUXI", "SUZHOU", "SUZHOU"),
        "date": ("2026-05-18", "2026-05-17", "2026-05-17"),
    }


DIFFERS = "but reads back place 'WUXI' instead of 'SUZHOU'."


@each(
    "is_confirmed, read_back, what",
    [
        (True, ELSEWHERE, f"The BMS confirmed the new production-information, {DIFFERS}"),
        (False, ELSEWHERE, f"The BMS did not confirm the new production-information, {DIFFERS}"),
        (True, None, "The BMS was sent the new production-information but did not read it back."),
        (False, None, "The BMS was sent the new production-information but did not confirm it."),
        (False, MADE, "did not confirm it; it does read back as written."),
    ],
)
def test_the_error_states_what_is_missing_or_the_first_field_that_differs(
    *, is_confirmed: bool, read_back: Content | None, what: str
) -> None:
    error = WriteResult(PLAN, None, is_confirmed=is_confirmed, read_back=read_back).error()
    assert error is not None
    assert error.what.endswith(what)
    assert error.code is ErrorCode.WRITE_DIFFERS


def test_what_is_not_known_of_a_field_is_none() -> None:
    (change,) = WriteResult(
        plan_write("user-string-1", ["RACK 7"]), None, is_confirmed=False, read_back=None
    ).changes
    assert (change.name, change.unit) == ("text", "")
    assert (change.old, change.new, change.read_back) == (None, "RACK 7", None)
    assert not change.differs


def test_a_finished_content_is_taken_as_it_is_and_only_alone() -> None:
    code = CheckCode(b"\x5a" * 12)
    assert plan_write("check-code", [code]).content is code
    with pytest.raises(UsageError, match="takes 1 value; 2 were given"):
        plan_write("check-code", ["5a" * 12, code])
    with pytest.raises(UsageError, match="takes 1 value; 2 were given"):
        plan_write("check-code", [code, code])


def test_only_the_manufacturer_writes_what_the_document_reserves_for_him() -> None:
    with pytest.raises(UsageError, match="reserves writing the model for the manufacturer"):
        plan_write("model", ["BM48"])
    plan = plan_write("model", ["BM48"], manufacturer=True)
    assert (plan.target, plan.content.data()) == (BMS, b"BM48.           ")
    assert (
        plan_write("model", [WireText(b"BM48" * 4)], manufacturer=True).content.data()
        == b"BM48" * 4
    )
