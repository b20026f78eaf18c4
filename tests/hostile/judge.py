"""What a reader may do with a hostile file, for campaigns and fuzzing alike."""

from __future__ import annotations

from typing import Final

from flasher.errors import ErrorCode, ExitCode, FlasherError

LIMIT_S: Final = 2.0
"""Of the processor, for a file of a few kilobytes."""


def fault_of(error: FlasherError) -> str:
    """What is wrong with the refusal of a file; "" if nothing is."""
    shown = str(error).replace("\n", "")
    if error.exit_code not in (ExitCode.USAGE, ExitCode.IMAGE) or not shown.isprintable():
        return f"exit code {error.exit_code}: {shown!a:.200}"
    if error.code is ErrorCode.IMAGE_READINGS:
        return f"the strict check and the library differ: {shown!a:.200}"
    return ""
