"""Requests as a browser, or a program, may send them to the pages; each an input of a harness.

An input is the text of a request: method and target, headers, a blank line, the body. What it does
not state is added, so that it is taken: host, origin, the cookie of the session, its token, the
time of the page whose order it is.
"""

from __future__ import annotations

import asyncio
import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final
from urllib.parse import unquote

import itsdangerous
from starlette.types import ASGIApp, Message

from flasher.web.feed import page_time
from flasher.web.guard import TOKEN_HEADER

HOST: Final = "127.0.0.1:8740"
SECRET: Final = "of the test"  # noqa: S105
TOKEN: Final = "T"  # noqa: S105
MARK: Final = b"<fuzz"
"""A tag in requests: no page may have it."""
_HERE: Final = re.compile(r"(?:http://127\.0\.0\.1(?::\d+)?)?/(?![/\\])")
"""Where a redirect may lead."""
_METHOD_MAX: Final = 8
_UNPRINTED: Final = bytes((*range(9), *range(10, 32), 127))
"""What no server of HTTP takes in a header."""


@dataclass(frozen=True)
class Answered:
    """The response to a request."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@cache
def _loop() -> asyncio.AbstractEventLoop:
    return asyncio.new_event_loop()


def cookie(session: Mapping[str, Any], name: str = "flasher") -> bytes:
    """The cookie of a session, signed as the server signs it."""
    content = b64encode(json.dumps({"token": TOKEN, **session}).encode())
    return name.encode() + b"=" + itsdangerous.TimestampSigner(SECRET).sign(content)


def send(app: ASGIApp, data: bytes, session_cookie: bytes) -> Answered:
    """Send a request. Raises AssertionError for a response that no page may give, and what the
    application raises.
    """
    scope, body = _request(data, session_cookie)
    received: list[Message] = []
    requests = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> Message:
        return requests.pop() if requests else {"type": "http.disconnect"}

    async def collect(message: Message) -> None:
        received.append(message)

    _loop().run_until_complete(app(scope, receive, collect))
    assert received, "no response"
    start = received[0]
    headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in start["headers"]}
    answered = Answered(
        start["status"], headers, b"".join(each.get("body", b"") for each in received[1:])
    )
    assert answered.status < 500 or answered.status in (503, 507), answered.status
    assert "default-src 'none'" in headers["content-security-policy"]
    assert all(value.isprintable() for value in headers.values()), headers
    if headers.get("content-type", "").startswith("text/html"):
        answered.body.decode()
        assert MARK not in answered.body
    location = headers.get("location", "/")
    assert _HERE.match(location), location
    return answered


def _request(data: bytes, session_cookie: bytes) -> tuple[dict[str, Any], bytes]:
    """Scope of a request, as uvicorn makes it, and its body."""
    head, _, body = data.partition(b"\n\n")
    if body.startswith(b"{") and body.endswith(b"}") and b'"shown_at"' not in body:
        body = b'{"shown_at": %f%s' % (page_time(), body[1:] if body == b"{}" else b", " + body[1:])
    first, *lines = head.split(b"\n")
    method, _, target = first.partition(b" ")
    method = method.strip()[:_METHOD_MAX].upper() or b"GET"
    target = bytes(each for each in target if 0x20 < each < 0x7F) or b"/"
    headers: list[tuple[bytes, bytes]] = []
    for line in lines:
        name, _, value = line.translate(None, _UNPRINTED).partition(b":")
        name = bytes(each for each in name.lower() if chr(each).isalnum() or each in b"-_")
        if name and name != b"content-length":
            headers.append((name, value.strip()))
    stated = {name for name, _ in headers}
    usual = {
        b"host": HOST.encode(),
        b"origin": b"http://" + HOST.encode(),
        b"cookie": session_cookie,
        TOKEN_HEADER.encode(): TOKEN.encode(),
    }
    headers += [(name, value) for name, value in usual.items() if name not in stated]
    if b"transfer-encoding" not in stated:
        headers.append((b"content-length", b"%d" % len(body)))
    path, _, query = target.partition(b"?")
    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.3"},
        "http_version": "1.1",
        "server": ("127.0.0.1", 8740),
        "client": ("192.0.2.1", 50_000),
        "scheme": "http",
        "method": method.decode("latin-1"),
        "root_path": "",
        "path": unquote(path.decode("ascii")),
        "raw_path": path,
        "query_string": query,
        "headers": headers,
        "state": {},
    }
    return scope, body


def words(paths: Sequence[str], fields: Sequence[str]) -> list[str | bytes]:
    """For the fuzzer's dictionary."""
    return [
        *paths,
        *(f"{name}=" for name in fields),
        *(f'"{name}": ' for name in fields),
        MARK + b">",
        "GET ", "POST ", "?", "&", "%00", "%0A", "%2F", "%ED%A0%80", "\\ud800", "lang=", "de", "zh",
        "host: ", "origin: null", "cookie: flasher=", "accept-language: ", f"{TOKEN_HEADER}: ",
        "transfer-encoding: chunked", "\n\n", "9" * 30, "0001-01-01", "9999-12-31T23:59",
    ]  # fmt: skip
