"""Ed25519 signatures of a station: its private key file, and verification."""

from __future__ import annotations

import base64
import hashlib
import os
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

from flasher.files import read
from flasher.protocol.text import printable
from flasher.station.records.errors import KeyMissingError, RecordError, mapped
from flasher.station.records.files import sync_folder

KEY_MAX_SIZE: Final = 64 * 1024
"""In bytes."""
_MODE: Final = 0o600
AUDIT_ROW: Final = "audit row"
"""The signed text begins with its purpose, so that a signature cannot be used for another."""
SEGMENT: Final = "heads"
EXAMINED: Final = "examined records"


def fingerprint(public: str) -> str:
    """Fingerprint for people: the first 16 digits of a public key's hash, in groups."""
    digits = hashlib.sha256(bytes.fromhex(public)).hexdigest()[:16]
    return "-".join(digits[at : at + 4] for at in range(0, 16, 4))


def is_signed(text: str, signature: str, public: str, purpose: str = AUDIT_ROW) -> bool:
    """True if the owner of the key signed this text for this purpose."""
    try:
        key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(public))
        key.verify(base64.b64decode(signature, validate=True), _signed_bytes(purpose, text))
    except (InvalidSignature, ValueError):
        return False
    return True


class SigningKey:
    """A private key. `public` is the public key in 64 hexadecimal digits."""

    def __init__(self, key: Ed25519PrivateKey) -> None:
        self._key = key
        self.public = key.public_key().public_bytes_raw().hex()

    @classmethod
    def make(cls, path: Path) -> SigningKey:
        """Create a key file that only this user can read; on disk on return. Raises RecordError."""
        made = cls(Ed25519PrivateKey.generate())
        made.save(path)
        return made

    def save(self, path: Path) -> None:
        """Write the key to a new file, as `make`."""
        text = self._key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        with mapped(printable(str(path)), writes=True):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _MODE)
            with os.fdopen(handle, "wb") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            sync_folder(path.parent)

    @classmethod
    def load(cls, path: Path) -> SigningKey | None:
        """Load a key file; None without one. Raises KeyMissingError for a file that is not a key or
        that others may read, RecordError, UsageError for a path that is not a file.
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
            return cls.parse(read(path, KEY_MAX_SIZE, error=RecordError))
        except ValueError as error:
            raise KeyMissingError(
                "The signing key of the station cannot be used: the file holds no Ed25519 key.",
                where=shown,
                remedy="Put the right file back; if it is lost: flasher station key --lost"
                " --reason TEXT.",
            ) from error

    @classmethod
    def parse(cls, data: bytes) -> SigningKey:
        """Parse the content of a key file. Raises ValueError."""
        try:
            key = load_pem_private_key(data, password=None)
        except (TypeError, UnsupportedAlgorithm) as error:
            raise ValueError(str(error)) from error
        if not isinstance(key, Ed25519PrivateKey):
            raise ValueError("it is not an Ed25519 key")  # noqa: TRY004  it was read from a file
        return cls(key)

    def sign(self, text: str, purpose: str = AUDIT_ROW) -> str:
        """Sign a text; returns the signature in base64."""
        return base64.b64encode(self._key.sign(_signed_bytes(purpose, text))).decode("ascii")


def _signed_bytes(purpose: str, text: str) -> bytes:
    return f"flasher station {purpose} {text}".encode()
