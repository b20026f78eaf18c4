"""A key in a hardware token signs: tried with SoftHSM, in processes of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from flasher.errors import ErrorCode
from tests.release.maker import SAMPLES

LIBRARY = Path("/usr/lib/softhsm/libsofthsm2.so")
PIN = "246810"
KEY = "hsm:2?label=release"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("softhsm2-util") is None or not LIBRARY.exists(), reason="no SoftHSM"
    ),
]


class Computer:
    """A computer with a token in it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._settings = {
            **os.environ,
            "SOFTHSM2_CONF": str(folder / "softhsm.conf"),
            "PYKCS11LIB": str(LIBRARY),
            "XDG_CONFIG_HOME": str(folder / "config"),
            "XDG_DATA_HOME": str(folder / "data"),
            "PIN": PIN,
        }

    def run(self, *words: str, pin: str = PIN) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            words, cwd=self._folder, env={**self._settings, "PIN": pin}, check=False,
            capture_output=True, text=True,
        )  # fmt: skip

    def flasher(self, *words: str, pin: str = PIN) -> subprocess.CompletedProcess[str]:
        return self.run(sys.executable, "-m", "flasher", *words, pin=pin)


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    (tmp_path / "tokens").mkdir()
    (tmp_path / "softhsm.conf").write_text(f"directories.tokendir = {tmp_path}/tokens\n")
    private = ec.generate_private_key(ec.SECP256R1())
    form = serialization
    (tmp_path / "key.pem").write_bytes(
        private.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    )
    shutil.copy(SAMPLES / "bms.bin", tmp_path / "bms.bin")
    made = Computer(tmp_path)
    for words in (
        ("--init-token", "--free", "--label", "release", "--pin", PIN, "--so-pin", "13579"),
        ("--import", "key.pem", "--token", "release", "--label", "k", "--id", "02", "--pin", PIN),
    ):
        done = made.run("softhsm2-util", *words)
        assert done.returncode == 0, done.stderr
    return made


def test_a_token_signs_trust_file_and_release(computer: Computer) -> None:
    pin = ("--passphrase-env", "PIN")
    steps = [
        ("trust", "key", "release", "--token", KEY, *pin),
        ("trust", "init", "trust.json", "--name", "Works", "--grant", "root=release.pub",
         "--grant", "bms=release.pub", "--key", KEY, *pin),
        ("trust", "install", "trust.json", "--yes"),
        ("release", "build", "bike.wfw", "--image", "bms=bms.bin", "--product", "48V",
         "--counter", "1"),
    ]  # fmt: skip
    for words in steps:
        done = computer.flasher(*words)
        assert done.returncode == 0, done.stderr
    refused = computer.flasher("release", "sign", "bike.wfw", "--key", KEY, *pin, pin="0000")
    assert (refused.returncode, ErrorCode.SIGNING_KEY in refused.stderr) == (2, True)
    done = computer.flasher("release", "sign", "bike.wfw", "--key", KEY, *pin)
    assert done.returncode == 0, done.stderr
    done = computer.flasher("release", "verify", "bike.wfw")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("key", ["hsm:9?label=release", "hsm:2?label=other", "hsm:x"])
def test_a_key_that_is_not_there_is_an_error_with_a_remedy(computer: Computer, key: str) -> None:
    refused = computer.flasher("trust", "key", "x", "--token", key, "--passphrase-env", "PIN")
    assert (refused.returncode, ErrorCode.SIGNING_KEY in refused.stderr) == (2, True)
