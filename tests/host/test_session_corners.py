"""Messages that are not expected any more: after the end, before the beginning, in between."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from flasher.errors import ExitCode
from flasher.host.guard import Guard
from flasher.host.identify import LISTEN_FIRST_S
from flasher.host.identity import CheckVerdict, DeviceAnswers, Identity, IdentityCheck, judge_device
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import ended_before_start
from flasher.host.session import Result, UpgradeSession
from flasher.host.table import Ending, UpgradeState
from flasher.host.upgrade import UpgradeStage
from flasher.image.image import Image
from flasher.image.plan import plan
from flasher.protocol.fields import Content, TextField, WireText, field
from flasher.protocol.frame import Frame
from flasher.protocol.spec import BMS, WELLING, WMC
from flasher.protocol.text import encode_text
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.settings.manifest import release_of
from tests.host.upgrade import Upgrade

IMAGE = Image.from_bytes(bytes(300))
PLAN = plan(IMAGE, BMS, WELLING.bitrate_bps)
FOREIGN = Frame(0x752, bytes.fromhex("55AA1102330000FF"))


def begun_message() -> Upgrade:
    """A host of whose reset one frame of two has left."""
    engine = Upgrade(PLAN)
    engine.tick(0.0)
    assert engine.next_frame(0.0) is not None
    engine.frame_sent(0.0)
    return engine


def test_an_adapter_that_comes_back_before_anything_began_changes_nothing() -> None:
    engine = Upgrade(PLAN)
    engine.link_back(0.0)
    engine.tick(0.0)
    assert engine.state is UpgradeState.RESETTING
    assert not engine.take_events()[1:]


def test_an_adapter_that_comes_back_after_the_users_word_finds_it_ended() -> None:
    engine = begun_message()
    engine.cancel(0.0)
    assert not engine.done, "the message is finished first"
    engine.link_back(0.1)
    assert engine.outcome.ending is Ending.CANCELLED
    assert engine.next_frame(0.1) is None


def test_a_second_tool_after_the_users_word_stops_the_rest_of_the_message() -> None:
    engine = begun_message()
    engine.cancel(0.0)
    engine.second_tool("a frame", 0.0)
    assert engine.outcome.ending is Ending.CANCELLED
    assert engine.next_frame(0.0) is None
    engine.second_tool("another frame", 0.1)
    assert engine.outcome.ending is Ending.CANCELLED


def test_a_session_that_has_ended_receives_and_sends_nothing_any_more() -> None:
    session = UpgradeSession(PLAN)
    session.tick(0.0)
    session.cancel(0.0)
    while (frame := session.next_frame(0.0)) is not None:
        assert frame.can_id == BMS.request_id
        session.frame_sent(0.0)
    assert session.done
    result = session.result
    session.receive(FOREIGN, 0.1)
    session.receive(Frame(0x725, bytes(8)), 0.1)
    session.tick(10.0)
    session.cancel(10.0)
    assert session.result is result
    assert session.deadline() is None
    assert session.next_frame(10.0) is None


def test_a_session_without_identity_asks_no_one_and_checks_nothing() -> None:
    session = UpgradeSession(PLAN)
    session.tick(0.0)
    assert session.next_frame(0.0) is None
    session.tick(LISTEN_FIRST_S)
    assert session.progress.startswith("resetting")
    frame = session.next_frame(LISTEN_FIRST_S)
    assert frame is not None
    assert frame.data.startswith(bytes.fromhex("55AA16074205"))


def test_what_others_get_is_no_matter_of_the_guard() -> None:
    guard = Guard(BMS, DEFAULT_TIMINGS)
    assert guard.see(Frame(0x751, b"\x55\xaa"), 0.0) is None
    assert guard.see(Frame(0x752, b"\x55\xaa"), 0.0) is not None


def test_a_target_without_a_version_query_cannot_be_asked() -> None:
    planned = plan(IMAGE, WMC, WELLING.bitrate_bps)
    stage = UpgradeStage(Upgrade(planned), planned, UpgradeOptions())
    with pytest.raises(RuntimeError, match="without a version query"):
        stage._query_version(None)


@dataclass(frozen=True)
class OnlyFirmware(Content):
    """What a version query of a product's own may answer: no hardware in it."""

    firmware_version: WireText = field(TextField(16))  # noqa: RUF009  as in contents


def test_a_device_that_does_not_report_its_hardware_is_refused_as_one_that_does_not_fit() -> None:
    release = release_of(IMAGE, BMS, hardware_versions=["V1r2r0_*"])
    noted = DeviceAnswers(OnlyFirmware(WireText(encode_text("V1r0r0_20220512", 16))))
    findings = list(judge_device(IMAGE, BMS, Identity(release), noted))
    hardware = next(found for found in findings if found.check is IdentityCheck.HARDWARE)
    assert hardware.verdict is CheckVerdict.REFUSED
    assert "does not report its hardware" in hardware.text
    assert hardware.ending is Ending.UNCHECKED


def test_an_up_to_date_device_is_no_error_and_has_an_exit_code_of_its_own() -> None:
    result = Result(ended_before_start(PLAN, Ending.UP_TO_DATE, "it runs it", duration_s=0.1))
    assert result.error() is None
    assert not result.ok
    assert result.exit_code == ExitCode.NOTHING_TO_DO
