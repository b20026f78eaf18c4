"""The supervisor pages of records, answered in this process."""

from __future__ import annotations

import asyncio
import weakref
from pathlib import Path

from starlette.routing import BaseRoute
from starlette.testclient import TestClient
from starlette.types import ASGIApp

from flasher.station.records.keys import KeyLocations
from flasher.station.shift_counts import DEFAULT_SHIFTS
from flasher.web.guard import application
from flasher.web.login import Login
from flasher.web.pages import Pages
from flasher.web.query_processes import Answer, Question, answer_routes
from flasher.web.supervisor import (
    PAGES,
    UPLOADS,
    SupervisorPages,
    open_supervisor,
)

_KEY = "of the test"


def app_of(database: Path, keys: Path) -> ASGIApp:
    """The pages of the records in a file, which is open as long as they are used."""
    folder = database.with_name(f"{database.name}.files")
    supervisor = open_supervisor(str(database), folder, KeyLocations(keys), DEFAULT_SHIFTS)
    app = app_with(supervisor)
    weakref.finalize(app, supervisor.store.close)
    return app


def app_with(
    supervisor: SupervisorPages, login: Login | None = None, *more: BaseRoute, secret: str = _KEY
) -> ASGIApp:
    """The pages that it answers, and more; with `login` for who signed in."""

    async def ask(question: Question) -> Answer:
        return await asyncio.to_thread(supervisor.answer, question)

    pages = Pages()
    return application(
        [*more, *answer_routes(pages, ask, PAGES, UPLOADS)],
        hosts={"127.0.0.1"},
        secret=secret,
        login=login,
        uploads=UPLOADS,
    )


def client_of(app: ASGIApp) -> TestClient:
    return TestClient(app, base_url="http://127.0.0.1:8741", follow_redirects=False)
