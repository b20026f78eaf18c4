"""`flasher release`, `flasher trust`, and `flash` on a computer with a trust file."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from flasher.errors import ErrorCode, ExitCode
from tests.cli.conftest import SAMPLES, Flasher, Run, flasher

pytest.importorskip("securesystemslib")

__all__ = ["flasher"]
pytestmark = pytest.mark.slow
PASSPHRASE = "correct horse"  # noqa: S105
WITH = ("--passphrase-env", "KEY_WORDS")
FLASH = ("-t", "bms", "--mock", "--mock-speed", "0")


@pytest.fixture(autouse=True)
def workshop(tmp_path: Path, short_bms: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, and a computer without a trust file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_CONFIG_DIRS", str(tmp_path / "system"))
    monkeypatch.setenv("KEY_WORDS", PASSPHRASE)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1785000000")
    shutil.copy(short_bms, tmp_path / "bms.hex")
    return tmp_path


@pytest.fixture
def run(flasher: Flasher) -> Flasher:
    def run(*words: str) -> Run:
        return flasher(*words)

    return run


def made(run: Flasher, *words: str) -> Run:
    done = run(*words)
    assert done.code == ExitCode.OK, done.err
    return done


def code_of(run: Run) -> str:
    return str(json.loads(run.out.splitlines()[-1])["error"]["code"])


def works(run: Flasher) -> None:
    """Keys of a root, of Anna and of Bert, and a trust file in which Anna may sign."""
    for name in ("boss", "anna", "bert"):
        made(run, "trust", "key", f"{name}.key", *WITH)
    made(
        run, "trust", "init", "trust.json", "--name", "Works", "--grant", "root=boss.key.pub",
        "--grant", "bms=anna.key.pub", "--key", "boss.key", *WITH,
    )  # fmt: skip


def build(run: Flasher, name: str = "bike.wfw", *more: str, counter: int = 7) -> Run:
    return made(
        run, "release", "build", name, "--image", "bms=bms.hex", "--product", "48V",
        "--counter", str(counter), "--trust", "trust.json", *more,
    )  # fmt: skip


def signed(run: Flasher, name: str = "bike.wfw", key: str = "anna", *, counter: int = 7) -> None:
    build(run, name, counter=counter)
    made(run, "release", "sign", name, "--key", f"{key}.key", *WITH)


def test_a_release_is_built_signed_verified_and_flashed(run: Flasher) -> None:
    works(run)
    signed(run)
    made(run, "trust", "install", "trust.json", "--yes")
    assert "(anna)" in made(run, "release", "verify", "bike.wfw").out
    done = made(run, "flash", "bike.wfw", *FLASH)
    assert "OK  BMS runs" in done.out
    assert "origin:  signed by" in done.err


def test_a_computer_with_a_trust_file_takes_no_unsigned_image(run: Flasher) -> None:
    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    for word in ("--force", "-f"):
        refused = run("flash", "bms.hex", *FLASH, word, "--json")
        assert (refused.code, code_of(refused)) == (3, ErrorCode.RELEASE_UNSIGNED)
    made(run, "flash", "bms.hex", *FLASH, "--allow-unsigned")
    history = made(run, "history", "--json").document
    assert "unsigned" in json.dumps(history)


def test_without_a_trust_file_nothing_changes_unless_a_signature_is_asked_for(run: Flasher) -> None:
    made(run, "flash", "bms.hex", *FLASH)
    refused = run("flash", "bms.hex", *FLASH, "--require-signed", "--json")
    assert (refused.code, code_of(refused)) == (3, ErrorCode.RELEASE_UNSIGNED)
    works(run)
    signed(run)
    made(run, "flash", "bike.wfw", *FLASH)
    refused = run("flash", "bike.wfw", *FLASH, "--require-signed", "--json")
    assert (refused.code, code_of(refused)) == (2, ErrorCode.TRUST_MISSING)


def test_requiring_and_allowing_contradict_each_other(run: Flasher) -> None:
    assert run("flash", "bms.hex", *FLASH, "--require-signed", "--allow-unsigned").code == 2


def test_a_device_takes_no_lower_counter_than_before(run: Flasher) -> None:
    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    signed(run, "new.wfw", counter=8)
    signed(run, "old.wfw", counter=7)
    made(run, "flash", "new.wfw", *FLASH)
    refused = run("flash", "old.wfw", *FLASH, "--force", "--json")
    assert (refused.code, code_of(refused)) == (6, ErrorCode.NOT_TRUSTED)
    made(run, "flash", "old.wfw", *FLASH, "--allow-unsigned")


def test_a_release_that_brings_a_newer_trust_file_revokes_the_old_key(run: Flasher) -> None:
    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    signed(run, "old.wfw")
    made(run, "trust", "rotate", "trust.json", "anna", "bert.key.pub", "--key", "boss.key", *WITH)
    signed(run, "new.wfw", "bert", counter=8)
    made(run, "flash", "old.wfw", *FLASH)
    made(run, "flash", "new.wfw", *FLASH, "--dry-run")
    refused = run("flash", "old.wfw", *FLASH, "--json")
    assert code_of(refused) == ErrorCode.RELEASE_UNSIGNED
    assert made(run, "trust", "show", "--json").document["version"] == 2


def test_a_detached_release_lies_beside_its_image(run: Flasher, workshop: Path) -> None:
    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    wrong = run(
        "release", "build", "x.wfw", "--image", "bms=bms.hex", "--product", "48V", "--counter",
        "1", "--detached",
    )  # fmt: skip
    assert wrong.code == 2
    build(run, "bms.hex.wfw", "--detached")
    made(run, "release", "sign", "bms.hex.wfw", "--key", "anna.key", *WITH)
    made(run, "flash", "bms.hex", *FLASH)
    shutil.copy(SAMPLES / "wmc.hex", workshop / "bms.hex")
    refused = run("flash", "bms.hex", *FLASH, "--json")
    assert code_of(refused) == ErrorCode.RELEASE_DIFFERS


def test_a_signature_is_made_on_another_machine(run: Flasher, workshop: Path) -> None:
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415

    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    build(run)
    made(run, "release", "payload", "bike.wfw", "-o", "payload")
    private: Any = load_pem_private_key((workshop / "anna.key").read_bytes(), PASSPHRASE.encode())
    (workshop / "anna.sig").write_bytes(private.sign((workshop / "payload").read_bytes()))
    attach = ("release", "attach", "bike.wfw", "--signature", "anna.sig", "--public-key")
    assert run(*attach, "bert.key.pub").code == 3
    made(run, *attach, "anna.key.pub")
    made(run, "release", "verify", "bike.wfw")


def test_two_people_sign_a_trust_file_one_after_the_other(run: Flasher) -> None:
    works(run)
    made(
        run, "trust", "add", "trust.json", "--grant", "root=bert.key.pub", "--threshold", "root=2",
        "--key", "boss.key", *WITH,
    )  # fmt: skip
    unfinished = run("trust", "install", "trust.json", "--yes", "--json")
    assert code_of(unfinished) == ErrorCode.TRUST_FILE
    signed_too = made(run, "trust", "sign", "trust.json", "--key", "bert.key", *WITH, "--json")
    assert signed_too.document["missing"] == []
    made(run, "trust", "install", "trust.json", "--yes")


def test_only_root_keys_sign_a_trust_file(run: Flasher, workshop: Path) -> None:
    works(run)
    before = (workshop / "trust.json").read_bytes()
    refused = run("trust", "sign", "trust.json", "--key", "anna.key", *WITH, "--json")
    assert code_of(refused) == ErrorCode.SIGNING_KEY
    assert (workshop / "trust.json").read_bytes() == before


def test_the_last_key_of_a_role_cannot_be_revoked(run: Flasher) -> None:
    works(run)
    refused = run("trust", "revoke", "trust.json", "anna", "--key", "boss.key", *WITH)
    assert refused.code == 2
    assert "rotate" in refused.err


def test_withdrawn_releases_are_refused(run: Flasher) -> None:
    works(run)
    signed(run)
    made(run, "trust", "revoke", "trust.json", "--minimum", "bms:48V=8", "--key", "boss.key", *WITH)
    made(run, "trust", "install", "trust.json", "--yes")
    refused = run("release", "verify", "bike.wfw", "--json")
    assert code_of(refused) == ErrorCode.RELEASE_OLD


def test_keys_and_trust_files_are_not_overwritten(run: Flasher) -> None:
    works(run)
    assert run("trust", "key", "anna.key", *WITH).code == 2
    assert run(
        "trust", "init", "trust.json", "--name", "X", "--grant", "root=bert.key.pub", "--key",
        "bert.key", *WITH,
    ).code == 2  # fmt: skip


def test_a_trust_file_does_not_begin_after_its_end(run: Flasher, workshop: Path) -> None:
    made(run, "trust", "key", "boss.key", *WITH)
    refused = run(
        "trust", "init", "trust.json", "--name", "X", "--grant", "root=boss.key.pub", "--key",
        "boss.key", "--expires", "2020-01-01", *WITH,
    )  # fmt: skip
    assert refused.code == 2
    assert "2020-01-01 has passed" in refused.err
    assert not (workshop / "trust.json").exists()


def test_a_private_key_is_encrypted_and_for_its_owner_alone(run: Flasher, workshop: Path) -> None:
    made(run, "trust", "key", "anna.key", *WITH)
    path = workshop / "anna.key"
    assert path.read_bytes().startswith(b"-----BEGIN ENCRYPTED PRIVATE KEY-----")
    if os.name == "posix":
        assert path.stat().st_mode & 0o777 == 0o600


def test_a_wrong_passphrase_and_an_open_key_are_refused(
    run: Flasher, monkeypatch: pytest.MonkeyPatch, workshop: Path
) -> None:
    works(run)
    build(run)
    before = (workshop / "bike.wfw").read_bytes()
    monkeypatch.setenv("OTHER", "wrong")
    for key in ("anna.key", "anna.key.pub"):
        words = ("release", "sign", "bike.wfw", "--key", key, "--passphrase-env", "OTHER", "--json")
        assert code_of(run(*words)) == ErrorCode.SIGNING_KEY
    assert (workshop / "bike.wfw").read_bytes() == before


def test_a_passphrase_is_read_from_a_descriptor_and_is_in_no_log(
    run: Flasher, workshop: Path
) -> None:
    works(run)
    build(run)
    words = workshop / "words"
    words.write_text(f"{PASSPHRASE}\n")
    with words.open() as file:
        made(
            run, "release", "sign", "bike.wfw", "--key", "anna.key", "--passphrase-fd",
            str(file.fileno()), "--log-file", "log.txt", "-vv",
        )  # fmt: skip
    assert PASSPHRASE not in (workshop / "log.txt").read_text()


def test_without_a_terminal_a_passphrase_is_not_waited_for(run: Flasher) -> None:
    works(run)
    build(run)
    refused = run("release", "sign", "bike.wfw", "--key", "anna.key", "--json")
    assert code_of(refused) == ErrorCode.NOT_CONFIRMED


def test_each_release_is_in_the_log_which_a_computer_compares(run: Flasher, workshop: Path) -> None:
    works(run)
    made(run, "trust", "key", "log.key", *WITH)
    made(
        run, "trust", "add", "trust.json", "--grant", "log=log.key.pub", "--key", "boss.key", *WITH
    )
    made(run, "trust", "install", "trust.json", "--yes")
    logged = ("--log", "log.json", "--log-key", "log.key", *WITH)
    build(run, "one.wfw", *logged)
    build(run, "two.wfw", *logged, counter=8)
    (workshop / "log.json").unlink()
    build(run, "fork.wfw", *logged, counter=9)
    for name in ("one.wfw", "two.wfw", "fork.wfw"):
        made(run, "release", "sign", name, "--key", "anna.key", *WITH)
    made(run, "release", "verify", "two.wfw")
    made(run, "release", "verify", "one.wfw")
    assert code_of(run("release", "verify", "fork.wfw", "--json")) == ErrorCode.RELEASE_LOG


def test_another_makers_trust_file_replaces_the_first_only_on_purpose(run: Flasher) -> None:
    works(run)
    made(run, "trust", "install", "trust.json", "--yes")
    made(
        run, "trust", "init", "own.json", "--name", "Own", "--grant", "root=bert.key.pub",
        "--grant", "bms=bert.key.pub", "--key", "bert.key", *WITH,
    )  # fmt: skip
    refused = run("trust", "install", "own.json", "--yes", "--json")
    assert code_of(refused) == ErrorCode.TRUST_FILE
    made(run, "trust", "install", "own.json", "--yes", "--replace")
    assert made(run, "trust", "show", "--json").document["name"] == "Own"


def test_installing_asks_first(run: Flasher) -> None:
    works(run)
    refused = run("trust", "install", "trust.json", "--json")
    assert code_of(refused) == ErrorCode.NOT_CONFIRMED
    assert made(run, "trust", "show", "--json").document["installed"] is False


def test_a_release_for_another_device_is_refused(run: Flasher) -> None:
    works(run)
    signed(run)
    refused = run("flash", "bike.wfw", "-t", "wmc", "--mock", "--json")
    assert (refused.code, code_of(refused)) == (6, ErrorCode.NOT_FOR_DEVICE)


def test_options_for_a_part_of_a_file_do_not_go_with_a_release(run: Flasher) -> None:
    works(run)
    signed(run)
    assert run("flash", "bike.wfw", *FLASH, "--base", "0x1000").code == 2
    assert run("flash", "bike.wfw", *FLASH, "--manifest", "x.toml").code == 2


def test_rescue_takes_a_release(run: Flasher) -> None:
    works(run)
    signed(run)
    made(run, "trust", "install", "trust.json", "--yes")
    made(run, "rescue", "bike.wfw", *FLASH)


def test_a_role_may_not_ask_for_more_signatures_than_it_has_keys(run: Flasher) -> None:
    works(run)
    refused = run(
        "trust", "init", "other.json", "--name", "X", "--grant", "root=boss.key.pub",
        "--threshold", "root=2", "--key", "boss.key", *WITH,
    )  # fmt: skip
    assert refused.code == ExitCode.USAGE
    assert "The role root would ask for 2 signatures and has 1 key." in refused.err
    assert "changed by hand" not in refused.err


def test_a_file_that_is_no_trust_file_is_named_as_such(run: Flasher) -> None:
    works(run)
    refused = run("trust", "show", "boss.key.pub")
    assert refused.code == ExitCode.USAGE
    assert "it is not a JSON file" in refused.err
