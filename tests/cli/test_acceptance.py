"""`flasher acceptance`: its steps, questions and report, on the mock."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from flasher.api import Device, DeviceInfo
from flasher.cli.recording import bundle_folder
from flasher.errors import InterruptedByUserError
from flasher.mock.model import MockDevice
from flasher.mock.table import BootloaderState
from tests.cli.conftest import SAMPLES, Flasher, Run

MOCK = ("--mock", "--mock-speed", "0")
NAMES = [
    "bus", "identity", "read", "first upgrade", "second upgrade", "interrupted and rescued",
    "identity afterwards",
]  # fmt: skip


@pytest.fixture(autouse=True)
def in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def walk(flasher: Flasher, short_bms: Path) -> Callable[..., Run]:
    return lambda *words: flasher("acceptance", short_bms, "-t", "bms", *MOCK, *words)


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[Iterable[bool]], list[str]]:
    """Answers the questions; returns them as they come."""

    def answer(answers: Iterable[bool]) -> list[str]:
        asked: list[str] = []
        coming = iter(answers)

        def agrees(question: str, *, interrupted: str) -> bool:
            asked.append(question)
            answer = next(coming, None)
            if answer is None:
                raise InterruptedByUserError(f"Interrupted at the question: {interrupted}")
            return answer

        monkeypatch.setattr("flasher.cli.upgrade.acceptance.can_ask", lambda: True)
        monkeypatch.setattr("flasher.cli.upgrade.acceptance.agrees", agrees)
        return asked

    return answer


def states(document: dict[str, Any]) -> dict[str, str]:
    return {each["name"]: each["state"] for each in document["steps"]}


def report() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path("acceptance-bms.json").read_text())
    return found


@pytest.mark.slow
def test_all_steps_pass_on_the_mock_and_are_called_practice(walk: Callable[..., Run]) -> None:
    run = walk("--yes", "--interrupt", "--json")
    assert run.code == 0
    assert states(run.document) == dict.fromkeys(NAMES, "passed")
    assert run.document["is_practice"] is True
    assert run.document["device_state"] == "it runs V1r0r4_20220512"
    assert report()["steps"] == run.document["steps"]
    for name in NAMES:
        assert f"{name}: on no hardware" in run.document["never_tried"]
    page = Path("acceptance-bms.html").read_text()
    assert "no adapter and no device was tried" in page
    assert "practice passed" in page
    walked = next(each for each in run.document["steps"] if each["name"] == NAMES[5])
    assert "ended at packet" in walked["what"]


@pytest.mark.slow
def test_a_person_is_asked_before_anything_is_erased(
    walk: Callable[..., Run], answering: Callable[[Iterable[bool]], list[str]]
) -> None:
    asked = answering([True, False])
    run = walk("--json")
    assert run.code == 12
    assert "W2605001" in asked[0] or "reports" in asked[0]
    assert "Its application is erased" in asked[1]
    assert len(asked) == 2
    assert states(run.document) == {
        **dict.fromkeys(NAMES[:3], "passed"), **dict.fromkeys(NAMES[3:], "not tried")
    }  # fmt: skip
    assert run.document["verdict"] == "incomplete"
    assert run.document["device_state"] == "nothing was erased by this acceptance"


def test_another_device_than_that_of_the_label_ends_it(
    walk: Callable[..., Run], answering: Callable[[Iterable[bool]], list[str]]
) -> None:
    answering([False])
    run = walk("--json")
    assert run.code == 12
    assert states(run.document)["identity"] == "failed"
    assert states(run.document)["first upgrade"] == "not tried"


@pytest.mark.slow
def test_ctrl_c_at_a_question_leaves_the_report(
    walk: Callable[..., Run], answering: Callable[[Iterable[bool]], list[str]]
) -> None:
    answering([True, True])  # none for the interruption
    run = walk()
    assert run.code == 130
    assert states(report())["second upgrade"] == "passed"
    assert states(report())["interrupted and rescued"] == "not tried"
    assert "state of the BMS: it runs V1r0r4_20220512" in run.out


@pytest.mark.slow
def test_an_interruption_is_not_tried_without_a_request(walk: Callable[..., Run]) -> None:
    run = walk("--yes", "--json")
    assert run.code == 12
    assert states(run.document)["interrupted and rescued"] == "not tried"
    assert run.document["verdict"] == "incomplete"


@pytest.mark.slow
def test_ctrl_c_in_an_upgrade_leaves_the_report_and_the_state(
    walk: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = 0
    receive = MockDevice.receive

    def received(device: MockDevice, frame: Any, now: float) -> None:
        nonlocal seen
        seen += device.state is BootloaderState.TRANSFER
        receive(device, frame, now)

    monkeypatch.setattr(MockDevice, "receive", received)
    monkeypatch.setattr("flasher.cli.stop.Stop.__call__", lambda stop: seen > 20 or stop.is_asked)
    run = walk("--yes")
    assert run.code == 130
    assert "stopped" in states(report()).values()
    assert "passed" in states(report()).values()
    assert "state of the BMS: " in run.out
    assert report()["verdict"] == "incomplete"
    assert "with --force: it overwrites this report." in run.err
    kept = [path.read_text() for path in bundle_folder().rglob("*.json")]
    assert any("with --force: it overwrites this report." in each for each in kept)


def test_without_a_terminal_or_agreement_it_is_refused(walk: Callable[..., Run]) -> None:
    run = walk()
    assert run.code == 2
    assert "asks a person" in run.err
    assert not Path("acceptance-bms.html").exists()
    assert walk("--interrupt").code == 2


@pytest.mark.slow
def test_an_older_report_is_kept_unless_forced(walk: Callable[..., Run]) -> None:
    Path("acceptance-bms.json").write_text("kept")
    assert walk("--yes").code == 2
    assert Path("acceptance-bms.json").read_text() == "kept"
    assert walk("--yes", "--interrupt", "--force").code == 0
    assert walk("--yes", "-o", "report.txt").code == 2


@pytest.mark.slow
def test_a_second_acceptance_with_the_same_new_report_is_refused_at_once(
    walk: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    second: list[Run] = []
    identify = Device.identify

    def identify_meanwhile(device: Device, **watch: Any) -> DeviceInfo:
        if not second:
            second.append(walk("--yes"))
        return identify(device, **watch)

    monkeypatch.setattr(Device, "identify", identify_meanwhile)
    assert walk("--yes", "--interrupt").code == 0
    assert second[0].code == 2
    assert "acceptance-bms.html exists already" in second[0].err


def test_an_image_for_another_target_is_refused_and_no_check_is_waived(flasher: Flasher) -> None:
    run = flasher("acceptance", SAMPLES / "wmc.hex", "-t", "bms", *MOCK, "--yes")
    assert run.code == 6
    assert "Take the maker's image for this BMS: an acceptance waives no check." in run.err
    assert not Path("acceptance-bms.html").exists()


@pytest.mark.slow
def test_a_target_without_queries_has_steps_that_cannot_be_tried(flasher: Flasher) -> None:
    words = ("acceptance", SAMPLES / "obc.bin", "-t", "obc", *MOCK, "--yes", "--interrupt")
    run = flasher(*words, "--json")
    assert run.code == 0
    assert states(run.document)["read"] == "not possible"
    assert states(run.document)["second upgrade"] == "passed"
    assert states(run.document)["identity afterwards"] == "not possible"
    assert run.document["device_state"] == "it has the new image"
    for number, name in enumerate(NAMES, 1):
        assert f"{number}. {name} ..." in run.err, "a step that is not tried has its line too"
    assert "NAK; what runs is not known" in run.err


@pytest.mark.slow
def test_a_target_without_queries_that_sends_nothing_is_upgraded_all_the_same(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DeviceInfo, "is_there", False)
    words = ("acceptance", SAMPLES / "obc.bin", "-t", "obc", *MOCK, "--yes", "--interrupt")
    run = flasher(*words, "--json")
    assert run.code == 0
    assert states(run.document)["identity"] == "not possible"
    assert states(run.document)["interrupted and rescued"] == "passed"
    assert states(run.document)["identity afterwards"] == "not possible"


def test_a_battery_that_answers_all_but_its_version_has_no_identity(
    walk: Callable[..., Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DeviceInfo, "version", None)
    run = walk("--yes", "--json")
    assert run.code == 12
    assert states(run.document)["identity"] == "failed"
    assert states(run.document)["first upgrade"] == "not tried"


@pytest.mark.slow
def test_a_check_of_the_device_that_refuses_names_no_option_to_waive_it(
    walk: Callable[..., Run], tmp_path: Path
) -> None:
    profile = tmp_path / "limits.toml"
    profile.write_text("minimum_charge_percent = 100\n")
    run = walk("--yes", "--profile", profile)
    assert run.code == 6
    assert "--allow" not in run.err
    assert "Connect its charger: while it charges, the upgrade is allowed." in run.err
    assert "An acceptance waives no check." in run.err
    assert "--allow" not in Path("acceptance-bms.json").read_text()
