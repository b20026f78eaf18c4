"""Documents reach a real Mosquitto with TLS and a password, and answers are stated as they are."""

from __future__ import annotations

import asyncio
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

import pytest
from aiomqtt import Client, ProtocolVersion
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from flasher.plant.deliveries import Answer, DeliveryState
from flasher.plant.receivers import Receiver as Settings
from flasher.plant.transport import KEY_HEADER, transport_to
from tests.plant.broker import Broker, running_broker
from tests.plant.receiver import Receiver, receiving

pytestmark = pytest.mark.slow
KEY = "0a6c3e42-7d1f-4b58-9c3a-5d2e8f901b47-1204"
DOCUMENT = f'{{"key": "{KEY}", "run": {{"run": {{"serial": "W2605001"}}}}}}'.encode()
RULES = """\
allow_anonymous false
password_file {folder}/passwords
acl_file {folder}/acl
max_packet_size 100000
certfile {folder}/cert.pem
keyfile {folder}/key.pem
"""
ACL = "user flasher\ntopic readwrite plant/#\n"


def certify(folder: Path) -> None:
    """Make a key and its certificate for the loopback address."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(IPv4Address("127.0.0.1"))]), critical=False
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    (folder / "cert.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )


@pytest.fixture(scope="module")
def secrets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with certificate, key, passwords and the broker's rules."""
    folder = tmp_path_factory.mktemp("secrets")
    certify(folder)
    (folder / "acl").write_text(ACL, encoding="ascii")
    for name, password in (("password", "s3cr3t"), ("wrong", "other")):
        (folder / name).touch(0o600)
        (folder / name).write_text(f"{password}\n", encoding="ascii")
    return folder


@pytest.fixture(scope="module")
def broker(mosquitto: str, secrets: Path) -> Iterator[Broker]:
    words = ["-c", "-b", str(secrets / "passwords"), "flasher", "s3cr3t"]
    subprocess.run(["mosquitto_passwd", *words], check=True)
    files = tuple(secrets / name for name in ("passwords", "acl", "cert.pem", "key.pem"))
    with running_broker(mosquitto, RULES, files) as made:
        yield made


def settings(broker: Broker, secrets: Path, **others: Any) -> Settings:
    usual = {
        "name": "broker",
        "url": f"mqtts://127.0.0.1:{broker.port}/plant/runs",
        "user": "flasher",
        "password_file": str(secrets / "password"),
        "ca_file": str(secrets / "cert.pem"),
        "time_limit_s": 20.0,
    }
    return Settings.model_validate(usual | others)


async def send(chosen: Settings, document: bytes = DOCUMENT) -> Answer:
    transport = transport_to(chosen)
    try:
        return await transport.send(KEY, document)
    finally:
        await transport.close()


def test_a_document_is_published_with_its_key_to_who_subscribes(
    broker: Broker, secrets: Path
) -> None:
    async def publish() -> tuple[Answer, Answer, Any]:
        first = await send(settings(broker, secrets))
        async with Client(
            "127.0.0.1", broker.port, username="flasher", password="s3cr3t",  # noqa: S106
            protocol=ProtocolVersion.V5, tls_context=_trusting(secrets),
        ) as subscriber:  # fmt: skip
            await subscriber.subscribe("plant/runs", qos=1)
            answer = await send(settings(broker, secrets))
            async with asyncio.timeout(20):
                return first, answer, await anext(aiter(subscriber.messages))

    without, answer, message = asyncio.run(publish())
    assert without.state is DeliveryState.WAITING, "no one would get it"
    assert without.text == "MQTT 16: no matching subscribers"
    assert answer == Answer(DeliveryState.CONFIRMED, "MQTT 0: success")
    assert message.payload == DOCUMENT
    assert message.qos == 1
    assert message.properties.UserProperty == [(KEY_HEADER, KEY)]
    assert message.properties.ContentType == "application/json"
    assert not hasattr(message.properties, "MessageExpiryInterval")


def _trusting(secrets: Path) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=secrets / "cert.pem")


# paho leaves the socket of a failed TLS handshake to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("changes", "state", "text"),
    [
        ({"url": "/other/runs"}, DeliveryState.REFUSED, "MQTT 135: not authorized"),
        ({"password_file": "wrong"}, DeliveryState.WAITING, "no connection"),
        ({"user": "", "password_file": ""}, DeliveryState.WAITING, "no connection"),
        ({"ca_file": ""}, DeliveryState.WAITING, "no connection"),
    ],
    ids=["another topic", "wrong password", "no password", "unknown issuer"],
)
def test_what_the_broker_does_not_take_is_not_confirmed(
    broker: Broker, secrets: Path, changes: dict[str, str], state: DeliveryState, text: str
) -> None:
    others = dict(changes)
    if "url" in others:
        others["url"] = f"mqtts://127.0.0.1:{broker.port}{others['url']}"
    if others.get("password_file"):
        others["password_file"] = str(secrets / others["password_file"])
    found = asyncio.run(send(settings(broker, secrets, **others)))
    assert found.state is state
    assert found.text.startswith(text)
    assert "s3cr3t" not in found.text


def test_a_document_that_is_too_large_for_the_broker_is_refused(
    broker: Broker, secrets: Path
) -> None:
    large = b'{"key": "' + b"x" * 200_000 + b'"}'
    found = asyncio.run(send(settings(broker, secrets), large))
    assert found == Answer(DeliveryState.REFUSED, "MQTT 149: packet too large")


def test_a_broker_that_is_away(broker: Broker, secrets: Path) -> None:
    gone = settings(broker, secrets, url="mqtts://127.0.0.1:1/plant/runs")
    assert asyncio.run(send(gone)).state is DeliveryState.WAITING


def test_http_with_tls_and_a_password(secrets: Path) -> None:
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(secrets / "cert.pem", secrets / "key.pem")
    with receiving(Receiver(), tls) as receiver:
        chosen = {
            "name": "mes", "url": receiver.url, "user": "flasher", "time_limit_s": 20.0,
            "password_file": str(secrets / "password"),
        }  # fmt: skip
        untrusted = asyncio.run(send(Settings.model_validate(chosen)))
        assert untrusted.state is DeliveryState.WAITING
        assert receiver.requests == {}
        trusted = chosen | {"ca_file": str(secrets / "cert.pem")}
        answer = asyncio.run(send(Settings.model_validate(trusted)))
    assert answer == Answer(DeliveryState.CONFIRMED, "HTTP 201")
    assert receiver.authorization == "Basic Zmxhc2hlcjpzM2NyM3Q="
    assert list(receiver.documents) == [KEY]


def test_an_acknowledgement_that_comes_late_or_twice_is_not_for_the_next_run() -> None:
    """Each document has a connection of its own: HTTP has nothing that names the request."""
    ok, busy = (f"HTTP/1.1 {status}\r\ncontent-length: 0\r\n\r\n".encode() for status in (200, 503))

    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        with suppress(asyncio.IncompleteReadError):
            await reader.readuntil(DOCUMENT)
            writer.write(busy)
            await reader.readuntil(DOCUMENT)
            writer.write(ok + busy)  # the first one is for the document before

    async def deliver() -> list[Answer]:
        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            port = server.sockets[0].getsockname()[1]
            chosen = {"name": "mes", "url": f"http://127.0.0.1:{port}/runs", "time_limit_s": 20.0}
            transport = transport_to(Settings.model_validate(chosen))
            answers = [await transport.send(f"{KEY}{run}", DOCUMENT) for run in range(2)]
            await transport.close()
            for writer in writers:
                writer.close()
                await writer.wait_closed()
        return answers

    assert asyncio.run(deliver()) == [Answer(DeliveryState.UNKNOWN, "HTTP 503")] * 2
