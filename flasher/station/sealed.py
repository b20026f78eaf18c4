"""Signed content of a certificate: its run, the audit row with digests, the station's signature."""

from __future__ import annotations

import base64
import binascii
import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from enum import Enum
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from flasher.errors import UsageError
from flasher.i18n import text
from flasher.station.records import chain
from flasher.station.records.errors import UnprovenError
from flasher.station.records.heads import ChainHead
from flasher.station.records.model import RunDetails, RunRecord, RunState, UnitLife, UnitState
from flasher.station.records.queries import details_of_content
from flasher.station.records.signatures import is_signed

CERTIFICATE_MAX_SIZE: Final = 8 * 1024 * 1024
"""Bytes of a file with a certificate."""
_BEGIN: Final = "-----BEGIN FLASHER CERTIFICATE-----"
_END: Final = "-----END FLASHER CERTIFICATE-----"
_LINE: Final = 96
_CONTENT: Final = re.compile(r"(?!\d+/\d+$)[A-Za-z0-9+/=]+")
"""Matches lines of the content, but not page numbers such as "1/2" that browsers print."""
_MAX_SIZE: Final = 4 * 1024 * 1024
"""Maximum size of the unpacked content in bytes."""
LEFT_OUT: Final = ("recipe", "claim")
"""Parts that certificates omit: the recipe is confidential, and the claim follows from the run."""


@dataclass(frozen=True)
class Sealed:
    """The signed content of a certificate."""

    flasher: str
    """Version of the flasher that made the certificate."""
    made_at: str
    """Time at which the page was made (ISO 8601)."""
    is_kept: bool
    """The head of its audit row is stored in another place than the key's folder."""
    is_beside: bool
    """The head of its audit row is stored in the key's folder."""
    examined_at: str
    """Day of the last examination of all records up to its audit row; "" without one."""
    content: dict[str, Any]
    """The rows of the run and of everything that it refers to, by table."""
    recipe: dict[str, str]
    """Name, revision and SHA-256 of the recipe."""
    row: dict[str, Any]
    """The audit row of the run."""
    station: str
    signature: str
    key: str
    earlier: tuple[dict[str, Any], ...]
    """Earlier runs of the unit, not covered by the signature."""
    earlier_left_out: int
    """Number of earlier runs that are not in `earlier`."""
    is_released: bool = False
    """The plant released the claim of the unit before it had the end of the run."""

    @property
    def head(self) -> ChainHead:
        row = self.row
        return ChainHead(
            self.station, row["number"], row["at"], row["hash"], self.signature, self.key
        )

    @property
    def digests(self) -> Mapping[str, str]:
        """Digests of the content by table, from the audit row."""
        digests = chain.data_of(self.row["data"]).get("digests")
        return digests if isinstance(digests, dict) else {}

    @property
    def record_sha256(self) -> str:
        return chain.digest(dict(self.digests))

    def wrong(self) -> list[str]:
        """Differences from the content that the station signed, in words."""
        row = self.row
        if chain.row_hash(row) != row["hash"]:
            return [text("the audit row in it was changed")]
        if not is_signed(row["hash"], self.signature, self.key):
            return [text("the signature is not that of the key in it")]
        found = {name: chain.digest(value) for name, value in self.content.items()}
        found["claim"] = chain.digest(chain.claim_of(self.content))
        words = chain.OWN | chain.NAMED
        wrong = [
            words.get(part, part)
            for part, stated in self.digests.items()
            if part != "recipe" and found.get(part) != stated
        ]
        if not self.digests or row["run_id"] != self.content["run"]["id"]:
            wrong.append("its run number")
        return (
            [text("it was changed after it was signed: {what}", what=", ".join(wrong))]
            if wrong
            else []
        )

    def life(self) -> UnitLife:
        """Runs of the unit, as stored in the certificate; the last one is the certified run.

        Raises ValidationError, KeyError or TypeError for content of another form.
        """
        details = details_of_content(self.content, self.recipe)
        runs = [RunDetails(_RUN.validate_python(run), (), (), (), ()) for run in self.earlier]
        state = UnitState.after(details.run.state)
        return UnitLife(details.run.serial, details.run.part, state, (*runs, details))


@dataclass(frozen=True)
class CheckedCertificate:
    """Result of the check of a certificate."""

    serial: str
    part: str
    state: RunState
    run_id: int
    station: str
    """The station that signed it."""
    fingerprint: str
    """Fingerprint of the station's key."""
    made_at: str
    """"" for a QR code, which does not contain it."""
    problems: tuple[str, ...]
    """Empty if the certificate is signed by that station, unchanged, and in these records."""
    remarks: tuple[str, ...]
    """Notable facts that are not problems."""


_TYPE: Final = TypeAdapter(Sealed)
_RUN: Final = TypeAdapter(RunRecord)


def plain(run: RunRecord) -> dict[str, Any]:
    """Convert a run to JSON types from which pydantic can read it again."""
    return {
        name: value.value
        if isinstance(value, Enum)
        else value.isoformat()
        if isinstance(value, datetime)
        else value
        for name, value in asdict(run).items()
        if name != "duplicates" or value is not None  # as in certificates of older versions
    }


def as_text(sealed: Sealed) -> str:
    """Encode the content as lines of text that survive printing: compressed, in base64."""
    parts = _TYPE.dump_python(sealed, mode="json")
    if not sealed.is_released:  # as in certificates of older versions
        del parts["is_released"]
    data = chain.canonical(parts).encode("ascii")
    text = base64.b64encode(zlib.compress(data, 9)).decode("ascii")
    lines = [text[at : at + _LINE] for at in range(0, len(text), _LINE)]
    return "\n".join([_BEGIN, *lines, _END])


def sealed_in(document: str) -> Sealed:
    """Decode the signed content in a text. Raises UsageError without one, UnprovenError for a
    damaged one.
    """
    start = document.find(_BEGIN)
    stop = document.find(_END, start)
    if start < 0 or stop < 0:
        raise UsageError(
            text("The file contains no signed certificate."),
            remedy=text("Name a certificate as flasher wrote or printed it, with its annex."),
        )
    lines = (line.strip() for line in document[start + len(_BEGIN) : stop].splitlines())
    encoded = "".join(line for line in lines if _CONTENT.fullmatch(line))
    try:
        data = base64.b64decode(encoded, validate=True)
        content = zlib.decompressobj().decompress(data, _MAX_SIZE)
        return _TYPE.validate_python(json.loads(content))
    except (binascii.Error, zlib.error, ValueError, ValidationError, RecursionError) as error:
        raise UnprovenError(
            text("The certificate was changed: its signed content cannot be read."),
            remedy=text("Request the certificate again."),
        ) from error
