"""A maker of firmware with keys, a trust file and releases, for tests."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

library: Any = pytest.importorskip("securesystemslib.signer")

from cryptography.hazmat.primitives import serialization  # noqa: E402
from cryptography.hazmat.primitives.asymmetric import ec, ed25519  # noqa: E402

from flasher.image.image import Image  # noqa: E402
from flasher.image.load import load  # noqa: E402
from flasher.protocol.spec import BMS, Target  # noqa: E402
from flasher.release import container, verify  # noqa: E402
from flasher.release.build import build, with_signatures  # noqa: E402
from flasher.release.keys import PublicKey, SigningKey  # noqa: E402
from flasher.release.statement import Part  # noqa: E402
from flasher.release.store import TrustStore  # noqa: E402
from flasher.release.transparency import ReleaseLog  # noqa: E402
from flasher.release.trust import Chain, Role, Trust, TrustedKey, new_chain  # noqa: E402
from flasher.settings.manifest import release_of  # noqa: E402

SAMPLES = Path(__file__).parent.parent.parent / "firmware_samples"
IMAGE = SAMPLES / "station" / "bms.bin"  # the smaller one
PRODUCT = "48V"
FIRST_DAY = "2026-01-10"


@cache
def key(name: str, *, p256: bool = False) -> SigningKey:
    """The key of a name: always the same one."""
    seed = hashlib.sha256(name.encode()).digest()
    private: Any = (
        ec.derive_private_key(int.from_bytes(seed), ec.SECP256R1())
        if p256
        else ed25519.Ed25519PrivateKey.from_private_bytes(seed)
    )
    der = private.public_key().public_bytes(
        serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    public = PublicKey(der)
    library_key = library.SSlibKey.from_crypto(private.public_key(), public.id)
    return SigningKey(public, library.CryptoSigner(private, library_key))


def role(*names: str, threshold: int = 1) -> Role:
    return Role(keys=tuple(key(name).public.id for name in names), threshold=threshold)


def trusted(*names: str) -> dict[str, TrustedKey]:
    return {
        key(name).public.id: TrustedKey(public=key(name).public.base64, holder=name)
        for name in names
    }


def first_trust(**other: Any) -> Trust:
    """Version 1: two root keys, of which both sign; two for the BMS, of which one is enough."""
    given: dict[str, Any] = {
        "name": "Works",
        "version": 1,
        "issued": FIRST_DAY,
        "expires": "2028-01-01",
        "keys": trusted("root a", "root b", "anna", "bert"),
        "root": role("root a", "root b", threshold=2),
        "release": {"bms": role("anna", "bert")},
    }
    return Trust(**{**given, **other})


def chain_of(*versions: Trust, signers: Sequence[str] = ("root a", "root b")) -> Chain:
    """A chain in which each version has the signatures of these."""
    keys = [key(name) for name in signers]
    chain = new_chain(versions[0], "trust.json").signed(keys)
    for each in versions[1:]:
        chain = chain.extended(each).signed(keys)
    return chain


@dataclass
class Maker:
    """Builds and signs releases of the sample for the BMS."""

    chain: Chain = field(default_factory=lambda: chain_of(first_trust()))
    log: ReleaseLog | None = None
    log_signers: tuple[str, ...] = ("log",)

    def next_version(self, *signers: str, **changes: Any) -> Chain:
        """Add a version of the trust file."""
        trust = replace(self.chain.newest, version=self.chain.newest.version + 1, **changes)
        names = signers or ("root a", "root b")
        self.chain = self.chain.extended(trust).signed([key(name) for name in names])
        return self.chain

    def release(
        self,
        counter: int = 1,
        signers: Sequence[str] = ("anna",),
        *,
        images: Mapping[Target, Path] | None = None,
        released: str = "2026-02-01",
        has_trust: bool = True,
        **options: Any,
    ) -> bytes:
        """Build a release with these signatures."""
        parts = {
            target: Part(path.name, path.read_bytes(), *_stated(path, target, counter))
            for target, path in (images or {BMS: IMAGE}).items()
        }
        raw, log = build(
            parts,
            released=released,
            chain=self.chain if has_trust else None,
            log=self.log,
            log_keys=[key(name) for name in self.log_signers],
            **options,
        )
        self.log = log
        return signed(raw, signers)


def _stated(path: Path, target: Target, counter: int) -> tuple[Image, Any]:
    image = load(path)
    return image, release_of(image, target, product=PRODUCT, counter=counter)


def signed(raw: bytes, signers: Sequence[str]) -> bytes:
    package = opened(raw)
    return with_signatures(package, package.envelope.sign(key(name) for name in signers))


def opened(raw: bytes) -> verify.Package:
    return verify.parse_package(container.unpack(raw, "bike.wfw"), "bike.wfw")


@pytest.fixture
def maker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Maker:
    """The maker whose keys this computer trusts."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    made = Maker()
    TrustStore().install(made.chain)
    return made
