"""Writes the licence texts of what a build contains into a folder, a file for each package.

`python licences.py SITE_PACKAGES FOLDER [LIBRARIES]`; LIBRARIES is the folder of a build with
libraries of this system. Ends with 1 where a text is missing.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from pathlib import Path

_KEPT = Path(__file__).parent / "licences"
"""Texts of packages whose wheels have none."""
_BUILDERS = {"pip", "setuptools", "pyinstaller-hooks-contrib", "altgraph", "wheel"}
"""Packages that are there to build, of which the build contains nothing."""
_OURS = "flasher"


def main() -> int:
    site, folder, *libraries = map(Path, sys.argv[1:])
    folder.mkdir()
    for each in distributions(path=[str(site)]):
        name = each.metadata["Name"]
        if name.lower() in _BUILDERS:
            continue
        texts = list(_texts(each))
        if not texts and (_KEPT / f"{name}.txt").is_file():
            texts = [(_KEPT / f"{name}.txt").read_text("utf-8")]
        if not texts:
            sys.exit(f"{name} has no licence text: put one into {_KEPT}")
        whole = "\n\n".join([f"{name} {each.version}", *texts])
        (folder / f"{name}.txt").write_text(whole, encoding="utf-8")
    if libraries:
        shutil.copy(Path(sysconfig.get_path("stdlib"), "LICENSE.txt"), folder / "Python.txt")
        _copy_of_system(libraries[0], folder)
    return 0


def _texts(package: Distribution) -> Iterator[str]:
    words = ("licen", "copying", "notice", "authors")
    for file in package.files or ():
        is_text = file.suffix in ("", ".txt", ".md", ".rst", ".apache", ".bsd", ".mit")
        if ".dist-info" in file.parts[0] and is_text and file.name.lower().startswith(words):
            yield Path(str(package.locate_file(file))).read_text("utf-8", errors="replace")


def _copy_of_system(libraries: Path, folder: Path) -> None:
    """Copy the licences of the libraries that PyInstaller took from this Debian system."""
    for library in sorted(libraries.glob("*.so*")):
        found = subprocess.run(
            ["dpkg-query", "--search", f"*/{library.name}"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if found.returncode == 0:
            package = found.stdout.partition(":")[0]
            text = Path("/usr/share/doc", package, "copyright")
            shutil.copy(text, folder / f"{package}.txt")


if __name__ == "__main__":
    sys.exit(main())
