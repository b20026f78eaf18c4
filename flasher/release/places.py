"""Paths of trust files and of releases: all that an upgrade without either needs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from platformdirs import site_config_path, user_config_path, user_data_path

from flasher.errors import ImageError
from flasher.files import opened

SUFFIX: Final = ".wfw"
TRUST_FILE: Final = "trust.toml"
CHAIN_FILE: Final = "trust.json"
_MAGIC: Final = b"PK\x03\x04"


def trust_folders() -> tuple[Path, Path]:
    """Folders of the system's and the user's trust file; never the working directory."""
    return (
        site_config_path("flasher", appauthor=False),
        user_config_path("flasher", appauthor=False, roaming=True),
    )


def seen_folder() -> Path:
    """Folder of what this computer has seen of each trust."""
    return user_data_path("flasher", appauthor=False) / "trust"


def has_trust() -> bool:
    """True if this computer has a trust file, in whichever state."""
    return any(
        os.path.lexists(folder / name)
        for folder in trust_folders()
        for name in (TRUST_FILE, CHAIN_FILE)
    )


def is_container(path: str | os.PathLike[str]) -> bool:
    """True if a file begins like a release. Raises UsageError and ImageError."""
    with opened(path, None, error=ImageError) as (file, _):
        return file.read(len(_MAGIC)) == _MAGIC


def detached_path(image: str | os.PathLike[str]) -> Path:
    """Path of the release that lies beside its image: the image's path with `.wfw` appended."""
    path = Path(image)
    return path.with_name(path.name + SUFFIX)


def release_path(path: str | os.PathLike[str]) -> Path | None:
    """Path of the release that a file is, or else that lies beside it; None without one.

    Raises UsageError and ImageError.
    """
    if is_container(path):
        return Path(path)
    beside = detached_path(path)
    # A dangling link counts as existing, so that it is an error.
    return beside if os.path.lexists(beside) else None
