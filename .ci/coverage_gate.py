"""Fails when a package of engines has less than 95 % of its branches covered by the tests."""

import json
import sys
from pathlib import Path

GATE_PERCENT = 95.0
PACKAGES = ("flasher/protocol", "flasher/image", "flasher/host", "flasher/mock")


def main(report: str) -> int:
    """Print the figures of each package; 1 when one is below the gate."""
    files = json.loads(Path(report).read_text())["files"]
    failed = False
    for package in PACKAGES:
        summaries = [
            entry["summary"]
            for name, entry in files.items()
            if Path(name).as_posix().startswith(package)
        ]
        branches = sum(summary["num_branches"] for summary in summaries)
        covered = sum(summary["covered_branches"] for summary in summaries)
        percent = 100.0 * covered / branches if branches else 0.0
        verdict = "ok" if percent >= GATE_PERCENT else f"below {GATE_PERCENT:g} %"
        print(f"{package:<18} {covered:>5} of {branches:>5} branches  {percent:6.2f} %  {verdict}")
        failed = failed or percent < GATE_PERCENT
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
