"""Who may use the pages, and what a browser may do with them.

Every request names this server as its host, so that no foreign name leads here (DNS rebinding).
What changes something is a POST from a page of this server that knows the token of its session.
Answers forbid scripts, styles and connections from anywhere else. Where a password is set, or a
badge asked for, nothing but the page that asks is shown before. Where there are badges, the pages
of supervisors are for theirs.
"""

from __future__ import annotations

import hmac
import secrets
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final
from urllib.parse import parse_qs

from anyio.to_thread import run_sync
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
from flasher.said import say
from flasher.station.people import Role
from flasher.web.pages import Pages

TOKEN_HEADER: Final = "x-flasher-token"  # noqa: S105  its name
BODY_MAX: Final = 64 * 1024
"""In bytes, of a request that is no upload."""
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
_TRIES_MAX: Final = 5
_TRIES_WITHIN_S: Final = 60.0
_ENTER: Final = "/enter"
_CLOSED: Final = "/closed"
_LOGIN: Final = "/login"
_OPEN: Final = ("/static/", _LOGIN, _ENTER, _CLOSED)
"""Paths that need no password."""
_SUPERVISES_S: Final = 900.0
"""A supervisor who looked at no page for so long has left the screen."""
_QUERY_MAX: Final = 1000
"""Characters of what a page was asked for that are kept while somebody signs in."""
_BADGE_MAX: Final = 300
"""Characters of a badge or a PIN."""


@dataclass(frozen=True)
class Badges:
    """The people who may open pages."""

    role_of: Callable[[str, str], Role | None]
    """The role of a badge with a PIN; None when one of them is wrong. It is slow on purpose."""
    is_supervised: Callable[[str], bool]
    """True for the path of a page that is for supervisors."""
    are_for_all: bool
    """True where the other pages need a badge too: any."""


@dataclass(frozen=True)
class _Rights:
    """What who signs in has to say, and how a session shows that it was said."""

    password: str
    badges: Badges | None
    signed: str
    now: Callable[[], float]

    def has_signed(self, session: Mapping[str, Any]) -> bool:
        return bool(session.get("is_in") == self.signed)

    def is_supervised(self, path: str) -> bool:
        return self.badges is not None and self.badges.is_supervised(path)


_IN: Final = "in"
"""Kept in the session of who may see the pages, where nobody signs in."""


class Tries:
    """Limits how often somebody may guess: `_TRIES_MAX` wrong ones in `_TRIES_WITHIN_S`."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._wrong: deque[float] = deque()

    @property
    def are_used_up(self) -> bool:
        """True while no other try is allowed."""
        while self._wrong and self._now() - self._wrong[0] > _TRIES_WITHIN_S:
            self._wrong.popleft()
        return len(self._wrong) >= _TRIES_MAX

    def was_wrong(self) -> None:
        self._wrong.append(self._now())


class Entry:
    """Lets the browser in that first opens `path`, and nobody else after it."""

    def __init__(self, pages: Pages) -> None:
        self._pages = pages
        self._key = secrets.token_urlsafe(32)
        self.path = f"{_ENTER}?key={self._key}"
        self.cookie = f"flasher-{secrets.token_hex(4)}"
        """Cookies hold for all ports of a computer, and several servers may run on it."""

    async def take(self, request: Request) -> Response:
        said = request.query_params.get("key", "")
        if not self._key or not hmac.compare_digest(said.encode(), self._key.encode()):
            return RedirectResponse("/" if request.session.get("is_in") else _CLOSED, 303)
        self._key = ""
        request.session["is_in"] = _IN
        # From a page of this server on, so that the cookie goes with it wherever the address was
        # clicked.
        return self._pages.show(request, "enter.html")

    async def refuse(self, request: Request) -> Response:
        return self._pages.show(request, "closed.html", status=403)


def application(  # noqa: PLR0913  the name and the rights of a server
    routes: Collection[BaseRoute],
    *,
    pages: Pages,
    hosts: Collection[str],
    secret: str,
    now: Callable[[], float],
    password: str = "",
    badges: Badges | None = None,
    signed: str = _IN,
    entry: Entry | None = None,
    is_tls: bool = False,
    uploads: Callable[[str], int] = lambda _path: BODY_MAX,
) -> ASGIApp:
    """The pages behind the guard. `hosts`: names by which this server is addressed, without port;
    `secret` signs the cookies; `signed` is kept in the session of who signed in, and is another one
    where password or badges are others, so that people sign in again;
    `uploads` gives the limit of a path's body in bytes.
    """
    rights = _Rights(password, badges, signed, now)
    login = _Login(pages, rights)
    entries = [] if entry is None else [Route(_ENTER, entry.take), Route(_CLOSED, entry.refuse)]
    asks = bool(password) or (badges is not None and badges.are_for_all)
    refused_to = _LOGIN if asks else "" if entry is None else _CLOSED
    own: list[BaseRoute] = [
        *entries,
        Route("/static/page.css", FileResponse(PAGE_STYLE)),
        Mount("/static", StaticFiles(packages=[("flasher.web", "static")])),
        Route(_LOGIN, login.show, methods=["GET"]),
        Route(_LOGIN, login.take, methods=["POST"]),
    ]
    session = Middleware(
        SessionMiddleware,
        secret_key=secret,
        session_cookie="flasher" if entry is None else entry.cookie,
        same_site="strict",
        https_only=is_tls,
    )
    inner = Starlette(
        routes=[*own, *routes],
        middleware=[
            session,
            Middleware(_Sessions, rights=rights, refused_to=refused_to),
        ],
    )
    return _Guard(inner, hosts, uploads)


class _Guard:
    """The outermost layer: hosts, origins, sizes, headers."""

    def __init__(
        self, app: ASGIApp, hosts: Collection[str], limit_of: Callable[[str], int]
    ) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts)
        self._limit_of = limit_of

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
        await self._app(scope, _limited(receive, self._limit_of(scope["path"])), send_guarded)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if _name_of(host) not in self._hosts:
            return PlainTextResponse("This server is not known by that name.", 421)
        if scope["method"] in ("GET", "HEAD"):
            return None
        if scope["method"] != "POST":
            return PlainTextResponse("Only GET and POST.", 405)
        if headers.get("origin", "") != f"{scope['scheme']}://{host}":
            return PlainTextResponse("The request comes from another page.", 403)
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > self._limit_of(scope["path"]):
            return PlainTextResponse("It is too large.", 413)
        return None


def _name_of(host: str) -> str:
    if host.startswith("["):
        return host.partition("]")[0].lower() + "]"
    return host.partition(":")[0].lower()


def _limited(receive: Receive, limit: int) -> Receive:
    """Ends a body that is larger than allowed, whatever its header said."""
    taken = 0

    async def receive_limited() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        return {"type": "http.disconnect"} if taken > limit else message

    return receive_limited


class _Sessions:
    """Every session has a token, which a POST has to say; and has said the password, shown a badge
    or used the entry, where there is one: others are sent to `refused_to`.
    """

    def __init__(self, app: ASGIApp, *, rights: _Rights, refused_to: str) -> None:
        self._app = app
        self._rights = rights
        self._refused_to = refused_to

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        session: dict[str, Any] = scope["session"]
        session.setdefault("token", secrets.token_urlsafe(24))
        path: str = scope["path"]
        if to := "" if path.startswith(_OPEN) else self._refused(path, session):
            if to == _LOGIN and scope["method"] == "GET":
                # One slash alone: two would begin the name of another computer.
                query = scope["query_string"].decode("latin-1")[:_QUERY_MAX]
                session["wanted"] = "/" + path.lstrip("/\\") + (f"?{query}" if query else "")
            is_stream = path.endswith("/events")
            refusal = Response(status_code=401) if is_stream else RedirectResponse(to, 303)
            await refusal(scope, receive, send)
            return
        if scope["method"] == "POST" and path != _LOGIN:
            said = Headers(scope=scope).get(TOKEN_HEADER, "")
            if not hmac.compare_digest(said.encode(), session["token"].encode()):
                await PlainTextResponse("Load the page again.", 403)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _refused(self, path: str, session: dict[str, Any]) -> str:
        """Where who may not see this page is sent to; "" for who may."""
        rights = self._rights
        if self._refused_to and not rights.has_signed(session):
            return self._refused_to
        if not rights.is_supervised(path):
            return ""
        if not rights.has_signed(session):
            return _LOGIN
        now = rights.now()
        # A clock that began anew, after a restart of the computer, says nothing of before.
        if not 0.0 <= now - session.get("supervised_at", -_SUPERVISES_S) < _SUPERVISES_S:
            return _LOGIN
        session["supervised_at"] = now
        return ""


class _Login:
    """The page that asks for the password, or for a badge."""

    def __init__(self, pages: Pages, rights: _Rights) -> None:
        self._pages = pages
        self._rights = rights
        self._tries = Tries(rights.now)

    async def show(self, request: Request) -> Response:
        return self._show(request)

    def _show(
        self, request: Request, trouble: str = "", status: int = 200, *, badge: str = ""
    ) -> Response:
        """The page; with a `badge` that was scanned it asks for its PIN alone."""
        return self._pages.show(
            request,
            "login.html",
            status=status,
            trouble=trouble,
            badge=badge,
            asks_password=bool(self._rights.password)
            and not self._rights.has_signed(request.session),
            asks_badge=self._rights.badges is not None,
            is_for_supervisors=self._is_supervised(request),
        )

    async def take(self, request: Request) -> Response:
        fields = parse_qs((await request.body()).decode("utf-8", "replace"))
        token, password, badge, pin = (
            fields.get(name, [""])[0] for name in ("token", "password", "badge", "pin")
        )
        if not hmac.compare_digest(token.encode(), request.session["token"].encode()):
            return RedirectResponse(_LOGIN, 303)
        if self._tries.are_used_up:
            return self._show(request, say("Too many wrong tries: wait a minute."), 429)
        role, rights = None, self._rights
        badges = rights.badges if badge else None
        if badges is not None:
            # Beside the loop that serves all pages: it takes its time.
            find = partial(badges.role_of, badge.strip()[:_BADGE_MAX], pin[:_BADGE_MAX])
            role = await run_sync(find)
        is_password = hmac.compare_digest(password.encode(), rights.password.encode())
        # Beside the right password too, a wrong badge is a wrong try: else PINs could be guessed.
        if role is None and (badges is not None or not (rights.password and is_password)):
            self._tries.was_wrong()
            if badge and not pin:  # a scanner ends what it types by Enter
                return self._show(request, say("Type the PIN of the badge."), 403, badge=badge)
            return self._show(request, say("That is not it."), 403)
        if role is not None and role is not Role.SUPERVISOR and self._is_supervised(request):
            return self._show(request, say("That badge is no supervisor's."), 403)
        if not rights.has_signed(request.session):
            request.session.pop("supervised_at", None)  # by badges that may be others now
        request.session["is_in"] = rights.signed
        if role is Role.SUPERVISOR:
            request.session["supervised_at"] = rights.now()
        return RedirectResponse(request.session.get("wanted", "/"), 303)

    def _is_supervised(self, request: Request) -> bool:
        return self._rights.is_supervised(str(request.session.get("wanted", "/")).partition("?")[0])
