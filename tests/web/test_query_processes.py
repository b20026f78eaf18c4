"""Answers from processes of their own."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import sys
import threading
from contextlib import closing
from functools import partial

import pytest

from flasher.errors import UsageError
from flasher.web.query_processes import Answer, Answering, QueryProcesses, Question
from tests.web.own_loop import in_own_loop

pytestmark = pytest.mark.slow


class Echo:
    """`/pid` answers the number of its process, `/wait` nothing."""

    def answer(self, question: Question) -> Answer:
        if question.path == "/wait":
            threading.Event().wait()
        return Answer(str(os.getpid()).encode() if question.path == "/pid" else b"/runs")


def _echo() -> Answering:
    return Echo()


def _broken(what: str) -> Answering:
    raise UsageError(what, remedy="Correct it.")


def test_a_question_is_answered_and_what_is_wrong_is_reported() -> None:
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


def _pid(answering: QueryProcesses) -> int:
    return int(in_own_loop(answering.ask(Question("/pid"))).body)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_process_that_was_killed_is_replaced_and_the_end_does_not_wait_for_it() -> None:
    """Where memory is short, the system ends the process that uses the most."""
    with closing(QueryProcesses(_echo)) as answering:
        first = _pid(answering)
        for process in multiprocessing.active_children():
            os.kill(process.pid or 0, signal.SIGKILL)
            process.join()
        assert _pid(answering) != first


@pytest.mark.skipif(sys.platform == "win32", reason="Windows sends no SIGTERM")
def test_sigterm_to_all_processes_of_a_station_leaves_its_answers() -> None:
    with closing(QueryProcesses(_echo)) as answering:
        first = _pid(answering)
        os.kill(first, signal.SIGTERM)
        pids = {_pid(answering) for _ in range(4)}
    assert first in pids


def test_a_question_that_takes_long_does_not_hold_up_the_end() -> None:
    async def ask(answering: QueryProcesses) -> None:
        await asyncio.wait_for(answering.ask(Question("/wait")), 1.0)

    others = set(multiprocessing.active_children())  # of an earlier test
    with closing(QueryProcesses(_echo)) as answering:
        _pid(answering)
        with pytest.raises(TimeoutError):
            in_own_loop(ask(answering))
    assert not set(multiprocessing.active_children()) - others
