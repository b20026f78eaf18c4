"""What a station keeps outside of its records: its signing key, and the heads of its audit chain.

Whoever can write the database but has no key cannot make a chain that verifies. The chain alone
cannot tell that its end was cut off, or that it is an older copy of itself; a file in another place
that only grows can.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from platformdirs import user_data_path

from flasher.files import opened, parse_json, read
from flasher.protocol.text import printable
from flasher.station.records.errors import KeyMissingError, RecordError, mapped
from flasher.station.records.files import sync_folder

KEY_MAX_SIZE: Final = 64 * 1024
"""In bytes."""
_MODE: Final = 0o600
_CONTEXT: Final = b"flasher station audit row "
"""What is signed says what it is, so that no signature can stand for something else."""


def fingerprint(public: str) -> str:
    """What a person compares: the first 16 digits of the hash of a public key, in groups."""
    digits = hashlib.sha256(bytes.fromhex(public)).hexdigest()[:16]
    return "-".join(digits[at : at + 4] for at in range(0, 16, 4))


def is_signed(row_hash: str, signature: str, public: str) -> bool:
    """True when the holder of the key signed this hash."""
    try:
        key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public))
        key.verify(base64.b64decode(signature, validate=True), _CONTEXT + row_hash.encode())
    except (InvalidSignature, ValueError):
        return False
    return True


class SigningKey:
    """A private key. `public` is the public one, 64 hexadecimal digits."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key
        self.public = key.public_key().public_bytes_raw().hex()

    @classmethod
    def make(cls, path: Path) -> SigningKey:
        """A new key, on disk when this returns, for this user alone. Raises RecordError."""
        key = Ed25519PrivateKey.generate()
        text = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        with mapped(printable(str(path)), writes=True):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE)
            with os.fdopen(handle, "wb") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            sync_folder(path.parent)
        return cls(key)

    @classmethod
    def load(cls, path: Path) -> SigningKey | None:
        """The key in a file; None when there is no file. Raises KeyMissingError for a file that is
        no key or that others may read, RecordError for one that cannot be read, UsageError for what
        is no file.
        """
        shown = printable(str(path))
        if not path.exists():
            return None
        try:
            with mapped(shown, writes=False):
                if os.name != "nt" and path.stat().st_mode & 0o077:
                    raise KeyMissingError(
                        "Others may read the signing key of the station.",
                        where=shown,
                        remedy=f"chmod 600 {shown}",
                    )
            data = read(path, KEY_MAX_SIZE, error=RecordError)
            key = load_pem_private_key(data, password=None)
        except (ValueError, TypeError, UnsupportedAlgorithm):
            key = None
        if not isinstance(key, Ed25519PrivateKey):
            raise KeyMissingError(
                "The signing key of the station cannot be used: the file holds no Ed25519 key.",
                where=shown,
                remedy="Put the right file back; if it is lost: flasher station key --lost.",
            )
        return cls(key)

    def sign(self, row_hash: str) -> str:
        """The signature of a row's hash, in base64."""
        return base64.b64encode(self._key.sign(_CONTEXT + row_hash.encode())).decode("ascii")


HEADS_MAX_SIZE: Final = 256 * 1024 * 1024
"""In bytes: some 200,000 units."""


@dataclass(frozen=True)
class Head:
    """The end of a station's chain at some moment, signed."""

    station: str
    number: int
    """Of the audit row in the station's chain, from 1."""
    at: str
    hash: str
    signature: str
    key: str
    """The public key, in hexadecimal digits."""


class HeadsFile:
    """The kept heads of one station; `append` is the only change that is ever made."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(self, heads: Iterable[Head]) -> None:
        """Add a line for each; on disk when this returns. Raises RecordError."""
        lines = b"".join(
            json.dumps(asdict(head), sort_keys=True).encode("ascii") + b"\n" for head in heads
        )
        with mapped(printable(str(self.path)), writes=True):
            is_new = not self.path.exists()
            if is_new:
                self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
            with os.fdopen(handle, "rb+", buffering=0) as file:
                size = file.seek(0, os.SEEK_END)
                if size:
                    file.seek(size - 1)
                    if file.read(1) != b"\n":
                        lines = b"\n" + lines  # behind half a line, which a crash has left
                file.write(lines)
                os.fsync(file.fileno())
            if is_new:
                sync_folder(self.path.parent)

    def read(self) -> tuple[Head | int, ...]:
        """The heads in the order in which they were kept; in place of a line that is no head its
        number, from 1. Empty without a file. Raises RecordError, UsageError for what is no file.
        """
        if not self.path.exists():
            return ()
        # A station may add to it meanwhile.
        with opened(self.path, HEADS_MAX_SIZE, error=RecordError, may_grow=True) as (file, size):
            lines = file.read(size).splitlines()
        return tuple(_heads(lines))


def _heads(lines: list[bytes]) -> Iterator[Head | int]:
    for number, line in enumerate(lines, 1):
        try:
            head = Head(**parse_json(line))
        except (ValueError, TypeError):
            yield number
        else:
            yield head if isinstance(head.number, int) else number


@dataclass(frozen=True)
class Keeping:
    """Where the signing key of a station is kept, and the heads of its chain; None: the place of
    this user, and beside the key.
    """

    keys: Path | None = None
    heads: Path | None = None

    @property
    def keys_folder(self) -> Path:
        return self.keys or user_data_path("flasher", appauthor=False) / "station"

    @property
    def heads_folder(self) -> Path:
        return self.heads or self.keys_folder

    def key_file(self, station: str, records_id: str) -> Path:
        return self.keys_folder / _file_name(station, records_id, ".key")

    def heads_file(self, station: str, records_id: str) -> HeadsFile:
        return HeadsFile(self.heads_folder / _file_name(station, records_id, ".heads"))

    def kept_heads(
        self, records_id: str, stations: Iterable[str]
    ) -> dict[str, tuple[Head | int, ...]]:
        """The heads that are kept of these records, by station; also of stations that the records
        do not name. Raises RecordError.
        """
        found = {name: self.heads_file(name, records_id).read() for name in stations}
        if self.heads_folder.is_dir():
            for path in sorted(self.heads_folder.glob("*.heads")):
                heads = HeadsFile(path).read()
                name = next((each.station for each in heads if isinstance(each, Head)), None)
                if name is not None and path == self.heads_file(name, records_id).path:
                    found[name] = heads
        return {name: heads for name, heads in found.items() if heads}


def _file_name(station: str, records_id: str, suffix: str) -> str:
    """The name of a station's file for these records: unlike for unlike stations."""
    plain = re.sub(r"[^A-Za-z0-9_-]", "_", station)[:40]
    mark = hashlib.sha256(f"{records_id} {station}".encode()).hexdigest()[:12]
    return f"{plain}-{mark}{suffix}"
