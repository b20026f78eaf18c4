"""Replayed traces: the same answers, other answers, a slower device, a crash."""

from __future__ import annotations

from pathlib import Path

import pytest

from flasher.conformance.mock import MockSubject
from flasher.conformance.replay import recording, replay
from flasher.conformance.restore import restore
from flasher.conformance.wire import RawFrame
from flasher.errors import UsageError
from flasher.protocol.spec import TARGETS
from flasher.trace.reader import read_trace
from tests.cli.conftest import Flasher

from .bench import PROFILE

MOCK = ("-t", "bms", "--mock")
WRONG = (*MOCK, "--variant", "accepts-early-end")


@pytest.fixture
def trace(flasher: Flasher, tmp_path: Path) -> Path:
    """The trace of a failed case."""
    words = ("conformance", *WRONG, "--case", "EN-02", "--trace-dir", tmp_path)
    assert flasher(*words).code == 12
    return tmp_path / "EN-02.log"


def test_the_same_device_answers_as_in_the_trace(flasher: Flasher, trace: Path) -> None:
    ran = flasher("conformance", "replay", trace, *WRONG)
    assert ran.code == 0
    assert ran.out.endswith("the device answers as in the trace\n")


def test_a_mended_device_answers_differently(flasher: Flasher, trace: Path) -> None:
    ran = flasher("conformance", "replay", trace, *MOCK)
    assert ran.code == 12
    assert ran.out.splitlines()[1:] == [
        "- complete",
        "+ NAK number 1",
        "the device answers differently",
    ]
    document = flasher("--json", "conformance", "replay", trace, *MOCK).document
    assert document["differences"] == [{"recorded": ["complete"], "answered": ["NAK number 1"]}]


def test_a_slower_device_gets_the_next_frame_after_its_answer(
    flasher: Flasher, trace: Path
) -> None:
    slow = ("--set", "erase_time_s=1.5", "--set", "program_time_s=0.1")
    assert flasher("conformance", "replay", trace, *WRONG, *slow).code == 0


def test_the_good_image_runs_after_a_replay(trace: Path) -> None:
    subject = MockSubject()
    replay(subject, PROFILE, recording(read_trace(trace), TARGETS["bms"]))
    assert subject.readback().startswith(subject.good_image)


@pytest.mark.slow
def test_a_crash_is_a_finding(flasher: Flasher, trace: Path) -> None:
    subject = "tests.conformance.wrong_bootloaders:Raises"
    ran = flasher("conformance", "replay", trace, "-t", "bms", "--subject", subject)
    assert ran.code == 12
    assert "ZeroDivisionError" in ran.out


def test_a_trace_of_another_device_is_refused(trace: Path) -> None:
    with pytest.raises(UsageError, match="The trace has no frame to the WMC"):
        recording(read_trace(trace), TARGETS["wmc"])


def test_a_trace_without_a_message_of_the_device_is_no_proof(trace: Path) -> None:
    sent = [each for each in read_trace(trace) if each[1].can_id == TARGETS["bms"].request_id]
    with pytest.raises(UsageError, match="there is nothing to compare"):
        recording(sent, TARGETS["bms"])


class _Counting(MockSubject):
    """Counts the frames that are sent to it."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, send = 0, self.port.send

        def count(frame: RawFrame) -> None:
            self.sent += 1
            send(frame)

        self.port.send = count  # type: ignore[method-assign]


def test_a_stop_puts_the_good_image_back_and_claims_nothing(trace: Path) -> None:
    """It is asked for when three frames of the trace have been sent."""
    recorded = recording(read_trace(trace), TARGETS["bms"])
    first = _Counting()
    assert restore(first, PROFILE, flash=True).ok
    subject = _Counting()
    found = replay(subject, PROFILE, recorded, stopped=lambda: subject.sent >= first.sent + 3)
    assert (found.trouble, found.frames_sent) == ("it was stopped", 3)
    assert subject.readback().startswith(subject.good_image)


def test_a_device_on_a_bus_is_not_flashed_without_being_asked_for(
    flasher: Flasher, trace: Path
) -> None:
    bus = ("-t", "bms", "-i", "virtual", "-c", "replay", "--good-image", trace)
    ran = flasher("conformance", "replay", trace, *bus)
    assert ran.code == 2
    assert "Add --yes." in ran.err
