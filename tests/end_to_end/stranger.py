"""A program that asks as the tool does and knows of no lock: python-can and nothing else."""

from __future__ import annotations

import threading
from typing import Self

import can

QUERY = (bytes.fromhex("55AA110239002E55"), bytes.fromhex("AA60F0"))
"""Read user string 1 of the BMS, on 0x752."""


class Stranger:
    """Sends a query again and again, in a thread, while the block runs. `bus` are the arguments of
    a UDP multicast bus as `tests.end_to_end.test_processes.bus` gives them.
    """

    def __init__(self, bus: tuple[str, ...], every_s: float) -> None:
        channel = bus[bus.index("-c") + 1]
        port = next(int(word.partition("=")[2]) for word in bus if word.startswith("port="))
        self._bus = can.Bus(
            interface="udp_multicast", channel=channel, port=port, hop_limit=0, ignore_config=True
        )
        self._every_s = every_s
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._ask)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()
        self._bus.shutdown()

    def _ask(self) -> None:
        while not self._is_over.wait(self._every_s):
            for part in QUERY:
                self._bus.send(can.Message(arbitration_id=0x752, data=part, is_extended_id=False))
