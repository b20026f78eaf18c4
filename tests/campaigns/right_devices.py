"""Makes devices that are right, each with its own choices of what the document leaves open, and
runs the whole suite on each: `python -m tests.campaigns.right_devices --count 500 --seed 1`.

Each is judged twice: by a profile that tells its choices, and by the default profile, where what is
open is `either`, with nothing but its sizes. What fails is a fault of the suite, or of the model.
Device N alone: `--count 1 --seed N`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import random
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar, Final, NamedTuple

from flasher.conformance.catalogue import Selection
from flasher.conformance.explore import Explorer
from flasher.conformance.mock import MockSubject, profile_of_mock
from flasher.conformance.profile import ConformanceProfile, Limits, Value
from flasher.conformance.results import CaseVerdict
from flasher.conformance.runner import run
from flasher.mock.model import AnyMessage, MockDevice
from flasher.mock.profile import DeviceProfile
from flasher.mock.table import BootloaderEvent, BootloaderState
from flasher.mock.variants.entering import LOOP_S, QueuesUpdates
from flasher.mock.variants.framing import HeaderAtFrameStart, PaddingFatal, ShortFrameEnds
from flasher.mock.variants.transfer import FillerChecked
from flasher.protocol import messages
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, WELLING, Command, Mode
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.protocol.wire import Damage, DamageReason, Reassembler
from tests.campaigns.dual_bank import CopiesImage, SwapsBanks
from tests.campaigns.right_c_devices import RightCDevice, right_c_device

HELD: Final = frozenset(
    {CaseVerdict.PASS, CaseVerdict.PASS_IN_PART, CaseVerdict.INFO, CaseVerdict.UNSUPPORTED}
)
_BOOTLOADER: Final = frozenset(BootloaderState) - {
    BootloaderState.OFF,
    BootloaderState.APPLICATION,
    BootloaderState.RESTARTING,
}


# -- what the device model has no choice for -------------------------------------------------------


class _ConfirmsUnknown(MockDevice):
    """Sends general feedback to a write that it does not know (2.2.1 (2), R15)."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        is_write = isinstance(row, messages.Unknown) and row.message.mode == Mode.WRITE
        if is_write and self.state in _BOOTLOADER:
            self._send(messages.GeneralFeedbackMessage())
        super()._take_row(row, now)


class _ConfirmsAll(_ConfirmsUnknown):
    """Sends general feedback to update command, packet and end of transfer as well (R15)."""

    def _take_row(self, row: AnyMessage, now: float) -> None:
        upgrade = messages.UpdateCommand | messages.Packet | messages.EndOfTransfer
        if isinstance(row, upgrade) and self.state in _BOOTLOADER:
            self._send(messages.GeneralFeedbackMessage())
        super()._take_row(row, now)


class RefusesByNak(MockDevice):
    """Answers an update command that it does not accept by NAK."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        is_update = isinstance(row, messages.UpdateCommand) or (
            isinstance(row, messages.Malformed) and row.message.command == Command.UPDATE
        )
        is_ignored = self.state in _BOOTLOADER and event is BootloaderEvent.NO_CONCERN
        return BootloaderEvent.UPDATE_REFUSED if is_update and is_ignored else event

    def _refuse_update(self, now: float) -> str:
        self._send(messages.Nak(0))
        return super()._refuse_update(now)


class ListensAfterBurst(MockDevice):
    """Takes the update command when the burst is over, not between its announcements (R2)."""

    def _classify(self, row: AnyMessage) -> BootloaderEvent:
        event = super()._classify(row)
        in_burst = self.state is BootloaderState.ANNOUNCING and self._announced < self.burst
        is_deaf = in_burst and self._has_whole_application
        updates = (BootloaderEvent.UPDATE, BootloaderEvent.UPDATE_REFUSED)
        return BootloaderEvent.NO_CONCERN if is_deaf and event in updates else event


class RefusesInBurst(RefusesByNak, ListensAfterBurst):
    """Answers update commands between its announcements by NAK, too."""


class _RequestsForEach(QueuesUpdates):
    """Erases and requests the transfer for each update command that comes before packet 1 (R25)."""

    def _request(self, now: float) -> str:
        detail = super()._request(now)
        if self._waiting_update:
            self._due_at = now + LOOP_S
        return detail

    def _boot(self, now: float) -> str:
        self._waiting_update = False
        return super()._boot(now)


class _AsksForDamaged(MockDevice):
    """Says NAK to a packet that is damaged, and nothing to one that makes no sense (TX-01)."""

    _is_damaged = False

    def _take_damage(self, damage: Damage, now: float) -> None:
        self._is_damaged = True
        super()._take_damage(damage, now)
        self._is_damaged = False

    def _answer_bad(self, now: float) -> str:
        if self._is_damaged:
            return super()._answer_bad(now)
        self._await_host(now)
        return ""


class _SilentToShort(MockDevice):
    """Says nothing to a packet of which frames are lost (TX-01)."""

    def _take_damage(self, damage: Damage, now: float) -> None:
        if damage.reason is not DamageReason.INCOMPLETE:
            super()._take_damage(damage, now)


class AnswersLate(MockDevice):
    """Sends each kind of answer only after this time, and none before an earlier one. Announcements
    do not wait.
    """

    late_s: ClassVar[Mapping[type[messages.UpgradeMessage], float]] = {}
    _at = 0.0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._held: deque[tuple[float, messages.UpgradeMessage]] = deque()
        super().__init__(*args, **kwargs)

    def _handle(self, event: BootloaderEvent, now: float) -> None:
        self._at = now
        super()._handle(event, now)

    def _send(self, row: messages.UpgradeMessage) -> None:
        late_s = self.late_s.get(type(row), 0.0)
        # A bootloader that sends general feedback sends it at once (R15).
        if isinstance(row, messages.GeneralFeedbackMessage) and self.state in _BOOTLOADER:
            late_s = 0.0
        if isinstance(row, messages.BootVersion):
            super()._send(row)
            return
        due_at = max(self._at + late_s, self._held_until)
        if due_at > self._at:
            self._held.append((due_at, row))
        else:
            super()._send(row)

    @property
    def _held_until(self) -> float:
        return self._held[-1][0] if self._held else 0.0

    def tick(self, now: float) -> None:
        while self._held and self._held[0][0] <= now:
            super()._send(self._held.popleft()[1])
        super().tick(now)

    def deadline(self) -> float | None:
        due_at = super().deadline()
        if not self._held:
            return due_at
        return self._held[0][0] if due_at is None else min(due_at, self._held[0][0])

    def _restart(self, now: float) -> str:
        self._held.clear()
        return super()._restart(now)

    def _boot(self, now: float) -> str:
        self._held.clear()
        return super()._boot(now)

    def _switch_off(self, now: float) -> str:
        self._held.clear()
        return super()._switch_off(now)

    def _await_restart(self, now: float) -> None:
        super()._await_restart(now)
        self._due_at = max(self._due_at, self._held_until)  # feedback comes first

    def _complete(self, now: float) -> str:
        detail = super()._complete(now)
        self._due_at += max(0.0, self._held_until - now)
        return detail

    def _await_host(self, now: float) -> None:
        before = self._due_at
        super()._await_host(now)
        if self._due_at != before:  # a pause begins when the answer is sent
            self._due_at += max(0.0, self._held_until - now)

    def _complete_again(self, now: float) -> str:
        # Nothing to check this time, when it has answered the first one.
        if self.profile.repeated_end == "same_answer" and not self._held:
            super()._send(messages.Complete())
        return ""

    def _start(self, now: float) -> str:
        self._held.clear()
        return super()._start(now)


def answers_late(**late_s: float) -> type[AnswersLate]:
    """A device that sends these messages late: `answers_late(Nak=0.4)`."""
    kinds = {getattr(messages, name): value for name, value in late_s.items()}
    return type("AnswersLate", (AnswersLate,), {"late_s": kinds})


class StartsSlowly(MockDevice):
    """Receives nothing in the first `slow_s` of its application."""

    slow_s: ClassVar[float] = 4.85
    _deaf_until = -math.inf

    def _start(self, now: float) -> str:
        self._deaf_until = now + self.slow_s
        return super()._start(now)

    def receive(self, frame: Frame, now: float) -> None:
        if self.state is not BootloaderState.APPLICATION or now >= self._deaf_until:
            super().receive(frame, now)


class CountsFromPackets(MockDevice):
    """Counts a pause from the last packet that it stored, or from request transfer (TX-12)."""

    _has_stored = False

    def _acknowledge(self, now: float) -> str:
        self._has_stored = True
        return super()._acknowledge(now)

    def _request(self, now: float) -> str:
        self._has_stored = True
        return super()._request(now)

    def _await_host(self, now: float) -> None:
        if self._has_stored:
            super()._await_host(now)
        self._has_stored = False


_BEHAVIOURS: Final[tuple[tuple[type[MockDevice], dict[str, Value]], ...]] = (
    (_ConfirmsUnknown, {"fr_10": "either"}),
    (_ConfirmsAll, {"fr_10": "either"}),
    (RefusesByNak, {"up_02": "either"}),
    (ListensAfterBurst, {"up_04_burst": "rejected"}),
    (_RequestsForEach, {"up_05": "each"}),
    (_AsksForDamaged, {"tx_01": "either"}),
    (_SilentToShort, {}),
    (FillerChecked, {"tx_08": "rejected"}),
)


class AsksBeyondTheEnd(MockDevice):
    """Answers a packet after the last one by NAK with the number after the last one."""

    def _answer_bad(self, now: float) -> str:
        transfer = self._transfer
        if transfer.stored == transfer.total and self.profile.bad_packet != "silence":
            return self._reply(messages.Nak(transfer.total + 1), now)
        return super()._answer_bad(now)


_FRAMINGS: Final[tuple[tuple[type[Reassembler], dict[str, Value]], ...]] = (
    (ShortFrameEnds, {"fr_01": "rejected"}),
    (HeaderAtFrameStart, {"fr_02": "lost"}),
    (PaddingFatal, {"fr_07": "rejected"}),
)
"""What a device may do, with what a profile says of it."""


_LIMITS: Final = Limits()
_ON_BUS_S: Final = 0.012
_END_AGAIN_S: Final = 0.05
"""A device that restarts sooner after a NAK does not hear end of transfer again (R6)."""

# -- a device by its seed --------------------------------------------------------------------------


class RightDevice(NamedTuple):
    """How to make one, and the profiles that it is judged by."""

    seed: int
    target: str
    device_type: type[MockDevice]
    choices: DeviceProfile
    timings: dict[str, float]
    is_bare: bool
    """On a bench without power control and readback."""
    profiles: dict[str, ConformanceProfile]

    def make(self, target: str, profile: DeviceProfile) -> MockDevice:
        """As `MockSubject` makes its device."""
        return self.device_type(
            TARGETS[target],
            bitrate_bps=WELLING.bitrate_bps,
            profile=profile,
            timings=dataclasses.replace(DEFAULT_TIMINGS, **self.timings),  # type: ignore[arg-type]
        )

    @contextmanager
    def subject(self) -> Iterator[MockSubject]:
        """It on its bench."""
        made = MockSubject(self.target, profile=self.choices, make_device=self.make)
        if self.is_bare:
            for ability in ("has_power", "has_readback", "has_bus_off", "has_timed_cuts"):
                setattr(made, ability, False)
        yield made

    def __str__(self) -> str:
        mro = self.device_type.__mro__
        kinds = [kind.__name__ for kind in mro[1 : mro.index(MockDevice)]]
        late_s = {kind.__name__: s for kind, s in getattr(self.device_type, "late_s", {}).items()}
        framing = [kind.__name__ for kind in self.device_type.reassembler_type.__mro__[:-2]]
        default = DeviceProfile()
        choices = {
            key: value
            for key, value in vars(self.choices).items()
            if value != getattr(default, key, value)
        }
        bench = "bare bench" if self.is_bare else "full bench"
        return f"{self.target}, {bench}, {kinds}, {framing}, {self.timings}, {late_s}, {choices}"


def right_device(seed: int, *, at_limits: bool = False) -> RightDevice:
    """The device of that seed; with `at_limits` many of its times are at their limits, and it may
    have two banks.
    """
    chance = random.Random(f"right/{seed}")
    target = chance.choice(("bms", "bms", "bms", "bms", "wmc", "obc"))
    choices = _choices(chance)
    behaviours = [one for one in _BEHAVIOURS if chance.random() < 0.25]
    if at_limits:
        choices, more = _strained(choices, random.Random(f"limits/{seed}"))
        behaviours += more
    framings = [one for one in _FRAMINGS if chance.random() < 0.25]
    framing = type("Framing", (*(kind for kind, _ in framings), Reassembler), {})
    kinds = tuple(kind for kind, _ in behaviours if kind is not MockDevice)
    if {_ConfirmsUnknown, _ConfirmsAll} <= set(kinds):
        kinds = tuple(kind for kind in kinds if kind is not _ConfirmsUnknown)
    device_type = type("Right", (*kinds, MockDevice), {"reassembler_type": framing})
    timings = {
        "boot_version_spacing_s": round(chance.uniform(0.046, 0.054), 4),
        "inter_frame_timeout_s": round(chance.uniform(0.1, 0.18), 3),
    }
    if at_limits:
        spacing_s = random.Random(f"spacing/{seed}").choice((0.042, 0.05, 0.058))
        timings["boot_version_spacing_s"] = spacing_s
    fitting = dict(profile_of_mock(choices).given)
    for _, given in (*behaviours, *framings):
        fitting |= given
    fitting["limits.version_spacing_s"] = timings["boot_version_spacing_s"]
    nak_s = getattr(device_type, "late_s", {}).get(messages.Nak, 0.0)
    if choices.refused_hold_s - nak_s < _END_AGAIN_S:
        fitting["en_02"] = "either"
    sizes: dict[str, Value] = {
        "device.application_bytes": choices.application_area_bytes,
        "device.largest_image_bytes": choices.image_limit_bytes,
    }
    if choices.transfer_timeout_s < _LIMITS.pause_s:
        sizes["limits.pause_s"] = choices.transfer_timeout_s
    only_power = (choices.pause_in_transfer, choices.reset_in_transfer, choices.update_in_transfer)
    is_bare = chance.random() < 0.3 and only_power != ("waits", "ignored", "ignored")
    profiles = {
        "fitting": ConformanceProfile(fitting, source=f"device {seed}"),
        "default": ConformanceProfile(sizes, source="defaults"),
    }
    return RightDevice(seed, target, device_type, choices, timings, is_bare, profiles)


def _choices(chance: random.Random) -> DeviceProfile:
    """Choices of the device model, and times within the limits of the default profile."""
    page = chance.choice((1024, 2048, 4096))
    pages = chance.randint(-(-6 * 1024 // page), 40 * 1024 // page)
    erase_s = chance.choice((0.0, 0.01, 0.3, 3.0)) * chance.random()
    smallest, area = 1400, page * pages
    picked: dict[str, Any] = {
        "reset_in_bootloader": chance.choice(("ignored", "restarts")),
        "without_application": chance.choice(("announces", "listens")),
        "window_s": round(chance.uniform(0.06, 0.95), 3),
        "reset_delay_s": round(chance.choice((0.0, 0.05, 1.5)) * chance.random(), 3),
        "update_in_transfer": chance.choice(("starts_over", "ignored")),
        "bad_packet": chance.choice(("nak_expected", "nak_received", "silence")),
        "repeated_packet": chance.choice(("ack", "nak_next")),
        "older_packet": chance.choice(("ack", "nak", "silence")),
        "pause_in_transfer": chance.choice(("announces", "waits")),
        "transfer_timeout_s": round(chance.uniform(3.0, 15.0), 2),
        "reset_in_transfer": chance.choice(("ignored", "restarts")),
        "image_checksum": chance.choice(("none", "none", "crc32")),
        "repeated_end": chance.choice(("same_answer", "silence")),
        "refused_hold_s": round(chance.uniform(0.0, 1.5), 3),
        "after_complete": chance.choice(("starts", "restarts")),
        "start_delay_s": round(chance.choice((0.01, 0.1, 1.5)) * chance.random(), 3),
        "upgrade_in_application": chance.choice(("general_feedback", "silence")),
        "page_size_bytes": page,
        "application_area_bytes": area,
        "largest_image_bytes": chance.choice((None, chance.randint(smallest, area))),
        "program_unit_bytes": chance.choice((2, 4, 8, 16, 32)),
        "erased_pages": chance.choice(("needed", "all")),
        "erase_time_s": erase_s / pages,
        "program_time_s": chance.choice((0.0, 0.001, 0.02, 0.3)) * chance.random(),
        "boot_version": f"V{chance.randrange(10)}.{chance.randrange(10)}.{chance.randrange(10)}",
    }
    return DeviceProfile(**picked)


def _strained(
    choices: DeviceProfile, chance: random.Random
) -> tuple[DeviceProfile, list[tuple[type[MockDevice], dict[str, Value]]]]:
    """Put times of a device to the ends of the default profile's limits, and add what it may do."""

    def drawn(limit_s: float, used_s: float = 0.0) -> float:
        """Nothing, anything, or the limit but for the time of an answer on a loaded bus."""
        left_s = max(limit_s - used_s - _ON_BUS_S, 0.0)
        return round(chance.choice((0.0, chance.random() * left_s, left_s)), 4)

    bank = chance.choice((None, None, SwapsBanks, CopiesImage))
    pages = choices.application_area_bytes // choices.page_size_bytes
    packets = choices.application_area_bytes // 128
    program_s, erase_s = drawn(_LIMITS.ack_s), drawn(_LIMITS.erase_s)
    window_s = chance.choice((0.0525, 0.2, 0.995))
    burst_s = 3 * 0.058 + window_s
    copying_s = 0.0
    if bank is CopiesImage:  # twice: once more after the power was cut
        program_s, erase_s = min(program_s, 0.4 / packets), min(erase_s, 0.4)
        copying_s = erase_s + (packets + 3) * program_s + erase_s
    restarts = bank is CopiesImage or choices.after_complete == "restarts"
    start_s = drawn(_LIMITS.start_s, copying_s + (burst_s if restarts else 0.0))
    changed = dataclasses.replace(
        choices,
        window_s=window_s,
        reset_delay_s=drawn(_LIMITS.first_version_s, _LIMITS.feedback_s + copying_s),
        transfer_timeout_s=chance.choice((2.5, _LIMITS.pause_s, 9.0)),
        refused_hold_s=drawn(_LIMITS.refused_s),
        start_delay_s=start_s,
        after_complete="restarts" if restarts else "starts",
        erase_time_s=erase_s / (pages + 1),
        program_time_s=program_s,
    )
    late = answers_late(
        GeneralFeedbackMessage=drawn(_LIMITS.feedback_s),
        RequestTransfer=drawn(_LIMITS.erase_s, erase_s),
        Ack=drawn(_LIMITS.ack_s, program_s),
        # A refused image is reported before the restart.
        Nak=min(drawn(_LIMITS.ack_s), changed.refused_hold_s),
        Complete=drawn(_LIMITS.complete_s, program_s),
    )
    found: list[tuple[type[MockDevice], dict[str, Value]]] = [(late, {})]
    if chance.random() < 0.5:
        found.append((CountsFromPackets, {}))
    if chance.random() < 0.25:
        found.append((AsksBeyondTheEnd, {}))
    if bank is not None:
        found.append((bank, {"rs_03_old": "kept"}))
    return changed, found


def strained_device(seed: int) -> RightDevice:
    """The device of that seed with times at their limits."""
    return right_device(seed, at_limits=True)


# -- the run ---------------------------------------------------------------------------------------


def faults_of(
    seed: int,
    selection: Selection = Selection(),  # noqa: B008  frozen
    *,
    make: Callable[[int], RightDevice | RightCDevice] = right_device,
    steps: int = 0,
) -> list[str]:
    """What the suite, and `steps` of random walks, find wrong with the device of that seed. It is
    right, so anything found is a fault of the suite.
    """
    device = make(seed)
    found: list[str] = []
    for name, profile in device.profiles.items():
        with device.subject() as subject:
            report = run(subject, profile, selection=selection)
            explored = Explorer(subject, profile, seed=str(seed)).explore(steps) if steps else None
        found += [
            f"{seed} {name} {result.case_id} {result.verdict.value}: {result.reason}"
            for result in report.results
            if result.verdict not in HELD
        ]
        if report.final_image != "verified":
            found.append(f"{seed} {name}: the good image at the end: {report.final_image}")
        if explored is not None and (explored.finding or explored.stopped):
            finding = explored.finding
            text = f"{finding.text} ({' '.join(finding.steps)})" if finding else explored.stopped
            found.append(f"{seed} {name} explore: {text}")
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Run the suite on as many devices as asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=500, help="how many devices (500)")
    parser.add_argument("--seed", type=int, default=1, help="number of the first one (1)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--c", action="store_true", help="bootloaders in C, not the device model")
    parser.add_argument("--plain", action="store_true", help="no times at their limits")
    parser.add_argument("--steps", type=int, default=0, help="steps of random walks (0)")
    parser.add_argument("--cases", default="", help="only these cases, separated by commas")
    options = parser.parse_args(words)
    cases = tuple(filter(None, options.cases.split(",")))
    make: Callable[[int], RightDevice | RightCDevice] = strained_device
    if options.c or options.plain:
        make = right_c_device if options.c else right_device
    judge = partial(faults_of, selection=Selection(cases=cases), make=make, steps=options.steps)
    began, bad = time.perf_counter(), 0
    seeds = range(options.seed, options.seed + options.count)
    with ProcessPoolExecutor(options.jobs) as pool:
        for seed, faults in zip(seeds, pool.map(judge, seeds), strict=True):
            bad += bool(faults)
            if faults:
                sys.stdout.write("\n".join([*faults, f"  {make(seed)}", ""]))
            took_s = time.perf_counter() - began
            sys.stdout.write(f"up to seed {seed}: {bad} failed, {took_s:.0f} s\n")
            sys.stdout.flush()
    took_s = time.perf_counter() - began
    sys.stdout.write(
        f"{options.count} right devices, each by two profiles: {bad} failed, {took_s:.0f} s\n"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
