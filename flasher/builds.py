"""Kind of this build: installed by pip, or packed with all packages, as one file or a folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

SUFFIX: Final = ".pyz"
"""File name ending of the build in one file, which a Python runs."""
_START: Final = "flasher_start"
"""Module that the build in one file begins with. Another file that contains flasher does not,
and would start itself again for each process.
"""


def is_frozen() -> bool:
    """True in the folder that PyInstaller makes, which contains a Python of its own."""
    return bool(getattr(sys, "frozen", False))


def is_whole() -> bool:
    """True for a build to which pip can add no package."""
    return is_frozen() or (_START in sys.modules and _program().suffix == SUFFIX)


def module_command(module: str) -> tuple[str, ...]:
    """Return the command that runs a module of flasher in a process of its own; what contains
    flasher whole understands Python's `-m` for it (`flasher_start`).
    """
    program = () if is_frozen() or not is_whole() else (str(_program().absolute()),)
    return (sys.executable, *program, "-m", module)


def _program() -> Path:
    return Path(sys.argv[0] if sys.argv else "")
