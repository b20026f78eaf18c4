"""How Sphinx makes the site; `python -m tests.site` builds and checks it."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import flasher

project = "flasher"
author = "the flasher maintainers"
version = release = flasher.__version__

extensions = ["myst_parser", "tests.site.diagrams", "tests.site.made"]
exclude_patterns = ["_static", "pictures"]
nitpicky = True

myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]

html_theme = "furo"
html_title = f"flasher {release}"
html_static_path = ["_static"]
html_search_scorer = str(Path(__file__).with_name("scorer.js"))  # Sphinx opens it from anywhere
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_show_copyright = False
html_use_index = False
html_theme_options = {"navigation_with_keys": True}
