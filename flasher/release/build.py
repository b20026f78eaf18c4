"""Release builder: packs images with their manifests and all that verification needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

from flasher.protocol.spec import Target
from flasher.release.container import IMAGES, LOG, NOTES, SBOM, STATEMENT, TRUST, pack
from flasher.release.envelope import Envelope, json_bytes
from flasher.release.keys import SigningKey
from flasher.release.statement import PAYLOAD_TYPE, Part, statement_bytes
from flasher.release.transparency import ReleaseLog
from flasher.release.trust import Chain
from flasher.release.verify import Package


def build(
    parts: Mapping[Target, Part],
    *,
    released: str,
    notes: bytes | None = None,
    sbom: bytes | None = None,
    chain: Chain | None = None,
    log: ReleaseLog | None = None,
    log_keys: Iterable[SigningKey] = (),
    is_detached: bool = False,
) -> tuple[bytes, ReleaseLog | None]:
    """Return a release without signatures, and the log with it appended."""
    files = {each.file: each.content for each in parts.values()}
    files |= {NOTES: notes} if notes is not None else {}
    files |= {SBOM: sbom} if sbom is not None else {}
    envelope = Envelope(statement_bytes(files, parts, released=released), PAYLOAD_TYPE)
    if log is not None:
        log = log.append(envelope.payload, log_keys)
    members = {
        name: raw for name, raw in files.items() if not (is_detached and name.startswith(IMAGES))
    }
    members[STATEMENT] = _envelope_file(envelope)
    members |= {TRUST: chain.to_bytes()} if chain is not None else {}
    members |= {LOG: log.to_bytes()} if log is not None else {}
    return pack(members), log


def with_signatures(package: Package, envelope: Envelope) -> bytes:
    """Return the container of a release with another envelope of the same statement."""
    return pack({**package.members, STATEMENT: _envelope_file(envelope)})


def with_signature(package: Package, key_id: str, signature: bytes) -> bytes:
    """Return the container of a release with a signature that was made elsewhere."""
    envelope = package.envelope
    signatures = {**envelope.signatures, key_id: signature}
    return with_signatures(package, replace(envelope, signatures=signatures))


def _envelope_file(envelope: Envelope) -> bytes:
    return json_bytes(envelope.document()) + b"\n"
