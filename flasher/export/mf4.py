"""Signal export to a measurement file (ASAM MDF 4). Needs the extra `mf4`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy
from asammdf import MDF, Signal

from flasher.export.names import key
from flasher.export.signals import SignalRow
from flasher.protocol import messages
from flasher.protocol.catalogue import BY_KEY
from flasher.protocol.fields import FlagsField, flag_names
from flasher.trace.decoder import BusEvent, Kind
from flasher.trace.explain import WALL_TIME_FROM


@dataclass
class _Channel:
    unit: str
    samples: list[int] = field(default_factory=list)


@dataclass
class _Group:
    """Messages of one title, which share a time axis."""

    times_s: list[float] = field(default_factory=list)
    channels: dict[str, _Channel] = field(default_factory=dict)


def write_mf4(rows: Iterable[SignalRow], to: Path) -> int:
    """Write the numbers and flags of all messages; return the number of channels.

    Raises OSError.
    """
    groups: dict[str, _Group] = {}
    start_s = 0.0
    for row in rows:
        start_s = row.stamp_s - row.time_s
        values = list(_numbers(row.event)) if row.event.kind is Kind.MESSAGE else []
        if not values:
            continue
        group = groups.setdefault(row.event.title, _Group())
        group.times_s.append(row.time_s)
        for name, unit, value in values:
            group.channels.setdefault(name, _Channel(unit)).samples.append(value)
    with MDF(version="4.10") as mdf:
        if start_s >= WALL_TIME_FROM:
            mdf.header.start_time = datetime.fromtimestamp(start_s, tz=UTC)
        for title, group in groups.items():
            times = numpy.array(group.times_s)
            signals = [
                Signal(numpy.array(channel.samples), times, name=name, unit=channel.unit)
                for name, channel in group.channels.items()
            ]
            mdf.append(signals, acq_name=title, comment=title, common_timebase=True)
        mdf.save(to, overwrite=True)
    return sum(len(group.channels) for group in groups.values())


def _numbers(event: BusEvent) -> Iterator[tuple[str, str, int]]:
    """Yield name, unit and value of each field that can be plotted."""
    prefix, command = key(event.title), event.command or 0
    item = BY_KEY.get((event.can_id, command))
    codecs = dict(
        messages.UPGRADE_MESSAGES[command].LAYOUT if item is None else item.content.LAYOUT
    )
    for shown in event.fields:
        name, codec = f"{prefix}.{shown.name}", codecs[shown.name]
        if isinstance(codec, FlagsField):
            for bit in codec.names:
                (text,) = flag_names(codec.names, bit)
                yield f"{name}.{key(text)}", "", int(text in shown.value)
        elif isinstance(shown.value, int):
            yield name, codec.unit, shown.value
        elif isinstance(shown.value, list):
            for at, value in enumerate(shown.value, 1):
                yield f"{name}.{at}", codec.unit, value
