"""Writes a failed check as a unit test in C against `flasher_dut.h`, with as few frames as show it.

The frames of the trace are played to the bootloader again, and messages left out as long as it
still fails and the device model, which is right, does what was expected.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from string import Template
from typing import Final

from flasher.conformance.bench import Bench
from flasher.conformance.dut.subject import CompiledSubject
from flasher.conformance.mock import MockSubject, model_of_profile
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.replay import Player
from flasher.conformance.restore import restore
from flasher.conformance.results import (
    CaseResult,
    DeviceCrashed,
    ExploreResult,
    TraceEntry,
)
from flasher.conformance.shrink import shrink
from flasher.conformance.subject import Subject
from flasher.conformance.waits import Waits
from flasher.conformance.wire import (
    ACK,
    BOOT_VERSION,
    COMPLETE,
    NAK,
    REPORT,
    REQUEST,
    DeviceDecoder,
    Encoder,
    RawFrame,
    Received,
    Reply,
    joined,
)
from flasher.errors import UsageError

_TRIES: Final = 80
_RESETS_TRIED: Final = 3
_BURST_S: Final = 0.002
"""Frames sent within this time belong to one message."""
_AFTER_S: Final = 0.02
"""An answer this soon after the check belongs to it."""
_FIRST_S: Final = 0.001
_US: Final = 1_000_000
_COMMANDS: Final = {
    Reply.BOOT_VERSION.value: BOOT_VERSION,
    Reply.REQUEST.value: REQUEST,
    Reply.ACK.value: ACK,
    Reply.NAK.value: NAK,
    Reply.COMPLETE.value: COMPLETE,
}
_SILENCE: Final = frozenset(("silence", "no answer"))
_IMAGE: Final = re.compile(r"the flash holds the image|(the )?application .*runs")
_NO_ANSWER: Final = re.compile(r"no (.+) within [0-9.]+ s after")
_OF_APPLICATION: Final = frozenset(
    {Reply.FEEDBACK, Reply.VERSION_INFORMATION, Reply.MEMORY, Reply.APPLICATION}
)
_LINE_BYTES: Final = 16
_BEGINNING_BYTES: Final = 32
_ERASED_BYTES: Final = 32
"""So many erased bytes in a row are left out of the flash."""


class NotExportableError(UsageError):
    """What failed cannot be written as a test in C; the text says why."""


@dataclass(frozen=True)
class Demand:
    """What the device has to do after the last frame; `text` is for the reader."""

    text: str
    wait_s: float
    allowed: tuple[bytes, ...] = ()
    """Beginnings of the first answer, one of them required; empty bytes allow silence."""
    forbidden: tuple[bytes, ...] = ()
    """Beginnings of messages that must not come."""
    image: bytes | None = None
    """What the flash has to hold and to run."""


@dataclass(frozen=True)
class Stimulus:
    """Frames that were sent in a row `gap_s` after those before, and what was received then."""

    gap_s: float
    frames: tuple[TraceEntry, ...]
    answers: tuple[TraceEntry, ...]


@dataclass(frozen=True)
class ExportedTest:
    """A test in C, with its number of messages to the device and of their frames."""

    code: bytes
    messages: int
    frames: int


def export_case(
    result: CaseResult,
    title: str,
    subject: Subject,
    profile: ConformanceProfile,
    *,
    stopped: Callable[[], bool],
) -> ExportedTest:
    """Write the first failed check of a case. Raises NotExportableError, RunStopped, BusError."""
    check = result.first_failure
    if check is None:
        raise NotExportableError(f"{result.case_id} has no failed check.")
    if result.trace_dropped:
        raise NotExportableError(f"{result.case_id} has more frames than its trace keeps.")
    trace = [
        entry
        for entry in result.trace
        if entry.at_s <= check.at_s + (0.0 if entry.sent else _AFTER_S)
    ]
    demand = _demand(check.expected, check.got, check.at_s, trace, subject, profile)
    heading = f"{result.case_id} {title}"
    step = f"{check.step}: " if check.step else ""
    return _Exporter(subject, profile, stopped).export(
        heading, f"{step}expected {check.expected}; got {check.got}", trace, demand
    )


def export_walk(
    explored: ExploreResult,
    subject: Subject,
    profile: ConformanceProfile,
    *,
    stopped: Callable[[], bool],
) -> ExportedTest:
    """Write the finding of a walk. Raises NotExportableError, RunStopped, BusError."""
    finding = explored.finding
    if finding is None or not finding.trace:
        raise NotExportableError("The walk found nothing.")
    trace, expected = list(finding.trace), finding.text
    encoder = Encoder(subject.target)
    wrong = [one.at for one in _decoded(trace, encoder) if _is_named(str(one), finding.text)]
    if wrong:  # it may be judged after the next frames
        trace = [entry for entry in trace if entry.at_s <= wrong[-1]]
    if missing := _NO_ANSWER.match(finding.text):
        expected = missing[1]
    if finding.rule == "crash":
        expected = "the case is completed"
    demand = _demand(expected, finding.text, trace[-1].at_s, trace, subject, profile)
    heading = f"walk: {' '.join(finding.steps)}"
    return _Exporter(subject, profile, stopped).export(heading, finding.text, trace, demand)


# -- what is expected ------------------------------------------------------------------------------


def _demand(
    expected: str,
    got: str,
    at_s: float,
    trace: Sequence[TraceEntry],
    subject: Subject,
    profile: ConformanceProfile,
) -> Demand:
    """Derive what the device has to do from the texts of a check. Raises NotExportableError."""
    sent_at = max((entry.at_s for entry in trace if entry.sent), default=at_s)
    waited_s = max(at_s - sent_at, 0.0) + _AFTER_S
    patience_s = Waits(profile, subject.port.bitrate_bps).answer_s
    encoder = Encoder(subject.target)
    if got.startswith("the device stopped"):
        return Demand("the bootloader goes on", patience_s)
    if _IMAGE.fullmatch(expected):
        image = _sent_image(trace, subject, encoder)
        return Demand(expected, waited_s + profile.limit("start_s"), image=image)
    words = re.split(" or |, ", expected.removeprefix("rejected: "))
    allowed = [_beginning(word) for word in words]
    if None not in allowed:
        beginnings = tuple(word for word in allowed if word is not None)
        wait_s = waited_s if b"" in beginnings else max(waited_s, patience_s)
        return Demand(expected, wait_s, allowed=beginnings)
    wrong = [one for one in _answers(trace, sent_at, encoder) if _is_named(str(one), got)]
    if not wrong:
        raise NotExportableError(
            f"No test can be made of this check: {expected}.",
            cause="it is neither about an answer to a message nor about the image",
        )
    return Demand(
        f"not {', '.join(map(str, wrong))}",
        waited_s,
        forbidden=tuple(one.raw for one in wrong),
    )


def _is_named(text: str, got: str) -> bool:
    return re.search(rf"(?<!\w){re.escape(text)}(?!\w)", got) is not None


def _beginning(word: str) -> bytes | None:
    """Beginning of the message that this word of a report means; None for another word."""
    if word in _SILENCE:
        return b""
    name, _, number = word.rpartition(" ")
    if not number.isdigit():
        name, number = word, ""
    command = _COMMANDS.get(name)
    if command is None:
        return None
    head = bytes((0x55, 0xAA, REPORT, 2 + (command & 0xFF))) + command.to_bytes(2, "big")
    return head + (int(number).to_bytes(2, "little") if number else b"")


def _answers(entries: Sequence[TraceEntry], after_s: float, encoder: Encoder) -> list[Received]:
    """Messages of the bootloader that ended after this time."""
    return [
        one
        for one in _decoded(entries, encoder)
        if one.at > after_s and one.can_id == encoder.to_tool and one.kind not in _OF_APPLICATION
    ]


def _decoded(entries: Sequence[TraceEntry], encoder: Encoder) -> Iterator[Received]:
    decoder = DeviceDecoder(encoder)
    for entry in entries:
        if not entry.sent:
            yield from decoder.feed(entry.frame, entry.at_s)


def _sent_image(trace: Sequence[TraceEntry], subject: Subject, encoder: Encoder) -> bytes:
    """The image whose update command was sent last, else the good one."""
    sent = b"".join(
        entry.frame.data
        for entry in trace
        if entry.sent and entry.frame.can_id == encoder.to_device
    )
    good, second, sizes = subject.firmware
    known = (subject.second_image, subject.good_image, good, second, *sizes)
    images = [image for image in known if image is not None]
    places = {
        image: sent.rfind(b"".join(frame.data for frame in encoder.update(len(image))))
        for image in images
    }
    last = max(images, key=lambda image: places[image])
    return last if places[last] >= 0 else subject.good_image


# -- the fewest messages ---------------------------------------------------------------------------


def _stimuli(trace: Sequence[TraceEntry]) -> list[Stimulus]:
    found: list[tuple[float, list[TraceEntry], list[TraceEntry]]] = []
    last_at = trace[0].at_s - _FIRST_S if trace else 0.0
    for entry in trace:
        if not entry.sent:
            if found:
                found[-1][2].append(entry)
            continue
        frame = entry.frame
        begins = frame.is_payload and frame.data.startswith(b"\x55\xaa")
        if not found or begins or entry.at_s - last_at > _BURST_S:
            found.append((entry.at_s - last_at, [], []))
        found[-1][1].append(entry)
        found[-1][2].clear()  # an answer to a part of a message is not awaited
        last_at = entry.at_s
    return [Stimulus(gap_s, tuple(sent), tuple(received)) for gap_s, sent, received in found]


def _entries(stimuli: Sequence[Stimulus]) -> list[TraceEntry]:
    """The trace of these stimuli, one after another."""
    found: list[TraceEntry] = []
    at_s = 0.0
    for one in stimuli:
        later_s = at_s + one.gap_s - one.frames[0].at_s
        found += [each._replace(at_s=each.at_s + later_s) for each in (*one.frames, *one.answers)]
        at_s = one.frames[-1].at_s + later_s
    return found


class _Exporter:
    """Plays frames to a bootloader and to the device model, and writes the test."""

    def __init__(
        self, subject: Subject, profile: ConformanceProfile, stopped: Callable[[], bool]
    ) -> None:
        if not isinstance(subject, CompiledSubject):
            raise NotExportableError(
                "Only a bootloader that is compiled for the computer can have a test in C.",
                remedy="Give it with --subject; see `flasher conformance header`.",
            )
        self._subject = subject
        self._profile = profile
        self._stopped = stopped
        self._encoder = Encoder(subject.target)
        self._patience_s = Waits(profile, subject.port.bitrate_bps).answer_s
        self._model = MockSubject(
            subject.target,
            profile=model_of_profile(profile),
            good_image=subject.good_image,
            second_image=subject.second_image,
        )

    def export(
        self, heading: str, finding: str, trace: Sequence[TraceEntry], demand: Demand
    ) -> ExportedTest:
        stimuli = _stimuli(trace)
        if not stimuli or self._meets(self._subject, stimuli, demand):
            raise NotExportableError(
                "The frames alone do not show what failed.",
                cause="it needs a power cut, a fault of the bus or the flash, or an exact time",
            )
        if not self._meets(self._model, stimuli, demand):
            raise NotExportableError(
                "No right device is known that the test could be tried with.",
                cause="the device model does not do what was expected after these frames: the "
                "profile states a choice that the model does not have, or their times matter",
            )
        stimuli = shrink(
            self._since_reset(stimuli, demand),
            lambda fewer: fewer if fewer and self._shows(fewer, demand) else None,
            tries=_TRIES,
        )
        restore(self._subject, self._profile, flash=True, stopped=self._stopped)
        frames = sum(len(one.frames) for one in stimuli)
        code = self._code(heading, finding, stimuli, demand)
        return ExportedTest(code, len(stimuli), frames)

    def _since_reset(self, stimuli: Sequence[Stimulus], demand: Demand) -> Sequence[Stimulus]:
        """What follows one of the last resets, if that shows it: far fewer frames to shrink."""
        reset = joined(self._encoder.reset())
        begins = [
            index
            for index, one in enumerate(stimuli)
            if joined(entry.frame for entry in one.frames) == reset
        ]
        latest = (stimuli[index:] for index in reversed(begins[-_RESETS_TRIED:]))
        return next((fewer for fewer in latest if self._shows(fewer, demand)), stimuli)

    def _shows(self, stimuli: Sequence[Stimulus], demand: Demand) -> bool:
        # The model first: it needs no process, and does not meet most shorter sequences.
        return self._meets(self._model, stimuli, demand) and not self._meets(
            self._subject, stimuli, demand
        )

    def _meets(self, subject: Subject, stimuli: Sequence[Stimulus], demand: Demand) -> bool:
        """Play the stimuli to a device that runs the good image."""
        done = restore(subject, self._profile, flash=True, stopped=self._stopped)
        if not done.ok:
            raise NotExportableError(
                "The device could not be brought back to play the frames again.", cause=done.reason
            )
        player = Player(subject, self._patience_s, self._stopped)
        try:
            player.play(_entries(stimuli), demand.wait_s)
        except DeviceCrashed:
            return False
        answers = _answers(player.answers, player.sent_at, self._encoder)
        if any(one.raw.startswith(demand.forbidden) for one in answers):
            return False
        if demand.allowed:
            wanted = tuple(filter(None, demand.allowed))
            if not answers:
                return b"" in demand.allowed
            return bool(wanted) and answers[0].raw.startswith(wanted)
        if demand.image is None:
            return True
        bench = Bench(subject, self._profile, limit_s=self._patience_s + 60.0)
        stored = subject.readback()[: len(demand.image)]
        return stored == demand.image and bench.application_runs()

    # -- the code ---------------------------------------------------------------------------------

    def _code(
        self, heading: str, finding: str, stimuli: Sequence[Stimulus], demand: Demand
    ) -> bytes:
        """Fill in the template for the device as it is now, which runs the good image."""
        device = self._subject.device
        content = device.flash.read(device.flash.start, device.facts.flash_bytes)
        parts = list(_parts(content))
        names = [f"flash_{number}" for number in range(len(parts))]
        checks_started = not (demand.image or demand.allowed or demand.forbidden)
        image = demand.image or b"\0"
        if checks_started:
            image = _sent_image(_entries(stimuli), self._subject, self._encoder)
        template = resources.files("flasher.conformance.dut") / "exported_test.c"
        filled = Template(template.read_text("utf-8")).substitute(
            heading=_comment(heading),
            finding=_comment(finding),
            expected=_c_text(demand.text),
            answer_id=f"0x{self._encoder.to_tool:03X}",
            bitrate_bps=self._subject.port.bitrate_bps,
            flash_bytes=device.facts.flash_bytes,
            patience_us=round(self._patience_s * _US),
            wait_us=round(demand.wait_s * _US),
            checks_image=int(demand.image is not None),
            checks_started=int(checks_started),
            beginning_bytes=_BEGINNING_BYTES,
            allowed=_beginnings(demand.allowed),
            forbidden=_beginnings(demand.forbidden),
            image=_bytes(image),
            old_image=_bytes(self._subject.good_image if checks_started else b"\0"),
            flash="".join(
                f"static const uint8_t {name}[] = {{\n{_bytes(part)}\n}};\n\n"
                for name, (_, part) in zip(names, parts, strict=True)
            ),
            flash_parts="\n".join(
                f"    {{0x{offset:X}, {len(part)}, {name}}},"
                for name, (offset, part) in zip(names, parts, strict=True)
            ),
            steps="\n".join(self._steps(stimuli)),
        )
        return filled.encode("ascii", "backslashreplace")

    def _steps(self, stimuli: Sequence[Stimulus]) -> Iterator[str]:
        """A line for each frame, and a comment for what the device answered."""
        reset = [frame.data for frame in self._encoder.reset()]
        awaited, last_at = 0, 0.0
        for one in stimuli:
            is_reset = [entry.frame.data for entry in one.frames] == reset
            for index, entry in enumerate(one.frames):
                after_s = entry.at_s - last_at if index else one.gap_s
                last_at = entry.at_s
                is_last = index == len(one.frames) - 1
                line = f"{max(round(after_s * _US), 1)}, {awaited}, {int(is_reset and is_last)}"
                yield f"    {{{line}, {_frame(entry.frame)}}},"
                awaited = 0
            seen = [
                each for each in _decoded(one.answers, self._encoder)
                if each.can_id == self._encoder.to_tool
            ]  # fmt: skip
            awaited = sum(each.kind is not Reply.VERSION_INFORMATION for each in seen)
            if seen and one is not stimuli[-1]:
                yield f"    /* {_comment(', '.join(map(str, seen)))} */"


def _frame(frame: RawFrame) -> str:
    flags = f"{int(frame.is_extended)}, {int(frame.is_remote)}, 0"
    return f"{{0x{frame.can_id:03X}, {len(frame.data)}, {flags}, {_braced(frame.data)}}}"


def _braced(data: bytes) -> str:
    return f"{{{', '.join(f'0x{byte:02X}' for byte in data) or '0'}}}"


def _beginnings(found: Sequence[bytes]) -> str:
    cut = [each[:_BEGINNING_BYTES] for each in found]
    lines = [f"    {{{len(each)}, {_braced(each)}}}," for each in cut]
    return "\n".join([*lines, "    {NONE, {0}},"])


def _bytes(content: bytes) -> str:
    return "\n".join(
        "    " + " ".join(f"0x{byte:02X}," for byte in content[at : at + _LINE_BYTES])
        for at in range(0, len(content), _LINE_BYTES)
    )


def _parts(flash: bytes) -> Iterator[tuple[int, bytes]]:
    """Offset and content of each part of the flash between erased ones."""
    pattern = rb"[^\xff](?:\xff{0,%d}[^\xff])*" % (_ERASED_BYTES - 1)
    for found in re.finditer(pattern, flash, re.DOTALL):
        yield found.start(), found[0]


def _c_text(text: str) -> str:
    escaped = text.encode("ascii", "backslashreplace").decode("ascii")
    return '"' + escaped.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _comment(text: str) -> str:
    return text.replace("*/", "* /").replace("/*", "/ *")
