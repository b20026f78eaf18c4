"""What the station knows of one socket."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from flasher.station.events import SocketState
from flasher.station.messages import Finished
from flasher.station.records.model import AttachmentFile, Claim
from flasher.station.run_model import RunResult
from flasher.station.steps import StepName

_FREE = frozenset({SocketState.EMPTY, SocketState.SCAN})


@dataclass
class ActiveRun:
    """A run that is claimed and not yet in the records with its end."""

    claim: Claim
    trace: Path
    begun_s: float
    step: StepName = StepName.CONNECT
    try_number: int = 1
    target: str = ""
    journal_error: str = ""
    """Something of it could not be saved: it cannot pass any more."""
    finished: Finished | None = None
    """Its end, once the process said it."""
    ended_s: float = 0.0
    attached: list[AttachmentFile] = field(default_factory=list)
    result: RunResult | None = None
    """The end as it is to be saved; tried again until it is."""
    is_save_noted: bool = False


@dataclass
class SocketLine:
    """One socket. `state` is what it shows."""

    name: str
    state: SocketState = SocketState.STARTING
    text: str = ""
    is_there: bool = False
    """A unit is in it, as far as it can be seen."""
    sees_units: bool = True
    can_work: bool = False
    """Its process runs and its adapter is open."""
    label: str = ""
    """The label for the next run."""
    begin_at_s: float | None = None
    """When the run is begun although no unit was seen: a person said that it is there."""
    serial: str = ""
    """The unit that runs or ran here last."""
    run: ActiveRun | None = None
    is_virtual: bool = False
    """Its units are virtual: no product comes out of it."""

    @property
    def is_free(self) -> bool:
        """True when it can take a label."""
        if not self.can_work or self.run is not None or self.label:
            return False
        return self.state in _FREE or (self.state.is_verdict and not self.is_there)


@dataclass(frozen=True)
class SocketView:
    """A socket for somebody who looks; `Station.sockets`."""

    name: str
    state: SocketState
    text: str
    serial: str
    is_there: bool
