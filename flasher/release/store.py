"""Trust store: the trust file of this computer, and the newest version seen of it.

The trust file is in the system's or the user's configuration: `trust.toml` to read, and
`trust.json` with all its versions and their signatures. A newer version that a release brings is
stored for the user. Version, log and newest date that were seen are kept apart, so that an older
trust file in the place of the newer one is noticed.
"""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock, Timeout

from flasher.errors import ErrorCode, FlasherError, UsageError
from flasher.files import parse_json, read, replace_private
from flasher.i18n import text
from flasher.protocol.text import printable
from flasher.release.envelope import json_bytes
from flasher.release.places import CHAIN_FILE, TRUST_FILE, seen_folder, trust_folders
from flasher.release.transparency import LOG_MAX_SIZE
from flasher.release.trust import (
    CHAIN_MAX_SIZE,
    Chain,
    Trust,
    newer,
    parse_chain,
    untrusted,
)

if TYPE_CHECKING:
    from flasher.settings.toml_reader import Reader

_LOCK_LIMIT_S = 3.0


@dataclass(frozen=True)
class Seen:
    """The newest that this computer has seen of one trust."""

    version: int = 0
    """Version of the trust file."""
    newest_date: str = ""
    """Newest day that a trusted document stated; empty for none."""
    log: tuple[str, ...] = ()
    """Entries of the longest log."""


@dataclass(frozen=True)
class Known:
    """Trust of this computer."""

    chain: Chain
    seen: Seen = field(default_factory=Seen)

    @property
    def trust(self) -> Trust:
        return self.chain.newest


@cache
def _seen_reader() -> Reader[Seen]:
    from flasher.settings.toml_reader import Reader  # noqa: PLC0415

    return Reader(
        Seen,
        "note of what was seen of a trust file",
        remedy="Delete it if it is damaged: an older trust file is then no longer noticed.",
    )


class TrustStore:
    """Trust files of this computer, in their folders."""

    def __init__(self, folders: Sequence[Path] | None = None) -> None:
        """`folders` are the system's and the user's, in which new versions are stored."""
        self.folders = tuple(folders or trust_folders())
        self._seen = seen_folder()

    @property
    def path(self) -> Path:
        """Trust file of the user."""
        return self.folders[-1] / TRUST_FILE

    def load(self) -> Known | None:
        """Read the trust file; None without one.

        Raises UsageError if it was changed, lacks a signature, or is older than one seen before.
        """
        chains = [each for each in map(self._read, self.folders) if each is not None]
        if not chains:
            return None
        chain = chains[0]
        for other in chains[1:]:
            chain = newer(chain, other)
        chain.check()
        seen = self._read_seen(chain)
        if seen.version > chain.newest.version:
            raise UsageError(
                text(
                    "The trust file {file} is version {version}, but this computer has seen "
                    "version {seen}.",
                    file=printable(chain.source),
                    version=chain.newest.version,
                    seen=seen.version,
                ),
                cause=text(
                    "an older copy was put in its place: keys revoked since would be valid again"
                ),
                remedy=text("Take the newest one: `flasher trust install FILE`, from a release."),
                code=ErrorCode.TRUST_ROLLED_BACK,
            )
        return Known(chain, seen)

    def _read(self, folder: Path) -> Chain | None:
        toml, chain = folder / TRUST_FILE, folder / CHAIN_FILE
        missing = [path for path in (toml, chain) if not os.path.lexists(path)]
        if len(missing) == 2:
            return None
        if missing:
            raise untrusted(str(toml), text("{file} is missing", file=printable(str(missing[0]))))
        stated = read(toml, CHAIN_MAX_SIZE, what="trust file", was_named=False)
        raw = read(chain, CHAIN_MAX_SIZE, what="trust file", was_named=False)
        found = parse_chain(raw, str(chain))
        # An older version: storing a newer one was interrupted.
        if stated not in [each.payload for each in found.envelopes]:
            raise untrusted(str(toml), text("it is not what was signed"))
        return found

    def learn(self, known: Known, chain: Chain, date: str, log: Sequence[str] = ()) -> Known:
        """Store a newer chain, date or log than what is known; return what is known then.

        Raises UsageError if it cannot be stored.
        """
        seen = Seen(
            max(chain.newest.version, known.seen.version),
            max(date, known.seen.newest_date),
            tuple(log) if len(log) > len(known.seen.log) else known.seen.log,
        )
        if chain is known.chain and seen == known.seen:
            return known
        with self._locked():
            # Another program may have learned more meanwhile.
            with contextlib.suppress(FlasherError):
                current = self.load()
                if current is not None:
                    chain = newer(current.chain, chain)
                    seen = _newest(seen, current.seen)
            if chain.newest.version > known.trust.version:
                self._write_chain(chain)
            if seen != known.seen:
                replace_private(self._note(chain), json_bytes(vars(seen)))
        return Known(chain, seen)

    def install(self, chain: Chain, *, replaces: bool = False) -> Known:
        """Store a trust file for the user.

        Raises UsageError if it lacks a signature, is older than the one here, or, unless it
        `replaces` that, does not succeed it.
        """
        chain.check()
        with self._locked():
            if not replaces:
                known = self.load()
                if known is not None and newer(known.chain, chain) is not chain:
                    return known
            self._write_chain(chain)
            seen = Seen() if replaces else self._read_seen(chain)
            seen = replace(
                seen,
                version=max(seen.version, chain.newest.version),
                newest_date=max(seen.newest_date, chain.newest.issued),
            )
            replace_private(self._note(chain), json_bytes(vars(seen)))
        return Known(chain, seen)

    def _write_chain(self, chain: Chain) -> None:
        # In this order: a trust file may be an older version of its chain.
        self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        replace_private(self.path.with_name(CHAIN_FILE), chain.to_bytes())
        replace_private(self.path, chain.envelopes[-1].payload)

    def _note(self, chain: Chain) -> Path:
        return self._seen / f"{chain.anchor[:32]}.json"

    def _read_seen(self, chain: Chain) -> Seen:
        path = self._note(chain)
        if not os.path.lexists(path):
            return Seen()
        raw = read(path, LOG_MAX_SIZE, what="note of trust", was_named=False)
        try:
            document = parse_json(raw)
        except ValueError:
            document = None
        return _seen_reader().read(document if isinstance(document, dict) else {"log": None}, path)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self._seen.mkdir(parents=True, exist_ok=True, mode=0o700)
            with FileLock(self._seen / "lock", timeout=_LOCK_LIMIT_S, mode=0o600):
                yield
        except (OSError, Timeout) as error:
            reason = getattr(error, "strerror", None) or type(error).__name__
            raise UsageError(
                text("The trust file cannot be stored: {reason}.", reason=printable(reason)),
                where=printable(str(self.path)),
                remedy=text("Make the folder writable for this user, and room on the disk."),
                code=ErrorCode.FILE_NOT_WRITTEN,
            ) from error


def _newest(one: Seen, other: Seen) -> Seen:
    return Seen(
        max(one.version, other.version),
        max(one.newest_date, other.newest_date),
        max(one.log, other.log, key=len),
    )


def days_between(earlier: str, later: datetime.date) -> int:
    return (later - datetime.date.fromisoformat(earlier)).days
