"""Damaged releases are refused by errors of flasher's own; a sample of the campaign."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.release.mutations import good, mutated, verdict


@pytest.mark.slow
def test_a_damaged_release_is_refused_by_an_error_of_our_own(tmp_path: Path) -> None:
    whole = good()
    assert verdict(whole, tmp_path / "x.wfw") == "taken"
    codes = {verdict(mutated(whole, seed), tmp_path / "x.wfw") for seed in (*range(60), 586)}
    assert "E311" in codes
    assert len(codes) >= 3
