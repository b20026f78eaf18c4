"""Terminal and pipe output: encoding, width, colours, columns; and yes/no questions."""

from __future__ import annotations

import codecs
import io
import os
import re
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, TextIO

from flasher.builds import SUFFIX, is_frozen, is_whole
from flasher.errors import ErrorCode, InterruptedByUserError, UsageError

_NO_WINDOW: Final = 10_000
"""Width without wrapping."""
COLOURS: Final = {"green": 32, "yellow": 33, "red": 31, "cyan": 36}
_SUBSTITUTES: Final = {"°": "deg", "…": "~"}
"""Replacements for characters that an encoding lacks."""
_SUBSTITUTED: Final = "flasher-substitutes"
_REPLACED_ERRORS: Final = frozenset({"strict", "backslashreplace", "surrogateescape"})
_COLOUR: Final = re.compile(r"\x1b\[[\d;]+m")
_PAINTED: Final = re.compile(r"(\x1b\[[\d;]+m)(.*?)(\x1b\[0m)(.*)")
"""Matches a line whose first words, or all, are coloured."""
_COMMAND: Final = re.compile(r"\s*flasher ")
"""Matches a command line, which is never wrapped, so that it can be copied."""
_ENDS_WITH_COMMAND: Final = re.compile(r"(.*[:|]) (flasher [a-z-]+ .*)")
_FROM_PATH: Final = "flasher"
_LABEL: Final = re.compile(r"\s*(?:\S+(?: \S+)*?\s{2,}|[A-Za-z][\w /-]{0,17}: +)?")
"""Matches the beginning of a line to whose width further lines are indented."""


def started_as() -> str:
    """Return the words that start this program again as it was started, quoted for a shell:
    "flasher", ".venv/bin/flasher", "python3 -m flasher", or a file that contains it whole.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    if spec is not None and spec.name == "flasher.__main__":
        return shlex.join([sys.orig_argv[0], "-m", "flasher"])
    typed = sys.argv[0] if sys.argv else ""
    path = Path(typed)
    if path.stem != "flasher" and not is_whole():
        return _FROM_PATH  # it is a part of another program
    if is_frozen() and os.sep not in typed:
        return shlex.quote(typed)  # as the shell found it
    on_path = shutil.which(_FROM_PATH)
    if on_path is not None and path.exists() and Path(on_path).samefile(path):
        return _FROM_PATH
    if path.suffix == SUFFIX and not os.access(path, os.X_OK):
        return shlex.join([sys.orig_argv[0], typed])
    return shlex.quote(typed if os.sep in typed else f".{os.sep}{typed}")


def prepare_streams() -> None:
    """Replace missing stdin, stdout or stderr (a service, pythonw): print() would otherwise mistake
    one for the other. Characters that an encoding lacks are replaced.
    """
    if sys.stdin is None:
        sys.stdin = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    codecs.register_error(_SUBSTITUTED, _substitute)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in _REPLACED_ERRORS:
            stream.reconfigure(errors=_SUBSTITUTED)


def _substitute(error: UnicodeError) -> tuple[str, int]:
    """Error handler for encoding: similar characters, else escapes."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    bad = error.object[error.start : error.end]
    escaped = (_SUBSTITUTES.get(each) or ascii(each)[1:-1] for each in bad)
    return "".join(escaped), error.end


def columns(rows: Iterable[Sequence[str]], *, indent: int = 0, first: int = 0) -> list[str]:
    """Format rows in columns, two blanks apart, as lines for stdout: a last cell too long for the
    window is wrapped in its column. `first` is the minimum width of the first column.
    """
    from rich.console import Console  # noqa: PLC0415  not every command has a table
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    table = Table.grid(padding=(0, 2))
    for row in rows:
        while len(table.columns) < len(row):
            table.add_column(no_wrap=True, min_width=0 if table.columns else first)
        table.add_row(*map(Text, row))
    if table.columns:
        table.columns[-1].no_wrap = False
    width = window_width(sys.stdout) or _NO_WINDOW
    console = Console(file=io.StringIO(), width=max(width - indent, 1), color_system=None)
    with console.capture() as captured:
        console.print(table, crop=False)
    return [" " * indent + line.rstrip() for line in captured.get().splitlines()]


def window_width(stream: TextIO) -> int | None:
    """Width of a stream's window in columns; None without one."""
    if not stream.isatty():
        return None
    try:
        return os.get_terminal_size(stream.fileno()).columns
    except OSError:
        return None


def takes_colour(stream: TextIO) -> bool:
    """True for a terminal that is not dumb, unless NO_COLOR is set."""
    return stream.isatty() and may_colour()


def may_colour() -> bool:
    """False if the environment asks for no colours: NO_COLOR, or TERM=dumb."""
    return not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def painted(text: str, colour: str) -> str:
    """Format text in a colour of `COLOURS`, bold."""
    return f"\x1b[1;{COLOURS[colour]}m{text}\x1b[0m"


def unpainted(text: str) -> str:
    """Remove colours, for a log."""
    return _COLOUR.sub("", text)


def wrapped(text: str, stream: TextIO) -> str:
    """Wrap text at the width of a terminal, never inside a word; unchanged elsewhere."""
    width = window_width(stream)
    if width is None:
        return text
    return "\n".join(part for line in text.split("\n") for part in wrap_line(line, width))


def wrap_line(line: str, width: int) -> list[str]:
    """Split a line into parts of at most `width` columns (a longer word stays whole), later ones
    indented to where the text of the first begins.
    """
    if len(line) <= width or width <= 0 or _COMMAND.match(line):
        return [line]
    if ends := _ENDS_WITH_COMMAND.fullmatch(line):
        return [*wrap_line(ends[1], width), f"    {ends[2]}"]
    if paint := _PAINTED.fullmatch(line):
        begin, word, end, rest = paint.groups()
        first, *others = wrap_line(word + rest, width)
        if rest:
            return [f"{begin}{word}{end}{first[len(word) :]}", *others]
        return [f"{begin}{part}{end}" for part in (first, *others)]
    label = _LABEL.match(line)
    indent = label.end() if label else 0
    if indent > width // 2:
        indent = len(line) - len(line.lstrip()) + 2
    return textwrap.wrap(
        line,
        width,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
        drop_whitespace=True,
    )


# -- a question before an irreversible action -----------------------------------------------------


def can_ask() -> bool:
    """True if a user can answer a question."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def check_can_ask(what: str, remedy: str = "Add --yes.") -> None:
    """Raise UsageError if no user can answer the question that `what` needs."""
    if not can_ask():
        why = f"{what}, and there is no terminal to ask."
        raise UsageError(why, remedy=remedy, code=ErrorCode.NOT_CONFIRMED)


def agrees(question: str, *, interrupted: str) -> bool:
    """Ask a yes-no question. Raises InterruptedByUserError for Ctrl-C."""
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt as interrupt:
        sys.stderr.write("\n")
        raise InterruptedByUserError(f"Interrupted at the question: {interrupted}") from interrupt
    return answer.strip().lower() in {"y", "yes"}
