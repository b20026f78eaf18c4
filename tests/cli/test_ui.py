"""`flasher ui` as a whole: its address, an upgrade by its page's means, and how it ends."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import webbrowser
from collections.abc import Callable, Iterator
from http.cookiejar import CookieJar
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import HTTPCookieProcessor, Request, build_opener

import pytest

from flasher.errors import ExitCode
from flasher.web.virtual_bike import BikeFault
from tests.cli.conftest import Flasher
from tests.end_to_end.stage import image_of
from tests.web.bench_place import IMAGE, folder_of_images

pytest.importorskip("uvicorn")


class _Browser:
    """What a browser does with the page."""

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        self._root = f"{parts.scheme}://{parts.netloc}"
        self._opener = build_opener(HTTPCookieProcessor(CookieJar()))
        self._opener.open(address).read()
        page = self._opener.open(f"{self._root}/").read().decode()
        found = re.search(r'name="flasher-token" content="([^"]+)"', page)
        assert found
        self._token = found[1]
        self._parts: dict[str, str] = {}
        self._states = self._follow()

    def _follow(self) -> Iterator[None]:
        with self._opener.open(f"{self._root}/bench/events") as stream:
            for line in stream:
                if line.startswith(b"data:"):
                    message = json.loads(line[5:])
                    self._shown_at = message["at"]
                    self._parts |= message.get("parts", {})
                    yield

    def until(self, part: str, text: str) -> None:
        """Waits for the page to show a text, and for its buttons to be free."""
        while text not in self._parts.get(part, "") or "disabled" in self._parts[part]:
            next(self._states)

    def order(self, word: str, **fields: str) -> None:
        body = json.dumps({"order": word, "shown_at": self._shown_at, **fields}).encode()
        headers = {"origin": self._root, "x-flasher-token": self._token}
        order = Request(f"{self._root}/bench/order", body, headers)  # noqa: S310  our own
        self._opener.open(order).read()

    def begin(self) -> None:
        self.until("adapter", "adapter-1")
        self.order("adapter", name=BikeFault.NONE.value)
        self.until("bike", "target-bms")
        self.order("target", name="bms")
        self.until("image", "image-1")
        self.order("image", name=IMAGE)
        self.until("start", "selection")
        found = re.search(r'name="selection" value="([0-9a-f]+)"', self._parts["start"])
        assert found
        self.order("upgrade", selection=found[1])


def _in_browser(monkeypatch: pytest.MonkeyPatch, do: Callable[[_Browser], None]) -> None:
    """Let the browser that is opened do this, then press Ctrl-C."""

    def run(address: str) -> None:
        try:
            do(_Browser(address))
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    def opened(address: str) -> bool:
        threading.Thread(target=run, args=(address,)).start()
        return True

    monkeypatch.setattr(webbrowser, "open", opened)


@pytest.mark.slow
def test_an_upgrade_that_went_through_ends_well(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def do(browser: _Browser) -> None:
        browser.begin()
        browser.until("result", "next-bike")

    _in_browser(monkeypatch, do)
    folder = folder_of_images(tmp_path)
    run = flasher("ui", "--mock", "--mock-speed", "0", "--images", folder, "--json")
    assert run.code == ExitCode.OK
    line, document = map(json.loads, run.out.splitlines())
    assert line["event"] == "serving"
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/enter\?key=\S{40,}", document["address"])


@pytest.mark.slow
def test_ctrl_c_in_an_upgrade_states_what_is_left(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def do(browser: _Browser) -> None:
        browser.begin()
        browser.until("pace", "of 300 packets, ")  # more than a second is left

    _in_browser(monkeypatch, do)
    (tmp_path / IMAGE).write_bytes(image_of(300).data)
    run = flasher("ui", "--mock", "--mock-speed", "2", "--images", tmp_path)
    assert run.code == ExitCode.INTERRUPTED
    assert "its application is erased, half written or not accepted" in run.err
    assert "bundle:" in run.err


@pytest.mark.parametrize("name", ["missing", "file"])
def test_a_folder_of_images_that_is_none_is_refused_at_once(
    flasher: Flasher, tmp_path: Path, name: str
) -> None:
    (tmp_path / "file").write_text("")
    run = flasher("ui", "--mock", "--no-browser", "--images", tmp_path / name)
    assert run.code == ExitCode.USAGE
    assert "is not a folder of this computer" in run.err
