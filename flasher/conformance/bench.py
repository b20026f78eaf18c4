"""What a case works with, in one object: `Line` (frames and messages), `Judge` (checks, times,
power, readback), `PatientHost` (a whole upgrade) and `Dialogue` (the upgrade step by step).
"""

from __future__ import annotations

from collections.abc import Callable

from flasher.conformance.dialogue import Dialogue
from flasher.conformance.model import Case
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.subject import Subject


class Bench(Dialogue):
    """Made anew for every case; never outlives it."""

    @classmethod
    def for_case(
        cls,
        case: Case,
        subject: Subject,
        profile: ConformanceProfile,
        seed: str,
        stopped: Callable[[], bool],
    ) -> Bench:
        """The bench of one case."""
        return cls(subject, profile, limit_s=case.limit_s, seed=seed, stopped=stopped)
