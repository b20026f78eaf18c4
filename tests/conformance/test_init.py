"""`init`: the written profile matches the device, observed on the bus alone."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, get_args, get_type_hints

import pytest

from flasher.conformance import init
from flasher.conformance.bench import Bench
from flasher.conformance.catalogue import CASES, QUICK, Selection
from flasher.conformance.dut.subject import open_subject
from flasher.conformance.init import LIMITS, NOT_ASKED, QUESTIONS, UPGRADES, ask_device
from flasher.conformance.init.answers import MARGINS, Trial, decide, limit_answer
from flasher.conformance.mock import (
    GOOD_IMAGE,
    MOCK_PROFILE,
    MockSubject,
    device_maker,
    profile_of_mock,
)
from flasher.conformance.profile import (
    ConformanceProfile,
    Limits,
    load_profile,
    profile_keys,
    unstated,
)
from flasher.conformance.results import InitResult
from flasher.conformance.runner import run
from flasher.conformance.subject import Subject
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants import VARIANTS
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.timing import DEFAULT_TIMINGS
from tests.campaigns.profiles import AREA_BYTES, faults
from tests.campaigns.right_devices import answers_late, right_device
from tests.cli.conftest import Flasher
from tests.conformance.bench import DeafDevice, answers, interview, questions
from tests.conformance.test_other_device import (
    IMAGE,
    BurstAnnouncer,
    ChoosyDevice,
    LateListener,
    PageDevice,
    SlowDevice,
    bench,
)
from tests.loops import each
from tests.peers.scripted_device import ScriptedDevice

CHOICES: Final = {
    "rs_02": "reset_in_bootloader",
    "rs_03": "without_application",
    "up_03": "upgrade_in_application",
    "up_08": "update_in_transfer",
    "tx_01": "bad_packet",
    "tx_02": "repeated_packet",
    "tx_03": "older_packet",
    "tx_12": "pause_in_transfer",
    "tx_13": "reset_in_transfer",
    "en_02": "repeated_end",
    "en_03": "after_complete",
}
"""Key of the profile to the option of the device model."""
OTHER_WORDS: Final = {"general_feedback": "feedback", ("up_08", "ignored"): "rejected"}
_KEYS: Final = tuple(profile_keys())
_NEEDED: Final = ("device.versions", "limits.window_s", "up_08")
"""Answers that other questions need."""
OPEN: Final = {"en_04", "limits.refused_s", "limits.silence_s"} | {
    "device.application_bytes",
    "device.application_address",
}
"""Keys that cannot be observed from outside."""


class FullFrames(MockDevice):
    """Accepts short frames only at the end of a message."""

    def receive(self, frame: Frame, now: float) -> None:
        if len(frame.data) == 8 or frame.data.endswith(b"\xf0"):
            super().receive(frame, now)


class OtherDevice(MockDevice):
    """Answers a rejected update command by NAK, rejects a last packet that is not padded with FF,
    and drops a partial message after 50 ms.
    """

    def __init__(self, *given: Any, **named: Any) -> None:
        timings = replace(DEFAULT_TIMINGS, inter_frame_timeout_s=0.05)
        super().__init__(*given, **{**named, "timings": timings})

    def _take_row(self, row: AnyMessage, now: float) -> None:
        super()._take_row(row, now)
        if isinstance(row, messages.UpdateCommand) and self.state is BootloaderState.ANNOUNCING:
            self._send(messages.Nak(1))

    def _classify_packet(self, row: messages.Packet) -> BootloaderEvent:
        rest = self._transfer.size_bytes - (row.number - 1) * len(row.payload)
        if row.number == self._transfer.total and row.payload[rest:].strip(b"\xff"):
            return BootloaderEvent.PACKET_BAD
        return super()._classify_packet(row)


class MoodyDevice(MockDevice):
    """Answers every second older packet, and every second damaged one."""

    asked = 0

    def _answer_older(self, now: float) -> str:
        self.asked += 1
        return super()._answer_older(now) if self.asked % 2 else ""

    def _answer_bad(self, now: float) -> str:
        self.asked += 1
        return super()._answer_bad(now) if self.asked % 2 else ""


class Confirming(MockDevice):
    """Its bootloader sends general feedback to every write; one ACK is lost."""

    acks = 0

    def _take_row(self, row: AnyMessage, now: float) -> None:
        if self.state is not BootloaderState.APPLICATION:
            self._send(messages.GeneralFeedbackMessage())
        super()._take_row(row, now)

    def _acknowledge(self, now: float) -> str:
        reported = super()._acknowledge(now)
        self.acks += 1
        if self.acks == 100:
            self._transmitter.drop_unstarted()
        return reported


class Witness(MockDevice):
    """Records every completed image, and counts how often it is erased."""

    completed: set[bytes]
    erased = 0

    def _erase(self, now: float) -> str:
        self.erased += 1
        return super()._erase(now)

    def _complete(self, now: float) -> str:
        self.completed.add(self.store.read(self._transfer.size_bytes))
        return super()._complete(now)


class FullFramesElsewhere(FullFrames, OtherDevice):
    """Both in one."""


class MoodyConfirming(Confirming, MoodyDevice):
    """Both in one."""


class LatePages(LateListener, PageDevice):
    """Both in one."""


class OldPages(PageDevice):
    """Erases a page when it is written: the flash holds the old image beyond it."""

    @property
    def image(self) -> bytes:
        return super().image + IMAGE[len(super().image) :]


class SlowPages(ScriptedDevice):
    """Writes a page of 2 KiB before the ACK of the packet that fills it."""

    def _ack(self, number: int, at: float) -> None:
        super()._ack(number, at + (0.2 if number % 16 == 0 else 0.0))


class SlowBursts(SlowDevice, BurstAnnouncer):
    """Both in one."""


def mock(kind: type[MockDevice] = MockDevice, target: str = "bms", **choices: Any) -> MockSubject:
    device = replace(MOCK_PROFILE, application_area_bytes=AREA_BYTES, **choices)
    return MockSubject(target, profile=device, make_device=device_maker(kind))


def values(asked: InitResult) -> dict[str, Any]:
    assert asked.stopped == ""
    return {one.key: one.value for one in asked.answers}


def test_every_key_is_asked_or_the_reason_is_reported() -> None:
    asked = [key for _, keys in QUESTIONS for key in keys]
    assert sorted([*asked, *LIMITS, *NOT_ASKED]) == sorted(profile_keys())


@pytest.mark.slow
@each("turn", range(3))
def test_each_value_of_each_choice_of_the_device_model_is_seen(turn: int) -> None:
    """No choice has more than three values."""
    hints = get_type_hints(DeviceProfile)
    words = {key: get_args(hints[option]) for key, option in CHOICES.items()}
    assert max(map(len, words.values())) == 3
    chosen = {key: each[turn % len(each)] for key, each in words.items()}
    options: dict[str, Any] = {CHOICES[key]: value for key, value in chosen.items()}
    asked = ask_device(mock(**options), ConformanceProfile())
    wanted = {
        key: OTHER_WORDS.get((key, value)) or OTHER_WORDS.get(value) or value
        for key, value in chosen.items()
    }
    found = values(asked)
    assert {key: found[key] for key in wanted} == wanted
    assert set(asked.open_keys) - {"limits.pause_s"} == OPEN


@pytest.mark.slow
@each(
    "make, wanted",
    [
        (
            lambda: mock(FullFramesElsewhere),
            {
                "fr_01": "rejected",
                "fr_07": "ignored",
                "up_02": "nak",
                "tx_08": "rejected",
                "limits.inter_frame_s": 0.043,
                "tm_02": "accepted",
            },
        ),
        (
            lambda: mock(MoodyConfirming),
            {
                "fr_10": "either",
                "tx_02": "ack",
                "fr_01": "accepted",
                "tx_01": "either",
                "tx_03": "either",
            },
        ),
        (
            lambda: bench(ScriptedDevice("bms", capacity_bytes=3000)),
            {
                "fr_01": "either",
                "fr_02": "lost",
                "fr_04": "dropped",
                "tx_03": "nak",
                "tx_12": "waits",
                "tx_01_lost_frame": "silence",
                "device.largest_image_bytes": 3000,
            },
        ),
        (
            lambda: bench(ChoosyDevice("bms", capacity_bytes=3000)),
            {"tx_01": "either", "tx_03": "silence"},
        ),
        (
            lambda: bench(LatePages("bms", capacity_bytes=3000)),
            {
                "up_04_burst": "rejected",
                "device.largest_image_bytes": 3000,
                "device.buffer_bytes": 896,
            },
        ),
    ],
)
def test_other_ways_are_seen(make: Callable[[], Subject], wanted: dict[str, Any]) -> None:
    found = values(interview(make(), *wanted, *_NEEDED))
    assert {key: found[key] for key in wanted} == wanted


@pytest.mark.slow
def test_no_limit_is_shorter_than_what_the_device_needs() -> None:
    slow = values(interview(bench(SlowBursts("bms", capacity_bytes=3000)), "en_03", "rs_03"))
    assert slow["limits.ack_s"] > 3 * 0.4
    assert slow["limits.complete_s"] > 3 * 6.0
    assert slow["limits.first_version_s"] > 3 * 1.0
    erasing = mock(erase_time_s=0.1, transfer_timeout_s=12.5, window_s=0.321)
    found = values(interview(erasing, *_NEEDED, "tx_12", "device.largest_image_bytes"))
    assert found["limits.erase_s"] > AREA_BYTES / 2048 * 0.1  # the largest image
    assert found["limits.pause_s"] == 12.5
    # As long as the document gives it: no image was refused.
    assert found["limits.complete_s"] == Limits().complete_s
    assert found["limits.window_s"] == pytest.approx(0.32, abs=0.002)


@pytest.mark.slow
def test_acknowledged_bytes_that_are_not_written_are_seen_though_the_flash_holds_the_same() -> None:
    paged = values(
        interview(bench(OldPages("bms", capacity_bytes=12288)), *_NEEDED, "device.buffer_bytes")
    )
    assert paged["device.buffer_bytes"] == 896


@pytest.mark.slow
@each(
    "make, question",
    (
        (lambda: bench(SlowPages("bms", capacity_bytes=12288)), "device.buffer_bytes"),
        (lambda: mock(answers_late(Nak=0.2)), "en_03"),
        (
            lambda: mock(answers_late(Nak=0.2), bad_packet="silence", repeated_packet="nak_next"),
            "en_03",
        ),
        (
            lambda: mock(answers_late(Nak=0.2), bad_packet="silence", older_packet="nak"),
            "en_03",
        ),
    ),
)
def test_the_limit_of_an_answer_holds_for_the_slowest_one(
    make: Callable[[], Subject], question: str
) -> None:
    """Any one question that such an answer comes to is enough."""
    assert values(interview(make(), question))["limits.ack_s"] >= 0.6


@pytest.mark.slow
def test_the_longest_gap_in_a_packet_is_found() -> None:
    timings = replace(DEFAULT_TIMINGS, inter_frame_timeout_s=0.3)

    class Patient(MockDevice):
        def __init__(self, *given: Any, **named: Any) -> None:
            super().__init__(*given, **{**named, "timings": timings})

    found = values(interview(mock(Patient), "tx_12", "limits.inter_frame_s"))
    assert found["limits.inter_frame_s"] == 0.26


@pytest.mark.slow
@each(
    "seed, wanted",
    (
        (3, {"device.largest_image_bytes": 31744, "up_08": "rejected"}),
        (9, {"device.largest_image_bytes": 2348, "rs_03_old": None}),
        (21, {"device.largest_image_bytes": 14336, "up_08": "starts_over"}),
        (6, {"tx_01": "nak_received", "tx_03": "silence", "tx_13": "restarts"}),
        (7, {"en_02": "same_answer", "fr_10": "either"}),
        (20, {"limits.window_s": 0.1991, "tx_13": "ignored"}),
        (
            11,
            {
                "rs_02": "restarts",
                "up_05": "once",
                "up_08": "rejected",
                "fr_07": "ignored",
                "limits.pause_s": 2.5,
            },
        ),
    ),
)
def test_a_device_may_take_longer_for_an_answer_than_a_pause_lasts(
    seed: int, wanted: dict[str, Any]
) -> None:
    device = right_device(seed, at_limits=True)
    with device.subject() as unit:
        assert answers(unit, wanted, device.profiles["fitting"].given) == wanted


def test_a_limit_has_its_margin_and_states_it() -> None:
    found = limit_answer("limits.ack_s", [0.1, 0.21], 0.1, 0.002)
    assert found.value == 0.64
    assert found.seen.startswith("measured 2 times, at most 210.0 ms; ")
    assert limit_answer("limits.ack_s", [], 0.1, 0.0).value is None


def test_the_document_states_the_margins_and_what_holds_without_a_value() -> None:
    document = Path(__file__).parents[2] / "docs/how-to/conformance_profile.md"
    assert MARGINS in document.read_text(encoding="utf-8")
    assert unstated() in document.read_text(encoding="utf-8")


def test_what_differs_is_either_or_stays_open() -> None:
    trials = [Trial(value, value.upper(), "it") for value in ("nak", "silence", "nak")]
    assert decide("up_02", trials).value == "either"
    own = [Trial(value, value.upper(), "it") for value in ("crc32", "none", "crc32")]
    assert decide("en_04", own).value is None
    assert decide("en_04", own).seen.endswith(
        ": CRC32 to it, 2 of 3 times; NONE to it, 1 of 3 times"
    )
    unheard = decide("tx_03", [Trial("", "COMPLETE", "it")])
    assert unheard.seen.endswith(": COMPLETE to it, 1 of 1 times")


@pytest.mark.slow
@pytest.mark.no_cover
def test_the_suite_passes_by_the_profile_that_is_written() -> None:
    assert faults(11, Selection(quick=True)) == []


def check_python_bootloader(cases: Sequence[str], keys: Sequence[str] = _KEYS) -> None:
    """It passes these cases with the profile determined from its answers about these keys."""
    what, start = "tests.peers.python_bootloader:PythonBootloader", ConformanceProfile()
    with open_subject(what, "bms", start, good_image=None, second_image=None) as (subject, _):
        profile = interview(subject, *keys).profile(start)
        report = run(subject, profile, selection=Selection(cases=tuple(cases)))
    assert profile.choice("up_05") == "each"
    assert profile.value("device.largest_image_bytes") == 0xF000
    assert [str(one.first_failure) for one in report.results if one.first_failure] == []


@pytest.mark.slow
@pytest.mark.no_cover
def test_the_bootloader_of_others_passes_by_its_profile() -> None:
    keys = (*_NEEDED, "en_03", "up_05", "tx_12", "en_02", "device.largest_image_bytes")
    check_python_bootloader(("UP-05", "UP-08", "EN-02"), keys)


@pytest.mark.slow
def test_only_good_images_are_completed_as_often_as_the_user_is_told() -> None:
    """The small one is there in the end; the times of the larger one are measured, too."""
    subject, start = mock(Witness), ConformanceProfile()
    assert isinstance(subject.device, Witness)
    subject.device.completed = set()
    asked = ask_device(subject, start)
    assert asked.stopped == ""
    assert subject.device.completed == {GOOD_IMAGE, subject.firmware.good}
    assert subject.device.stored_image == GOOD_IMAGE
    run(subject, asked.profile(start), selection=Selection(quick=True))
    assert pytest.approx(UPGRADES, rel=0.25) == subject.device.erased


def test_a_device_that_is_not_there_is_reported_and_nothing_is_asked() -> None:
    subject = mock(DeafDevice)
    assert isinstance(subject.device, DeafDevice)
    subject.device.hangs = subject.device.hangs_for_good = True
    asked = ask_device(subject, ConformanceProfile())
    assert not asked.was_brought_up
    assert asked.stopped.startswith("before the first question, ")


@pytest.mark.slow
def test_one_that_is_stopped_has_its_good_image() -> None:
    subject, calls = mock(), []

    def stopped() -> bool:
        calls.append(1)
        return len(calls) > 3000

    asked = ask_device(subject, ConformanceProfile(), stopped=stopped)
    assert asked.stopped == "the run was stopped"
    assert subject.device.stored_image == GOOD_IMAGE


# -- the command ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_a_profile_that_is_read_again(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    model = ("-t", "bms", "--mock", "--set", "application_area_bytes=34K", "--set", "window_s=0.1")
    ran = flasher("conformance", "init", *model, "-o", str(path))
    assert ran.code == 0
    assert "tx_02" in ran.out
    assert "ACK 1 to packet 1 again, 3 of 3 times" in ran.out
    passed = f"quick cases by this profile: {len(QUICK)} pass"
    assert passed in ran.out.splitlines()
    assert MARGINS in ran.out
    profile = load_profile(path)
    assert profile.rationales["tx_02"].startswith("ACK 1 to packet 1 again, 3 of 3 times")
    own = profile_of_mock(replace(MOCK_PROFILE, window_s=0.1)).limit("window_s")
    assert profile.limit("window_s") == pytest.approx(own, abs=0.001)
    assert profile.limit("window_s") != own  # it was seen, and not known
    text = path.read_text(encoding="utf-8")
    assert f"# open: {NOT_ASKED['en_04']}" in text
    assert {f"# {passed}", f"# Margins: {MARGINS}.", f"# {unstated()}"} <= set(text.splitlines())
    by_file = ("--profile", str(path), "--case", "TX-02", "--case", "UP-04")
    assert flasher("conformance", *model, *by_file).code == 0


@pytest.mark.slow
def test_a_file_that_is_there_is_written_with_force_alone(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.toml"
    path.write_text("of another device")
    model = ("-t", "bms", "--mock")
    again = flasher("conformance", "init", *model, "-o", str(path))
    assert again.code == 2
    assert "exists already" in again.err
    assert path.read_text() == "of another device"
    monkeypatch.setattr(init, "QUESTIONS", questions("limits.window_s", "tx_02"))
    forced = flasher("--json", "conformance", "init", *model, "-o", str(path), "--force")
    assert forced.code == 0
    document = json.loads(forced.out)
    assert document["toml"] == path.read_text(encoding="utf-8")
    found = {one["key"]: one["value"] for one in document["answers"]}
    assert (found["tx_02"], found["en_04"]) == ("ack", None)
    determined = {key: value for key, value in found.items() if value is not None}
    assert load_profile(path).given == determined
    assert document["report"]["passed"]


@pytest.mark.slow
def test_what_does_not_pass_by_the_profile_is_beside_its_keys(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "p.toml"
    monkeypatch.setattr(init, "QUESTIONS", questions("limits.window_s", "tx_01", "tx_02"))
    wrong = ("-t", "bms", "--mock", "--set", "application_area_bytes=34K", "--variant")
    ran = flasher("conformance", "init", *wrong, "no-crc-check", "-o", str(path))
    assert ran.code == 12
    *_, failure, key, _, _ = ran.out.splitlines()
    assert failure.startswith("FAIL TX-01 damaged packet: packet 1, wrong CRC: expected ")
    assert key.startswith(
        "    tx_01 = either (either, nak_expected, nak_received, silence): no value"
    )
    assert f"# {failure}\n# {key}\n" in path.read_text(encoding="utf-8")
    assert load_profile(path).choice("tx_02") == "ack"


@pytest.mark.slow
def test_no_file_is_written_when_the_quick_cases_are_broken_off(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, case = tmp_path / "p.toml", CASES["TX-02"]

    def interrupted(bench: Bench) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        case.run(bench)

    monkeypatch.setitem(CASES, case.id, replace(case, run=interrupted))
    monkeypatch.setattr(init, "QUESTIONS", questions("limits.window_s"))
    model = ("-t", "bms", "--mock", "--set", "application_area_bytes=34K")
    ran = flasher("conformance", "init", *model, "-o", str(path))
    assert ran.code == 130
    assert "no profile is written: the run was stopped" in ran.err
    assert not path.exists()


def test_no_file_is_written_for_a_device_that_does_not_answer(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "p.toml"
    variant = next(name for name, one in VARIANTS.items() if not one.upgrade_works)
    ran = flasher(
        "conformance", "init", "-t", "bms", "--mock", "--variant", variant, "-o", str(path)
    )
    assert ran.code == 5
    assert "no profile is written" in ran.err
    assert not path.exists()


def test_a_device_on_a_bus_is_asked_about(flasher: Flasher, tmp_path: Path) -> None:
    bus = ("-i", "virtual", "-c", "init", "--good-image", "README.md")
    ran = flasher("conformance", "init", "-t", "bms", *bus, "-o", str(tmp_path / "p.toml"))
    assert ran.code == 2
    assert "erase and write the device about 180 times" in ran.err
