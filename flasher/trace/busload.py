"""How full a bus was, and who else was on it: sums over all frames, no frame kept."""

from __future__ import annotations

from typing import Final

from flasher.protocol.frame import Frame
from flasher.protocol.spec import Node
from flasher.trace.decoder import BusEvent, Kind, route
from flasher.trace.story import BusFigures, Talker, TalkerKind

MAX_TALKERS: Final = 100
"""Different ids that are told; a bus with more of them babbles."""
_MAX_IDS: Final = 100_000


class BusCounter:
    """Counts the frames of a trace."""

    def __init__(self) -> None:
        self.frames = 0
        self.first_at: float | None = None
        self.last_at = 0.0
        self.error_frames = 0
        self.damaged = 0
        self.malformed = 0
        self.is_alone = True
        """Nobody but the tool was heard."""
        self._bits = 0
        self._peak_bits = 0
        self._second = 0
        self._second_bits = 0
        self._gap = (0.0, 0.0)
        self._talkers: dict[tuple[int, bool], int] = {}

    def frame(self, frame: Frame, now: float, bits: int) -> None:
        """Take one frame; times do not go back."""
        if self.first_at is None:
            self.first_at = self.last_at = now
        if now - self.last_at > self._gap[0]:
            self._gap = (now - self.last_at, self.last_at)
        self.last_at = now
        self._bits += bits
        second = int(now - self.first_at)
        if second != self._second:
            self._second, self._second_bits = second, 0
        self._second_bits += bits
        self._peak_bits = max(self._peak_bits, self._second_bits)
        if frame.is_error:
            self.error_frames += 1
            return
        self.frames += 1
        key = (frame.can_id, frame.is_extended)
        if key in self._talkers or len(self._talkers) < _MAX_IDS:
            self._talkers[key] = self._talkers.get(key, 0) + 1
        if self.is_alone:
            names = None if frame.is_extended else route(frame.can_id)
            self.is_alone = names is not None and names[0] == Node.CDL.name

    def seen(self, seen: BusEvent) -> None:
        """Take note of what was no message."""
        self.damaged += seen.kind is Kind.DAMAGED
        self.malformed += seen.kind in (Kind.MALFORMED, Kind.UNKNOWN)

    def figures(self, bitrate_bps: int) -> BusFigures:
        """The sums."""
        first_at = self.first_at or 0.0
        duration_s = self.last_at - first_at if self.frames or self.error_frames else 0.0
        return BusFigures(
            duration_s=duration_s,
            frames=self.frames,
            load=self._bits / bitrate_bps / duration_s if duration_s > 0 else None,
            peak_load=self._peak_bits / bitrate_bps if duration_s >= 1 else None,
            error_frames=self.error_frames,
            damaged=self.damaged,
            malformed=self.malformed,
            longest_gap_s=self._gap[0],
            longest_gap_at_s=max(0.0, self._gap[1] - first_at),
        )

    def talkers(self, but: frozenset[int]) -> list[Talker]:
        """Everybody, most frames first, `but` these 11-bit ids."""
        found = []
        for (can_id, is_extended), frames in self._talkers.items():
            names = None if is_extended else route(can_id)
            if can_id in but and not is_extended:
                continue
            kind = TalkerKind.FOREIGN if names is None else TalkerKind.NODE
            name = "" if names is None else f"{names[0]} > {names[1]}"
            found.append(Talker(can_id, is_extended, name, frames, kind))
        return sorted(found, key=lambda talker: -talker.frames)
