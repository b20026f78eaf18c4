from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING

import pytest

from tests.conftest import NO_SKIPS

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

if find_spec("axe_playwright_python") is None and not os.environ.get(NO_SKIPS):
    # They drive a browser with what the extra `dev` brings, and are all of the second lane.
    collect_ignore = [f"test_{of}.py" for of in (
        "bench_page", "login_pages", "operator_page", "supervisor_pages"
    )]  # fmt: skip


@dataclass
class Tab:
    """A page, what it has asked for, and what went wrong in it."""

    page: Page
    asked: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Closed before tests of other folders: Playwright's loop counts as running in this thread
    until then, and `asyncio.run` fails.
    """
    from tests.web.browser import chromium  # noqa: PLC0415  needs Playwright

    with chromium() as started:
        yield started


@pytest.fixture(scope="package")
def only_tab(browser: Browser) -> Iterator[Tab]:
    context = browser.new_context(locale="en")
    tab = Tab(context.new_page())
    context.on("request", lambda request: tab.asked.append(request.url))
    tab.page.on("pageerror", lambda error: tab.wrong.append(str(error)))
    tab.page.on(
        "console", lambda reported: tab.wrong.extend([reported.text] * (reported.type == "error"))
    )
    yield tab
    context.close()


@pytest.fixture
def tab(only_tab: Tab) -> Iterator[Tab]:
    """The tab, with nothing of the test before: one of its own costs more than most tests do."""
    page = only_tab.page
    page.goto("about:blank")
    page.context.clear_cookies()
    page.set_viewport_size({"width": 1280, "height": 800})
    page.emulate_media(media="screen", color_scheme="light")
    only_tab.asked.clear()
    only_tab.wrong.clear()
    yield only_tab
    page.unroute_all()
