"""What axe-core finds on a page."""

from __future__ import annotations

from axe_playwright_python.base import AXE_SCRIPT, AxeResults
from playwright.sync_api import Page


def barriers(page: Page) -> str:
    """A report of what bars somebody from the page; empty where nothing does."""
    if not page.evaluate("'axe' in window"):  # half of its time is the loading of its script
        page.evaluate(AXE_SCRIPT)
    options = '{"resultTypes": ["violations"]}'
    violations = page.evaluate(f"axe.run({options}).then(found => found.violations)")
    found = AxeResults({"violations": violations})
    return str(found.generate_report()) if violations else ""
