"""The tests that take a sample in the gate, with the whole of it: `python -m tests.campaigns.sweeps
[ARGUMENTS OF PYTEST]`; without a path, all of them.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest

from tests.loops import SWEEPS

_TESTS = Path(__file__).parents[1]
_TAKES_A_SAMPLE = re.compile(r"^from tests\.loops import .*\bsample\b", re.MULTILINE)


def main(arguments: list[str]) -> int:
    """Run them; the exit code of pytest."""
    os.environ[SWEEPS] = "1"
    paths = [
        str(path)
        for path in sorted(_TESTS.rglob("test_*.py"))
        if _TAKES_A_SAMPLE.search(path.read_text("utf-8"))
    ]
    has_path = any(Path(each.partition("::")[0]).exists() for each in arguments)
    return int(pytest.main(["--timeout=0", *arguments, *([] if has_path else paths)]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
