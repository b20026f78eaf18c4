"""Trust: which keys may sign releases and the next version of the trust file.

A trust file is TOML. Its versions form a chain: each one is signed by enough root keys of the
version before it, and of its own. Of two chains that this computer meets, one has to begin with
the other: the longer one is newer, and any other pair is a fork.
"""

from __future__ import annotations

import datetime
import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from json import JSONDecodeError
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import tomli_w

from flasher.errors import ErrorCode, FlasherError, UsageError
from flasher.files import parse_json, parse_toml
from flasher.i18n import text
from flasher.image.release import COUNTER_MAX
from flasher.protocol.text import printable
from flasher.release.envelope import Envelope, envelope_of, json_bytes
from flasher.release.keys import PublicKey, SigningKey
from flasher.validation import NumberRange, Parsed

if TYPE_CHECKING:
    from flasher.settings.toml_reader import Reader

PAYLOAD_TYPE: Final = "application/vnd.welling-flasher.trust+toml"
CHAIN_MAX_SIZE: Final = 1024 * 1024
"""Maximum size of a chain in bytes: some hundred versions."""
VALID_DAYS: Final = 730
"""Default time in days until a trust file expires."""
_FORMAT: Final = 1
_ROOT: Final = "root"
_LOG: Final = "log"
ROLES: Final = (_ROOT, _LOG, "wmc", "bms", "obc")
"""Roles of keys: root keys sign trust files, log keys the log, and those of a target its images."""


def _date(value: object) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"\d{4}-\d\d-\d\d", value):
        raise ValueError
    datetime.date.fromisoformat(value)
    return value


def _public_key(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    return PublicKey.from_base64(value).base64


DateText = Annotated[str, Parsed("a date as 2027-11-24", _date)]
TargetKey = Literal["wmc", "bms", "obc"]


@dataclass(frozen=True, kw_only=True)
class TrustedKey:
    """Public key in a trust file."""

    public: Annotated[str, Parsed("an Ed25519 or P-256 public key in base64", _public_key)]
    """Public key (SubjectPublicKeyInfo) in base64."""
    holder: str = ""
    """Who has the private key, for people."""


@dataclass(frozen=True, kw_only=True)
class Role:
    """Keys of a role, and how many of them have to sign."""

    keys: tuple[str, ...]
    """Ids of the keys."""
    threshold: Annotated[int, NumberRange(ge=1, le=16)] = 1
    """Number of different keys that have to sign."""


@dataclass(frozen=True, kw_only=True)
class Trust:
    """One version of a trust file."""

    name: str
    """Whose releases these are, for people."""
    version: Annotated[int, NumberRange(ge=1, le=1_000_000)]
    """Version of the trust file: 1 for the first, one more for each change."""
    issued: DateText
    """Day on which this version was made."""
    expires: DateText
    """Last day for which a release may state that it was made under this version."""
    keys: dict[str, TrustedKey]
    """Public keys by id, which is made of the key."""
    root: Role
    """Keys that sign the next version."""
    release: dict[TargetKey, Role] = field(default_factory=dict)
    """Keys that sign images, by target."""
    log: Role | None = None
    """Keys that sign the log of releases; without this table no log is needed."""
    minimum_counters: dict[
        TargetKey, dict[str, Annotated[int, NumberRange(ge=1, le=COUNTER_MAX)]]
    ] = field(default_factory=dict)
    """Oldest counter that is still flashed, by target and product."""

    def role(self, name: str) -> Role | None:
        """Return a role of `ROLES`; None if nobody has it."""
        if name == _ROOT:
            return self.root
        return self.log if name == _LOG else self.release.get(name)  # type: ignore[call-overload]

    def with_role(self, name: str, role: Role) -> Trust:
        """Return this trust with another role."""
        if name in (_ROOT, _LOG):
            return replace(self, **{name: role})  # type: ignore[arg-type]
        return replace(self, release={**self.release, name: role})  # type: ignore[dict-item]

    def key(self, key_id: str) -> PublicKey:
        return _parsed_key(self.keys[key_id].public)

    def signers(self, role: Role, envelope: Envelope) -> frozenset[str]:
        """Return the ids of keys of a role that signed an envelope."""
        return envelope.signers(map(self.key, role.keys))

    def shown(self, key_id: str) -> str:
        """Return id and holder of a key."""
        holder = self.keys[key_id].holder
        return f"{key_id} ({printable(holder)})" if holder else key_id

    def to_toml(self) -> bytes:
        """Write the trust file, in the one form that is signed."""
        roles = {name: _table(role) for name, role in sorted(self.release.items())}
        document: dict[str, Any] = {
            "format": _FORMAT,
            "name": self.name,
            "version": self.version,
            "issued": self.issued,
            "expires": self.expires,
            "keys": {
                key_id: {"public": key.public} | ({"holder": key.holder} if key.holder else {})
                for key_id, key in sorted(self.keys.items())
            },
            "root": _table(self.root),
            "release": roles,
            **({"log": _table(self.log)} if self.log else {}),
            **({"minimum_counters": self.minimum_counters} if self.minimum_counters else {}),
        }
        return tomli_w.dumps(document).encode("utf-8")


@cache
def _parsed_key(value: str) -> PublicKey:
    return PublicKey.from_base64(value)


def _table(role: Role) -> dict[str, Any]:
    return {"keys": list(role.keys), "threshold": role.threshold}


@cache
def reader() -> Reader[Trust]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(Trust, "trust file", also=("format",))


def parse_trust(raw: bytes, source: str) -> Trust:
    """Parse a version of a trust file. Raises UsageError with all problems."""
    try:
        document = parse_toml(raw)
    except ValueError as error:
        raise untrusted(source, text("it is not a TOML file: {why}", why=str(error))) from error
    if type(document.get("format")) is not int or document["format"] != _FORMAT:
        raise untrusted(source, text("this flasher reads format = {format}", format=_FORMAT))
    stated = {key: value for key, value in document.items() if key != "format"}
    trust, faults = reader().check(stated)
    if trust is None or faults:
        refusal = reader().refusal(source, faults)
        refusal.code = ErrorCode.TRUST_FILE
        raise refusal
    for problem in _contradictions(trust):
        raise untrusted(source, problem)
    return trust


def _contradictions(trust: Trust) -> Iterator[str]:
    for key_id in trust.keys:
        own = trust.key(key_id).id
        if own != key_id:
            yield text(
                "the key {key} has the id {own}, and may have no other: a key with two ids would "
                "count twice",
                key=printable(key_id),
                own=own,
            )
    for name in ROLES:
        role = trust.role(name)
        if role is None:
            continue
        for key_id in role.keys:
            if key_id not in trust.keys:
                yield text(
                    "the role {role} names an unknown key {key}", role=name, key=printable(key_id)
                )
        if len(set(role.keys)) != len(role.keys):
            yield text("the role {role} names a key twice", role=name)
        if role.threshold > len(role.keys):
            yield text(
                "the role {role} asks for {threshold} signatures and has {count} keys",
                role=name,
                threshold=role.threshold,
                count=len(role.keys),
            )


# -- the chain -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chain:
    """All versions of a trust file, with their signatures; the last one may still lack some."""

    envelopes: tuple[Envelope, ...]
    versions: tuple[Trust, ...]
    source: str = field(compare=False)

    @property
    def newest(self) -> Trust:
        return self.versions[-1]

    @cached_property
    def anchor(self) -> str:
        """Hash of the first version, which all of its chains have in common."""
        return hashlib.sha256(self.envelopes[0].payload).hexdigest()

    def missing(self) -> list[str]:
        """Describe the signatures that the newest version lacks; empty if it is complete."""
        return list(self._missing(len(self.versions) - 1))

    def _missing(self, at: int) -> Iterator[str]:
        envelope = self.envelopes[at]
        for trust in dict.fromkeys((max(at - 1, 0), at)):
            signing = self.versions[trust]
            given = len(signing.signers(signing.root, envelope))
            if given < signing.root.threshold:
                yield text(
                    "version {version} has {given} of the {threshold} signatures by root keys of "
                    "version {of}",
                    version=self.versions[at].version,
                    given=given,
                    threshold=signing.root.threshold,
                    of=signing.version,
                )

    def check(self) -> Chain:
        """Return this chain. Raises UsageError if a version lacks a signature."""
        for at in range(len(self.versions)):
            for problem in self._missing(at):
                raise untrusted(
                    self.source,
                    problem,
                    remedy=text(
                        "Add signatures with `flasher trust sign`, or take the maker's file."
                    ),
                )
        return self

    def begins_with(self, other: Chain) -> bool:
        """True if the other chain is this one, or an older state of it."""
        own = [each.payload for each in self.envelopes[: len(other.envelopes)]]
        return own == [each.payload for each in other.envelopes]

    def signed(self, keys: list[SigningKey]) -> Chain:
        """Return the chain with more signatures of its newest version."""
        return replace(self, envelopes=(*self.envelopes[:-1], self.envelopes[-1].sign(keys)))

    def extended(self, trust: Trust) -> Chain:
        """Return the chain with another version, which has no signatures yet."""
        envelope = Envelope(trust.to_toml(), PAYLOAD_TYPE)
        return Chain((*self.envelopes, envelope), (*self.versions, trust), self.source)

    def to_bytes(self) -> bytes:
        """Write the chain as JSON."""
        documents = [each.document() for each in self.envelopes]
        return json_bytes({"format": _FORMAT, "versions": documents}) + b"\n"


def new_chain(trust: Trust, source: str) -> Chain:
    """Create a chain with its first version."""
    return Chain((), (), source).extended(trust)


def parse_chain(raw: bytes, source: str) -> Chain:
    """Parse a chain, of which no signature is checked yet (`Chain.check`). Raises UsageError."""
    if len(raw) > CHAIN_MAX_SIZE:
        raise untrusted(source, text("it is larger than {limit} bytes", limit=CHAIN_MAX_SIZE))
    try:
        envelopes = _envelopes(raw)
    except JSONDecodeError as error:
        raise untrusted(source, text("it is not a JSON file: {why}", why=str(error))) from error
    except ValueError as error:
        raise untrusted(source, printable(str(error))) from error
    versions = tuple(parse_trust(each.payload, source) for each in envelopes)
    for at, trust in enumerate(versions, 1):
        if trust.version != at:
            raise untrusted(
                source,
                text(
                    "version {found} is where version {wanted} belongs",
                    found=trust.version,
                    wanted=at,
                ),
            )
    return Chain(envelopes, versions, source)


def _envelopes(raw: bytes) -> tuple[Envelope, ...]:
    match parse_json(raw):
        case {"format": 1, "versions": [_, *_] as documents, **rest} if not rest:
            return tuple(envelope_of(each, PAYLOAD_TYPE) for each in documents)
        case _:
            raise ValueError("it is not a chain of trust files")


def newer(known: Chain, found: Chain) -> Chain:
    """Return the longer one of two chains of one trust. Raises UsageError for a fork."""
    if known.begins_with(found):
        return known
    if found.begins_with(known):
        return found
    raise untrusted(
        found.source,
        text(
            "it is not a successor of the trust file on this computer, {known}, version {version}",
            known=printable(known.source),
            version=known.newest.version,
        ),
        remedy=text(
            "Take the file of the maker whose releases you use. Another maker's, or your own, "
            "replaces it by `flasher trust install --replace`."
        ),
    )


def untrusted(source: str, why: str, *, remedy: str = "") -> FlasherError:
    """Create the error for a trust file that is not used."""
    return UsageError(
        text("The trust file {file} is not used: {why}.", file=printable(source), why=why),
        cause=text("it was changed by hand, is unfinished, or belongs to another maker"),
        remedy=remedy or text("Take the file as its maker gave it: `flasher trust install FILE`."),
        code=ErrorCode.TRUST_FILE,
    )
