"""`flasher release`: build, sign, verify and show signed releases."""

from __future__ import annotations

import datetime
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import click
from filelock import FileLock, Timeout

from flasher.cli import values
from flasher.cli.files import check_new, check_writable, write_whole
from flasher.cli.framework import argument, group, option
from flasher.cli.options import target_option
from flasher.cli.output import Output
from flasher.cli.release.signing import (
    Passphrases,
    date,
    key_option,
    open_keys,
    passphrase_options,
    today,
)
from flasher.errors import ErrorCode, ExitCode, ImageError, UsageError
from flasher.files import read
from flasher.image.load import load
from flasher.image.plausible import check_plausible
from flasher.image.release import Release, check_target
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.release import container, verify
from flasher.release.build import build, with_signature, with_signatures
from flasher.release.envelope import Envelope
from flasher.release.keys import PublicKey, read_public_key
from flasher.release.places import SUFFIX, detached_path
from flasher.release.statement import Part
from flasher.release.transparency import LOG_MAX_SIZE, ReleaseLog, parse_log
from flasher.release.trust import CHAIN_MAX_SIZE, Chain, parse_chain
from flasher.settings.manifest import check_statement, find_release, release_of

_DOCUMENT_MAX_SIZE: Final = 8 * 1024 * 1024
_SIGNATURE_MAX_SIZE: Final = 1024
_LOG_LOCK_S: Final = 10.0


@dataclass(frozen=True)
class ReleaseImageDocument:
    """Image of a release."""

    target: str
    file: str
    release: Release


@dataclass(frozen=True)
class ReleaseDocument:
    """Contents of a release; nothing in it is verified by showing it."""

    file: str
    released: str
    images: list[ReleaseImageDocument]
    signed_by: list[str]
    """Ids of the keys that the signatures name."""
    trust_version: int | None
    """Version of the trust file inside; null without one."""
    log_size: int | None
    """Number of releases in the log inside; null without one."""
    log_head: str | None
    """Hash over the log."""
    sha256: str
    """Of the statement, as in the log."""
    is_detached: bool


@dataclass(frozen=True)
class ReleaseVerifiedDocument:
    """Result of `release verify` for each target."""

    file: str
    verified: list[str]
    """Targets whose images may be flashed."""
    trust_version: int | None
    signers: dict[str, list[str]]
    warnings: list[str]


@dataclass(frozen=True)
class PayloadDocument:
    """Bytes to be signed elsewhere."""

    file: str
    payload: str
    sha256: str


DOCUMENTS: Final = (ReleaseDocument, ReleaseVerifiedDocument, PayloadDocument)

_EXAMPLES: Final = """\
examples:
  flasher release build bike.wfw --image bms=FILE.hex --product 48V --counter 7 --trust trust.json
  flasher release sign bike.wfw --key anna.key
  flasher release verify bike.wfw
  flasher release show bike.wfw

A release is one file: images with their manifests, signatures, and the trust file, so that a USB
stick brings revoked keys to computers without a network. It protects the process, not the device:
the bootloader checks no signature, and takes any image from another tool.
"""
_BUILD_EXAMPLES: Final = """\
examples:
  flasher release build bms.wfw --image bms=FILE.hex --product 48V --counter 7 --trust trust.json
  flasher release build bike.wfw --image bms=FILE.hex --image wmc=MOTOR.hex --product 48V \\
      --counter 8 --notes notes.md --sbom sbom.json --log log.json --log-key log.key
  flasher release build bms.hex.wfw --image bms=FILE.hex --product 48V --counter 9 --detached

A manifest beside an image (bms.hex.toml) gives its rules. The day of the release is today's, or
that of SOURCE_DATE_EPOCH: the same images, options and day give the same bytes on every computer.
"""


@group(epilog=_EXAMPLES, exit_codes=(ExitCode.IMAGE, ExitCode.WRONG_DEVICE))
def release() -> None:
    """Build, sign, verify and show signed releases (*.wfw) of images."""


_file = argument(
    "file", metavar="FILE", type=values.FilePath(SUFFIX.removeprefix(".")), help="the release"
)


# -- build ----------------------------------------------------------------------------------------


def _image(text: str) -> tuple[Target, str]:
    name, equals, path = text.partition("=")
    if not (equals and path):
        raise click.BadParameter(f"{text!a} is not TARGET=FILE")
    return values.target(name), path


def _product(text: str) -> str:
    try:
        check_statement("product", text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return text


@release.action("build", epilog=_BUILD_EXAMPLES)
@argument("file", metavar="FILE", type=values.FilePath("wfw"), help="the release to write")
@option(
    "--image", "images", type=_image, multiple=True, required=True, metavar="TARGET=FILE",
    panel="release", help="an image and its target; may be repeated, one for each target",
)  # fmt: skip
@option(
    "--product", type=_product, metavar="NAME", panel="release", brief=True,
    help="the product whose releases share a counter (default: of the manifests)",
)  # fmt: skip
@option(
    "--counter", type=values.count, metavar="N", panel="release", brief=True,
    help="number of the release, higher than all before (default: of the manifests)",
)  # fmt: skip
@option(
    "--released", type=date, metavar="DATE", panel="release",
    help="day of the release (default: of SOURCE_DATE_EPOCH, else today)",
)  # fmt: skip
@option(
    "--notes", metavar="FILE", type=values.FilePath("md", "txt"), panel="release",
    help="release notes for people",
)  # fmt: skip
@option(
    "--sbom", metavar="FILE", type=values.FilePath("json"), panel="release",
    help="list of what the firmware is made of (SBOM, in JSON)",
)  # fmt: skip
@option(
    "--trust", metavar="FILE", type=values.FilePath("json"), panel="release", brief=True,
    help="trust file of `flasher trust`, so that the release brings the newest one",
)  # fmt: skip
@option(
    "--log", "ledger", metavar="FILE", type=values.FilePath("json"), panel="release",
    help="log of releases, which is appended to, or created; needs --log-key",
)  # fmt: skip
@option(
    "--log-key", "log_keys", multiple=True, metavar="KEY", type=values.FilePath(), panel="keys",
    help="key that signs the log; may be repeated",
)  # fmt: skip
@option(
    "--detached", is_flag=True, panel="release",
    help="without the image, for a file IMAGE.wfw beside it",
)  # fmt: skip
@option("--force", is_flag=True, panel="release", help="overwrite an older release")
@passphrase_options
def build_(
    output: Output,
    passphrases: Passphrases,
    *,
    file: str,
    images: tuple[tuple[Target, str], ...],
    product: str | None,
    counter: int | None,
    released: str | None,
    notes: str | None,
    sbom: str | None,
    trust: str | None,
    ledger: str | None,
    log_keys: tuple[str, ...],
    detached: bool,
    force: bool,
) -> int:
    """Build a release of images, without signatures yet."""
    path = Path(file)
    check_new(path, "FILE", force=force)
    check_writable(path, "FILE", [*(each for _, each in images), notes, sbom, trust, ledger])
    _check_build(path, images, detached=detached, has_log=bool(ledger), has_key=bool(log_keys))
    parts: dict[Target, Part] = {}
    for target, image in images:
        if target in parts:
            raise UsageError(
                f"Two images are named for the {target.node.name}.",
                remedy="A release has one image for each target.",
            )
        parts[target] = _part(image, target, product, counter)
    chain = _read_chain(trust)
    with _locked_log(ledger) as earlier:
        raw, log = build(
            parts,
            released=released or today(),
            notes=_document(notes, "release notes"),
            sbom=_document(sbom, "SBOM"),
            chain=chain,
            log=earlier,
            log_keys=open_keys(log_keys, passphrases),
            is_detached=detached,
        )
        package = verify.parse_package(container.unpack(raw, file), file)
        if log is not None and ledger is not None:
            # First the log: a release that it lacks would be refused, and the next one fork it.
            write_whole(Path(ledger), log.to_bytes(), "--log")
    write_whole(path, raw, "FILE")
    output.result(
        f"written: {printable(file)}, without signatures: `flasher release sign` adds them"
    )
    _print(output, package)
    return output.document(_release_document(package))


def _check_build(
    path: Path,
    images: tuple[tuple[Target, str], ...],
    *,
    detached: bool,
    has_log: bool,
    has_key: bool,
) -> None:
    if has_log != has_key:
        raise UsageError(
            "A log of releases and the key that signs it go together.",
            remedy="Name both --log and --log-key, or neither.",
        )
    if not detached:
        return
    if len(images) > 1:
        raise UsageError("A detached release has one image.", remedy="Build one for each image.")
    beside = detached_path(images[0][1])
    if path.absolute() != beside.absolute():
        raise UsageError(
            f"A detached release is looked for beside its image, as {printable(str(beside))}.",
            remedy="Give it this name.",
        )


def _part(image: str, target: Target, product: str | None, counter: int | None) -> Part:
    """Load an image with the manifest beside it. Raises ImageError and UsageError."""
    loaded = load(image)
    beside = find_release(image)
    if beside is None:
        check_plausible(loaded)
        stated = release_of(loaded, target, source=image, product=product, counter=counter)
    else:
        beside.check_bytes(loaded)
        stated = replace(
            beside, product=product or beside.product, counter=counter or beside.counter
        )
    check_target(loaded, stated, target)
    if stated.product is None or stated.counter is None:
        raise UsageError(
            f"The image for the {target.node.name} has no product or no counter.",
            where=printable(image),
            remedy="Give --product and --counter, or write them into its manifest.",
        )
    content = read(image, container.MAX_SIZE, what="image", error=ImageError)
    name = Path(image).name
    if not container.is_member_name(f"{container.IMAGES}{name}"):
        raise UsageError(
            f"The file name {printable(name)} cannot be in a release.",
            remedy="Rename it: letters, digits, and . _ + - are possible.",
        )
    return Part(name, content, loaded, stated)


def _document(path: str | None, what: str) -> bytes | None:
    return None if path is None else read(path, _DOCUMENT_MAX_SIZE, what=what)


def _read_chain(path: str | None) -> Chain | None:
    if path is None:
        return None
    return parse_chain(read(path, CHAIN_MAX_SIZE, what="trust file"), path).check()


@contextmanager
def _locked_log(path: str | None) -> Iterator[ReleaseLog | None]:
    """Yield the log of releases, if any, which no other build appends to meanwhile."""
    if not path:
        yield None
        return
    try:
        held = FileLock(f"{path}.lock", timeout=_LOG_LOCK_S).acquire()
    except (OSError, Timeout) as error:
        raise UsageError(
            f"The log of releases {printable(path)} cannot be locked.",
            cause="another build uses it, or its folder does not exist or is read-only",
            remedy="Run one build after the other.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        ) from error
    with held:
        yield _read_log(path)


def _read_log(path: str) -> ReleaseLog:
    if not os.path.lexists(path):
        return ReleaseLog()
    try:
        return parse_log(read(path, LOG_MAX_SIZE, what="log of releases"))
    except ValueError as error:
        raise UsageError(
            f"The log of releases {printable(path)} cannot be used: {error}.",
            remedy="Take its newest copy, such as the one in the last release.",
            code=ErrorCode.FILE_FAULTS,
        ) from error


# -- signatures -----------------------------------------------------------------------------------


@release.action(
    "sign",
    epilog="""\
examples:
  flasher release sign bike.wfw --key anna.key
  flasher release sign bike.wfw --key 'hsm:2?label=release'
  flasher release sign bike.wfw --key anna.key --passphrase-fd 3 3<passphrase.txt
""",
)
@_file
@key_option("the key that signs")
@passphrase_options
def sign(output: Output, passphrases: Passphrases, *, file: str, keys: tuple[str, ...]) -> int:
    """Add signatures to a release."""
    package = verify.open_package(file)
    _check_images(package, file)
    opened = open_keys(keys, passphrases)
    raw = with_signatures(package, package.envelope.sign(opened))
    return _write(output, file, raw, [key.public for key in opened])


def _check_images(package: verify.Package, file: str) -> None:
    """Check before it is signed that a release is whole. Raises ImageError."""
    beside = file.removesuffix(SUFFIX) if package.is_detached else None
    for target in package.targets:
        verify.image_of(package, target, beside=beside)


def _write(output: Output, file: str, raw: bytes, keys: list[PublicKey]) -> int:
    write_whole(Path(file), raw, "FILE")
    for key in keys:
        output.result(f"added: signature of {key.id}")
    package = verify.open_package(file)
    _print(output, package)
    return output.document(_release_document(package))


@release.action(
    "payload",
    epilog="""\
examples:
  flasher release payload bike.wfw -o bike.payload
  openssl pkeyutl -sign -rawin -in bike.payload -inkey anna.key -out anna.sig   (Ed25519)
  openssl dgst -sha256 -sign anna.key -out anna.sig bike.payload                (P-256)
  flasher release attach bike.wfw --public-key anna.key.pub --signature anna.sig
""",
)
@_file
@option(
    "-o", "--output", "to", required=True, metavar="FILE", type=values.FilePath(),
    panel="release", help="where the bytes are written",
)  # fmt: skip
@option("--force", is_flag=True, panel="release", help="overwrite an older file")
def payload(output: Output, *, file: str, to: str, force: bool) -> int:
    """Write the bytes that are to be signed, for a key on another machine."""
    check_new(Path(to), "-o", force=force)
    check_writable(Path(to), "-o", [file])
    package = verify.open_package(file)
    _check_images(package, file)
    signed = package.envelope.signed_bytes
    write_whole(Path(to), signed, "-o")
    digest = hashlib.sha256(signed).hexdigest()
    output.result(f"written: {printable(to)}, SHA-256 {digest}")
    return output.document(PayloadDocument(file, to, digest))


@release.action(
    "attach",
    epilog="""\
examples:
  flasher release attach bike.wfw --public-key anna.key.pub --signature anna.sig
""",
)
@_file
@option(
    "--public-key", required=True, metavar="FILE", type=values.FilePath("pub", "pem"),
    panel="keys", help="public key of the signature, in PEM",
)  # fmt: skip
@option(
    "--signature", required=True, metavar="FILE", type=values.FilePath(), panel="keys",
    help="the signature: raw for Ed25519, DER for P-256",
)  # fmt: skip
def attach(output: Output, *, file: str, public_key: str, signature: str) -> int:
    """Attach a signature that was made on another machine. A wrong one is refused."""
    package = verify.open_package(file)
    key = read_public_key(public_key)
    made = read(signature, _SIGNATURE_MAX_SIZE, what="signature")
    checked = Envelope(package.envelope.payload, package.envelope.payload_type, {key.id: made})
    if not checked.signers([key]):
        raise ImageError(
            f"{printable(signature)} is no signature of this release by the key {key.id}.",
            cause="the payload of another release was signed, or by another key",
            remedy="Sign the file of `flasher release payload`, as its help shows.",
            code=ErrorCode.RELEASE_UNSIGNED,
        )
    return _write(output, file, with_signature(package, key.id, made), [key])


# -- verify and show ------------------------------------------------------------------------------


@release.action(
    "verify",
    epilog="""\
examples:
  flasher release verify bike.wfw
  flasher release verify bike.wfw -t bms --json

Exit code 3 for a release that would not be flashed, 2 without a trust file on this computer;
nothing is sent in any case.
""",
)
@_file
@target_option(required=False)
def verify_(output: Output, target: Target | None, *, file: str) -> int:
    """Check a release as `flasher flash --require-signed` does before it opens a bus."""
    package = verify.open_package(file)
    now = datetime.datetime.now(datetime.UTC).date()
    signers: dict[str, list[str]] = {}
    warnings: dict[str, None] = {}
    version = None
    for each in package.targets if target is None else (target,):
        found = verify.provenance_of(package, each, now, is_required=True)
        if found.problem is not None:
            raise found.problem
        beside = file.removesuffix(SUFFIX) if package.is_detached else None
        verify.image_of(package, each, beside=beside)
        output.result(f"{each.node.name}: {found.text}")
        signers[each.name] = list(found.signers)
        warnings |= dict.fromkeys(found.warnings)
        version = found.trust_version
    for warning in warnings:
        output.error_line(f"warning: {warning}")
    return output.document(
        ReleaseVerifiedDocument(file, list(signers), version, signers, list(warnings))
    )


@release.action(
    "show",
    epilog="""\
examples:
  flasher release show bike.wfw
  flasher release show bike.wfw --json
""",
)
@_file
def show(output: Output, *, file: str) -> int:
    """Show what is in a release. Its signatures are not checked: that is `release verify`."""
    package = verify.open_package(file)
    _print(output, package)
    return output.document(_release_document(package))


def _release_document(package: verify.Package) -> ReleaseDocument:
    log = package.log
    return ReleaseDocument(
        file=package.source,
        released=package.statement.released,
        images=[
            ReleaseImageDocument(target.name, name, release)
            for target, (name, release) in package.statement.images.items()
        ],
        signed_by=sorted(map(printable, package.envelope.signatures)),
        trust_version=package.chain.newest.version if package.chain else None,
        log_size=len(log.entries) if log else None,
        log_head=log.head if log else None,
        sha256=hashlib.sha256(package.envelope.payload).hexdigest(),
        is_detached=package.is_detached,
    )


def _print(output: Output, package: verify.Package) -> None:
    shown = _release_document(package)
    rows = [("released:", shown.released)]
    for each in shown.images:
        release = each.release
        version = release.firmware_version or "without a version"
        rows.append(
            (
                f"{release.target.node.name}:",
                f"{version}, product {release.product}, counter {release.counter}, sha256 "
                + release.sha256,
            )
        )
    signed = ", ".join(shown.signed_by) or "no key yet"
    rows.append(("signatures of:", f"{signed} (not checked here)"))
    if package.chain is not None:
        rows.append(
            (
                "trust file:",
                f"{printable(package.chain.newest.name)}, version {shown.trust_version}",
            )
        )
    if shown.log_head is not None:
        rows.append(("log:", f"{shown.log_size} releases, head {shown.log_head[:16]}"))
    output.table(rows, indent=2)
