"""Kills a station with -9 while a browser watches its page: `python -m tests.campaigns.page_kills
--count 200`.

Each time: no PASS was ever on the page that is not on disk; the page is covered within 3 s of the
kill; and it is right again after the restart, without being loaded anew.
"""

from __future__ import annotations

import argparse
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from playwright.sync_api import Page, expect
from sqlalchemy import create_engine
from sqlalchemy import text as sql

from tests.web.browser import chromium

RECIPE: Final = Path(__file__).parents[2] / "firmware_samples" / "station" / "recipe.toml"
_COVERED_WITHIN_S: Final = 3.0
_BACK_WITHIN_MS: Final = 60_000

_WATCH: Final = """() => {
  window.greens = [];
  window.loads = 1;
  const look = () => {
    const covered = getComputedStyle(document.getElementById("cover")).visibility === "visible";
    if (covered) { window.coveredAt ??= Date.now(); } else { window.coveredAt = null; }
    if (covered) return;
    for (const article of document.querySelectorAll("article[data-state=pass]")) {
      const serial = article.dataset.serial;
      if (!window.greens.includes(serial)) window.greens.push(serial);
    }
  };
  new MutationObserver(look).observe(document.body, {subtree: true, attributes: true});
  setInterval(look, 20);
}"""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


def _start(folder: Path, port: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [
            sys.executable, "-m", "flasher", "station", "run", "--recipe", str(RECIPE),
            "--mock-sockets", "4", "--mock-speed", "5", "--web", str(port),
            "--database", str(folder / "records.sqlite"), "--keys", str(folder / "keys"),
        ],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _passed(folder: Path) -> set[str]:
    """Serial numbers of units that have a PASS on disk."""
    engine = create_engine(f"sqlite:///{folder / 'records.sqlite'}")
    with engine.connect() as connection:
        query = sql(
            "SELECT unit.serial FROM run JOIN unit ON unit.id = run.unit_id"
            " WHERE run.state = 'PASS'"
        )
        found = {str(row[0]) for row in connection.execute(query)}
    engine.dispose()
    return found


def _one(page: Page, folder: Path, port: int, chance: random.Random) -> tuple[float, list[str]]:
    """One station, from its start to its kill; how long until the page was covered, and the greens
    that are not on disk.
    """
    station = _start(folder, port)
    try:
        expect(page.locator("#cover")).to_be_hidden(timeout=_BACK_WITHIN_MS)
        page.wait_for_timeout(chance.uniform(500, 4000))
    finally:
        station.send_signal(signal.SIGKILL)
        killed_at = time.time()
        station.wait()
    page.wait_for_function("() => window.coveredAt !== null", timeout=10_000, polling=50)
    covered_after_s = page.evaluate("() => window.coveredAt") / 1000 - killed_at
    greens: list[str] = page.evaluate("() => window.greens")
    on_disk = _passed(folder)
    return covered_after_s, [serial for serial in greens if serial not in on_disk]


def main() -> int:
    """Kill as often as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=200, help="how many kills (200)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    chance, worst_s, bad, port = random.Random(options.seed), 0.0, 0, free_port()
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder = Path(name)
        station = _start(folder, port)
        page: Any = browser.new_page()
        for _ in range(100):
            try:
                page.goto(f"http://127.0.0.1:{port}/line")
                break
            except Exception:  # noqa: BLE001  it is still starting
                time.sleep(0.3)
        page.evaluate(_WATCH)
        station.send_signal(signal.SIGKILL)
        station.wait()
        for number in range(1, options.count + 1):
            covered_after_s, unsaved = _one(page, folder, port, chance)
            worst_s = max(worst_s, covered_after_s)
            if unsaved or covered_after_s > _COVERED_WITHIN_S:
                bad += 1
                sys.stdout.write(
                    f"kill {number}: {covered_after_s:.2f} s, not on disk: {unsaved}\n"
                )
            if number % 20 == 0:
                seen = len(page.evaluate("() => window.greens"))
                sys.stdout.write(f"{number} kills, {seen} greens seen, covered {worst_s:.2f} s\n")
                sys.stdout.flush()
        seen = len(page.evaluate("() => window.greens"))
        loads = page.evaluate("() => window.loads")  # undefined if it had been loaded anew
    sys.stdout.write(
        f"{options.count} kills: {bad} bad; {seen} greens, each on disk; covered within"
        f" {worst_s:.2f} s at the latest; page loaded {loads} time\n"
    )
    return 1 if bad or loads != 1 else 0


if __name__ == "__main__":
    sys.exit(main())
