"""Builds that contain flasher whole: what they advise, start and contain."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import flasher_start
from flasher.builds import module_command
from flasher.cli.extras import _PACKAGES
from flasher.cli.terminal import started_as
from flasher.errors import how_to_install, install_command

CHECKOUT = Path(__file__).parents[1]
INSTALLERS = CHECKOUT / "installers"
WHEEL = "./welling_flasher-0.1.0-py3-none-any.whl"


@pytest.fixture
def one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The program runs from one file."""
    file = tmp_path / "flasher-0.1.0.pyz"
    file.write_bytes(b"")
    file.chmod(0o755)
    monkeypatch.setattr("sys.argv", [str(file), "adapters"])
    return file


@pytest.fixture
def frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The program has a Python of its own."""
    monkeypatch.setattr("sys.frozen", True, raising=False)
    monkeypatch.setattr("sys.argv", ["flasher", "adapters"])


# -- advice ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("one_file")
def test_what_one_file_lacks_is_installed_into_an_environment_of_its_own() -> None:
    before, _, command = install_command("python-can[gs-usb]").partition(" && ")
    assert before == "python3 -m venv flasher-env"
    assert shlex.split(command) == [
        *("flasher-env/bin/python", "-m", "pip", "install"),
        *(WHEEL, "python-can[gs-usb]"),
    ]


@pytest.mark.usefixtures("frozen")
def test_an_extra_comes_with_the_wheel_of_the_same_version() -> None:
    assert how_to_install("station,web").endswith(
        f"flasher-env/bin/python -m pip install '{WHEEL}[station,web]'"
    )


def test_where_pip_can_add_a_package_its_python_is_named() -> None:
    assert install_command("pyserial") == f"{shlex.quote(sys.executable)} -m pip install pyserial"
    assert how_to_install("web").startswith("In the checkout: ")


@pytest.mark.usefixtures("frozen")
def test_a_folder_found_in_the_path_is_named_as_it_was_typed() -> None:
    assert started_as() == "flasher"


def test_one_file_is_named_with_its_place(one_file: Path) -> None:
    assert started_as() == str(one_file)


# -- processes -------------------------------------------------------------------------------------


@pytest.mark.usefixtures("one_file")
def test_one_file_of_somebody_else_is_not_begun_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "flasher_start")
    assert module_command("flasher.trace.mf4") == (sys.executable, "-m", "flasher.trace.mf4")


def test_one_file_runs_its_processes_by_itself(one_file: Path) -> None:
    own = "flasher.bus.detect"
    assert module_command(own) == (sys.executable, str(one_file), "-m", own)


@pytest.mark.usefixtures("frozen")
def test_a_folder_runs_its_processes_by_itself() -> None:
    assert module_command("flasher.trace.mf4") == (sys.executable, "-m", "flasher.trace.mf4")


@pytest.mark.slow
def test_the_start_of_the_program_runs_a_process() -> None:
    # Its own block for the folder, as PyInstaller runs it.
    command = [sys.executable, "-m", "flasher_start", "-m", "flasher.bus.detect", "virtual"]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ran.stdout.startswith('detected: {"interface": "virtual"')


def test_every_module_that_is_started_is_one_that_the_start_knows() -> None:
    started = re.findall(r'module_command\("([\w.]+)"\)', _sources())
    assert sorted(started) == sorted(flasher_start._PROCESSES)


def test_the_packages_of_the_builds_have_the_versions_of_the_constraints() -> None:
    pinned = re.compile(r"^[\w.-]+==[^ ;\n]+", re.MULTILINE)
    builds, people = (
        set(pinned.findall((CHECKOUT / ".ci" / name).read_text("utf-8")))
        for name in ("bundle_hashes.txt", "constraints.txt")
    )
    assert len(builds) > 50
    assert builds <= people  # else run .ci/lock


# -- what the folder contains ----------------------------------------------------------------------


def test_the_folder_contains_every_module_that_is_imported_by_name() -> None:
    recipe = ast.parse((INSTALLERS / "flasher.spec").read_text("utf-8"))
    listed = {
        node.targets[0].id: {
            str(each.value) for each in ast.walk(node.value) if isinstance(each, ast.Constant)
        }
        for node in recipe.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
    }
    names = listed["BY_NAME"] | listed["MODULES"]
    contained = {name.partition(".")[0] for name in names} | sys.stdlib_module_names
    contained |= set(re.findall(r"^ *(?:from|import) (\w+)", _sources(), re.MULTILINE))
    by_name = re.findall(r'(?:import_module|find_spec)\(\s*"(\w+)', _sources())
    looked_for = {*by_name, *_PACKAGES["station"], *_PACKAGES["web"]}
    assert looked_for - contained == set()
    assert "flasher" in names  # commands are loaded by their names


@cache
def _sources() -> str:
    return "\n".join(path.read_text("utf-8") for path in (CHECKOUT / "flasher").rglob("*.py"))


@pytest.mark.slow
def test_the_units_of_the_debian_package_are_valid(tmp_path: Path) -> None:
    program = tmp_path / "opt" / "flasher" / "flasher"
    program.parent.mkdir(parents=True)
    program.symlink_to("/bin/true")
    units = sorted((INSTALLERS / "debian").glob("*.service"))
    placed = tmp_path / "etc" / "systemd" / "system"
    placed.mkdir(parents=True)
    for unit in units:
        text = unit.read_text("utf-8").replace("/opt/flasher/flasher", str(program))
        (placed / unit.name).write_text(text)
    if (verify := shutil.which("systemd-analyze")) is None:
        pytest.skip("needs systemd-analyze")
    ran = subprocess.run(
        [verify, "verify", "--man=no", *(placed / unit.name for unit in units)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (ran.returncode, ran.stdout + ran.stderr) == (0, "")
    assert len(units) == 3
