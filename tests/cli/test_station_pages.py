"""`flasher station pages`: the supervisor pages of records, in processes of their own."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import httpx2
import pytest

from tests.cli.conftest import Flasher
from tests.station.factory import SERIAL, Bench

pytestmark = pytest.mark.slow


def test_records_are_served_until_ctrl_c(tmp_path: Path) -> None:
    """To who signs in: that is in the log, since the station alone writes the audit trail."""
    bench = Bench(tmp_path)
    bench.make()
    bench.store.close()
    sockets = tmp_path / "sockets.toml"
    sockets.write_text('badges = "badges.toml"\n[[socket]]\nname = "A"\nmock = {}\n')
    badge = '[[person]]\nname = "Sue"\ncode = "BADGE-2"\nrole = "supervisor"\n'
    (tmp_path / "badges.toml").write_text(badge)
    words = [sys.executable, "-m", "flasher", "-v", "station", "pages", "--web", "0"]
    words += ["--sockets", str(sockets), "--database", str(bench.path), "--keys", str(bench.keys)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        found = re.search(r"http://127\.0\.0\.1:\d+", process.stderr.readline())
        assert found is not None
        headers = {"origin": found[0]}
        with httpx2.Client(
            base_url=found[0], headers=headers, follow_redirects=True, timeout=30
        ) as client:
            page = client.get("/")
            assert page.url.path == "/login"
            token = re.search(r'name="token" value="(.*?)"', page.text)
            assert token is not None
            runs = client.post("/login", data={"token": token[1], "badge": "BADGE-2"})
            assert runs.url.path == "/runs"
            assert SERIAL in runs.text
            assert "signed in: Sue" in runs.text
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
        assert "sign-in: {'number': '1', 'name': 'Sue'" in process.stderr.read()


@pytest.mark.parametrize(
    ("options", "reported"),
    [
        (
            ("--database", "nothing.sqlite"),
            "nothing.sqlite. [E201]",
        ),
        (("--web", "0.0.0.0:0"), "--web-certificate"),
        (("--web", "here"), "must be PORT or HOST:PORT"),
    ],
)
def test_what_cannot_be_served_is_reported(
    flasher: Flasher, tmp_path: Path, options: tuple[str, ...], reported: str
) -> None:
    bench = Bench(tmp_path)
    bench.store.close()
    run = flasher("station", "pages", "--database", bench.path, *options)
    assert run.code == 2
    assert reported in run.err
