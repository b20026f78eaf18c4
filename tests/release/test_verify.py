"""Releases before anything is sent: what the trust file of this computer makes of them."""

from __future__ import annotations

import datetime
import subprocess
import sys
from pathlib import Path

import pytest

from flasher.errors import ErrorCode, FlasherError
from flasher.image.load import load
from flasher.image.release import Provenance
from flasher.protocol.spec import BMS
from flasher.release import verify
from flasher.release.store import TrustStore
from tests.release.maker import IMAGE, Maker, opened

TODAY = datetime.date(2026, 2, 2)


def checked(raw: bytes, today: datetime.date = TODAY) -> Provenance:
    return verify.provenance_of(opened(raw), BMS, today)


def code_of(raw: bytes) -> ErrorCode | None:
    """The code by which a release is refused; None for one that is flashed."""
    try:
        package = opened(raw)
        found = verify.provenance_of(package, BMS, TODAY)
        if found.problem is not None:
            raise found.problem
        verify.image_of(package, BMS)
    except FlasherError as error:
        return error.code
    return None


def test_a_signed_release_names_its_signers_and_gives_the_bytes_of_the_image() -> None:
    maker = Maker()
    TrustStore().install(maker.chain)
    raw = maker.release(counter=7)
    found = checked(raw)
    assert found.problem is None
    assert "(anna)" in found.text
    image, release = verify.image_of(opened(raw), BMS)
    assert image.data == load(IMAGE).data
    assert (release.product, release.counter) == ("48V", 7)


def test_without_a_trust_file_signatures_are_reported_as_unchecked() -> None:
    found = checked(Maker().release(signers=()))
    assert (found.problem, found.signers) == (None, ())


@pytest.mark.parametrize("signers", [(), ("root a",), ("a stranger",)])
def test_a_release_without_a_trusted_signature_is_refused(signers: tuple[str, ...]) -> None:
    maker = Maker()
    TrustStore().install(maker.chain)
    assert code_of(maker.release(signers=signers)) is ErrorCode.RELEASE_UNSIGNED


def test_what_was_seen_is_kept_in_the_data_folder(own_computer: Path) -> None:
    maker = Maker()
    TrustStore().install(maker.chain)
    checked(maker.release())
    known = TrustStore().load()
    assert known is not None
    assert (known.seen.version, known.seen.newest_date) == (1, "2026-02-01")
    assert list((own_computer / "data").rglob("*.json"))


_WITHOUT_TRUST = """
import os, sys
from flasher import api, jobs
from flasher.protocol.spec import BMS
from flasher.settings.profile import load_profile
jobs.prepare(sys.argv[1], load_profile(os.devnull, BMS)).checked()
wanted = {"flasher.release.verify", "securesystemslib", "cryptography"}
sys.exit(repr(wanted & sys.modules.keys()) if wanted & sys.modules.keys() else 0)
"""


@pytest.mark.slow
def test_an_upgrade_without_a_trust_file_loads_nothing_for_signatures() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT_TRUST, IMAGE], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
