"""A browser on the page of a station at full speed: `python -m tests.campaigns.page_soak --units
3000`. Prints the memory of page and server as it goes, and every state that the station reported
and the page did not show.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Final

from playwright.sync_api import Page

from tests.campaigns.page_kills import RECIPE, free_port
from tests.web.browser import chromium

_LOG: Final = """() => {
  window.shown = [];
  const first = window.show;
  window.show = (tile) => {
    window.shown.push([tile.socket, tile.state, tile.is_label ? tile.serial : ""]);
    first(tile);
  };
}"""
_MIB: Final = 1024 * 1024
Sequences = dict[str, list[tuple[str, str]]]


def _server_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / _MIB


def _page_mib(page: Page) -> float:
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used: float = session.send("Runtime.getHeapUsage")["usedSize"]
    session.detach()
    return used / _MIB


def _add(found: Sequences, socket: str, state: str, serial: str) -> None:
    """Add a state that differs from the one before."""
    if not found[socket] or found[socket][-1] != (state, serial):
        found[socket].append((state, serial))


def main() -> int:
    """Run the station to its end; returns 1 when the page left a state out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--units", type=int, default=3000)
    parser.add_argument("--sockets", type=int, default=8)
    options = parser.parse_args()
    noted: Sequences = defaultdict(list)
    shown: Sequences = defaultdict(list)
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        port, folder = free_port(), Path(name)
        with (folder / "events.jsonl").open("wb") as events:
            station = subprocess.Popen(
                [
                    sys.executable, "-m", "flasher", "station", "run", "--recipe", str(RECIPE),
                    "--mock-sockets", str(options.sockets), "--mock-speed", "0",
                    "--units", str(options.units), "--web", str(port),
                    "--database", str(folder / "records.sqlite"), "--keys", str(folder / "keys"),
                ],
                stdin=subprocess.DEVNULL, stdout=events,
            )  # fmt: skip
        page = browser.new_page()
        while True:
            try:
                page.goto(f"http://127.0.0.1:{port}/line")
                break
            except Exception:  # noqa: BLE001  it is still starting
                time.sleep(0.1)
        page.evaluate(_LOG)
        began, looked = time.perf_counter(), 0.0
        is_over = False
        while not is_over:
            is_over = station.poll() is not None
            page.wait_for_timeout(500)
            for socket, state, serial in page.evaluate("() => window.shown.splice(0)"):
                _add(shown, socket, state, serial)
            if time.perf_counter() - looked > 60.0 and not is_over:
                looked = time.perf_counter()
                minutes = (looked - began) / 60
                mib = f"server {_server_mib(station.pid):.1f} MiB, page {_page_mib(page):.2f} MiB"
                sys.stdout.write(f"{minutes:.0f} min: {mib}\n")
                sys.stdout.flush()
        for line in (folder / "events.jsonl").read_text().splitlines():
            event = json.loads(line)
            if event.get("event") == "SocketChanged":
                _add(noted, event["socket"], event["state"], event["serial"])
    count = sum(map(len, noted.values()))
    missed = 0
    for socket, states in noted.items():
        first = (
            states.index(shown[socket][0]) if shown[socket] else 0
        )  # reported before it was opened
        same = difflib.SequenceMatcher(None, states[first:], shown[socket], autojunk=False)
        missed += len(states[first:]) - sum(block.size for block in same.get_matching_blocks())
    if missed:
        sys.stdout.write(f"reported {dict(noted)}\nshown {dict(shown)}\n")
    sys.stdout.write(f"{count} states of {options.units} units, {missed} not shown\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
