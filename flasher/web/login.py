"""Sign-in and sign-out pages, and the list of active sign-ins.

A separate thread checks one PIN at a time. A try is counted before its check, few requests wait,
and others are refused at once: guesses cost neither memory nor the time of users.
"""

from __future__ import annotations

import asyncio
import hmac
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from typing import Any, Final
from urllib.parse import parse_qs

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import Scope

from flasher.i18n import text
from flasher.station import pins
from flasher.station.attempts import Attempts
from flasher.station.operators import Person, Role
from flasher.station.records.model import AuditEvent, StationClock
from flasher.web.pages import Pages
from flasher.web.query_processes import question_of
from flasher.web.server import client_at
from flasher.web.sign_ins import IDLE_S, SHIFT_S, Note, SignIn, SignIns
from flasher.web.supervisor import frame

LOGIN: Final = "/login"
SIGN_OUT: Final = "/sign-out"
SIGN_INS: Final = "/sign-ins"
_END: Final = f"{SIGN_INS}/end"
_KEYS: Final = "sign_ins"
"""Session key for the keys of the browser's sign-ins."""
FORMS: Final = (LOGIN, SIGN_OUT, _END)
"""Forms with the session's token in a field."""
_WAITING_MAX: Final = 4
"""Maximum number of PINs that are checked or wait."""
_WAITING_OF_ONE_MAX: Final = 2
"""Maximum number for one address, so that one client cannot use all of them."""
_QUERY_MAX: Final = 1000
"""Maximum length of a page's query that is stored during sign-in."""
_BADGE_MAX: Final = 300
"""Maximum length of a badge or a PIN."""


ROLE_WORDS: Final = {
    Role.OPERATOR: text("operator"),
    Role.REWORK: text("rework"),
    Role.SUPERVISOR: text("supervisor"),
}


@dataclass(frozen=True)
class Badges:
    """Badges of people who may open pages."""

    people: Sequence[Person]
    needs_pin: bool
    """True if a badge requires a PIN."""
    is_supervised: Callable[[str], bool]
    """True for the path of a supervisors' page."""
    are_for_all: bool
    """True if all other pages need a badge too, of any role."""

    def find(self, code: str) -> Person | None:
        return next((each for each in self.people if each.code == code), None)

    @property
    def any_hash(self) -> str:
        """A hash for the check of unknown badges, so that timing does not reveal known ones."""
        return next((each.pin for each in self.people if each.pin), "")


class _RefusedError(Exception):
    def __init__(
        self, trouble: str, status: int = 403, *, wait_s: int = 0, badge: str = ""
    ) -> None:
        super().__init__(trouble)
        self.trouble = trouble
        self.status = status
        self.wait_s = wait_s
        self.badge = badge
        """Scanned badge that needs a PIN."""


class _Places:
    """Limits the number of waiting requests; further ones are refused at once."""

    def __init__(self) -> None:
        self._taken: Counter[str] = Counter()

    @contextmanager
    def of(self, address: str) -> Iterator[None]:
        if self._taken.total() >= _WAITING_MAX or self._taken[address] >= _WAITING_OF_ONE_MAX:
            trouble = text("Others are signing in at this moment. Try it again.")
            raise _RefusedError(trouble, 503, wait_s=1)
        self._taken[address] += 1
        try:
            yield
        finally:
            self._taken[address] -= 1
            self._taken += Counter()  # without those that are zero


class Login:
    """Signs people in by a shared password or a badge."""

    def __init__(
        self,
        pages: Pages,
        clock: StationClock,
        note: Note,
        *,
        checker: Executor,
        password: str = "",
        badges: Badges | None = None,
    ) -> None:
        self._pages = pages
        self._clock = clock
        self._note = note
        self._checker = checker
        self._password = password
        self._badges = badges
        self._attempts = Attempts()
        self._places = _Places()
        self.sign_ins = SignIns(clock, note)

    @property
    def routes(self) -> list[BaseRoute]:
        return [
            Route(LOGIN, self._page, methods=["GET"]),
            Route(LOGIN, self._take, methods=["POST"]),
            Route(SIGN_OUT, self._sign_out, methods=["POST"]),
            Route(SIGN_INS, self._list, methods=["GET"]),
            Route(_END, self._end, methods=["POST"]),
        ]

    # -- for the guard ----------------------------------------------------------------------------

    def find(self, session: dict[str, Any], *, is_use: bool = False) -> SignIn | None:
        """The active sign-in of a session; `is_use`: a page is viewed."""
        return self.sign_ins.find(_keys(session), is_use=is_use)

    def is_refused(self, path: str, sign_in: SignIn | None) -> bool:
        """True for a page that this sign-in (None: none) may not open."""
        badges = self._badges
        if badges is not None and (path.startswith(SIGN_INS) or badges.is_supervised(path)):
            return sign_in is None or not sign_in.is_supervisor
        if path.startswith(SIGN_INS):
            return sign_in is None
        asks_all = bool(self._password) or (badges is not None and badges.are_for_all)
        return asks_all and sign_in is None

    def want(self, session: dict[str, Any], scope: Scope) -> None:
        """Store the requested page, to open it after sign-in."""
        query = scope["query_string"].decode("latin-1")[:_QUERY_MAX]
        # Exactly one slash: after two, the name of another computer would follow.
        session["wanted"] = "/" + scope["path"].lstrip("/\\") + (f"?{query}" if query else "")

    # -- in ---------------------------------------------------------------------------------------

    async def _page(self, request: Request) -> Response:
        return self._show(request)

    def _show(self, request: Request, refused: _RefusedError | None = None) -> Response:
        badge = "" if refused is None else refused.badge
        answer = self._pages.show(
            request,
            "login.html",
            status=200 if refused is None else refused.status,
            trouble="" if refused is None else refused.trouble,
            badge=badge,
            asks_password=bool(self._password) and self.find(request.session) is None,
            asks_badge=self._badges is not None,
            is_for_supervisors=self._is_for_supervisors(request),
        )
        if refused is not None and refused.wait_s:
            answer.headers["retry-after"] = str(refused.wait_s)
        return answer

    async def _take(self, request: Request) -> Response:
        fields = await _form(request)
        if fields is None:
            return RedirectResponse(LOGIN, 303)
        address = _address(request)
        try:
            person = await self._checked(address, fields)
            if self._is_for_supervisors(request) and person is not None:
                self._check_supervisor(address, person)
        except _RefusedError as refused:
            return self._show(request, refused)
        keys = self.sign_ins.begin(person, address, _keys(request.session))
        request.session[_KEYS] = keys
        return RedirectResponse(request.session.pop("wanted", "/"), 303)

    async def _checked(self, address: str, fields: dict[str, str]) -> Person | None:
        """The person of a badge; None for the password. Raises _RefusedError."""
        code, pin = (fields.get(name, "").strip()[:_BADGE_MAX] for name in ("badge", "pin"))
        # A wrong badge is a wrong try, even with the right password.
        if self._badges is not None and code:
            return await self._person(self._badges, address, code, pin)
        self._count(address, "")
        password = fields.get("password", "").encode()
        if not (self._password and hmac.compare_digest(password, self._password.encode())):
            raise self._wrong(address, "", "wrong password")
        self._attempts.forget(address, "")
        return None

    async def _person(self, badges: Badges, address: str, code: str, pin: str) -> Person:
        """The person of a badge, after the check of the PIN. Raises _RefusedError."""
        person = badges.find(code)
        if person is not None and not (person.pin or badges.needs_pin):
            self._count(address, code)
            self._attempts.forget(address, code)
            return person
        if not pin:  # a scanner ends what it types by Enter
            self._count(address, None)
            raise _RefusedError(text("Type the PIN of the badge."), badge=code)
        # Also for a badge that opens nothing, so that the time does not reveal it.
        pin_hash = person.pin if person is not None and person.pin else badges.any_hash
        with self._places.of(address):
            self._count(address, code)
            is_right = pin_hash != "" and await asyncio.wrap_future(
                self._checker.submit(pins.is_right, pins.Pin(pin), pin_hash)
            )
        if person is None:
            raise self._wrong(address, code, "unknown badge")
        if not (is_right and person.pin):
            raise self._wrong(address, code, "wrong PIN", person.name)
        self._attempts.forget(address, code)
        return person

    def _count(self, address: str, badge: str | None) -> None:
        """Count a try before its check. Raises _RefusedError if there were too many."""
        wait_s = ceil(self._attempts.begin(address, badge, self._clock.monotonic_s()))
        if wait_s:
            trouble = text("Too many tries: wait {seconds} s.", seconds=wait_s)
            raise _RefusedError(trouble, 429, wait_s=wait_s)

    def _wrong(self, address: str, badge: str, why: str, name: str = "") -> _RefusedError:
        # Recorded without the text, which may be a PIN typed into the wrong field.
        data = {"name": name, "address": address, "why": why}
        pause_s = self._attempts.pause_s(address, badge, self._clock.monotonic_s())
        if pause_s:
            data["pause"] = f"{ceil(pause_s)} s"
        self._note(AuditEvent.SIGN_IN_REFUSED, data)
        return _RefusedError(text("The badge, PIN or password is wrong."))

    def _check_supervisor(self, address: str, person: Person) -> None:
        """Check that a badge is a supervisor's. Raises _RefusedError."""
        if person.role is not Role.SUPERVISOR:
            data = {"name": person.name, "address": address, "why": "no supervisor"}
            self._note(AuditEvent.SIGN_IN_REFUSED, data)
            raise _RefusedError(text("That is not the badge of a supervisor."))

    def _is_for_supervisors(self, request: Request) -> bool:
        wanted = str(request.session.get("wanted", "/")).partition("?")[0]
        return self._badges is not None and self._badges.is_supervised(wanted)

    # -- out --------------------------------------------------------------------------------------

    async def _sign_out(self, request: Request) -> Response:
        fields, sign_in = await _form(request), self.find(request.session)
        if fields is not None and sign_in is not None:
            self.sign_ins.sign_out(sign_in, everywhere="everywhere" in fields)
        return RedirectResponse("/", 303)

    # -- active sign-ins --------------------------------------------------------------------------

    async def _list(self, request: Request) -> Response:
        question = question_of(SIGN_INS, request, self._pages)
        now = self._clock.utc().astimezone()
        listed = self.sign_ins.listed()
        return self._pages.show(
            request,
            "sign_ins.html",
            sign_ins=reversed(listed),
            roles=ROLE_WORDS,
            hours=f"{SHIFT_S / 3600:g}",
            minutes=f"{IDLE_S / 60:g}",
            **frame(question, now),
        )

    async def _end(self, request: Request) -> Response:
        fields, by = await _form(request), self.find(request.session)
        if fields is not None and by is not None:
            if "all" in fields:
                self.sign_ins.end_all(by)
            else:
                self.sign_ins.end(fields.get("number", ""), by)
        return RedirectResponse(SIGN_INS, 303)


def _keys(session: Mapping[str, Any]) -> list[str]:
    return list(session.get(_KEYS, ()))


async def _form(request: Request) -> dict[str, str] | None:
    """Fields of a form; None if it lacks this session's token."""
    found = parse_qs((await request.body()).decode("utf-8", "replace"), keep_blank_values=True)
    fields = {name: values[0] for name, values in found.items()}
    token: str = request.session["token"]
    is_own = hmac.compare_digest(fields.get("token", "").encode(), token.encode())
    return fields if is_own else None


def _address(request: Request) -> str:
    return "" if request.client is None else client_at(request.client.host)
