"""The picture of a terminal in the README, drawn from a real run.

    python -m tests.terminal_picture

runs it and draws docs/pictures/flash.svg anew.
"""

from __future__ import annotations

import os
import pty
import re
import shlex
import sys
from io import StringIO
from pathlib import Path
from typing import Final

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

_ROOT: Final = Path(__file__).parents[1]
PICTURE: Final = _ROOT / "docs" / "pictures" / "flash.svg"
COMMAND: Final = "flasher flash firmware_samples/bms.hex -t bms --mock"
_COLUMNS: Final = 100
_FONT: Final = re.compile(r"@font-face \{\{.*?\}\}\s*", re.DOTALL)
"""It would be loaded from another computer."""


def run() -> str:
    """What a person sees at the end: every line as it was drawn last."""
    # A size and colours as a terminal has them.
    environment = {
        "COLUMNS": str(_COLUMNS), "LINES": "40", "TERM": "xterm-256color",
        "FLASHER_BUNDLE_DIR": os.devnull, "XDG_DATA_HOME": "/nonexistent",
    }  # fmt: skip
    os.environ.update(environment)
    os.environ.pop("NO_COLOR", None)
    os.chdir(_ROOT)
    got = bytearray()

    def read(descriptor: int) -> bytes:
        data = os.read(descriptor, 4096)
        got.extend(data)
        return data

    words = shlex.split(COMMAND)[1:]
    status = pty.spawn([sys.executable, "-m", "flasher", *words], read)
    if status:
        raise SystemExit(f"{COMMAND}: it ended with {os.waitstatus_to_exitcode(status)}")
    text = got.decode().replace("\r\n", "\n")
    text = re.sub(r"\x1b\[[0-9;]*[A-HJKf]|\x1b\[\?\d+[hl]", "", text)
    lines = (line.rstrip("\r").rpartition("\r")[2] for line in text.split("\n"))
    return "\n".join(line for line in lines if line.strip())


def draw(shown: str) -> str:
    """A drawing that needs nothing else, on a dark window that is readable on any page."""
    console = Console(record=True, width=_COLUMNS, file=StringIO(), force_terminal=True)
    console.print(Text.assemble(("$ ", "bold green"), COMMAND))
    console.print(Text.from_ansi(shown.rstrip()))
    form = _FONT.sub("", CONSOLE_SVG_FORMAT)
    return console.export_svg(title="flasher", code_format=form, unique_id="flash")


if __name__ == "__main__":
    PICTURE.write_text(draw(run()), encoding="utf-8")
