"""What is known of one upgrade: plain facts, filled in by `dialogue`, judged by `verdict`; and what
of them a new phase or a new attempt changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from flasher.protocol.spec import Target
from flasher.trace.records import Interleaving, PacketRecord
from flasher.trace.story import Phase, PhaseSpan, TraceVerdict


@dataclass
class Facts:
    """One upgrade of one target so far. Times are seconds on the trace's clock."""

    target: Target
    begin_s: float
    last_at_s: float
    """The latest message of either side."""
    tool_at_s: float
    """The latest message of the tool."""
    phase: Phase | None = None
    phase_begin_s: float = 0.0
    spans: list[PhaseSpan] = field(default_factory=list)
    attempt: int = 1
    earlier: TraceVerdict | None = None
    """That of the attempt before, if it had come to the transfer."""
    is_answered: bool = False
    """The target said something intact."""

    is_one_tool: bool = False
    """All that is sent on the tool's id is known to come from one tool."""

    # Before the transfer.
    resets: int = 0
    feedbacks: int = 0
    boot_versions: dict[str, int] = field(default_factory=dict)
    """Name and version, and how often each was announced."""
    boot_names: set[str] = field(default_factory=set)
    is_boot_odd: bool = False
    """A version was announced that has not the document's form."""
    boot_changes: int = 0
    """How often a boot version differs from the one before it in the same attempt."""
    is_announced: bool = False
    """The bootloader announced itself in this attempt."""
    updates: int = 0
    boots_after_update: int = 0
    feedbacks_after_update: int = 0
    image_size_bytes: int | None = None

    # The transfer.
    total: int | None = None
    packets: list[PacketRecord] = field(default_factory=list)
    """In the order of first copies; their number is limited."""
    current: PacketRecord | None = None
    restarts: int = 0
    is_restarted: bool = False
    """The device restarted and has not been told to prepare since."""
    damage_from_tool: int = 0
    damage_from_device: int = 0
    damage_now: int = 0
    """Damage since the last progress."""
    is_cut_short: bool = False
    """The latest thing on the tool's id is a message that was never finished."""
    errors: int = 0
    errors_now: int = 0
    """Error frames since the last progress."""
    extra_acks: int = 0
    """ACKs for a packet that was sent once and had its ACK already."""
    image_versions: set[str] = field(default_factory=set)
    """Firmware versions found inside the packets."""

    # The end.
    ends: int = 0
    end_naks: int = 0
    boots_after_end: int = 0
    completed_at_s: float | None = None
    early_complete: bool = False
    running_version: str | None = None

    # Others.
    shutdown_at_s: float | None = None
    intrusions: list[str] = field(default_factory=list)
    """What the tool's id said that this upgrade does not explain."""
    interleaving: Interleaving = field(default_factory=Interleaving)

    @property
    def is_restart(self) -> bool:
        """So far the device was restarted and announced itself, and was told of no update."""
        return self.is_announced and not self.updates and self.phase is Phase.BOOT

    def enter(self, phase: Phase, at_s: float) -> None:
        """A phase begins, or goes on."""
        if self.phase is not phase:
            self.leave(at_s)
            self.phase, self.phase_begin_s = phase, at_s

    def leave(self, at_s: float) -> None:
        """The phase, if there is one, is over."""
        if self.phase is not None:
            end_s = max(self.phase_begin_s, at_s)
            self.spans.append(PhaseSpan(self.phase, self.attempt, self.phase_begin_s, end_s))

    def progress(self) -> None:
        """Something went well: trouble before it explains nothing any more."""
        self.damage_now = self.errors_now = 0

    def begin_attempt(self, at_s: float) -> None:
        """The tool starts over: what belongs to one attempt alone begins anew."""
        self.leave(at_s)
        self.phase = None
        self.attempt += 1
        self.current = None
        self.ends = self.end_naks = self.boots_after_end = self.boots_after_update = 0
        self.feedbacks_after_update = self.feedbacks = self.resets = 0
        self.is_restarted = self.early_complete = self.is_announced = False
        self.progress()
