"""What a shell offers while a command line is typed, and what --help says."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from click.shell_completion import ShellComplete

from flasher.cli.framework import Group, Session
from flasher.cli.logs import Logs
from flasher.cli.main import COMMANDS
from flasher.cli.main import flasher as program
from flasher.cli.output import Output
from flasher.errors import ExitCode
from tests.cli.conftest import Flasher
from tests.end_to_end.processes import FLASHER, clean_environment
from tests.loops import each

Complete = Callable[[str], set[str]]


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch) -> Complete:
    """What is offered after the words so far; "FILES" where the shell offers files by itself."""
    monkeypatch.setattr("flasher.cli.values._NETWORK", Path("no-such-folder"))

    def offered(line: str) -> set[str]:
        *words, begun = line.split(" ")[1:]
        found = ShellComplete(program, {}, "flasher", "_C").get_completions(words, begun)
        return {"FILES" if each.type == "file" else str(each.value) for each in found}

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
        (
            "flasher help E60",
            {"E600", "E601", "E602", "E603", "E604", "E605", "E606", "E607", "E608"},
        ),
        ("flasher help mo", {"mock", "monitor"}),
        ("flasher scan -i socketc", {"socketcan", "socketcand"}),
        ("flasher monitor --node ", {"bms", "wmc", "mc", "obc", "pbu", "hmi", "cdl"}),
        ("flasher profile ", {"show", "check"}),
        ("flasher read ver", {"version-information"}),
        ("flasher read mem", {"memory"}),
        ("flasher read -t wmc ver", set()),
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
        ("flasher flash fol", {"folder/f.hex", "folder/g.bin"}),
        ("flasher flash folder/f", {"folder/f.hex"}),
        ("flasher info --log-file ", {"FILES"}),
    ],
)
def test_files_are_offered_by_their_suffix(
    complete: Complete,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    line: str,
    offered: set[str],
) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("a.hex", "b.s19", "c.asc", "d.toml", "e.txt", "folder/f.hex", "folder/g.bin"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    assert complete(line) == offered


def test_can_interfaces_of_linux_are_offered_as_channels(
    complete: Complete, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, kind in (("can0", "280"), ("vcan1", "280"), ("eth0", "1")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
    (tmp_path / "gone").mkdir()
    monkeypatch.setattr("flasher.cli.values._NETWORK", tmp_path)
    assert complete("flasher scan -c ") == {"can0", "vcan1"}


@pytest.mark.slow
def test_the_program_itself_answers_the_shell() -> None:
    asked = {
        "_FLASHER_COMPLETE": "zsh_complete",
        "COMP_WORDS": "flasher flash x.hex -t b",
        "COMP_CWORD": "4",
    }
    done = subprocess.run(
        FLASHER, env=clean_environment() | asked, capture_output=True, timeout=30, check=True
    )
    assert b"bms" in done.stdout
    assert b"wmc" not in done.stdout
    assert done.stderr == b""


def test_fish_is_answered_by_the_word_under_the_cursor(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_FLASHER_COMPLETE", "fish_complete")
    monkeypatch.setenv("COMP_WORDS", "flasher flash x.hex -t b")
    monkeypatch.setenv("COMP_CWORD", "b")
    answer = flasher()
    assert answer.code == ExitCode.OK
    assert "bms" in answer.out
    assert "wmc" not in answer.out
    assert answer.err == ""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_learns_how_to_ask(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, shell: str
) -> None:
    monkeypatch.setenv("_FLASHER_COMPLETE", f"{shell}_source")
    printed = flasher()
    assert printed.code == ExitCode.OK
    assert f"_FLASHER_COMPLETE={shell}_complete" in printed.out


# -- help ------------------------------------------------------------------------------------------


def examples_of(command: click.Command) -> list[list[str]]:
    """The words of every example; its remark, and what it is piped into, left out."""
    found = []
    for line in re.sub(r"\s*\\\n\s*", " ", command.epilog or "").splitlines():
        if line.startswith("  flasher "):
            words = re.split(r"\s{2,}| \| | > ", line.strip())[0]
            found.append(shlex.split(words)[1:])
    return found


def command_of(name: str | None) -> click.Command:
    return program if name is None else COMMANDS[name].load()


@pytest.mark.slow
@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_help_is_a_manual_page(
    flasher: Flasher, monkeypatch: pytest.MonkeyPatch, command: str | None
) -> None:
    for columns in (60, 80, 200):
        monkeypatch.setenv("COLUMNS", str(columns))
        reported = flasher(*([command] if command else []), "--help").out
        assert max(map(len, reported.splitlines())) <= 100
        for section in ("Usage: flasher", "output:", "examples:", "exit codes:"):
            assert section in reported
        assert "NO_COLOR" in reported
        assert "R|" not in reported
    assert command_of(command).help
    assert len(examples_of(command_of(command))) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_short_help_has_what_is_needed_most(flasher: Flasher, command: str) -> None:
    short, whole = (flasher(command, option).out for option in ("-h", "--help"))
    assert len(short.splitlines()) < len(whole.splitlines())
    assert f"every option: flasher {command} --help" in short
    assert "examples:" in short
    assert "exit codes:" not in short
    if "--mock-speed" in whole:
        assert "--mock " in short
        assert "--channel" in short
        assert "--mock-speed" not in short
        assert "--bus-kwargs" not in short


@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_every_example_parses(monkeypatch: pytest.MonkeyPatch, command: str | None) -> None:
    monkeypatch.setattr("click.Context.invoke", lambda *_, **__: ExitCode.OK)
    for words in examples_of(command_of(command)):
        output = Output()
        with Logs(output) as logs:
            session = Session(output, logs, words)
            with program.make_context("flasher", list(words), obj=session) as ctx:
                program.invoke(ctx)
        assert command in (None, output.command)


def with_actions(command: click.Command) -> Iterator[click.Command]:
    """A command and its actions (`flasher profile show`)."""
    yield command
    if isinstance(command, Group):
        yield from command.commands.values()


@each("command", COMMANDS)
def test_actions_of_a_command_take_the_output_options_too(command: str) -> None:
    for found in with_actions(command_of(command)):
        assert any("--log-file" in param.opts for param in found.params), found.name


def test_help_lists_the_commands_by_purpose(flasher: Flasher) -> None:
    reported = flasher("--help").out
    for title in (
        "upgrade a device",
        "look at devices and the bus",
        "when something goes wrong",
        "without hardware, and for bootloaders",
        "at the end of a production line",
        "settings of a product",
    ):
        assert f"\n{title}:\n" in reported
    for name, entry in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(entry.summary)}$", reported, re.MULTILINE)


@pytest.mark.parametrize(
    ("command", "printed", "not_printed"),
    [
        ("image-info", ["3 image rejected"], ["5 no answer", "CAN_INTERFACE"]),
        (
            "scan",
            ["5 no answer", "CAN_INTERFACE", "can.conf", "flasher.toml"],
            ["3 image", "target profile"],
        ),
        ("profile", [], ["4 adapter"]),
        (None, [f"{int(code)} " for code in ExitCode], []),
    ],
)
def test_help_lists_the_exit_codes_and_what_is_read(
    flasher: Flasher, command: str | None, printed: list[str], not_printed: list[str]
) -> None:
    reported = flasher(*([command] if command else []), "--help").out
    reported = reported[reported.index("exit codes:") :]
    assert all(text in reported for text in printed)
    assert not any(text in reported for text in not_printed)


def test_an_action_reports_what_it_reads(flasher: Flasher) -> None:
    assert "  flasher.toml" in flasher("profile", "show", "--help").out


@pytest.mark.slow
def test_no_command_is_imported_for_the_list_of_commands() -> None:
    """So that `flasher --help` is quick."""
    script = (
        "import sys; from flasher.cli.main import COMMANDS, main; main(['--help']); "
        "names = {e.place.partition(':')[0] for e in COMMANDS.values()}; "
        "libraries = ('can', 'tqdm', 'jinja2', 'pydantic', 'intelhex', 'bincopy', 'flasher.api'); "
        "print([n for n in libraries if n in sys.modules], "
        "[n for n in names if f'flasher.cli.{n}' in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=clean_environment(), capture_output=True, text=True, timeout=30, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "[] []"


@pytest.mark.slow
def test_only_the_chosen_command_is_imported() -> None:
    script = (
        "import sys; from flasher.cli.main import COMMANDS, main; main(['scan', '--help']); "
        "names = {e.place.partition(':')[0] for e in COMMANDS.values()}; "
        "print([n for n in names if f'flasher.cli.{n}' in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=clean_environment(), capture_output=True, text=True, timeout=30, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "['look.scan']"
