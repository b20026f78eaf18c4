"""Plays a plan: the production upgrade on the plan's bus, then an examination of every device."""

from __future__ import annotations

import hashlib
import random
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Final

from flasher import api
from flasher.bus.link import VirtualClock
from flasher.errors import FlasherError
from flasher.events import AttemptStarted, BootVersionSeen, PowerCycleAwaited, QueryAnswered
from flasher.host.identity import Identity
from flasher.host.options import UpgradeOptions, overall_timeout_s
from flasher.host.session import Result
from flasher.host.table import Reason
from flasher.image.image import Image
from flasher.image.plan import Plan as ImagePlan
from flasher.image.plan import plan as image_plan
from flasher.mock.model import MockDevice
from flasher.mock.store import with_checksum
from flasher.protocol.contents import RunningInformation
from flasher.protocol.frame import Frame
from flasher.protocol.spec import PACKET_DATA_SIZE, TARGETS, WELLING
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.simulate import plan as plans
from flasher.simulate.bus import (
    FrameFault,
    HostClock,
    KilledError,
    OverdueError,
    PlanBus,
    PlanLink,
    Unit,
)
from flasher.simulate.independent import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    END,
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
    IndependentDevice,
    frames_of,
)
from flasher.simulate.oracle import Facts, Reported, SubjectFailedError, UnitFacts, Violation, judge
from flasher.simulate.reached import fault_place, reading_place
from flasher.simulate.wire_rules import WireRules

if TYPE_CHECKING:
    from flasher.simulate.subject import SubjectBench, SubjectDevice

NEW_VERSION: Final = "V1r2r0_20240601"
"""Version that the new image reports."""
SETTLE_S: Final = 3.0
"""Time from the end of a run to the examination of the flash."""
OVERDUE_SHARE: Final = 1.5
OVERDUE_S: Final = 60.0
"""A run that is so much later than its announced deadline has not ended."""
_VECTORS: Final = struct.pack("<4I", 0x2000_5000, 0x0800_4101, 0, 0)
"""Vector table of a Cortex-M: stack pointer, reset vector, no NMI and no hard fault handler."""
_ON_HOST: Final = (plans.Stall, plans.Kill, plans.Interrupt, plans.Unplug, plans.BusOff)
"""Clauses that the host notices at the end of a wait."""
_STEP_S: Final = 0.05
_OPERATOR_S: Final = 8.0
"""Time in which the operator of the recovery follows a prompt; the supply is then off so long."""


@dataclass(frozen=True)
class Verdict:
    """How a plan ended, and what the oracle found wrong."""

    plan: str
    ending: str
    """Ending of the upgrade, or the code of the error."""
    exit_code: int
    is_good: bool
    """The result claims success, and the device has the image."""
    left: str
    """Content of the device's flash: new, old, none or other; after " / " that of a twin."""
    attempts: int
    took_s: float
    lateness: float
    """The end as a share of the announced deadline."""
    share_of_bus_time: float = 0.0
    """Duration as a multiple of the time that all frames of the upgrade take on the bus."""
    violations: tuple[Violation, ...] = ()
    """Empty if the host was right."""
    recovered: str = ""
    """Command that brought the device back after a run without success; empty if none had to."""
    runs: int = 1
    reached: frozenset[str] = frozenset()
    """What the run passed through: faults with the phase in which they happened."""
    wire: str = ""
    """Digest of all frames with their times."""
    where: str = ""


def image_plan_of(
    packets: int, short: int, seed: int, target: str, *, has_checksum: bool = False
) -> ImagePlan:
    """Plan the upgrade to an image that names its version, and may end with a checksum (R7)."""
    head = _VECTORS + NEW_VERSION.encode() + b"\0"
    body = random.Random(seed).randbytes(packets * PACKET_DATA_SIZE - short - len(head))
    data = head + body
    if has_checksum:
        data = with_checksum(b"", len(data), data)
    image = replace(Image.from_bytes(data), version=NEW_VERSION)
    return image_plan(image, TARGETS[target], WELLING.bitrate_bps)


class Player:
    """One plan being played. `log` gets each frame, fault and event as a line of text, `tap` each
    frame with its sender (`None` for other traffic) and time. `bench` makes the device of a plan
    that has a bootloader under test.
    """

    def __init__(
        self,
        plan: plans.Plan,
        *,
        bench: SubjectBench | None = None,
        log: Callable[[str], object] | None = None,
        tap: Callable[[Frame, plans.Sender | None, float], None] | None = None,
    ) -> None:
        job = plan.job
        self.plan = plan
        self.target = TARGETS[job.target]
        self.clock = VirtualClock()
        self.bus = PlanBus(self.clock, self._seen)
        self._bench = bench
        self._identity = Identity() if bench is None else bench.identity
        self.image_plan = self._image_plan()
        self.units: list[Unit] = []
        self._options = _options(job)
        self._log = log
        self._tap = tap
        self._link: PlanLink | None = None
        self._frames = 0
        self._trace: list[bytes] = []
        """Each frame with its time, for the digest."""
        self._waiting: dict[tuple[str, int], list[plans.Clause]] = {}
        self._is_running = True
        self._interrupted_at: float | None = None
        self._has_operator = False
        """Somebody follows the prompts of `flasher rescue`."""
        self._is_prompted = False
        """A prompt is on the screen."""
        self._has_running_information = self._is_silence_answered = False
        self._again_after_s = 0.0
        """Time from the kill of the host's process until the same command runs again."""
        self._disturbs_host = any(isinstance(each, _ON_HOST) for each in plan.clauses)
        self._phase = "idle"
        """Last message that the host began."""
        self._reached: set[str] = set()
        self._facts = Facts(plan, self.target.request_id, WireRules(plan))
        self.bus.on_late = self._facts.rules.delayed_frame_arrives
        self._at_update: list[Unit] = []
        """Units on the bus when the last update command began."""
        if bench is None:
            self._begin()

    # -- the world -------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Put the devices on the bus."""
        for number, device in enumerate(self.plan.devices):
            unit = Unit(self._engine(device), drift=device.drift)
            self.units.append(unit)
            if device.when is None:
                self._join(number, device, 0.0)
        if self._bench is not None:
            self._start_subject()
        for clause in self.plan.events:
            self._expect(clause)
        if self._bench is None and any(what == "flash" for what, _ in self._waiting):
            self.units[0].on_operation = lambda number, now: self._begins("flash", number, now)

    def _start_subject(self) -> None:
        """Wait until the bootloader under test has started its application, if it has one."""
        engine, device = self.units[0].engine, self.plan.devices[0]
        assert not isinstance(engine, IndependentDevice | MockDevice)  # noqa: S101  it has a bench
        engine.flash_faults.on_operation = self._interrupt
        if device.begins == "application" and device.application == "old" and device.when is None:
            limit = self.clock.now() + engine.START_LIMIT_S
            while not self.units[0].runs_application and self.clock.now() < limit:
                self.bus.advance(self.clock.now() + _STEP_S)
            if not self.units[0].runs_application:
                raise SubjectFailedError("it does not start an application that it has taken")
        self._frames = 0

    def _image_plan(self, *, has_checksum: bool = False) -> ImagePlan:
        job = self.plan.job
        if self._bench is not None:
            size_bytes = job.packets * PACKET_DATA_SIZE - job.short
            return self._bench.image_plan(NEW_VERSION, size_bytes, job.image)
        return image_plan_of(
            job.packets, job.short, job.image, job.target, has_checksum=has_checksum
        )

    def _interrupt(self, number: int, takes_s: float) -> float | None:
        """Begin what waits for a flash operation of the bootloader under test; return the share of
        it that is done when its supply fails, None if it does not. It calls while its time runs
        ahead of the bus.
        """
        now, share = self.clock.now(), None
        for clause in [*self._waiting.get(("flash", number), ())]:
            plus_s = clause.when.plus_s if clause.when else 0.0
            if isinstance(clause, plans.Power | plans.Restart) and plus_s < takes_s:
                self._waiting["flash", number].remove(clause)
                self._happen(clause, now)
                share = plus_s / takes_s
        self._begins("flash", number, now)
        return share

    def _engine(self, device: plans.Device) -> IndependentDevice | MockDevice | SubjectDevice:
        if self._bench is not None:
            return self._bench.device(device.version if device.application == "old" else None)
        if isinstance(device, plans.Independent):
            old = _VECTORS + device.version.encode() + b"\0" + bytes(range(256)) * 4
            content = old if device.application == "old" else None
            return IndependentDevice(self.target.name, device.chosen(), content)
        assert isinstance(device, plans.Mock)  # noqa: S101  a subject has a bench
        return MockDevice(
            self.target,
            bitrate_bps=WELLING.bitrate_bps,
            profile=replace(device.chosen(), factory_version=device.version),
            has_application=device.application == "old",
        )

    def _join(self, number: int, device: plans.Device, now: float) -> None:
        unit = self.units[number]
        engine = unit.engine
        self.bus.attach(unit if self._is_disturbed(number, device) else engine)
        self.bus.units.append(unit)
        if device.begins == "application" and device.application == "old" and device.when is None:
            if isinstance(engine, IndependentDevice):
                engine.run_application(now)
        elif isinstance(engine, MockDevice):
            engine.power_cut(now)
        if device.begins != "off":
            unit.power_on(now)
        self._update_acknowledgement()

    def _is_disturbed(self, number: int, device: plans.Device) -> bool:
        """True if more than the supply of a device fails, or its flash operations are traced."""
        return bool(device.drift or self._tap or self._bench) or any(
            (isinstance(each, plans.Answer | plans.Hang) and each.device == number)
            or (each.when is not None and each.when.what == "flash")
            for each in self.plan.clauses
        )

    def _update_acknowledgement(self) -> None:
        has_units = any(unit.has_power for unit in self.units)
        is_alone = self.bus.is_garbled or not (self.plan.job.others or has_units)
        if is_alone != self.bus.is_unacknowledged:
            self.bus.is_unacknowledged = is_alone

    def _expect(self, clause: plans.Clause) -> None:
        when = clause.when
        if when is None or not when.what:
            moment = 0.0 if when is None else when.plus_s
            self.bus.agenda.at(self.clock.now() + moment, lambda now: self._happen(clause, now))
        else:
            self._waiting.setdefault((when.what, when.number), []).append(clause)

    def _seen(self, frame: Frame, sender: plans.Sender | None, now: float) -> None:
        self._frames += 1
        self._trace.append(b"%d %s %.9f;" % (frame[0], frame[1], now))
        if self._tap is not None:
            self._tap(frame, sender, now)
        if self._log is not None:
            name = sender or "other"
            self._log(f"{now:.6f} {name} {frame.can_id:03X} {frame.data.hex(' ')}")
        if self._waiting:
            self._begins("frame", self._frames, now)
        facts = self._facts
        if sender == "host":
            facts.host_ids.add(frame[0])
            begun = facts.rules.host_sends(frame, now)
            facts.may_have_erased |= facts.rules.has_update
            if begun is not None:
                what, number = begun
                self._phase = what
                if what == "update":
                    self._at_update = self._present
                    self.bus.forget_heard()
                    self.bus.burst_ends_at, self.bus.awaits_burst = inf, False
                elif what == "end" and not self._facts.rules.ends:
                    self.bus.awaits_burst = True
                elif what == "packet":
                    ends_at = now + DEFAULT_TIMINGS.leftover_boot_version_s
                    self.bus.burst_ends_at = min(self.bus.burst_ends_at, ends_at)
                self._begins(what, number, now)
        else:
            facts.rules.others_send(frame, now)

    def _begins(self, what: str, number: int, now: float) -> None:
        if not self._waiting:
            return
        for clause in self._waiting.pop((what, number), ()):
            plus_s = clause.when.plus_s if clause.when else 0.0
            if plus_s:
                self.bus.agenda.at(now + plus_s, lambda at, due=clause: self._happen(due, at))  # type: ignore[misc]
            else:
                self._happen(clause, now)

    def _happen(self, clause: plans.Clause, now: float) -> None:
        if self._log is not None:
            self._log(f"{now:.6f} *** {clause}")
        self._reached.add(fault_place(clause.NAME, self._phase))
        match clause:
            case plans.OnFrames() | plans.Noise():
                self.bus.frame_faults.append(FrameFault(clause, now))
            case plans.OnDevice():
                self._happen_to(clause, now)
            case plans.Device():
                self._join(list(self.plan.devices).index(clause), clause, now)
            case plans.Load():
                self._load(clause, now, now + clause.seconds)
            case plans.Unsolicited():
                for copy in range(clause.count):
                    self.bus.agenda.send(self._unsolicited(clause), now + 0.002 * copy)
            case plans.Tool():
                for turn in range(clause.count):
                    frames = self._foreign(clause.does, turn)
                    self.bus.agenda.send(frames, now + clause.every * turn)
            case _:
                self._happen_to_host(clause, now)

    def _happen_to_host(self, clause: plans.Clause, now: float) -> None:
        bus, link = self.bus, self._link
        match clause:
            case plans.Unplug(seconds=seconds, wrong_rate=wrong_rate):
                bus.unplug(seconds)
                if wrong_rate:
                    bus.agenda.at(now + seconds, lambda _at: self._garble(is_garbled=True))
                    back_at = now + seconds + wrong_rate
                    bus.agenda.at(back_at, lambda _at: self._garble(is_garbled=False))
            case plans.BusOff(seconds=seconds):
                bus.bus_off(seconds)
            case plans.Stall(seconds=seconds) if link is not None:
                link.stall(now + seconds)
            case plans.Kill(again=again, rescue=rescue) if link is not None:
                self._again_after_s, self._has_operator = again, rescue
                link.kill()
            case plans.Interrupt():
                if self._interrupted_at is None:
                    self._interrupted_at = now

    def _garble(self, *, is_garbled: bool) -> None:
        self.bus.is_garbled = is_garbled
        self._update_acknowledgement()

    def _happen_to(self, clause: plans.OnDevice, now: float) -> None:
        if clause.device >= len(self.units):
            return
        unit = self.units[clause.device]
        match clause:
            case plans.Answer():
                unit.change(clause)
            case plans.Power(seconds=seconds):
                self._cut(unit, seconds, now)
            case plans.Restart():
                unit.power_cut(now)
                unit.power_on(now)
            case plans.Hang(seconds=seconds):
                unit.hang(now + seconds, now)
            case plans.FlashFails(count=count):
                unit.fail_flash(count)

    def _cut(self, unit: Unit, seconds: float, now: float) -> None:
        unit.power_cut(now)
        self._update_acknowledgement()
        self.bus.agenda.at(now + seconds, lambda at: self._power_back(unit, at))

    def _power_back(self, unit: Unit, now: float) -> None:
        unit.power_on(now)
        self._update_acknowledgement()

    def _load(self, clause: plans.Load, now: float, until: float) -> None:
        if now < until and self._is_running:
            self.bus.agenda.send([Frame(clause.id, b"\x33" * 8)], now)
            self.bus.agenda.at(now + clause.every, lambda at: self._load(clause, at, until))

    def _unsolicited(self, clause: plans.Unsolicited) -> list[Frame]:
        number = clause.number.to_bytes(2, "little")
        command, data = {
            "ack": (ACK, number),
            "nak": (NAK, number),
            "boot": (BOOT_VERSION, self.target.boot_name.encode() + b"V1.0.0"),
            "request": (REQUEST, b"\0\0"),
            "complete": (COMPLETE, b"\0\0"),
            "feedback": (FEEDBACK, b"ACK"),
            "unknown": (0x7701, b"?"),
        }[clause.what]
        return frames_of(self.target.answer_id, REPORT, command, data)

    def _foreign(self, does: str, turn: int) -> list[Frame]:
        packets = self.plan.job.packets
        packet = (
            b"\1" + (turn + 1).to_bytes(2, "little") + packets.to_bytes(2, "little") + b"\xa5" * 128
        )
        update, size_bytes = self.target.update_text.encode(), len(self.image_plan.image.data)
        mode, command, data = {
            "asks": (READ, READ_VERSION, b""),
            "writes": (WRITE, 0x3A10, b"second tool.    "),
            "resets": (WRITE, RESET, b"RESET"),
            "updates": (WRITE, UPDATE, update + size_bytes.to_bytes(4, "little")),
            "shortens": (WRITE, UPDATE, update + (size_bytes - 1).to_bytes(4, "little")),
            "packets": (WRITE, PACKET, packet),
            "refused": (WRITE, UPDATE, update + bytes(4)),
            "ends": (WRITE, END, b"\4"),
            "unknown": (WRITE, 0x7777, b"?"),
            "damaged": (WRITE, PACKET, packet),
            "answers": (REPORT, ACK, b"\1\0"),
        }[does]  # fmt: skip
        frames = frames_of(self.target.request_id, mode, command, data)
        if does == "damaged":
            frames[-1] = Frame(frames[-1].can_id, bytes(frames[-1].data[:-2]) + b"\0\xf0")
        return frames

    # -- the host --------------------------------------------------------------------------------

    def play(self) -> Verdict:
        """Run the host, as often as it is killed; examine the devices; bring the unit back."""
        if self._bench is None:
            return self._play()
        try:
            self._begin()
            return self._play()
        except SubjectFailedError as error:
            failed = _failed(self.plan, "subject failed", Violation("SUBJECT", str(error)))
            return replace(failed, took_s=self.clock.now(), wire=self._wire())
        finally:
            self._bench.end_device()

    def _play(self) -> Verdict:
        runs, facts = 0, self._facts
        while True:
            runs += 1
            began_at = self.clock.now()
            facts.begin_run(self._content(self.units[0]))
            # The history of this computer has a run without an end.
            options = replace(self._options, in_session=runs > 1, at_power_up=self._has_operator)
            limit_s = overall_timeout_s(self.image_plan, options)
            reported = self._run(options, began_at + limit_s * OVERDUE_SHARE + OVERDUE_S)
            if reported is not None:
                break
            self._wait(self.clock.now() + self._again_after_s)
        ended_at = self.clock.now()
        took_s = ended_at - began_at
        interrupted_s = ended_at - (self._interrupted_at or ended_at)
        heard = self.bus.heard
        at_end = [self._content(unit) for unit in self.units]
        self._end_faults()
        self._wait(self.clock.now() + SETTLE_S)
        left = " / ".join(map(self._content, self.units))
        facts.took_s, facts.limit_s = took_s, limit_s
        facts.interrupted_s = interrupted_s
        facts.units = [
            UnitFacts(
                at_end=content,
                now=self._content(unit),
                took_part=unit in self._at_update or unit.application != unit.before,
                was_heard=not heard.isdisjoint((unit, unit.engine)),
                was_at_update=unit in self._at_update,
                runs_nothing=unit.runs_application and unit.application is None,
            )
            for unit, content in zip(self.units, at_end, strict=True)
        ]
        is_good = reported.is_ok and self.units[0].application == self.image_plan.image.data
        if is_good:
            self._reached |= set(map(reading_place, self._readings()))
        if self._bench is not None:
            unit = self.units[0]
            facts.started = [self._name(each, unit) for each in unit.engine.started]  # type: ignore[union-attr]
        violations = [*judge(facts, reported)]
        recovered = ""
        if not (reported.is_ok or violations) and len(self.units) == 1:
            recovered = self._recover(reported, was_killed=runs > 1)
            if not recovered:
                lost = self._content(self.units[0])
                violations.append(Violation("LOST", f"not brought back: the device has {lost}"))
        return Verdict(
            plan=str(self.plan),
            ending=reported.ending,
            exit_code=reported.exit_code,
            is_good=is_good,
            left=left,
            attempts=reported.attempts,
            took_s=took_s,
            lateness=took_s / limit_s,
            share_of_bus_time=took_s / self.image_plan.wire_s,
            violations=tuple(violations),
            recovered=recovered,
            runs=runs,
            reached=frozenset(self._reached),
            wire=self._wire(),
            where=reported.where,
        )

    def _wire(self) -> str:
        return hashlib.sha256(b"".join(self._trace)).hexdigest()[:16]

    def _readings(self) -> Iterator[str]:
        """Yield the readings of the documents that a good run shows by itself."""
        job, device = self.plan.job, self.plan.devices[0]
        if self._has_running_information:
            yield "R1"
        if device.application == "none":
            yield "R14"
        elif job.target != "bms" and not [*self.plan.events]:
            yield "R3"  # only a reset leads into its bootloader
        if job.short:
            yield "R9"
        if self._is_silence_answered:
            yield "R26"

    def _run(self, options: UpgradeOptions, overdue_at: float) -> Reported | None:
        """Run the command once; None if its process was killed."""
        self._phase = "idle"
        self._link = link = PlanLink(self.bus, self.plan.adapter, overdue_at)
        link.on_send = self._facts.rules.host_hands_over
        self._interrupted_at = None
        clock = HostClock(self.bus, is_disturbed=self._disturbs_host and self._is_running)
        device = api.Connection(link, clock, "the bus of the plan").device(self.target)
        try:
            result = device.upgrade(
                self.image_plan,
                options=options,
                identity=self._identity,
                on_event=self._note,
                cancelled=lambda: self._interrupted_at is not None,
            )
        except KilledError:
            return None
        except OverdueError:
            return Reported(
                "overdue", -1, is_ok=False, left=None, needs_rescue=True, is_overdue=True
            )
        except FlasherError as error:
            return Reported(
                f"error {error.code}",
                int(error.exit_code),
                is_ok=False,
                left=None,
                needs_rescue=error.needs_rescue,
                where=f"{error.where}: {error.what}",
            )
        return _reported_by(result)

    def _recover(self, reported: Reported, *, was_killed: bool) -> str:
        """Run the commands that the documents advise, without faults, for an operator who follows
        each prompt; return the one that succeeded.
        """
        unit = self.units[0]
        unit.power_on(self.clock.now())
        if "image_checksum=crc32" in self.plan.devices[0].choices:
            # It refuses an image without one: another image is advised.
            self.image_plan = self._image_plan(has_checksum=True)
        self._has_operator = True
        in_session = was_killed or reported.needs_rescue
        options = replace(self._options, attempts=None, timeout_s=None, frame_gap_s=0.0)
        for name, run in (
            ("flash", replace(options, in_session=in_session)),
            ("rescue", replace(options, at_power_up=True)),
        ):
            limit_s = overall_timeout_s(self.image_plan, run)
            again = self._run(run, self.clock.now() + limit_s)
            if again is not None and unit.application == self.image_plan.image.data:
                return name
        return ""

    def _note(self, event: object) -> None:
        if self._log is not None:
            self._log(f"{self.clock.now():.6f}     {event}")
        if self._has_operator and isinstance(event, PowerCycleAwaited):
            self._is_prompted = True
            self.bus.agenda.at(self.clock.now() + _OPERATOR_S, self._follow_prompt)
        elif isinstance(event, BootVersionSeen):
            self._is_prompted = False
        elif isinstance(event, QueryAnswered):
            self._has_running_information |= isinstance(event.content, RunningInformation)
        elif isinstance(event, AttemptStarted):
            self._is_silence_answered |= event.reason == Reason.BOOT_SILENT.value

    def _follow_prompt(self, now: float) -> None:
        """Switch the unit off, unless the upgrade goes on already."""
        if self._is_prompted:
            self._is_prompted = False
            self._cut(self.units[0], _OPERATOR_S, now)

    def _end_faults(self) -> None:
        """Cancel what has not happened yet, and end what lasts."""
        self._is_running = False
        self._waiting.clear()
        self.bus.agenda.clear()
        self.bus.frame_faults.clear()
        self.bus.is_garbled = self.bus.is_unacknowledged = False
        self.bus.plug()
        for unit in self.units:
            unit.end_faults(self.clock.now())

    def _wait(self, until: float) -> None:
        while self.clock.now() < until:
            self.bus.advance(until)

    def _content(self, unit: Unit) -> str:
        return self._name(unit.application, unit)

    def _name(self, application: bytes | None, unit: Unit) -> str:
        if application is None:
            return "none"
        if application == self.image_plan.image.data:
            return "new"
        return "old" if application == unit.before else "other"

    @property
    def _present(self) -> list[Unit]:
        """Units that have been on the bus."""
        return [unit for unit in self.units if unit in self.bus.units]


def _options(job: plans.Job) -> UpgradeOptions:
    options = UpgradeOptions()
    if job.attempts:
        options = replace(options, attempts=job.attempts)
    if job.gap:
        options = replace(options, frame_gap_s=job.gap)
    if job.tries:
        options = replace(options, timings=replace(options.timings, packet_tries=job.tries))
    return replace(options, timeout_s=job.timeout) if job.timeout else options


def _reported_by(result: Result) -> Reported:
    outcome, error = result.outcome, result.error()
    needs_rescue = outcome.device_left.needs_rescue if error is None else error.needs_rescue
    ending = outcome.ending.value
    if outcome.ok and not result.verification.ok:
        ending += f", {result.verification.verdict.value}"
    return Reported(
        ending,
        int(result.exit_code),
        is_ok=result.ok,
        left=outcome.device_left,
        needs_rescue=needs_rescue,
        attempts=outcome.statistics.attempts,
        acknowledged=outcome.statistics.packets_acknowledged,
        reports_version=bool(result.running_version),
        unobserved_s=outcome.unobserved_s,
        where=outcome.where,
    )


def play(plan: plans.Plan, bench: SubjectBench | None = None) -> Verdict:
    """Play a plan. An exception of the code under test is a violation."""
    try:
        return Player(plan, bench=bench).play()
    except Exception as error:  # noqa: BLE001  a finding
        return _failed(plan, "crash", Violation("CRASH", f"{type(error).__name__}: {error}"))


def _failed(plan: plans.Plan, ending: str, why: Violation) -> Verdict:
    return Verdict(
        str(plan), ending, 1, is_good=False, left="", attempts=0, took_s=0.0, lateness=0.0,
        violations=(why,),
    )  # fmt: skip
