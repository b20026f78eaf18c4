"""Runs a web server in its own thread."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from ipaddress import IPv6Address, ip_address, ip_network
from pathlib import Path
from typing import Any, Final, NamedTuple

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from flasher.errors import ErrorCode, UsageError
from flasher.protocol.text import printable

LOOPBACK: Final = frozenset({"127.0.0.1", "::1", "localhost"})
"""Host names that only this computer can reach."""
# The server logs its messages instead of printing them to the terminal.
logging.getLogger("uvicorn").addHandler(logging.NullHandler())
_END_LIMIT_S: Final = 1.0
"""Time after which open streams are closed at the end."""


_CONNECTIONS_MAX: Final = 200
_OF_ONE_MAX: Final = 100
"""Maximum number of connections of one client."""


class _Protocol(H11Protocol):
    """HTTP protocol that limits the connections of a client."""

    place = ""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.place = "" if self.client is None else client_at(self.client[0])
        same = [each for each in self.connections if getattr(each, "place", "") == self.place]
        if len(same) > _OF_ONE_MAX:
            # Count it down at once, since many connections may come together.
            self.connections.discard(self)
            transport.abort()


def client_at(host: str) -> str:
    """Client of an address: all addresses of this computer, or of an IPv6 network, count as one."""
    try:
        found = ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if isinstance(found, IPv6Address) and found.ipv4_mapped is not None:
        found = found.ipv4_mapped
    if found.is_loopback:
        return "127.0.0.1"
    return str(ip_network((found, 64), strict=False)) if found.version == 6 else str(found)


class Tls(NamedTuple):
    """PEM files of a certificate and its key."""

    certificate: Path
    key: Path


class Server:
    """Serves an ASGI application while the block runs; `url` contains the actual port. Raises
    UsageError for an address that cannot be used.
    """

    def __init__(self, app: Any, host: str, port: int, tls: Tls | None = None) -> None:
        self._listener = _listen(host, port)
        scheme, name = "http" if tls is None else "https", f"[{host}]" if ":" in host else host
        self.url = f"{scheme}://{name}:{self._listener.getsockname()[1]}/"
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=16 * 1024,
            limit_concurrency=_CONNECTIONS_MAX,
            http=_Protocol,
            # No proxy header is trusted: sign-in tries are counted by address.
            proxy_headers=False,
            ssl_certfile=None if tls is None else str(tls.certificate),
            ssl_keyfile=None if tls is None else str(tls.key),
        )
        try:
            config.load()
        except (OSError, ValueError) as error:  # no file, or no certificate
            self._listener.close()
            raise UsageError(
                f"The certificate or its key cannot be used: {printable(str(error))}",
                remedy="Give the certificate and its key as PEM files.",
                code=ErrorCode.PAGES_NOT_SERVED,
            ) from error
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, args=([self._listener],), name="web", daemon=True
        )

    def __enter__(self) -> Server:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join(_END_LIMIT_S)
        self._server.force_exit = True
        self._thread.join(_END_LIMIT_S)
        self._listener.close()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise UsageError(
            f"Port {port} of {printable(host)} cannot be used: {error.strerror or error}.",
            cause="another program uses it, or this computer does not have the address",
            remedy="Give another port, or 0 for any.",
            code=ErrorCode.PAGES_NOT_SERVED,
        ) from error
