"""`flasher help`: it explains each printed code, whose digits begin with its exit code."""

from __future__ import annotations

import ast
import itertools
import re
from pathlib import Path
from typing import Final

import pytest

import flasher.cli.look.help as printed
import flasher.station.records.errors
from flasher import errors
from flasher.errors import ErrorCode, ExitCode, FlasherError
from flasher.host import outcome, verify
from flasher.station.codes import CODES
from flasher.station.records.errors import Refusal
from tests.cli.conftest import Flasher

PACKAGE: Final = Path(errors.__file__).parent
KINDS: Final = {
    name: kind
    for name, kind in itertools.chain(
        vars(errors).items(), vars(flasher.station.records.errors).items()
    )
    if isinstance(kind, type) and issubclass(kind, FlasherError)
}


def exit_code_in(code: ErrorCode) -> int:
    return int(code[1:] if code is ErrorCode.INTERRUPTED else code[1:-2])


def test_the_page_explains_each_code_in_order() -> None:
    assert list(printed.error_codes()) == [code.value for code in ErrorCode]


def test_each_code_is_explained_to_its_end() -> None:
    page = (PACKAGE / "error_codes.md").read_text(encoding="utf-8")
    for code, one in printed.error_codes().items():
        section = page.partition(f"## {code}: ")[2].partition("\n## ")[0]
        assert f"{one.title}\n\n{one.text}" == section.strip().replace("**", "")


def test_the_code_of_a_class_has_its_exit_code() -> None:
    for kind in KINDS.values():
        assert exit_code_in(kind.default_code) == kind.exit_code, kind
    for each in outcome._EXPLANATIONS.values():
        if each.code is not None:
            assert exit_code_in(each.code) == each.kind.exit_code, each


@pytest.mark.slow
def test_the_code_of_an_error_has_the_exit_code_of_its_class() -> None:
    used = set()
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)) if "code=" in source else ():
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in KINDS:
                kind = KINDS[node.func.id]  # type: ignore[attr-defined]
                for given in node.keywords:
                    # A code that is passed on was checked where it was given.
                    named = ast.unparse(given.value)
                    if given.arg == "code" and re.fullmatch(r"ErrorCode\.\w+", named):
                        code = ErrorCode[named.removeprefix("ErrorCode.")]
                        assert exit_code_in(code) == kind.exit_code, (path, node.lineno)
                        used.add(code)
    used |= {kind.default_code for kind in KINDS.values()}
    for described in (*outcome._EXPLANATIONS.values(), *verify._EXPLANATIONS.values()):
        if described.code is not None:
            assert exit_code_in(described.code) == described.kind.exit_code, described
            used.add(described.code)
    assert used | {ErrorCode.FILE_FAULTS} == set(ErrorCode)


def test_a_code_is_printed_and_explained(flasher: Flasher) -> None:
    failed = flasher("flash", "nix.bin", "-t", "bms")
    assert failed.err.splitlines()[0].endswith("no file of this name. [E201]")
    reported = flasher("help", "e201")
    assert reported.out.startswith("E201: a file cannot be read\n\nThere is no file of this name")
    assert "What to do: correct the name." in reported.out
    assert flasher("flash", "nix.bin", "-t", "bms", "--json").document["error"]["code"] == "E201"


@pytest.mark.parametrize("code", ["E202", "E503", "E504"])
def test_a_code_does_not_claim_that_nothing_was_done(flasher: Flasher, code: str) -> None:
    """Each is the error of a first attempt, and of a later one after an erased application."""
    reported = flasher("help", code).out.lower()
    for claim in ("nothing was", "nothing has", "is still there"):
        assert claim not in reported


def test_a_file_with_faults_has_their_code(flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text("nix = 1\n")
    ran = flasher("profile", "check", tmp_path / "p.toml")
    assert ran.code == ExitCode.USAGE
    assert "[E203]" in ran.err


@pytest.mark.parametrize("code", [*CODES, *Refusal])
def test_a_code_of_the_station_is_explained(flasher: Flasher, code: str) -> None:
    ran = flasher("help", code)
    assert ran.code == 0
    assert "`" + code in ran.out if code in list(Refusal) else ran.out.startswith(f"{code}: ")


def test_all_codes_are_listed(flasher: Flasher) -> None:
    listed = flasher("help", "codes").out
    assert all(f"{code}  " in listed for code in (*ErrorCode, *CODES))


@pytest.mark.slow
def test_help_of_a_command_is_that_of_its_option(flasher: Flasher) -> None:
    assert flasher("help", "flash").out == flasher("flash", "--help").out
    assert flasher("help", "trust", "key").out == flasher("trust", "key", "--help").out
    for words in (("trust", "no"), ("flash", "key"), ("E201", "key")):
        assert flasher("help", *words).code == 2
    assert flasher("help").out == flasher("--help").out


def test_an_unknown_code_is_refused(flasher: Flasher) -> None:
    ran = flasher("help", "E40")
    assert ran.code == ExitCode.USAGE
    assert "Did you mean E4" in ran.err
