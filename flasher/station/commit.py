"""What of a run goes onto the disk, in the one thread, and what is told after it is there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from flasher.station import codes
from flasher.station.codes import CODES
from flasher.station.events import (
    LineResumed,
    LineStopped,
    OperatorPrompted,
    Progressed,
    RecordNotSaved,
    RunEnded,
    SocketState,
    StepEnded,
    StepStarted,
)
from flasher.station.messages import Done, Finished, Intent, Reply
from flasher.station.records.errors import RecordError
from flasher.station.records.model import RunState
from flasher.station.run_model import (
    Progress,
    Prompt,
    RunNote,
    RunResult,
    StepBegan,
    StepReport,
)
from flasher.station.saving import save, verified_words
from flasher.station.socket_line import ActiveRun, SocketLine

if TYPE_CHECKING:
    from flasher.station.station import Station

_SHOWN: Final = {
    RunState.PASS: SocketState.PASS,
    RunState.FAIL: SocketState.FAIL,
    RunState.ERROR: SocketState.RECHECK,
    RunState.ABORTED: SocketState.RECHECK,
}
SPOOL: Final = "open"
"""Folder of the traces of runs that go on, beside the attachments."""


class Committing:
    """The records' side of a station."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._store = station.store
        self.stopped: LineStopped | None = None
        """Why the line stands."""

    @property
    def spool(self) -> Path:
        """Where traces are written until they are saved."""
        return self._store.files.folder / SPOOL

    # -- while a run goes on ----------------------------------------------------------------------

    def answer(self, line: SocketLine, number: int, what: Intent | Done | StepReport) -> None:
        """Put something on disk, then let the process go on."""
        run = line.run
        if run is None or run.finished is not None:
            self._reply(line, Reply(number, error="The run is not one of this station."))
            return
        write_id = None
        try:
            match what:
                case Intent():
                    run_id = run.claim.run_id
                    write_id = self._store.intent(run_id, what.target, what.what, what.value)
                case Done():
                    self._store.verified(what.write_id, what.read_back)
                case StepReport():
                    self._save_step(line, run, what)
        except RecordError as error:
            run.journal_error = _said(error)
            self.not_saved(line, run, error)
            self._reply(line, Reply(number, error=error.what))
        else:
            self._reply(line, Reply(number, write_id))

    def _reply(self, line: SocketLine, reply: Reply) -> None:
        self._station.supervisor.send(line.name, reply)

    def _save_step(self, line: SocketLine, run: ActiveRun, report: StepReport) -> None:
        self._store.step(
            run.claim.run_id,
            report.name,
            report.state,
            duration_s=report.duration_s,
            code=report.code,
            text=report.text,
            measurements=report.measurements,
        )
        self._station.tell(
            StepEnded(
                line.name,
                run.claim.serial,
                report.step,
                report.try_number,
                report.state,
                report.duration_s,
                report.code,
                report.text,
                report.target,
            )
        )

    def pass_on(self, line: SocketLine, note: RunNote) -> None:
        """What a run says becomes an event."""
        run = line.run
        if run is None:
            return
        name, serial = line.name, run.claim.serial
        match note:
            case StepBegan(step, target, try_number):
                run.step, run.target, run.try_number = step, target, try_number
                self._station.tell(StepStarted(name, serial, step, try_number, target))
            case Progress(step, target, share, left_s):
                self._station.tell(Progressed(name, serial, step, share, left_s, target))
            case Prompt(text, limit_s):
                self._station.tell(OperatorPrompted(name, text, limit_s))

    # -- its end ----------------------------------------------------------------------------------

    def end(self, line: SocketLine, finished: Finished) -> None:
        """The process said how the run ended: save it, then show it."""
        run = line.run
        if run is None or run.finished is not None:
            return
        run.finished = finished
        run.ended_s = self._station.clock.monotonic_s()
        self._station.show(line, SocketState.SAVING)
        self.save(line, run)

    def end_lost(self, line: SocketLine, reason: str, *, hung: bool) -> None:
        """The process is gone, and its run with it."""
        run = line.run
        if run is None or run.finished is not None:
            return
        code = codes.PROCESS_HUNG if hung else codes.PROCESS_DIED
        duration_s = self._station.clock.monotonic_s() - run.begun_s
        where = f"In {run.step.value} {run.target}".strip()
        result = RunResult(code.outcome, code.name, f"{where}: {reason}.", duration_s)
        self.end(line, Finished(result, None))

    def save(self, line: SocketLine, run: ActiveRun) -> bool:
        """Save the end of a run, and show it when it is on disk; False when it is not."""
        try:
            result = save(self._store, run, self._station.clock.monotonic_s)
        except RecordError as error:
            self.not_saved(line, run, error)
            self._station.show(line, SocketState.ERROR, error.what)
            return False
        claim = run.claim
        line.run, line.serial = None, claim.serial
        code = CODES[result.code]
        text = verified_words(result) if result.outcome is RunState.PASS else result.text
        self._station.tell(
            RunEnded(
                line.name,
                claim.serial,
                claim.run_id,
                claim.kind,
                result.outcome,
                code.name,
                text,
                code.action,
                max(result.duration_s, run.ended_s - run.begun_s),
                tuple(result.verified.items()),
                line.is_virtual,
            )
        )
        self._station.show(line, _SHOWN[result.outcome], code.action)
        self._station.tell_figures()
        return True

    # -- the line ---------------------------------------------------------------------------------

    def not_saved(self, line: SocketLine, run: ActiveRun | None, error: RecordError) -> None:
        """Something is not on disk: nothing green, and the line stands."""
        run_id = None if run is None else run.claim.run_id
        serial = line.label if run is None else run.claim.serial
        self._station.tell(RecordNotSaved(line.name, serial, run_id, _said(error), error.remedy))
        self.stop_line(codes.RECORD_NOT_SAVED.name, error.what, error.remedy)

    def stop_line(self, code: str, reason: str, remedy: str) -> None:
        """Begin no unit until RESUME."""
        if self.stopped is not None:
            return
        self.stopped = LineStopped(code, reason, remedy)
        self._station.tell(self.stopped)
        self._show_all()

    def resume(self) -> bool:
        """Save what is open; True when the line goes on."""
        open_runs = [
            (line, line.run)
            for line in self._station.lines.values()
            if line.run is not None and line.run.finished is not None
        ]
        saved = [self.save(line, run) for line, run in open_runs]  # every one is tried
        if not all(saved):
            return False
        if self.stopped is not None:
            self.stopped = None
            self._station.tell(LineResumed())
            self._show_all()
        return True

    def _show_all(self) -> None:
        for line in self._station.lines.values():
            if line.run is None and not line.state.is_verdict:
                self._station.show_rest(line)


def _said(error: RecordError) -> str:
    """What is wrong and where, in one line; what to do stands elsewhere."""
    where = f" ({error.where})" if error.where else ""
    return f"{error.what.rstrip('.')}{where}."
