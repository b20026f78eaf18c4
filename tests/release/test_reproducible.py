"""The same release on computers with other settings: the same bytes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.release.maker import SAMPLES

_BUILD = """
import os, sys
os.umask(int(sys.argv[1], 8))
from flasher.cli.main import main
sys.exit(main(sys.argv[2:]))
"""
PLACES = {
    "here": {"LC_ALL": "C", "TZ": "UTC", "PYTHONHASHSEED": "1"},
    "there": {"LC_ALL": "de_DE.UTF-8", "TZ": "Asia/Shanghai", "PYTHONHASHSEED": "2"},
}


@pytest.mark.slow
def test_a_release_is_the_same_under_another_locale_time_zone_and_umask(tmp_path: Path) -> None:
    made: list[bytes] = []
    for (name, settings), umask in zip(PLACES.items(), ("022", "077"), strict=True):
        folder = tmp_path / name
        folder.mkdir()
        # Shortly before midnight of UTC, when it is another day in Shanghai.
        given = {**os.environ, **settings, "SOURCE_DATE_EPOCH": "1785023990"}
        for image in ("bms.bin", "wmc.hex"):
            shutil.copy(SAMPLES / image, folder / image)
            os.utime(folder / image, (len(made) * 1e9, len(made) * 1e9))
        images = ["--image", "bms=bms.bin", "--image", "wmc=wmc.hex"]
        subprocess.run(
            [
                sys.executable, "-c", _BUILD, umask, "release", "build", "bike.wfw",
                *(images if name == "here" else images[2:] + images[:2]),
                "--product", "48V", "--counter", "7",
            ],
            cwd=folder, env=given, check=True, capture_output=True,
        )  # fmt: skip
        made.append((folder / "bike.wfw").read_bytes())
    assert made[0] == made[1]
