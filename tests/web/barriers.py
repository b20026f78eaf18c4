"""What axe-core finds on a page."""

from __future__ import annotations

from axe_playwright_python.base import AXE_SCRIPT, AxeResults
from playwright.sync_api import Page

_OF_LOOKS = '"color-contrast", "scrollable-region-focusable"'
"""The rules whose result depends on colours and widths."""


def barriers(page: Page, *, looks_alone: bool = False) -> str:
    """A report of what bars somebody from the page; empty where nothing does. With `looks_alone`,
    of what differs by colours and widths: for a page that was examined in others.
    """
    if not page.evaluate("'axe' in window"):  # half of its time is the loading of its script
        page.evaluate(AXE_SCRIPT)
    rules = f'"runOnly": {{"type": "rule", "values": [{_OF_LOOKS}]}},' if looks_alone else ""
    options = f'{{{rules} "resultTypes": ["violations"]}}'
    violations = page.evaluate(f"axe.run({options}).then(found => found.violations)")
    found = AxeResults({"violations": violations})
    return str(found.generate_report()) if violations else ""
