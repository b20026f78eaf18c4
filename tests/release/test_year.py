"""A year in a workshop: releases, new keys, a theft, 200 days without news, a stick, a rollback."""

from __future__ import annotations

import datetime
import os
import shutil
from pathlib import Path

import pytest

from flasher import jobs
from flasher.errors import ErrorCode, FlasherError
from flasher.image.release import Provenance
from flasher.protocol.spec import BMS
from flasher.release import verify
from flasher.release.places import CHAIN_FILE, TRUST_FILE
from flasher.release.store import TrustStore
from flasher.release.transparency import ReleaseLog
from flasher.settings.profile import load_profile
from tests.release.maker import Maker, chain_of, first_trust, opened, role, trusted


class Workshop:
    """A computer that flashes releases, on given days."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def flash(self, raw: bytes, day: str) -> ErrorCode | Provenance:
        """Verify a release on a day: the code of the refusal, or what is known of its origin."""
        found = verify.provenance_of(opened(raw), BMS, datetime.date.fromisoformat(day))
        path = self._folder / "stick.wfw"
        path.write_bytes(raw)
        try:
            job = jobs.prepare(path, load_profile(os.devnull, BMS)).checked()
        except FlasherError as error:
            assert found.problem is not None
            return error.code
        assert job.identity.provenance is not None
        assert job.identity.provenance.signers == found.signers
        return found


def accepted(found: ErrorCode | Provenance) -> Provenance:
    assert isinstance(found, Provenance), found
    assert found.problem is None
    return found


@pytest.mark.slow
def test_a_year(tmp_path: Path) -> None:
    workshop = Workshop(tmp_path)
    trust = first_trust(keys=trusted("root a", "root b", "anna", "bert", "log"), log=role("log"))
    maker = Maker(chain_of(trust), ReleaseLog())
    store = TrustStore()

    # January: the workshop takes over the maker's keys, and flashes a first release.
    store.install(maker.chain)
    january = maker.release(counter=1, released="2026-01-15")
    assert accepted(workshop.flash(january, "2026-01-16")).warnings == ()

    # March: Anna gets a new key. The release brings the new trust file, and the old key ends.
    maker.next_version(
        issued="2026-03-01",
        keys=trusted("root a", "root b", "anna's new", "bert", "log"),
        release={"bms": role("anna's new", "bert")},
    )
    march = maker.release(counter=2, signers=("anna's new",), released="2026-03-02")
    assert accepted(workshop.flash(march, "2026-03-03")).trust_version == 2
    assert workshop.flash(january, "2026-03-03") is ErrorCode.RELEASE_UNSIGNED

    # April: Bert's laptop is stolen. The maker revokes his key; the workshop has no network.
    backup = tmp_path / "backup"
    shutil.copytree(store.path.parent, backup)
    stolen = Maker(maker.chain, maker.log)
    maker.next_version(
        issued="2026-04-10",
        keys=trusted("root a", "root b", "anna's new", "log"),
        release={"bms": role("anna's new")},
        minimum_counters={"bms": {"48V": 2}},
    )

    # Until the news arrives, dates only warn: 90 days without any are too long.
    assert accepted(workshop.flash(march, "2026-05-31")).warnings == ()
    (warning,) = accepted(workshop.flash(march, "2026-06-01")).warnings
    assert "91 days" in warning

    # The thief has Bert's key, and no log: his release is in none that the maker's key signed.
    stolen.log_signers = ("bert",)
    forged = stolen.release(counter=9, signers=("bert",), released="2026-05-01")
    assert workshop.flash(forged, "2026-06-02") is ErrorCode.RELEASE_LOG

    # After 200 days a stick comes with the autumn's release, and with it the revocation.
    autumn = maker.release(counter=3, signers=("anna's new",), released="2026-09-15")
    (warning,) = accepted(workshop.flash(march, "2026-09-18")).warnings
    assert "200 days" in warning
    assert accepted(workshop.flash(autumn, "2026-09-18")).warnings == ()
    assert workshop.flash(forged, "2026-09-18") is ErrorCode.RELEASE_UNSIGNED
    assert accepted(workshop.flash(march, "2026-09-18")).trust_version == 3

    # A clock that runs wrong decides nothing.
    assert accepted(workshop.flash(autumn, "1990-01-01")).warnings == ()
    assert "expired" in " ".join(accepted(workshop.flash(autumn, "2031-01-01")).warnings)

    # December: somebody puts the trust file of April back, in which Bert may still sign.
    for name in (TRUST_FILE, CHAIN_FILE):
        shutil.copy(backup / name, store.path.parent / name)
    assert workshop.flash(autumn, "2026-12-01") is ErrorCode.TRUST_ROLLED_BACK
    assert workshop.flash(forged, "2026-12-01") is ErrorCode.TRUST_ROLLED_BACK
    chain = opened(autumn).chain
    assert chain is not None
    store.install(chain, replaces=True)
    assert accepted(workshop.flash(autumn, "2026-12-01")).trust_version == 3
