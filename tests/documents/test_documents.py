"""What the documents tell a reader to do, works (see the package)."""

from __future__ import annotations

import html
import re
from pathlib import Path

import pytest

from flasher.bus.detect import DetectionResult
from flasher.bus.link import VirtualClock
from tests.documents.blocks import LANGUAGES, ROOT, Block, blocks, pages
from tests.documents.reader import PageReader, hold_options, is_printed
from tests.terminal_picture import COMMAND, PICTURE

pytestmark = pytest.mark.slow

FOLLOWED = {
    path.relative_to(ROOT).as_posix(): found
    for path in pages()
    if (found := list(blocks(path.read_text(encoding="utf-8"))))
}

SIZE = re.compile(rf"\b{(ROOT / 'firmware_samples' / 'bms.bin').stat().st_size}\b")
"""Of the sample, as a page shows it that needs the whole of it."""


def follow(found: list[Block], folder: Path, *, patient: bool) -> None:
    """Do what a page says. Nothing waits for the device model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flasher.bus.link.SteadyClock", lambda _speed: VirtualClock())
        patch.setattr("flasher.cli.adapters.detect_adapters", lambda **_: DetectionResult())
        patch.setattr("can.util.load_file_config", lambda *_args: {})
        patch.setattr("can.util.load_environment_config", lambda *_args: {})
        # What it leaves for later pages it would find there.
        for name in (
            "XDG_CONFIG_HOME",
            "XDG_DATA_HOME",
            "XDG_STATE_HOME",
            "FLASHER_BUNDLE_DIR",
        ):
            patch.setenv(name, str(folder / name.lower()))
        patch.setenv("KEY_WORDS", "the passphrase that pages name")
        shown = any(
            block.language == "console" and SIZE.search(block.text.replace(",", ""))
            for block in found
        )
        reader = PageReader(folder, patient=patient, shows_samples=shown)
        for block in found:
            try:
                reader.follow(block)
            except BaseException as error:
                error.add_note(f"in the block of line {block.line}")
                raise


@pytest.mark.parametrize("page", FOLLOWED)
def test_what_a_page_names_works(page: str, tmp_path: Path) -> None:
    follow(FOLLOWED[page], tmp_path, patient=False)


def test_the_picture_in_the_readme_is_of_this_program(tmp_path: Path) -> None:
    drawn = re.findall(r"<text[^>]*>(.*?)</text>", PICTURE.read_text(encoding="utf-8"))
    shown = " ".join(" ".join(map(html.unescape, drawn)).split())
    text = f"```console\n{shown[shown.index('$') :]}\n```\n".replace(COMMAND, f"{COMMAND}\n")
    follow(list(blocks(text)), tmp_path, patient=False)


def test_a_wrong_option_a_wrong_output_and_a_wrong_code_are_found(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="--verifi"):
        hold_options("flasher flash bms.hex -t bms --verifi memory")
    shown = (
        "```console\n$ flasher read serial-number -t bms --mock\n  serial number  W2605009\n```\n"
    )
    ends = "```sh\nflasher image-info absent.hex\n```\n"
    for number, text in enumerate((shown, ends)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with pytest.raises(AssertionError, match=r"W2605001|exit code 2"):
            follow(list(blocks(text)), folder, patient=False)


def test_dots_stand_for_anything_and_times_are_not_compared() -> None:
    assert is_printed("a\n...\nc 1.5 s", "a\nb\nb\nc  22 s\n")
    assert not is_printed("a\n...\nc 15 packets", "a\nb\nc 16 packets\n")


def test_a_block_has_the_marks_above_it() -> None:
    text = "words\n\n<!-- in: there -->\n<!-- not run: why -->\n```sh\nx\n```\n```c\ny\n```\n"
    (block,) = blocks(text)
    assert (block.marks, block.line) == ({"in": "there", "not run": "why"}, 5)
    assert block.language in LANGUAGES
