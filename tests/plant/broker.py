"""A Mosquitto of the tests' own: an ordinary user, a temporary folder, loopback."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

_USER = "postgres"
"""Whom a test that runs as root starts it as, like the database server."""


def find_mosquitto() -> str | None:
    """The program; Debian puts it where users have no path to."""
    return shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")


@dataclass
class Broker:
    """A broker that keeps sessions and messages over a restart."""

    program: str
    folder: Path
    port: int
    settings: str = ""
    _process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def start(self) -> None:
        config = self.folder / "mosquitto.conf"
        config.write_text(
            f"listener {self.port} 127.0.0.1\npersistence true\n"
            f"persistence_location {self.folder}/\nlog_dest file {self.folder}/log\n"
            f"max_queued_messages 0\n{self.settings or 'allow_anonymous true'}\n",
            encoding="utf-8",
        )
        is_root = os.geteuid() == 0
        self._process = subprocess.Popen(
            [self.program, "-c", config], user=_USER if is_root else None, cwd=self.folder
        )
        for _ in range(200):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0):
                return
            if self._process.poll() is not None:
                break
            time.sleep(0.05)
        raise RuntimeError((self.folder / "log").read_text(encoding="utf-8"))

    def stop(self) -> None:
        """End it as an administrator does: it saves what it keeps."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


@contextmanager
def running_broker(
    program: str, settings: str = "", files: tuple[Path, ...] = ()
) -> Iterator[Broker]:
    """A broker from start to end. `files` are copied into its folder, which `{folder}` names in the
    settings.
    """
    folder = Path(tempfile.mkdtemp(prefix="flasher-mqtt-"))
    try:
        for path in files:
            shutil.copy(path, folder)
        if os.geteuid() == 0:
            for path in (folder, *folder.iterdir()):
                shutil.chown(path, _USER)
        with socket.create_server(("127.0.0.1", 0)) as probe:
            port = probe.getsockname()[1]
        broker = Broker(program, folder, port, settings.replace("{folder}", str(folder)))
        broker.start()
        try:
            yield broker
        finally:
            broker.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
