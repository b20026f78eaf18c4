"""Append-only file of the finished seeds of a campaign and their results.

One JSON document a line. A campaign that was stopped goes on with the seeds that are left; a shard
writes the same file, and `merge` adds any number of them up.
"""

from __future__ import annotations

import os
import time
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Self

from filelock import FileLock, Timeout

from flasher.errors import ErrorCode, UsageError
from flasher.files import JSON_MAX_SIZE, opened, parse_json
from flasher.protocol.text import printable
from flasher.simulate.campaign import CANARY_EVERY, WALKS, Batch, Result, campaign_key
from flasher.validation import NumberRange, json_keys

if TYPE_CHECKING:
    from pydantic import TypeAdapter

WRITE_INTERVAL_S: Final = 10.0
"""Results of this time share a line; a process that is killed loses at most so much."""
_SEEDS_MAX: Final = 10**12
_RUNS_MAX: Final = 10**9

_Seed = Annotated[int, NumberRange(ge=0, le=_SEEDS_MAX)]
_Count = Annotated[int, NumberRange(ge=1, le=_RUNS_MAX)]
Range = tuple[int, int]
"""First seed, and the seed after the last one."""


@dataclass(frozen=True)
class Entry:
    """Line of a ledger: finished batches, and the sum of their results."""

    campaign: str
    """`campaign_key`"""
    first: _Seed
    runs: _Count | None
    """Seeds of the whole campaign, of which this file may be a part; null without a number."""
    seeds: tuple[tuple[_Seed, _Count], ...]
    """First seed and number of runs of each range."""
    canaries: tuple[tuple[_Seed, str], ...]
    """First seed and planted mistake of each canary."""
    result: Result

    @property
    def end(self) -> int:
        """Seed after the last one of the campaign; without a number of runs, of this line."""
        if self.runs is None:
            return max((first + count for first, count in self.seeds), default=self.first)
        return self.first + self.runs


@cache
def _adapter() -> TypeAdapter[Entry]:
    from pydantic import TypeAdapter  # noqa: PLC0415  slow

    return TypeAdapter(Entry)


@dataclass
class _Read:
    """Sum of the lines of a ledger."""

    result: Result
    ranges: list[Range] = field(default_factory=list)
    canaries: list[tuple[int, str]] = field(default_factory=list)
    wholes: set[Range] = field(default_factory=set)
    size: int = 0
    """Bytes up to the end of the last whole line."""
    notice: str = ""
    """A last line that was written in part."""


def _read(path: Path, campaign: str) -> _Read:
    """Read a ledger; an empty `campaign` is that of its first line. Raises UsageError for a file
    that cannot be read, is damaged before its last line, or was written by other code.
    """
    found = _Read(Result(campaign))
    with opened(path, None, what="ledger", may_grow=True) as (file, size):
        number = 0
        while found.size < size:
            number += 1
            line = file.readline(min(JSON_MAX_SIZE, size - found.size))
            if not line.endswith(b"\n"):
                if found.size + len(line) < size:
                    raise _damaged(path, number, "it is too long")
                found.notice = (
                    f"{printable(str(path))}, line {number}: the last line was written in part; its"
                    " seeds run again."
                )
                break
            entry = _entry(path, number, line, found.result.campaign)
            if not found.result.campaign:
                found.result = Result(entry.campaign)
            found.size += len(line)
            found.result += entry.result
            found.ranges += [(first, first + count) for first, count in entry.seeds]
            found.canaries += entry.canaries
            found.wholes.add((entry.first, entry.end))
    return found


def _entry(path: Path, number: int, line: bytes, expected: str) -> Entry:
    from pydantic import ValidationError  # noqa: PLC0415  slow

    try:
        document = parse_json(line)
    except ValueError as error:
        raise _damaged(path, number, f"it is not valid JSON ({printable(str(error))})") from error
    campaign = document.get("campaign") if isinstance(document, dict) else None
    code = campaign_key()  # the key begins with it
    is_same = campaign == expected if expected else str(campaign).startswith(code)
    if isinstance(campaign, str) and not is_same:
        cause = "flasher or Python was changed since: the same seeds now mean other runs"
        if campaign.startswith(code):
            cause = "the device under test, its profile or an image was changed, or is another"
            its, own = (_command(each) for each in (campaign, expected))
            if its != own:
                cause = f"it is of `{its}`, this is `{own}`"
        raise UsageError(
            f"The ledger {printable(str(path))} is of another campaign, so its results cannot be"
            " added to those of this one.",
            where=f"line {number}: campaign {printable(campaign)[:40]}; this is {expected or code}",
            cause=cause,
            remedy="Run the flasher, Python and device that it is of, or begin with a new file.",
        )
    try:
        entry = _adapter().validate_json(line, strict=True)
    except ValidationError as error:
        wrong = error.errors()[0]
        place = printable(".".join(map(str, wrong["loc"])))[:80]
        raise _damaged(path, number, f"{place}: {wrong['msg']}") from error
    runs = sum(count for _, count in entry.seeds)
    are_inside = all(entry.first <= at and at + count <= entry.end for at, count in entry.seeds)
    if entry.result.campaign != entry.campaign or entry.result.runs != runs or not are_inside:
        raise _damaged(path, number, "its seeds are not those of its result")
    return entry


def _command(campaign: str) -> str:
    return "flasher conformance explore" if WALKS in campaign else "flasher simulate"


def _damaged(path: Path, number: int, why: str) -> UsageError:
    return UsageError(
        f"The ledger {printable(str(path))} is damaged.",
        where=f"line {number}: {why}",
        cause="another program wrote into it, or another file was meant",
        remedy=f"Name another file, or delete line {number}: its seeds then run again.",
    )


class Ledger:
    """Ledger that is written, locked against other programs until it is closed.

    `first` and `runs` are the seeds of the whole campaign; None for one that ends some time.
    `campaign` is a `campaign_key`, by default that of the code.
    Raises UsageError for a file that cannot be read or written, is damaged, was written by other
    code, or is in use.
    """

    def __init__(
        self, path: Path, first: int, runs: int | None, campaign: str | None = None
    ) -> None:
        self._path, self._first, self._runs = path, first, runs
        self._campaign = campaign or campaign_key()
        self._waiting = _Read(Result(self._campaign))
        """Finished batches that are not written."""
        self._lock = FileLock(f"{path}.lock", timeout=0)
        try:
            self._file = path.open("a+b")  # only to write, it would wait for the reader of a pipe
        except OSError as error:
            raise self._not_written(error) from error
        try:
            self._lock.acquire()
        except OSError as error:
            self._file.close()
            if not isinstance(error, Timeout):
                raise self._not_written(error) from error
            raise UsageError(
                f"The ledger {printable(str(path))} is in use.",
                cause="another flasher writes it",
                remedy="Wait for its end, or name another file for each process.",
                code=ErrorCode.FILE_NOT_WRITTEN,
            ) from error
        try:
            self.found = _read(path, self._campaign)
            _check_once([(*each, path) for each in self.found.ranges])
        except BaseException:
            self.close()
            raise
        os.truncate(path, self.found.size)
        self._written_at_s = time.perf_counter()

    @property
    def result(self) -> Result:
        """Sum of all that is finished."""
        return self.found.result + self._waiting.result

    @property
    def notice(self) -> str:
        """Sentence about a line that was dropped; empty without one."""
        return self.found.notice

    def left(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the parts of the batches that the file did not contain when it was opened."""
        done = _joined(self.found.ranges)
        canaries = set(self.found.canaries)
        for batch in batches:
            if batch.is_corpus:
                if not self.found.result.corpus_runs:
                    yield batch
            elif not batch.canary:
                for first, end in _gaps((batch.first, batch.first + batch.count), done):
                    yield replace(batch, first=first, count=end - first)
            elif (batch.first, batch.canary) not in canaries:
                yield batch

    def add(self, batch: Batch, result: Result) -> None:
        """Add the result of a batch, or of its first runs if it was stopped. Raises UsageError if
        the file cannot be written.
        """
        waiting = self._waiting
        if batch.is_corpus:
            if result.corpus_runs < batch.count:
                return  # stopped
        elif batch.canary:
            if not (result.canaries_found or result.canaries_missed):
                return  # stopped
            waiting.canaries.append((batch.first, batch.canary))
        elif result.runs:
            waiting.ranges.append((batch.first, batch.first + result.runs))
        waiting.result += result
        if time.perf_counter() - self._written_at_s >= WRITE_INTERVAL_S:
            self.write()

    def write(self) -> None:
        """Write what was added. Raises UsageError if the file cannot be written."""
        done, self._waiting = self._waiting, _Read(Result(self._campaign))
        self._written_at_s = time.perf_counter()
        if not (done.ranges or done.canaries or done.result.corpus_runs):
            return
        seeds = tuple((first, end - first) for first, end in _joined(done.ranges))
        whole = (self._first, self._runs)
        entry = Entry(self._campaign, *whole, seeds, tuple(done.canaries), done.result)
        self.found.result += done.result
        try:
            self._file.write(_adapter().dump_json(entry) + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._not_written(error) from error

    def close(self) -> None:
        """Release the file. What was added since the last `write` is lost."""
        with suppress(OSError):  # it writes again what did not fit on the disk
            self._file.close()
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.write()
        finally:
            self.close()

    def _not_written(self, error: OSError) -> UsageError:
        return UsageError(
            f"The ledger {printable(str(self._path))} cannot be written: "
            f"{printable(error.strerror or str(error))}.",
            remedy="Name a file in a folder that can be written, on a disk with room.",
            code=ErrorCode.FILE_NOT_WRITTEN,
        )


@json_keys("result missing missing_canaries")
@dataclass(frozen=True)
class Merged:
    """Sum of the ledgers of a campaign."""

    result: Result
    missing: Sequence[Range]
    """Seeds that no file contains: first, and the one after the last."""
    missing_canaries: Sequence[int]  # first seeds of canaries that no file contains
    notices: Sequence[str]


def merge(paths: Iterable[Path]) -> Merged:
    """Add ledgers up. Raises UsageError as `Ledger` does, for seeds that are in two files, and for
    files without a result.
    """
    result = Result("")
    ranges: list[tuple[int, int, Path]] = []
    canaries: dict[tuple[int, str], Path] = {}
    wholes: set[Range] = set()
    notices = []
    for path in paths:
        found = _read(path, result.campaign)
        if not result.campaign:
            result = Result(found.result.campaign)
        result += found.result
        ranges += [(*each, path) for each in found.ranges]
        for canary in found.canaries:
            if canary in canaries:
                raise _doubled(f"canary at seed {canary[0]}", canaries[canary], path)
            canaries[canary] = path
        wholes |= found.wholes
        notices += [found.notice] if found.notice else []
    if not wholes:
        raise UsageError(
            "The ledgers contain no result.",
            cause="the campaign was stopped before its first result",
            remedy="Run it again with the same --ledger.",
        )
    done = _joined([(first, end) for first, end, _ in _check_once(ranges)])
    begun = {first for first, _ in canaries}
    starts = {at for first, end in wholes for at in range(first, end, CANARY_EVERY)}
    return Merged(
        result=result,
        missing=[gap for whole in _joined(wholes) for gap in _gaps(whole, done)],
        missing_canaries=sorted(starts - begun),
        notices=notices,
    )


def _check_once(ranges: list[tuple[int, int, Path]]) -> list[tuple[int, int, Path]]:
    """Sort ranges. Raises UsageError for seeds that are in two of them."""
    ranges = sorted(ranges)
    for (_, end, one), (first, its_end, other) in pairwise(ranges):
        if first < end:
            raise _doubled(f"seeds {first} to {min(end, its_end) - 1}", one, other)
    return ranges


def _doubled(what: str, one: Path, other: Path) -> UsageError:
    return UsageError(
        f"Two results contain the same runs: {what}.",
        where=f"{printable(str(one))} and {printable(str(other))}",
        cause="a file was named twice, or two processes ran the same shard",
        remedy="Name each file once, and one file of each shard.",
    )


def _joined(ranges: Iterable[Range]) -> list[Range]:
    """Sort ranges, and join those that touch or overlap."""
    joined: list[Range] = []
    for first, end in sorted(ranges):
        if joined and first <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((first, end))
    return joined


def _gaps(whole: Range, done: Sequence[Range]) -> Iterator[Range]:
    """Yield the parts of a range that the joined ranges `done` do not contain."""
    at, last = whole
    for first, end in done[bisect_right(done, at, key=lambda each: each[1]) :]:
        if first >= last:
            break
        if first > at:
            yield at, first
        at = end
    if at < last:
        yield at, last
