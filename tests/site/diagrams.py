"""Draws the Mermaid diagrams of the documents while the site is built.

A code host draws them itself; the site reads offline, so that its pictures are in its pages.
"""

from __future__ import annotations

import hashlib
from typing import Final

import mmdr
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

_ID: Final = "merman"
"""What the drawing reports, in its style sheet too: two on a page need two names."""


def _draw(_app: Sphinx, document: nodes.document) -> None:
    for block in list(document.findall(nodes.literal_block)):
        if block.get("language") != "mermaid":
            continue
        source = block.astext()
        name = f"d{hashlib.sha256(source.encode()).hexdigest()[:8]}"
        svg = mmdr.render(source).svg().replace(_ID, name)
        block.replace_self(nodes.raw("", f'<div class="diagram">{svg}</div>', format="html"))


def setup(app: Sphinx) -> ExtensionMetadata:
    app.connect("doctree-read", _draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
