"""Renders the page templates of this package and `flasher.report`, escaped and translated."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from functools import cache
from typing import Any, Final

from jinja2 import ChoiceLoader, Environment, PackageLoader
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response, StreamingResponse

from flasher import __version__
from flasher.report.base import environment
from flasher.translation import NAMES, Translator, chosen, translator

_PART: Final = "part_"


def streamed(messages: AsyncIterator[dict[str, Any]]) -> Response:
    """Response with server-sent events for a page's script."""

    async def lines() -> AsyncIterator[str]:
        yield "retry: 500\n\n"
        async for message in messages:
            yield f"data: {json.dumps(message, ensure_ascii=False)}\n\n"

    headers = {"x-accel-buffering": "no"}
    return StreamingResponse(lines(), media_type="text/event-stream", headers=headers)


@cache
def _environment(language: str) -> Environment:
    folders = [
        ("flasher.web", "templates"),
        ("flasher.web", "static"),
        ("flasher.report", "templates"),
    ]
    loader = ChoiceLoader([PackageLoader(*each) for each in folders])
    return environment(loader, translator(language))


def page_text(template: str, translate: Translator, token: str, **context: Any) -> str:
    """Render a page. Templates also get `token`, `languages` and `version`."""
    page = _environment(translate.code).get_template(template)
    return page.render(languages=NAMES, token=token, version=__version__, **context)


class Pages:
    """Renders pages. `language`: the default; None: the browser's. With `remembers_language`, a
    chosen language is stored in the session.
    """

    def __init__(self, language: str | None = None, *, remembers_language: bool = False) -> None:
        self._language = language
        self._remembers_language = remembers_language

    def translator_of(self, request: Request) -> Translator:
        accepted = request.headers.get("accept-language", "").replace(" ", "").split(",")
        wanted = request.query_params.get("lang")
        if self._remembers_language:
            wanted = request.session["lang"] = wanted or request.session.get("lang", "")
        return chosen(wanted or self._language, accepted)

    def parts(self, translate: Translator, template: str, **context: Any) -> dict[str, str]:
        """Render each macro `part_...` of a template, by name."""
        found = _environment(translate.code).get_template(template).make_module(context)
        return {
            name.removeprefix(_PART): str(macro())
            for name, macro in vars(found).items()
            if name.startswith(_PART)
        }

    def show(
        self, request: Request, template: str, *, status: int = 200, **context: Any
    ) -> Response:
        """Response with a page in the language of the request."""
        token = request.session.get("token", "")
        context.setdefault("sign_in", request.scope.get("sign_in"))
        return HTMLResponse(
            page_text(template, self.translator_of(request), token, **context), status
        )
