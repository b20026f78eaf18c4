"""An operator at a station's screen: connects units, scans cards and labels, and does what the
station says. Of the station it knows the event stream alone, which is what the screen is made of.

Each unit bears a label; what the operator does with a unit, and which unit is in which socket, is
known here for certain. So every word of the station can be compared with the units: `Fault` names
what may be wrong.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from tests.campaigns.scripted_units import Story, Units

_IDLE_S: Final = 0.6
"""A socket in which nothing happens for so long waits for the operator."""
_ATTEMPT_S: Final = 25.0
"""A label that was scanned has begun its run after so long, or was in vain."""
_ANSWER_S: Final = 10.0
_TURN_S: Final = 0.02
_AT_WORK: Final = ("running", "saving")
_LEFT_S: Final = 8.0
"""After so long, a socket that shows a unit which is not in it needs a scan."""
_KNOWN_S: Final = 6.0
"""A unit that was put in is detected sooner."""
_JUST_S: Final = 1.0
"""What was done so short a time ago may have crossed what the station shows."""
_GAPS_S: Final = (0.0, 0.3, 0.8)
"""How long a socket is empty while its unit is exchanged."""
_SEEN_S: Final = 0.3
"""The same where a process listens, which may not detect a faster hand (`station_run`)."""
_NAMED: Final = re.compile(r"\binto socket ([0-9]+)\b")
_FREE: Final = re.compile(r"If it is out, scan FREE ([0-9]+)")
_CARD: Final = re.compile(r"\bscan (the card|SOCKET)\b", re.IGNORECASE)
_CYCLE: Final = re.compile(r"off.*on again")


class Fault(StrEnum):
    """What a problem is."""

    UNTRUE = "false PASS"
    LOST = "lost"
    MISBOUND = "mis-bound"
    STUCK = "stuck"
    RECORDS = "records"
    PROCESS = "process"


class Change(StrEnum):
    """What somebody does with the unit in a socket."""

    NOTHING = "left alone"
    AGAIN = "pulled and put back"
    PULLED = "pulled"
    OTHER = "exchanged for one that has not passed"
    PASSED = "exchanged for one that has passed"
    PLACES = "exchanged with the next socket"


class Station:
    """The process of `flasher station run`, its events, and its scanner."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.story = Story(folder)
        self.story.note(station="starts")
        command = [sys.executable, "-m", "flasher", "station", "run", *words]
        with (folder / "stderr").open("ab") as errors:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                bufsize=1,
            )
        self.events: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.endswith("\n"):  # a line that a kill cut off was not shown
                event = json.loads(line)
                self.story.note(**event)
                self.events.put(event)

    def scan(self, text: str) -> None:
        assert self.process.stdin is not None
        self.story.note(scan=text)
        with contextlib.suppress(OSError):  # it was killed
            self.process.stdin.write(text + "\n")
            self.process.stdin.flush()

    @property
    def workers(self) -> list[int]:
        """The processes of its sockets."""
        pid = self.process.pid
        try:
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
            return [int(each) for each in children if "spawn_main" in _command_line(int(each))]
        except OSError:
            return []

    def kill(self) -> list[int]:
        """Kill it; its workers, which have to end by themselves."""
        workers = self.workers
        self.story.note(station="killed")
        self.process.kill()
        self._end()
        return workers

    def stop(self) -> int:
        """Ctrl-C; its exit code."""
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(30.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._end()
        return self.process.returncode

    def _end(self) -> None:
        self.process.wait()
        self._reader.join(5.0)
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()


def _command_line(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")


def is_running(pid: int) -> bool:
    """True while a process that we started is there, and no zombie."""
    try:
        os.kill(pid, 0)
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
    except OSError:
        return False


@dataclass
class Place:
    """A socket: what the station shows of it, and what is in it."""

    name: str
    port: int
    state: str = "starting"
    serial: str = ""
    text: str = ""
    unit: str = ""
    """The label on the unit that is in it."""
    changed_at: float = 0.0
    before: str = ""
    """The unit that was in it before the last exchange, which was at `exchanged_at`."""
    exchanged_at: float = float("-inf")
    is_green_over: str = ""
    """The unit over which a PASS of another one was shown and counted."""
    tries: int = 0
    """Of this unit, since the last kill."""


@dataclass
class Operator:
    """Works at one station after the other; units stay where they are meanwhile."""

    units: Units
    places: dict[str, Place]
    image: bytes
    random: random.Random
    counts: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    shown: list[dict[str, Any]] = field(default_factory=list)
    """Every RunStarted and RunEnded."""
    shelf: list[str] = field(default_factory=list)
    """Units in no socket that have not passed."""
    lost: list[Place] = field(default_factory=list)
    """The sockets whose processes were lost, in their order."""
    station: Station | None = None
    moments: int = 0
    """Happenings of the running station at which a kill is of interest."""
    _number: int = 0
    _own: dict[str, str] = field(default_factory=dict)
    """Of every unit: the serial number that it came with."""
    _passed: set[str] = field(default_factory=set)
    _reported: list[str] = field(default_factory=list)
    """What the station answered to the last scan."""
    _answer: str = ""
    _is_open: bool = False
    _stopped: bool = False
    _resume_at: float = 0.0

    # -- at a station -----------------------------------------------------------------------------

    def begin(self, station: Station) -> None:
        """Sit down at a station that was just started."""
        self.station, self.moments = station, 0
        self._is_open = self._stopped = False
        for place in self.places.values():
            place.state, place.serial, place.text, place.tries = "starting", "", "", 0
            place.changed_at = time.perf_counter()

    def work(
        self, over: Callable[[], bool], *, bring_units: bool = True, scans: bool = True
    ) -> None:
        """Work until `over` says so, or the station is gone; without `scans` only look on."""
        while not over() and self._is_there():
            self._read(_TURN_S)
            for place in self.places.values() if scans else ():
                self._look_after(place, over, bring_units=bring_units)
                if over():
                    return

    def leave(self) -> None:
        """Read what the station showed last."""
        while self.station is not None and not self.station.events.empty():
            self._take(self.station.events.get())
        self.station = None

    def _is_there(self) -> bool:
        return self.station is not None and self.station.process.poll() is None

    @property
    def is_done(self) -> bool:
        """True when the station works, and no unit is left to be done."""
        is_empty = not any(place.unit for place in self.places.values())
        return self._is_open and is_empty and not self.shelf

    # -- reading ----------------------------------------------------------------------------------

    def _read(self, limit_s: float) -> None:
        assert self.station is not None
        try:
            event = self.station.events.get(timeout=limit_s)
            while True:
                self._take(event)
                event = self.station.events.get_nowait()
        except queue.Empty:
            return

    def _take(self, event: dict[str, Any]) -> None:
        name = event.get("event", "")
        if name in ("RunStarted", "StepStarted", "StepEnded", "RunEnded") or (
            name == "SocketChanged" and event["state"] == "saving"
        ):
            self.moments += 1
        match name:
            case "StationStarted":
                self._is_open = True
            case "ScanAccepted":
                self._answer = "accepted"
            case "ScanRefused":
                self._answer = "refused"
                self._reported.append(f"{event['reason']} {event['remedy']}")
                self.counts[f"refused {event['code']}"] += 1
            case "OperatorPrompted" if not _CYCLE.search(event["text"]):
                self._reported.append(event["text"])
            case "LineStopped":
                self._stopped, self._resume_at = True, time.perf_counter() + 1.0
                self.counts["line stopped"] += 1
            case "LineResumed":
                self._stopped = False
            case _ if event.get("socket") in self.places:
                self._take_of(self.places[event["socket"]], event)

    def _take_of(self, place: Place, event: dict[str, Any]) -> None:
        """What the station shows of one socket."""
        match event["event"]:
            case "SocketChanged":
                place.state, place.serial = event["state"], event["serial"]
                place.text, place.changed_at = event["text"], time.perf_counter()
            case "RunStarted":
                self.shown.append(event)
                if not self._is_or_was_just(place, event["serial"]):
                    self._wrong(
                        Fault.MISBOUND,
                        f"the label {event['serial']} runs in socket {place.name}, where "
                        f"{place.unit or 'nothing'} is",
                    )
            case "RunEnded":
                self.shown.append(event)
                run = event["run"]
                self.counts[f"shown {run['state']} {run['code']}"] += 1
                if run["state"] == "pass":
                    self._hold(run["serial"], place)
            case "OperatorPrompted" if place.unit:
                self.counts["power cycles"] += 1
                self.units.out(place.unit)
                self.units.put(place.unit, place.port)
            case "WorkerFailed":
                self.counts["worker failed"] += 1
                self.lost.append(place)

    def _wrong(self, fault: Fault, what: str) -> None:
        self.problems.append(f"{fault.value}: {what}")

    @staticmethod
    def _is_or_was_just(place: Place, label: str) -> bool:
        is_just = time.perf_counter() - place.exchanged_at < _JUST_S
        return place.unit == label or (is_just and place.before == label)

    def _hold(self, serial: str, place: Place) -> None:
        """A PASS is shown: the unit with this label has to be what it says."""
        self._passed.add(serial)
        found = self.units.look(serial) if serial in self._own else {}
        if not self._is_or_was_just(place, serial):
            where = f"in socket {place.name}, where {place.unit or 'nothing'} is"
            self._wrong(Fault.UNTRUE, f"{serial} {where}")
        if found.get("serial") != serial or found.get("image") != self.image.hex():
            self._wrong(Fault.UNTRUE, f"the unit {serial} has number {found.get('serial')!r}")

    # -- doing ------------------------------------------------------------------------------------

    def _look_after(self, place: Place, over: Callable[[], bool], *, bring_units: bool) -> None:
        now = time.perf_counter()
        if self._stopped:
            if now >= self._resume_at:
                self._resume_at = now + 1.0
                self._scan("RESUME")
            return
        quiet_s = now - place.changed_at
        if place.state in ("starting", "error", *_AT_WORK) or quiet_s < _IDLE_S:
            return
        if place.unit and place.state == "pass" and place.serial != place.unit:
            self._look_at_green(place, now)
        elif place.unit and place.unit in self._passed:
            self._take_out(place)
        elif place.unit:
            place.tries += 1
            self._scan_unit(place, over)
        elif place.state in ("empty", "silent"):
            if bring_units or self.shelf:
                self._bring(place, over)
        elif quiet_s > _LEFT_S:
            self._scan(f"FREE {place.name}")
            place.changed_at = now

    def _look_at_green(self, place: Place, now: float) -> None:
        """A PASS is shown in a socket where another unit is."""
        if now - max(place.changed_at, place.exchanged_at) < _LEFT_S:
            return
        if place.is_green_over != place.unit:
            place.is_green_over = place.unit
            what = f"socket {place.name} shows that of {place.serial} over {place.unit}"
            self._wrong(Fault.UNTRUE, what)
        self._scan(f"FREE {place.name}")
        place.changed_at = now

    def _take_out(self, place: Place) -> None:
        self.units.out(place.unit)
        self.counts["units passed"] += 1
        place.unit, place.changed_at = "", time.perf_counter()

    def _bring(self, place: Place, over: Callable[[], bool]) -> None:
        """A unit from the shelf, or a new one: into the socket first, or its label first."""
        label = self._next_unit()
        if self.random.random() < 0.6:
            self._put(label, place)
            return
        self.counts["bare label, unit in the hand"] += 1
        if self._scan(label):
            place = self._named(place)
        self._put(label, place)
        if label in self._passed:  # shown as it was pulled
            return
        if self._answer == "accepted":
            if self._wants_card():
                self._scan_card(place)
            self._see_run(label, place, over)

    def _next_unit(self) -> str:
        if self.shelf:
            return self.shelf.pop(0)
        self._number += 1
        label = f"W{self._number:07d}"
        # Some come with their number, some with their maker's, the others have none yet.
        self._own[label] = self.random.choice(("", f"MK{self._number:07d}", label))
        return label

    def change_units(self, places: Sequence[Place]) -> None:
        """Somebody changes units in these sockets. A person who comes back to a station that was
        left so scans CANCEL first: a label that waits may be of a unit that is elsewhere now.
        """
        for place in places:
            self._pause(_TURN_S)
            self._change(place, self.random.choice(tuple(Change)), self.random.choice(_GAPS_S))
        if self._is_there():
            self._scan("CANCEL")

    def choose_card(self) -> Place | None:
        """Scan the card of a socket whose unit waits for its label; None where none can wait."""
        idle = [each for each in self.places.values() if each.state not in ("error", *_AT_WORK)]
        place = self.random.choice(idle) if idle else None
        if place is None:
            return None
        if place.unit in self._passed:
            self._take_out(place)
        if not place.unit:
            self._put(self._next_unit(), place)
        latest = time.perf_counter() + _KNOWN_S
        self.work(lambda: place.state == "scan" or time.perf_counter() >= latest, scans=False)
        return place if self._scan(f"SOCKET {place.name}") else None

    def change_after_card(self, place: Place) -> None:
        """Another unit is put in after the card of its socket was scanned and the socket's process
        was lost; then the label of the unit that was there is scanned.
        """
        meant = place.unit
        self._change(place, Change.OTHER, self.random.choice(_GAPS_S))
        if self._is_there():
            self._scan(meant)
            self.counts[f"label of a unit that was exchanged after its card: {self._answer}"] += 1
            self._scan("CANCEL")

    def _change(self, place: Place, how: Change, gap_s: float) -> None:
        before = place.unit
        others = [each for each in self.places.values() if each is not place]
        at_hand = sorted(self._passed.difference(each.unit for each in self.places.values()))
        place.before, place.exchanged_at = before, time.perf_counter()
        match how:
            case Change.AGAIN if before:
                self._pull(place)
                self._pause(gap_s)
                self._put(before, place)
            case Change.PULLED if before:
                self._pull(place)
                self._shelve(before)
            case Change.OTHER:
                self._pull(place)
                self._pause(gap_s)
                self._put(self._next_unit(), place)
                self._shelve(before)
            case Change.PASSED if at_hand:
                self._pull(place)
                self._pause(gap_s)
                self._put(self.random.choice(at_hand), place)
                self._shelve(before)
            case Change.PLACES if others:
                other = self.random.choice(others)
                after, other.before = other.unit, other.unit
                gap_s = max(gap_s, _SEEN_S) if self._is_there() else gap_s
                self._pull(place)
                self._pull(other)
                self._pause(gap_s)
                for label, into in ((after, place), (before, other)):
                    if label:
                        self._put(label, into)
                    into.exchanged_at = time.perf_counter()
            case _:
                how = Change.NOTHING
        self.counts[f"{'station' if self.station is None else 'process'} dead: {how.value}"] += 1
        if how is not Change.NOTHING:
            place.exchanged_at = time.perf_counter()

    def _pull(self, place: Place) -> None:
        if place.unit:
            self.units.out(place.unit)
        place.unit, place.changed_at = "", time.perf_counter()

    def _shelve(self, label: str) -> None:
        if label and label not in self._passed:
            self.shelf.append(label)

    def _pause(self, seconds: float) -> None:
        """The station is looked at meanwhile."""
        until = time.perf_counter() + seconds
        while (left_s := until - time.perf_counter()) > 0.0:
            if self._is_there():
                self._read(min(_TURN_S, left_s))
            else:
                time.sleep(left_s)

    def _named(self, place: Place) -> Place:
        """The socket that the station names, when nothing is in it; else the one meant."""
        named = _NAMED.search(" ".join(self._reported))
        chosen = self.places[named[1]] if named else place
        return place if chosen.unit else chosen

    def _wants_card(self) -> bool:
        return bool(_CARD.search(" ".join(self._reported)))

    def _put(self, label: str, place: Place) -> None:
        place.unit, place.changed_at, place.tries = label, time.perf_counter(), 0
        self.units.put(label, place.port, self._own[label])
        if label in self.shelf:
            self.shelf.remove(label)

    def _scan_unit(self, place: Place, over: Callable[[], bool]) -> None:
        """Scan a unit that waits in a socket: the card and the label, or the label alone; after a
        label alone, what the station asks for.
        """
        way = self.random.choice(("card, label", "label, card", "bare label"))
        if place.tries > 2:
            way = "card, label"  # what is on the wall for those who do not get further
            if place.tries % 4 == 0:
                self._scan("CANCEL")
        self.counts[way] += 1
        if way == "card, label":
            if self._scan(f"SOCKET {place.name}"):
                self._scan(place.unit)
        elif self._scan(place.unit):
            if way == "label, card" or self._wants_card():
                self._scan_card(place)
            elif self._named(place) is not place:
                label, place.unit = place.unit, ""
                self.units.out(label)
                place = self._named(place)
                self._put(label, place)
                self.counts["unit moved, as the station asked"] += 1
        if self._answer == "accepted":
            self._see_run(place.unit, place, over)
        elif free := _FREE.search(" ".join(self._reported)):
            self._scan(f"FREE {free[1]}")  # it is out: here one unit of a label is in one place
        place.changed_at = time.perf_counter()

    def _scan_card(self, place: Place) -> None:
        """After its label. The card of another socket, for another unit, would be taken for it."""
        if not self._scan(f"SOCKET {place.name}"):
            self._scan("CANCEL")
            self._answer = "refused"

    def _see_run(self, label: str, place: Place, over: Callable[[], bool]) -> None:
        """Wait until the run has begun, while the other sockets go on by themselves."""
        give_up_at = time.perf_counter() + _ATTEMPT_S
        refusals = len(self._reported)
        while time.perf_counter() < give_up_at and self._is_there() and not over():
            self._read(_TURN_S)
            if len(self._reported) > refusals or label in self._passed or self._stopped:
                return
            if any(
                each["event"] == "RunStarted" and each["serial"] == label
                for each in self.shown[-4:]
            ) and place.state in (*_AT_WORK, "pass", "fail", "recheck"):
                return

    def _scan(self, text: str) -> bool:
        """Scan, and read the answer; False when it is refused, or there is none."""
        if not self._is_there():
            return False
        assert self.station is not None
        self._reported.clear()
        self._answer = ""
        self.station.scan(text)
        give_up_at = time.perf_counter() + _ANSWER_S
        while not self._answer and time.perf_counter() < give_up_at and self._is_there():
            self._read(_TURN_S)
        return self._answer == "accepted"

    # -- at the end -------------------------------------------------------------------------------

    def stuck(self) -> list[str]:
        """The units that did not get through."""
        in_sockets = [
            f"{Fault.STUCK.value}: {place.unit} in socket {place.name}: {place.state} {place.text}"
            for place in self.places.values()
            if place.unit
        ]
        return [
            *in_sockets,
            *(f"{Fault.STUCK.value}: {label} in no socket" for label in self.shelf),
        ]

    def strange_units(self, runs: Iterable[Mapping[str, Any]]) -> list[str]:
        """What is wrong with the units, by these runs of the records."""
        sockets = {place.port: place.name for place in self.places.values()}
        runs = list(runs)
        reported = []
        for label, own in self._own.items():
            reported += misbound(label, own, self.units.look(label), runs, sockets)
        return reported

    def false_passes(self, runs: Iterable[Mapping[str, Any]]) -> list[str]:
        """Units that are not what the records say; also those whose PASS was never shown."""
        reported = []
        for serial in sorted({run["serial"] for run in runs if run["state"] == "pass"}):
            found = self.units.look(serial) if serial in self._own else {}
            if found.get("serial") != serial or found.get("image") != self.image.hex():
                number = repr(found.get("serial"))
                reported.append(f"{Fault.UNTRUE.value}: in the records {serial} is one, its unit"
                            f" has the number {number}")  # fmt: skip
        return reported

    @property
    def passed(self) -> set[str]:
        """Serial numbers of which a PASS was shown."""
        return set(self._passed)


def misbound(
    label: str,
    own: str,
    found: Mapping[str, Any],
    runs: Iterable[Mapping[str, Any]],
    sockets: Mapping[int, str],
) -> list[str]:
    """What is wrong with a unit that bears this label on paper and came with the number `own`: it
    has another one, or was flashed or written in a run of another label. `found` is what it says
    (`Units.look`), `sockets` are the names of the sockets by their ports.
    """
    reported = []
    if found["serial"] not in (label, own):
        reported.append(f"unit {label} has the number {found['serial']}")
    for at, port, number in found["done"]:
        begun = [
            (datetime.fromisoformat(run["begun_at"]).timestamp(), run["serial"])
            for run in runs
            if run["socket"] == sockets[port]
        ]
        _, serial = max((each for each in begun if each[0] <= at), default=(0.0, ""))
        if serial != label:
            deed = f"got the number {number}" if number else "was flashed"
            reported.append(f"unit {label} {deed} in socket {sockets[port]} in a run of {serial}")
    return [f"{Fault.MISBOUND.value}: {each}" for each in dict.fromkeys(reported)]
