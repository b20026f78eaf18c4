"""The file of receivers."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.plant.receivers import load_receivers, password_of
from flasher.plant.transport import transport_to

GOOD = """\
[[receiver]]
name = "mes"
url = "https://mes.example/api/runs"
user = "flasher"
password_file = "mes.password"
ca_file = "ca.pem"

[[receiver]]
name = "broker"
url = "mqtt://broker.example/flasher/runs"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "receivers.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_addresses_have_the_usual_ports_and_files_are_beside_the_file(tmp_path: Path) -> None:
    mes, broker = load_receivers(written(tmp_path, GOOD))
    assert (mes.kind, mes.host, mes.port, mes.is_secure) == ("http", "mes.example", 443, True)
    assert mes.password_file == str(tmp_path / "mes.password")
    assert (broker.kind, broker.port, broker.topic) == ("mqtt", 1883, "flasher/runs")
    assert password_of(broker) is None
    file = tmp_path / "mes.password"
    file.write_text("s3cr3t\n", encoding="utf-8")
    for mode in (0o600, 0o400, 0o640):
        file.chmod(mode)
        assert password_of(mes) == "s3cr3t"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[[receiver]]\nname = "MES"\nurl = "http://h/"\n', "name"),
        ('[[receiver]]\nname = "a"\nurl = "ftp://h/"\n', "http://, https://, mqtt:// or mqtts://"),
        ('[[receiver]]\nname = "a"\nurl = "http://"\n', "with a host"),
        ('[[receiver]]\nname = "a"\nurl = "http://h:99999/"\n', "with a host"),
        ('[[receiver]]\nname = "a"\nurl = "http://h i/"\n', "with a host"),
        ('[[receiver]]\nname = "a"\nurl = "http://ä..de/"\n', "with a host"),
        (f'[[receiver]]\nname = "a"\nurl = "mqtt://{"h" * 64}/t"\n', "with a host"),
        (f'[[receiver]]\nname = "a"\nurl = "mqtt://h/{"ä" * 32768}"\n', "65,535 bytes"),
        ('[[receiver]]\nname = "a"\nurl = "http://u:s3cr3t@h/"\n', "use user and password_file"),
        ('[[receiver]]\nname = "a"\nurl = "http://h/#x"\n', "fragment"),
        ('[[receiver]]\nname = "a"\nurl = "mqtt://h"\n', "topic"),
        ('[[receiver]]\nname = "a"\nurl = "mqtt://h/runs/+"\n', "topic"),
        ('[[receiver]]\nname = "a"\nurl = "mqtt://h/%23"\n', "topic"),
        ('[[receiver]]\nname = "a"\nurl = "http://h/"\npassword_file = "p"\n', "needs user"),
        ('[[receiver]]\nname = "a"\nurl = "http://h/"\nca_file = "p"\n', "needs https or mqtts"),
        ('[[receiver]]\nname = "a"\nurl = "http://h/"\n' * 2, "the same name"),
        ("receiver = []\n", "receiver"),
    ],
)
def test_a_wrong_file_is_refused_and_no_password_shown(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(UsageError) as caught:
        load_receivers(written(tmp_path, text))
    shown = str(caught.value)
    assert words in shown
    assert "s3cr3t" not in shown


@pytest.mark.parametrize("content", [b"", b"\n", b"two\nlines\n", b"\xff"])
def test_a_file_without_a_password(tmp_path: Path, content: bytes) -> None:
    mes, _ = load_receivers(written(tmp_path, GOOD))
    (tmp_path / "mes.password").touch(0o600)
    (tmp_path / "mes.password").write_bytes(content)
    with pytest.raises(UsageError, match="not one line of text"):
        password_of(mes)


@pytest.mark.skipif(os.name != "posix", reason="its files have no mode")
@pytest.mark.parametrize("mode", [0o604, 0o602, 0o666])
def test_a_password_that_every_user_may_read_or_change_is_not_used(
    tmp_path: Path, mode: int
) -> None:
    mes, _ = load_receivers(written(tmp_path, GOOD))
    file = tmp_path / "mes.password"
    file.write_text("s3cr3t\n", encoding="utf-8")
    file.chmod(mode)
    with pytest.raises(UsageError, match="Every user of this computer") as caught:
        password_of(mes)
    assert caught.value.remedy.endswith(f"chmod o= {file}")


def test_certificates_that_are_missing_or_none(tmp_path: Path) -> None:
    mes, _ = load_receivers(written(tmp_path, GOOD.replace('password_file = "mes.password"\n', "")))
    for content in (None, "no certificate"):
        if content is not None:
            (tmp_path / "ca.pem").write_text(content, encoding="utf-8")
        with pytest.raises(UsageError, match="certificates of mes cannot be read"):
            transport_to(mes)
