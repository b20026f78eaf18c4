"""Which adapters python-can detects, in bounded time, whatever its back ends do meanwhile.

Vendors' libraries hang, print and crash: they do it in another process, `python -m
flasher.cli.look.detect NAME...`, which is ended in time. It asks every back end in a thread of its
own, and says each answer at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

LIMIT_S: Final = 4.5
"""For everything together. The slowest honest back end (socketcand) listens for 4 s."""
_MARK: Final = "detected: "
"""Begins the lines that are answers: vendors' libraries print too."""
_LIFE_S: Final = 30.0
"""A process whose parent was killed ends itself after this."""
_SLICE_S: Final = 0.2
"""Between two looks whether the user wants to stop."""
_COMMAND: Final = (sys.executable, "-m", "flasher.cli.look.detect")
_NO_HARDWARE: Final = frozenset({"virtual", "udp_multicast"})
"""Interfaces that are always there and reach no bus."""


@dataclass(frozen=True)
class Found:
    """An adapter that can be opened with `-i interface -c channel`."""

    interface: str
    channel: str
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def arguments(self) -> str:
        """What chooses it on the command line."""
        return f"-i {self.interface} -c {self.channel}"


@dataclass
class Detected:
    """What was found, and the back ends of which nothing is known."""

    found: list[Found] = field(default_factory=list)
    hung: list[str] = field(default_factory=list)
    """They did not answer in time."""
    failed: dict[str, str] = field(default_factory=dict)
    """They failed or crashed, with what they said."""


class Detection:
    """Begins to look at once, in other processes, so that something else can be done meanwhile.

    `collect` ends them. Use it as a context manager: whatever happens, no process is left.
    """

    def __init__(
        self,
        interfaces: Iterable[str],
        *,
        command: Sequence[str] = _COMMAND,
        limit_s: float = LIMIT_S,
    ) -> None:
        self._command = command
        self._names = [name for name in interfaces if name not in _NO_HARDWARE]
        self._ends_at = time.monotonic() + limit_s
        self._cancelled: Callable[[], bool] = lambda: False
        self._processes = [self._start(self._names)] if self._names else []

    def __enter__(self) -> Detection:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def collect(self, cancelled: Callable[[], bool] = lambda: False) -> Detected:
        """What was found. Waits for the rest of the time at the most, or until `cancelled` says so;
        it is asked five times a second.
        """
        self._cancelled = cancelled
        detected = Detected()
        unanswered = set(self._names)
        crashed = self._gather(detected, unanswered)
        if crashed and unanswered and not self._cancelled():
            # One of them took the others with it: each on its own, in the time that is left.
            self._processes = [self._start([name]) for name in sorted(unanswered)]
            self._gather(detected, unanswered)
        detected.hung = sorted(unanswered - set(detected.failed))
        detected.found.sort(key=lambda found: (found.interface, found.channel))
        return detected

    def _start(self, names: Sequence[str]) -> tuple[list[str], subprocess.Popen[str]]:
        return list(names), subprocess.Popen(  # noqa: S603  our own interpreter
            [*self._command, *names],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C is for us: we end them
        )

    def _gather(self, detected: Detected, unanswered: set[str]) -> bool:
        """Take the answers of all processes; True when one ended without having answered."""
        crashed = False
        for names, process in self._processes:
            said, is_over = self._wait_for(process)
            _take(said, detected, unanswered)
            if not is_over:
                continue
            missing = unanswered & set(names)
            crashed = crashed or bool(missing)
            if len(names) == 1 and missing:
                detected.failed[names[0]] = f"its library ended the process ({process.returncode})"
        return crashed

    def _wait_for(self, process: subprocess.Popen[str]) -> tuple[str, bool]:
        """What a process said, and whether it ended by itself; else it is ended."""
        while True:
            remaining_s = max(self._ends_at - time.monotonic(), 0.01)
            try:
                return process.communicate(timeout=min(remaining_s, _SLICE_S))[0], True
            except subprocess.TimeoutExpired:
                if time.monotonic() < self._ends_at and not self._cancelled():
                    continue
            process.kill()
            return process.communicate()[0], False

    def _end(self) -> None:
        for _, process in self._processes:
            if process.poll() is None:
                process.kill()
                process.communicate()
            elif process.stdout is not None:
                process.stdout.close()


def _take(said: str, detected: Detected, unanswered: set[str]) -> None:
    for line in said.splitlines():
        if not line.startswith(_MARK):
            continue
        with contextlib.suppress(ValueError, LookupError, TypeError):
            answer = json.loads(line.removeprefix(_MARK))
            name = str(answer["interface"])
            if answer["error"]:
                detected.failed[name] = str(answer["error"])
            for channel in answer["channels"]:
                detected.found.append(Found(name, str(channel.pop("channel", "")), channel))
            unanswered.discard(name)


# -- the other process -----------------------------------------------------------------------------


def say_detected(names: Sequence[str]) -> None:
    """Ask these interfaces and say what they answer, a line each."""
    threads = [threading.Thread(target=_ask, args=(name,), daemon=True) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _ask(name: str) -> None:
    answer: dict[str, Any] = {"interface": name, "channels": [], "error": ""}
    try:
        import can  # noqa: PLC0415  needed in the other process only

        answer["channels"] = [_simple(config) for config in can.detect_available_configs(name)]
    except BaseException as error:  # noqa: BLE001  whatever a vendor's library does
        answer["error"] = f"{type(error).__name__}: {error}"
    sys.stdout.write(f"{_MARK}{json.dumps(answer)}\n")
    sys.stdout.flush()


def _simple(config: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON holds of a configuration: some have objects of their library in it."""
    return {
        key: value
        for key, value in config.items()
        if isinstance(value, str | int | float) and key != "interface"
    }


if __name__ == "__main__":
    watchdog = threading.Timer(_LIFE_S, os._exit, (1,))
    watchdog.daemon = True
    watchdog.start()
    say_detected(sys.argv[1:])
