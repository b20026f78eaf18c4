"""A real browser: Debian's chromium, driven by Playwright. Where it is missing, its tests are
skipped.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, sync_playwright

_CHROMIUM = shutil.which("chromium-headless-shell") or shutil.which("chromium")
"""The shell needs about half the processor time of the whole browser."""
_ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--autoplay-policy=no-user-gesture-required",
    # One process draws all pages, instead of a new one for most of them: half the processor time.
    "--in-process-gpu",
    "--disable-site-isolation-trials",
    "--renderer-process-limit=1",
)


@contextmanager
def chromium() -> Iterator[Browser]:
    """A browser while the block runs; skips the test where there is none."""
    if _CHROMIUM is None:
        pytest.skip("needs chromium (Debian: apt-get install chromium-headless-shell)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=_CHROMIUM,
            args=_ARGUMENTS,
        )
        try:
            yield browser
        finally:
            browser.close()
