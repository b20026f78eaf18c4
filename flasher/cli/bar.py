"""Progress bar on stderr, if that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

from flasher.cli.output import Output


class Bar:
    """Progress bar, shown only on a terminal, and not with -q. Messages meanwhile are printed above
    it. A lost terminal ends only the bar.
    """

    def __init__(self, output: Output, **look: Any) -> None:
        """`look` are keywords of tqdm."""
        self._output = output
        self._look = look
        self._is_wanted = sys.stderr.isatty() and output.verbosity >= 0
        self._bar: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def move_to(self, done: float, total: float, *, note: str = "") -> None:
        """Set the progress; the first call opens the bar."""
        if not self._is_wanted:
            return
        with self._guarded():
            if self._bar is None:
                self._open(total)
            if note:
                self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)

    @property
    def is_shown(self) -> bool:
        """True while the bar is on the screen."""
        return self._bar is not None

    def describe(self, text: str) -> None:
        """Set the text next to the bar."""
        if self._bar is not None:
            with self._guarded():
                self._bar.set_description_str(text)

    def close(self) -> None:
        """End the bar and leave it on the screen. Another one may begin."""
        if self._bar is not None:
            with self._guarded():
                self._bar.close()
            self._forget()

    def _open(self, total: float) -> None:
        from tqdm import tqdm  # noqa: PLC0415  only where a bar is shown

        self._bar = tqdm(total=total, file=sys.stderr, dynamic_ncols=True, **self._look)
        self._output.write_stderr = self._write_above

    def _write_above(self, text: str) -> None:
        with self._guarded():
            self._bar.write(text, file=sys.stderr)

    def _forget(self) -> None:
        self._bar = None
        self._output.restore_stderr()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        try:
            yield
        except OSError:  # the terminal is gone
            self._is_wanted = False
            self._forget()
