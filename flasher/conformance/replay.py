"""Replays a recorded trace against a device, and compares what the device answers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from itertools import groupby
from typing import Final

from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.restore import restore
from flasher.conformance.results import DeviceCrashed, RunStopped, TraceEntry
from flasher.conformance.subject import Subject
from flasher.conformance.trace_excerpt import decoded_rows
from flasher.conformance.waits import Waits
from flasher.conformance.wire import RawFrame
from flasher.errors import UsageError
from flasher.protocol.frame import Frame
from flasher.protocol.spec import TARGETS, Node, Target, can_id
from flasher.trace.decoder import Decoder

_TAIL_S: Final = 1.0
"""Time after the last frame in which answers still count."""
_POLL_S: Final = 0.2


@dataclass(frozen=True)
class ReplayDifference:
    """A place at which the device did not answer as in the trace; one side may be empty."""

    recorded: tuple[str, ...]
    answered: tuple[str, ...]


@dataclass(frozen=True)
class ReplayResult:
    """A replayed trace."""

    subject: str
    frames_sent: int
    messages_recorded: int
    """Messages of the device in the trace; equal ones in a row count once."""
    differences: tuple[ReplayDifference, ...]
    trouble: str = ""
    """Why the comparison is not whole: the good image could not be flashed, the device or the user
    stopped; empty for none."""


def recording(frames: Iterable[tuple[float, Frame]], target: Target) -> list[TraceEntry]:
    """Select the frames to the device, and those of its messages. Raises UsageError for a trace
    that has nothing to send or nothing to compare.
    """
    answer_ids = _answer_ids(target)
    recorded = [
        TraceEntry(at_s, frame.can_id == target.request_id, RawFrame(*frame[:5]))
        for at_s, frame in frames
        if frame.can_id == target.request_id or (frame.is_payload and frame.can_id in answer_ids)
    ]
    if not any(entry.sent for entry in recorded):
        raise UsageError(
            f"The trace has no frame to the {target.node.name}.",
            remedy="Name the target with -t, or another trace.",
        )
    if not _messages(recorded):
        raise UsageError(
            f"The trace has no message of the {target.node.name}: there is nothing to compare.",
            cause="only the tool was recorded, or the device was silent",
        )
    return recorded


def replay(
    subject: Subject,
    profile: ConformanceProfile,
    recorded: Sequence[TraceEntry],
    *,
    stopped: Callable[[], bool] = lambda: False,
) -> ReplayResult:
    """Flash the good image, send the tool's frames of a `recording` again at their times, and
    compare the device's messages. The good image is flashed again at the end, also after a stop.
    Raises BusError.
    """
    player = Player(subject, Waits(profile, subject.port.bitrate_bps).answer_s, stopped)
    trouble = ""
    try:
        done = restore(subject, profile, flash=True, stopped=stopped)
        if done.ok:
            player.play(recorded)
        else:
            trouble = f"the good image could not be flashed first: {done.reason}"
    except RunStopped:
        trouble = "it was stopped"
    except DeviceCrashed as crashed:
        trouble = str(crashed)
    done = restore(subject, profile, flash=True)
    if not (trouble or done.ok):
        trouble = f"the good image could not be flashed afterwards: {done.reason}"
    before, after = _messages(recorded), _messages(player.answers)
    matcher = SequenceMatcher(a=before, b=after, autojunk=False)
    differences = tuple(
        ReplayDifference(tuple(before[i:j]), tuple(after[m:n]))
        for kind, i, j, m, n in matcher.get_opcodes()
        if kind != "equal" and player.frames_sent
    )
    return ReplayResult(subject.name, player.frames_sent, len(before), differences, trouble)


def _answer_ids(target: Target) -> set[int]:
    return {can_id(target.node, to) for to in (None, *Node) if to != target.node}


class Player:
    """Sends frames at their times, later where the device is slower than the recorded one."""

    def __init__(
        self,
        subject: Subject,
        patience_s: float,
        stopped: Callable[[], bool],
    ) -> None:
        self._port = subject.port
        self._answer_ids = _answer_ids(TARGETS[subject.target])
        self._patience_s = float(patience_s)
        """How much longer a slower device gets for the answers of the recorded one."""
        self._stopped = stopped
        self._decoder = Decoder()
        self._messages = 0
        """Messages that the device has sent since the last frame to it."""
        self.answers: list[TraceEntry] = []
        self.frames_sent = 0
        self.sent_at = 0.0
        """Time of the last frame to the device."""

    def play(self, recorded: Sequence[TraceEntry], tail_s: float = _TAIL_S) -> None:
        """Send the frames; listen for `tail_s` after the last one."""
        late_s = self._port.now() - recorded[0].at_s
        decoder, wanted = Decoder(), 0
        for entry in recorded:
            if not entry.sent:
                wanted += len(decoder.feed(Frame(*entry.frame), entry.at_s))
                continue
            late_s += self._await(wanted, entry.at_s + late_s)
            self.sent_at = self._port.now()
            self._port.send(entry.frame)
            self.frames_sent += 1
            wanted = self._messages = 0
        self._await(wanted, recorded[-1].at_s + late_s + float(tail_s))

    def _await(self, wanted: int, due_at: float) -> float:
        """Receive until this time, and longer until the device has sent so many messages. Returns
        how much longer.
        """
        give_up_at = due_at + self._patience_s
        while (now := self._port.now()) < due_at or (self._messages < wanted and now < give_up_at):
            if self._stopped():
                raise RunStopped
            until = due_at if now < due_at else give_up_at
            arrival = self._port.receive(min(until, now + _POLL_S))
            if arrival is None or arrival.is_echo:
                continue
            if arrival.frame.can_id in self._answer_ids:
                self.answers.append(TraceEntry(arrival.at, False, arrival.frame))  # noqa: FBT003
                self._messages += len(self._decoder.feed(Frame(*arrival.frame), arrival.at))
        return max(0.0, self._port.now() - due_at)


def _messages(entries: Sequence[TraceEntry]) -> list[str]:
    """Texts of the device's messages; equal ones in a row once, as how often a device announces
    itself depends on times.
    """
    rows = decoded_rows([entry for entry in entries if not entry.sent])
    texts = (f"{row.seen.title} {row.text}".rstrip() for row in rows)
    return [text for text, _ in groupby(texts)]
