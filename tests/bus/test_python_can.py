"""python-can is imported without what only a file format needs."""

from __future__ import annotations

import subprocess
import sys

import pytest

_PROGRAM = """
import sys
import flasher.bus.adapter, flasher.trace.reader
assert "asammdf" not in sys.modules
from can import MF4Reader
from flasher.python_can import load_mf4
load_mf4()
assert "asammdf" in sys.modules
try:
    MF4Reader("no-such-file.mf4")
except NotImplementedError:
    sys.exit("the class that python-can handed out does not see the package")
except Exception:
    pass
"""


@pytest.mark.slow
def test_asammdf_is_imported_for_its_files_only() -> None:
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    subprocess.run([sys.executable, "-c", _PROGRAM], check=True)
