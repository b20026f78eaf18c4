"""Command framework on click: `command`, `group`, `option`, `argument` and `option_set`.

    @command(exit_codes=(ExitCode.BUS,), epilog=EXAMPLES)
    @option("--listen", type=seconds, default=1.0, metavar="S", help="...", brief=True)
    @bus_options()
    def doctor(output: Output, bus: Bus, *, listen: float) -> int:
        '''What the help says first.'''

rich-click parses, suggests, completes and lays out the help. `-h` shows the options that are marked
`brief` and the examples, `--help` shows everything.
"""

from __future__ import annotations

import functools
import importlib
import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from types import ModuleType
from typing import Any, Final, get_type_hints

import click
import rich_click
from click.core import ParameterSource

from flasher import __version__
from flasher.cli.help import BRIEF, HelpedCommand
from flasher.cli.logs import LOG_FILE, Logs
from flasher.cli.output import PRINTED, Output
from flasher.cli.values import FilePath
from flasher.errors import ExitCode, UsageError, without_password
from flasher.protocol.text import printable

_LOG: Final = logging.getLogger("flasher.cli")
_TYPED: Final = "flasher.typed"

Decorator = Callable[[Any], Any]


class Session:
    """Run of the program, with its output options."""

    def __init__(self, output: Output, logs: Logs, words: Sequence[str]) -> None:
        self.output = output
        self.command_line = [without_password(word) for word in words]
        """Arguments as typed, without passwords."""
        self._logs = logs
        self._verbose = self._quiet = 0
        self._log_file: str | None = None

    def take(self, name: str, value: Any) -> None:
        """Set an output option, given before or after the command."""
        match name:
            case "verbose":
                self._verbose += len(value)
            case "quiet":
                self._quiet += len(value)
            case "json":
                self.output.json_wanted = True
            case "events":
                self.output.events_wanted = True
            case "log_file":
                self._log_file = value

    def begin(self) -> None:
        """Start a command. Raises UsageError for output options that exclude each other, and for a
        log file that cannot be written.
        """
        output = self.output
        verbosity = output.verbosity = self._verbose - self._quiet
        if self._verbose and self._quiet:
            raise UsageError("-v and -q contradict each other.", remedy="Leave one of them out.")
        if output.events_wanted and not output.json_wanted:
            raise UsageError(
                "--events needs --json.", remedy="Events are lines of JSON: add --json."
            )
        self._logs.open(verbosity, self._log_file, typed_values(but="log_file"))
        shown = printable(shlex.join(["flasher", *self.command_line]))
        _LOG.info("flasher %s: %s", __version__, shown, extra=PRINTED)


def _session(ctx: click.Context) -> Session:
    found = ctx.find_object(Session)
    if found is None:
        raise TypeError("a command runs with obj=Session(...)")
    return found


# -- options and arguments ------------------------------------------------------------------------


class _Parameter(rich_click.RichParameter):
    """Parameter that records its text as typed."""

    def consume_value(self, ctx: click.Context, opts: Mapping[str, Any]) -> tuple[Any, Any]:
        value, source = super().consume_value(ctx, opts)
        if source is ParameterSource.COMMANDLINE:
            retype(ctx, str(self.name), value)
        return value, source


class Option(_Parameter, rich_click.RichOption):
    """Command-line option; `brief` ones also appear in the short help."""

    def __init__(self, *args: Any, brief: bool = False, **more: Any) -> None:
        more.setdefault("show_default", more.get("default") is not None)
        more.setdefault("panel", "options")
        super().__init__(*args, **more)
        self.brief = brief or self.required

    def get_error_hint(self, ctx: click.Context | None) -> str:
        """Return the option as users type it."""
        return "/".join(self.opts)


class Argument(_Parameter, rich_click.RichArgument):
    """Positional argument."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, panel="arguments", **more)


def option(*names: str, **more: Any) -> Decorator:
    """Declare an option of a command; `panel` is its group in the help."""
    return click.option(*names, cls=Option, **more)


def argument(name: str, **more: Any) -> Decorator:
    """Declare a positional argument of a command."""
    return click.argument(name, cls=Argument, **more)


def option_set(name: str, gather: type[Any], *options: Decorator) -> Decorator:
    """Declare related options: the command receives `gather(...)` of them as one argument.

    `gather` is a dataclass with a field for each of `options`, and for each option in an
    annotation: `limit: Annotated[int, option("--limit", ...)]`.
    """
    own = [each.name for each in fields(gather)]
    hints = get_type_hints(gather, include_extras=True)
    options += tuple(each for key in own for each in getattr(hints[key], "__metadata__", ()))

    def decorate(function: Callable[..., int]) -> Callable[..., int]:
        @functools.wraps(function)
        def gathered(*args: Any, **values: Any) -> int:
            mine = {key: values.pop(key) for key in own if key in values}
            return function(*args, **{name: gather(**mine)}, **values)

        for each in reversed(options):
            gathered = each(gathered)
        return gathered

    return decorate


# -- the typed command line ------------------------------------------------------------------------


def command_line() -> list[str]:
    """Return the arguments of the running command, without passwords."""
    ctx = click.get_current_context(silent=True)
    return sys.argv[1:] if ctx is None else _session(ctx).command_line


def typed_values(*, but: str) -> list[str]:
    """Return the typed values of the running command, which may name files, except those of the
    option `but`.
    """
    ctx = click.get_current_context(silent=True)
    found: list[str] = []
    for name, value in ({} if ctx is None else _typed(ctx)).items():
        if name != but:
            found += [value] if isinstance(value, str) else []
            found += value if isinstance(value, tuple) else []
    return found


def rebuild_command_line(
    ctx: click.Context,
    command: str,
    *,
    without: Callable[[str], bool] = lambda _option: False,
    replaced: Mapping[str, str | list[str]] | None = None,
) -> list[str]:
    """Build a command line that runs `command` with the arguments of the command of `ctx`,
    passwords hidden.

    `without` selects options to omit, by their long names; `replaced` maps names of arguments to
    other values.
    """
    typed = {**_typed(ctx), **(replaced or {})}
    positional: list[str] = []
    for param in ctx.command.params:
        if isinstance(param, Argument) and param.name in typed:
            value = typed[param.name]
            positional += [value] if isinstance(value, str) else value
    words = [*_typed_options(ctx.find_root(), without), command]
    own = list(_typed_options(ctx, without))
    if any(word.startswith("-") for word in positional):
        words += [*own, "--", *positional]
    else:
        words += [*positional, *own]
    return [without_password(word) for word in words]


def _typed(ctx: click.Context) -> dict[str, Any]:
    """Return the values as typed, by the names of the parameters."""
    found: dict[str, Any] = ctx.meta.get(_TYPED, {}).get(ctx.command_path, {})
    return found


def retype(ctx: click.Context, name: str, value: str) -> None:
    """Have command lines that are built from now on give a parameter this value."""
    ctx.meta.setdefault(_TYPED, {}).setdefault(ctx.command_path, {})[name] = value


def _typed_options(ctx: click.Context, without: Callable[[str], bool]) -> Iterator[str]:
    typed = _typed(ctx)
    for param in ctx.command.params:
        if not isinstance(param, Option) or param.name not in typed or without(param.opts[-1]):
            continue
        for value in typed[param.name] if param.multiple else [typed[param.name]]:
            yield param.opts[0]
            if not param.is_flag:
                yield value


def missing_option(name: str) -> click.MissingParameter:
    """Create the error for an option that the running command needs with these others."""
    ctx = click.get_current_context()
    param = next(each for each in ctx.command.params if each.name == name)
    return click.MissingParameter(ctx=ctx, param=param)


# -- commands --------------------------------------------------------------------------------------


def _take(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    if value:
        _session(ctx).take(str(param.name), value)


def _show(ctx: click.Context, param: click.Parameter, value: bool) -> None:  # noqa: FBT001
    """Show help or version, and end."""
    if not value or ctx.resilient_parsing:
        return
    ctx.meta[BRIEF] = param.name == "brief_help"
    is_version = param.name == "version"
    output = _session(ctx).output
    output.print_help(f"flasher {__version__}" if is_version else ctx.get_help())
    ctx.exit()


def _output_option(*names: str, callback: Callable[..., None] = _take, **more: Any) -> Option:
    return Option(
        names, is_flag="metavar" not in more, callback=callback, expose_value=False,
        panel="output", **more,
    )  # fmt: skip


def _output_options() -> list[click.Parameter]:
    """Create the options that every command has."""
    return [
        _output_option(
            "-v", "--verbose", multiple=True,
            help="print more, and show the log on stderr; twice for everything",
        ),
        _output_option("-q", "--quiet", multiple=True, help="print less"),
        _output_option(
            "--json", brief=True, help="print one JSON document (or JSON lines) on stdout"
        ),
        _output_option(
            "--events", help="with --json: print each event as a line of JSON, before the document"
        ),
        _output_option(
            LOG_FILE, metavar="FILE", type=FilePath(),
            help="append everything to this log, with times, regardless of -v and -q",
        ),
        _output_option(
            "-h", "brief_help", callback=_show, is_eager=True, brief=True,
            help="show the most used options",
        ),
        _output_option(
            "--help", callback=_show, is_eager=True, brief=True,
            help="show every option, the exit codes, files and environment variables",
        ),
    ]  # fmt: skip


class _OurCommand(HelpedCommand):
    """Command with the output options, whose long options may be abbreviated."""

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.params.sort(key=lambda param: not isinstance(param, Argument))
        self.params += _output_options()

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        return super().make_context(*args, token_normalize_func=self._whole_name, **more)

    @functools.cached_property
    def _names(self) -> set[str]:
        return {name.lstrip("-") for param in self.params for name in param.opts}

    def _whole_name(self, token: str) -> str:
        """Return the long option with this unique prefix."""
        matches = [name for name in self._names if name.startswith(token)]
        is_whole = len(token) == 1 or token in self._names
        return token if is_whole or len(matches) != 1 else matches[0]


class CliCommand(_OurCommand):
    """Command whose function takes the output and returns the exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        session = _session(ctx)
        session.begin()
        assert self.callback is not None  # noqa: S101  a command without a function is not a command
        return ctx.invoke(self.callback, session.output, **ctx.params)


class Group(_OurCommand, rich_click.RichGroup):  # type: ignore[misc]  # rich-click's own bases
    """Command that has actions (`flasher profile show`)."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the actions in the order of declaration, the most used first."""
        return list(self.commands)

    def action(self, name: str, **more: Any) -> Callable[[Callable[..., int]], CliCommand]:
        """Make a function an action; its exit codes default to the group's."""

        def make(function: Callable[..., int]) -> CliCommand:
            summary = (function.__doc__ or "").partition(".")[0]
            more.setdefault("exit_codes", self.exit_codes)
            made = command(short_help=" ".join(summary.split()), **more)(function)
            self.add_command(made, name)
            return made

        return make


def command(**more: Any) -> Callable[[Callable[..., int]], CliCommand]:
    """Make a function a command; its docstring begins the help."""
    return click.command(cls=CliCommand, **more)


def group(*, runs_alone: bool = False, **more: Any) -> Callable[[Callable[..., Any]], Group]:
    """Make a function a command with actions; its docstring begins the help. With `runs_alone` the
    function runs if no action is named.
    """

    def make(function: Callable[..., Any]) -> Group:
        @functools.wraps(function)
        @click.pass_context
        def run(ctx: click.Context, /, **options: Any) -> Any:
            if ctx.invoked_subcommand is not None:
                _refuse_own_options(ctx, ctx.invoked_subcommand)
                return None
            session = _session(ctx)
            session.begin()
            return function(session.output, **options)

        return click.group(
            cls=Group,
            no_args_is_help=False,
            invoke_without_command=runs_alone,
            subcommand_metavar="[ACTION ...]" if runs_alone else "ACTION ...",
            **more,
        )(run)

    return make


def _refuse_own_options(ctx: click.Context, action: str) -> None:
    """Raise UsageError for an option of a command that is typed before its action: it would have no
    effect. Those of the output apply to the action.
    """
    for param in ctx.command.params:
        if param.name in _typed(ctx) and param.callback is not _take:
            raise UsageError(
                f"{param.opts[0]} before the action {action} has no effect.",
                remedy=f"Leave it out, or write it after {action} if that has it:"
                f" `{ctx.command_path} {action} --help`.",
            )


@dataclass(frozen=True)
class CommandEntry:
    """Command of the program: its location, and its line in the list of commands."""

    place: str
    """Module in flasher.cli, and the name in it: "upgrade.flash:rescue"."""
    summary: str

    def module(self) -> ModuleType:
        return importlib.import_module(f"flasher.cli.{self.place.partition(':')[0]}")

    def load(self) -> click.Command:
        found: click.Command = getattr(self.module(), self.place.partition(":")[2])
        return found


class Program(_OurCommand, rich_click.RichGroup):  # type: ignore[misc]  # rich-click's own bases
    """The program. It imports a command when it is called, or its help is requested."""

    def __init__(
        self, *args: Any, entries: Mapping[str, Mapping[str, CommandEntry]], **more: Any
    ) -> None:
        """`entries` are the commands, by section and name."""
        super().__init__(
            *args,
            exit_codes=ExitCode,
            invoke_without_command=True,
            subcommand_metavar="COMMAND ...",
            **more,
        )
        self.params.append(
            _output_option("--version", callback=_show, is_eager=True, help="show the version")
        )
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


def usage_error(wrong: click.UsageError, command: str | None) -> UsageError:
    """Convert click's error about the command line of `command`."""
    ctx = wrong.ctx
    program = ctx.command_path if ctx else " ".join(filter(None, ("flasher", command)))
    close = getattr(wrong, "possibilities", None)
    message = wrong.message if close else wrong.format_message()
    remedy = f"Did you mean {close[0]}? " if close else ""
    if ctx is not None and isinstance(ctx.command, Group) and " command" in message:
        message = message.replace("command", "action")
        remedy = remedy or f"Actions are {', '.join(ctx.command.commands)}. "
    is_left_over = "extra argument" in message or isinstance(wrong, click.exceptions.NoSuchCommand)
    if ctx is not None and is_left_over:
        remedy += "".join(
            f"{param.opts[-1]} takes one value, and may be repeated. "
            for param in ctx.command.params
            if getattr(param, "multiple", False) and param.name in _typed(ctx)
        )
    return UsageError(
        f"{program}: {message.rstrip('.')}.", remedy=f"{remedy}Try `{program} --help`."
    )
