"""The wheel holds every data file, and `.ci/package` removes nothing that it did not make. (That it
builds, the gate sees.)
"""

from __future__ import annotations

import subprocess
import tomllib
from pathlib import Path

CHECKOUT = Path(__file__).parents[1]
SCRIPT = CHECKOUT / ".ci" / "package"


def test_every_data_file_is_packed() -> None:
    settings = tomllib.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))
    packed = {
        path
        for package, patterns in settings["tool"]["setuptools"]["package-data"].items()
        for pattern in patterns
        for path in CHECKOUT.joinpath(*package.split(".")).glob(pattern)
    }
    data = {
        path
        for path in (CHECKOUT / "flasher").rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc") and not path.name.startswith(".")
    }
    assert data - packed == set()


def test_a_build_that_cannot_be_made_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "of_somebody_else.txt").write_text("kept")
    (folder / "welling_flasher-0.0.9.tar.gz").write_text("the build before")
    lacking = tmp_path / "python"
    lacking.write_text("#!/bin/sh\nexit 1\n")
    lacking.chmod(0o755)
    absent = subprocess.run(
        [SCRIPT, "out", "nix/python"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert absent.returncode == 2
    assert absent.stderr.startswith(f"There is no {tmp_path}/nix/python.\n  what to do: ")
    # From another folder: what is given counts from there.
    ran = subprocess.run(
        [SCRIPT, "out", "./python"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 2
    assert f"{lacking} lacks the packages of the extra `release`" in ran.stderr
    assert f"{lacking} -m pip install -c .ci/constraints.txt" in ran.stderr
    assert {each.name for each in folder.iterdir()} == {
        "of_somebody_else.txt",
        "welling_flasher-0.0.9.tar.gz",
    }
