"""What is held of the site is found where it does not hold."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from tests.site import __main__ as command
from tests.site.pages import Site
from tests.site.questions import QUESTIONS, unanswered, ways


def site(folder: Path, **pages: str) -> Site:
    """A site of these texts, by the names of their pages."""
    for name, text in pages.items():
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return Site(folder)


def test_dead_links_and_whatever_comes_from_elsewhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "s.css").write_text("@import url('https://fonts.example/f.css');")
    built = site(
        tmp_path,
        index='<a href="other.html#there">1</a> <a href="other.html#gone">2</a>'
        '<a href="absent.html">3</a> <a href="https://example.org">4</a>'
        '<script src="https://cdn.example/x.js"></script><img src="absent.png">'
        '<link rel="stylesheet" href="s.css">',
        other='<h1 id="there"></h1><style>b { background: url(//far.example/b.png) }</style>',
    )
    assert sorted(built.problems()) == [
        "index.html: leads nowhere: absent.html",
        "index.html: leads nowhere: other.html#gone",
        "index.html: loaded from outside: https://cdn.example/x.js",
        "index.html: not there: absent.png",
        "other.html: loaded from outside: //far.example/b.png",
        "s.css: loaded from outside: https://fonts.example/f.css",
    ]


def test_a_way_goes_by_links_in_the_text_and_not_by_a_menu(tmp_path: Path) -> None:
    built = site(
        tmp_path,
        index='<nav><a href="far.html">x</a></nav><article><a href="near.html">x</a></article>',
        near='<article><a href="far.html">x</a></article>',
        far="<article></article>",
    )
    near, far = (tmp_path / name for name in ("near.html", "far.html"))
    assert ways(built)[far] == [near, far]
    assert len(list(unanswered(built))) == len(QUESTIONS)


def test_a_folder_that_is_no_site_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    with pytest.raises(SystemExit, match="something else than a site"):
        command.build(tmp_path)
    assert (tmp_path / "precious.txt").exists()


def test_the_same_pages_make_the_same_archive(tmp_path: Path) -> None:
    pages = tmp_path / "pages"
    pages.mkdir()
    site(pages, index="<p>x</p>")
    archives = [tmp_path / "plant" / name for name in ("a.zip", "b.zip")]
    for archive in archives:
        command.pack(pages, archive)
    assert archives[0].read_bytes() == archives[1].read_bytes()
    with zipfile.ZipFile(archives[0]) as packed:
        assert packed.namelist() == ["flasher-site/index.html"]
