"""Sockets of a station as threads of the test: what a socket's process does, without processes."""

from __future__ import annotations

import multiprocessing
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from flasher.station.messages import FromWorker, ToWorker, WorkerSetup
from flasher.station.worker import StationGoneError, StationPipe, Worker, load_same, open_socket


class ThreadPort:
    """The station's end of one thread."""

    def __init__(self, setup: WorkerSetup) -> None:
        self._channel, theirs = multiprocessing.Pipe()
        self._thread = threading.Thread(target=_work, args=(theirs, setup), daemon=True)
        self._thread.start()

    @property
    def waitable(self) -> Connection[Any, Any]:
        return self._channel

    def send(self, message: ToWorker) -> bool:
        try:
            self._channel.send(message)
        except (OSError, ValueError):
            return False
        return True

    def receive(self) -> FromWorker | None:
        if not self._channel.poll():
            return None
        message: FromWorker = self._channel.recv()
        return message

    def kill(self) -> None:
        self._channel.close()
        self._thread.join(2.0)

    def join(self, limit_s: float) -> bool:
        self._thread.join(limit_s)
        return not self._thread.is_alive()


def _work(channel: Connection[Any, Any], setup: WorkerSetup) -> None:
    pipe = StationPipe(channel, time.perf_counter)
    with suppress(StationGoneError):
        recipe = load_same(setup)
        with open_socket(setup, recipe) as (connection, virtual):
            Worker(setup, recipe, pipe, connection, virtual).work()
    channel.close()
