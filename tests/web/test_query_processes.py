"""Answers from processes of their own."""

from __future__ import annotations

from contextlib import closing
from functools import partial

import pytest

from flasher.errors import UsageError
from flasher.web.query_processes import Answer, Answering, QueryProcesses, Question
from tests.web.own_loop import in_own_loop

pytestmark = pytest.mark.slow


class Echo:
    def answer(self, question: Question) -> Answer:
        return Answer(question.path.encode())


def _echo() -> Answering:
    return Echo()


def _broken(what: str) -> Answering:
    raise UsageError(what, remedy="Correct it.")


def test_a_question_is_answered_and_what_is_wrong_is_said() -> None:
    """A place that cannot be opened is an answer, and no process that dies again and again."""
    with (
        closing(QueryProcesses(_echo)) as answering,
        closing(QueryProcesses(partial(_broken, "no such place"))) as broken,
    ):

        async def ask() -> list[Answer]:
            return [await each.ask(Question("/runs")) for each in (answering, broken, broken)]

        good, *bad = in_own_loop(ask())
    assert good.body == b"/runs"
    assert [(each.status, b"no such place" in each.body) for each in bad] == [(503, True)] * 2
