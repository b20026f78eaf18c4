"""What goes into the log: -v, -vv and --log-file."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from flasher import events
from flasher.cli.logs import Logs
from flasher.cli.output import Output
from flasher.events import Phase
from flasher.log import describe, level_of, log_event
from tests.cli.conftest import SAMPLES, Flasher
from tests.schema import event_classes

OBC = SAMPLES / "obc.bin"
FULL = Path("/dev/full")
HEAD = re.compile(r"(\S+T\S+) (DEBUG|INFO|WARNING|ERROR) +(\S+): (.*)")


def records(path: Path) -> list[tuple[str, str, str]]:
    """Level, logger and text of each record; its further lines are left out."""
    lines = [line for line in path.read_text("utf-8").splitlines() if not line.startswith("    ")]
    matches = [HEAD.fullmatch(line) for line in lines]
    assert all(matches), lines
    return [(match[2], match[3], match[4]) for match in matches if match]


# -- the log file ----------------------------------------------------------------------------------


def test_the_file_has_what_was_run_what_was_reported_and_how_it_ended(
    flasher: Flasher, tmp_path: Path
) -> None:
    path = tmp_path / "flasher.log"
    run = flasher("scan", "--mock", "--mock-speed", "0", "--log-file", path)
    written = records(path)
    assert written[0][0] == "INFO"
    assert "flasher scan --mock --mock-speed 0 --log-file" in written[0][2]
    reported = {text for _, _, text in written}
    for line in (*run.out.splitlines(), *run.err.splitlines()):
        assert not line.strip() or line in reported or line.startswith("  ")
    assert written[-1] == ("INFO", "flasher.cli", "exit code 0")


def test_times_are_iso_with_milliseconds_and_offset(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "flasher.log"
    flasher("image-info", OBC, "--log-file", path)
    stamp = path.read_text("utf-8").split()[0]
    assert re.fullmatch(r".*\.[0-9]{3}[+-][0-9]{2}:[0-9]{2}", stamp)
    assert datetime.fromisoformat(stamp).tzinfo is not None


def test_the_file_is_at_debug_whatever_is_shown_and_grows(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "flasher.log"
    run = flasher("-q", "--log-file", path, "image-info", OBC, "--json")
    assert [text for level, _, text in records(path) if level == "DEBUG"] == [run.out.strip()]
    before = path.stat().st_size
    flasher("-q", "--log-file", path, "image-info", OBC)
    assert path.stat().st_size > before
    assert sum("exit code 0" in text for _, _, text in records(path)) == 2


@pytest.mark.parametrize("name", ["no-folder/x.log", "."])
def test_a_log_that_cannot_be_written_is_refused_before_anything_happens(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ran: list[object] = []
    monkeypatch.setattr("flasher.cli.options.load", lambda *_, **__: ran.append(1))
    run = flasher("image-info", OBC, "--log-file", name, "--json")
    assert run.code == run.document["exit_code"] == 2
    assert run.document["error"]["where"] == "--log-file"
    assert not ran


@pytest.mark.parametrize("taken", ["image", "output"])
def test_a_file_of_the_command_is_never_taken_for_the_log(
    flasher: Flasher, tmp_path: Path, taken: str
) -> None:
    image = tmp_path / "image.bin"
    image.write_bytes(OBC.read_bytes())
    words: tuple[str | Path, ...] = ("image-info", image)
    if taken == "output":
        words = ("read", "memory", "0", "8", "-t", "bms", "--mock", "-o", image)
    run = flasher(*words, "--log-file", image)
    assert run.code == 2
    assert "is a file of the command itself" in run.err
    assert image.read_bytes() == OBC.read_bytes()


@pytest.mark.skipif(not FULL.exists(), reason="there is no /dev/full")
def test_a_full_disk_changes_nothing_and_is_reported_once(flasher: Flasher) -> None:
    plain = flasher("image-info", OBC)
    run = flasher("image-info", OBC, "--log-file", FULL)
    assert (run.code, run.out) == (0, plain.out)
    assert run.err.count("\n") == 1
    assert "the log /dev/full is incomplete" in run.err


def test_a_file_named_like_a_command_is_a_file(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert flasher("--log-file", "scan", "image-info", OBC).code == 0
    assert flasher("--log", "read", "image-info", OBC).code == 0
    assert flasher("--log-file=info", "image-info", OBC).code == 0
    assert (tmp_path / "scan").exists()


def test_the_lines_of_a_bug_are_in_the_file(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object) -> int:
        raise RuntimeError("boom\x1b[2J")

    monkeypatch.setattr("flasher.cli.upgrade.image_info.vector_table", fail)
    path = tmp_path / "flasher.log"
    run = flasher("image-info", OBC, "--log-file", path)
    assert run.code == 1
    written = path.read_text("utf-8")
    assert "Traceback (most recent call last)" in written
    assert "RuntimeError: boom\\x1b[2J" in written
    assert "\x1b" not in written + run.err
    assert records(path)[-1][2] == "exit code 1"


# -- what libraries log ----------------------------------------------------------------------------


@pytest.fixture
def output() -> Iterator[Output]:
    output = Output()
    before = [logging.getLogger(name).handlers[:] for name in ("flasher", "can")]
    yield output
    assert [logging.getLogger(name).handlers for name in ("flasher", "can")] == before
    assert logging.getLogger("flasher").level == logging.NOTSET


def say_something() -> None:
    logging.getLogger("flasher.bus").debug("a detail")
    logging.getLogger("flasher.bus").info("opened")
    logging.getLogger("flasher.bus").warning("slow")
    logging.getLogger("can.pcan").info("driver 4.6")
    logging.getLogger("can.pcan").warning("no driver")


@pytest.mark.parametrize(
    ("verbosity", "shown"),
    [
        (-1, []),
        (0, ["warning: can.pcan: no driver"]),
        (1, ["info: bus: opened", "warning: bus: slow", "warning: can.pcan: no driver"]),
        (
            2,
            [
                "debug: bus: a detail",
                "info: bus: opened",
                "warning: bus: slow",
                "info: can.pcan: driver 4.6",
                "warning: can.pcan: no driver",
            ],
        ),
    ],
)
def test_v_shows_the_log_tersely(
    output: Output, capsys: pytest.CaptureFixture[str], verbosity: int, shown: list[str]
) -> None:
    with Logs(output) as log:
        log.open(verbosity, None)
        say_something()
    assert capsys.readouterr().err.splitlines() == shown
    say_something()
    assert capsys.readouterr().err == "", "no file is left"


def test_the_file_gets_flashers_details_but_not_those_of_python_can(
    output: Output, tmp_path: Path
) -> None:
    path = tmp_path / "x.log"
    with Logs(output) as log:
        log.open(-1, str(path))
        say_something()
        logging.getLogger("can.socketcan.tx").debug("a frame")
    texts = [text for _, _, text in records(path)]
    assert texts == ["a detail", "opened", "slow", "driver 4.6", "no driver"]


def test_hostile_records_make_no_lines_of_their_own(
    output: Output, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.log"
    # Given to the handlers alone: those of pytest fail on it, as they should in a test.
    broken = logging.LogRecord("can.x", logging.WARNING, "", 0, "%d", ("no number",), None)
    with Logs(output) as log:
        log.open(1, str(path))
        logging.getLogger("can.x").warning("one\n2026-01-01T00:00:00 ERROR y: two\x1b[2J")
        for handler in logging.getLogger("can").handlers:
            handler.handle(broken)
    assert len(records(path)) == 1
    assert "\x1b" not in path.read_text("utf-8")
    assert capsys.readouterr().err.splitlines()[0].endswith("one | 2026-01-01T00:00:00 ERROR y: two"
                                                            "\\x1b[2J")  # fmt: skip


def test_what_the_command_prints_is_not_printed_twice(
    output: Output, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "x.log"
    phase = events.PhaseEntered(Phase.TRANSFER, 1)
    output.verbosity = 2
    output.shows = lambda event: isinstance(event, events.PhaseEntered)
    with Logs(output) as log:
        log.open(2, str(path))
        output.progress("transferring ...")
        log_event(phase)
        log_event(events.MemoryRead(1, 2))
    assert capsys.readouterr().err.splitlines() == [
        "transferring ...",
        "debug: host: MemoryRead: read_bytes=1, total_bytes=2",
    ]
    assert ("INFO", "flasher.host", "PhaseEntered: phase=transfer, attempt=1") in records(path)


def test_an_error_is_in_the_file_as_it_was_shown(flasher: Flasher, tmp_path: Path) -> None:
    path = tmp_path / "x.log"
    run = flasher("image-info", SAMPLES / "bad" / "no_end.hex", "--log-file", path)
    written = path.read_text("utf-8")
    for line in run.err.splitlines():
        assert line in written


# -- events ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("event", "level", "text"),
    [
        (events.PhaseEntered(Phase.END, 2), "INFO", "PhaseEntered: phase=end, attempt=2"),
        (events.PacketAcknowledged(1, 2, 1), "DEBUG",
         "PacketAcknowledged: number=1, total=2, tries=1"),
        (events.Reported("odd\x1b["), "WARNING", "Reported: what=odd\\x1b["),
        (events.BytesDamaged(0x725, "cut short", b"\x55\xaa"), "WARNING",
         "BytesDamaged: can_id=1829, reason='cut short', data=55 aa"),
        (events.CheckMade("target", "passed", "fits"), "INFO",
         "CheckMade: check=target, verdict=passed, text=fits"),
        (events.CheckMade("target", "refused", "no"), "WARNING",
         "CheckMade: check=target, verdict=refused, text=no"),
        (events.AdapterBack(), "INFO", "AdapterBack"),
        ("something else", "DEBUG", "str: something else"),
    ],
)  # fmt: skip
def test_events_are_logged_by_how_much_they_matter(
    caplog: pytest.LogCaptureFixture, event: Any, level: str, text: str
) -> None:
    caplog.set_level(logging.DEBUG, "flasher")
    log_event(event)
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == (level, text)
    assert logging.getLevelName(level_of(event)) == level
    assert "\n" not in describe(event)


def test_nothing_is_written_out_for_a_level_that_is_off(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flasher.log.describe", lambda _event: pytest.fail("needless work"))
    log_event(events.PacketAcknowledged(1, 2, 1))


def test_the_device_models_events_have_a_logger_of_their_own(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG, "flasher")
    log_event(events.PacketStored(1, 2))
    log_event(events.PacketAcknowledged(1, 2, 1))
    assert [record.name for record in caplog.records] == ["flasher.mock", "flasher.host"]


def test_trouble_of_every_kind_is_at_least_a_warning() -> None:
    named = {event.__name__ for event in event_classes()}
    for trouble in ("MessageRepeated", "AdapterLost", "ShutdownHeard", "QueryUnanswered"):
        assert trouble in named
        event = getattr(events, trouble)
        assert level_of(object.__new__(event)) == logging.WARNING


def test_what_python_can_prints_after_the_end_goes_nowhere(flasher: Flasher) -> None:
    """Without any handler, Python itself would print it."""
    assert flasher("image-info", OBC).code == 0
    handlers = logging.getLogger("can").handlers
    assert [type(each) for each in handlers] == [logging.NullHandler]


def test_a_bus_that_could_not_be_opened_is_no_warning_beside_its_failure(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(**_config: object) -> None:
        logging.getLogger("can.bus").warning("%s was not properly shut down", "FakeBus")
        logging.getLogger("can.interfaces.socketcan.socketcan").error(
            "Could not access SocketCAN device %s (%s)", "can0", "No such device"
        )
        logging.getLogger("can.interfaces.socketcand.socketcand").error(
            "Failed to receive: invalid literal  Traceback (most recent call last):\n  File x"
        )
        logging.getLogger("can.bus").warning("something else")
        raise OSError("no socket")

    monkeypatch.setattr("can.Bus", fails)
    reported = flasher("scan", "-i", "virtual", "-c", "x").err
    assert "The adapter cannot be opened" in reported
    assert "something else" in reported
    assert "properly" not in reported
    assert "Could not access" not in reported
    assert "Traceback" not in reported
