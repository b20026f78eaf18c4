"""Every hostile file: one message, an exit code of the contract, bounded time and memory, and
nothing in its folder is another thing than before.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.campaigns.hostile_files import READERS, Campaign
from tests.hostile.files import ROWS

TIME_LIMIT_S = 4.0
"""Of the processor. 2 on an idle machine; room for a loaded one."""
MEMORY_LIMIT_MB = 300
SLICES = 4
"""So that several workers share the table."""


def state(folder: Path) -> dict[str, tuple[int, int, str]]:
    """Everything in a folder: size, time of change, and the bytes of files that are not huge."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        is_small = path.is_file() and not path.is_symlink() and status.st_size < 1 << 20
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if is_small else ""
        found[str(path)] = (status.st_size, status.st_mtime_ns, digest)
    return found


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
@pytest.mark.parametrize("part", range(SLICES))
def test_no_file_hurts_whoever_reads_it(tmp_path: Path, part: int) -> None:
    rows = ROWS[part::SLICES]
    jobs = []
    for number, row in enumerate(rows):
        folder = tmp_path / str(number)
        folder.mkdir()
        row.make(folder / row.name)
        words = [str(folder / row.name) if word == "FILE" else word for word in row.command.split()]
        jobs.append((str(folder), words))
    before = state(tmp_path)
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("child.py")],
        input=json.dumps(jobs),
        capture_output=True,
        text=True,
        check=True,
    )
    wrong = []
    for row, result in zip(rows, json.loads(done.stdout), strict=True):
        code, out, err, seconds, megabytes = result
        faults = [
            f"exit code {code}" if code != row.code else "",
            f"does not say {row.said!r}" if row.said not in out + err else "",
            f"{err.count('error: ')} messages" if err.count("error: ") != bool(code) else "",
            f"{seconds:.1f} s" if seconds > TIME_LIMIT_S else "",
            f"{megabytes:.0f} MB" if megabytes > MEMORY_LIMIT_MB else "",
        ]
        if any(faults):
            wrong.append(f"{row.command} {row.name}: {', '.join(filter(None, faults))}\n{err:.300}")
    assert not wrong, "\n".join(wrong)
    assert state(tmp_path) == before
    shutil.rmtree(tmp_path)


def test_files_damaged_at_random_are_read_or_refused(tmp_path: Path) -> None:
    """A sample of `python -m tests.campaigns.hostile_files`."""
    campaign = Campaign(tmp_path, seed=20)
    for _ in range(250):
        campaign.once()
    assert not campaign.problems
    assert {name.partition(":")[0] for name in campaign.counts} == set(READERS)
