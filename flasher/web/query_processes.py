"""Processes that render pages from the records, so that the station is not delayed.

Questions and answers are plain data. The processes start with the first question.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from http import HTTPStatus
from typing import Final, Protocol, TypeVar

from starlette.convertors import Convertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from flasher.errors import FlasherError
from flasher.processes import end_with_parent, signals_blocked
from flasher.web.pages import Pages
from flasher.web.sign_ins import SignIn

PROCESSES: Final = 2
ANSWER_LIMIT_S: Final = 120.0
FIELD_MAX: Final = 200
"""Characters of one field of a form."""
RUN: Final = "{run:run}"
"""The number of a run, in the path of a page."""
_NICENESS: Final = 10
Result = TypeVar("Result")
HTML: Final = "text/html; charset=utf-8"


class _RunConvertor(Convertor[int]):
    """Matches numbers that fit into a database."""

    regex = "[0-9]{1,18}"

    def convert(self, value: str) -> int:
        return int(value)

    def to_string(self, value: int) -> str:
        return str(value)


register_url_convertor("run", _RunConvertor())


@dataclass(frozen=True)
class Question:
    """The request of a page, as plain data."""

    path: str
    fields: Mapping[str, str] = field(default_factory=dict)
    """Query parameters of the URL, without empty ones."""
    run: int = 0
    """Number of the run, for a page about one run."""
    language: str = "en"
    token: str = ""
    sign_in: SignIn | None = None
    """Sign-in of the person."""
    body: bytes = b""
    """Body of a POST request, or empty."""


@dataclass(frozen=True)
class Answer:
    """The response: a page, a file to save, or a redirect."""

    body: bytes = b""
    media_type: str = HTML
    status: int = 200
    file_name: str = ""
    location: str = ""
    """Path on this server to redirect to."""
    after: str = ""
    """Start of the next part of a long file: the field `after` of the next question."""


class Answering(Protocol):
    """Renders answers to questions."""

    def answer(self, question: Question) -> Answer: ...


Ask = Callable[[Question], Awaitable[Answer]]


class QueryProcesses:
    """Pool of processes that answer questions. `make` is called in each process and must be
    picklable; `close` ends them.
    """

    def __init__(self, make: Callable[[], Answering]) -> None:
        self._make = make
        self._pool: ProcessPoolExecutor | None = None

    def begin(self) -> None:
        """Start a process now instead of with the first question."""
        self._submit(os.getpid)

    async def ask(self, question: Question) -> Answer:
        """Answer a question. Raises TimeoutError, or the exception of the process."""
        try:
            answer = self._submit(_answer, question)
            return await asyncio.wait_for(asyncio.wrap_future(answer), ANSWER_LIMIT_S)
        except BrokenExecutor:  # a process was killed: others take its place
            self.close()
            answer = self._submit(_answer, question)
            return await asyncio.wait_for(asyncio.wrap_future(answer), ANSWER_LIMIT_S)

    def _submit(self, function: Callable[..., Result], *arguments: object) -> Future[Result]:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(PROCESSES, context, _begin, (self._make,))
        with signals_blocked():
            return self._pool.submit(function, *arguments)

    def close(self) -> None:
        """End the processes, even during an answer."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = [*(pool._processes or {}).values()]  # noqa: SLF001  nothing else names them
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        for process in processes:
            process.join()


_make: Callable[[], Answering]
_answering: Answering | None = None


def _begin(make: Callable[[], Answering]) -> None:
    """Initialize a process. It must not fail, or another process would start at once."""
    global _make  # noqa: PLW0603  a process has one
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the station, which ends this one
    end_with_parent()
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    _make = make


def _answer(question: Question) -> Answer:
    global _answering  # noqa: PLW0603  a process has one
    try:
        _answering = _answering or _make()
        return _answering.answer(question)
    except FlasherError as error:
        return Answer(str(error).encode("utf-8", "replace"), "text/plain; charset=utf-8", 503)


def question_of(path: str, request: Request, pages: Pages) -> Question:
    """Build the question of a request; `path`: the path of its route."""
    fields = {
        name: value.strip()[:FIELD_MAX]
        for name, value in request.query_params.items()
        if value.strip()
    }
    return Question(
        path,
        fields,
        int(request.path_params.get("run", 0)),
        pages.translator_of(request).code,
        request.session.get("token", ""),
        request.scope.get("sign_in"),
    )


async def _parts(ask: Ask, question: Question, answer: Answer) -> AsyncIterator[bytes]:
    """Stream a file in parts. An exception of `ask` ends the file early."""
    yield answer.body
    while answer.after:
        answer = await ask(replace(question, fields={**question.fields, "after": answer.after}))
        if answer.status != HTTPStatus.OK:
            raise RuntimeError("a part of a file cannot be read")
        yield answer.body


def answer_routes(
    pages: Pages, ask: Ask, paths: Iterable[str], uploads: Iterable[str] = ()
) -> list[BaseRoute]:
    """Routes of pages that are answered by `ask`; those in `uploads` accept a file."""

    async def page(path: str, request: Request) -> Response:
        question = question_of(path, request, pages)
        if request.method == "POST":
            question = replace(question, body=await request.body())
        try:
            answer = await ask(question)
        except TimeoutError:
            return PlainTextResponse("That took too long: choose a shorter period.", 503)
        if answer.location:
            return RedirectResponse(answer.location, 303)
        headers = {}
        if answer.file_name:
            headers["content-disposition"] = f'attachment; filename="{answer.file_name}"'
        if answer.after:
            parts = _parts(ask, question, answer)
            return StreamingResponse(parts, answer.status, headers, answer.media_type)
        return Response(answer.body, answer.status, headers, answer.media_type)

    methods = {path: ["GET", "POST"] for path in uploads}
    return [Route(path, partial(page, path), methods=methods.get(path)) for path in paths]
