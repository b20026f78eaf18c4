"""The bench page in a real browser, with a device in another process on a bus of UDP multicast:
`python -m tests.campaigns.bench_page`, `--case WORDS` for some of the cases.

Each case is a `flasher ui` of its own. It prints what the page showed, and what was wrong.
"""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import can
from playwright.sync_api import Browser, Page, expect

from flasher.image.release import Release
from flasher.protocol.spec import BMS
from flasher.settings.manifest import manifest_path, to_toml
from tests.end_to_end.processes import FLASHER, MockProcess, clean_environment, lines_until
from tests.end_to_end.serial_adapter import READY
from tests.end_to_end.stage import NEW, image_of
from tests.end_to_end.stranger import Stranger
from tests.end_to_end.test_processes import GROUP, bus_words, free_port
from tests.web.browser import chromium

PACKETS: Final = 400
IMAGE: Final = "new.bin"
_WAIT_MS: Final = 60_000
_CRC_WANTED: Final = ("--set", "image_checksum=crc32")
_SLOW: Final = ("--set", "program_time_s=0.004")
"""So that something can happen in the middle."""
_PACKET: Final = bytes.fromhex("55AA168700000000")
"""The beginning of a message that only a tool sends."""


@dataclass
class Bench:
    """A bus, the page on it, and a browser that shows it."""

    folder: Path
    port: int
    page: Page
    stack: ExitStack
    reported: list[str] = field(default_factory=list)
    adapter: subprocess.Popen[str] | None = None
    """Where it is a process of its own."""
    ui: subprocess.Popen[str] | None = None

    @property
    def bus(self) -> tuple[str, ...]:
        return bus_words(self.port)

    @property
    def image(self) -> bytes:
        return (self.folder / IMAGE).read_bytes()

    def device(self, *arguments: str) -> MockProcess:
        """A battery in another process."""
        words = ("-t", "bms", "--save-image", "out.bin", *_SLOW, *arguments, *self.bus)
        return MockProcess(*words, folder=self.folder)

    def begin(self) -> None:
        """Choose adapter, battery and image."""
        self.page.click("#adapter-1:enabled")
        self.page.click("#target-bms:enabled", timeout=_WAIT_MS)
        self.page.click(f"#image button:text-is('{IMAGE}')")

    def go(self) -> None:
        self.page.click("#go")

    def until_packet(self, number: int) -> None:
        """Wait until so many packets are acknowledged."""
        script = """number => {
            const found = document.querySelector("#pace")?.textContent.match(/([0-9,]+) of/);
            return found && Number(found[1].replace(",", "")) >= number;
        }"""
        self.page.wait_for_function(script, arg=number, timeout=_WAIT_MS)

    def claims(self) -> list[str]:
        """The three claims of the end."""
        expect(self.page.locator("#next-bike")).to_be_enabled(timeout=_WAIT_MS)
        found = self.page.locator("#result .claim strong").all_inner_texts()
        self.say(f"claims {', '.join(found)}")
        return found

    def error(self) -> str:
        """The error at the end, in bold."""
        text = self.page.locator("#result .what").inner_text()
        self.say(text)
        return text

    def say(self, text: str) -> None:
        self.reported.append(text)

    def plug(self) -> tuple[str, ...]:
        """Plug in a serial adapter; returns the arguments that use it."""
        link = self.folder / "port"
        words = ["-m", "tests.end_to_end.serial_adapter", str(link), GROUP, str(self.port)]
        self.adapter = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
        self.stack.callback(self.adapter.wait)
        self.stack.callback(self.adapter.kill)
        assert self.adapter.stdout is not None
        lines_until(self.adapter.stdout, READY)
        return ("-i", "slcan", "-c", str(link), "--bus-kwargs", "sleep_after_open=0.05")

    def pull(self) -> None:
        """Pull the adapter out."""
        assert self.adapter is not None
        self.adapter.kill()

    def start(self, *bus: str) -> None:
        """Start `flasher ui` with folders of its own, and open its page."""
        homes = {name: str(self.folder / name) for name in ("XDG_STATE_HOME", "XDG_DATA_HOME")}
        self.ui = ui = subprocess.Popen(
            [*FLASHER, "ui", "--no-browser", "--images", str(self.folder), *bus],
            stdout=subprocess.PIPE,
            stderr=(self.folder / "terminal.txt").open("w"),
            text=True,
            env=clean_environment(**homes),
        )
        self.stack.callback(ui.wait)
        self.stack.callback(ui.kill)
        assert ui.stdout is not None
        self.page.goto(lines_until(ui.stdout, "http://")[-1].strip())


# -- the cases -------------------------------------------------------------------------------------


def whole(bench: Bench) -> None:
    """A whole upgrade."""
    with bench.device():
        bench.begin()
        bench.go()
        assert bench.claims() == ["YES"] * 3, "three times yes"
        stored = (bench.folder / "out.bin").read_bytes()
        assert stored == bench.image, "the device has the image byte for byte"
        bench.page.click("#sheet")
        expect(bench.page.locator("tr.changed").first).to_contain_text(NEW)
        bench.say(f"{len(stored):,} bytes stored as sent; the sheet shows {NEW}")


def interrupted(bench: Bench) -> None:
    """The device loses its power in the middle, and is rescued."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
    assert bench.claims() == ["NO", "NO", "NOT KNOWN"], "not completed"
    bench.error()
    bench.page.click("#do-rescue-it")
    bench.page.click("#go")
    expect(bench.page.locator("#work")).to_contain_text("Switch the device off and on now")
    expect(bench.page.locator("#pace")).to_contain_text("s more")
    first = bench.page.locator("#pace .what").inner_text()
    expect(bench.page.locator("#pace .what")).not_to_have_text(first)
    bench.say(f"then: {first} and counts down")
    with bench.device("--no-app"):
        assert bench.claims() == ["YES"] * 3, "rescued"
    stored = (bench.folder / "out.bin").read_bytes()
    assert stored == bench.image, "the device has the image byte for byte"


def refused(bench: Bench) -> None:
    """The device refuses the image at the end."""
    with bench.device(*_CRC_WANTED):
        bench.begin()
        bench.go()
        assert bench.claims() == ["YES", "NO", "NOT KNOWN"], "transferred alone"
        assert "refused the image" in bench.error(), "the refusal is shown"
        bench.page.click("#do-rescue-it")
        expect(bench.page.locator("#image-1")).to_be_visible()
        assert not _is_shown(bench, "#go"), "the refused image is not chosen again"


def not_for_it(bench: Bench) -> None:
    """The image is for other hardware: it is not offered, and waived in a second step."""
    release = Release(
        target=BMS, size_bytes=len(bench.image), sha256=image_of(PACKETS, NEW).sha256,
        hardware_versions=("V9r9r9_*",), source="",
    )  # fmt: skip
    manifest_path(bench.folder / IMAGE).write_text(to_toml(release))
    with bench.device():
        bench.page.click("#adapter-1:enabled")
        bench.page.click("#target-bms:enabled", timeout=_WAIT_MS)
        bench.page.click("#refused-all")
        assert not _is_shown(bench, "#image-1"), "it is not offered"
        bench.say(bench.page.locator("#refused p").first.inner_text().partition(";")[0])
        bench.page.click("#waive-1")
        bench.page.check("#waive-1-risk")
        bench.page.click("#waive-1-go")
        bench.go()
        assert bench.claims() == ["YES"] * 3, "upgraded"
        expect(bench.page.locator("#start")).to_contain_text("waived")
        bench.page.click("#kept")
        expect(bench.page.locator("main")).to_contain_text("hardware")


def asking_tool(bench: Bench) -> None:
    """A program that knows no lock asks the battery in the middle: that writes nothing."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        with Stranger(bench.bus, every_s=0.15):
            assert bench.claims() == ["YES"] * 3, "three times yes"


def second_tool(bench: Bench) -> None:
    """A program that knows no lock sends a packet of its own in the middle."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        with can.Bus(
            interface="udp_multicast", channel=GROUP, port=bench.port, hop_limit=0,
            ignore_config=True,
        ) as bus:  # fmt: skip
            bus.send(can.Message(arbitration_id=BMS.request_id, data=_PACKET, is_extended_id=False))
            assert bench.claims() == ["NO", "NO", "NOT KNOWN"], "not completed"
        assert "second tool" in bench.error(), "it is named"


def second_flasher(bench: Bench) -> None:
    """Another flasher wants the adapter in the middle: it is refused, and nothing is disturbed."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        other = subprocess.run(
            [*FLASHER, "flash", str(bench.folder / IMAGE), "-t", "bms", *bench.bus],
            capture_output=True, text=True, check=False, env=clean_environment(),
        )  # fmt: skip
        bench.say(f"the other: exit code {other.returncode}: {other.stderr.splitlines()[-4:][0]}")
        assert other.returncode == 4, "the other is refused"
        assert bench.claims() == ["YES"] * 3, "three times yes"


def closed(bench: Bench) -> None:
    """The page is closed in the middle, and opened again."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        address = bench.page.url
        bench.page.goto("about:blank")
        time.sleep(1)
        bench.page.goto(address)
        assert bench.claims() == ["YES"] * 3, "three times yes"


def ended(bench: Bench) -> None:
    """`flasher ui` is ended in the middle."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        assert bench.ui is not None
        bench.ui.send_signal(signal.SIGINT)
        expect(bench.page.locator("#ended")).to_be_visible(timeout=_WAIT_MS)
        bench.error()
        code = bench.ui.wait(30)
        bench.say(f"exit code {code}")
        assert code == 130, "it says that it was interrupted"


def pulled(bench: Bench) -> None:
    """The adapter is pulled out in the middle, and stays away."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        bench.pull()
        bench.claims()
        bench.error()
        expect(bench.page.locator("#do-rescue-it")).to_be_visible()


def plugged_again(bench: Bench) -> None:
    """The adapter is pulled out in the middle, and is back at once."""
    with bench.device():
        bench.begin()
        bench.go()
        bench.until_packet(PACKETS // 4)
        bench.pull()
        bench.plug()
        assert bench.claims() == ["YES"] * 3, "three times yes"
        stored = (bench.folder / "out.bin").read_bytes()
        assert stored == bench.image, "the device has the image byte for byte"


def absent(bench: Bench) -> None:
    """No device is there: the page reports it, and still explains a trace."""
    bench.page.click("#adapter-1:enabled")
    expect(bench.page.locator("#trouble .what")).to_be_visible(timeout=_WAIT_MS)
    bench.say(bench.page.locator("#trouble .what").inner_text())
    trace = {"name": "a.log", "mimeType": "", "buffer": b"(1.000000) can0 725#00\n"}
    bench.page.set_input_files("#file", trace)  # type: ignore[arg-type]
    expect(bench.page.locator("h1")).to_have_text("What a.log tells", timeout=_WAIT_MS)


CASES: Final[tuple[Callable[[Bench], None], ...]] = (
    whole, interrupted, refused, not_for_it, asking_tool, second_tool, second_flasher, closed,
    ended, absent, pulled, plugged_again,
)  # fmt: skip
_SERIAL: Final = (pulled, plugged_again)
"""Over an adapter in a process of its own."""


# -- around a case ---------------------------------------------------------------------------------


def _is_shown(bench: Bench, name: str) -> bool:
    return bench.page.locator(name).is_visible()


@contextmanager
def benched(browser: Browser, case: Callable[[Bench], None]) -> Iterator[Bench]:
    """The page on a bus of its own, while the block runs."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / IMAGE).write_bytes(image_of(PACKETS, NEW).data)
        context = browser.new_context(viewport={"width": 1280, "height": 800}, locale="en")
        stack.callback(context.close)
        bench = Bench(folder, free_port(), context.new_page(), stack)
        bench.start(*(bench.plug() if case in _SERIAL else bench.bus))
        yield bench


def run(browser: Browser, case: Callable[[Bench], None]) -> tuple[list[str], str]:
    """What the page showed in a case, and what was wrong; "" is nothing."""
    with benched(browser, case) as bench:
        try:
            case(bench)
        except Exception as error:  # noqa: BLE001  a page that never came too
            terminal = (bench.folder / "terminal.txt").read_text().strip()
            return bench.reported, re.sub(r"\s+", " ", f"{error} | {terminal}")[:600]
    return bench.reported, ""


def main() -> int:
    """Run the cases; returns how many do not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--case", action="append", help="only this one, by its name")
    options = parser.parse_args()
    bad = 0
    with chromium() as browser:
        for case in CASES:
            if options.case and case.__name__ not in options.case:
                continue
            began_at = time.perf_counter()
            reported, wrong = run(browser, case)
            took_s = time.perf_counter() - began_at
            bad += bool(wrong)
            verdict = f"DOES NOT HOLD: {wrong}" if wrong else "holds"
            sys.stdout.write(f"{case.__name__:<15} {took_s:5.1f} s  {verdict}\n")
            sys.stdout.writelines(f"    {each}\n" for each in reported)
            sys.stdout.flush()
    sys.stdout.write(f"{bad} do not hold\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
