"""How a run goes, on stderr: which case, and how many are left; a line of its own on a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from flasher.cli.output import Output
from flasher.conformance.catalogue import Case
from flasher.conformance.results import CaseResult, CaseVerdict
from flasher.conformance.runner import RunObserver
from flasher.protocol.text import printable

_BAD: Final = (CaseVerdict.FAIL, CaseVerdict.ERROR)
"""Verdicts that need somebody to look; cases that were not run have one reason for all of them."""
_BAR: Final = "{n_fmt}/{total_fmt} |{bar:20}| {elapsed} {desc}"


@contextmanager
def progress(output: Output) -> Iterator[RunObserver]:
    """An observer for one run; the terminal is as before at the end."""
    shown = _Progress(output)
    try:
        yield shown
    finally:
        shown.close()


class _Progress(RunObserver):
    """An observer that tells a person; on a terminal with a bar, elsewhere only with -v."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self._wants_bar = sys.stderr.isatty() and output.verbosity >= 0
        self._bar: Any = None
        self._count = 0
        self._ended = 0

    def run_began(self, count: int) -> None:
        """So many case runs follow."""
        self._count = count
        if not self._wants_bar or not count:
            return
        from tqdm import tqdm  # noqa: PLC0415  only where a bar is shown

        bar = tqdm(total=count, bar_format=_BAR, file=sys.stderr, dynamic_ncols=True, leave=False)
        self._bar = bar
        self._output.write_stderr = lambda text: bar.write(text, file=sys.stderr)

    def preparing(self, what: str) -> None:
        """The device is brought to the known state."""
        self._describe(f"bringing the device to the known state, {what}")

    def case_began(self, case: Case, repeat: int) -> None:
        """A case begins."""
        self._describe(f"{case.id} {case.title}" + (f" (repeat {repeat})" if repeat > 1 else ""))

    def case_ended(self, result: CaseResult) -> None:
        """A case has its verdict; what this bench cannot run has one before the run begins."""
        if not self._count or (result.verdict is CaseVerdict.UNSUPPORTED and not result.seed):
            return
        self._ended += 1
        left = self._count - self._ended
        line = f"{result.case_id} {result.verdict.text}"
        if result.verdict in _BAD:
            line += f": {result.reason}"
        is_news = self._bar is not None and result.verdict in _BAD
        self._output.progress(f"{printable(line)} ({left} left)", level=0 if is_news else 1)
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.update(1)

    def _describe(self, text: str) -> None:
        if self._bar is None:
            return
        try:
            self._bar.set_description_str(printable(text))
        except OSError:  # the terminal is gone; the run goes on
            self._wants_bar = False
            self.close()

    def close(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.close()
            self._bar = None
            self._output.restore_stderr()
