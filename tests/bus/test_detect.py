"""Looking for adapters in processes that may hang, crash and say odd things."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from flasher.bus import detect
from flasher.bus.detect import DetectedAdapter, Detection, network_adapters, serial_ports

# Replaces the process that asks: the answer of each back end goes by its name.
CHILD = """
import os, sys, time
for name in sys.argv[1:]:
    if name == "crashes":
        sys.stdout.flush()
        os._exit(3)
    if name == "talks":
        print("Vendor library v1.2"); print('detected: {"interface": 1')
    if name == "fails":
        print('detected: {"interface": "fails", "channels": [], "sees": "",'
              ' "error": "OSError: no driver"}')
    if name.startswith("good"):
        print('detected: {"interface": "%s", "channels": [{"channel": "ch0", "serial": 7}],'
              ' "sees": "", "error": ""}' % name)
    sys.stdout.flush()
if "hangs" in sys.argv:
    time.sleep(60)
"""
COMMAND = (sys.executable, "-S", "-c", CHILD)


@pytest.mark.slow
def test_one_back_end_that_hangs_does_not_hide_the_others() -> None:
    began = time.perf_counter()
    with Detection(["hangs", "good"], command=COMMAND, limit_s=0.5) as detection:
        detected = detection.collect()
    assert time.perf_counter() - began < 5.0
    assert detected.found == [DetectedAdapter("good", "ch0", {"serial": 7})]
    assert detected.hung == ["hangs"]
    assert detection._processes[0][1].returncode is not None


def test_one_that_crashes_does_not_take_the_others_with_it() -> None:
    with Detection(["crashes", "good1", "good2"], command=COMMAND, limit_s=20.0) as detection:
        detected = detection.collect()
    assert [found.interface for found in detected.found] == ["good1", "good2"]
    assert "3" in detected.failed["crashes"]
    assert detected.hung == []


def test_a_failure_and_odd_output_are_distinguished_from_answers() -> None:
    with Detection(["fails", "talks", "good"], command=COMMAND, limit_s=20.0) as detection:
        detected = detection.collect()
    assert [found.arguments for found in detected.found] == ["-i good -c ch0"]
    assert detected.failed["fails"] == "OSError: no driver"


def test_no_process_is_left_when_no_one_collects() -> None:
    with Detection(["hangs"], command=COMMAND, limit_s=20.0) as detection:
        process = detection._processes[0][1]
        assert process.poll() is None
    assert process.returncode is not None


@pytest.mark.slow
def test_who_does_not_want_to_wait_gets_what_there_is() -> None:
    began = time.perf_counter()
    with Detection(["hangs", "good"], command=COMMAND, limit_s=60.0) as detection:
        detected = detection.collect(lambda: time.perf_counter() - began > 0.3)
    assert time.perf_counter() - began < 10.0
    assert [found.interface for found in detected.found] == ["good"]


def test_interfaces_that_reach_no_bus_are_not_asked() -> None:
    with Detection(["virtual", "udp_multicast"], command=COMMAND) as detection:
        assert detection._processes == []
        assert detection.collect().found == []


def test_the_real_process_answers_for_python_cans_back_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def answer(name: str) -> list[dict[str, object]]:
        if name == "vector":
            raise RuntimeError("no driver")
        if name != "kvaser":
            return []
        return [{"interface": name, "channel": 0, "config": object()}]

    monkeypatch.setattr("can.detect_available_configs", answer)
    monkeypatch.setitem(can.interfaces.BACKENDS, "virtual2", ("no_such_module", "Bus"))
    detect.print_detected(["kvaser", "vector", "slcan", "virtual2"])
    answers = [json.loads(line.partition(": ")[2]) for line in capsys.readouterr().out.splitlines()]
    assert sorted(answers, key=lambda answer: str(answer["interface"])) == [
        {"interface": "kvaser", "channels": [{"channel": 0}], "sees": "", "error": ""},
        {"interface": "slcan", "channels": [], "sees": "cannot_tell", "error": ""},
        {"interface": "vector", "channels": [], "sees": "", "error": "RuntimeError: no driver"},
        {"interface": "virtual2", "channels": [], "sees": "not_loaded", "error": ""},
    ]


def test_a_back_end_that_can_list_nothing_is_distinguished_from_one_that_finds_nothing() -> None:
    child = """
for name, sees in (("a", "cannot_tell"), ("b", "not_loaded"), ("c", "")):
    print('detected: {"interface": "%s", "channels": [], "sees": "%s", "error": ""}' % (name, sees))
"""
    command = (sys.executable, "-S", "-c", child)
    with Detection(["a", "b", "c"], command=command, limit_s=20.0) as detection:
        detected = detection.collect()
    assert (detected.cannot_tell, detected.not_loaded, detected.hung) == (["a"], ["b"], [])


def test_the_kernels_interfaces_are_found_up_or_down(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, kind in (("can0", "280"), ("eth0", "1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(kind)
        (tmp_path / name / "flags").write_text("0x0")
    monkeypatch.setattr(detect, "network_adapters", lambda sysfs=tmp_path: network_adapters(sysfs))
    with Detection(["socketcan", "slcan"], command=COMMAND) as detection:
        assert detection._processes == [], "a serial port is not opened to look"
        assert detection.collect().found == [DetectedAdapter("socketcan", "can0")]


def test_a_serial_port_is_one_with_its_usb_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = SimpleNamespace(
        device="/dev/ttyACM0", description="CANable2", serial_number="0042", location="1-1.4",
        vid=0x16D0,
    )  # fmt: skip
    own = SimpleNamespace(
        device="/dev/ttyS0", description="n/a", serial_number=None, location=None, vid=None
    )
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [own, port])
    (found,) = serial_ports("slcan")
    assert (found.serial_number, found.usb_path) == ("0042", "1-1.4")
    assert found.arguments == "-i slcan -c /dev/ttyACM0"
