"""Checks of a release before anything is sent: signatures, trust, log, counters, hashes, target.

They come in this order. `provenance_of` never raises what a waiver may pass over: the refusal is in
its result. A container or an image that is damaged is an error in any case.
"""

from __future__ import annotations

import datetime
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from typing import Final

from flasher.errors import ErrorCode, FlasherError, ImageError, UsageError, WrongDeviceError
from flasher.history import FlashHistory, highest_counters
from flasher.i18n import Text, text
from flasher.image.image import Image
from flasher.image.load import load
from flasher.image.release import Provenance, Release
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.release import container
from flasher.release.container import LOG, STATEMENT, TRUST, damaged
from flasher.release.envelope import Envelope, parse_envelope
from flasher.release.statement import PAYLOAD_TYPE, Statement, parse_statement
from flasher.release.store import Known, TrustStore, days_between
from flasher.release.transparency import ReleaseLog, parse_log
from flasher.release.trust import Chain, newer, parse_chain

UPDATE_DUE_DAYS: Final = 90
"""Age in days of the newest trusted date above which a warning asks for an update."""


@dataclass(frozen=True)
class Package:
    """Opened release, of which nothing but the form has been checked."""

    source: str
    members: Mapping[str, bytes]
    envelope: Envelope
    statement: Statement
    chain: Chain | None
    log: ReleaseLog | None

    @property
    def is_detached(self) -> bool:
        """True if the images are files beside the release."""
        return not any(name.startswith(container.IMAGES) for name in self.members)

    @cached_property
    def targets(self) -> tuple[Target, ...]:
        return tuple(self.statement.images)


def open_package(path: str | os.PathLike[str]) -> Package:
    """Open a release. Raises UsageError, and ImageError for another form than `build` writes."""
    return parse_package(container.read(path), os.fspath(path))


def parse_package(members: Mapping[str, bytes], source: str) -> Package:
    """Parse the members of a release. Raises ImageError."""
    shown = printable(source)
    if STATEMENT not in members:
        raise damaged(shown, text("it has no {name}", name=STATEMENT))
    try:
        envelope = parse_envelope(members[STATEMENT], PAYLOAD_TYPE)
        log = parse_log(members[LOG]) if LOG in members else None
    except ValueError as error:
        raise damaged(shown, printable(str(error))) from error
    statement = parse_statement(envelope.payload, source)
    for name in members:
        if name not in statement.files and name not in (STATEMENT, TRUST, LOG):
            raise damaged(shown, text("{name} in it is not part of its statement", name=name))
    chain = None
    if TRUST in members:
        try:
            chain = parse_chain(members[TRUST], source)
        except FlasherError as error:
            if error.code is ErrorCode.PACKAGE_MISSING:
                chain = None  # nothing can be checked; without a trust file nothing has to be
            else:
                raise damaged(
                    shown, text("its trust file cannot be used"), where=error.what
                ) from error
    return Package(source, members, envelope, statement, chain, log)


# -- the images ------------------------------------------------------------------------------------


def check_target(package: Package, target: Target) -> None:
    """Raise WrongDeviceError if a release has no image for a target."""
    if target in package.statement.images:
        return
    names = ", ".join(each.node.name for each in package.targets)
    raise WrongDeviceError(
        text("The release has no image for the {target}.", target=target.node.name),
        where=text("{file} has: {names}", file=printable(package.source), names=names),
        remedy=text("Choose a release for this target, or the target that it is for."),
        code=ErrorCode.NOT_FOR_DEVICE,
    )


def image_of(
    package: Package,
    target: Target,
    *,
    beside: str | os.PathLike[str] | None = None,
    allow_outside_vector: bool = False,
) -> tuple[Image, Release]:
    """Load the image for a target, with its manifest. `beside` is the image of a detached release.

    Raises ImageError if a file, or the bytes to be sent, are not those of the statement;
    WrongDeviceError without an image for the target.
    """
    shown = printable(package.source)
    for name, stated in package.statement.files.items():
        if name in package.members:
            if hashlib.sha256(package.members[name]).hexdigest() != stated:
                raise _differs(shown, name)
        elif not (package.is_detached and name.startswith(container.IMAGES)):
            raise damaged(shown, text("{name} is missing in it", name=name))
    check_target(package, target)
    name, release = package.statement.images[target]
    if package.is_detached:
        if beside is None:
            raise ImageError(
                text("{file} is a release without its images.", file=shown),
                remedy=text("Name the image, beside which the release lies."),
                code=ErrorCode.RELEASE_DAMAGED,
            )
        image = load(beside, allow_outside_vector=allow_outside_vector)
    else:
        image = load(
            f"{package.source}/{name}",  # its suffix may decide on the format
            stream=BytesIO(package.members[name]),
            allow_outside_vector=allow_outside_vector,
        )
    if image.sha256 != release.sha256 or image.size_bytes != release.size_bytes:
        raise _differs(shown, name)
    return image, release


def _differs(shown: str, name: str) -> ImageError:
    return ImageError(
        text("{name} is not what was signed in {file}.", name=name, file=shown),
        where=text("its SHA-256 differs from that in the statement"),
        cause=text("a damaged copy, another build, or a forgery"),
        remedy=text("Get image and release again from their maker."),
        code=ErrorCode.RELEASE_DIFFERS,
    )


# -- what the trust file says ----------------------------------------------------------------------


def unsigned(source: str) -> Provenance:
    """Provenance of an image without a release, on a computer with a trust file."""
    problem: FlasherError
    try:
        TrustStore().load()
    except FlasherError as error:
        problem = error
    else:
        problem = ImageError(
            text("{file} is not signed.", file=printable(source)),
            remedy=Text(
                "{remedy} {option}",
                {
                    "remedy": text("Take the release (*.wfw) of its maker."),
                    "option": text("--allow-unsigned flashes your own image."),
                },
            ),
            code=ErrorCode.RELEASE_UNSIGNED,
        )
    return Provenance(text=text("the image is not signed"), problem=problem)


def unchecked(source: str, *, is_required: bool) -> Provenance:
    """Provenance of an image on a computer without a trust file."""
    sentence = text("no trust file on this computer: signatures are not checked")
    problem: FlasherError | None = None
    if is_required:
        problem = UsageError(
            text("The signature of {file} cannot be checked.", file=printable(source)),
            cause=text("this computer has no trust file"),
            remedy=text("Take over the maker's keys: `flasher trust install FILE`."),
            code=ErrorCode.TRUST_MISSING,
        )
    return Provenance(text=sentence, problem=problem)


def provenance_of(
    package: Package,
    target: Target,
    today: datetime.date,
    *,
    is_required: bool = False,
) -> Provenance:
    """Check a release against the trust file of this computer, and store what it brings: a newer
    trust file, log and date. `is_required` refuses without a trust file.

    A computer that cannot store it is warned.
    """
    store = TrustStore()
    warnings: list[str] = []
    try:
        known = store.load()
        if known is None:
            return unchecked(package.source, is_required=is_required)
        known = _with_chain(package, known, store, warnings)
        signers = _check(package, target, known)
    except FlasherError as error:
        return Provenance(text=error.what, problem=error)
    date = max(package.statement.released, known.trust.issued)
    log = package.log.entries if package.log and known.trust.log else ()
    known = _learned(store, known, known.chain, date, log, warnings)
    names = ", ".join(map(known.trust.shown, sorted(signers)))
    role = known.trust.role(target.name)
    threshold = role.threshold if role else 0
    release = package.statement.release_for(target)
    return Provenance(
        text=text(
            "signed by {names}, keys needed: {threshold}, trust file version {version}, "
            "counter {counter}",
            names=names,
            threshold=threshold,
            version=known.trust.version,
            counter=release.counter,
        ),
        signers=tuple(sorted(signers)),
        threshold=threshold,
        trust_version=known.trust.version,
        warnings=(*dict.fromkeys(warnings), *warnings_of(known, today)),
        highest_counters=_counters_seen(target, release.product or ""),
    )


def _with_chain(package: Package, known: Known, store: TrustStore, warnings: list[str]) -> Known:
    """Take a newer trust file from a release. What it revokes holds even if the release is refused.
    Raises UsageError for a fork, and one that lacks signatures.
    """
    if package.chain is None:
        return known
    chain = newer(known.chain, package.chain)
    if chain is known.chain:
        return known
    return _learned(store, known, chain.check(), chain.newest.issued, (), warnings)


def _learned(
    store: TrustStore,
    known: Known,
    chain: Chain,
    date: str,
    log: tuple[str, ...],
    warnings: list[str],
) -> Known:
    """Store what was seen; a folder that cannot be written to keeps no release from being used."""
    try:
        return store.learn(known, chain, date, log)
    except FlasherError as error:
        warnings.append(
            text("an older trust file will not be noticed on this computer: {why}", why=error.what)
        )
        return Known(chain, known.seen)


def _check(package: Package, target: Target, known: Known) -> frozenset[str]:
    """Return the ids of the keys that signed. Raises ImageError for a release that the trust file
    does not allow.
    """
    trust, shown = known.trust, printable(package.source)
    check_target(package, target)
    signers = _check_signatures(package.envelope, target, known, shown)
    if package.statement.released > trust.expires:
        raise ImageError(
            text(
                "{file} was released on {released}, when the trust file had expired.",
                file=shown,
                released=package.statement.released,
            ),
            where=text(
                "version {version} is valid for releases until {expires}",
                version=trust.version,
                expires=trust.expires,
            ),
            cause=text("the maker has not renewed the trust file, or an old key was misused"),
            remedy=text("Take a release with a newer trust file from its maker."),
            code=ErrorCode.RELEASE_EXPIRED,
        )
    _check_log(package, known, shown)
    release = package.statement.release_for(target)
    minimum = trust.minimum_counters.get(target.name, {}).get(release.product or "", 0)  # type: ignore[call-overload]
    if (release.counter or 0) < minimum:
        raise ImageError(
            text(
                "{file} has the counter {counter}; its maker withdrew all below {minimum}.",
                file=shown,
                counter=release.counter,
                minimum=minimum,
            ),
            cause=text("an old release, with a fault that was fixed since"),
            remedy=text("Take the newest release from its maker."),
            code=ErrorCode.RELEASE_OLD,
        )
    return signers


def _check_signatures(
    envelope: Envelope, target: Target, known: Known, shown: str
) -> frozenset[str]:
    trust = known.trust
    role = trust.role(target.name)
    name = target.node.name
    if role is None:
        raise ImageError(
            text("No key may sign images for the {target}.", target=name),
            where=text("version {version} of the trust file", version=trust.version),
            remedy=text("Take a newer trust file from the maker of this target's firmware."),
            code=ErrorCode.RELEASE_UNSIGNED,
        )
    signers = trust.signers(role, envelope)
    if len(signers) >= role.threshold:
        return signers
    remedy = text("Take the release again from its maker; do not flash it otherwise.")
    if not envelope.signatures:
        cause: str = text("it was built, but not signed")
        remedy = text("Sign it with `flasher release sign`, or take the signed one from its maker.")
    elif revoked := _revoked(envelope, known):
        cause = text("the key {key} was revoked", key=revoked)
    elif signers:
        cause = text("not all who have to sign it have done so")
        remedy = text("Let the others sign it: `flasher release sign`.")
    elif any(each in role.keys for each in envelope.signatures):
        cause = text("the signed text was changed: a forgery, or a damaged copy")
    else:
        cause = text(
            "keys signed it that the trust file does not name for the {target}", target=name
        )
    raise ImageError(
        text(
            "{file} has {count} of the {threshold} signatures that the trust file asks for.",
            file=shown,
            count=len(signers),
            threshold=role.threshold,
        ),
        where=text(
            "the {target}, version {version} of the trust file",
            target=name,
            version=trust.version,
        ),
        cause=cause,
        remedy=remedy,
        code=ErrorCode.RELEASE_UNSIGNED,
    )


def _revoked(envelope: Envelope, known: Known) -> str:
    """Return a key of an older trust file that signed and is in no role any more."""
    *older, newest = known.chain.versions
    for trust in reversed(older):
        for key_id in sorted(envelope.signatures):
            if key_id in trust.keys and key_id not in newest.keys:
                return trust.shown(key_id)
    return ""


def _check_log(package: Package, known: Known, shown: str) -> None:
    """Check that the release is in the log, and the log no other one than was seen before."""
    trust, log = known.trust, package.log
    if trust.log is None and log is None:
        return
    why = ""
    if log is None:
        why = text("it has no log of releases")
    elif package.envelope.payload not in log:
        why = text("it is not in its log of releases")
    elif trust.log is not None and (
        len(trust.signers(trust.log, log.checkpoint)) < trust.log.threshold
    ):
        why = text("its log of releases lacks a signature")
    elif trust.log is not None and not log.agrees_with(known.seen.log):
        why = text("its log of releases contradicts the one that this computer has seen")
    if why:
        raise ImageError(
            text("{file} is not proven to be public: {why}.", file=shown, why=why),
            cause=text("a release that its maker never listed, or lists for some only"),
            remedy=text("Do not flash it, and ask the maker: keys may have been stolen."),
            code=ErrorCode.RELEASE_LOG,
        )


def warnings_of(known: Known, today: datetime.date) -> list[str]:
    """Warn by dates, which decide nothing: the clock of this computer may be wrong."""
    found: list[str] = []
    trust = known.trust
    age = days_between(max(known.seen.newest_date, trust.issued), today)
    if age > UPDATE_DUE_DAYS:
        found.append(
            text(
                "no news from the maker for {days} days: keys may have been revoked meanwhile; "
                "take a newer release or trust file",
                days=age,
            )
        )
    if days_between(trust.expires, today) > 0:
        found.append(text("the trust file expired on {expires}", expires=trust.expires))
    return found


def _counters_seen(target: Target, product: str) -> dict[str, int]:
    try:
        flashes, _ = FlashHistory().flashes()
    except FlasherError:
        return {}
    return highest_counters(flashes, target=target.name, product=product)
