"""Progress of a run on stderr: the current case and the count left; a bar on a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from flasher.cli.bar import Bar
from flasher.cli.output import Output
from flasher.conformance.catalogue import Case
from flasher.conformance.results import CaseResult, CaseVerdict
from flasher.conformance.runner import RunObserver
from flasher.protocol.text import printable

_BAD: Final = (CaseVerdict.FAIL, CaseVerdict.ERROR)
"""Verdicts that need attention; cases that did not run share one reason."""
_BAR: Final = "{n_fmt}/{total_fmt} |{bar:20}| {elapsed} {desc}"


@contextmanager
def progress(output: Output) -> Iterator[RunObserver]:
    """Gives the observer of one run; restores the terminal at the end."""
    shown = _Progress(output)
    with shown.bar:
        yield shown


class _Progress(RunObserver):
    """Prints progress: with a bar on a terminal, elsewhere only with -v."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self.bar = Bar(output, bar_format=_BAR, leave=False)
        self._count = 0
        self._ended = 0

    def run_began(self, count: int) -> None:
        self._count = count
        if count:
            self.bar.move_to(0, count)

    def preparing(self, what: str) -> None:
        self.bar.describe(printable(f"bringing the device to the known state, {what}"))

    def case_began(self, case: Case, repeat: int) -> None:
        again = f" (repeat {repeat})" if repeat > 1 else ""
        self.bar.describe(printable(f"{case.id} {case.title}{again}"))

    def case_ended(self, result: CaseResult) -> None:
        """Cases that this bench cannot run have a verdict before the run begins."""
        if not self._count or (result.verdict is CaseVerdict.UNSUPPORTED and not result.seed):
            return
        self._ended += 1
        left = self._count - self._ended
        line = f"{result.case_id} {result.verdict.text}"
        if result.verdict in _BAD:
            line += f": {result.reason}"
        is_news = self.bar.is_shown and result.verdict in _BAD
        self._output.progress(f"{printable(line)} ({left} left)", level=0 if is_news else 1)
        self.bar.move_to(self._ended, self._count)
