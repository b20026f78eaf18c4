"""A plant's database on the tests' server, and stations that send to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psycopg

from flasher.plant.central import Central
from flasher.plant.forwarder import Forwarder
from flasher.plant.setup import DELIVERERS, READERS, role_of, setup
from flasher.plant.stations import StationStatus, statuses
from flasher.plant.store import PlantStore
from flasher.station.records.keys import KeyLocations
from flasher.station.records.store import Store
from flasher.web.plant import PlantPages
from flasher.web.supervisor import SupervisorPages, open_supervisor
from tests.station.factory import Bench, FakeClock
from tests.station.postgres import OWNER, Server

STATIONS = ("line-2", "line-3")
PASSWORD = "s3cr3t"  # noqa: S105  of a server that lives as long as the tests
READER = "flasher_desk"
COURIER = "flasher_courier"
_TEMPLATE = "plant_template"


def _make_template(server: Server) -> None:
    """The roles, and a database to copy: making the tables takes most of a second.

    Half the time of a connection is that of SCRAM's 4096 rounds of SHA-256.
    """
    with server.connect() as admin:
        admin.autocommit = True
        if admin.execute("SELECT 1 FROM pg_database WHERE datname = %s", [_TEMPLATE]).fetchone():
            return
        admin.execute(f"CREATE DATABASE {_TEMPLATE}".encode())
        setup(server.url(_TEMPLATE), STATIONS, datetime.now(UTC))
        for role, given in ((READER, READERS), (COURIER, DELIVERERS)):
            admin.execute(f"CREATE ROLE {role} LOGIN".encode())
            admin.execute(f"GRANT {given} TO {role}".encode())
        admin.execute(b"SET password_encryption = 'md5'")
        for role in (*map(role_of, STATIONS), READER, COURIER):
            admin.execute(f"ALTER ROLE {role} PASSWORD '{PASSWORD}'".encode())


@dataclass
class Plant:
    """A database of a plant, empty or a copy of another one to which nothing is connected."""

    server: Server
    folder: Path
    copied: str = _TEMPLATE
    database: str = field(init=False)

    def __post_init__(self) -> None:
        _make_template(self.server)
        self.server._made += 1
        self.database = f"plant_{self.server._made}"
        with self.server.connect() as admin:
            admin.autocommit = True
            made = f"CREATE DATABASE {self.database} TEMPLATE {self.copied} STRATEGY file_copy"
            admin.execute(made.encode())
            # Rights on a database are not copied.
            admin.execute(f"REVOKE ALL ON DATABASE {self.database} FROM PUBLIC".encode())
            given = f"GRANT CONNECT ON DATABASE {self.database} TO flasher_stations, {READERS}"
            admin.execute(given.encode())

    def drop(self) -> None:
        """Delete the database: hundreds of them take long at the end, and gigabytes until then."""
        with self.server.connect() as admin:
            admin.autocommit = True
            admin.execute(f"DROP DATABASE {self.database} WITH (FORCE)".encode())

    def url(self, role: str = OWNER) -> str:
        secret = "" if role == OWNER else f":{PASSWORD}"
        return f"postgresql://{role}{secret}@127.0.0.1:{self.server.port}/{self.database}"

    def connect(self, role: str = OWNER) -> psycopg.Connection[Any]:
        return psycopg.connect(self.url(role))

    def sender(self, station: str) -> Sender:
        return Sender(self, station, self.folder / station)

    def rows(self, query: str) -> list[tuple[Any, ...]]:
        """What the owner of the database reads."""
        with self.connect() as connection:
            return connection.execute(query.encode()).fetchall()

    def status(self, station: str = "line-2") -> StationStatus:
        with closing(Central(self.url(READER))) as central, central.reading() as connection:
            return next(each for each in statuses(connection) if each.station == station)

    def store(self) -> Store:
        """The runs as reports and pages read them."""
        url = self.url(READER)
        return PlantStore.open(url, station="desk", folder=self.folder / "desk", read_only=True)

    @contextmanager
    def pages(self) -> Iterator[SupervisorPages]:
        """The pages of all stations."""
        folder, keys = self.folder / "desk", KeyLocations(self.folder / "desk-keys")
        made = open_supervisor(self.url(READER), folder, keys, (), PlantStore, PlantPages)
        with closing(made.store):
            yield made


@dataclass
class Sender:
    """A station with records of its own, and its forwarder."""

    plant: Plant
    station: str
    folder: Path
    role: str = ""
    _forwarders: list[Forwarder] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder.mkdir(exist_ok=True)
        self.bench = Bench(self.folder)
        if self.station != "line-2":
            self.bench.store.close()
            self.bench.store = self.bench.opened(self.station)
            self.bench.store.recover()
        self.start()

    def start(self) -> None:
        """A new process: it knows nothing of the last one."""
        self.end()
        self.forwarder = Forwarder(
            self.bench.opened(self.station).database,
            self.bench.store.files,
            Central(self.plant.url(self.role or role_of(self.station))),
            self.station,
            FakeClock(datetime.now(UTC)),
        )
        self._forwarders.append(self.forwarder)

    def lose_the_server(self) -> None:
        self.forwarder._central.close()
        self.forwarder._central = Central("postgresql://x@127.0.0.1:1/plant")

    def end(self) -> None:
        """End the process that sends."""
        while self._forwarders:
            self._forwarders.pop().close()

    def send(self) -> None:
        """Send everything; raises what the plant answers."""
        while self.forwarder.forward():
            pass
        if self.forwarder.error is not None:
            raise self.forwarder.error

    def close(self) -> None:
        self.end()
        self.bench.store.close()
