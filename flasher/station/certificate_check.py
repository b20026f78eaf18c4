"""Checks the signature of a certificate, and compares it with the run in the records.

A certificate is the HTML file that flasher wrote, a PDF of it that a browser printed, the lines of
its signed content, or the text of its QR code.
"""

from __future__ import annotations

import io
import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime
from html.parser import HTMLParser
from typing import Final

from pydantic import ValidationError

from flasher import __version__
from flasher.errors import UsageError
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.station.certificate import EARLIER_SHOWN, code_lines, render_certificate
from flasher.station.records.errors import NotFoundError, UnprovenError
from flasher.station.records.model import RunId, RunRecord
from flasher.station.records.signatures import fingerprint, is_signed
from flasher.station.records.store import Store
from flasher.station.sealed import CheckedCertificate, Sealed, plain, sealed_in
from flasher.translation import NAMES

_PDF: Final = b"%PDF-"
_CODE: Final = re.compile(r"flasher record 1\n(?:[^\n]+\n){7}key [0-9a-f]{64}")
_LANGUAGE: Final = re.compile(r'<html lang="(\w+)">')
_AROUND: Final = 24
_EDGE_LINES: Final = 4
_HIDDEN: Final = frozenset({"style", "script", "title", "svg"})


def check_certificate(store: Store, data: bytes) -> CheckedCertificate:
    """Check the bytes of a file. Raises UsageError for a file that is not a certificate,
    UnprovenError for signed content that cannot be read, and RecordError.
    """
    is_pdf = data.startswith(_PDF)
    pages = list(_pages_of_pdf(data)) if is_pdf else []
    page_text = "\n".join(pages) if is_pdf else data.decode("utf-8", "replace")
    code = _CODE.search(page_text.replace("\r\n", "\n").strip())
    if code is not None:
        return _check_code(store, code[0])
    sealed = sealed_in(page_text)
    try:
        problems = sealed.wrong()
        life = sealed.life()
        made_at = datetime.fromisoformat(sealed.made_at)
        expected = [
            render_certificate(life, made_at, sealed, language)
            for language in _languages(page_text)
        ]
        where = _difference_of_page(_closest(expected, page_text), data, pages)
    except (ValidationError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise UnprovenError(
            text("The certificate was changed: its signed content is not a run."),
            remedy=text("Request the certificate again."),
        ) from error
    if where:
        problems.append(text("its page was changed: {where}", where=where))
        if sealed.flasher != __version__:
            problems.append(
                text(
                    "it was made by flasher {other}, and this is {version}: check the page with"
                    " that version",
                    other=printable(sealed.flasher),
                    version=__version__,
                )
            )
    found, remarks = _in_records(store, sealed)
    moment = f"{made_at:%Y-%m-%d %H:%M} UTC"
    run, problems = life.runs[-1].run, [*problems, *found]
    return _checked(run, problems, sealed.station, sealed.key, moment, remarks)


def _checked(
    run: RunRecord,
    problems: Iterable[str],
    station: str,
    key: str,
    made_at: str = "",
    remarks: tuple[str, ...] = (),
) -> CheckedCertificate:
    shown = "none"
    with suppress(ValueError):
        shown = fingerprint(key)
    return CheckedCertificate(
        run.serial, run.part, run.state, int(run.run_id), station, shown, made_at,
        tuple(problems), remarks,
    )  # fmt: skip


# -- comparison with the records -------------------------------------------------------------------


def _in_records(store: Store, sealed: Sealed) -> tuple[list[str], tuple[str, ...]]:
    """Compare a certificate with the records. Returns problems, and remarks on later runs."""
    run_id = RunId(sealed.row["run_id"])
    head = store.read.head_of(run_id)
    if head is None or (head.station, head.number, head.hash) != (
        sealed.station, sealed.row["number"], sealed.row["hash"],
    ):  # fmt: skip
        return [text("the run is not in these records")], ()
    problems: list[str] = []
    if head.key != sealed.key:
        problems.append(text("it is not signed with the key that the station had in these records"))
    problems += _in_run(store, run_id)
    if problems:
        return problems, ()
    last = store.read.run(run_id)
    if sealed.life().last != last:
        problems.append(text("its run differs from the run in the records"))
    if run_id in store.read.released() and not sealed.is_released:
        problems.append(text("the unit may have passed at another station, which was found later"))
    runs = [each.run for each in store.read.unit(last.run.serial, last.run.part).runs]
    before = [plain(run) for run in runs if run.run_id < run_id]
    stated = [dict(each) for each in sealed.earlier]
    if before[-EARLIER_SHOWN:] != stated or sealed.earlier_left_out != max(
        0, len(before) - EARLIER_SHOWN
    ):
        problems.append(text("its earlier runs of the unit differ from those in the records"))
    later = [run for run in runs if run.run_id > run_id]
    remarks: tuple[str, ...] = tuple(
        text(
            "the unit had a later run: {run}, {day}, {state}",
            run=run.run_id,
            day=f"{run.begun_at:%Y-%m-%d}",
            state=run.state.value,
        )
        for run in later[-1:]
    )
    return problems, remarks


def _in_run(store: Store, run_id: RunId) -> list[str]:
    return [
        text("{where} in the records: {what}", where=each.where, what=each.what)
        for each in store.examine_run(run_id).problems
    ]


def _check_code(store: Store, code_text: str) -> CheckedCertificate:
    """Check the text of a QR code: run number, hashes and signature."""
    run_line = re.search(r"\nrun (\d{1,18}) ", code_text)
    try:
        run_id = RunId(int(run_line[1])) if run_line else RunId(0)
        details = store.read.run(run_id)
    except NotFoundError as error:
        raise UnprovenError(
            text("The run of this code is not in these records."),
            cause="the code belongs to other records, or was changed",
        ) from error
    problems: list[str] = []
    head = store.read.head_of(run_id)
    if head is None:
        problems.append(text("the run is not signed in these records"))
    else:
        expected = code_lines(details, store.read.record_sha256(run_id), head)
        lines = code_text.split("\n")
        problems += [
            text(
                "the code has '{code}', the records have '{line}'",
                code=printable(code),
                line=printable(line),
            )
            for line, code in zip(expected, lines, strict=True)
            if line != code
        ]
        if not is_signed(head.hash, head.signature, head.key):
            problems.append(text("the signature in the records is not that of the station's key"))
    problems += _in_run(store, run_id)
    station, key = (head.station, head.key) if head else ("", "")
    return _checked(details.run, problems, station, key)


# -- the page --------------------------------------------------------------------------------------


def _languages(page_text: str) -> Iterable[str]:
    """Possible languages of the page; a print does not contain its language."""
    named = _LANGUAGE.search(page_text)
    return (named[1],) if named and named[1] in NAMES else NAMES


def _closest(pages: Sequence[str], page_text: str) -> str:
    """The page with the most words of the file."""
    words = set(page_text.split())
    return max(pages, key=lambda page: len(words & set(" ".join(_parsed(page).text).split())))


def _difference_of_page(page: str, data: bytes, prints: list[str]) -> str:
    """Where the file, or a page of the PDF, differs from the expected page; "" if nowhere, or for
    signed lines alone.
    """
    if prints:
        return _difference_of_print(page, prints)
    if page.encode("utf-8") == data or b"<html" not in data:
        return ""
    return _difference(_text_of(page), _text_of(data.decode("utf-8", "replace")))


class _Text(HTMLParser):
    """Extracts the visible text of a page and the headings of its tables."""

    def __init__(self) -> None:
        super().__init__()
        self.text: list[str] = []
        self.heads: list[str] = []
        self._hidden = 0
        self._is_head = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self._hidden += tag in _HIDDEN
        if tag == "thead":
            self._is_head = True
            self.heads.append("")

    def handle_endtag(self, tag: str) -> None:
        self._hidden -= tag in _HIDDEN
        self._is_head = self._is_head and tag != "thead"

    def handle_data(self, data: str) -> None:
        if not self._hidden:
            self.text.append(data)
            if self._is_head:
                self.heads[-1] += data


def _parsed(page: str) -> _Text:
    parser = _Text()
    parser.feed(page)
    return parser


def _text_of(page: str) -> str:
    return _bare("".join(_parsed(page).text))


def _bare(text: str) -> str:
    """Remove spaces, line breaks and ligatures, which printing may change."""
    return re.sub(r"\s", "", unicodedata.normalize("NFKC", text))


def _difference(expected: str, found: str) -> str:
    """Describe the first difference of two texts."""
    if expected == found:
        return text("its text is the same, but its markup differs")
    at = next(
        (at for at, pair in enumerate(zip(expected, found, strict=False)) if pair[0] != pair[1]),
        min(len(expected), len(found)),
    )
    begin = max(0, at - _AROUND)
    shown, signed = (printable(each[begin : at + _AROUND]) for each in (found, expected))
    return text("it shows '{shown}', the station signed '{signed}'", shown=shown, signed=signed)


def _difference_of_print(page: str, pages: list[str]) -> str:
    """Describe the first difference of a print from its page; "" without one. Lines that a browser
    prints at the edges, and repeated headings of tables, are ignored.
    """
    parser = _parsed(page)
    expected = _bare("".join(parser.text))
    heads = [_bare(each) for each in parser.heads]
    title = re.search(r"<title>(.*?)</title>", page, re.DOTALL)
    edge = _edge(title[1] if title else "")
    found = ""
    for number, printed in enumerate(pages):
        lines = printed.strip().split("\n")
        for _ in range(_EDGE_LINES):
            if lines and edge.fullmatch(lines[0].strip()):
                del lines[0]
            if lines and edge.fullmatch(lines[-1].strip()):
                del lines[-1]
        more = _bare("".join(lines))
        for head in heads if number else ():
            if more.startswith(head) and not expected.startswith(head, len(found)):
                more = more.removeprefix(head)
                break
        found += more
    return "" if expected == found else _difference(expected, found)


def _edge(title: str) -> re.Pattern[str]:
    """Matches lines that a browser prints at the edges: date, title, address, page."""
    escaped = re.escape(unicodedata.normalize("NFKC", title))
    return re.compile(rf"(?:[\d/.,:\- ]+|AM|PM|{escaped}|about:blank|\w{{2,5}}://\S+|\d+/\d+|\s)+")


def _pages_of_pdf(data: bytes) -> Iterator[str]:
    """Text of each page. Raises UsageError for an unreadable file."""
    from pypdf import PdfReader  # noqa: PLC0415  only for a PDF
    from pypdf.errors import PyPdfError  # noqa: PLC0415

    try:
        for page in PdfReader(io.BytesIO(data)).pages:
            yield unicodedata.normalize("NFKC", page.extract_text())
    except (PyPdfError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
        raise UsageError(
            text("The PDF cannot be read."),
            remedy=text("Print the certificate to a PDF in a browser, or name its HTML file."),
        ) from error
