"""Brings the catalogues of the pages up to date with what the code says:
`python -m tests.catalogue`. A new sentence is added without a translation, and the test fails until
it has one; a sentence that is not used any more is dropped.
"""

from __future__ import annotations

import itertools
import string
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from babel.messages.catalog import Catalog, Message
from babel.messages.extract import extract
from babel.messages.pofile import read_po, write_po

from flasher.events import Phase
from flasher.host.identity import IdentityCheck
from flasher.host.items import meaningful_fields
from flasher.host.outcome import (
    _EXPLANATIONS,
    _NO_SESSION_EITHER,
    _TWO_PERHAPS_ERASED,
    AGAIN,
    DeviceLeft,
    _late,
)
from flasher.protocol.catalogue import ITEMS
from flasher.protocol.contents import BatteryFault, BatteryStatus
from flasher.protocol.fields import FlagsField, flag_names, label
from flasher.protocol.messages import BootVersion, Packet, UpdateCommand
from flasher.report.chart import MarkKind
from flasher.station.records.chain import NAMED, OWN, RowFault
from flasher.station.records.errors import NOT_SAVED
from flasher.station.records.model import (
    AFTER_RESTART,
    BY_POWER,
    COUNTER,
    POWER_CYCLES,
    PRODUCT,
    SIGNATURE,
    RunKind,
    StepName,
    StepState,
    Verified,
)
from flasher.station.scans import Word
from flasher.trace.decoder import message_titles
from flasher.translation import NAMES
from flasher.wording import _EXPLANATIONS as _CAUSES
from flasher.wording import _TEXTS
from tests.sentences import spoken

_SYSTEM: Final = (
    "Address already in use",
    "Address family not supported by protocol",
    "Connection refused",
    "Connection timed out",
    "Device or resource busy",
    "Is a directory",
    "Network is down",
    "No route to host",
    "No space left on device",
    "No such device",
    "No such device or address",
    "No such file or directory",
    "Operation not permitted",
    "Permission denied",
    "Read-only file system",
)
"""Errors of Linux that users meet."""
_SHOWN: Final = (RunKind, StepName, StepState, MarkKind, RowFault)
"""Enumerations whose values are shown."""
ROOT: Final = Path(__file__).parent.parent / "flasher"
FOLDER: Final = ROOT / "locale"
LANGUAGES: Final = tuple(code for code in NAMES if code != "en")


def sentences() -> Iterator[str]:
    """Every sentence of the code and of the pages that is shown in the reader's language."""
    for path in sorted(ROOT.rglob("*.py")):
        if b"flasher.i18n" in path.read_bytes():  # `text` of SQLAlchemy is another function
            yield from _marked("python", path, "text")
    for path in sorted(ROOT.glob("**/templates/*.html")):
        yield from _marked("jinja2.ext:babel_extract", path, "_")
    yield from spoken()
    yield from (text for texts in _TEXTS.values() for text in texts.values())
    yield from (text for each in _CAUSES.values() for text in each if text)
    yield from (each.value for kind in _SHOWN for each in kind)
    yield from (each.short for each in MarkKind)
    yield from (each.words for each in Verified)
    yield from (
        "flash {target}",
        "once",
        "twice",
        "Then",
        "Here the tool ended",
        "silence",
        "reason",
        "data",
        "not answered",
    )
    yield from (NOT_SAVED, "[Errno {number}] {error}")
    yield from (POWER_CYCLES, AFTER_RESTART, BY_POWER, *NAMED.values(), *OWN.values())
    yield from ("it was removed", "it was added", "it was changed", "before {measurement}")
    yield from _SYSTEM
    named = ("model", "serial number", "hardware version", "firmware version")
    yield from (f"{{target}} {word}" for word in (*named, *(each.value for each in IdentityCheck)))
    yield from (f"{{target}} {word}" for word in (SIGNATURE, COUNTER, PRODUCT))
    layouts = (BootVersion.LAYOUT, Packet.LAYOUT, UpdateCommand.LAYOUT)
    yield from (label(*each) for layout in layouts for each in layout)
    explained = [
        *_EXPLANATIONS.values(),
        _NO_SESSION_EITHER,
        _TWO_PERHAPS_ERASED,
        *itertools.starmap(_late, itertools.product(Phase, DeviceLeft)),
    ]
    for each in explained:
        yield from filter(None, (each.cause, each.remedy))
    yield AGAIN
    yield from message_titles()
    for item in ITEMS:
        for name, codec in meaningful_fields(item.content):
            yield label(name, codec)
            if isinstance(codec, FlagsField):
                yield codec.none
    yield from flag_names(BatteryFault, sum(BatteryFault))
    yield from flag_names(BatteryStatus, sum(BatteryStatus))
    yield from ("label", *(word.value.lower() for word in Word))  # what a scan means


def _marked(method: str, path: Path, keyword: str) -> Iterator[str]:
    """The sentences that a file gives to the function of this name."""
    with path.open("rb") as file:
        for _, message, _, _ in extract(method, file, {keyword: None}, (), {"trimmed": "true"}):
            assert isinstance(message, str)
            yield message


def path_of(language: str) -> Path:
    return FOLDER / f"{language}.po"


def catalogue(language: str) -> Catalog:
    """The catalogue as it is; empty where there is none."""
    path = path_of(language)
    if not path.exists():
        return Catalog(locale=language)
    with path.open("rb") as file:
        return read_po(file, locale=language)


def fields(text: str) -> set[str]:
    """The names in braces of a sentence, without the plural's s of English."""
    return {name for _, name, _, _ in string.Formatter().parse(text) if name} - {"s"}


def messages(language: str) -> dict[str, str]:
    """Sentences with their translations."""
    found: dict[str, str] = {}
    for each in catalogue(language):
        if isinstance(each, Message) and each.id:
            found[str(each.id)] = str(each.string)
    return found


def main() -> int:
    """Write the catalogues; returns 1 when a translation is missing."""
    missing = 0
    for language in LANGUAGES:
        known, wanted = messages(language), sorted(set(sentences()))
        made = Catalog(locale=language, project="flasher", copyright_holder="", fuzzy=False)
        for each in wanted:
            made.add(each, known.get(each, ""))
            missing += not known.get(each)
        with path_of(language).open("wb") as file:
            write_po(file, made, width=100, omit_header=True)
    sys.stdout.write(f"{missing} translations are missing\n")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
