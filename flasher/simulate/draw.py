"""Random plans: a seed gives the same plan each time."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

from flasher.bus.simulated import DEFAULT_QUEUE_FRAMES
from flasher.simulate import plan as plans
from flasher.simulate.corpus import parents
from flasher.simulate.plan import Plan, When

TWIN_SHARE: Final = 0.1
"""Share of the plans with two devices; their images are long, and take half of the time."""
_MUTANT_EVERY: Final = 8
"""One in so many seeds changes a plan that is kept, instead of drawing one."""
_LONG_PACKETS: Final = 1000
"""Largest image for a bootloader under test."""
_TOOL_DOES: Final = (
    "asks", "asks", "writes", "resets", "updates", "packets", "refused", "ends", "unknown",
    "damaged",
)  # fmt: skip
_HOW_MANY: Final = (0, 1, 1, 1, 2, 2, 2, 3, 3, 4, 6)


def drawn(seed: int, twin_share: float = TWIN_SHARE) -> Plan:
    """The plan of a seed, which has two devices in it in a share of the seeds."""
    draw = _Draw(seed, twin_share)
    return draw.plan() if seed % _MUTANT_EVERY else draw.mutant()


def drawn_for_subject(
    seed: int, target: str, packets_max: int, erases: int, writes_per_packet: float
) -> Plan:
    """The plan of a seed for a bootloader under test: job, adapter and faults of the other plans,
    and in every second one also a fault in a flash operation.
    """
    draw = _Draw(seed, twin_share=0.0)
    plan = draw.plan()
    packets, short = min(plan.job.packets, packets_max), plan.job.short
    if draw.is_whole_area():
        packets, short = min(packets_max, _LONG_PACKETS), 0
    job = replace(plan.job, target=target, packets=packets, short=short)  # type: ignore[arg-type]
    device = plan.devices[0]
    subject = plans.Subject(
        application=device.application, begins=device.begins, drift=device.drift
    )
    faults = (*plan.events, *draw.flash_faults(erases, round(packets * writes_per_packet)))
    lasting = [each for each in plan.clauses if isinstance(each, plans.Adapter)]
    return Plan((job, *lasting, subject, *faults))


class _Draw:
    def __init__(self, seed: int, twin_share: float) -> None:
        self._twin_share = twin_share
        self._random = random.Random(seed)
        self._seed = seed
        self._packets = 20
        self._has_twin = False
        self._target = "bms"
        self._is_independent = False

    # -- helpers ---------------------------------------------------------------------------------

    def _is(self, share: float) -> bool:
        return self._random.random() < share

    def _between(self, least: float, most: float) -> float:
        """Evenly in the logarithm, in microseconds."""
        drawn_s = math.exp(self._random.uniform(math.log(least), math.log(most)))
        return round(drawn_s, 6)

    def _chosen(self, name: str, share: float, *others: object) -> str:
        """`name=other` in a share of the cases."""
        if not self._is(share):
            return ""
        return f"{name}={self._random.choice(others)}"

    def _when(self) -> When:
        draw = self._random
        kind = draw.random()
        if kind < 0.68:
            plus = self._between(1e-4, 0.05) if self._is(0.5) else 0.0
            return When("packet", draw.randint(1, self._packets), plus)
        if kind < 0.76:
            return When("end", 0, self._between(1e-4, 1.0) if self._is(0.7) else 0.0)
        if kind < 0.84:
            return When("update", 0, self._between(1e-4, 1.0) if self._is(0.7) else 0.0)
        if kind < 0.90:
            return When("reset", 0, self._between(1e-4, 0.5) if self._is(0.7) else 0.0)
        if kind < 0.93:
            return When("flash", draw.randint(1, self._packets + 2), self._between(1e-5, 0.3))
        if kind < 0.96:
            return When("frame", draw.randint(1, 20 * self._packets))
        return When(plus_s=self._between(0.01, 5.0))

    # -- what there is ---------------------------------------------------------------------------

    def plan(self) -> Plan:
        draw = self._random
        self._target = draw.choice(("bms", "bms", "bms", "wmc", "obc"))
        self._packets = draw.choice((3, 5, 8, 12, 20, 20, 30, 45))
        self._has_twin = self._is(self._twin_share)
        if self._has_twin:
            # As long as firmware is: of a shorter transfer little shows that two devices take part.
            self._packets = draw.choice((120, 200, 300, 600))
        devices = self._devices()
        self._is_independent = isinstance(devices[0], plans.Independent)
        events = [self._event() for _ in range(draw.choice(_HOW_MANY))]
        needs_others = any(isinstance(each, plans.Tool | plans.Load) for each in events)
        clauses: list[plans.Clause] = [
            plans.Job(
                target=self._target,  # type: ignore[arg-type]  # one of them
                packets=self._packets,
                short=draw.choice((5, 5, 0, 1, 64, draw.randrange(96))),
                image=self._seed % 1000,
                others=needs_others or self._is(0.7),
                attempts=draw.randint(1, 4) if self._is(0.1) else 0,
                tries=draw.choice((1, 2, 10, 20)) if self._is(0.1) else 0,
                timeout=round(draw.uniform(2.0, 60.0), 1) if self._is(0.1) else 0.0,
                gap=round(draw.uniform(0.001, 0.08), 3) if self._is(0.05) else 0.0,
            )
        ]
        if self._is(0.5):
            clauses.append(self._adapter())
        return Plan((*clauses, *devices, *events))

    def mutant(self) -> Plan:
        """A plan that is kept, with one to three changes."""
        draw = self._random
        one, other = draw.sample(parents(), 2)
        job, adapter, devices = one.job, one.adapter, [*one.devices]
        self._target, self._packets = job.target, job.packets
        self._is_independent = isinstance(devices[0], plans.Independent)
        events = [each for each in one.events if not isinstance(each, plans.Device)]
        others = [each for each in other.events if not isinstance(each, plans.Device)]
        for _ in range(draw.choice((1, 1, 2, 3))):
            way, index = draw.random(), draw.randrange(len(events) + 1)
            if index < len(events) and way < 0.3:
                moved = When(draw.choice(("reset", "update", "end")), 0, self._between(1e-4, 1.0))
                events[index] = replace(events[index], when=draw.choice((self._when(), moved)))
            elif index < len(events) and way < 0.45:
                events.pop(index)
            elif others and way < 0.65:
                events.append(draw.choice(others))
            elif way < 0.75:
                choices = self._independent() if self._is_independent else self._mock()
                devices[0] = replace(devices[0], choices=choices)
            elif way < 0.85:
                adapter = self._adapter()
            else:
                events.append(self._event())
        is_shared = any(isinstance(each, plans.Tool | plans.Load) for each in events)
        job = replace(job, image=self._seed % 1000, others=job.others or is_shared)
        return Plan((job, adapter, *devices, *events))

    def _adapter(self) -> plans.Adapter:
        return plans.Adapter(
            echoes=self._is(0.7),
            delay=self._between(1e-4, 0.3),
            jitter=self._between(1e-4, 0.02) if self._is(0.3) else 0.0,
            lost=round(self._random.uniform(0, 0.5), 3) if self._is(0.3) else 0.0,
            doubled=round(self._random.uniform(0, 0.5), 3) if self._is(0.3) else 0.0,
            queue=self._random.choice((1, 2, 10, 18)) if self._is(0.3) else DEFAULT_QUEUE_FRAMES,
            seed=self._seed,
        )

    def _devices(self) -> list[plans.Clause]:
        is_independent = self._is(0.65)
        choices = self._independent() if is_independent else self._mock()
        application = "none" if self._is(0.1) else "old"
        kind = plans.Independent if is_independent else plans.Mock
        first = kind(
            application=application,  # type: ignore[arg-type]
            begins="boot" if self._is(0.05) else "application",
            drift=self._drift(),
            choices=choices,
        )
        if not self._has_twin:
            return [first]
        other = (
            choices if self._is(0.7) else self._independent() if is_independent else self._mock()
        )
        if is_independent and self._is(0.9):
            late = self._between(1e-6, 0.01)
            other = f"{other} late={late}".strip()
        begins = self._random.choice(("application", "application", "boot"))
        twin = kind(
            when=self._when() if self._is(0.15) else None,
            application="none" if self._is(0.3) else "old",
            version=self._random.choice(("V1r0r0_20220512", "V1r0r0_20220512", "V1r1r0_20230101")),
            begins=begins,  # type: ignore[arg-type]
            drift=self._drift(),
            choices=other,
        )
        return [first, twin]

    def _drift(self) -> float:
        return round(self._random.uniform(-0.01, 0.01), 4) if self._is(0.1) else 0.0

    def _independent(self) -> str:
        among = self._chosen
        words = (
            f"restart={self._between(0.01, 1.0)}" if self._is(0.5) else "",
            f"spacing={round(self._random.uniform(0.045, 0.055), 4)}" if self._is(0.3) else "",
            among("listens", 0.2, "after_burst"),
            f"window={self._between(0.05, 1.0)}" if self._is(0.4) else "",
            among("empty", 0.2, "listens"),
            f"erase={self._between(0.001, 9.5)}" if self._is(0.7) else "",
            among("deaf_in_erase", 0.3, "true"),
            among("update_again", 0.4, "erases", "ignored"),
            among("update_in_transfer", 0.3, "ignored"),
            among("bad_packet", 0.5, "nak_received", "silent"),
            among("older_packet", 0.4, "nak", "silent"),
            f"store={self._between(0.0001, 0.3)}" if self._is(0.6) else "",
            f"session={self._random.choice((0.0, 0.0, 2.0, 10.0))}" if self._is(0.6) else "",
            among("reset_in_boot", 0.3, "restarts"),
            among("confirms_writes", 0.3, "true"),
            f"check={self._between(0.001, 3.0)}" if self._is(0.5) else "",
            among("end_again", 0.3, "silent"),
            among("after_complete", 0.4, "restarts"),
            f"start={self._between(0.01, 2.0)}" if self._is(0.5) else "",
            among("after_refusal", 0.3, "waits"),
            among("answers", 0.1, "false"),
            among("app_upgrade", 0.3, "silent"),
        )
        return " ".join(word for word in words if word)

    def _mock(self) -> str:
        among = self._chosen
        words = (
            among("reset_in_bootloader", 0.3, "restarts"),
            among("without_application", 0.2, "listens"),
            f"window_s={self._between(0.05, 1.0)}" if self._is(0.3) else "",
            f"reset_delay_s={self._between(0.01, 1.0)}" if self._is(0.3) else "",
            among("update_in_transfer", 0.3, "ignored"),
            among("bad_packet", 0.5, "nak_received", "silence"),
            among("older_packet", 0.4, "nak", "silence"),
            among("pause_in_transfer", 0.4, "waits"),
            f"transfer_timeout_s={self._between(1.0, 10.0)}" if self._is(0.3) else "",
            among("reset_in_transfer", 0.3, "restarts"),
            among("repeated_end", 0.3, "silence"),
            among("after_complete", 0.4, "restarts"),
            f"start_delay_s={self._between(0.01, 2.0)}" if self._is(0.4) else "",
            among("upgrade_in_application", 0.3, "silence"),
            among("battery_use", 0.1, "riding") if self._target == "bms" else "",
            f"erase_time_s={self._between(0.0005, 0.5)}" if self._is(0.5) else "",
            f"program_time_s={self._between(0.0001, 0.2)}" if self._is(0.5) else "",
        )
        return " ".join(word for word in words if word)

    # -- what happens ----------------------------------------------------------------------------

    def _event(self) -> plans.Clause:
        kinds: list[tuple[int, Callable[[When], plans.Clause]]] = [
            (14, self._on_frames),
            (12, self._noise),
            (8, self._unsolicited),
            (12, self._power),
            (8, self._restart),
            (8, self._hang),
            (8, self._answer),
            (3 if self._is_independent else 0, self._flash_fails),
            (8, self._unplug),
            (4, lambda when: plans.BusOff(when=when, seconds=self._between(0.05, 10.0))),
            (8, self._tool),
            (6, lambda when: plans.Stall(when=when, seconds=self._between(0.05, 10.0))),
            (3, self._kill),
            (1, lambda when: plans.Interrupt(when=when)),
            (4, self._load),
        ]
        weights = [weight for weight, _ in kinds]
        make = self._random.choices([make for _, make in kinds], weights)[0]
        return make(self._when())

    def _which(self) -> int:
        return int(self._has_twin and self._is(0.3))

    def _sender(self) -> plans.Sender:
        return self._random.choice(("any", "host", "device", "device"))

    def _on_frames(self, when: When) -> plans.Clause:
        sender, count = self._sender(), self._random.choice((1, 1, 1, 2, 2, 3, 4, 8))
        match self._random.randrange(6):
            case 0:
                return plans.Double(when=when, sender=sender, count=count)
            case 1:
                seconds = self._between(1e-4, 2.0)
                return plans.Delay(when=when, sender=sender, count=count, seconds=seconds)
            case 2:
                bit = self._random.randrange(64)
                return plans.Flip(when=when, sender=sender, count=count, bit=bit)
            case 3:
                to = self._random.randrange(8)
                return plans.Truncate(when=when, sender=sender, count=count, to=to)
            case 4:
                return plans.Swap(when=when, sender=sender, count=count)
            case _:
                return plans.Drop(when=when, sender=sender, count=count)

    def _noise(self, when: When) -> plans.Clause:
        scale = self._random.choice((0.01, 0.05, 0.2, 1.0))

        def share() -> float:
            return round(scale * self._random.random(), 4)

        return plans.Noise(
            when=when,
            seconds=self._between(0.05, 20.0),
            sender=self._sender(),
            lost=share(),
            wrong=share() if self._is(0.5) else 0.0,
            doubled=share() if self._is(0.3) else 0.0,
            errors=share() if self._is(0.2) else 0.0,
            seed=self._random.randrange(1000),
        )

    def _unsolicited(self, when: When) -> plans.Clause:
        what = self._random.choice(
            ("ack", "ack", "nak", "nak", "nak", "boot", "boot", "request", "feedback", "complete")
        )
        if what == "complete":
            # One that nobody sent is believed, as its checksum is right: not once the end is sent.
            when = When("packet", max(1, self._packets - 3))
        number = max(0, when.number + self._random.choice((-1, -1, 0, 1, 2, 300)))
        count = self._random.choice((1, 1, 2, 5, 20))
        return plans.Unsolicited(when=when, what=what, number=number, count=count)  # type: ignore[arg-type]

    def _answer(self, when: When) -> plans.Clause:
        becomes = self._random.choice(("same", "ack", "nak", "silence", "twice", "twice"))
        return plans.Answer(
            when=when,
            device=self._which(),
            becomes=becomes,  # type: ignore[arg-type]
            shift=self._random.choice((0, 0, -1, 1, 2, 300)),
            # Just before and after the limit for an ACK (0.5 s), among others.
            late=self._random.choice((0.0, 0.0, 0.499, 0.501, self._between(1e-4, 12.0))),
            count=self._random.choice((1, 1, 1, 2, 5)),
        )

    def _flash_fails(self, when: When) -> plans.Clause:
        return plans.FlashFails(when=when, count=self._random.choice((1, 1, 2, 5, 20)))

    def is_whole_area(self) -> bool:
        """True in a small share of the plans: a long image takes as long as fifty short ones."""
        return self._is(0.015)

    def flash_faults(self, erases: int, writes: int) -> Iterator[plans.Clause]:
        """In half of the plans, a fault in an erase, in a write, or in one of the last writes."""
        draw = self._random
        if self._is(0.5):
            first, last = draw.choice(
                (
                    (1, erases),
                    (erases + 1, erases + writes),
                    (erases + writes - 1, erases + writes + 2),
                )
            )
            number = draw.randint(first, max(first, last))
            when = When("flash", max(1, number), self._between(1e-5, 0.03))
            yield draw.choice((self._power, self._restart, self._flash_fails))(when)

    def _restart(self, when: When) -> plans.Clause:
        return plans.Restart(when=when, device=self._which())

    def _unplug(self, when: When) -> plans.Clause:
        return plans.Unplug(
            when=when,
            seconds=self._between(0.05, 30.0),
            wrong_rate=self._between(0.05, 10.0) if self._is(0.2) else 0.0,
        )

    def _power(self, when: When) -> plans.Clause:
        return plans.Power(when=when, device=self._which(), seconds=self._between(0.05, 60.0))

    def _hang(self, when: When) -> plans.Clause:
        return plans.Hang(when=when, device=self._which(), seconds=self._between(0.1, 30.0))

    def _kill(self, when: When) -> plans.Clause:
        again = self._between(0.1, 10.0)
        return plans.Kill(when=when, again=again, rescue=self._is(0.3))

    def _tool(self, when: When) -> plans.Clause:
        return plans.Tool(
            when=when,
            does=self._random.choice(_TOOL_DOES),
            count=self._random.choice((1, 1, 2, 5, 20)),
            every=self._between(0.01, 1.5),
        )

    def _load(self, when: When) -> plans.Clause:
        return plans.Load(
            when=when,
            id=self._random.choice((0x000, 0x100, 0x712, 0x7FF)),
            every=self._between(0.0007, 0.02),
            seconds=self._between(0.05, 20.0),
        )
