"""A station's process, units that keep their paper label, contents and numbers, and people who
scan cards and labels while units change places: the part of `pulled_units` that has a line.

Each `Line` has its own station, its own units, two scanners on serial ports (pseudo terminals) and
two browsers at its page, each of them a source of its own. `Scenario` names what crosses. A trial
takes two units with new labels, plays its scenario, lets all end, and says what each ended as.
"""

from __future__ import annotations

import itertools
import json
import os
import queue
import random
import re
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any, Final

import httpx2

from flasher.cli.main import main as flasher
from flasher.image.image import Image
from flasher.web.guard import TOKEN_HEADER
from tests.campaigns.scripted_units import NEW_VERSION, Units, free_port
from tests.campaigns.station_kill import write_files
from tests.campaigns.station_operator import Fault, Station, misbound

GAPS_S: Final = (0.3, 0.5, 1.0, 3.5)
_IMAGE_BYTES: Final = 80 * 128
_PACKET_S: Final = 0.05
"""A unit takes so long for each message: in a flash a share of it has to be met."""
_ANSWER_S: Final = 20.0
_LIMIT_S: Final = 90.0
_QUIET_S: Final = 2.5
"""After so long without a run no other one begins by itself."""
_KNOWN_S: Final = 1.5
"""A unit that was put in so long ago has identified itself."""
_GONE_S: Final = 3.0
"""A unit that was pulled so long ago is noticed to be gone."""
_JUST_S: Final = 1.0


class Scenario(StrEnum):
    """What crosses. "1" and "2" are labels, A and B the sockets of their units."""

    CARD = "card A, the units change places, label 1"
    ONE_STREAM = "cards A and B, labels 1 and 2, at one source"
    TWO_SOURCES = "cards A and B, labels 1 and 2, each person at a source"
    CROSSED = "cards at one source, labels at another one"
    BEGIN = "card A, label 1, unit 1 is pulled as its run begins, unit 2 put in"
    ARRIVAL = "card A, label 1, unit 1 arrives and is pulled, unit 2 put in"
    FLASH = "unit 1 is pulled in its flash, unit 2 comes from socket B"
    BOTH = "both run, and change places in their flash"


Token = tuple[str, int]
"""A card ("card", 0) or a label ("label", 0); 0 is the unit 1 and its socket A."""
_TOKENS: Final[tuple[Token, ...]] = (("card", 0), ("card", 1), ("label", 0), ("label", 1))


def orders(*, at_one_source: bool) -> list[tuple[Token, ...]]:
    """The orders of two cards and two labels. At one source a card that is followed by the other
    one's label, or the reverse, says that this unit is in that socket: who does that, lies.
    """
    made = list(itertools.permutations(_TOKENS))
    if not at_one_source:
        return made
    return [order for order in made if order[0][0] == order[1][0] or order[0][1] == order[1][1]]


@dataclass(frozen=True)
class Plan:
    """One trial."""

    number: int
    scenario: Scenario
    has_number: bool
    """The units come with a number of their maker."""
    gap_s: float
    delay_s: float
    """Between a scan and what follows it."""
    share: float
    """Of the flash that is done when units are pulled."""
    order: tuple[Token, ...] = ()

    @property
    def kind(self) -> str:
        return "maker's number" if self.has_number else "blank"

    @property
    def title(self) -> str:
        order = " ".join("AB12"[2 * (what == "label") + whose] for what, whose in self.order)
        return (
            f"trial {self.number}, {self.scenario.value}: {self.kind}, gap {self.gap_s} s,"
            f" delay {self.delay_s} s, {self.share:.0%} {order}"
        )


def make_plan(number: int, seed: int, only: Scenario | None) -> Plan:
    """Scenarios, kinds and gaps take turns, so that each of them meets each; the rest is chance."""
    chance = random.Random(seed * 1_000_003 + number)
    turn, at = divmod(number, len(Scenario))
    scenario = only or tuple(Scenario)[at]
    order: tuple[Token, ...] = ()
    if scenario in (Scenario.ONE_STREAM, Scenario.TWO_SOURCES, Scenario.CROSSED):
        order = chance.choice(orders(at_one_source=scenario is Scenario.ONE_STREAM))
    return Plan(
        number,
        scenario,
        has_number=turn % 2 == 1,
        gap_s=GAPS_S[turn // 2 % len(GAPS_S)],
        delay_s=chance.choice((0.05, 0.2, 0.5, 1.0, 2.5)),
        share=chance.choice((0.2, 0.5, 0.9)),
        order=order,
    )


@dataclass
class _Sat:
    """A unit in a socket, and until when."""

    label: str
    until: float = float("inf")


@dataclass
class Line:
    """A station, its sockets, and what it showed."""

    folder: Path
    ports: list[int]
    chance: random.Random
    problems: list[str] = field(default_factory=list)
    _shown: list[dict[str, Any]] = field(default_factory=list)
    """Since the trial began."""
    _states: dict[str, tuple[str, str]] = field(default_factory=dict)
    """State and serial number that each socket shows."""
    _sat: dict[str, list[_Sat]] = field(default_factory=dict)
    """The units that were in each socket."""
    judged: list[str] = field(default_factory=list)
    """What was wrong at the end, by the records."""
    _own: dict[str, str] = field(default_factory=dict)
    """The number that each unit came with, and the trial that it was made for."""
    _plans: dict[str, Plan] = field(default_factory=dict)
    _pulled_in: dict[str, str] = field(default_factory=dict)
    """The state of each unit when it was pulled out first."""
    _unheard: set[Plan] = field(default_factory=set)
    """Trials whose unit was pulled at a moment at which that is undetectable."""
    _count: int = 0

    def __post_init__(self) -> None:
        self._stack = ExitStack()
        data = b"BMS\0" + NEW_VERSION.encode() + bytes(at % 251 for at in range(_IMAGE_BYTES))
        self._image = Image.from_bytes(data)
        self._words = write_files(self.folder, self.ports, self._image)
        self._sources: dict[str, Callable[[str], object]] = {}
        """Scanners and browsers, by the names that the station gives them, and how they scan."""
        lines = []
        for name in ("left", "right"):
            ours, theirs = os.openpty()
            tty.setraw(theirs)
            self._sources[f"scanner {name}"] = partial(_type_in, ours)
            lines += ["", "[[scanner]]", f'name = "{name}"', f'port = "{os.ttyname(theirs)}"']
        with (self.folder / "sockets.toml").open("a", encoding="utf-8") as sockets:
            sockets.write("\n".join(lines) + "\n")

    def __enter__(self) -> Line:
        self.units = self._stack.enter_context(
            Units(self.ports, self.folder / "units.log", _PACKET_S)
        )
        self.station = Station(self.folder, *self._words, "--web", "0")
        names = {str(at) for at in range(1, len(self.ports) + 1)}
        self._sat = {name: [] for name in names}
        ready: set[str] = set()

        def is_ready() -> bool:
            ready.update(e["scanner"] for e in self._shown if e["event"] == "ScannerChanged")
            return len(ready) == len(self._sources) and self._are_free(names)

        self._await(is_ready, "the station starts")
        for _ in range(2):
            self._open_page()
        return self

    def _open_page(self) -> None:
        """Open the station's page in another browser; its first scan gives the name that it has."""
        url = re.search(r"http://127\.0\.0\.1:\d+", (self.folder / "stderr").read_text())
        assert url is not None
        browser = self._stack.enter_context(httpx2.Client(base_url=url[0], timeout=_ANSWER_S))
        token = re.search(r'name="flasher-token" content="(.*?)"', browser.get("/line").text)
        assert token is not None
        browser.headers.update({"origin": url[0], TOKEN_HEADER: token[1]})
        before = len(self._shown)
        _scan_on_page(browser, "CANCEL")
        self._await(lambda: self._has_answered("page", "CANCEL", before), "a page is opened")
        name = next(each["source"] for each in self._shown[before:] if "source" in each)
        self._sources[name] = partial(_scan_on_page, browser)

    def __exit__(self, *_: object) -> None:
        self.station.stop()
        self._judge()
        self._stack.close()

    @property
    def is_running(self) -> bool:
        return self.station.process.poll() is None

    # -- reading ----------------------------------------------------------------------------------

    def _pump(self, seconds: float) -> None:
        until = time.perf_counter() + seconds
        while (left_s := until - time.perf_counter()) > 0.0:
            try:
                self._take(self.station.events.get(timeout=min(left_s, 0.1)))
            except queue.Empty:
                continue

    def _await(self, over: Callable[[], bool], what: str, limit_s: float = _LIMIT_S) -> bool:
        until = time.perf_counter() + limit_s
        while not over():
            if time.perf_counter() >= until or self.station.process.poll() is not None:
                self._wrong(Fault.STUCK, f"{what}: {self._states}")
                return False
            self._pump(0.05)
        return True

    def _wrong(self, fault: Fault, what: str) -> None:
        self.problems.append(f"{fault.value}: {what}")

    def _take(self, event: dict[str, Any]) -> None:
        self._shown.append(event)
        match event["event"]:
            case "SocketChanged":
                self._states[event["socket"]] = event["state"], event["serial"]
            case "RunEnded" if event["run"]["state"] == "pass":
                self._hold(event["run"]["socket"], event["run"]["serial"])

    def _hold(self, socket: str, serial: str) -> None:
        """A PASS is shown: the unit with this label has to be what it says, and in that socket."""
        since = time.perf_counter() - _JUST_S
        if not any(each.label == serial and each.until > since for each in self._sat[socket]):
            self._wrong(Fault.UNTRUE, f"{serial} in socket {socket}, where it is not")
        found = self.units.look(serial)
        if found["serial"] != serial or found["image"] != self._image.data.hex():
            self._wrong(Fault.UNTRUE, f"the unit {serial} has number {found['serial']!r}")

    def _are_free(self, names: Sequence[str] | set[str]) -> bool:
        return all(self._states.get(name, ("", ""))[0] in ("empty", "silent") for name in names)

    # -- doing ------------------------------------------------------------------------------------

    def _put(self, label: str, socket: str) -> None:
        self._sat[socket].append(_Sat(label))
        self.units.put(label, self.ports[int(socket) - 1], self._own[label])

    def _pull(self, label: str) -> None:
        seen = self.units.out(label)
        if label not in self._pulled_in:
            self._pulled_in[label] = seen["state"]
            if seen["is_unheard"]:
                self._unheard.add(self._plans[label])
        for sat in itertools.chain.from_iterable(self._sat.values()):
            if sat.label == label:
                sat.until = min(sat.until, time.perf_counter())

    def _scan(self, text: str, source: str) -> None:
        """Scan, and wait for the answer."""
        before = len(self._shown)
        self.station.story.note(scan=text, source=source)
        self._sources[source](text)
        self._await(
            lambda: self._has_answered(source, text, before), f"{source} scans {text}", _ANSWER_S
        )

    def _has_answered(self, source: str, text: str, since: int) -> bool:
        return any(
            each["event"] in ("ScanAccepted", "ScanRefused")
            and each["source"].startswith(source)
            and each["text"] == text
            for each in self._shown[since:]
        )

    def _is_at(self, socket: str, share: float) -> bool:
        """The run in this socket has come so far in its flash, or has ended."""
        reported = [each for each in self._shown if each.get("socket") == socket]
        has_ended = any(each["event"] == "RunEnded" for each in reported)
        shares = [
            each["share"] for each in reported if each.get("step") == "flash" and "share" in each
        ]
        return has_ended or max(shares, default=0.0) >= share

    # -- trials -----------------------------------------------------------------------------------

    def play(self, plan: Plan) -> str:
        """What the labels ended as."""
        self._shown.clear()
        known = len(self.problems)
        labels, sockets = [], self.chance.sample(sorted(self._sat), 2)
        for _ in range(2):
            self._count += 1
            label = f"W{self._count:07d}"
            self._own[label] = f"MK{self._count:07d}" if plan.has_number else ""
            self._plans[label] = plan
            labels.append(label)
        people = self.chance.sample(sorted(self._sources), 2)
        trial = _Trial(self, plan, labels, sockets, people)
        trial.begin()
        trial.cross()
        self._end(people)
        self.problems[known:] = [f"{each} ({plan.title})" for each in self.problems[known:]]
        reported = "; ".join(f"{at} {self._ending(label)}" for at, label in enumerate(labels, 1))
        if plan in self._unheard:
            del self.problems[known:]
            reported += " (undetectable)"
        for label in labels:
            self._pull(label)
        self._clear(sockets)
        return reported

    def _end(self, people: Sequence[str]) -> None:
        """What waits is cancelled; then all runs end."""
        self._pump(_QUIET_S)
        for source in people:
            self._scan("CANCEL", source)
        self._await(self._is_at_rest, "runs end")
        self._pump(0.3)

    def _is_at_rest(self) -> bool:
        return not any(state in ("running", "saving") for state, _ in self._states.values())

    def _ending(self, label: str) -> str:
        of_label = [
            each
            for each in self._shown
            if label in (each.get("run", each).get("serial"), each.get("text"))
        ]
        reported = [each for each in of_label if each["event"] in ("RunEnded", "ScanRefused")]
        if not reported:
            return "nothing"
        last = reported[-1]
        return (
            str(last["run"]["code"]) if last["event"] == "RunEnded" else f"refused {last['code']}"
        )

    def _clear(self, sockets: Sequence[str]) -> None:
        self._pump(_GONE_S)
        for socket in sockets:
            self._scan(f"FREE {socket}", next(iter(self._sources)))
        self._await(lambda: self._are_free(sockets), "the sockets are empty", _ANSWER_S)

    # -- at the end -------------------------------------------------------------------------------

    def _judge(self) -> None:
        """Compare the units with the records."""
        known = len(self.problems)
        runs = self._ask("report")["runs"]
        sockets = {port: str(at) for at, port in enumerate(self.ports, 1)}
        for label, own in self._own.items():
            found = self.units.look(label)
            reported = misbound(label, own, found, runs, sockets)
            has_passed = any(r["serial"] == label and r["state"] == "pass" for r in runs)
            if has_passed and found["serial"] != label:
                reported.append(
                    f"{Fault.UNTRUE.value}: {label} in the records: {found['serial']!r}"
                )
            if self._plans[label] in self._unheard:
                continue
            others = [each for each, plan in self._plans.items() if plan is self._plans[label]]
            pulled = ", ".join(self._pulled_in.get(each, "no state") for each in others)
            title = f"{self._plans[label].title}, pulled in {pulled}"
            self.problems += [f"{each} ({title})" for each in reported]
        for each in self._ask("verify")["problems"]:
            self._wrong(Fault.RECORDS, f"{each['where']}: {each['what']}")
        self.judged = self.problems[known:]

    def _ask(self, action: str) -> dict[str, list[dict[str, str]]]:
        with redirect_stdout(StringIO()) as reported, redirect_stderr(StringIO()):
            flasher(["station", action, "--json", *self._words[2:4]])
        document: dict[str, list[dict[str, str]]] = json.loads(reported.getvalue().splitlines()[-1])
        return document


@dataclass
class _Trial:
    """One trial; what happens by its scenario."""

    line: Line
    plan: Plan
    labels: list[str]
    sockets: list[str]
    people: list[str]

    def begin(self) -> None:
        """Both units are in their sockets and known; where a unit arrives, its socket is empty."""
        line = self.line
        for label, socket in zip(self.labels, self.sockets, strict=True):
            if self.plan.scenario is not Scenario.ARRIVAL:
                line._put(label, socket)
        if self.plan.scenario is not Scenario.ARRIVAL:
            are_there = lambda: all(line._states[each][0] == "scan" for each in self.sockets)  # noqa: E731
            line._await(are_there, "the units are detected", _ANSWER_S)
            line._pump(_KNOWN_S)

    def cross(self) -> None:
        line, plan = self.line, self.plan
        match plan.scenario:
            case Scenario.CARD:
                self._token(("card", 0), self.people[0])
                self._change_places()
                line._pump(plan.delay_s)
                self._token(("label", 0), self.people[0])
            case Scenario.ONE_STREAM | Scenario.TWO_SOURCES | Scenario.CROSSED:
                for token in plan.order:
                    self._token(token, self._source_of(token))
                    line._pump(min(plan.delay_s, 0.5))
            case Scenario.BEGIN:
                self._pair(0)
                line._pump(plan.delay_s)
                self._change_places()
            case Scenario.ARRIVAL:
                self._pair(0)
                line._put(self.labels[0], self.sockets[0])
                line._pump(plan.delay_s)
                line._pull(self.labels[0])
                line._pump(plan.gap_s)
                line._put(self.labels[1], self.sockets[0])
            case Scenario.FLASH:
                self._pair(0)
                self._await_flash(self.sockets[:1])
                self._change_places()
            case Scenario.BOTH:
                self._pair(0)
                self._pair(1)
                self._await_flash(self.sockets)
                self._change_places()

    def _await_flash(self, sockets: Sequence[str]) -> None:
        for socket in sockets:
            is_there = lambda socket=socket: self.line._is_at(socket, self.plan.share)  # noqa: E731
            self.line._await(is_there, "the flash goes on")

    def _source_of(self, token: Token) -> str:
        what, whose = token
        match self.plan.scenario:
            case Scenario.TWO_SOURCES:
                return self.people[whose]
            case Scenario.CROSSED:
                return self.people[what == "label"]
            case _:
                return self.people[0]

    def _token(self, token: Token, source: str) -> None:
        what, whose = token
        text = f"SOCKET {self.sockets[whose]}" if what == "card" else self.labels[whose]
        self.line._scan(text, source)

    def _pair(self, whose: int) -> None:
        for what in ("card", "label"):
            self._token((what, whose), self.people[whose])

    def _change_places(self) -> None:
        for label in self.labels:
            self.line._pull(label)
        self.line._pump(self.plan.gap_s)
        for label, socket in zip(self.labels, reversed(self.sockets), strict=True):
            self.line._put(label, socket)


def _type_in(scanner: int, text: str) -> None:
    os.write(scanner, text.encode() + b"\r")


def _scan_on_page(browser: httpx2.Client, text: str) -> None:
    browser.post(
        "/line/scan", json={"text": text, "shown_at": time.perf_counter()}
    ).raise_for_status()


def line_of(folder: Path, sockets: int, seed: int) -> Line:
    """A line in a folder of its own."""
    folder.mkdir(parents=True)
    return Line(folder, [free_port() for _ in range(sockets)], random.Random(seed))
