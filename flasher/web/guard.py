"""Access control of the pages, and the browser policies in their headers.

Every request must have a name of this server as its host (against DNS rebinding). Changes need a
POST from a page of this server with the token of its session. Responses forbid scripts, styles and
connections from elsewhere. `flasher.web.login` adds sign-in.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, Final

from anyio import CancelScope
from anyio.lowlevel import checkpoint
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.sessions import SessionMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flasher.report.base import PAGE_STYLE
from flasher.web.login import FORMS, LOGIN, SIGN_OUT, Login
from flasher.web.pages import Pages
from flasher.web.sign_ins import SignIn

TOKEN_HEADER: Final = "x-flasher-token"  # noqa: S105  its name
BODY_MAX: Final = 64 * 1024
"""Maximum size in bytes of a request that is not an upload."""
_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "font-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=()",
    "cache-control": "no-store",
}
_ENTER: Final = "/enter"
_CLOSED: Final = "/closed"
_OPEN: Final = ("/static/", LOGIN, SIGN_OUT, _ENTER, _CLOSED)
"""Paths without sign-in."""
_ENTERED_S: Final = 14 * 24 * 3600
_IS_IN: Final = "is_in"
"""Session key of the browser that opened the entry address."""


class BrowserEntry:
    """Admits only the first browser that opens `path`."""

    def __init__(self, pages: Pages) -> None:
        self._pages = pages
        self._key = secrets.token_urlsafe(32)
        self.path = f"{_ENTER}?key={self._key}"
        self.cookie = f"flasher-{secrets.token_hex(4)}"
        """Contains the port: several servers of a computer share its cookies."""

    @property
    def routes(self) -> list[BaseRoute]:
        return [Route(_ENTER, self._take), Route(_CLOSED, self._refuse)]

    async def _take(self, request: Request) -> Response:
        given = request.query_params.get("key", "")
        if not self._key or not hmac.compare_digest(given.encode(), self._key.encode()):
            return RedirectResponse("/" if request.session.get(_IS_IN) else _CLOSED, 303)
        self._key = ""
        request.session[_IS_IN] = True
        # Redirect by a page of this server, so that the cookie is sent wherever the address was
        # clicked.
        return self._pages.show(request, "enter.html")

    async def _refuse(self, request: Request) -> Response:
        return self._pages.show(request, "closed.html", status=403)


def application(
    routes: Collection[BaseRoute],
    *,
    hosts: Collection[str],
    secret: str,
    login: Login | None = None,
    entry: BrowserEntry | None = None,
    is_tls: bool = False,
    uploads: Mapping[str, int] = MappingProxyType({}),
) -> ASGIApp:
    """Wrap the pages in the access control.

    `hosts`: names of this server, without port; `secret` signs the cookies; `login` checks
    sign-ins, and `entry` admits one browser (without either the pages are open to all); `uploads`
    has the maximum body size in bytes of paths that take more than `BODY_MAX`.
    """
    own: list[BaseRoute] = [
        *([] if entry is None else entry.routes),
        *([] if login is None else login.routes),
        Route("/static/page.css", FileResponse(PAGE_STYLE)),
        Mount("/static", StaticFiles(packages=[("flasher.web", "static")])),
    ]
    session = Middleware(
        SessionMiddleware,
        secret_key=secret,
        session_cookie="flasher" if entry is None else entry.cookie,
        # A browser that entered by the address could not enter again; one that signed in can.
        max_age=_ENTERED_S if entry is not None else None,
        same_site="strict",
        https_only=is_tls,
    )
    inner = Starlette(
        routes=[*own, *routes],
        middleware=[
            session,
            Middleware(_Sessions, login=login, entry=entry),
        ],
    )
    return _Guard(inner, hosts, uploads)


class _Guard:
    """Outermost layer: checks host, origin and size, and sets headers."""

    def __init__(self, app: ASGIApp, hosts: Collection[str], uploads: Mapping[str, int]) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts)
        self._uploads = uploads

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
                if scope["path"].startswith("/static/"):
                    headers["cache-control"] = "no-cache"
            await send(message)

        refusal = self._refusal(scope)
        if refusal is not None:
            await refusal(scope, receive, send_guarded)
            return
        limit = self._uploads.get(scope["path"], BODY_MAX)
        await self._app(scope, _limited(receive, limit), send_guarded)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if _name_of(host) not in self._hosts:
            return PlainTextResponse("This server is not known by that name.", 421)
        if scope["method"] in ("GET", "HEAD"):
            return None
        if scope["method"] != "POST":
            return PlainTextResponse("Only GET and POST are allowed.", 405)
        if headers.get("origin", "") != f"{scope['scheme']}://{host}":
            return PlainTextResponse("The request comes from another page.", 403)
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._uploads.get(scope["path"], BODY_MAX):
            return PlainTextResponse("The request is too large.", 413)
        return None


def _name_of(host: str) -> str:
    if host.startswith("["):
        return host.partition("]")[0].lower() + "]"
    return host.partition(":")[0].lower()


def _limited(receive: Receive, limit: int) -> Receive:
    """Stop reading a body that is too large, whatever its header states."""
    taken = 0

    async def receive_limited() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        return {"type": "http.disconnect"} if taken > limit else message

    return receive_limited


class _Sessions:
    """Adds a token to every session, which a POST must contain. Redirects to the sign-in page, or
    reports that another browser has the pages.
    """

    def __init__(self, app: ASGIApp, *, login: Login | None, entry: BrowserEntry | None) -> None:
        self._app = app
        self._login = login
        self._entry = entry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        session: dict[str, Any] = scope["session"]
        session.setdefault("token", secrets.token_urlsafe(24))
        path: str = scope["path"]
        is_stream = path.endswith("/events")
        sign_in = None
        if self._login is not None:
            # An open page requests its stream by HEAD, which is not a view by a person.
            is_use = not is_stream and scope["method"] in ("GET", "POST")
            sign_in = self._login.find(session, is_use=is_use)
        scope["sign_in"] = sign_in
        if to := "" if path.startswith(_OPEN) else self._refused(path, session, sign_in):
            if to == LOGIN and self._login is not None and scope["method"] == "GET":
                self._login.want(session, scope)
            refusal = Response(status_code=401) if is_stream else RedirectResponse(to, 303)
            await refusal(scope, receive, send)
            return
        if scope["method"] == "POST" and path not in FORMS:
            token = Headers(scope=scope).get(TOKEN_HEADER, "")
            if not hmac.compare_digest(token.encode(), session["token"].encode()):
                await PlainTextResponse("Load the page again.", 403)(scope, receive, send)
                return
        if is_stream:
            await self._stream(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _refused(self, path: str, session: Mapping[str, Any], sign_in: SignIn | None) -> str:
        """Path to redirect to if this user may not open the page; otherwise ""."""
        if self._entry is not None and not session.get(_IS_IN):
            return _CLOSED
        if self._login is not None and self._login.is_refused(path, sign_in):
            return LOGIN
        return ""

    async def _stream(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a stream that ends together with its sign-in."""
        session, path = scope["session"], scope["path"]
        with CancelScope() as streaming:

            async def send_to_who_may(message: Message) -> None:
                login = self._login
                if login is not None and login.is_refused(path, login.find(session)):
                    await send({"type": "http.response.body", "body": b"", "more_body": False})
                    streaming.cancel()
                    await checkpoint()
                await send(message)

            await self._app(scope, receive, send_to_who_may)
