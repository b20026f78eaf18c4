"""The last line of `flash`: what it came to, in one line and in its colour."""

from __future__ import annotations

import random
import re
from pathlib import Path

import pytest

from flasher.cli.upgrade.text import summary_lines, verdict_of
from flasher.errors import ErrorCode
from flasher.events import Phase
from flasher.host.outcome import DeviceLeft, Outcome, Statistics
from flasher.host.session import Result
from flasher.host.table import Ending
from flasher.host.verify import Level, Verification
from flasher.host.verify import Verdict as Verified
from flasher.image.plan import plan
from flasher.protocol.spec import TARGETS, WELLING
from tests.host.bench import Bench
from tests.loops import each

from .conftest import SAMPLES, Flasher

BMS, OBC = SAMPLES / "bms.hex", SAMPLES / "obc.bin"
MOCK = ("--mock", "--mock-speed", "0")
GREEN, YELLOW, RED = "\x1b[1;32m", "\x1b[1;33m", "\x1b[1;31m"
RUNS = "BMS runs V1r0r4_20220512, was V1r0r0_20220512"
HAS, UNKNOWN = "confirmed the image", "what runs is not known"
NO_QUERY = "no version query"


@pytest.fixture
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal, as far as colours go."""
    monkeypatch.setattr("flasher.cli.output.takes_colour", lambda _stream: True)


@pytest.mark.usefixtures("colours")
@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((BMS, "-t", "bms"), f"{GREEN}OK\x1b[0m  {RUNS} (version read back)"),
        (
            (BMS, "-t", "bms", "--verify", "none"),
            f"{YELLOW}OK\x1b[0m  BMS {HAS}, was V1r0r0_20220512; {UNKNOWN} (not asked)",
        ),
        (
            (OBC, "-t", "obc"),
            f"{YELLOW}OK\x1b[0m  OBC {HAS}; {UNKNOWN} ({NO_QUERY})",
        ),
        (
            (OBC, "-t", "wmc", "--allow-other-target"),
            f"{YELLOW}OK\x1b[0m  WMC {HAS}; {UNKNOWN} ({NO_QUERY}; 1 warning)",
        ),
    ],
    ids=["good", "not asked", "no query", "waived"],
)
def test_a_good_end_states_what_runs_and_is_green_only_where_nothing_is_unknown(
    flasher: Flasher, short_bms: Path, words: tuple[str | Path, ...], line: str
) -> None:
    run = flasher("flash", *(short_bms if word == BMS else word for word in words), *MOCK)
    last = run.out.splitlines()[-1]
    assert re.fullmatch(re.escape(line) + r"  \d+\.\d s", last), last
    assert "device took" not in run.out + run.err
    assert "check: passed" not in run.err


@pytest.mark.slow
@pytest.mark.usefixtures("colours")
@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((BMS, "-t", "bms"), f"{RED}FAILED\x1b[0m  No adapter is named, and none was found"),
        ((SAMPLES / "missing.hex", "-t", "bms"), f"{RED}FAILED\x1b[0m  "),
        (
            (BMS, "-t", "wmc", *MOCK),
            f"{RED}FAILED\x1b[0m  WMC: the image is not meant for this device",
        ),
        (
            (BMS, "-t", "bms", "--timeout", "2", *MOCK),
            f"{RED}FAILED\x1b[0m  BMS: the overall deadline passed; it has no application now  2.0",
        ),
    ],
    ids=["no adapter", "no file", "wrong device", "broken off"],
)
@pytest.mark.parametrize("form", [(), ("--json",)], ids=["text", "json"])
def test_a_bad_end_is_red_and_the_last_line_whatever_came_before(
    flasher: Flasher, words: tuple[str, ...], line: str, form: tuple[str, ...]
) -> None:
    run = flasher("flash", *words, *form)
    assert run.code
    assert run.err.splitlines()[-1].startswith(line)
    assert run.err.count("FAILED") == 1
    assert bool(run.out) == bool(form)


def test_what_makes_the_last_line_long_is_in_the_error_alone(
    flasher: Flasher, tmp_path: Path
) -> None:
    (tmp_path / "noise.bin").write_bytes(random.Random(1).randbytes(3000))
    run = flasher("flash", tmp_path / "noise.bin", "-t", "bms", *MOCK)
    assert run.err.splitlines()[-1] == "FAILED  BMS: not plausible as firmware"
    assert "--allow-implausible" in run.err


@each("name", ("my. file.hex", ".", "none (1).hex"))
def test_the_last_line_names_a_file_whole(flasher: Flasher, name: str) -> None:
    run = flasher("flash", name, "-t", "bms", *MOCK)
    assert run.err.splitlines()[-1].startswith(f"FAILED  {name} cannot be read")


@pytest.mark.slow
def test_figures_of_the_line_and_passed_checks_are_reported_with_v_and_in_json(
    flasher: Flasher, short_bms: Path
) -> None:
    loud = flasher("flash", OBC, "-t", "obc", "-v", *MOCK)
    assert "device took:" in loud.err
    assert "check: passed: by a name inside" in loud.err
    document = flasher("flash", short_bms, "-t", "bms", "--json", *MOCK).document
    assert document["link"]["device_answer"]["median_s"] > 0
    assert "passed" in {check["verdict"] for check in document["checks"]}
    assert document["previous_version"] == "V1r0r0_20220512"


@pytest.mark.usefixtures("colours")
def test_a_log_has_no_colours(flasher: Flasher, tmp_path: Path) -> None:
    flasher("flash", OBC, "-t", "obc", *MOCK, "--log-file", tmp_path / "log")
    flasher("flash", BMS, "-t", "bms", "--log-file", tmp_path / "log")
    log = (tmp_path / "log").read_text()
    assert f"OK  OBC {HAS}" in log
    assert "FAILED  No adapter" in log
    assert "\x1b" not in log


def test_an_upgrade_that_is_completed_and_runs_something_else_has_failed() -> None:
    outcome = Outcome(
        Ending.COMPLETED, Phase.END, DeviceLeft.NEW, TARGETS["bms"], 10, None, None, None,
        Statistics(),
    )  # fmt: skip
    other = Verification(Level.VERSION, Verified.VERSION_OTHER, "V1", "V1 instead of V2")
    line = verdict_of(Result(outcome, other), [], 2.0)
    assert (line.word, line.colour) == ("FAILED", "red")
    assert line.text == (
        "BMS: completed, but the application runs another version than the image names  2.0 s"
    )


def test_a_transfer_in_which_the_adapter_was_away_is_good_and_not_green() -> None:
    whole = plan(Bench().image, TARGETS["bms"], WELLING.bitrate_bps)
    outcome = Outcome(
        Ending.COMPLETED, Phase.END, DeviceLeft.NEW, TARGETS["bms"], 10, None, None, None,
        Statistics(), unobserved_s=1.5,
    )  # fmt: skip
    result = Result(outcome, Verification(Level.VERSION, Verified.VERSION_RIGHT, "V1"))
    line = verdict_of(result, [], 2.0)
    assert (line.word, line.colour) == ("OK", "yellow")
    assert line.text == "BMS runs V1 (version read back; unobserved for 1.50 s)  2.0 s"
    assert (
        "unobserved:   1.50 s, the adapter was away or this computer suspended; if another tool"
        " sent or another unit was connected then, flash it again" in summary_lines(result, whole)
    )


@pytest.mark.parametrize(
    ("verdict", "code"),
    [
        (Verified.VERSION_OTHER, ErrorCode.OTHER_VERSION),
        (Verified.MEMORY_OTHER, ErrorCode.VERIFICATION),
        (Verified.NO_ANSWER, ErrorCode.VERIFICATION),
    ],
)
def test_another_version_has_a_code_of_its_own(verdict: Verified, code: ErrorCode) -> None:
    error = Verification(Level.VERSION, verdict, "V1").error(TARGETS["bms"])
    assert error is not None
    assert error.code is code
