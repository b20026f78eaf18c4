"""Runs every block of every page, also those that take long.

python -m tests.documents [PAGE ...]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
from pathlib import Path

from tests.documents.test_documents import FOLLOWED, follow


def run(names: list[str]) -> int:
    """Follow these pages, or all; returns how many are wrong."""
    wrong = 0
    for page in names or FOLLOWED:
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            try:
                follow(FOLLOWED[page], Path(folder), patient=True)
            except Exception:  # noqa: BLE001  of a page, whatever it is
                wrong += 1
                traceback.print_exc(limit=0)
        sys.stdout.write(f"{page}: {time.perf_counter() - began:.1f} s\n")
    return wrong


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Do everything that the documents say.")
    parser.add_argument("page", nargs="*", choices=[*FOLLOWED, []], metavar="PAGE")
    sys.exit(1 if run(parser.parse_args().page) else 0)
