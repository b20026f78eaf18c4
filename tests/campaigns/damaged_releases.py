"""Damages a good release by chance, again and again: `python -m tests.campaigns.damaged_releases`.

Each one has to be refused by an error of flasher's own, or to give the bytes that were signed. It
prints how often each code came, and ends with 1 and the seed of what broke.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.release.mutations import good, mutated, verdict


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    given = parser.parse_args()
    codes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in ("CONFIG_HOME", "CONFIG_DIRS", "DATA_HOME"):
            os.environ[f"XDG_{name}"] = f"{folder}/{name}"
        whole = good()
        for seed in range(given.seed, given.seed + given.count):
            try:
                codes[verdict(mutated(whole, seed), Path(folder) / "x.wfw")] += 1
            except Exception as error:  # noqa: BLE001  what it looks for
                print(f"seed {seed}: {type(error).__name__}: {error}")  # noqa: T201
                return 1
    print(", ".join(f"{code}: {count}" for code, count in codes.most_common()))  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
