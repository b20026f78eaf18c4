"""Help texts after the options: examples, exit codes, files and environment variables."""

from __future__ import annotations

import itertools
import platform
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import click
import rich_click

from flasher.cli.terminal import wrap_line
from flasher.errors import ExitCode

BRIEF: Final = "flasher.brief"
"""Key in `Context.meta`: True for the short help."""
STYLE: Final = {
    "theme": "default-slim",
    "max_width": 100,
    "text_markup": None,
    "commands_panel_title": "actions",
    "default_string": "(default {})",
    "required_long_string": "(required)",
}
"""Settings of rich-click."""
_WIDTH: Final = 100
"""Width of examples without a terminal."""
_EXAMPLE: Final = re.compile(r"(\s+flasher .*?\S) {3,}(\S.*)")
_MEANINGS: Final[Mapping[ExitCode, str]] = {
    ExitCode.OK: "done",
    ExitCode.INTERNAL: "a bug in flasher",
    ExitCode.USAGE: "wrong usage",
    ExitCode.IMAGE: "image rejected",
    ExitCode.BUS: "adapter or bus failure",
    ExitCode.NO_ANSWER: "no answer",
    ExitCode.WRONG_DEVICE: "wrong device",
    ExitCode.TRANSFER: "transfer failed",
    ExitCode.REFUSED: "refused by the device",
    ExitCode.UNCONFIRMED: "unconfirmed",
    ExitCode.VERIFICATION: "verification failed",
    ExitCode.NOTHING_TO_DO: "nothing to do",
    ExitCode.PARTIAL: "some failed",
    ExitCode.INTERRUPTED: "interrupted",
}
_ALWAYS: Final = (ExitCode.OK, ExitCode.INTERNAL, ExitCode.USAGE)
CAN_FILES: Final = {
    "Linux": ("~/.canrc", "~/.can", "/etc/can.conf", "~/can.conf"),
    "Darwin": ("~/.canrc", "~/.can", "/etc/can.conf", "~/can.conf"),
    "Windows": (r"%APPDATA%\can.ini", "can.ini", "~/can.conf"),
}
"""python-can's configuration files on each system; an earlier one takes precedence."""
_OWN_CAN_FILES: Final = CAN_FILES.get(platform.system(), ("~/can.conf",))


_READ_FOR: Final = {
    "--interface": f"""\
  CAN_INTERFACE, CAN_CHANNEL, ...    the adapter, where -i and -c do not name it
  {", ".join(_OWN_CAN_FILES)}
                                     the same in python-can's configuration; an earlier one first
  flasher.toml                       the same in its table [bus], where nothing above names it:
                                     of the working directory, else of the user's configuration
""",
    "--profile": """\
  flasher.toml                       target profile, where --profile names none: of the
                                     working directory, else of the user's configuration
""",
    "--bundle-dir": """\
  FLASHER_BUNDLE_DIR                 where bundles go, where --bundle-dir is not given
""",
    "--last": """\
  FLASHER_BUNDLE_DIR                 where bundles are looked for
""",
}
"""Environment variables and files, by the option that replaces them."""
_READ_ALWAYS: Final = """\
  NO_COLOR                           set to anything: no colours
"""


class HelpedCommand(rich_click.RichCommand):
    """Command with additional sections in its help; `-h` omits options that are not brief."""

    def __init__(self, *args: Any, exit_codes: Iterable[ExitCode] = (), **more: Any) -> None:
        """`exit_codes` are added to those of every command: done, wrong usage and a bug."""
        super().__init__(*args, **more)
        self.exit_codes = exit_codes

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters; in the short help only the most needed."""
        if ctx.meta.get(BRIEF):
            return [param for param in self.params if getattr(param, "brief", True)]
        return self.params

    def get_help_option(self, ctx: click.Context) -> None:
        """Return None: `flasher.cli.framework` adds the help options."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write examples; in the full help also exit codes, files and environment variables."""
        sections = [(self.epilog or "").strip("\n")]
        if ctx.meta.get(BRIEF):
            examples = sections[0].partition("\n\n")[0]
            sections = [examples, f"every option: {ctx.command_path} --help"]
        else:
            codes = sorted({*_ALWAYS, *self.exit_codes})
            # No blank inside, so that a meaning is not parted from its code.
            listed = (f"{int(code)} {_MEANINGS[code]}".replace(" ", "\xa0") for code in codes)
            given = {name for param in self.params for name in param.opts}
            read = "".join(text for name, text in _READ_FOR.items() if name in given)
            sections.append(f"exit codes:\n  {'   '.join(listed)}")
            sections.append(f"files and environment:\n{read}{_READ_ALWAYS}")
        from rich.text import Text  # noqa: PLC0415  for help only

        assert isinstance(formatter, rich_click.RichHelpFormatter)  # noqa: S101  its own class
        width = formatter.width if sys.stdout.isatty() else _WIDTH
        for section in filter(None, sections):
            lines = "\n".join(_wrapped(section, width)).replace("\xa0", " ")
            formatter.write(Text(f"{lines}\n"), soft_wrap=True)


def _wrapped(section: str, width: int) -> Iterator[str]:
    """Yield the lines of a section: indented ones unchanged if they fit, other text wrapped."""
    for is_prose, group in itertools.groupby(
        section.splitlines(), lambda line: bool(line[:1].strip())
    ):
        lines = list(group)
        if is_prose and max(map(len, lines)) > width:
            yield from textwrap.wrap(" ".join(lines), width)
            continue
        for before, line in itertools.pairwise(["", *lines]):
            example = _EXAMPLE.match(line)
            if before.endswith("\\"):  # a command line that goes on is copied as it is
                yield line
            elif len(line) > width and example:
                yield from (example[1], f"      {example[2]}")
            else:
                yield from wrap_line(line, width)
