"""The conformance suite against a device model in another process, over UDP multicast."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.end_to_end.processes import MockProcess, run_here
from tests.end_to_end.test_processes import bus
from tests.firmware import VECTORS

pytestmark = pytest.mark.slow

__all__ = ["bus"]
IMAGE = VECTORS + b"V2r0r1_20240131" + bytes(range(256)) * 2


def test_a_mock_in_another_process_gets_the_verdicts_that_the_built_in_one_gets(
    bus: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "good.bin").write_bytes(IMAGE)
    wanted = ("--case", "FR-08", "--case", "UP-08")
    with MockProcess("-t", "bms", *bus, folder=tmp_path):
        done = run_here(
            *("conformance", "-t", "bms", "--good-image", "good.bin", *wanted, "--json", *bus),
            folder=tmp_path,
        )
    built_in = run_here("conformance", "-t", "bms", "--mock", *wanted, "--json", folder=tmp_path)
    found = [json.loads(run.stdout)["report"] for run in (done, built_in)]
    verdicts = [
        [(result["id"], result["status"]) for result in report["results"]] for report in found
    ]
    assert verdicts[0] == [("FR-08", "pass"), ("UP-08", "pass_in_part")]  # it has no readback
    assert verdicts[1] == [("FR-08", "pass"), ("UP-08", "pass")]
    assert found[0]["final_image"] == "verified"
    assert found[0]["timestamp_source"].startswith("kernel")
    # The echo of a packet comes before its ACK: no time is negative.
    assert min(times["minimum_s"] for times in found[0]["times"]) >= 0
    assert done.returncode == 0
