"""`--export-test`: what a test in C contains, and which failures cannot be one. tests/examples runs
such tests on a wrong bootloader and on the right one.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flasher.conformance.catalogue import CASES, Selection
from flasher.conformance.dut.exported_test import (
    ExportedTest,
    NotExportableError,
    export_case,
    export_walk,
)
from flasher.conformance.dut.subject import open_subject
from flasher.conformance.explore import Explorer
from flasher.conformance.mock import MockSubject, model_of_profile, profile_of_mock
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.runner import run
from tests.cli.conftest import Flasher

_FLAWS = "tests.conformance.wrong_bootloaders:"


def exported(subject: str, case_id: str) -> ExportedTest:
    with open_subject(subject, "bms", None, good_image=None, second_image=None) as (
        device,
        profile,
    ):
        report = run(device, profile, selection=Selection((case_id,)))
        (result,) = report.results
        title = CASES[case_id].title
        return export_case(result, title, device, profile, stopped=lambda: False)


def lines(made: ExportedTest, name: str) -> list[str]:
    """The lines of a table, without comments."""
    found = re.search(rf" {name}\[\] = \{{\n(.*?)\n\}};", made.code.decode("ascii"), re.DOTALL)
    assert found is not None
    return [line for line in found[1].splitlines() if not line.startswith("    /*")]


@pytest.mark.slow
def test_an_answer_that_is_wrong_must_not_come() -> None:
    made = exported(_FLAWS + "AcceptsAnyName", "UP-06")
    assert made.messages == 2  # reset, update command
    assert made.frames == len(lines(made, "steps")) == 5
    assert lines(made, "forbidden")[0].startswith("    {13, {0x55, 0xAA, 0x0C, 0x04, 0xC4, 0x02")
    assert lines(made, "allowed") == ["    {NONE, {0}},"]


@pytest.mark.slow
def test_an_answer_that_does_not_come_has_to() -> None:
    made = exported(_FLAWS + "IgnoresAnEarlyEnd", "EN-02")
    assert lines(made, "allowed")[0] == "    {6, {0x55, 0xAA, 0x0C, 0x04, 0xC3, 0x02}},"
    assert made.messages == 3  # reset, update command, end of transfer


@pytest.mark.slow
def test_an_image_has_to_be_in_the_flash() -> None:
    made = exported(_FLAWS + "SpoilsSmallImages", "EN-01")
    text = made.code.decode("ascii")
    assert "CHECK_IMAGE = 1," in text or "CHECK_STARTED = 1," in text
    assert len(lines(made, "image")) == 128 // 16
    assert made.messages == 2 + 1 + 1


@pytest.mark.slow
def test_a_forbidden_access_to_the_flash_needs_no_answer() -> None:
    made = exported(_FLAWS + "WritesOldPacketsAgain", "TX-02")
    text = made.code.decode("ascii")
    assert '#define EXPECTED "the bootloader goes on"' in text
    assert made.messages == 4  # reset, update command, packet 1 twice


@pytest.mark.slow
def test_a_time_is_no_test_in_c() -> None:
    with pytest.raises(NotExportableError, match="No test can be made of this check"):
        exported(_FLAWS + "BootsSlowly", "RS-01")


@pytest.mark.slow
def test_what_needs_more_than_frames_is_no_test_in_c() -> None:
    with pytest.raises(NotExportableError, match="The frames alone do not show"):
        exported("tests.conformance.wrong_bootloaders:ClaimsToHandleErrors", "PW-04")


@pytest.mark.slow
def test_the_finding_of_a_walk() -> None:
    subject = _FLAWS + "AcceptsPacketsBeyondTheLast"
    with open_subject(subject, "bms", None, good_image=None, second_image=None) as (
        device,
        profile,
    ):
        found = Explorer(device, profile).replay(
            ["reset", "update=300", "packets=4", "packet-beyond"]
        )
        made = export_walk(found, device, profile, stopped=lambda: False)
    assert lines(made, "forbidden")[0].startswith("    {13, {0x55, 0xAA, 0x0C, 0x04, 0xC2, 0x02")
    assert made.messages == 3  # reset, update command, packet 4 of 3


def test_only_a_compiled_bootloader_has_one() -> None:
    subject = MockSubject()
    report = run(subject, profile_of_mock(), selection=Selection(("RS-01",)))
    with pytest.raises(NotExportableError, match="no failed check"):
        export_case(report.results[0], "", subject, profile_of_mock(), stopped=lambda: False)


def test_the_model_follows_the_choices_that_it_has() -> None:
    profile = ConformanceProfile(
        {"tx_01": "silence", "up_08": "rejected", "tx_02": "either", "limits.pause_s": 2.5}
    )
    model = model_of_profile(profile)
    assert (model.bad_packet, model.update_in_transfer) == ("silence", "ignored")
    assert model.repeated_packet == "ack"  # its own choice
    assert model.transfer_timeout_s == 2.5


@pytest.mark.slow
def test_nothing_failed(flasher: Flasher, tmp_path: Path) -> None:
    subject, path = "tests.peers.python_bootloader:PythonBootloader", tmp_path / "t.c"
    ran = flasher(
        *("conformance", "-t", "bms", "--subject", subject),
        *("--case", "RS-01", "--export-test", path),
    )
    assert ran.code == 0
    assert "no test: nothing failed" in ran.err
    assert not path.exists()


@pytest.mark.slow
def test_the_command_line_writes_the_first_test_that_can_be_made(
    flasher: Flasher, tmp_path: Path
) -> None:
    subject, path = _FLAWS + "AcceptsAnyName", tmp_path / "t.c"
    ran = flasher(
        *("conformance", "-t", "bms", "--subject", subject),
        *("--case", "UP-06", "--export-test", path),
    )
    assert ran.code == 12
    assert f"test: {path}, of UP-06 (2 messages, 5 frames)" in ran.err
    assert path.read_bytes().startswith(b"/* UP-06 ")


def test_the_device_model_has_no_test_in_c(flasher: Flasher, tmp_path: Path) -> None:
    line = ("-t", "bms", "--mock", "--export-test", tmp_path / "t.c")
    for action in ((), ("explore",)):
        ran = flasher("conformance", *action, *line)
        assert ran.code == 2
        assert "--export-test works with --subject only" in ran.err
