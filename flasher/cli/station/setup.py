"""From the options of `flasher station run` to a station's parts: sockets, records, recipe."""

from __future__ import annotations

import getpass
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Final

from flasher.cli.station.records import records_of
from flasher.errors import UsageError
from flasher.station.adapters import Resolved, detect, resolve
from flasher.station.config import MockUnits, SocketConfig, StationConfig, load_config, mock_config
from flasher.station.messages import VirtualUnits, WorkerSetup
from flasher.station.recipe_file import LoadedRecipe
from flasher.station.records import Keeping, Store
from flasher.station.virtual_units import serial_numbers

_LEAVE_S: Final = 2.0
"""A verdict on a virtual unit can be read so long."""
_NUMBERS_TRIED: Final = 10_000
_MOCK_OPTIONS: Final = ("units", "scan_by_hand")


@dataclass(frozen=True)
class Place:
    """Where a station works."""

    config: StationConfig
    sockets: tuple[Resolved, ...]

    @property
    def is_virtual(self) -> bool:
        """True when no socket has an adapter."""
        return all(socket.bus is None for socket in self.sockets)


def find_place(options: SimpleNamespace) -> Place:
    """The sockets that the options name. Raises UsageError, BusError for a missing adapter."""
    if (options.sockets is None) == (options.mock_sockets is None):
        raise UsageError(
            "A station needs either its sockets or virtual ones.",
            remedy="Give --sockets FILE, or --mock-sockets N.",
        )
    if options.sockets is not None:
        config = load_config(options.sockets)
    else:
        config = mock_config(options.mock_sockets, _mock_units(options))
    place = Place(config, resolve(config.socket, detect(config.socket)))
    given = [name for name in _MOCK_OPTIONS if getattr(options, name)]
    if given and not place.is_virtual:
        raise UsageError(
            f"--{given[0].replace('_', '-')} is for virtual units; this station has adapters.",
            remedy="Leave it out.",
        )
    if options.units and options.scans is not None:
        raise UsageError(
            "--units and --scans both say when the station ends.", remedy="Leave one of them out."
        )
    return place


def _mock_units(options: SimpleNamespace) -> MockUnits:
    shares = {"bad": options.mock_bad, "slow": options.mock_slow, "dead": options.mock_dead}
    if sum(shares.values()) > 1:
        raise UsageError(
            "--mock-bad, --mock-slow and --mock-dead are more than all units together.",
            remedy="Their sum is 1 at the most.",
        )
    return MockUnits(**shares, seed=options.mock_seed)


@contextmanager
def opened_records(options: SimpleNamespace, config: StationConfig) -> Iterator[Store]:
    """The records; those of virtual units without --database are gone afterwards.

    Raises UsageError, RecordError.
    """
    if options.mock_sockets is not None and options.database is None:
        with (
            tempfile.TemporaryDirectory(prefix="flasher-station-") as folder,
            Store.open(
                str(Path(folder) / "records.sqlite"),
                station=config.name,
                keeping=Keeping(Path(folder) / "keys"),
            ) as store,
        ):
            yield store
        return
    with records_of(options).open(config.name) as store:
        yield store


def make_setups(
    options: SimpleNamespace, place: Place, recipe: LoadedRecipe, store: Store
) -> Sequence[WorkerSetup]:
    """What each socket's process needs. Raises UsageError for an impossible count of units."""
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    total = len(place.sockets)
    first = _first_number(recipe, store) if place.is_virtual else 1
    return [
        WorkerSetup(
            each.config.name,
            recipe.path,
            files,
            each.bus,
            _virtual(options, each.config, first + number, total, number),
            each.config.power,
        )
        for number, each in enumerate(place.sockets)
    ]


def _virtual(
    options: SimpleNamespace, socket: SocketConfig, first: int, total: int, number: int
) -> VirtualUnits | None:
    if socket.mock is None:
        return None
    # The units are dealt out like cards.
    count = None if options.units is None else (options.units - number + total - 1) // total
    return VirtualUnits(
        socket.mock,
        first,
        total,
        speed=options.mock_speed,
        leave_after_s=_LEAVE_S,
        count=count,
    )


def _first_number(recipe: LoadedRecipe, store: Store) -> int:
    """The number behind the last virtual unit that these records know, so that there are new ones.

    Raises UsageError when there are no further numbers.
    """
    part = recipe.recipe.part
    known = {str(row["serial"]) for row in store.read.table() if row["part"] == part}
    last = 0
    for number in range(1, _NUMBERS_TRIED):
        if not known:
            break
        try:
            serial = next(serial_numbers(recipe.recipe.serial_number, number, 1))
        except UsageError:
            break
        if serial in known:
            known.remove(serial)
            last = number
    return last + 1


def operator_of(options: SimpleNamespace) -> str:
    """Who works here."""
    try:
        return str(options.operator or getpass.getuser())
    except (OSError, KeyError):
        return "operator"
