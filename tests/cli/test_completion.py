"""What a shell offers while a command line is typed, and what --help says."""

from __future__ import annotations

import argparse
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from argcomplete.finders import CompletionFinder

from flasher.cli import completion, manual
from flasher.cli.lists import gather_lists
from flasher.cli.main import COMMANDS, build_parser, main, with_actions
from flasher.errors import ExitCode
from tests.cli.conftest import Flasher
from tests.end_to_end.processes import FLASHER, clean_environment

Complete = Callable[[str], set[str]]


@pytest.fixture(scope="module")
def whole() -> argparse.ArgumentParser:
    """The parser with every command's options."""
    return build_parser(COMMANDS)


class Finder(CompletionFinder):
    """argcomplete's own, but for its log on file descriptor 9, which is somebody else's here."""

    def _init_debug_stream(self) -> None:
        """The standard error stream."""


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch) -> Complete:
    """What is offered behind the words so far, options left out unless one was begun."""
    monkeypatch.setattr("flasher.cli.completion._NETWORK", Path("no-such-folder"))
    parser = build_parser(COMMANDS)
    for each in with_actions(parser):
        completion.prepare(each)

    def offered(line: str) -> set[str]:
        monkeypatch.setenv("_ARGCOMPLETE", "1")
        monkeypatch.setenv("_ARGCOMPLETE_IFS", "\n")
        monkeypatch.setenv("COMP_LINE", line)
        monkeypatch.setenv("COMP_POINT", str(len(line)))
        stream = io.StringIO()
        with pytest.raises(SystemExit):
            Finder()(parser, exit_method=sys.exit, output_stream=stream)
        words = {word.strip() for word in stream.getvalue().split("\n")}
        is_option = line.rsplit(" ", maxsplit=1)[-1].startswith("-")
        return {word for word in words if word and word.startswith("-") == is_option}

    return offered


# -- completion ------------------------------------------------------------------------------------


def test_commands_are_offered(complete: Complete) -> None:
    assert set(COMMANDS) <= complete("flasher ")
    assert complete("flasher prof") == {"profile"}


def test_options_of_the_command_are_offered(complete: Complete) -> None:
    assert complete("flasher flash --verif") == {"--verify"}
    assert {"--json", "--log-file"} <= complete("flasher info --")


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("flasher flash x.hex -t ", {"bms", "wmc", "mc", "obc", "pbu"}),
        ("flasher info --dialect ", {"welling", "motinova"}),
        ("flasher scan -i socketc", {"socketcan", "socketcand"}),
        ("flasher monitor --node ", {"bms", "wmc", "mc", "obc", "pbu", "hmi", "cdl"}),
        ("flasher profile ", {"show", "check"}),
        ("flasher read ver", {"version-information"}),
        ("flasher read mem", {"memory"}),
        ("flasher write user-string-1", {"user-string-1"}),
        ("flasher mock -t bms --set repeated_p", {"repeated_packet="}),
        ("flasher flash x.hex --timeout ", set()),
        ("flasher scan -c ", set()),
    ],
)
def test_values_are_offered(complete: Complete, line: str, offered: set[str]) -> None:
    assert complete(line) == offered


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("flasher flash ", {"a.hex", "b.s19", "folder/"}),
        ("flasher image-info ", {"a.hex", "b.s19", "folder/"}),
        ("flasher monitor ", {"c.asc", "folder/"}),
        ("flasher flash a.hex --trace-file ", {"c.asc", "folder/"}),
        ("flasher flash a.hex --profile ", {"d.toml", "folder/"}),
        ("flasher info --log-file ", {"a.hex", "b.s19", "c.asc", "d.toml", "e.txt", "folder/"}),
    ],
)
def test_files_are_offered_by_their_suffix(
    complete: Complete,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    line: str,
    offered: set[str],
) -> None:
    for name in ("a.hex", "b.s19", "c.asc", "d.toml", "e.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    assert complete(line) == offered


def test_can_interfaces_of_linux_are_offered_as_channels(
    complete: Complete, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, kind in (("can0", "280"), ("vcan1", "280"), ("eth0", "1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
    (tmp_path / "gone").mkdir()
    monkeypatch.setattr("flasher.cli.completion._NETWORK", tmp_path)
    assert complete("flasher scan -c ") == {"can0", "vcan1"}


def test_the_program_itself_answers_the_shell(tmp_path: Path) -> None:
    answer = tmp_path / "answer"
    line = "flasher flash x.hex -t b"
    asked = {
        "_ARGCOMPLETE": "1",
        "_ARGCOMPLETE_IFS": "\n",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(answer),
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
    }
    done = subprocess.run(
        FLASHER, env=clean_environment() | asked, capture_output=True, timeout=30, check=False
    )
    assert answer.read_text().split() == ["bms"]
    assert (done.stdout, done.stderr) == (b"", b"")


def test_without_argcomplete_nothing_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    monkeypatch.delitem(sys.modules, "flasher.cli.completion")
    assert main([]) != ExitCode.OK
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["__main__.py", "cli/main.py"])
def test_modules_are_marked_for_global_completion(name: str) -> None:
    """argcomplete looks into the first 1024 characters of the module that a script runs."""
    text = (Path(manual.__file__).parents[1] / name).read_text("utf-8")
    assert "PYTHON_ARGCOMPLETE_OK" in text[:1024]


# -- help ------------------------------------------------------------------------------------------


def examples_of(parser: argparse.ArgumentParser) -> list[list[str]]:
    """The words of every example; the remark behind it, and what it is piped into, left out."""
    found = []
    for line in re.sub(r"\s*\\\n\s*", " ", parser.epilog or "").splitlines():
        if line.startswith("  flasher "):
            command = re.split(r"\s{2,}| \| | > ", line.strip())[0]
            found.append(shlex.split(command)[1:])
    return found


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal wider than help is."""
    monkeypatch.setenv("COLUMNS", "200")


@pytest.mark.parametrize("command", [None, *COMMANDS])
@pytest.mark.usefixtures("wide")
def test_help_is_a_manual_page(whole: argparse.ArgumentParser, command: str | None) -> None:
    parser = command_parser(whole, command) if command else whole
    said = parser.format_help()
    assert max(map(len, said.splitlines())) <= 100
    for section in ("usage: flasher", "output:", "examples:", "exit codes:"):
        assert section in said
    assert parser.description
    assert parser.description.strip()
    if command:
        assert "files and environment:" in said
        assert "NO_COLOR" in said
    assert len(examples_of(parser)) >= 3
    assert "R|" not in said


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_every_example_parses(whole: argparse.ArgumentParser, command: str | None) -> None:
    for words in examples_of(command_parser(whole, command) if command else whole):
        options = whole.parse_args(gather_lists(words))
        assert command in (None, options.command)


def command_parser(whole: argparse.ArgumentParser, command: str) -> argparse.ArgumentParser:
    parsers = {parser.prog: parser for parser in with_actions(whole)}
    return parsers[f"flasher {command}"]


def test_actions_of_a_command_take_the_output_options_too(whole: argparse.ArgumentParser) -> None:
    for parser in with_actions(whole):
        assert "--log-file" in parser.format_help(), parser.prog


def test_help_lists_the_commands_by_purpose(flasher: Flasher) -> None:
    said = flasher("--help").out
    for title, names in manual.PURPOSES.items():
        known = [name for name in names if name in COMMANDS]
        assert (f"\n{title}:\n" in said) == bool(known)
    for name, (_, summary) in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", said, re.MULTILINE)


def test_a_command_without_a_purpose_is_listed_too() -> None:
    groups = dict(manual.commands_by_purpose({"new": ("new", "does it"), "scan": ("scan", "s")}))
    assert groups == {"look at devices and the bus": "scan  s", "others": "new   does it"}


@pytest.mark.parametrize(
    ("command", "told", "untold"),
    [
        ("image-info", ["3 image rejected"], ["5 no answer", "CAN_INTERFACE"]),
        ("scan", ["5 no answer", "CAN_INTERFACE", "can.conf"], ["3 image", "flasher.toml"]),
        ("profile", ["flasher.toml"], ["4 adapter"]),
        (None, [f"{int(code)} " for code in ExitCode], []),
    ],
)
def test_help_tells_the_exit_codes_and_what_is_read(
    whole: argparse.ArgumentParser, command: str | None, told: list[str], untold: list[str]
) -> None:
    epilog = str((command_parser(whole, command) if command else whole).epilog)
    assert all(text in epilog for text in told)
    assert not any(text in epilog for text in untold)


def test_only_the_chosen_command_is_imported() -> None:
    """So that `flasher --help` is quick."""
    script = (
        "import sys; from flasher.cli.main import main; main(['--help']); "
        "print([n for n in ('can', 'rich', 'tqdm', 'argcomplete', 'jinja2') if n in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=clean_environment(), capture_output=True, text=True, timeout=30, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "[]"
