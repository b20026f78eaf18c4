"""`flasher station pages`: the supervisor pages of records, in processes of their own."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from tests.cli.conftest import Flasher
from tests.station.factory import SERIAL, Bench


def test_records_are_served_until_ctrl_c(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.make()
    bench.store.close()
    words = [sys.executable, "-m", "flasher", "station", "pages", "--web", "0"]
    words += ["--database", str(bench.path), "--keys", str(bench.keys)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        found = re.search(r"http://127\.0\.0\.1:\d+/", process.stderr.readline())
        assert found is not None
        with urllib.request.urlopen(found[0], timeout=30) as answer:  # noqa: S310  of this computer
            assert answer.url.endswith("/runs")
            assert SERIAL in answer.read().decode()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--database", "nothing.sqlite"),
            "nothing.sqlite. [E201]",
        ),
        (("--web", "0.0.0.0:0"), "--web-certificate"),
        (("--web", "here"), "is no address"),
    ],
)
def test_what_cannot_be_served_is_said(
    flasher: Flasher, tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    bench = Bench(tmp_path)
    bench.store.close()
    run = flasher("station", "pages", "--database", bench.path, *options)
    assert run.code == 2
    assert said in run.err
