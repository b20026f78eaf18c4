"""The web server: what it believes of a client, and that no client takes the places of all."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from http.client import BadStatusLine, HTTPResponse

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from flasher.web.server import Server, client_at
from tests.loops import each

OF_ONE_MAX = 100


async def _client(request: Request) -> Response:
    assert request.client is not None
    return PlainTextResponse(f"{request.url.scheme} {request.client.host}")


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with Server(Starlette(routes=[Route("/", _client)]), "127.0.0.1", 0) as server:
        yield int(server.url.rstrip("/").rpartition(":")[2])


def connected(stack: ExitStack, port: int, address: str) -> socket.socket:
    return stack.enter_context(
        socket.create_connection(("127.0.0.1", port), 10, source_address=(address, 0))
    )


def asked(connection: socket.socket, header: str = "") -> str:
    """The answer to a request; "" when the server has ended the connection."""
    try:
        connection.sendall(f"GET / HTTP/1.1\r\nhost: x\r\n{header}\r\n".encode())
        answer = HTTPResponse(connection)
        answer.begin()
        return answer.read().decode()
    except (ConnectionError, BadStatusLine):
        return ""


def test_no_header_makes_another_client_of_one(port: int) -> None:
    """Tries are counted by the address: who could choose it could guess without end."""
    with ExitStack() as stack:
        connection = connected(stack, port, "127.0.0.1")
        header = "x-forwarded-for: 192.0.2.1\r\nx-forwarded-proto: https\r\n"
        assert asked(connection, header) == "http 127.0.0.1"


@pytest.mark.slow
def test_one_client_does_not_take_all_connections(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ExitStack() as stack:
        # All addresses of this computer are one client.
        greedy = [connected(stack, port, f"127.0.0.{n % 3 + 2}") for n in range(3 * OF_ONE_MAX)]
        answers = [asked(each) for each in greedy]
        assert len(answers) - answers.count("") == OF_ONE_MAX
        monkeypatch.setattr("flasher.web.server.client_at", lambda _host: "another computer")
        assert asked(connected(stack, port, "127.0.0.1")) == "http 127.0.0.1"


@each(
    "host, client",
    [
        ("192.0.2.1", "192.0.2.1"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("127.0.0.9", "127.0.0.1"),
        ("::1", "127.0.0.1"),
        ("2001:db8:0:1:2::3", "2001:db8:0:1::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("testclient", "testclient"),
    ],
)
def test_a_client_has_all_addresses_that_it_can_choose(host: str, client: str) -> None:
    assert client_at(host) == client
