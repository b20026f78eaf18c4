"""Draws charts as SVG page markup with pygal.

Styles, scripts and names from pygal are removed, so that no browser policy has to allow them: the
pages' style sheet colours a chart, in light and dark. It shows one of two drawings, so that text
has its full size on desktops and phones.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.etree import ElementTree

import pygal
from markupsafe import Markup
from pygal.style import Style

from flasher.report.base import shortened, visible
from flasher.report.chart import WIDTHS
from flasher.report.scale import linear_ticks

# Remove pygal's finder of maps, not used here: Python 3.11 warns of it at every import.
sys.meta_path[:] = [each for each in sys.meta_path if not isinstance(each, pygal.PluginImportFixer)]

SERIES_MAX: Final = 8
"""Number of colours in the style sheet."""
_HEIGHT: Final = 300
_PX_PER_LABEL: Final = 36
_PX_PER_CHARACTER: Final = 8
_LEFT: Final = 60
_Y_INTERVALS: Final = 5
_LABEL_MAX: Final = 18
_STYLE: Final = Style(
    label_font_size=12, major_label_font_size=12, font_family="system-ui, sans-serif"
)
_DROPPED: Final = frozenset({"style", "script", "defs", "title", "desc"})
_OVERLAYS: Final = frozenset({"tooltip", "text-overlay", "tooltip-overlay", "titles"})
_KEPT: Final = frozenset(
    ["viewBox", "x", "y", "x1", "x2", "y1", "y2", "width", "height", "d", "cx", "cy", "r", "rx",
     "ry", "points", "transform", "class"]
)  # fmt: skip

Series = Mapping[str, Sequence[float | None]]


def lines(title: str, labels: Sequence[str], series: Series, unit: str) -> Markup:
    """Line chart of percentages over shared labels, from the ten below the least value up."""
    least = min(value for values in series.values() for value in values if value is not None)
    return _drawn(title, labels, series, pygal.Line, (min(90, least // 10 * 10), 100), unit)


def stacked_bars(title: str, labels: Sequence[str], series: Series) -> Markup:
    """Stacked bar chart with a bar for each label."""
    most = max(sum(each or 0 for each in bar) for bar in zip(*series.values(), strict=True))
    return _drawn(title, labels, series, pygal.StackedBar, (0, most))


def _drawn(
    title: str,
    labels: Sequence[str],
    series: Series,
    kind: Any,
    span: tuple[float, float],
    unit: str = "",
) -> Markup:
    drawings = []
    shown = [visible(shortened(label, _LABEL_MAX)) for label in labels]
    ticks = [each for each in linear_ticks(*span, _Y_INTERVALS) if each == int(each)]
    longest = max(map(len, shown))
    for name, width in WIDTHS.items():
        is_level = len(shown) * longest * _PX_PER_CHARACTER <= width - _LEFT
        upright_room = max(1, (width - _LEFT) // _PX_PER_LABEL)
        chart = kind(
            width=width, height=_HEIGHT, style=_STYLE, css=(), js=(), show_legend=False,
            margin=8, dots_size=3, x_label_rotation=0 if is_level else 50,
            show_minor_x_labels=False, truncate_label=-1, range=(ticks[0], ticks[-1]),
            x_labels_major_every=1 if is_level else max(1, -(-len(shown) // upright_room)),
        )  # fmt: skip
        chart.x_labels = shown
        chart.y_labels = [{"value": each, "label": f"{each:,.0f}{unit}"} for each in ticks]
        for label, values in series.items():
            chart.add(visible(label), list(values))
        tree = chart.render_tree()
        _strip(tree)
        tree.attrib.update({"role": "img", "aria-label": visible(title)})
        svg = ElementTree.tostring(tree, encoding="unicode")
        drawings.append(f'<div class="chart {name}">{svg}</div>')
    return Markup("".join(drawings))  # noqa: S704  ElementTree has escaped every text


def _strip(element: Any) -> None:
    """Keep shapes, texts, positions and classes; remove all else."""
    for child in list(element):
        names = set((child.get("class") or "").split())
        if not isinstance(child.tag, str) or child.tag in _DROPPED or names & _OVERLAYS:
            element.remove(child)
            continue
        _strip(child)
    for name in set(element.attrib) - _KEPT:
        del element.attrib[name]
