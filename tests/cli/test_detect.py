"""Looking for adapters in processes that may hang, crash and say odd things."""

from __future__ import annotations

import sys
import time

import pytest

from flasher.cli.look import detect
from flasher.cli.look.detect import Detection, Found

# Stands for the process that asks: the answer of each back end goes by its name.
CHILD = """
import os, sys, time
for name in sys.argv[1:]:
    if name == "crashes":
        sys.stdout.flush()
        os._exit(3)
    if name == "talks":
        print("Vendor library v1.2"); print('detected: {"interface": 1')
    if name == "fails":
        print('detected: {"interface": "fails", "channels": [], "error": "OSError: no driver"}')
    if name.startswith("good"):
        print('detected: {"interface": "%s", "channels": [{"channel": "ch0", "serial": 7}],'
              ' "error": ""}' % name)
    sys.stdout.flush()
if "hangs" in sys.argv:
    time.sleep(60)
"""
COMMAND = (sys.executable, "-S", "-c", CHILD)


def test_one_back_end_that_hangs_does_not_hide_the_others() -> None:
    began = time.monotonic()
    with Detection(["hangs", "good"], command=COMMAND, limit_s=0.5) as detection:
        detected = detection.collect()
    assert time.monotonic() - began < 5.0
    assert detected.found == [Found("good", "ch0", {"serial": 7})]
    assert detected.hung == ["hangs"]
    assert detection._processes[0][1].returncode is not None


def test_one_that_crashes_does_not_take_the_others_with_it() -> None:
    with Detection(["crashes", "good1", "good2"], command=COMMAND, limit_s=20.0) as detection:
        detected = detection.collect()
    assert [found.interface for found in detected.found] == ["good1", "good2"]
    assert "3" in detected.failed["crashes"]
    assert detected.hung == []


def test_a_failure_and_odd_output_are_told_from_answers() -> None:
    with Detection(["fails", "talks", "good"], command=COMMAND, limit_s=20.0) as detection:
        detected = detection.collect()
    assert [found.arguments for found in detected.found] == ["-i good -c ch0"]
    assert detected.failed["fails"] == "OSError: no driver"


def test_no_process_is_left_when_nobody_collects() -> None:
    with Detection(["hangs"], command=COMMAND, limit_s=20.0) as detection:
        process = detection._processes[0][1]
        assert process.poll() is None
    assert process.returncode is not None


def test_who_does_not_want_to_wait_gets_what_there_is() -> None:
    began = time.monotonic()
    with Detection(["hangs", "good"], command=COMMAND, limit_s=60.0) as detection:
        detected = detection.collect(lambda: time.monotonic() - began > 0.3)
    assert time.monotonic() - began < 10.0
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
        return [{"interface": name, "channel": 0, "config": object()}]

    monkeypatch.setattr("can.detect_available_configs", answer)
    detect.say_detected(["kvaser", "vector"])
    lines = sorted(capsys.readouterr().out.splitlines())
    assert lines == [
        'detected: {"interface": "kvaser", "channels": [{"channel": 0}], "error": ""}',
        'detected: {"interface": "vector", "channels": [], "error": "RuntimeError: no driver"}',
    ]
