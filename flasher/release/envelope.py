"""Envelope: bytes with their type and signatures (DSSE), read and checked.

The signatures are over `signed_bytes`, in which the type has its place: what was signed as one kind
of document is no signature of another.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from flasher.files import parse_json
from flasher.release.keys import PublicKey, SigningKey

_SIGNATURES_MAX: Final = 32


@dataclass(frozen=True)
class Envelope:
    """Payload with its signatures, by the id of the key."""

    payload: bytes = field(repr=False)
    payload_type: str
    signatures: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def signed_bytes(self) -> bytes:
        """The bytes that a signature is made of (the pre-authentication encoding of DSSE)."""
        kind = self.payload_type.encode("utf-8")
        return b"DSSEv1 %d %b %d %b" % (len(kind), kind, len(self.payload), self.payload)

    def sign(self, keys: Iterable[SigningKey]) -> Envelope:
        """Return the envelope with a signature of each key."""
        made = {key.public.id: key.sign(self.signed_bytes) for key in keys}
        return replace(self, signatures={**self.signatures, **made})

    def signers(self, keys: Iterable[PublicKey]) -> frozenset[str]:
        """Return the ids of those keys whose signature is right. Raises UsageError if the packages
        for it are missing.
        """
        return frozenset(
            key.id
            for key in keys
            if key.id in self.signatures
            and key.verifies(self.signatures[key.id], self.signed_bytes)
        )

    def document(self) -> dict[str, object]:
        """Return the envelope as DSSE writes it, signatures sorted by key."""
        return {
            "payload": _encoded(self.payload),
            "payloadType": self.payload_type,
            "signatures": [
                {"keyid": key_id, "sig": _encoded(self.signatures[key_id])}
                for key_id in sorted(self.signatures)
            ],
        }


def envelope_of(document: object, payload_type: str) -> Envelope:
    """Read the JSON of an envelope. Raises ValueError for anything else, for another type, and for
    two signatures of one key.
    """
    match document:
        case {
            "payload": str() as payload,
            "payloadType": str() as kind,
            "signatures": list() as given,
            **rest,
        } if not rest:
            pass
        case _:
            raise ValueError("it is not an envelope (DSSE)")
    if kind != payload_type:
        raise ValueError(f"its envelope is of the type {kind!a:.60}")
    if len(given) > _SIGNATURES_MAX:
        raise ValueError(f"it has more than {_SIGNATURES_MAX} signatures")
    signatures: dict[str, bytes] = {}
    for each in given:
        match each:
            case {"keyid": str() as key_id, "sig": str() as signature} if len(each) == 2:
                if key_id in signatures:
                    raise ValueError(f"it has two signatures of the key {key_id!a:.60}")
                signatures[key_id] = _decoded(signature)
            case _:
                raise ValueError("a signature in it has another form than DSSE")
    return Envelope(_decoded(payload), kind, signatures)


def parse_envelope(raw: bytes, payload_type: str) -> Envelope:
    """Parse an envelope. Raises ValueError."""
    return envelope_of(parse_json(raw), payload_type)


def json_bytes(document: object) -> bytes:
    """Write JSON in the one form that is signed: sorted keys, no blanks, ASCII."""
    return json.dumps(document, sort_keys=True, separators=(",", ":")).encode("ascii")


def _encoded(raw: bytes) -> str:
    return base64.b64encode(raw).decode("ascii")


def _decoded(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError("a value in its envelope is not base64") from error
