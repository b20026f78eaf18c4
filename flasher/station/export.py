"""Sealed export of a station: signing key and settings in a file, encrypted with a passphrase.

The key of the cipher (AES-256-GCM) is made of the passphrase by scrypt with 64 MiB, so that guesses
cost time.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

from flasher.errors import ErrorCode, UsageError
from flasher.files import is_plain, read
from flasher.protocol.text import printable
from flasher.station.records.errors import UnprovenError, mapped
from flasher.station.records.files import whole_file

EXPORT_MAX_SIZE: Final = 256 * 1024 * 1024
PASSPHRASE_MIN: Final = 12
"""Shortest passphrase, in characters."""
KEY_NAME: Final = "signing.key"
"""Member with the signing key; others are named by their path beside the station file."""
_MAGIC: Final = b"flasher station export 1\n"
_SALT_SIZE: Final = 16
_NONCE_SIZE: Final = 12
_TAG_SIZE: Final = 16
_SCRYPT_N: Final = 1 << 16
_REMEDY: Final = "Make another one: flasher station export."


def seal(path: Path, members: Mapping[str, bytes], passphrase: str) -> None:
    """Write an export, whole or not at all. Raises UsageError for a short passphrase,
    RecordError.
    """
    if len(passphrase) < PASSPHRASE_MIN:
        raise UsageError(
            f"A passphrase has at least {PASSPHRASE_MIN} characters.",
            remedy="Choose a longer one: several words.",
        )
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    head = _MAGIC + os.urandom(_SALT_SIZE) + os.urandom(_NONCE_SIZE)
    cipher, nonce = _cipher(head, passphrase)
    with mapped(printable(str(path)), writes=True), whole_file(path) as part:
        part.touch(0o600)
        part.write_bytes(head + cipher.encrypt(nonce, packed.getvalue(), head))


def unseal(path: Path, passphrase: str) -> dict[str, bytes]:
    """Read an export. Raises UsageError for another file, UnprovenError for a wrong passphrase or a
    changed file: the cipher does not distinguish them.
    """
    data = read(path, EXPORT_MAX_SIZE, what="export")
    shown = printable(str(path))
    size = len(_MAGIC) + _SALT_SIZE + _NONCE_SIZE
    if not data.startswith(_MAGIC) or len(data) < size + _TAG_SIZE:
        raise UsageError(
            "The file is no export of a station, or its end is missing.",
            where=shown,
            remedy=_REMEDY,
            code=ErrorCode.FILE_NOT_READ,
        )
    head = data[:size]
    cipher, nonce = _cipher(head, passphrase)
    try:
        packed = cipher.decrypt(nonce, data[size:], head)
    except InvalidTag as error:
        raise UnprovenError(
            "The export cannot be opened.",
            where=shown,
            cause="the passphrase is wrong, or the file was changed or cut off",
            remedy=f"Enter the passphrase again. {_REMEDY}",
        ) from error
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        return {name: archive.read(name) for name in archive.namelist() if is_plain(name)}


def _cipher(head: bytes, passphrase: str) -> tuple[AESGCM, bytes]:
    salt = head[len(_MAGIC) : len(_MAGIC) + _SALT_SIZE]
    made = Scrypt(salt=salt, length=32, n=_SCRYPT_N, r=8, p=1).derive(passphrase.encode())
    return AESGCM(made), head[len(_MAGIC) + _SALT_SIZE :]
