"""Fixtures: the command line as the tests of the commands run it."""

from __future__ import annotations

from tests.cli.conftest import bundle_folder, flasher, folders

__all__ = ["bundle_folder", "flasher", "folders"]
