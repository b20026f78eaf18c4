"""Sweeps of simulated upgrades: each fault at each place of a short upgrade, not a sample of them.

A sweep has parts, each with its number of cases known before it runs. The places are those of the
upgrade without faults, which is played first: its frames, messages and flash operations. `limits`
has a plan just before, at and just after each time limit. `crc` plays nothing: `crc_errors` decides
for all errors of a few bits.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations, islice, product
from typing import Final

from flasher.bus.link import SEND_LIMIT_S
from flasher.driver import STALL_S
from flasher.host.duplicates import SECOND_DEVICE_WAIT_S
from flasher.host.options import (
    BRIEF_ADAPTER_RETURN_S,
    DEFAULT_ADAPTER_RETURN_S,
    OTHER_TOOL_QUIET_S,
)
from flasher.protocol.bittime import frame_bits
from flasher.protocol.frame import Frame
from flasher.protocol.spec import (
    BOOT_VERSION_BURST,
    FRAME_DATA_SIZE,
    MESSAGE_MAX_SIZE,
    OVERHEAD_SIZE,
    WELLING,
)
from flasher.protocol.timing import DEFAULT_TIMINGS
from flasher.simulate import plan as plans
from flasher.simulate.campaign import VIOLATIONS_MAX, Found
from flasher.simulate.crc_errors import ErrorsOfSize
from flasher.simulate.independent import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    END,
    FEEDBACK,
    GAP_LIMIT_S,
    PACKET,
    READ_VERSION,
    REQUEST,
    RESET,
    UPDATE,
    VERSION,
    Choices,
)
from flasher.simulate.oracle import Violation
from flasher.simulate.plan import Plan, When
from flasher.simulate.play import Player, play

JOB: Final = plans.Job(packets=4)
DEVICES: Final[Sequence[plans.Independent | plans.Mock]] = (plans.Independent(), plans.Mock())
DELAY_S: Final = 0.003
"""Delay of a frame: a few frames of the same message overtake it."""
BESIDE_S: Final = (-0.001, 0.0, 0.001)
"""Times beside a limit."""
_AFTER_S: Final = 1e-6
"""Time from the end of a flash operation to a power cut after it."""
_SECOND_CUT_FRAMES: Final = range(6, 138, 12)
"""Frames of the rescue in which the supply fails again, from the first cut on."""
_TWIN_JOB: Final = plans.Job(packets=120)
"""In a short transfer little shows that two devices take part."""
_TIMES: Final = DEFAULT_TIMINGS
_SESSION_S: Final = 5.0
"""Time after which both devices leave a transfer by default."""
_UNITS: Final[Mapping[str, str]] = {"restart": "reset_delay_s", "start": "start_delay_s"} | {
    "store": "program_time_s",
    "session": "transfer_timeout_s",
}
"""Choices of the independent device, and what `mock` calls them."""
Case = Plan | ErrorsOfSize


@dataclass(frozen=True)
class Part:
    """Part of a sweep."""

    name: str
    what: str
    """Sentence about what it tries."""
    count: int
    """Number of its cases."""
    cases: Callable[[], Iterator[Case]]
    """Plans, or errors of messages; each prints as the line that repeats it."""

    def taken(self, every: int) -> Part:
        """Return the part with every so many cases only."""
        return replace(
            self,
            count=len(range(0, self.count, every)),
            cases=lambda: islice(self.cases(), 0, None, every),
        )


@dataclass(frozen=True)
class PartResult:
    """Cases of a part that have run, and what they showed."""

    name: str
    runs: int
    endings: Mapping[str, int]
    """Number of plans by their ending; of `crc`, number of errors by what becomes of them."""
    violations: Sequence[Found]
    """With the number of the case in the place of a seed."""


def parts() -> Sequence[Part]:
    """Return the parts of the whole sweep."""
    sizes = _message_sizes()
    return [
        _part_of_plans(
            "frames",
            "Each frame is dropped, doubled, swapped, delayed, cut short, or has a wrong bit.",
            _count_frame_faults,
            _frame_plans,
        ),
        _part_of_plans(
            "pairs",
            "Two frames are dropped, doubled, swapped or delayed, in each combination.",
            lambda trace: len(_PAIRED) ** 2 * len(trace.frames) * (len(trace.frames) - 1) // 2,
            _pair_plans,
        ),
        _part_of_plans(
            "power",
            "The supply fails at each frame and flash operation, and again while the device is "
            "brought back: by the same run, by the same command after a kill, by rescue.",
            lambda trace: len(_cuts(trace)) * len(_RESCUES) * len(_second_cuts(trace, 0, 0)),
            _power_plans,
        ),
        _part_of_plans(
            "limits",
            "Each time limit of host and device is met 1 ms early, exactly, and 1 ms late.",
            lambda trace: len(BESIDE_S) * sum(1 for _ in limits(trace)),
            _limit_plans,
        ),
        Part(
            "crc",
            "All errors of 1, 2 and 3 bits and all bursts of up to 16 bits, for each size of a "
            "message.",
            len(sizes),
            lambda: map(ErrorsOfSize, sizes),
        ),
    ]


def run(
    part: Part,
    is_stopped: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda _runs, _violations: None,
    violations_max: int = VIOLATIONS_MAX,
) -> PartResult:
    """Run the cases of a part until it ends, is stopped, or has shown `violations_max` violations;
    `progress` gets the number of cases and of violations after each case.
    """
    endings: Counter[str] = Counter()
    found: list[Found] = []
    runs = 0
    for number, case in enumerate(part.cases()):
        if is_stopped() or len(found) >= violations_max:
            break
        counts, violations = _examine(case)
        endings.update(counts)
        found += (
            Found(number, each.kind, each.text, str(case))
            for each in violations
            if not each.is_excused
        )
        runs += 1
        progress(runs, len(found))
    return PartResult(part.name, runs, dict(sorted(endings.items())), tuple(found))


def _examine(case: Case) -> tuple[Mapping[str, int], Sequence[Violation]]:
    if isinstance(case, ErrorsOfSize):
        return case.examine()
    verdict = play(case)
    return {verdict.ending: 1}, verdict.violations


# -- the upgrade without faults --------------------------------------------------------------------


@dataclass(frozen=True)
class Span:
    """Message in a trace; `first` and `last` are numbers of frames, from 1, times are seconds."""

    sender: plans.Sender | None
    command: int
    first: int
    last: int
    begins: float
    """Begin of its first frame."""
    ends: float
    """End of its last frame."""


@dataclass(frozen=True)
class Trace:
    """Frames, messages and flash operations of a plan that was played."""

    device: plans.Independent | plans.Mock
    frames: Sequence[tuple[float, plans.Sender | None, Frame]]
    """Each with the time of its end, and its sender."""
    operations: Sequence[tuple[float, float]]
    """Begin and duration of each flash operation, in seconds."""
    messages: Sequence[Span]

    def of(self, command: int, turn: int = 0) -> Span:
        """Return a message; of several with the command, the one of this turn."""
        return [each for each in self.messages if each.command == command][turn]

    def plan(self, *clauses: plans.Clause, **choices: object) -> Plan:
        """Plan with the device of the trace and more of its choices, by the names of the
        independent device.
        """
        return Plan((JOB, chosen(self.device, **choices), *clauses))


def chosen(
    device: plans.Independent | plans.Mock, **choices: object
) -> plans.Independent | plans.Mock:
    """Return the device with more choices, by the names of the independent device."""
    if not choices:
        return device
    is_mock = isinstance(device, plans.Mock)
    words = (f"{_UNITS.get(key, key) if is_mock else key}={choices[key]}" for key in choices)
    return replace(device, choices=" ".join([*device.choices.split(), *words]))


@cache
def traced(device: plans.Independent | plans.Mock, *clauses: plans.Clause) -> Trace:
    """Play an upgrade of a device, usually without faults."""
    frames: list[tuple[float, plans.Sender | None, Frame]] = []
    operations: list[tuple[float, float]] = []

    def tap(frame: Frame, sender: plans.Sender | None, now: float) -> None:
        frames.append((now, sender, frame))

    player = Player(Plan((JOB, device, *clauses)), tap=tap)
    unit = player.units[0]

    def begun(_number: int, now: float) -> None:
        # A device that works on its flash has nothing else to do before the end of the operation.
        operations.append((now, (unit.deadline() or now) - now))

    unit.on_operation = begun
    player.play()
    return Trace(device, frames, operations, [*_messages(frames)])


def _messages(frames: Sequence[tuple[float, plans.Sender | None, Frame]]) -> Iterator[Span]:
    open_messages: dict[tuple[plans.Sender | None, int], tuple[int, int]] = {}
    """Per sender and CAN id, number of the first frame, and of the last."""
    for number, (now, sender, frame) in enumerate(frames, 1):
        if frame.data.startswith(b"\x55\xaa"):
            size = frame.data[3] + OVERHEAD_SIZE
            open_messages[sender, frame.can_id] = number, size
        first, size = open_messages.get((sender, frame.can_id), (0, 0))
        if first:
            size -= len(frame.data)
            open_messages[sender, frame.can_id] = first, size
            if size <= 0:
                del open_messages[sender, frame.can_id]
                began_at, _, head = frames[first - 1]
                command = int.from_bytes(head.data[4:6], "big")
                yield Span(sender, command, first, number, began_at - _frame_s(head), now)


def _frame_s(frame: Frame) -> float:
    return frame_bits(frame) / WELLING.bitrate_bps


def _message_sizes() -> Sequence[int]:
    """Sizes of all messages of an upgrade, in bytes, and of the largest that there is."""
    sizes = {MESSAGE_MAX_SIZE}
    for device in DEVICES:
        trace = traced(device)
        for each in trace.messages:
            sizes.add(
                sum(len(frame.data) for _, _, frame in trace.frames[each.first - 1 : each.last])
            )
    return sorted(sizes)


def _part_of_plans(
    name: str,
    what: str,
    count: Callable[[Trace], int],
    plans_of: Callable[[Trace], Iterator[Plan]],
) -> Part:
    def cases() -> Iterator[Plan]:
        for device in DEVICES:
            yield from plans_of(traced(device))

    return Part(name, what, sum(count(traced(device)) for device in DEVICES), cases)


# -- frames, and pairs of them ---------------------------------------------------------------------

_PAIRED: Final[Sequence[plans.OnFrames]] = (
    plans.Drop(),
    plans.Double(),
    plans.Swap(),
    plans.Delay(seconds=DELAY_S),
)


def _frame_faults(frame: Frame) -> Iterator[plans.OnFrames]:
    yield from _PAIRED
    for size in range(min(len(frame.data), FRAME_DATA_SIZE)):
        yield plans.Truncate(to=size)
    for bit in range(8 * len(frame.data)):
        yield plans.Flip(bit=bit)


def _count_frame_faults(trace: Trace) -> int:
    return sum(sum(1 for _ in _frame_faults(frame)) for _, _, frame in trace.frames)


def _frame_plans(trace: Trace) -> Iterator[Plan]:
    for number, (_, _, frame) in enumerate(trace.frames, 1):
        for fault in _frame_faults(frame):
            yield trace.plan(replace(fault, when=When("frame", number)))


def _pair_plans(trace: Trace) -> Iterator[Plan]:
    for one, other in combinations(range(1, len(trace.frames) + 1), 2):
        for fault, second in product(_PAIRED, _PAIRED):
            yield trace.plan(
                replace(fault, when=When("frame", one)), replace(second, when=When("frame", other))
            )


# -- the supply ------------------------------------------------------------------------------------

_RESCUES: Final[Sequence[plans.Kill | None]] = (None, plans.Kill(), plans.Kill(rescue=True))
"""Who brings the device back: the run itself, or what runs after a kill."""


@dataclass(frozen=True)
class _Cut:
    when: When
    frames: int
    """Frames up to it."""
    operations: int
    """Flash operations that have begun before it."""


def _cuts(trace: Trace) -> Sequence[_Cut]:
    """Moments of the first cut: before each frame is received (and so before what it causes), and
    at the begin, in and after each flash operation.
    """
    ends = [ended_at for ended_at, _, _ in trace.frames]
    cuts = [
        _Cut(When("frame", number), number, sum(begun < at for begun, _ in trace.operations))
        for number, at in enumerate(ends, 1)
    ]
    for number, (begun, took) in enumerate(trace.operations, 1):
        for plus in _in_operation(took):
            frames = sum(at <= begun + plus for at in ends)
            cuts.append(_Cut(When("flash", number, plus), frames, number))
    return cuts


def _in_operation(took_s: float) -> Sequence[float]:
    return 0.0, round(took_s / 2, 6), round(took_s + _AFTER_S, 6)


def _second_cuts(trace: Trace, frames: int, operations: int) -> Sequence[plans.Power | None]:
    cuts: list[plans.Power | None] = [None]
    for number, (_, took) in enumerate(trace.operations, operations + 1):
        cuts += (plans.Power(when=When("flash", number, plus)) for plus in _in_operation(took))
    cuts += (plans.Power(when=When("frame", frames + each)) for each in _SECOND_CUT_FRAMES)
    return cuts


def _power_plans(trace: Trace) -> Iterator[Plan]:
    for cut, rescue in product(_cuts(trace), _RESCUES):
        first = plans.Power(when=cut.when)
        kill = () if rescue is None else (replace(rescue, when=cut.when),)
        for second in _second_cuts(trace, cut.frames, cut.operations):
            yield trace.plan(first, *kill, *(() if second is None else (second,)))


# -- time limits -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limit:
    """Time limit, and the plan in which something happens so much later than it."""

    name: str
    """Field of `Timings`, or the constant."""
    plan: Callable[[float], Plan]


def _limit_plans(trace: Trace) -> Iterator[Plan]:
    for limit in limits(trace):
        for beside in BESIDE_S:
            yield limit.plan(beside)


def limits(trace: Trace) -> Iterator[Limit]:
    yield from _late_answers(trace)
    yield from _slow_devices(trace)
    yield from _late_boot_versions(trace)
    yield from _late_frames(trace)
    yield from _around_the_host(trace)
    if isinstance(trace.device, plans.Independent):
        yield from _choices_of_the_independent(trace)


def _s(seconds: float) -> float:
    """Time as a plan prints it, in nanoseconds."""
    return round(seconds, 9)


def _late_answers(trace: Trace) -> Iterator[Limit]:
    """The answer to a message of the host arrives at the limit, counted from the end of the
    message.
    """

    def late(question: Span, answer: Span, limit_s: float) -> plans.Answer:
        when = When("frame", question.last)
        return plans.Answer(when=when, late=_s(limit_s - (answer.ends - question.ends)))

    def limit(
        name: str,
        question: Span,
        answer: Span,
        limit_s: float,
        *more: plans.Clause,
        **choices: object,
    ) -> Limit:
        return Limit(
            name,
            lambda beside: trace.plan(late(question, answer, limit_s + beside), *more, **choices),
        )

    reset, feedback = trace.of(RESET), trace.of(FEEDBACK)
    repeat_s, timeout_s = _TIMES.command_repeat_s, _TIMES.command_timeout_s
    for turn in range(1, round(timeout_s / repeat_s)):
        yield limit("command_repeat_s", reset, feedback, turn * repeat_s, restart=2.0)
    yield limit("command_timeout_s", reset, feedback, timeout_s, restart=2.0)
    for turn in range(sum(each.command == READ_VERSION for each in trace.messages)):
        query, answer = trace.of(READ_VERSION, turn), trace.of(VERSION, turn)
        silent = plans.Answer(when=When("frame", query.last), becomes="silence", count=4)
        yield limit("command_repeat_s", query, answer, repeat_s)
        yield limit("command_timeout_s", query, answer, timeout_s, silent)
    request_s, complete_s = _TIMES.request_transfer_timeout_s, _TIMES.complete_timeout_s
    yield limit(
        "request_transfer_timeout_s",
        trace.of(UPDATE),
        trace.of(REQUEST),
        request_s,
        **_stays(trace),
    )
    for turn in range(JOB.packets):
        packet, ack = trace.of(PACKET, turn), trace.of(ACK, turn)
        yield limit("ack_timeout_s", packet, ack, _TIMES.ack_timeout_s)
        # An ACK while the packet is sent again; the answer to the repetition at the limit.
        first = late(packet, ack, _TIMES.ack_timeout_s + 0.002)
        quiet_s = _TIMES.quiet_after_repeat_s - (ack.ends - ack.begins)
        yield Limit(
            "quiet_after_repeat_s",
            lambda beside, first=first, quiet_s=quiet_s: trace.plan(  # type: ignore[misc]
                first, replace(first, late=_s(quiet_s + beside))
            ),
        )
    silence = (
        {"repeated_end": "silence"}
        if isinstance(trace.device, plans.Mock)
        else {"end_again": "silent"}
    )
    for turn in range(1, _TIMES.end_tries + 1):
        end, complete = trace.of(END), trace.of(COMPLETE)
        yield limit("complete_timeout_s", end, complete, turn * complete_s, **silence)


def _slow_devices(trace: Trace) -> Iterator[Limit]:
    """The device itself is as slow as the limit, or as quick to leave a transfer."""

    def limit(name: str, choice: str, seconds: float, *clauses: plans.Clause) -> Limit:
        return Limit(name, lambda beside: trace.plan(*clauses, **{choice: _s(seconds + beside)}))

    boot, complete, end = trace.of(BOOT_VERSION), trace.of(COMPLETE), trace.of(END)
    for since in (trace.of(RESET), trace.of(FEEDBACK)):
        restart_s = 0.05 + _TIMES.boot_version_timeout_s - (boot.ends - since.ends)
        yield limit("boot_version_timeout_s", "restart", restart_s)
    packet, ack = trace.of(PACKET), trace.of(ACK)
    store_s = _TIMES.ack_timeout_s - (ack.ends - ack.begins)
    yield limit("ack_timeout_s", "store", store_s)
    # The application is deaf so long once; one that is always that slow cannot be verified.
    start_s = _TIMES.application_start_timeout_s
    done = When("frame", complete.last)
    deaf = traced(trace.device, plans.Hang(when=done, seconds=2 * start_s))
    last_asked_s = max(
        each.ends - complete.ends
        for each in deaf.messages
        if each.command == READ_VERSION and each.begins < complete.ends + start_s
    )
    for deaf_s in (start_s, last_asked_s):
        yield Limit(
            "application_start_timeout_s",
            lambda beside, deaf_s=deaf_s: trace.plan(  # type: ignore[misc]
                plans.Hang(when=done, seconds=_s(deaf_s + beside))
            ),
        )
    # Without a final answer, the host asks for the version after its last end of transfer.
    tries, sent_s = _TIMES.end_tries, end.ends - end.begins
    asked_at = end.ends + tries * _TIMES.complete_timeout_s + (tries - 1) * sent_s
    silent = plans.Answer(when=When("end"), becomes="silence")
    unheard = When("end", 0, _s(complete.ends - end.ends))
    yield Limit(
        "application_start_timeout_s",
        lambda beside: trace.plan(
            silent,
            plans.Hang(when=unheard, seconds=_s(asked_at + start_s - complete.ends + beside)),
        ),
    )
    # The host pauses in a transfer for as long as the device waits.
    packet, ack, following = trace.of(PACKET, 1), trace.of(ACK, 1), trace.of(PACKET, 2)
    paused_at = trace.frames[packet.first - 1][0]
    pause_s = ack.begins + _SESSION_S - paused_at - (following.ends - ack.ends)
    yield Limit(
        "session",
        lambda beside: trace.plan(
            plans.Stall(when=When("packet", 2), seconds=_s(pause_s + beside))
        ),
    )
    # After a kill, the device leaves its transfer when the next run asks into the silence.
    kill = plans.Kill(when=When("packet", 3))
    killed = traced(chosen(trace.device, **_stays(trace)), kill)
    asked = killed.of(UPDATE, 1)
    heard_at = max(
        each.begins for each in killed.messages if each.command == ACK and each.ends < asked.begins
    )
    # The independent device restarts, the other announces itself at once.
    restart_s = 0.05 if isinstance(trace.device, plans.Independent) else 0.0
    session_s = asked.begins - heard_at - restart_s - (boot.ends - boot.begins)
    yield limit("request_transfer_timeout_s", "session", session_s, kill)


def _stays(trace: Trace) -> Mapping[str, object]:
    """Choices of a device that never leaves a transfer."""
    is_mock = isinstance(trace.device, plans.Mock)
    return {"pause_in_transfer": "waits"} if is_mock else {"session": 0.0}


def _late_boot_versions(trace: Trace) -> Iterator[Limit]:
    """A boot version that nobody sent arrives at the limit."""
    boot, update, request = trace.of(BOOT_VERSION), trace.of(UPDATE), trace.of(REQUEST)
    wire_s = boot.ends - boot.begins

    def after(what: Span, seconds: float) -> plans.Clause:
        """A boot version that ends so much later than a message."""
        when = When("frame", what.last, _s(seconds - wire_s))
        return plans.Unsolicited(when=when, what="boot")

    for name, what, limit_s in (
        ("boot_watch_s", boot, _TIMES.boot_watch_s),
        ("boot_version_spacing_s", boot, _TIMES.boot_version_spacing_s),
        ("update_spacing_s", update, _TIMES.update_spacing_s),
        ("leftover_boot_version_s", request, _TIMES.leftover_boot_version_s),
    ):
        yield Limit(
            name,
            lambda beside, what=what, limit_s=limit_s: trace.plan(after(what, limit_s + beside)),  # type: ignore[misc]
        )
    end = trace.of(END)
    silent = plans.Answer(when=When("end"), becomes="silence")
    on_s, burst_s = _TIMES.announcing_on_s, _TIMES.burst_s
    series = [after(end, _s(0.3 + 0.1 * turn)) for turn in range(round(on_s / 0.1))]
    yield Limit(
        "announcing_on_s",
        lambda beside: trace.plan(silent, *series, after(end, 0.3 + on_s + beside), start=3.0),
    )
    yield Limit(
        "end of a burst",
        lambda beside: trace.plan(
            silent, after(end, 0.3), after(end, 0.3 + burst_s + beside), start=3.0
        ),
    )


def _late_frames(trace: Trace) -> Iterator[Limit]:
    """The last frame of a message arrives at the limit after the one before it, of both sides."""
    if _TIMES.inter_frame_timeout_s != GAP_LIMIT_S:
        raise ValueError("host and independent device differ in the time between frames")
    for each in trace.messages:
        apart_s = trace.frames[each.last - 1][0] - trace.frames[each.last - 2][0]
        when = When("frame", each.last)
        yield Limit(
            "inter_frame_timeout_s",
            lambda beside, when=when, apart_s=apart_s: trace.plan(  # type: ignore[misc]
                plans.Delay(when=when, seconds=_s(GAP_LIMIT_S - apart_s + beside))
            ),
        )


def _around_the_host(trace: Trace) -> Iterator[Limit]:
    """Adapter, computer, other tools and the deadline."""

    def limit(name: str, seconds: float, make: Callable[[float], plans.Clause]) -> Limit:
        return Limit(name, lambda beside: trace.plan(make(_s(seconds + beside))))

    moments = [When("reset"), When("update"), When("packet", 2), When("end")]
    for when in moments:
        yield limit(
            "DEFAULT_ADAPTER_RETURN_S",
            DEFAULT_ADAPTER_RETURN_S,
            lambda seconds, when=when: plans.Unplug(when=when, seconds=seconds),  # type: ignore[misc]
        )
        yield limit(
            "STALL_S",
            STALL_S,
            lambda seconds, when=when: plans.Stall(when=when, seconds=seconds),  # type: ignore[misc]
        )
    before = When(plus_s=0.05)
    brief_s = BRIEF_ADAPTER_RETURN_S
    yield limit("BRIEF_ADAPTER_RETURN_S", brief_s, lambda s: plans.Unplug(when=before, seconds=s))
    yield limit("BRIEF_ADAPTER_RETURN_S", brief_s, lambda s: plans.BusOff(when=before, seconds=s))
    wrote = traced(trace.device, plans.Tool(when=When("packet", 2), does="writes"))
    written = next(each for each in wrote.messages if each.sender is None)
    between_s = written.ends - wrote.frames[written.first - 1][0]
    yield limit(
        "OTHER_TOOL_QUIET_S",
        OTHER_TOOL_QUIET_S + between_s,
        lambda s: plans.Tool(when=When("packet", 2), does="writes", count=2, every=s),
    )
    full = plans.Load(id=0)
    every_s = _s(_frame_s(Frame(full.id, b"\x33" * FRAME_DATA_SIZE)))
    yield Limit(
        "SEND_LIMIT_S",
        lambda beside: trace.plan(
            plans.Adapter(queue=1),
            replace(full, when=When("packet", 2), every=every_s, seconds=SEND_LIMIT_S + beside),
        ),
    )
    for what in (trace.of(ACK, 1), trace.of(COMPLETE)):
        yield Limit(
            "timeout_s",
            lambda beside, what=what: Plan(
                (replace(JOB, timeout=_s(what.ends + beside)), trace.device)
            ),  # type: ignore[misc]
        )
    for name, late_s in (
        ("SECOND_DEVICE_WAIT_S", SECOND_DEVICE_WAIT_S),
        ("boot_watch_s", _TIMES.boot_watch_s),
    ):
        yield Limit(
            name,
            lambda beside, late_s=late_s: Plan(  # type: ignore[misc]
                (
                    _TWIN_JOB,
                    trace.device,
                    plans.Independent(choices=f"late={_s(late_s + beside)}"),
                )
            ),
        )


def _choices_of_the_independent(trace: Trace) -> Iterator[Limit]:
    """Times that only the independent device lets choose."""
    complete = trace.of(COMPLETE)
    check_s = _TIMES.complete_timeout_s - (complete.ends - complete.begins)
    yield Limit("complete_timeout_s", lambda beside: trace.plan(check=_s(check_s + beside)))
    spacing_s = _TIMES.boot_version_spacing_s
    yield Limit("boot_version_spacing_s", lambda beside: trace.plan(spacing=_s(spacing_s + beside)))
    # The host pauses until the window closes in which the device takes an update command.
    after_burst = {"listens": "after_burst"}
    listening = traced(chosen(trace.device, **after_burst))
    last_boot, update = listening.of(BOOT_VERSION, BOOT_VERSION_BURST - 1), listening.of(UPDATE, -1)
    pause_s = Choices().window - (update.ends - last_boot.begins)
    yield Limit(
        "window",
        lambda beside: trace.plan(
            plans.Stall(when=When("frame", last_boot.last), seconds=_s(pause_s + beside)),
            **after_burst,
        ),
    )
