"""What the pages of a built site have: links, anchors, and what a browser would load by itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

_LOADS: Final = {
    ("img", "src"), ("img", "srcset"), ("script", "src"), ("link", "href"), ("iframe", "src"),
    ("source", "src"), ("object", "data"), ("use", "href"),
}  # fmt: skip
_OUTSIDE: Final = re.compile(r"(?:https?:)?//", re.IGNORECASE)
_CSS_LOAD: Final = re.compile(r"""(?:url\(|@import)\s*['"]?\s*((?:https?:)?//[^'")\s]+)""")


class Page(HTMLParser):
    """One page: what it leads to, what can be led to in it, and what it loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        text = path.read_text(encoding="utf-8")
        self.links: list[str] = []
        self.noted: list[str] = []
        """Those of the text, without the menus."""
        self.text = ""
        self._depth = 0
        self.anchors = {""}
        self.loads: list[str] = _CSS_LOAD.findall(text)
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._depth += tag == "article"
        for name, value in attrs:
            if name == "id":
                self.anchors.add(value or "")
            elif tag == "a" and name == "href":
                self.links.append(value or "")
                self.noted += [value or ""] * bool(self._depth)
            elif (tag, name) in _LOADS:
                self.loads.append(value or "")

    def handle_endtag(self, tag: str) -> None:
        self._depth -= tag == "article"

    def handle_data(self, data: str) -> None:
        self.text += data * bool(self._depth)


class Site:
    """All pages of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.pages = {path: Page(path) for path in sorted(self.folder.rglob("*.html"))}

    def problems(self) -> Iterator[str]:
        """Links that lead nowhere, and whatever comes from another computer."""
        for path, page in self.pages.items():
            name = path.relative_to(self.folder)
            for link in page.links:
                if self._dead(page, link):
                    yield f"{name}: leads nowhere: {link}"
            for load in page.loads:
                if _OUTSIDE.match(load):
                    yield f"{name}: loaded from outside: {load}"
                elif not load.startswith("data:") and self.target(page, load) is None:
                    yield f"{name}: not there: {load}"
        for style in self.folder.rglob("*.css"):
            for load in _CSS_LOAD.findall(style.read_text(encoding="utf-8")):
                yield f"{style.relative_to(self.folder)}: loaded from outside: {load}"

    def _dead(self, page: Page, link: str) -> bool:
        if urlsplit(link).scheme:
            return False
        target = self.target(page, link)
        if target is None:
            return True
        there = self.pages.get(target)
        return there is not None and unquote(urlsplit(link).fragment) not in there.anchors

    def target(self, page: Page, link: str) -> Path | None:
        """The file that a link or a load of a page means; None when there is none."""
        name = unquote(urlsplit(link).path)
        path = (page.path.parent / name).resolve() if name else page.path
        return path if path.is_file() and path.is_relative_to(self.folder) else None
