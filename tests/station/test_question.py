"""The question to the plant, with a real small server that does what it should not."""

from __future__ import annotations

import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from flasher.errors import UsageError
from flasher.station.config import CONFIG, QuestionConfig
from flasher.station.question import REPLY_MAX_SIZE, Question
from flasher.station.recipe import Unchecked
from flasher.station.records.model import Order
from tests.station.factory import BMS_VERSION, make_recipe

pytestmark = pytest.mark.slow
LIMIT_S = 0.5
ORDER = Order("W2605002", "A", "jo", lot="L 1&2")


class Server:
    """Answers each connection with `reply`, which writes bytes, and keeps what was asked."""

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._tls = tls
        self.port = self._socket.getsockname()[1]
        self.asked: list[bytes] = []
        self.over = threading.Event()
        self.reply: Callable[[socket.socket], None] = lambda _made: None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                made, _ = self._socket.accept()
            except OSError:
                return
            with closing(made), suppress(OSError):
                made.settimeout(5.0)
                if self._tls is not None:
                    made = self._tls.wrap_socket(made, server_side=True)
                data = made.recv(65536)
                while b"\r\n\r\n" not in data or not _is_whole(data):
                    data += made.recv(65536)
                self.asked.append(data)
                self.reply(made)
                made.close()

    def says(self, body: bytes, status: str = "200 OK", more: str = "") -> None:
        head = f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\n{more}\r\n".encode()
        self.reply = lambda made: made.sendall(head + body)

    def close(self) -> None:
        self.over.set()
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(5.0)


def _is_whole(data: bytes) -> bool:
    head, _, body = data.partition(b"\r\n\r\n")
    length = next(
        (int(line.split(b":")[1]) for line in head.lower().split(b"\r\n") if b"length" in line), 0
    )
    return len(body) >= length


@pytest.fixture
def server() -> Iterator[Server]:
    with closing(Server()) as made:
        yield made


def question(tmp_path: Path, url: str, **more: Any) -> Question:
    config = QuestionConfig(url=url, time_limit_s=LIMIT_S, **more)
    return Question(config, make_recipe(tmp_path), "line-2")


def asked(server: Server, tmp_path: Path, **more: Any) -> tuple[bool, str]:
    answer = question(tmp_path, f"http://127.0.0.1:{server.port}/may?plant=1", **more).ask(ORDER)
    return answer.may_begin, answer.text


def test_yes_and_no_with_their_reasons(server: Server, tmp_path: Path) -> None:
    server.says(b'{"answer": "yes"}')
    assert asked(server, tmp_path) == (True, "yes")
    server.says(b'{"answer": "no", "reason": "its test\\nis missing."}')
    may_begin, words = asked(server, tmp_path)
    assert not may_begin
    assert words.startswith("no: its test")
    assert "\n" not in words


def test_it_states_the_unit_the_target_and_the_place(server: Server, tmp_path: Path) -> None:
    server.says(b'{"answer": "yes"}')
    asked(server, tmp_path)
    head, _, body = server.asked[0].partition(b"\r\n\r\n")
    assert head.startswith(b"POST /may?plant=1 HTTP/1.1\r\n")
    found = json.loads(body)
    (target,) = found.pop("targets")
    assert (target["target"], target["version"]) == ("bms", BMS_VERSION)
    named = ("serial", "part", "lot", "station", "socket", "operator", "recipe", "recipe_revision")
    assert [found[name] for name in named] == [
        "W2605002", "BAT-36", "L 1&2", "line-2", "A", "jo", "Battery 36 V", "4",
    ]  # fmt: skip


def test_it_asks_by_get(server: Server, tmp_path: Path) -> None:
    server.says(b'{"answer": "yes"}')
    assert asked(server, tmp_path, method="GET") == (True, "yes")
    line = server.asked[0].partition(b"\r\n")[0]
    assert line.startswith(b"GET /may?plant=1&serial=W2605002&part=BAT-36&lot=L+1%262&")
    assert f"&target=bms&version={BMS_VERSION}".encode() in line


NONSENSE = {
    "another status": (b'{"answer": "yes"}', "503 Busy", "", "HTTP status 503"),
    "a redirect": (
        b"",
        "302 Found",
        "Location: http://elsewhere/\r\n",
        "redirected to http://else",
    ),
    "no JSON": (b"<html>yes</html>", "200 OK", "", "the reply is not"),
    "another word": (b'{"answer": "maybe"}', "200 OK", "", "the reply is not"),
    "a boolean": (b'{"answer": true}', "200 OK", "", "the reply is not"),
    "two answers": (b'{"answer": "no", "answer": "yes"}', "200 OK", "", "the reply is not"),
    "a list": (b'["yes"]', "200 OK", "", "the reply is not"),
    "nothing": (b"", "200 OK", "", "the reply is not"),
    "too much": (b" " * (REPLY_MAX_SIZE + 1), "200 OK", "", "more than 65,536 bytes"),
    "a deep document": (b"[" * 50000, "200 OK", "", "the reply is not"),
    "no HTTP": (b"", "\x00", "", "no answer: "),
}


def test_a_reply_that_ends_too_early_is_no_answer(server: Server, tmp_path: Path) -> None:
    head = b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n"
    server.reply = lambda made: made.sendall(head + b'{"answer": "yes"}')
    assert asked(server, tmp_path) == (False, "no answer: the reply is not complete")


@pytest.mark.parametrize("name", NONSENSE)
def test_anything_else_is_no_answer(server: Server, tmp_path: Path, name: str) -> None:
    body, status, more, words = NONSENSE[name]
    server.says(body, status, more)
    may_begin, text = asked(server, tmp_path)
    assert not may_begin
    assert text.startswith("no answer: ")
    assert words in text


def test_the_rule_for_silence(server: Server, tmp_path: Path) -> None:
    server.says(b"", "500 Oops")
    assert asked(server, tmp_path) == (False, "no answer: HTTP status 500")
    assert asked(server, tmp_path, silence=Unchecked.ALLOW)[0]


def _drip(server: Server, made: socket.socket) -> None:
    """A byte again and again: the time limit of a socket would start anew each time."""
    made.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    while not server.over.wait(0.05):
        made.sendall(b"x")


def _drip_body(server: Server, made: socket.socket) -> None:
    made.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 60000\r\n\r\n")
    while not server.over.wait(0.05):
        made.sendall(b" ")


def _hang(server: Server, _made: socket.socket) -> None:
    server.over.wait(5.0)


@pytest.mark.parametrize("reply", [_drip, _drip_body, _hang])
def test_a_slow_server_takes_no_longer_than_the_limit(
    server: Server, tmp_path: Path, reply: Callable[[Server, socket.socket], None]
) -> None:
    server.reply = lambda made: reply(server, made)
    ready = question(tmp_path, f"http://127.0.0.1:{server.port}/")
    began_s = time.perf_counter()
    answer = ready.ask(ORDER)
    took_s = time.perf_counter() - began_s
    assert (answer.may_begin, answer.text) == (False, "no answer: none within 0.5 s")
    assert took_s < LIMIT_S + 2.0  # this computer may be busy


def test_no_server(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = free.getsockname()[1]
    answer = question(tmp_path, f"http://127.0.0.1:{port}/").ask(ORDER)
    assert answer.text == "no answer: Connection refused"


# -- TLS -------------------------------------------------------------------------------------------


def certificate(folder: Path, name: str, days: int = 1) -> Path:
    """A certificate that signs itself, with its key in one file."""
    key = ec.generate_private_key(ec.SECP256R1())
    now, named = datetime.now(UTC), x509.Name([x509.NameAttribute(x509.OID_COMMON_NAME, name)])
    made = (
        x509.CertificateBuilder()
        .subject_name(named)
        .issuer_name(named)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=99))
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
        .sign(key, hashes.SHA256())
    )
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    path = folder / f"{name}.pem"
    path.write_bytes(made.public_bytes(serialization.Encoding.PEM) + secret)
    return path


def _secured(path: Path) -> Server:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(path)
    return Server(context)


def test_tls_with_the_certificate_of_the_plant(tmp_path: Path) -> None:
    path = certificate(tmp_path, "localhost")
    with closing(_secured(path)) as server:
        server.says(b'{"answer": "yes"}')
        url = f"https://localhost:{server.port}/"
        answer = question(tmp_path, url, certificates=str(path)).ask(ORDER)
        assert answer.text == "yes"
        answer = question(tmp_path, url).ask(ORDER)
        assert "certificate is not trusted" in answer.text
        assert not answer.may_begin


def test_tls_of_another_host(tmp_path: Path) -> None:
    path = certificate(tmp_path, "another")
    with closing(_secured(path)) as server:
        server.says(b'{"answer": "yes"}')
        url = f"https://localhost:{server.port}/"
        answer = question(tmp_path, url, certificates=str(path)).ask(ORDER)
        assert "certificate is not trusted" in answer.text


def test_a_server_that_stops_in_the_handshake(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:
        url = f"https://localhost:{listening.getsockname()[1]}/"
        answer = question(tmp_path, url).ask(ORDER)
    assert answer.text == "no answer: none within 0.5 s"


def test_certificates_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        question(tmp_path, "https://localhost/", certificates=str(tmp_path / "missing.pem"))


@pytest.mark.parametrize(
    "url", ["ftp://x/", "https:///x", "https://a:b@c/", "http://x:99999/", "http://x/a b", "x"]
)
def test_an_address_that_is_none_is_refused(tmp_path: Path, url: str) -> None:
    path = tmp_path / "station.toml"
    path.write_text(f'[[socket]]\nname = "A"\nmock = {{}}\n[question]\nurl = "{url}"\n')
    with pytest.raises(UsageError, match=r"question\.url|url"):
        CONFIG.load(path)
