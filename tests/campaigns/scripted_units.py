"""Units in a process of their own, which no kill of a station reaches: the scripted device of the
peers, which shares no code with flasher, on one multicast bus for each socket.

    python -m tests.campaigns.scripted_units ANSWER_S PORT...

Orders are lines of JSON on stdin, each is answered by one on stdout: {"put": UNIT, "into": PORT},
{"out": UNIT} and {"look": UNIT}. A unit is made at its first `put` ("own" is the serial number that
it has then), and keeps its image and its number in and out of sockets. It also notes what is done
to it, with the time and the socket's port.
"""

from __future__ import annotations

import json
import random
import select
import socket
import struct
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, Final, Self

import can

from tests.peers.scripted_device import ScriptedDevice
from tests.peers.wording import READ, REPORT, WORDINGS, WRITE, build, literal, payloads

_SAYS: Final = 0x720
_LOOK_S: Final = 0.01
NEW_VERSION: Final = "V1r2r3_20220512"
"""What the scripted battery says when it runs an image that it was given."""


def bus_of(port: int) -> dict[str, Any]:
    """python-can's keywords of a socket's bus; its frames stay on this machine. A multicast bus
    hears every group on its port, and a station wants a channel of its own for each socket.
    """
    channel = f"239.74.{port >> 8}.{port & 0xFF}"
    return {"interface": "udp_multicast", "channel": channel, "port": port, "hop_limit": 0}


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    assert isinstance(port, int)
    return port


def _text(text: str) -> bytes:
    return (text + ".").encode("ascii").ljust(16)


class Unit(ScriptedDevice):
    """A battery with a serial number that can be written, and a session that it forgets."""

    def __init__(self, own_serial: str, session_s: float | None, answer_s: float) -> None:
        super().__init__("bms", erase_s=0.2, answer_s=answer_s)
        self.serial = own_serial
        self._session_s = session_s
        """Silence after which it leaves an upgrade; None: never (R26)."""
        self._heard_at = 0.0
        self.port = 0
        """The socket that it was put into last."""
        self._done: list[tuple[float, int, str]] = []
        """When and where it was flashed or got a number, and which; empty for a flash."""

    def hear(self, mode: int, command: int, data: bytes, now: float) -> None:
        self._heard_at = now
        if self.state == "application" and (mode, command) == (WRITE, 0x4110):
            self.serial = data.partition(b".")[0].decode("ascii").rstrip()
            self._done.append((time.time(), self.port, self.serial))
            self.say("feedback", literal(WORDINGS["bms"].feedback), not_before=now)
        elif self.state == "application" and (mode, command) == (READ, 0x3400):
            state = struct.pack("<HhHHBBBB4x", 36000, 0, 5000, 10000, 65, 50, 0, 100)
            self._report(0x1010, state, now)
        elif self.state == "application" and (mode, command) == (READ, 0x3000):
            self._report(0x160C, b"\x01\x01\x3a\x14\x3a\x12" * 2, now)
        elif self.state == "application" and (mode, command) == (READ, 0x3300):
            firmware = NEW_VERSION if self.completed else "V1r2r2_20220401"
            fields = map(_text, ("BM36", self.serial, "V1r2r0_20220512", firmware))
            self._report(0x1540, b"".join(fields), now)
        else:
            taken = self.updates_taken
            super().hear(mode, command, data, now)
            if self.updates_taken > taken:
                self._done.append((time.time(), self.port, ""))
            if self.state in ("erasing", "transfer") and self._session_s is not None:
                self.alarm(now + self._session_s, self._forget)

    def _report(self, command: int, data: bytes, now: float) -> None:
        self.say("report", payloads(build(_SAYS, REPORT, command, data)), can_id=_SAYS,
                 not_before=now)  # fmt: skip

    def _forget(self, now: float) -> None:
        left_s = (self._session_s or 0.0) - (now - self._heard_at)
        if self.state in ("erasing", "transfer") and left_s <= 0.0:
            self.power_on(now)

    def power_on(self, now: float) -> None:
        self.note("power", now)
        super().power_on(now)

    @property
    def is_unheard(self) -> bool:
        """It has sent nothing since it got power, or since it confirmed a reset: the announcement
        of another unit looks like its own then.
        """
        reported: list[str] = []
        for entry in reversed(self.log):
            if entry.what in ("power", "reset"):
                wanted = ["feedback"] if entry.what == "reset" else []
                return reported == wanted and not self._sent_frames
            reported += [entry.what] if entry.kind == "sent" else []
        return False

    def power_off(self) -> None:
        """What it was saying breaks off."""
        self.clear_alarms()
        self._outbox, self._sent_frames, self._partial = [], 0, b""

    def look(self) -> dict[str, Any]:
        """What is in it, and what was done to it, whoever asks."""
        image = self.image.hex() if self.completed else ""
        return {
            "serial": self.serial,
            "image": image,
            "state": self.state,
            "done": self._done,
            "is_unheard": self.is_unheard,
        }


class _Bench:
    """The buses, and the units in their sockets."""

    def __init__(self, buses: dict[int, can.BusABC], seed: int, answer_s: float) -> None:
        self._buses = buses
        self._answer_s = answer_s
        self._random = random.Random(seed)
        self._units: dict[str, Unit] = {}
        self._inside: dict[int, Unit] = {}

    def serve(self) -> None:
        """Until stdin is closed."""
        ports = {bus.fileno(): port for port, bus in self._buses.items()}
        while True:
            ready, _, _ = select.select([sys.stdin.fileno(), *ports], [], [], _LOOK_S)
            now = time.perf_counter()
            for handle in ready:
                if handle in ports:
                    self._receive(ports[handle], now)
                else:
                    line = sys.stdin.readline()
                    if not line:
                        return
                    print(json.dumps(self._obey(json.loads(line), now)), flush=True)  # noqa: T201
            for port, unit in self._inside.items():
                unit.tick(now)
                while (frame := unit.next_frame(now)) is not None:
                    message = can.Message(
                        arbitration_id=frame.can_id, data=frame.data, is_extended_id=False
                    )
                    self._buses[port].send(message)
                    unit.frame_sent(now)

    def _receive(self, port: int, now: float) -> None:
        while (message := self._buses[port].recv(0.0)) is not None:
            unit = self._inside.get(port)
            if unit is not None:
                flags = (
                    message.is_extended_id,
                    message.is_remote_frame,
                    message.is_error_frame,
                )
                unit.receive((message.arbitration_id, bytes(message.data), *flags), now)

    def _obey(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        match order:
            case {"put": name, "into": port, "own": own}:
                session_s = None if self._random.random() < 0.1 else 0.5
                unit = self._units.setdefault(name, Unit(own, session_s, self._answer_s))
                self._inside[port] = unit
                unit.port = port
                unit.power_on(now)
            case {"out": name}:
                unit = self._units[name]
                seen = unit.look()
                unit.power_off()
                self._inside = {at: each for at, each in self._inside.items() if each is not unit}
                return seen
            case {"look": name}:
                unit = self._units[name]
            case _:
                raise ValueError(order)
        return unit.look()


class Story:
    """What was scanned and shown, and where units were put, with the times, in a file: a trial in
    real time is not played again by its seed alone.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "story.jsonl"

    def note(self, **what: object) -> None:
        with self._path.open("a", encoding="utf-8") as story:
            story.write(json.dumps({"s": round(time.time(), 3), **what}) + "\n")


class Units:
    """The process, for who orders it. `answer_s`: how long a unit takes for each answer."""

    def __init__(self, ports: list[int], log: Path, answer_s: float = 0.0) -> None:
        self._story = Story(log.parent)
        numbers = map(str, (answer_s, *ports))
        words = [sys.executable, "-m", "tests.campaigns.scripted_units", *numbers]
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(5.0)
        self._process.stdout.close()

    def put(self, name: str, port: int, own: str = "") -> None:
        """A unit into a socket; its power comes with it."""
        self._story.note(put=name, into=port)
        self._ask(put=name, into=port, own=own)

    def out(self, name: str) -> dict[str, Any]:
        """Pull a unit; what was in it then."""
        self._story.note(out=name)
        return self._ask(out=name)

    def look(self, name: str) -> dict[str, Any]:
        """What is in a unit."""
        return self._ask(look=name)

    def _ask(self, **order: object) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer


def main() -> None:
    answer_s, *ports = float(sys.argv[1]), *map(int, sys.argv[2:])
    with ExitStack() as stack:
        buses = {
            port: stack.enter_context(can.Bus(**bus_of(port), ignore_config=True)) for port in ports
        }
        _Bench(buses, seed=sum(ports), answer_s=answer_s).serve()


if __name__ == "__main__":
    main()
