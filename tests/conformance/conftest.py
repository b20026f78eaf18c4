"""Fixtures of the suite's tests: the command line as the tests of the commands run it."""

from __future__ import annotations

from tests.cli.conftest import flasher

__all__ = ["flasher"]
