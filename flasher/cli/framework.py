"""How commands are declared: `command`, `group`, `option`, `argument` and `option_set`.

    @command(exit_codes=(ExitCode.BUS,), epilog=EXAMPLES)
    @target_option()
    @option("--listen", type=seconds, default=1.0, metavar="S", help="...", brief=True)
    @bus_options
    def doctor(output: Output, target: Target, listen: float, bus: Bus) -> int:
        '''What the help says first.'''

rich-click parses, suggests, completes and lays out the help. `-h` shows the options that are marked
`brief` and the examples, `--help` shows everything.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import logging
import re
import shlex
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any, Final

import click
import rich_click
from click.core import ParameterSource

from flasher.cli.logs import LOG_FILE, Logs
from flasher.cli.output import SAID, Output
from flasher.cli.terminal import wrap_line
from flasher.cli.values import FilePath
from flasher.errors import ExitCode, UsageError, hide_passwords
from flasher.protocol.text import printable

_WIDTH: Final = 100
"""Columns that the text of help takes where there is no terminal."""
_LOG: Final = logging.getLogger("flasher.cli")
_BRIEF: Final = "flasher.brief"
_TYPED: Final = "flasher.typed"
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
_READS: Final[Mapping[str, tuple[tuple[str, str], ...]]] = {
    "--interface": (
        ("CAN_INTERFACE, CAN_CHANNEL, ...", "the adapter, where -i and -c do not name it"),
        ("can.conf, ~/.canrc, /etc/can.conf", "the same in python-can's configuration files"),
    ),
    "--profile": (
        ("flasher.toml", "target profile, where --profile names none: of the"),
        ("", "working directory, else of the user's configuration"),
    ),
    "--bundle-dir": (("FLASHER_BUNDLE_DIR", "where bundles go, where --bundle-dir is not given"),),
    "--last": (("FLASHER_BUNDLE_DIR", "where bundles are looked for"),),
}
"""Environment variables and files, by the option that stands for them."""
_READS_ALWAYS: Final = (("NO_COLOR", "set to anything: no colours"),)

Decorator = Callable[[Any], Any]


class Session:
    """One run of the program: what it says, and what the output options ask for."""

    def __init__(self, output: Output, logs: Logs, words: Sequence[str], version: str) -> None:
        self.output = output
        self.verbosity = 0
        self.log_file: str | None = None
        self.command_line = [hide_passwords(word) for word in words]
        """As typed, but for passwords."""
        self._logs = logs
        self.version = version

    def begin(self) -> None:
        """A command is going to run. Raises UsageError for output options that do not go
        together, and for a log file that cannot be written.
        """
        output = self.output
        output.verbosity = self.verbosity
        if output.events_wanted and not output.json_wanted:
            raise UsageError(
                "--events needs --json.", remedy="Events are lines of JSON: add --json."
            )
        self._logs.open(self.verbosity, self.log_file, typed_values(but="log_file"))
        told = printable(shlex.join(["flasher", *self.command_line]))
        _LOG.info("flasher %s: %s", self.version, told, extra=SAID)


# -- options and arguments ------------------------------------------------------------------------


class _Typed(rich_click.RichParameter):
    """A parameter that remembers its text as typed."""

    def consume_value(self, ctx: click.Context, opts: Mapping[str, Any]) -> tuple[Any, Any]:
        value, source = super().consume_value(ctx, opts)
        if source is ParameterSource.COMMANDLINE:
            ctx.meta.setdefault(_TYPED, {})[ctx.command_path, self.name] = value
        return value, source


class Option(_Typed, rich_click.RichOption):
    """An option; `brief` ones are in the short help too."""

    def __init__(self, *args: Any, brief: bool = False, **more: Any) -> None:
        more.setdefault("show_default", more.get("default") is not None)
        more.setdefault("panel", "options")
        super().__init__(*args, **more)
        self.brief = brief or self.required


class Argument(_Typed, rich_click.RichArgument):
    """A positional argument."""

    brief = True

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, panel="arguments", **more)


def option(*names: str, **more: Any) -> Decorator:
    """An option of a command; `panel` is its group in the help."""
    return click.option(*names, cls=Option, **more)


def argument(name: str, **more: Any) -> Decorator:
    """A positional argument of a command."""
    return click.argument(name, cls=Argument, **more)


def option_set(name: str, gather: Callable[..., object], *options: Decorator) -> Decorator:
    """Options that belong together: the command receives `gather(...)` of them as one argument.
    `gather` is a dataclass with a field for each option.
    """
    own = [each.name for each in fields(gather)]  # type: ignore[arg-type]

    def decorate(function: Callable[..., int]) -> Callable[..., int]:
        @functools.wraps(function)
        def gathered(*args: Any, **values: Any) -> int:
            mine = {key: values.pop(key) for key in own if key in values}
            return function(*args, **{name: gather(**mine)}, **values)

        for each in reversed(options):
            gathered = each(gathered)
        return gathered

    return decorate


def command_line() -> list[str]:
    """The words that the running command was called with, without passwords."""
    ctx = click.get_current_context(silent=True)
    return sys.argv[1:] if ctx is None else _session(ctx).command_line


def typed_values(*, but: str) -> list[str]:
    """The texts that the running command was called with, which may name files: all values `but`
    those of one option.
    """
    ctx = click.get_current_context(silent=True)
    found: list[str] = []
    for (path, name), value in ({} if ctx is None else ctx.meta.get(_TYPED, {})).items():
        if ctx is not None and path == ctx.command_path and name != but:
            found += [value] if isinstance(value, str) else []
            found += value if isinstance(value, tuple) else []
    return found


def retyped(
    ctx: click.Context,
    command: str,
    *,
    without: Callable[[str], bool] = lambda _option: False,
    replaced: Mapping[str, str] | None = None,
) -> list[str]:
    """The words that run `command` with what was typed for the command of `ctx`, passwords hidden.

    `without` tells which options are left out, by their long names; `replaced` has other values for
    arguments, by their names.
    """
    words = [*_typed_options(ctx.find_root(), without), command]
    typed = ctx.meta.get(_TYPED, {})
    positional: list[str] = []
    for param in ctx.command.params:
        key = (ctx.command_path, param.name)
        if isinstance(param, Argument) and key in typed:
            value = (replaced or {}).get(str(param.name), typed[key])
            positional += [value] if isinstance(value, str) else value
    own = list(_typed_options(ctx, without))
    if any(word.startswith("-") for word in positional):
        words += [*own, "--", *positional]
    else:
        words += [*positional, *own]
    return [hide_passwords(word) for word in words]


def _typed_options(ctx: click.Context, without: Callable[[str], bool]) -> Iterator[str]:
    typed = ctx.meta.get(_TYPED, {})
    for param in ctx.command.params:
        key = (ctx.command_path, param.name)
        if not isinstance(param, Option) or key not in typed or without(param.opts[-1]):
            continue
        for value in typed[key] if param.multiple else [typed[key]]:
            yield param.opts[0]
            if not param.is_flag:
                yield value


# -- the output options, which every command has ---------------------------------------------------


def _session(ctx: click.Context) -> Session:
    found = ctx.find_object(Session)
    if found is None:
        raise TypeError("a command runs with obj=Session(...)")
    return found


def _more_verbose(ctx: click.Context, _param: click.Parameter, given: Sequence[bool]) -> None:
    _session(ctx).verbosity += len(given)


def _less_verbose(ctx: click.Context, _param: click.Parameter, given: Sequence[bool]) -> None:
    _session(ctx).verbosity -= len(given)


def _want_json(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    _session(ctx).output.json_wanted |= value


def _want_events(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    _session(ctx).output.events_wanted |= value


def _want_log_file(ctx: click.Context, _param: click.Parameter, value: str | None) -> None:
    if value is not None:
        _session(ctx).log_file = value


def _show_help(ctx: click.Context, param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    if value and not ctx.resilient_parsing:
        ctx.meta[_BRIEF] = param.name == "brief_help"
        _session(ctx).output.print_help(ctx.get_help())
        ctx.exit()


def _show_version(ctx: click.Context, _param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    if value and not ctx.resilient_parsing:
        session = _session(ctx)
        session.output.print_help(f"flasher {session.version}")
        ctx.exit()


def _output_option(*names: str, callback: Callable[..., None], **more: Any) -> Option:
    return Option(names, callback=callback, expose_value=False, panel="output", **more)


def _output_options() -> list[click.Parameter]:
    return [
        _output_option(
            "-v", "--verbose", is_flag=True, multiple=True, callback=_more_verbose,
            help="say more, and show the log on stderr; twice for everything",
        ),
        _output_option(
            "-q", "--quiet", is_flag=True, multiple=True, callback=_less_verbose, help="say less"
        ),
        _output_option(
            "--json", is_flag=True, callback=_want_json, brief=True,
            help="print one JSON document (or JSON lines) on stdout",
        ),
        _output_option(
            "--events", is_flag=True, callback=_want_events,
            help="with --json: print each event as a line of JSON, before the document",
        ),
        _output_option(
            LOG_FILE, metavar="FILE", type=FilePath(), callback=_want_log_file,
            help="append everything to this log, with times, whatever -v and -q say",
        ),
        _output_option(
            "-h", "brief_help", is_flag=True, is_eager=True, callback=_show_help, brief=True,
            help="show what is needed most",
        ),
        _output_option(
            "--help", is_flag=True, is_eager=True, callback=_show_help, brief=True,
            help="show every option, the exit codes, and what is read besides",
        ),
    ]  # fmt: skip


# -- commands --------------------------------------------------------------------------------------


class _Helped(rich_click.RichCommand):
    """A command whose help has sections of ours, and whose long options may be abbreviated."""

    exit_codes: Iterable[ExitCode] = ()
    """What it can end with besides done, wrong usage and a bug."""

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        return super().make_context(*args, token_normalize_func=self._whole_name, **more)

    def _whole_name(self, token: str) -> str:
        """The long option that begins like this, if there is one alone."""
        names = [name.lstrip("-") for param in self.params for name in param.opts]
        matches = [name for name in names if name.startswith(token)]
        is_whole = len(token) == 1 or token in names
        return token if is_whole or len(matches) != 1 else matches[0]

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters; in the short help those that are needed most."""
        if ctx.meta.get(_BRIEF):
            return [param for param in self.params if getattr(param, "brief", True)]
        return self.params

    def get_help_option(self, ctx: click.Context) -> None:
        """None of click's: ours are among the output options."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Examples; in the whole help exit codes, files and environment too."""
        sections = [(self.epilog or "").strip("\n")]
        if ctx.meta.get(_BRIEF):
            sections.append(f"every option: {ctx.command_path} --help")
        else:
            sections += [_exit_codes_section(self.exit_codes), self._reads_section()]
        from rich.text import Text  # noqa: PLC0415  for help only

        for section in filter(None, sections):
            width = formatter.width if sys.stdout.isatty() else _WIDTH
            lines = _laid_out(section, width)
            assert isinstance(formatter, rich_click.RichHelpFormatter)  # noqa: S101  whose else
            formatter.write(Text("\n".join(lines) + "\n"), soft_wrap=True)

    def _reads_section(self) -> str:
        """What a command with these options reads besides its command line."""
        given = {name for param in self.params for name in param.opts}
        rows = [row for name, rows in _READS.items() if name in given for row in rows]
        rows += _READS_ALWAYS
        width = max(len(name) for name, _ in rows)
        lines = [f"  {name:<{width}}  {meaning}" for name, meaning in rows]
        return "\n".join(["files and environment:", *lines])


class Command(_Helped):
    """A command that runs: its function takes the output and returns the exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        session = _session(ctx)
        session.begin()
        assert self.callback is not None  # noqa: S101  a command without a function is no command
        return ctx.invoke(self.callback, session.output, **ctx.params)


class Group(_Helped, rich_click.RichGroup):  # type: ignore[misc]  # rich-click's own bases
    """A command that has actions (`flasher profile show`)."""

    def action(
        self, name: str, *, epilog: str = "", exit_codes: Iterable[ExitCode] | None = None
    ) -> Callable[[Callable[..., int]], Command]:
        """Make an action of a function; its exit codes are the group's where none are given."""

        def make(function: Callable[..., int]) -> Command:
            made = command(
                epilog=epilog, exit_codes=self.exit_codes if exit_codes is None else exit_codes
            )(function)
            made.name = name
            self.add_command(made)
            return made

        return make


@dataclass(frozen=True)
class Entry:
    """A command of the program: where it is, and its line in the list of commands."""

    place: str
    """Module below flasher.cli, and the name in it: "upgrade.flash:rescue"."""
    summary: str

    def module(self) -> ModuleType:
        """Import the module that it is in."""
        return importlib.import_module(f"flasher.cli.{self.place.partition(':')[0]}")

    def load(self) -> click.Command:
        """Import the command."""
        found: click.Command = getattr(self.module(), self.place.partition(":")[2])
        return found


class Program(_Helped, rich_click.RichGroup):  # type: ignore[misc]  # rich-click's own bases
    """The program. A command is imported when it is called, or its help is asked for."""

    exit_codes = ExitCode

    def __init__(self, *args: Any, entries: Mapping[str, Mapping[str, Entry]], **more: Any) -> None:
        """`entries` are the commands, by what they are for and by their names."""
        super().__init__(*args, **more)
        self.entries = {name: each for group in entries.values() for name, each in group.items()}
        for purpose, group in entries.items():
            self.add_panel(rich_click.RichCommandPanel(purpose, commands=list(group)))
        for name, each in self.entries.items():
            self.add_command(rich_click.RichCommand(name=name, help=each.summary))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, found, rest = super().resolve_command(ctx, args)
        if name is None or found is None:
            return name, found, rest
        if (session := ctx.find_object(Session)) is not None:
            session.output.command = name
        return name, self.entries[name].load(), rest


def program(
    *, entries: Mapping[str, Mapping[str, Entry]], epilog: str
) -> Callable[[Callable[..., int]], Program]:
    """Make the program of a function, which runs where no command is named."""

    def make(function: Callable[..., int]) -> Program:
        made = click.group(
            cls=Program,
            entries=entries,
            epilog=epilog,
            invoke_without_command=True,
            subcommand_metavar="COMMAND ...",
        )(click.pass_context(function))
        made.params += [
            *_output_options(),
            _output_option(
                "--version", is_flag=True, is_eager=True, callback=_show_version,
                help="show the version",
            ),
        ]  # fmt: skip
        return made

    return make


def command(
    *, epilog: str = "", exit_codes: Iterable[ExitCode] = ()
) -> Callable[[Callable[..., int]], Command]:
    """Make a command of a function, whose docstring is the beginning of the help."""

    def make(function: Callable[..., int]) -> Command:
        made = click.command(cls=Command, epilog=epilog)(function)
        made.params.sort(key=lambda param: not isinstance(param, Argument))
        made.params += _output_options()
        made.exit_codes = exit_codes
        return made

    return make


def group(
    *, epilog: str = "", exit_codes: Iterable[ExitCode] = (), runs_alone: bool = False
) -> Callable[[Callable[..., Any]], Group]:
    """Make a command that has actions of a function, whose docstring is the beginning of the help.
    With `runs_alone` the function is the command's own where no action is named.
    """

    def make(function: Callable[..., Any]) -> Group:
        @functools.wraps(function)
        @click.pass_context
        def run(ctx: click.Context, /, **options: Any) -> Any:
            if ctx.invoked_subcommand is None:
                session = _session(ctx)
                session.begin()
                return function(session.output, **options)
            return None

        made = click.group(
            cls=Group,
            epilog=epilog,
            no_args_is_help=False,
            invoke_without_command=runs_alone,
            subcommand_metavar="[ACTION ...]" if runs_alone else "ACTION ...",
        )(run)
        made.params += _output_options()
        made.exit_codes = exit_codes
        return made

    return make


def usage_error(wrong: click.UsageError, command: str | None) -> UsageError:
    """What click says of the command line of `command`, as all other errors are reported."""
    ctx = wrong.ctx
    program = ctx.command_path if ctx else " ".join(filter(None, ("flasher", command)))
    close = getattr(wrong, "possibilities", None)
    said = wrong.message if close else wrong.format_message()
    remedy = f"Did you mean {close[0]}? " if close else ""
    if ctx is not None and "extra argument" in said:
        typed = ctx.meta.get(_TYPED, {})
        remedy += "".join(
            f"{param.opts[-1]} takes one value, and may be repeated. "
            for param in ctx.command.params
            if getattr(param, "multiple", False) and (ctx.command_path, param.name) in typed
        )
    return UsageError(f"{program}: {said.rstrip('.')}.", remedy=f"{remedy}Try `{program} --help`.")


def _exit_codes_section(codes: Iterable[ExitCode]) -> str:
    told = sorted({*_ALWAYS, *codes})
    # No blank inside, so that a meaning is not parted from its code.
    words = "   ".join(f"{int(code)} {_MEANINGS[code]}".replace(" ", "\xa0") for code in told)
    return f"exit codes:\n  {words}"


def _laid_out(section: str, width: int) -> Iterator[str]:
    """The lines of a section: indented ones stay as they are where they fit, prose is filled."""
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
                yield from (part.replace("\xa0", " ") for part in wrap_line(line, width))
