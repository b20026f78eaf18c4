"""Adapter locks: one tool at a time, by any name of the adapter; a dead process has no lock."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flasher.bus import lock
from flasher.bus.adapter import open_adapter
from flasher.errors import BusError, ExitCode
from tests.loops import each

SLCAN = {"interface": "slcan", "channel": "COM3"}
CAN0 = {"interface": "socketcan", "channel": "can0"}


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path


def is_free(config: dict[str, Any]) -> bool:
    try:
        lock.acquire(config, "somebody else")()
    except BusError:
        return False
    return True


def test_a_second_holder_learns_who_has_it_and_since_when() -> None:
    release = lock.acquire(CAN0, "flasher flash")
    with pytest.raises(BusError) as caught:
        lock.acquire(CAN0, "flasher read")
    error = caught.value
    assert error.exit_code is ExitCode.BUS
    assert (
        f"socketcan can0 is in use by flasher flash (process {os.getpid()}, since 20" in error.what
    )
    assert "Wait until it has ended" in error.remedy
    release()
    release()
    assert is_free(CAN0)


@each(
    "one, other, same",
    [
        (CAN0, {"interface": "socketcan", "channel": "can1"}, False),
        (CAN0, {"interface": "gs_usb", "channel": "can0"}, False),
        (CAN0, CAN0 | {"bitrate": 125_000}, True),
        ({"interface": "kvaser", "channel": 0}, {"interface": "kvaser", "channel": "0"}, True),
        (
            {"interface": "slcan", "channel": "COM3"},
            {"interface": "slcan", "channel": "com3"},
            True,
        ),
        (SLCAN, SLCAN | {"channel": r"\\.\COM3"}, True),
        (SLCAN, SLCAN | {"channel": "//./com3"}, True),
        (SLCAN, SLCAN | {"channel": r"\\?\COM3@115200"}, True),
        (SLCAN, SLCAN | {"channel": "COM3@115200"}, True),
        (SLCAN, SLCAN | {"channel": r"\\.\COM33"}, False),
        (
            {"interface": "udp_multicast", "channel": "239.74.163.2"},
            {"interface": "udp_multicast", "channel": "239.74.163.9", "port": 43113},
            True,
        ),
        (
            {"interface": "udp_multicast", "channel": "239.74.163.2", "port": 43114},
            {"interface": "udp_multicast", "channel": "239.74.163.2"},
            False,
        ),
        ({"interface": "virtual", "channel": 0}, {"interface": "virtual", "channel": 0}, False),
        (
            {"interface": "gs_usb", "channel": 0, "index": 0},
            {"interface": "gs_usb", "channel": 0, "index": 1},
            False,
        ),
    ],
)
def test_the_same_adapter_is_known_however_it_is_named(
    one: dict[str, Any], other: dict[str, Any], *, same: bool
) -> None:
    release = lock.acquire(one, "one")
    assert is_free(other) is not same
    release()


def test_who_only_listens_takes_a_serial_adapter_alone() -> None:
    """To open it a second time would end the upgrade that uses it."""
    lock.acquire(CAN0, None)
    assert is_free(CAN0)
    release = lock.acquire(SLCAN, None)
    with pytest.raises(BusError) as caught:
        lock.acquire(SLCAN, None)
    assert "monitor" not in caught.value.remedy, "it would open the port, too"
    release()


@pytest.mark.skipif(sys.platform == "win32", reason="needs links and SIGKILL")
def test_a_serial_port_is_the_same_by_its_link(tmp_path: Path) -> None:
    port, link = tmp_path / "ttyACM0", tmp_path / "by-id"
    port.touch()
    link.symlink_to(port)
    release = lock.acquire({"interface": "slcan", "channel": f"{link}@115200"}, "one")
    assert not is_free({"interface": "slcan", "channel": str(port)})
    release()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs links and SIGKILL")
def test_who_was_killed_holds_nothing() -> None:
    script = (
        "import time; from flasher.bus.lock import acquire;"
        f"held = acquire({CAN0!r}, 'flasher flash'); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        try:
            assert not is_free(CAN0)
        finally:
            process.send_signal(signal.SIGKILL)
    assert is_free(CAN0)


@pytest.mark.parametrize("noted", ["", "[]", "{", '{"holder": 1}', "\x00\xff"])
def test_what_is_beside_the_lock_may_be_anything(state: Path, noted: str) -> None:
    release = lock.acquire(CAN0, "one")
    (note,) = state.glob("flasher/locks/*.json")
    note.write_text(noted)
    with pytest.raises(BusError, match="in use by another program"):
        lock.acquire(CAN0, "another")
    release()


def test_a_state_folder_that_cannot_be_written_keeps_no_one_from_working(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    lock.acquire(CAN0, "flasher flash")()
    assert "no lock for socketcan can0" in caplog.text


def test_an_adapter_that_cannot_be_opened_is_not_held() -> None:
    for _ in range(2):
        with pytest.raises(BusError, match="cannot be opened"):
            open_adapter(250_000, holder="flasher flash", interface="socketcan", channel="nocan7")


def test_an_open_adapter_is_held_over_a_reopening_and_until_it_is_closed() -> None:
    config: dict[str, Any] = {"interface": "udp_multicast", "port": 43999, "hop_limit": 0}
    try:
        link = open_adapter(250_000, holder="flasher flash", **config)
    except BusError as error:
        pytest.skip(str(error))
    link.reopen()
    assert not is_free(config)
    with_none = open_adapter(250_000, **config)
    with_none.close()
    link.close()
    link.close()
    assert is_free(config)
    with pytest.raises(BusError, match="was closed"):
        link.reopen()
    with pytest.raises(BusError, match="it is not open"):
        link.receive(0.0)
