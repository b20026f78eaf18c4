"""Somebody who does what a page says, in a folder of their own."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any, Final

import click
import pytest

from flasher.cli.main import COMMANDS, main
from flasher.settings import bus
from flasher.settings.toml_reader import Reader
from flasher.station import config, recipe
from tests.documents.blocks import ROOT, Block
from tests.firmware import shorten

KINDS: Final[Mapping[str, Reader[Any]]] = {
    "bus": bus.READER,
    "recipe": recipe.RECIPE,
    "station": config.CONFIG,
}
"""Files of settings that a page shows a part of."""
_ADAPTER: Final = re.compile(r" (?:-i|-c|--bus-kwargs) \S+")
_PROGRAMS: Final = Path(sys.executable).parent
_SILENT: Final = " 2>/dev/null"
_TIMES: Final = re.compile(
    r"\d+(?:\.\d+)?(?= (?:s|ms|kB/s)\b)|\d+ ?%|^ +\d+\.\d{3}(?=  )|"
    r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:[+-]\d\d:\d\d)?",
    re.MULTILINE,
)


class PageReader:
    """Runs the blocks of a page in their order; AssertionError where the page is wrong."""

    def __init__(self, folder: Path, *, patient: bool, shows_samples: bool = True) -> None:
        """`patient` runs what is slow, too. A page that does not show the size of the sample of the
        BMS is followed with a short one, unless one is patient.
        """
        self._folder = folder
        self._patient = patient
        self._code = 0
        self._adapter = False
        """One is named by the environment."""
        self._names: dict[str, Any] = {"__name__": "page"}
        samples = folder / "firmware_samples"
        if patient or shows_samples:
            samples.symlink_to(ROOT / "firmware_samples")
        else:
            shutil.copytree(ROOT / "firmware_samples", samples, ignore=_links)
            shorten(ROOT / "firmware_samples" / "bms", samples / "bms")
        (folder / "examples").symlink_to(ROOT / "examples")
        # What a page with a real adapter says in the place of the image that a reader has.
        shutil.copy(samples / "bms.hex", folder / "YOUR_IMAGE.hex")

    def follow(self, block: Block) -> None:
        """Do what it says."""
        marks = block.marks
        if folder := marks.get("in"):
            shutil.copytree(ROOT / folder, self._folder, dirs_exist_ok=True, ignore=_links)
        if name := marks.get("file"):
            (self._folder / name).write_text(block.text, encoding="utf-8")
        elif kind := marks.get("part of"):
            document = tomllib.loads(block.text)
            _, faults = KINDS[kind].check(document.get(kind, document), is_whole=False)
            assert not faults, faults
        elif "not run" in marks or ("slow" in marks and not self._patient):
            for line in commands(block):
                hold_options(line)
        elif block.language == "python":
            with chdir(self._folder), redirect_stdout(_stream()):
                exec(compile(block.text, f"line {block.line}", "exec"), self._names)  # noqa: S102
        else:
            assert block.language != "toml", "say which file it is"
            self._follow_commands(block)

    def _follow_commands(self, block: Block) -> None:
        steps = list(_steps(block))
        for number, (line, expected) in enumerate(steps):
            output = self._run(line)
            is_asked = number + 1 < len(steps) and steps[number + 1][0] == "echo $?"
            is_last = number + 1 == len(steps)
            code = int(block.marks.get("ends with", 0)) if is_last else 0
            if line != "echo $?" and not is_asked:
                assert self._code == code, f"{line}: exit code {self._code}\n{output[-2000:]}"
            if block.language == "console":
                assert is_printed(expected, output), (
                    f"{line}\n\n{expected}\nis not\n\n{output[-4000:]}"
                )

    def _run(self, line: str) -> str:
        """Run a line; returns what a terminal would show."""
        first, _, rest = line.partition(" ")
        if line == "echo $?":
            return f"{self._code}\n"
        if first == "cd":
            self._folder = (self._folder / rest).resolve()
            return ""
        if first == "export":
            self._adapter = self._adapter or "CAN_INTERFACE=" in rest
            return ""
        if first != "flasher":
            return self._shell(line, "")
        line, _, behind = line.partition(" | ")
        line, _, target = line.partition(" > ")
        is_whole = not (behind or target or line.endswith(_SILENT))
        printed = self._flasher(line.removesuffix(_SILENT), is_whole=is_whole)
        if target:
            (self._folder / target).write_text(printed, encoding="utf-8")
            return ""
        return self._shell(behind, printed) if behind else printed

    def _shell(self, line: str, given: str) -> str:
        ended = subprocess.run(
            ["bash", "-c", line], input=given, cwd=self._folder, capture_output=True, text=True,
            check=False, env=os.environ | {"PATH": f"{_PROGRAMS}:{os.environ['PATH']}"},
        )  # fmt: skip
        self._code = ended.returncode
        return ended.stdout + ended.stderr

    def _flasher(self, line: str, *, is_whole: bool) -> str:
        """Run the program in this process; returns its standard output, or, as a whole, what a
        terminal shows.
        """
        words = shlex.split(_ADAPTER.sub("", line), comments=True)[1:]
        if (self._adapter or _ADAPTER.search(line)) and has_option(words, "--mock"):
            words += ["--mock"]
        out = _stream()
        err = out if is_whole else _stream()
        with chdir(self._folder), redirect_stdout(out), redirect_stderr(err):
            self._code = main(words)
        return _text(out)


def _stream() -> TextIOWrapper:
    return TextIOWrapper(BytesIO(), encoding="utf-8", write_through=True)


def _text(stream: TextIOWrapper) -> str:
    assert isinstance(stream.buffer, BytesIO)
    return stream.buffer.getvalue().decode()


def _links(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if name == "bad" or Path(folder, name).is_symlink()]


# -- what a block says -----------------------------------------------------------------------------


def _steps(block: Block) -> Iterator[tuple[str, str]]:
    """Each command with the output that the page shows."""
    if block.language == "console":
        for step in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
            line, _, expected = step.partition("\n")
            yield line, expected
        return
    for line in block.text.replace("\\\n", " ").splitlines():
        if line.strip():
            yield line.strip(), ""


def commands(block: Block) -> list[str]:
    """The calls of the program in a block."""
    if block.language not in ("sh", "console"):
        return []
    parts = (part.strip() for line, _ in _steps(block) for part in re.split(r" && | \| | > ", line))
    return [part for part in parts if part.startswith("flasher ")]


def hold_options(line: str) -> None:
    """Fails for a command or an option that there is not. Nothing is run."""
    reported = _stream()
    with (
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(reported),
        redirect_stderr(reported),
    ):
        patch.setattr(click.Context, "invoke", lambda *_words, **_options: 0)
        assert main(shlex.split(line, comments=True)[1:]) == 0, _text(reported)


def has_option(words: list[str], name: str) -> bool:
    """Whether the command that these words call has an option."""
    command: click.Command | None = None
    for word in words:
        if command is None:
            command = COMMANDS[word].load() if word in COMMANDS else None
        elif isinstance(command, click.Group) and word in command.commands:
            command = command.commands[word]
    return command is not None and any(name in param.opts for param in command.params)


def is_printed(expected: str, output: str) -> bool:
    """Whether an output is what the page shows: `...` is anything, times are not compared."""
    parts = [re.escape(part) for part in re.split(r" ?\.\.\. ?", _plain(expected))]
    return re.fullmatch(".*".join(parts), _plain(output), re.DOTALL) is not None


def _plain(text: str) -> str:
    """Without times, and with one blank for many."""
    return re.sub(r"[ \n]+", " ", _TIMES.sub("#", text)).strip()
