"""Builds the site of the documents, and checks it.

    python -m tests.site                     into build/site
    python -m tests.site --zip flasher.zip   and into one file, for computers without a network

A warning of Sphinx, a link that leads nowhere or anything that would be loaded from another
computer ends it with exit code 1.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
import zipfile
from pathlib import Path
from typing import Final

from tests.site.pages import Site
from tests.site.questions import noted, unanswered

_ROOT: Final = Path(__file__).parents[2]
_MADE_BY_SPHINX: Final = ".buildinfo"
_DATE: Final = (1980, 1, 1, 0, 0, 0)
"""Of every file in the zip archive: the same pages make the same archive."""


def build(folder: Path) -> bool:
    """Build it anew in place of a site that is there; whether Sphinx had nothing against it."""
    if folder.exists() and any(folder.iterdir()) and not (folder / _MADE_BY_SPHINX).exists():
        sys.exit(f"{folder} holds something else than a site: name another folder, or empty it")
    try:
        from sphinx.cmd.build import build_main  # noqa: PLC0415  an extra that may be absent
    except ImportError as error:
        sys.exit(f"{error.name} is missing: pip install -c .ci/constraints.txt -e '.[docs]'")
    shutil.rmtree(folder, ignore_errors=True)
    # In one process: others would import all again and pickle their pages, on cores that the gate
    # has other work for.
    arguments = ["-b", "html", "-W", "--keep-going", "-q"]
    trees = folder.with_name(f"{folder.name}.trees")
    shutil.rmtree(trees, ignore_errors=True)
    return build_main([*arguments, "-d", str(trees), str(_ROOT / "docs"), str(folder)]) == 0


def pack(folder: Path, archive: Path) -> None:
    """All files of the site in one archive, in a folder of its own."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            name = Path("flasher-site") / path.relative_to(folder)
            info = zipfile.ZipInfo(name.as_posix(), _DATE)
            info.compress_type = zipfile.ZIP_DEFLATED
            packed.writestr(info, path.read_bytes())


def main() -> int:
    """Build, check, pack; returns the exit code."""
    parser = argparse.ArgumentParser(description="Build the site of the documents, and check it.")
    parser.add_argument("folder", nargs="?", type=Path, default=_ROOT / "build" / "site")
    parser.add_argument("--zip", type=Path, metavar="FILE", help="pack it into one file too")
    parser.add_argument("--questions", action="store_true", help="show the way to ten answers")
    options = parser.parse_args()
    began = time.perf_counter()
    if not build(options.folder):
        return 1
    site = Site(options.folder)
    problems = [*site.problems(), *unanswered(site)]
    sys.stderr.writelines(f"{problem}\n" for problem in problems)
    if problems:
        return 1
    size = sum(path.stat().st_size for path in options.folder.rglob("*") if path.is_file())
    took_s = time.perf_counter() - began
    sys.stdout.write(
        f"{options.folder / 'index.html'}: {len(site.pages)} pages, {size / 1e6:.1f} MB, "
        f"{took_s:.1f} s\n"
    )
    if options.questions:
        sys.stdout.writelines(f"{line}\n" for line in noted(site))
    if options.zip:
        pack(options.folder, options.zip)
        sys.stdout.write(f"{options.zip}: {options.zip.stat().st_size / 1e6:.1f} MB\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
