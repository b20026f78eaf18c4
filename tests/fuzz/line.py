"""Harnesses of the station's files: recipe, station, scans."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import date
from functools import cache
from pathlib import Path
from typing import Final

from flasher.cli.station.scans import ScanFile, read_scans
from flasher.errors import UsageError
from flasher.station.config import CONFIG, load_config
from flasher.station.recipe import RECIPE
from flasher.station.recipe_file import load_checked
from flasher.station.scans import Word, understand
from tests.fuzz.harness import Harness, own_folder, written
from tests.fuzz.settings import toml_words
from tests.hostile.files import SAMPLES

_STATION: Final = SAMPLES / "station"
_DAY: Final = date(2026, 5, 17)


@cache
def _folder() -> Path:
    """What the recipe of the samples names."""
    folder = own_folder()
    for name in ("bms.bin", "bms.bin.toml"):
        shutil.copy(_STATION / name, folder)
    return folder


def take_recipe(data: bytes) -> None:
    path = _folder() / "recipe.toml"
    path.write_bytes(data)
    loaded = load_checked(path, _DAY)
    assert loaded.is_unchanged()
    assert loaded.content.encode() == data.removeprefix(b"\xef\xbb\xbf")


def _recipes() -> Iterator[bytes]:
    whole = (_STATION / "recipe.toml").read_bytes()
    yield whole
    yield whole + b"\n[golden]\nserial_numbers = ['BAT2620-9999']\nevery_h = 8.0\n"


def take_station(data: bytes) -> None:
    load_config(written(data, ".toml"))


def _stations() -> Iterator[bytes]:
    yield (_STATION / "sockets.toml").read_bytes()


def take_scans(data: bytes) -> None:
    scans = read_scans(written(data, ".txt"))
    for scan in scans:
        understand(scan)
    ScanFile(scans, ["A", "B"], lambda _scan: None)


def _scans() -> Iterator[bytes]:
    yield (_STATION / "scans.txt").read_bytes()
    yield "\n".join(f"{word.value} A" for word in Word).encode()


HARNESSES: Final = {
    "recipe": Harness(
        take_recipe,
        _recipes,
        "flasher.settings.toml_reader.to_json",
        (UsageError,),
        words=lambda: toml_words(RECIPE.keys.values()),
    ),
    "station": Harness(
        take_station,
        _stations,
        "flasher.settings.toml_reader.to_json",
        (UsageError,),
        words=lambda: toml_words(CONFIG.keys.values()),
    ),
    "scans": Harness(
        take_scans,
        _scans,
        "flasher.cli.station.scans.read",
        (UsageError,),
        words=lambda: [f"{word.value} " for word in Word],
    ),
}
