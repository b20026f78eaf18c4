"""Keys of releases: public keys with their ids, and signers with private ones.

The id of a key is a hash of its public key, so that one key cannot have two ids: signatures are
counted by id. Private keys are in encrypted PKCS#8 files, or in a hardware token by PKCS#11.
Signing and verifying need the extra `signed`, tokens the extra `pkcs11`.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from flasher.errors import ErrorCode, UsageError
from flasher.files import read
from flasher.i18n import text
from flasher.protocol.text import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from securesystemslib.signer._key import Key
    from securesystemslib.signer._signer import Signer

Secret = Callable[[str], str]
"""Asks for the passphrase or PIN of a key, which it is given the name of."""
TOKEN: Final = "hsm:"  # noqa: S105  the scheme of a URI
"""Start of the name of a key in a hardware token: `hsm:2?label=LABEL`."""
TOKEN_LIBRARY: Final = "PYKCS11LIB"  # noqa: S105
"""Environment variable with the path of the token's PKCS#11 library."""
_KEY_FILE_MAX_SIZE: Final = 16 * 1024
_ID_LENGTH: Final = 16


class Scheme(Enum):
    """Signature schemes; the value is the word of `--scheme`."""

    ED25519 = "ed25519"
    P256 = "p256"


@dataclass(frozen=True)
class PublicKey:
    """Public key of a signer."""

    der: bytes
    """SubjectPublicKeyInfo, in the one form that is accepted."""

    @property
    def id(self) -> str:
        return hashlib.sha256(self.der).hexdigest()[:_ID_LENGTH]

    @property
    def base64(self) -> str:
        return base64.b64encode(self.der).decode("ascii")

    @property
    def pem(self) -> str:
        lines = [self.base64[at : at + 64] for at in range(0, len(self.base64), 64)]
        return "\n".join(("-----BEGIN PUBLIC KEY-----", *lines, "-----END PUBLIC KEY-----", ""))

    @classmethod
    def from_base64(cls, value: str) -> PublicKey:
        """Parse a key of a trust file. Raises ValueError for any other form of the same key."""
        try:
            der = base64.b64decode(value, validate=True)
        except binascii.Error as error:
            raise ValueError("it is not base64") from error
        key = _public(_crypto().serialization.load_der_public_key, der)
        if key.base64 != value:
            raise ValueError("it is not in its usual form")
        return key

    def verifies(self, signature: bytes, data: bytes) -> bool:
        """True if a signature is right."""
        library = _library()
        try:
            _verifier(self).verify_signature(library.Signature(self.id, signature.hex()), data)
        except _errors().UnverifiedSignatureError:
            return False
        return True


@cache
def _verifier(key: PublicKey) -> Key:
    loaded = _crypto().serialization.load_der_public_key(key.der)
    verifier: Key = _library().SSlibKey.from_crypto(loaded, key.id)
    return verifier


def _public(load: Callable[[bytes], Any], raw: bytes) -> PublicKey:
    """Load a public key of a known scheme. Raises ValueError."""
    crypto = _crypto()
    try:
        loaded = load(raw)
    except Exception as error:  # unsupported algorithms have a class of their own
        raise ValueError("it is not a public key") from error
    if not isinstance(loaded, crypto.ed25519.Ed25519PublicKey) and not (
        isinstance(loaded, crypto.ec.EllipticCurvePublicKey)
        and isinstance(loaded.curve, crypto.ec.SECP256R1)
    ):
        raise ValueError("it is neither an Ed25519 nor a P-256 key")  # noqa: TRY004  of a file
    form = crypto.serialization
    der = loaded.public_bytes(form.Encoding.DER, form.PublicFormat.SubjectPublicKeyInfo)
    return PublicKey(der)


def read_public_key(path: str | os.PathLike[str]) -> PublicKey:
    """Read a public key in PEM. Raises UsageError."""
    raw = read(path, _KEY_FILE_MAX_SIZE, what="public key")
    try:
        return _public(_crypto().serialization.load_pem_public_key, raw)
    except ValueError as error:
        raise UsageError(
            f"The public key {printable(os.fspath(path))} cannot be used: {error}.",
            cause="another file was meant, such as the private key",
            remedy="Name a file PEM of an Ed25519 or P-256 public key: `flasher trust key` "
            "writes it as NAME.pub.",
            code=ErrorCode.SIGNING_KEY,
        ) from error


# -- signing ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SigningKey:
    """Private key that signs, with its public key."""

    public: PublicKey
    signer: Signer

    def sign(self, data: bytes) -> bytes:
        """Sign. Raises UsageError if a token refuses."""
        with _token_errors():
            return bytes.fromhex(self.signer.sign(data).signature)


def generate(scheme: Scheme, passphrase: str) -> tuple[bytes, PublicKey]:
    """Create a key pair; return the encrypted private key in PEM, and the public key."""
    crypto = _crypto()
    form = crypto.serialization
    private = (
        crypto.ed25519.Ed25519PrivateKey.generate()
        if scheme is Scheme.ED25519
        else crypto.ec.generate_private_key(crypto.ec.SECP256R1())
    )
    encrypted = private.private_bytes(
        form.Encoding.PEM,
        form.PrivateFormat.PKCS8,
        form.BestAvailableEncryption(passphrase.encode("utf-8")),
    )
    der = private.public_key().public_bytes(
        form.Encoding.DER, form.PublicFormat.SubjectPublicKeyInfo
    )
    return encrypted, PublicKey(der)


def open_key(name: str, secret: Secret) -> SigningKey:
    """Open a private key: a file, or a key in a token (`hsm:...`). Raises UsageError."""
    if name.startswith(TOKEN):
        return _token_key(name, secret)
    raw = read(name, _KEY_FILE_MAX_SIZE, what="private key")
    form = _crypto().serialization
    is_encrypted = b"ENCRYPTED" in raw.partition(b"\n")[0]
    reason = "the passphrase does not fit" if is_encrypted else "it is not an encrypted PKCS#8 file"
    try:
        passphrase = secret(name) if is_encrypted else ""
        private = form.load_pem_private_key(raw, passphrase.encode("utf-8"))
        der = private.public_key().public_bytes(
            form.Encoding.DER, form.PublicFormat.SubjectPublicKeyInfo
        )
        public = _public(form.load_der_public_key, der)
    except (ValueError, TypeError) as error:
        raise UsageError(
            f"The private key {printable(name)} cannot be used: {reason}.",
            remedy="Name a key of `flasher trust key`, and its passphrase; `openssl pkcs8 -topk8 "
            "-in OLD -out NEW` encrypts another key.",
            code=ErrorCode.SIGNING_KEY,
        ) from error
    return SigningKey(public, _library().CryptoSigner(private, _verifier(public)))


def token_public_key(name: str, secret: Secret) -> PublicKey:
    """Read the public key of a key in a token. Raises UsageError."""
    return _token_key(name, secret).public


def _token_key(name: str, secret: Secret) -> SigningKey:
    from urllib.parse import parse_qs, urlsplit  # noqa: PLC0415

    library = _library()

    def pin(_what: str) -> str:
        return secret(name)

    with _token_errors():
        parts = urlsplit(name)
        label = parse_qs(parts.query).get("label", [None])[0]
        number = int(parts.path) if parts.path else None
        uri, found = library.HSMSigner.import_(number, label, pin)
        pem = found.keyval["public"].encode("ascii")
        public = _public(_crypto().serialization.load_pem_public_key, pem)
        return SigningKey(public, library.HSMSigner.from_priv_key_uri(uri, _verifier(public), pin))


@contextmanager
def _token_errors() -> Iterator[None]:
    """Turn errors of a token into UsageError."""
    try:
        yield
    except UsageError:
        raise
    except Exception as error:
        reason = printable(str(error)) or type(error).__name__
        raise UsageError(
            f"The token does not sign: {reason}.",
            cause="it is not plugged in, the PIN is wrong, or another key was named",
            remedy=f"Set {TOKEN_LIBRARY} to the path of its PKCS#11 library, and name the key as "
            "hsm:ID?label=LABEL.",
            code=ErrorCode.SIGNING_KEY,
        ) from error


# -- libraries -------------------------------------------------------------------------------------


class _Crypto:
    """Modules of `cryptography`."""

    def __init__(self) -> None:
        from cryptography.hazmat.primitives import serialization  # noqa: PLC0415
        from cryptography.hazmat.primitives.asymmetric import ec, ed25519  # noqa: PLC0415

        self.serialization, self.ec, self.ed25519 = serialization, ec, ed25519


@cache
def _crypto() -> _Crypto:
    try:
        return _Crypto()
    except ImportError as error:
        raise missing_package() from error


@cache
def _library() -> Any:
    """Load securesystemslib, once something is signed or verified."""
    try:
        import securesystemslib.signer as library  # noqa: PLC0415
    except ImportError as error:
        raise missing_package() from error
    return library


@cache
def _errors() -> Any:
    from securesystemslib import exceptions  # noqa: PLC0415  as `_library`

    return exceptions


def missing_package() -> UsageError:
    return UsageError(
        text("Signatures need a package that is not installed: securesystemslib."),
        remedy=text("Install it: pip install '.[signed]'"),
        code=ErrorCode.PACKAGE_MISSING,
    )
