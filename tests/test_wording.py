"""Every word that programs see has its text for people, and every text its word."""

from __future__ import annotations

from enum import Enum

from flasher import wording
from flasher.bus.health import ControllerState
from flasher.events import Phase
from flasher.host.outcome import DeviceLeft
from flasher.host.table import Ending, Reason
from flasher.host.verify import Verdict
from flasher.protocol.wire import DamageReason
from flasher.trace import decoder
from flasher.trace.story import Cause, TalkerKind
from tests.loops import each

TOLD: tuple[type[Enum], ...] = (
    Cause,
    ControllerState,
    DamageReason,
    DeviceLeft,
    Ending,
    Phase,
    Reason,
    TalkerKind,
    Verdict,
    decoder.Kind,
)


@each("noted", TOLD)
def test_every_member_has_a_word_and_a_text(noted: type[Enum]) -> None:
    for member in noted:
        assert member.value == member.name.lower()
        assert wording.wording(member)
    assert wording._TEXTS[noted.__name__].keys() == {member.value for member in noted}


def test_nothing_else_is_in_the_catalogue() -> None:
    assert wording._TEXTS.keys() == {noted.__name__ for noted in TOLD}
    assert wording._EXPLANATIONS.keys() <= {cause.value for cause in Cause}


def test_a_word_that_is_not_known_stays_itself() -> None:
    assert wording.wording_of("DamageReason", "bad_crc") == "wrong CRC"
    assert wording.wording_of("DamageReason", "cut short") == "cut short"
