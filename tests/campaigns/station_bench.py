"""What the station campaigns stand on: units on buses of their own, which outlive every station
process, and a station in a process that can be killed at a chosen commit.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flasher.bus.adapter import open_adapter
from flasher.bus.link import MonotonicClock
from flasher.device.bms import BmsApplication
from flasher.device.model import Device
from flasher.device.profile import DeviceProfile
from flasher.driver import drive
from flasher.image.image import Image
from flasher.image.manifest import release_of, to_toml
from flasher.protocol.contents import SerialNumber
from flasher.protocol.spec import BMS, WELLING
from flasher.protocol.text import decode_text
from flasher.station.events import RunEnded, RunStarted, StationEvent
from flasher.station.messages import WorkerSetup
from flasher.station.options import StationOptions
from flasher.station.recipe_file import LoadedRecipe, load_recipe
from flasher.station.records import Store
from flasher.station.records.model import RunState
from flasher.station.station import Station
from flasher.station.virtual_units import Place

GROUP = "239.74.163.3"
VERSION = "V1r0r4_20220512"
IMAGE = Image.from_bytes(b"BMS\0" + VERSION.encode() + bytes(at % 251 for at in range(6000)))
RECIPE = f"""\
name = "Campaign"
part = "BAT-36"
revision = "1"

[serial_number]
pattern = 'W[0-9]{{7}}'
example = "W2605002"

[[target]]
target = "bms"
image = "bms.bin"
sha256 = "{IMAGE.sha256}"

[[write]]
target = "bms"
item = "serial-number"
values = ["{{serial}}"]
manufacturer = true

[[write]]
target = "bms"
item = "user-string-1"
values = ["made {{date}}"]

[[unchanged]]
target = "bms"
item = "physical-id"
"""


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    assert isinstance(port, int)
    return port


def bus_of(port: int) -> dict[str, Any]:
    """python-can's keywords of a socket's bus; its frames stay on this machine."""
    return {
        "interface": "udp_multicast",
        "channel": GROUP,
        "port": port,
        "hop_limit": 0,
    }


def write_files(folder: Path) -> Path:
    """The recipe with its image and manifest."""
    (folder / "bms.bin").write_bytes(IMAGE.data)
    manifest = to_toml(release_of(IMAGE, BMS))
    (folder / "bms.bin.toml").write_text(manifest, encoding="utf-8")
    path = folder / "recipe.toml"
    path.write_text(RECIPE, encoding="utf-8")
    return path


class _Socket(Place):
    """A place that can be left."""

    over = False

    @property
    def done(self) -> bool:
        return self.over


class UnitOnBus:
    """A socket with a unit in it, served by a thread. No station process has a part in it."""

    def __init__(self, port: int) -> None:
        self._place = _Socket()
        self._link = open_adapter(WELLING.bitrate_bps, **bus_of(port))
        self._clock = MonotonicClock()
        self._todo: list[Callable[[float], None]] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self.serial = ""
        self._thread.start()

    def put(self, serial: str) -> None:
        """Take the unit out and put a new one in, whose label is `serial`."""
        self.serial = serial
        profile = DeviceProfile(
            serial_number="NONE", application_area_bytes=32 * 1024, transfer_timeout_s=0.5
        )
        device = Device(BMS, bitrate_bps=WELLING.bitrate_bps, profile=profile)
        self._do(lambda now: self._place.put(device, now))

    @property
    def is_made(self) -> bool:
        """True when the unit itself has all that a PASS says it has."""
        found: list[bool] = []

        def look(_now: float) -> None:
            device = self._place.device
            assert device is not None
            application = device.application
            assert isinstance(application, BmsApplication)
            kept = application.kept["serial number"]
            assert isinstance(kept, SerialNumber)
            own = decode_text(kept.data())
            found.append(device.stored_image == IMAGE.data and own == self.serial)

        self._do(look)
        return found[0]

    def close(self) -> None:
        self._place.over = True
        self._thread.join(5.0)
        self._link.close()

    def _do(self, action: Callable[[float], None]) -> None:
        done = threading.Event()

        def act(now: float) -> None:
            action(now)
            done.set()

        with self._lock:
            self._todo.append(act)
        assert done.wait(5.0), "the bench does not serve its bus"

    def _serve(self) -> None:
        drive(self._place, self._link, self._clock, cancelled=self._control)

    def _control(self) -> bool:
        with self._lock:
            todo, self._todo = self._todo, []
        for act in todo:
            act(self._clock.now())
        return False


# -- the process that is killed -------------------------------------------------------------------

COMMITS = ("recover", "claim", "intent", "verified", "step", "finish")


TROUBLES = ("locked", "full")
TROUBLE_S = 3.0
ALL_PAGES = 0x3FFFFFFF


@dataclass
class Killer:
    """Kills its own process after the commit with this number; None: never. With `trouble` the
    process lives, but the records cannot be written for a while.
    """

    after: int | None
    trouble: str = ""
    store: Store | None = None
    count: int = 0
    ends_at: float | None = None
    holder: sqlite3.Connection | None = None

    def committed(self) -> None:
        self.count += 1
        if self.count == self.after:
            if not self.trouble:
                os.kill(os.getpid(), signal.SIGKILL)
            self.ends_at = time.monotonic() + TROUBLE_S
            self._begin()

    def _begin(self) -> None:
        assert self.store is not None
        if self.trouble == "full":
            self._limit_pages(1)  # SQLite takes as many as there are
        else:
            file = self.store.database.location.file
            self.holder = sqlite3.connect(str(file), isolation_level=None)
            self.holder.execute("BEGIN IMMEDIATE")

    def look(self) -> None:
        """End the trouble in its time."""
        if self.ends_at is None or time.monotonic() < self.ends_at:
            return
        self.ends_at = None
        if self.holder is not None:
            self.holder.close()
        else:
            self._limit_pages(ALL_PAGES)

    def _limit_pages(self, count: int) -> None:
        assert self.store is not None
        with self.store.database.engine.connect() as connection:
            connection.exec_driver_sql(f"PRAGMA max_page_count = {count}")


def with_killer(store: Store, killer: Killer) -> None:
    """Every operation of the store that commits is followed by the killer's look."""
    for name in COMMITS:
        original = getattr(store, name)

        def wrapped(*args: Any, _original: Any = original, **kwargs: Any) -> Any:
            result = _original(*args, **kwargs)
            killer.committed()
            return result

        setattr(store, name, wrapped)


def setups_of(recipe: LoadedRecipe, ports: list[int]) -> list[WorkerSetup]:
    files = {str(path): sha256 for path, sha256 in recipe.files.items()}
    return [
        WorkerSetup(str(number), recipe.path, files, bus_of(port), silence_s=1.0, probe_s=0.2)
        for number, port in enumerate(ports, 1)
    ]


def station_main(
    folder: Path, shown: Path, orders: dict[str, str], kill_after: int | None, trouble: str = ""
) -> int:
    """The station process: runs the given unit in each socket once. What it shows goes to a file,
    by writes that a kill cannot take back.
    """
    ports = [int(port) for port in (folder / "ports").read_text(encoding="ascii").split()]
    recipe = load_recipe(folder / "recipe.toml")
    killer = Killer(kill_after, trouble)
    ended: set[str] = set()
    log = os.open(shown, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def show(event: StationEvent) -> None:
        match event:
            case RunStarted():
                row = {"began": event.run_id, "serial": event.serial}
            case RunEnded():
                row = {"ended": event.run_id, "outcome": event.outcome, "code": event.code}
                row |= {"serial": event.serial}
                ended.add(event.serial)
            case _:
                return
        os.write(log, json.dumps(row).encode("ascii") + b"\n")

    with Store.open(str(folder / "records.sqlite"), station="line", lock_timeout_s=1.0) as store:
        killer.store = store
        with_killer(store, killer)
        station = Station(
            store,
            recipe,
            setups_of(recipe, ports),
            operator="jo",
            on_event=show,
            options=StationOptions(arrival_limit_s=30.0),
        )
        for name, serial in orders.items():
            station.submit(f"SOCKET {name}")
            station.submit(serial)

        def over() -> bool:
            killer.look()
            if station.is_line_stopped and killer.ends_at is None:
                station.submit("RESUME")
            # A socket takes no order before its adapter is open: it is given again.
            views = {view.name: view for view in station.sockets}
            for name, serial in orders.items():
                view = views[name]
                if serial not in ended and view.state in ("EMPTY", "SCAN") and not view.serial:
                    station.submit(f"SOCKET {name}")
                    station.submit(serial)
            return ended >= set(orders.values())

        station.run(until=over)
    sys.stdout.write(f"{killer.count}\n")
    return 0


def passes_in(store: Store) -> set[str]:
    return {run.serial for run in store.read.runs() if run.state is RunState.PASS}
