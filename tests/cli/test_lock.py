"""Which commands are refused while a second tool sends on the adapter."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from flasher.bus.lock import acquire
from flasher.errors import ExitCode
from tests.cli.conftest import SAMPLES, Flasher

BUS = ("-i", "socketcan", "-c", "nocan7")
IMAGE = str(SAMPLES / "bms.bin")


@pytest.fixture(autouse=True)
def somebody_else() -> Iterator[None]:
    give_back = acquire({"interface": "socketcan", "channel": "nocan7"}, "flasher flash")
    yield
    give_back()


@pytest.mark.parametrize(
    "words",
    [
        ("flash", IMAGE, "-t", "bms"),
        ("rescue", IMAGE, "-t", "bms"),
        ("read", "history"),
        ("write", "user-string-1", "rack 7", "--yes"),
        ("info", "-t", "bms"),
        ("scan",),
        ("conformance", "-t", "bms", "--good-image", IMAGE),
    ],
    ids=lambda words: str(words[0]),
)
def test_a_command_that_asks_is_refused_and_learns_who_has_the_adapter(
    flasher: Flasher, words: tuple[str, ...]
) -> None:
    run = flasher(*words, *BUS)
    assert run.code == ExitCode.BUS
    assert "socketcan nocan7 is in use by flasher flash (process " in run.err
    assert "monitor" in run.err


@pytest.mark.parametrize("words", [("monitor",), ("mock", "-t", "bms")], ids=lambda words: words[0])
def test_who_never_speaks_as_the_tool_is_not_refused(
    flasher: Flasher, words: tuple[str, ...]
) -> None:
    run = flasher(*words, *BUS)
    assert "[E401]" in run.err, "there is no such interface"


def test_the_mock_needs_no_lock(flasher: Flasher) -> None:
    assert flasher("read", "history", "--mock", "--mock-speed", "0").code == ExitCode.OK
