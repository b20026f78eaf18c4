"""Takes a page apart for the tests, and checks what must hold for every page."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

VOID = frozenset({"meta", "br", "hr", "img", "input", "link"})
KNOWN = frozenset(
    re.findall(
        r"\w+",
        "html head meta title style body header main footer section div p h1 h2 h3 ul li dl dt dd "
        "table thead tbody tr th td span strong code pre figure figcaption details summary svg g "
        "line rect circle path text tspan desc",
    )
)
"""Every element that a page of ours is made of: none of them loads or runs anything."""


class Page(HTMLParser):
    """A parsed page. Raises AssertionError for tags that do not pair up."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        """Tag, attribute, value."""
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert not self._open, self._open

    @property
    def text(self) -> str:
        """All text outside of the style sheet, in one line."""
        return " ".join(" ".join(self.texts).split())

    @property
    def drawings(self) -> list[ET.Element]:
        """Every <svg>, read by a strict XML parser."""
        found = re.findall(r"<svg.*?</svg>", self.html, re.DOTALL)
        return [ET.fromstring(one) for one in found]  # noqa: S314  # a page of our own

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self._open, f"</{tag}> closes nothing"
        assert self._open[-1] == tag, f"</{tag}> closes <{self._open[-1]}>"
        self._open.pop()

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] != "style":
            self.texts.append(data)


def assert_self_contained(page: Page) -> None:
    """Nothing is loaded, nothing runs, and the policy forbids both."""
    assert set(page.tags) <= KNOWN, set(page.tags) - KNOWN
    names = {name for _, name, _ in page.attributes}
    assert not {name for name in names if name.startswith("on")}
    assert not names & {"href", "src", "xlink:href", "action", "srcset", "style", "data"}
    policies = [
        value for tag, name, value in page.attributes if tag == "meta" and "default-src" in value
    ]
    assert policies == [
        "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    ]
    style = re.findall(r"<style>(.*?)</style>", page.html, re.DOTALL)
    assert len(style) == 1
    assert "url(" not in style[0]
    assert "@import" not in style[0]


def assert_visible(html: str) -> None:
    """No character that hides, reorders or piles up."""
    hidden = re.findall(
        "[\x00-\x08\x0b-\x1f\x7f-\x9f\u0300-\u036f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff]",
        html,
    )
    assert not hidden
