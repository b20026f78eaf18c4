"""A PostgreSQL server of the tests' own: an ordinary user, a temporary folder, loopback."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psycopg

OWNER = "postgres"
_MEMORY = Path("/dev/shm")  # noqa: S108  only a unique folder in it is used
_INSTALLED = Path("/usr/lib/postgresql")
_RULES = f"""\
host all {OWNER} 127.0.0.1/32 trust
host all all 127.0.0.1/32 md5
"""
_FAST = "-c fsync=off -c synchronous_commit=off -c full_page_writes=off -c max_connections=60"
_DURABLE = "-c shared_buffers=1GB -c max_wal_size=4GB -c max_connections=60"


@dataclass
class Server:
    """A running server. Its databases are gone with it."""

    programs: Path
    folder: Path
    port: int
    is_durable: bool = False
    """Each commit waits for the disk."""
    _made: int = 0

    def url(self, database: str, user: str = OWNER) -> str:
        return f"postgresql+psycopg://{user}@127.0.0.1:{self.port}/{database}"

    def connect(self, database: str = OWNER, user: str = OWNER) -> psycopg.Connection:
        """A connection of a program that knows nothing of the station."""
        host = "127.0.0.1"
        return psycopg.connect(host=host, port=self.port, dbname=database, user=user)

    def database(self) -> str:
        """The name of a new database."""
        self._made += 1
        name = f"test_{self._made}"
        with self.connect() as connection:
            connection.autocommit = True
            connection.execute(f"CREATE DATABASE {name}".encode())
        return name

    def start(self) -> None:
        data = self.folder / "data"
        if not data.exists():
            self._run("initdb", "-D", str(data), "-U", OWNER, "-A", "trust", "-N", "-E", "UTF8")
            (data / "pg_hba.conf").write_text(_RULES, encoding="ascii")
        self._start()

    def _start(self) -> None:
        data = self.folder / "data"
        where = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self.folder}"
        log = str(self.folder / "log")
        settings = f"{where} {_DURABLE if self.is_durable else _FAST}"
        self._run("pg_ctl", "-D", str(data), "-w", "-l", log, "-o", settings, "start")

    def stop(self, mode: str = "immediate") -> None:
        self._run("pg_ctl", "-D", str(self.folder / "data"), "-m", mode, "stop")

    def _run(self, program: str, *words: str) -> None:
        # The server refuses to be run by root.
        user = OWNER if os.geteuid() == 0 else None
        subprocess.run(
            [self.programs / program, *words],
            user=user,
            check=True,
            cwd=self.folder,
            stdout=subprocess.DEVNULL,
        )


def find_programs() -> Path | None:
    """The folder of the server's programs; None where it is not installed."""
    found = shutil.which("pg_ctl")
    if found:
        return Path(found).resolve().parent
    installed = _INSTALLED.glob("*/bin/pg_ctl")
    newest = max(installed, key=lambda path: int(path.parts[-3]), default=None)
    return newest and newest.parent


def _has_room(place: Path) -> bool:
    return place.is_dir() and shutil.disk_usage(place).free > 1 << 30


@contextmanager
def running_server(
    programs: Path,
    kept: Path | None = None,
    *,
    is_durable: bool = False,
    in_memory: bool = False,
) -> Iterator[Server]:
    """A server from start to end; with a folder that is `kept`, its databases are there again.
    With `in_memory` they are small, and no disk that is busy holds them up.
    """
    # A short path, since the server's socket lies in it.
    place = _MEMORY if in_memory and _has_room(_MEMORY) else None
    folder = kept or Path(tempfile.mkdtemp(prefix="flasher-pg-", dir=place))
    try:
        if os.geteuid() == 0:
            shutil.chown(folder, OWNER)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        server = Server(programs, folder, port, is_durable)
        server.start()
        try:
            yield server
        finally:
            server.stop("immediate" if kept is None else "fast")
    finally:
        if kept is None:
            shutil.rmtree(folder, ignore_errors=True)
