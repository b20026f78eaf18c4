"""Bundles: folders with trace, transcript and report of a failed command, for diagnosis.

`trace.blf` contains the last frames, `transcript.txt` the same frames decoded, `report.json` the
circumstances. A bundle appears complete under its final name, or not at all. Only its owner can
read it: a command line may contain private data.

Wireshark, CANalyzer and python-can all read .blf with directions, remote and error frames.
"""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any, Final

from flasher.files import make_private
from flasher.protocol.text import printable
from flasher.python_can import can
from flasher.trace.decoder import BusEvent, TimedDecoder, bits_of
from flasher.trace.recorder import message_of
from flasher.trace.steps import step_of
from flasher.trace.taps import Entry, FlightRecorder

TRACE: Final = "trace.blf"
OLDER_TRACE: Final = "trace.log"
"""Trace file in bundles of older versions."""
TRANSCRIPT: Final = "transcript.txt"
REPORT: Final = "report.json"
PREFIX: Final = "flasher-"
"""Name prefix of every bundle."""
FORMAT: Final = 1
"""Version of report.json, incremented when a key changes its meaning."""
_PACKAGES: Final = {"flasher": "welling-flasher", "python_can": "python-can"}


def write_bundle(
    folder: Path,
    recorder: FlightRecorder,
    facts: Mapping[str, Any],
    *,
    wall_clock: Callable[[], float] = time.time,
) -> Path:
    """Write a bundle into `folder`, creating it if needed; return the bundle's path.

    The name is `facts["target"]` and the time; no bundle is overwritten. `facts` go into
    report.json: dataclasses by field, other types that JSON lacks as text. Raises OSError.
    """
    now = wall_clock()
    folder.mkdir(parents=True, exist_ok=True)
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(now))
    path, part = _names(folder, f"{PREFIX}{facts.get('target') or 'bus'}-{stamp}")
    try:
        for name in (TRACE, TRANSCRIPT, REPORT):
            make_private(part / name)
        _write_trace(part / TRACE, recorder)
        with (part / TRANSCRIPT).open("w", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in transcript(recorder))
        report = {**_circumstances(recorder, now), **facts}
        text = json.dumps(report, indent=2, default=_plain)
        (part / REPORT).write_text(f"{text}\n", encoding="utf-8")
        part.rename(path)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return path


def _plain(value: Any) -> Any:
    """Convert a value for JSON without the validation library, whose import takes a while."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return value.value if isinstance(value, Enum) else printable(str(value))


def bundles(folder: Path) -> list[Path]:
    """List the bundles in a folder, latest last; empty if the folder is missing."""
    if not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if path.name.startswith(PREFIX) and path.is_dir())
    return sorted(found, key=lambda path: (path.stat().st_mtime_ns, path.name))


def keep_last(folder: Path, count: int) -> None:
    """Remove all bundles in a folder except the latest `count`."""
    for path in bundles(folder)[:-count]:
        shutil.rmtree(path, ignore_errors=True)


def _names(folder: Path, base: str) -> tuple[Path, Path]:
    """Return a free name, and the new temporary folder for writing."""
    for number in count(1):
        name = base if number == 1 else f"{base}-{number}"
        part = folder / f".{name}.part"
        if (folder / name).exists():
            continue
        try:
            part.mkdir(mode=0o700)
        except FileExistsError:
            continue
        return folder / name, part
    raise AssertionError  # pragma: no cover  count never ends


def _write_trace(path: Path, recorder: FlightRecorder) -> None:
    offset_s = recorder.wall_offset_s or 0.0
    writer = can.BLFWriter(path)
    # The file header holds milliseconds: times relative to them are exact.
    first_at_s = next((entry.at_s for entry in recorder), 0.0) + offset_s
    writer.start_timestamp = math.floor(first_at_s * 1000) / 1000
    try:
        for entry in recorder:
            at_s = entry.at_s + offset_s
            writer.on_message_received(message_of(entry.frame, sent=entry.sent, at_s=at_s))
    finally:
        writer.stop()


def transcript(recorder: FlightRecorder) -> Iterator[str]:
    """Yield a line for each message in the recorder: seconds since the oldest frame, direction, CAN
    id, sender and receiver, content.
    """
    pieces = TimedDecoder()
    first_at: float | None = None
    last_at = 0.0
    own: dict[int, str] = {}
    for at_s, frame, sent in recorder:
        first_at = at_s if first_at is None else first_at
        last_at = at_s - first_at
        own[frame.can_id] = "out" if sent else "in"
        for timed in pieces.feed(frame, last_at, bits_of(frame)):
            yield _line(timed.event, own.get(timed.event.can_id, "in"))
    for timed in pieces.finish(last_at):
        yield _line(timed.event, own.get(timed.event.can_id, "in"))


def _line(event: BusEvent, direction: str) -> str:
    step = step_of(event, event.at)
    route = f"{step.sender} > {step.receiver}" if step.sender else ""
    line = ("! " if step.is_trouble else "") + step.title + (f": {step.text}" if step.text else "")
    return f"{step.at_s:10.6f}  {direction:<3}  {event.can_id:03X}  {route:<9}  {line}"


def _circumstances(recorder: FlightRecorder, now: float) -> dict[str, Any]:
    last: Entry | None = recorder.last
    offset_s = recorder.wall_offset_s or 0.0
    return {
        "bundle": FORMAT,
        "written_at": now,
        "versions": versions(),
        "frames_seen": recorder.frames,
        "frames_kept": len(recorder),
        "last_frame": None
        if last is None
        else {"monotonic_s": last.at_s, "wall_s": last.at_s + offset_s},
    }


def versions() -> dict[str, str | None]:
    """Versions of flasher, of its libraries, and of the operating system."""
    return {
        **{name: _version(package) for name, package in _PACKAGES.items()},
        "python": platform.python_version(),
        "os": platform.platform(),
    }


@cache
def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
