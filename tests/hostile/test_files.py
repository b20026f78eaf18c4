"""A sample of `python -m tests.campaigns.hostile_files`: one message, an exit code of the contract,
bounded time and memory, and nothing in its folder is another thing than before.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.campaigns.hostile_files import READERS, Campaign, run_rows
from tests.hostile.files import COSTLY, ROWS, SAMPLE

pytestmark = pytest.mark.slow


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_no_file_hurts_whoever_reads_it(tmp_path: Path) -> None:
    wrong = run_rows(SAMPLE, tmp_path)
    assert not wrong, "\n".join(wrong)
    shutil.rmtree(tmp_path)


def test_the_sample_leaves_out_the_costly_rows_alone() -> None:
    assert {row.name for row in ROWS} - {row.name for row in SAMPLE} == COSTLY


def test_files_damaged_at_random_are_read_or_refused(tmp_path: Path) -> None:
    campaign = Campaign(tmp_path, seed=20)
    for _ in range(250):
        campaign.once()
    assert not campaign.problems
    assert {name.partition(":")[0] for name in campaign.counts} == set(READERS)
