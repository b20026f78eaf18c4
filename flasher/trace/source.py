"""Explanation of a trace file, or of a bundle with trace and report."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from flasher.errors import FlasherError, UsageError
from flasher.files import JSON_MAX_SIZE, is_folder, opened, parse_json, read
from flasher.protocol.frame import Frame
from flasher.protocol.text import printable
from flasher.trace.bundle import OLDER_TRACE, REPORT, TRACE
from flasher.trace.explain import explain
from flasher.trace.reader import SeveralBusesError, read_trace
from flasher.trace.recorder import ONE_TOOL_CHANNEL
from flasher.trace.story import Cause, Recorded, Story, TraceVerdict
from flasher.wording import explanation

_HEAD_SIZE: Final = 100
_RATE_MAX_BPS: Final = 10_000_000


def explain_path(
    path: Path,
    *,
    bitrate_bps: int | None = None,
    everything: bool = False,
    channel: str | None = None,
) -> Story:
    """Explain a trace file of any known format, or one channel of it, or the folder of a bundle.

    Raises UsageError for other files and folders.
    """
    damage: list[str] = []
    trace = trace_file(path)
    report = _report(path / REPORT) if is_folder(path) else {}
    rate_bps = report.get("bitrate_bps")
    if not isinstance(rate_bps, int) or not 0 < rate_bps <= _RATE_MAX_BPS:
        rate_bps = None
    story = explain(
        frames_until_damage(trace, damage, channel=channel),
        source=str(path),
        suffix=_suffix(trace),
        bitrate_bps=bitrate_bps or rate_bps,
        until=report.get("written_at") if isinstance(report.get("written_at"), float) else None,
        everything=everything,
        recorded=_recorded(report) if report else None,
        is_one_tool=_is_conformance_log(path),
    )
    return replace(_with_tool_end(story), damage=" ".join(damage))


def trace_file(path: Path) -> Path:
    """Return the trace file, for a bundle the one in its folder. Raises UsageError for any other
    folder.
    """
    if not is_folder(path):
        return path
    for name in (TRACE, OLDER_TRACE):
        if (path / name).is_file():
            return path / name
    raise UsageError(
        f"{printable(str(path))} is a folder, but not a bundle: it lacks {TRACE} in it.",
        remedy="Name a trace file, or the folder that a failed command wrote.",
    )


def _with_tool_end(story: Story) -> Story:
    """Replace the verdict "recording ends" of a bundle: it was written after its tool ended."""
    recorded = story.recorded
    if recorded is None or recorded.exit_code is None:
        return story

    def judged(verdict: TraceVerdict) -> TraceVerdict:
        if verdict.cause is not Cause.RECORDING_ENDS:
            return verdict
        first = recorded.error.partition(" | ")[0]
        return replace(
            verdict,
            cause=Cause.TOOL_ENDED,
            text=f"{verdict.text} Here the tool ended: {first}".rstrip(": "),
            likely=explanation(Cause.TOOL_ENDED).likely,
            remedy=explanation(Cause.TOOL_ENDED).remedy,
        )

    upgrades = [*story.upgrades]
    if upgrades:
        upgrades[-1] = replace(upgrades[-1], verdict=judged(upgrades[-1].verdict))
    return replace(story, upgrades=tuple(upgrades), verdict=judged(story.verdict))


def frames_until_damage(
    path: Path, damage: list[str], *, channel: str | None = None
) -> Iterator[tuple[float, Frame]]:
    """Yield the frames up to the first unreadable one, which is described in `damage`: a killed
    recorder leaves half a line. Raises UsageError if no frame can be read, or if the frames are of
    several buses.
    """
    count = 0
    try:
        for timed in read_trace(path, channel=channel):
            yield timed
            count += 1
    except SeveralBusesError:
        raise
    except UsageError as error:
        if not count:
            raise
        damage.append(f"{error.where or error.what}: {error.cause}")


def _is_conformance_log(path: Path) -> bool:
    """True for a log of the conformance suite, by its channel."""
    if path.suffix.lower() != ".log" or not path.is_file():
        return False
    with opened(path, None, may_grow=True) as (file, _):
        return f" {ONE_TOOL_CHANNEL} ".encode() in file.read(_HEAD_SIZE)


def _suffix(path: Path) -> str:
    return "".join(path.suffixes[-2:] if path.suffix == ".gz" else path.suffixes[-1:])[1:].lower()


def _report(path: Path) -> dict[str, Any]:
    """Return the report of a bundle; empty if missing."""
    try:
        if not path.exists():
            return {}
        loaded = parse_json(read(path, JSON_MAX_SIZE))
    except FlasherError as error:
        raise _no_report(path, error.what) from error
    except (OSError, ValueError) as error:
        raise _no_report(path, str(error)) from error
    if not isinstance(loaded, dict):
        raise _no_report(path, "it holds no JSON object")
    return loaded


def _no_report(path: Path, cause: str) -> UsageError:
    return UsageError(
        f"{printable(str(path))} is not the report of a bundle.",
        cause=printable(cause),
        remedy=f"Explain the {TRACE} in the same folder instead.",
    )


def recorded_of(path: Path) -> Recorded:
    """Return the result that a command wrote to its bundle. Raises UsageError if it is broken."""
    return _recorded(_report(path / REPORT))


def _recorded(report: dict[str, Any]) -> Recorded:
    words = report.get("command_line")
    error = report.get("error")
    error = error if isinstance(error, dict) else {}
    exit_code = error.get("exit_code")
    messages = [
        f"{title}{error[key]}"
        for key, title in (
            ("what", ""),
            ("where", "where: "),
            ("cause", "likely cause: "),
            ("remedy", "what to do: "),
        )
        if error.get(key)
    ]
    return Recorded(
        command=printable(shlex.join(map(str, words))) if isinstance(words, list) else "",
        exit_code=exit_code if isinstance(exit_code, int) else None,
        error=printable(" | ".join(messages)),
    )
