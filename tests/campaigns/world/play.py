"""Plays a plan: the production session on the bus of the plan, and the oracle at its end.

The oracle believes nobody: it looks into the flash of every device, and holds the claims of the
result against it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, Final

from flasher import api
from flasher.bus.link import VirtualClock
from flasher.errors import ExitCode, FlasherError
from flasher.host.identity import Identity
from flasher.host.options import UpgradeOptions, overall_timeout_s
from flasher.host.outcome import DeviceLeft
from flasher.host.session import Result
from flasher.image.plan import Plan as ImagePlan
from flasher.image.plan import plan as image_plan
from flasher.mock.model import MockDevice
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING
from tests.campaigns.world import plans
from tests.campaigns.world.bus import (
    Killed,
    OverdueError,
    Unit,
    Voice,
    WorldBus,
    WorldLink,
    frame_fault,
    message_begun,
)
from tests.campaigns.world.stranger import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    FEEDBACK,
    NAK,
    PACKET,
    READ,
    READ_VERSION,
    REPORT,
    REQUEST,
    RESET,
    UPDATE,
    WRITE,
    Stranger,
    frames_of,
)
from tests.end_to_end.stage import image_of
from tests.firmware import VECTORS

DOCUMENTED: Final = frozenset(
    {
        ExitCode.OK,
        ExitCode.IMAGE,
        ExitCode.BUS,
        ExitCode.NO_ANSWER,
        ExitCode.WRONG_DEVICE,
        ExitCode.TRANSFER,
        ExitCode.REFUSED,
        ExitCode.UNCONFIRMED,
        ExitCode.VERIFICATION,
        ExitCode.INTERRUPTED,
    }
)
"""Exit codes that `flasher flash --help` names for what can happen here."""
SETTLE_S: Final = 3.0
"""After the end of a session, before the flash is looked at."""
LATEST: Final = 1.001
"""An end is not later than this share of the announced deadline (an open message is finished)."""
_BOOT_NAMES: Final = {"bms": b"BMS", "wmc": b"WMC", "obc": b"PBU"}


@dataclass(frozen=True)
class Verdict:
    """How a plan ended, and what the oracle thinks of it."""

    plan: str
    ending: str
    """The upgrade's own word, or the error's code."""
    exit_code: int
    is_good: bool
    """The result claims success, and the device has the image."""
    left: str
    """What is in the device's flash: new, old, none, other; with that of a twin behind it."""
    attempts: int
    took_s: float
    lateness: float
    """The end, as a share of the announced deadline."""
    faults: tuple[str, ...] = ()
    """What the oracle finds wrong; empty where the host was right."""
    had_twin: bool = False
    runs: int = 1
    wire: str = ""
    """A digest of all frames with their times."""
    where: str = ""

    @property
    def is_false(self) -> bool:
        return any(fault.startswith("FALSE") for fault in self.faults)


@dataclass
class _Claim:
    """What a run says of itself."""

    ending: str
    exit_code: int
    is_ok: bool
    left: DeviceLeft | None
    """None where only `needs_rescue` is told."""
    needs_rescue: bool
    attempts: int = 0
    where: str = ""


@dataclass
class Player:
    """One plan being played."""

    plan: plans.Plan
    options: UpgradeOptions = field(default_factory=UpgradeOptions)
    verbose: bool = False
    clock: VirtualClock = field(default_factory=VirtualClock)
    log: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        world = self.plan.world
        self.target = TARGETS[world.target]
        self.bus = WorldBus(self.clock)
        self.bus.watch = self._seen
        self.voice = Voice()
        self.bus.attach(self.voice)
        self.image = image_of(world.packets, seed=world.image)
        self.units: list[Unit] = []
        self._link: WorldLink | None = None
        self._frames = 0
        self._digest = hashlib.sha256()
        self._waiting: dict[tuple[str, int], list[plans.Clause]] = {}
        self._is_interrupted = False
        self._kill: plans.Kill | None = None
        self._may_have_erased = False
        self._at_update: list[Unit] = []
        """Who was on the bus when the last update command began."""
        for number, device in enumerate(self.plan.devices):
            unit = Unit(self._engine(device))
            self.units.append(unit)
            if device.when is None:
                self._join(number, device, 0.0)
        for clause in self.plan.happenings:
            self._expect(clause)

    # -- the world -------------------------------------------------------------------------------

    def _engine(self, device: plans.Strange | plans.Mock) -> Stranger | MockDevice:
        if isinstance(device, plans.Strange):
            old = VECTORS + device.version.encode() + b"\0" + bytes(range(256)) * 4
            content = old if device.application == "old" else None
            return Stranger(self.target.name, device.chosen(), content)
        return MockDevice(
            self.target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=replace(device.chosen(), factory_version=device.version),
            has_application=device.application == "old",
        )

    def _join(self, number: int, device: plans.Strange | plans.Mock, now: float) -> None:
        unit = self.units[number]
        engine = unit.engine
        self.bus.attach(unit)
        if device.begins == "application" and device.application == "old" and device.when is None:
            if isinstance(engine, Stranger):
                engine.run_application(now)
        elif isinstance(engine, MockDevice):
            engine.power_cut(now)
        if device.begins != "off":
            unit.power_on(now)
        self._look_who_is_there()

    def _look_who_is_there(self) -> None:
        is_alone = not self.plan.world.others and not any(unit.has_power for unit in self.units)
        if is_alone != self.bus.is_unacknowledged:
            self.bus.is_unacknowledged = is_alone

    def _expect(self, clause: plans.Clause) -> None:
        when = clause.when
        if when is None or not when.what:
            self.bus.timers.at(
                0.0 if when is None else when.plus_s, lambda now: self._happen(clause, now)
            )
        else:
            self._waiting.setdefault((when.what, when.number), []).append(clause)

    def _seen(self, frame: Frame, sender: str, now: float) -> None:
        self._frames += 1
        self._digest.update(b"%d %s %.9f;" % (frame.can_id, frame.data, now))
        if self.verbose:
            self.log.append(f"{now:.6f} {sender} {frame.can_id:03X} {frame.data.hex(' ')}")
        self._begins("frame", self._frames, now)
        if sender == "host":
            begun = message_begun(frame)
            if begun is not None:
                if begun[0] == "update":
                    self._may_have_erased = True
                    self._at_update = self._present
                    self.bus.heard.clear()
                self._begins(*begun, now)

    def _begins(self, what: str, number: int, now: float) -> None:
        if not self._waiting:
            return
        for clause in self._waiting.pop((what, number), ()):
            plus_s = clause.when.plus_s if clause.when else 0.0
            if plus_s:
                self.bus.timers.at(now + plus_s, lambda at, due=clause: self._happen(due, at))  # type: ignore[misc]
            else:
                self._happen(clause, now)

    def _happen(self, clause: plans.Clause, now: float) -> None:
        if self.verbose:
            self.log.append(f"{now:.6f} *** {clause}")
        match clause:
            case plans.OnFrames() | plans.Noise():
                self.bus.faults_of_frames.append(frame_fault(clause, now))
            case plans.OnDevice():
                self._happen_to(clause, now)
            case plans.Strange() | plans.Mock():
                self._join(list(self.plan.devices).index(clause), clause, now)
            case plans.Load():
                self._load(clause, now, now + clause.seconds)
            case plans.Say():
                for copy in range(clause.count):
                    self.voice.say(self._unasked(clause), now + 0.002 * copy)
            case plans.Tool():
                for turn in range(clause.count):
                    self.voice.say(self._foreign(clause.does, turn), now + clause.every * turn)
            case _:
                self._happen_to_host(clause)

    def _happen_to_host(self, clause: plans.Clause) -> None:
        bus, link = self.bus, self._link
        match clause:
            case plans.Unplug(seconds=seconds):
                bus.unplug(seconds)
            case plans.BusOff(seconds=seconds):
                bus.bus_off(seconds)
            case plans.Stall(seconds=seconds) if link is not None:
                link.stalls_s += seconds
            case plans.Kill() if link is not None:
                self._kill, link.is_killed = clause, True
            case plans.Interrupt():
                self._is_interrupted = True

    def _happen_to(self, clause: plans.OnDevice, now: float) -> None:
        if clause.device >= len(self.units):
            return
        unit = self.units[clause.device]
        match clause:
            case plans.Power(seconds=seconds):
                unit.power_cut(now)
                self._look_who_is_there()
                self.bus.timers.at(now + seconds, lambda at: self._power_back(unit, at))
            case plans.Restart():
                unit.power_cut(now)
                unit.power_on(now)
            case plans.Hang(seconds=seconds):
                unit.hang(now + seconds)

    def _power_back(self, unit: Unit, now: float) -> None:
        unit.power_on(now)
        self._look_who_is_there()

    def _load(self, clause: plans.Load, now: float, until: float) -> None:
        if now >= until or not self._is_running:
            return
        self.voice.say([Frame(clause.id, b"\x33" * 8)], now)
        self.bus.timers.at(now + clause.every, lambda at: self._load(clause, at, until))

    def _unasked(self, clause: plans.Say) -> list[Frame]:
        number = clause.number.to_bytes(2, "little")
        command, data = {
            "ack": (ACK, number),
            "nak": (NAK, number),
            "boot": (BOOT_VERSION, _BOOT_NAMES[self.target.name] + b"V1.0.0"),
            "request": (REQUEST, b"\0\0"),
            "complete": (COMPLETE, b"\0\0"),
            "feedback": (FEEDBACK, b"ACK"),
        }[clause.what]
        return frames_of(self.target.answer_id, REPORT, command, data)

    def _foreign(self, does: str, turn: int) -> list[Frame]:
        packets = self.plan.world.packets
        mode, command, data = {
            "asks": (READ, READ_VERSION, b""),
            "writes": (WRITE, 0x3A10, b"second tool.    "),
            "resets": (WRITE, RESET, b"RESET"),
            "updates": (
                WRITE,
                UPDATE,
                self.target.update_text.encode() + (packets * 128 - 5).to_bytes(4, "little"),
            ),
            "packets": (
                WRITE,
                PACKET,
                b"\1" + (turn + 1).to_bytes(2, "little") + packets.to_bytes(2, "little")
                + b"\xa5" * 128,
            ),
        }[does]  # fmt: skip
        return frames_of(self.target.request_id, mode, command, data)

    # -- the host --------------------------------------------------------------------------------

    def play(self) -> Verdict:
        self._is_running = True
        faults: list[str] = []
        lateness, took_s, runs = 0.0, 0.0, 0
        while True:
            runs += 1
            began_at = self.clock.now()
            had = self._word_for(self.units[0])
            # This computer's history knows of a run that has no end.
            options = replace(self._options, in_session=runs > 1)
            limit_s = overall_timeout_s(self._image_plan, options)
            claim = self._run(options, began_at + limit_s * 1.5 + 60.0)
            took_s = self.clock.now() - began_at
            if claim is None:
                assert self._kill is not None
                again_at, self._kill = self.clock.now() + self._kill.again, None
                self._wait(again_at)
                continue
            lateness = max(lateness, took_s / limit_s)
            break
        heard = frozenset(self.bus.heard)
        then = [self._word_for(unit) for unit in self.units]
        self._stop()
        self._wait(self.clock.now() + SETTLE_S)
        words = [self._word_for(unit) for unit in self.units]
        if any(isinstance(each, plans.Tool) for each in self.plan.clauses):
            # What another tool did after the end is none of the host's.
            words = [was if was == "new" else now for was, now in zip(then, words, strict=True)]
        faults += self._judge(claim, had, words, heard)
        if lateness > LATEST:
            faults.append(f"LATE: ended at {lateness:.4f} of the announced deadline")
        has_it = self.units[0].application == self.image.data
        return Verdict(
            plan=str(self.plan),
            ending=claim.ending,
            exit_code=claim.exit_code,
            is_good=claim.is_ok and has_it,
            left=" / ".join(self._word_for(unit) for unit in self.units),
            attempts=claim.attempts,
            took_s=took_s,
            lateness=lateness,
            faults=tuple(faults),
            had_twin=len(self.units) > 1,
            runs=runs,
            wire=self._digest.hexdigest()[:16],
            where=claim.where,
        )

    @property
    def _options(self) -> UpgradeOptions:
        world, options = self.plan.world, self.options
        if world.attempts:
            options = replace(options, attempts=world.attempts)
        if world.tries:
            timings = replace(options.timings, packet_tries=world.tries)
            options = replace(options, timings=timings)
        return replace(options, timeout_s=world.timeout) if world.timeout else options

    @property
    def _image_plan(self) -> ImagePlan:
        return image_plan(self.image, self.target, WELLING.bitrate_bps)

    def _run(self, options: UpgradeOptions, overdue_at: float) -> _Claim | None:
        """One run of the command; None when its process was killed."""
        self._may_have_erased = False
        self._link = link = WorldLink(self.bus, self.plan.adapter)
        link.overdue_at = overdue_at
        self._is_interrupted = False
        device = api.Connection(link, self.clock, "the bus of the plan").device(self.target)
        try:
            result = device.upgrade(
                self._image_plan,
                options=options,
                identity=Identity(),
                on_event=self._note,
                cancelled=lambda: self._is_interrupted,
            )
        except Killed:
            return None
        except OverdueError:
            return _Claim("HANG", -1, is_ok=False, left=None, needs_rescue=True)
        except FlasherError as error:
            return _Claim(
                f"error {error.code}",
                int(error.exit_code),
                is_ok=False,
                left=None,
                needs_rescue=error.needs_rescue,
                where=f"{error.where}: {error.what}",
            )
        return _claim_of(result)

    def _note(self, event: object) -> None:
        if self.verbose:
            self.log.append(f"{self.clock.now():.6f}     {event}")

    def _stop(self) -> None:
        """What has not happened yet does not happen any more."""
        self._is_running = False
        self._waiting.clear()
        self.bus.timers.clear()
        self.bus.faults_of_frames.clear()
        self.bus.is_unacknowledged = False
        self.bus.plug()
        for unit in self.units:
            unit.hang(-inf)

    def _wait(self, until: float) -> None:
        link = self.bus.link()
        while self.clock.now() < until:
            self.bus.advance(until)
            link.drain()

    # -- the oracle ------------------------------------------------------------------------------

    def _word_for(self, unit: Unit) -> str:
        application = unit.application
        if application is None:
            return "none"
        if application == self.image.data:
            return "new"
        return "old" if application == unit.before else "other"

    def _judge(
        self, claim: _Claim, had: str, words: Sequence[str], heard: frozenset[object]
    ) -> Iterator[str]:
        word, *twins = words
        # Of two devices, one that sends nothing of its own in the transfer cannot be seen.
        is_unseen = len(self._at_update) > 1 and not heard.issuperset(self._at_update)
        false = "UNSEEN" if is_unseen else "FALSE"
        if claim.ending == "HANG":
            yield "HANG: it did not end"
            return
        if claim.exit_code not in DOCUMENTED:
            yield f"UNDOCUMENTED: exit code {claim.exit_code}"
        if claim.is_ok != (claim.exit_code == ExitCode.OK):
            yield "UNDOCUMENTED: success and exit code differ"
        if claim.is_ok and word != "new":
            yield f"{false}: success, and the device has {word}"
        for twin, unit in zip(twins, self.units[1:], strict=True):
            took_part = unit in self._at_update or unit.application != unit.before
            if claim.is_ok and twin != "new" and took_part:
                yield f"{false}: success, and its twin has {twin}"
        if not self._may_have_erased:
            return  # whoever erased it, it was not the host
        # Another tool may erase a device that was complete, while its version is asked.
        is_others = claim.left is DeviceLeft.NEW and "second_tool" in claim.ending
        if not claim.needs_rescue and not claim.is_ok and word == "none" != had and not is_others:
            yield "DISHONEST: no need of rescue, and the device has no application"
        if claim.left is DeviceLeft.UNTOUCHED and word != had:
            yield f"DISHONEST: untouched, and the device has {word}"

    @property
    def _present(self) -> list[Unit]:
        """Units that have been on the bus."""
        attached = {id(each.engine) for each in self.bus._devices}
        return [unit for unit in self.units if id(unit) in attached]


def _claim_of(result: Result) -> _Claim:
    outcome, error = result.outcome, result.error()
    needs_rescue = outcome.device_left.needs_rescue if error is None else error.needs_rescue
    ending = outcome.ending.value
    if outcome.ok and not result.verification.ok:
        ending += f", {result.verification.verdict.value}"
    return _Claim(
        ending,
        int(result.exit_code),
        is_ok=result.ok,
        left=outcome.device_left,
        needs_rescue=needs_rescue,
        attempts=outcome.statistics.attempts,
        where=outcome.where,
    )


def play(plan: plans.Plan, options: UpgradeOptions | None = None) -> Verdict:
    """Play a plan; what is raised stands in the verdict."""
    player = Player(plan, options or UpgradeOptions())
    try:
        return player.play()
    except Exception as error:  # noqa: BLE001  a finding
        text: Any = f"{type(error).__name__}: {error}"
        return Verdict(
            str(plan), "INTERNAL", 1, is_good=False, left="", attempts=0, took_s=0.0,
            lateness=0.0, faults=(f"INTERNAL: {text}",),
        )  # fmt: skip
