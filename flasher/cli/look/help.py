"""`flasher help`: explain an error code, a code of the station, or a command."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Final

import click

from flasher.cli import values
from flasher.cli.framework import Program, argument, command
from flasher.cli.output import Output
from flasher.errors import ErrorCode, ExitCode, UsageError, did_you_mean

_EXAMPLES: Final = """\
examples:
  flasher help E402         an error code, as it ends a message
  flasher help DUPLICATE    a code of the station
  flasher help codes        all codes
  flasher help flash        the same as flasher flash --help
  flasher help trust key    the same as flasher trust key --help
"""
_SECTION: Final = re.compile(r"^## (E\d+): (.+)\n((?:(?!#).*\n?)*)", re.MULTILINE)
_ALL: Final = "codes"


@dataclass(frozen=True)
class CodeDocument:
    """Error code with its explanation."""

    code: str
    title: str
    text: str
    """Paragraphs, separated by empty lines; empty in the list of all codes."""


@dataclass(frozen=True)
class CodesDocument:
    """Requested codes."""

    codes: list[CodeDocument]


DOCUMENTS: Final = (CodesDocument,)


def error_codes() -> dict[str, CodeDocument]:
    """Read the codes of flasher/error_codes.md with their explanations."""
    page = files("flasher").joinpath("error_codes.md").read_text(encoding="utf-8")
    return {
        code: CodeDocument(code, title, text.strip().replace("**", ""))
        for code, title, text in _SECTION.findall(page)
    }


def _codes(ctx: click.Context) -> Iterable[str]:
    from flasher.station.codes import CODES  # noqa: PLC0415  needed for its codes alone

    program = ctx.find_root().command
    commands = program.entries if isinstance(program, Program) else ()
    return (*ErrorCode, *CODES, _ALL, *commands)


def _help_of(found: click.Command, shown: click.Context, action: str | None) -> str:
    """Return the help of a command, or of its action. Raises UsageError for an unknown action."""
    if action is None:
        return found.get_help(shown)
    inner = found.get_command(shown, action) if isinstance(found, click.Group) else None
    if inner is None:
        raise UsageError(
            f"{shown.command_path} has no action {action!a:.40}.",
            remedy=f"See `flasher help {shown.info_name}`.",
        )
    with inner.make_context(action, [], parent=shown, resilient_parsing=True) as inside:
        return inner.get_help(inside)


@command(name="help", epilog=_EXAMPLES)
@argument(
    "what", metavar="WHAT", required=False, shell_complete=values.offers(_codes),
    help="a code, `codes`, or a command",
)  # fmt: skip
@argument("action", metavar="ACTION", required=False, help="an action of the command")
@click.pass_context
def help_(ctx: click.Context, output: Output, *, what: str | None, action: str | None) -> int:
    """Explain a code, or show the help of a command."""
    from flasher.station.codes import CODES  # noqa: PLC0415  needed for its codes alone

    program = ctx.find_root()
    assert isinstance(program.command, Program)  # noqa: S101  it is the one that found us
    if what is None:
        output.print_help(program.get_help())
        return ExitCode.OK
    if what in program.command.entries:
        found = program.command.entries[what].load()
        with found.make_context(what, [], parent=program, resilient_parsing=True) as shown:
            output.print_help(_help_of(found, shown, action))
        return ExitCode.OK
    if action is not None:
        raise UsageError(
            f"{what!a:.40} is not a command with actions.", remedy="See `flasher help`."
        )
    errors = error_codes()
    if what.lower() == _ALL:
        output.table((code, each.title) for code, each in errors.items())
        output.result("")
        output.result("of the station:")
        output.table(((name, code.meaning) for name, code in CODES.items()), indent=2)
        documents = [CodeDocument(each.code, each.title, "") for each in errors.values()]
        documents += [CodeDocument(name, str(code.meaning), "") for name, code in CODES.items()]
        return output.document(CodesDocument(documents))
    word = what.upper()
    if word in CODES:
        code = CODES[word]
        one = CodeDocument(word, str(code.meaning), str(code.action))
    elif word in errors:
        one = errors[word]
    else:
        refused = errors[ErrorCode.CLAIM_REFUSED]
        why = re.search(rf"^- (`{re.escape(word)}`: .*)", refused.text, re.MULTILINE)
        if why is None:
            known = [*errors, *CODES, *program.command.entries]
            raise UsageError(
                f"Unknown code or command: {what!a:.40}.",
                remedy=f"{did_you_mean(word, known)}See all codes with `flasher help codes`.",
            )
        one = replace(refused, text=why[1])
    output.result(f"{one.code}: {one.title}")
    for paragraph in one.text.split("\n\n"):
        output.result("")
        is_list = paragraph.startswith("- ")
        for line in re.split(r"\n(?=- )", paragraph) if is_list else [paragraph]:
            output.result(" ".join(line.split()))
    return output.document(CodesDocument([one]))
