"""Archive pages: flash history, bundles, backups and explained traces of this computer.

Processes of their own render them (`flasher.web.query_processes`), so that no upgrade waits.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from flasher.errors import ErrorCode, FlasherError, UsageError
from flasher.history import FlashHistory, matching
from flasher.protocol.text import printable
from flasher.report.base import visible
from flasher.report.explain_page import story_context
from flasher.trace.bundle import bundles
from flasher.trace.source import explain_path, recorded_of
from flasher.translation import translator
from flasher.web.pages import page_text
from flasher.web.query_processes import HTML, Answer, Question

SHOWN_MAX: Final = 50
"""Maximum number of flashes, and of files of one kind, on a page."""
_ZIP: Final = "application/zip"


class ArchivedFile(NamedTuple):
    """A bundle or a backup."""

    name: str
    at: datetime
    size_bytes: int
    what: str = ""
    """Reason why the bundle was written."""


@dataclass(frozen=True)
class Archive:
    """Renders the archive pages. `bundles`, `backups` and `traces` are folders; the last one holds
    files dropped on the page.
    """

    bundles: Path
    backups: Path
    traces: Path

    def answer(self, question: Question) -> Answer:
        """Render a page or return a file; an error page if there is none."""
        try:
            return PAGES[question.path](self, question)
        except FlasherError as error:
            return self._page(question, "trouble.html", http=400, error=error)
        except OSError as error:
            trouble = UsageError(
                f"A file cannot be read: {error.strerror or error}.", code=ErrorCode.FILE_NOT_READ
            )
            return self._page(question, "trouble.html", http=400, error=trouble)

    def _page(
        self, question: Question, template: str, *, http: int = 200, **context: Any
    ) -> Answer:
        text = page_text(
            template,
            translator(question.language),
            question.token,
            layout="bench_layout.html",
            **context,
        )
        return Answer(text.encode("utf-8", "backslashreplace"), HTML, http)

    def overview(self, question: Question) -> Answer:
        """History, bundles and backups, latest first."""
        history = FlashHistory()
        flashes, damaged = history.flashes()
        serial = question.fields.get("serial", "")
        found = list(matching(flashes, target=None, serial_number=serial))
        left = {str(path): path.name for path in bundles(self.bundles)}
        return self._page(
            question,
            "kept.html",
            history=printable(str(history.path)),
            serial=serial,
            flashes=list(islice(reversed(found), SHOWN_MAX)),
            total=len(found),
            damaged=damaged,
            bundle_of=left,
            bundles=[_bundle(path) for path in reversed(bundles(self.bundles)[-SHOWN_MAX:])],
            bundles_in=printable(str(self.bundles)),
            backups=[_file(path) for path in reversed(self._backups()[-SHOWN_MAX:])],
            backups_in=printable(str(self.backups)),
        )

    def story(self, question: Question) -> Answer:
        """The explanation of a bundle or a dropped trace."""
        if "bundle" in question.fields:
            path = self._bundle(question.fields["bundle"])
        else:
            name = question.fields.get("trace", "")
            path = _known({each.name: each for each in _files(self.traces)}, name)
        try:
            story = explain_path(path)
        except FlasherError as error:
            error.what = error.what.replace(printable(str(path)), printable(path.name))
            raise
        named = replace(story, source=visible(path.name))
        return self._page(
            question, "explain.html", **story_context(named, translator(question.language))
        )

    def bundle(self, question: Question) -> Answer:
        """Download of a bundle as one file."""
        path = self._bundle(question.fields.get("name", ""))
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for each in _files(path):
                archive.write(each, f"{path.name}/{each.name}")
        return Answer(packed.getvalue(), _ZIP, file_name=f"{path.name}.zip")

    def backup(self, question: Question) -> Answer:
        found = {each.name: each for each in self._backups()}
        path = _known(found, question.fields.get("name", ""))
        return Answer(path.read_bytes(), _ZIP, file_name=path.name)

    def _bundle(self, name: str) -> Path:
        return _known({each.name: each for each in bundles(self.bundles)}, name)

    def _backups(self) -> list[Path]:
        """Backups, latest last."""
        found = [each for each in _files(self.backups) if each.suffix == ".zip"]
        return sorted(found, key=lambda each: each.stat().st_mtime_ns)


PAGES: Final[Mapping[str, Callable[[Archive, Question], Answer]]] = {
    "/kept": Archive.overview,
    "/kept/story": Archive.story,
    "/kept/bundle": Archive.bundle,
    "/kept/backup": Archive.backup,
}
"""Routes of the pages, with their methods."""


def _files(folder: Path) -> list[Path]:
    return sorted(each for each in folder.iterdir() if each.is_file()) if folder.is_dir() else []


def _file(path: Path) -> ArchivedFile:
    found = path.stat()
    at = datetime.fromtimestamp(found.st_mtime).astimezone()
    return ArchivedFile(path.name, at, found.st_size)


def _bundle(path: Path) -> ArchivedFile:
    size_bytes = sum(each.stat().st_size for each in _files(path))
    try:
        recorded = recorded_of(path)
    except FlasherError as error:
        return _file(path)._replace(size_bytes=size_bytes, what=error.what)
    return _file(path)._replace(size_bytes=size_bytes, what=recorded.error.partition(" | ")[0])


def _known(found: Mapping[str, Path], name: str) -> Path:
    """Look up a listed name, so that no other file is read. Raises UsageError."""
    path = found.get(name)
    if path is None:
        raise UsageError(f"{printable(name)} no longer exists.", remedy="Reload the previous page.")
    return path
