"""Upgrade run with recording: frames, a bundle if it fails, and this computer's history.

A failure to record does not affect the upgrade: it only prints a warning.
"""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import click

from flasher.api import CallOptions, Connection
from flasher.cli.framework import retype
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.recording import Recording, RecordingOptions, recording
from flasher.cli.upgrade.settings import (
    SavedSettings,
    compare_settings,
    restore_command,
    save_settings,
)
from flasher.cli.upgrade.text import UpgradeDocument, plan_document, upgrade_document
from flasher.errors import ExitCode, FlasherError
from flasher.events import (
    SETTINGS,
    AdapterBack,
    CheckMade,
    PacketAcknowledged,
    Phase,
    PhaseEntered,
    QueryAnswered,
    UpgradeLeftOpen,
)
from flasher.history import MOCK, Began, Ended, FlashHistory, Reached, left_open, working_folder
from flasher.host.session import Result
from flasher.i18n import text
from flasher.jobs import Job
from flasher.protocol.contents import VersionInformation
from flasher.protocol.text import printable

Watching = Callable[[Connection, Recording], AbstractContextManager[CallOptions]]
"""Context of an upgrade, entered when the bus is open; yields the event listeners."""


@dataclass
class UpgradeRun:
    """Upgrade with its recording; `write_planned` fills in its facts."""

    job: Job
    bus: Bus
    recorded: RecordingOptions
    output: Output
    on_failure: Callable[[FlasherError], None] = lambda _error: None
    """Completes an error before it is recorded."""
    again: Callable[[], str] = lambda: ""
    """Builds the command that repeats the upgrade after this program was killed; empty for the
    page."""
    keeps_settings: bool = False
    restore_command: Callable[[Path], str] = restore_command
    """Builds the command that writes saved settings back."""
    checks: list[CheckMade] = field(default_factory=list)
    record: Recording | None = None
    document: UpgradeDocument | None = None
    error: FlasherError | None = None
    """Completed error of a failed upgrade."""
    took_s: float = 0.0
    warning: str = ""
    """Reason why the upgrade is missing in the history; empty if it is there."""
    _history: FlashHistory = field(default_factory=FlashHistory)
    _name: str | None = None
    """Name in the history; None before the start."""
    _start: Began | None = None
    """Start as the history has it."""
    _serial_number: str | None = None
    _result: Result | None = None
    _connection: Connection | None = None
    _saved: SavedSettings | None = None

    def write_planned(
        self, connect: Callable[[], AbstractContextManager[Connection]], watching: Watching
    ) -> Result:
        """Run, record and return the upgrade. Raises BusError and InterruptedByUserError."""
        try:
            result = self._recorded(connect, watching)
        except BaseException as failure:
            self._ended(failure)
            raise
        self._ended(None)
        return result

    def _recorded(
        self, connect: Callable[[], AbstractContextManager[Connection]], watching: Watching
    ) -> Result:
        plan = self.job.plan
        with recording(self.recorded, self.bus, self.output, target=plan.target) as record:
            self.record = record
            record.facts["plan"] = plan_document(plan, self.job.options)
            record.facts["waived"] = self.job.waived
            record.facts["image_sha256"] = plan.image.sha256
            try:
                with connect() as opened:
                    # An earlier upgrade may have lost the adapter.
                    connection = self._connection = opened.renamed()
                    record.opened(connection)
                    began_at = connection.clock.now()
                    left = self._left_open(connection.name)
                    if left is not None:
                        self.job = self.job.in_session()
                    job = self.job
                    with watching(connection, record) as watch:
                        self._began(connection)

                        def on_event(event: object) -> None:
                            match event:
                                case PhaseEntered(phase):
                                    self._reached(phase, 0)
                                case PacketAcknowledged(number):
                                    self._reached(Phase.TRANSFER, number)
                                case AdapterBack():
                                    self._name_adapter()
                                case CheckMade():
                                    self.checks.append(event)
                                    record.facts["checks"] = self.checks
                                case QueryAnswered(content=VersionInformation() as version):
                                    serial_number = printable(str(version.serial_number))
                                    self._serial_number = serial_number or None
                            listener = watch.get("on_event")
                            if listener is not None:
                                listener(event)

                        if left is not None:
                            on_event(left)
                        result = self._run(connection, record, watch, on_event)
                    self.took_s = connection.clock.now() - began_at
            except FlasherError as failure:
                self.error = failure
                self._failed(failure)
                raise
            self._result = result
            self.error = error = result.error()
            self.document = document = upgrade_document(
                plan, job.options, result, self.checks, record.link_report()
            )
            record.facts["outcome"] = document.outcome
            record.facts["verification"] = document.verification
            if error is not None:
                self._failed(error)
                record.failed(error)
        return result

    def _run(
        self,
        connection: Connection,
        record: Recording,
        watch: CallOptions,
        on_event: Callable[[object], None],
    ) -> Result:
        """Run the upgrade, with the settings saved before and compared after it."""
        device = connection.device(self.job.plan.target, dialect=self.bus.dialect)
        calls: CallOptions = {"taps": record.taps, "cancelled": watch.get("cancelled")}
        if self.keeps_settings and self.job.options.at_power_up:
            # No application answers a query, and the announcement must not be missed meanwhile.
            what = text("not saved: no application runs that could report them")
            on_event(CheckMade(SETTINGS, "unknown", what))
        elif self.keeps_settings:
            self._saved = save_settings(device, on_event, self.restore_command, **calls)
        result = device.run_job(
            self.job,
            taps=record.taps,
            on_event=on_event,
            cancelled=watch.get("cancelled"),
            hung_up=watch.get("hung_up"),
        )
        if self._saved is not None and result.outcome.ok:
            compare_settings(device, self._saved, on_event, **calls)
        return result

    def _name_adapter(self) -> None:
        """Give history and commands the name that the adapter came back with; none while another
        adapter has its name.
        """
        before = self._connection
        if before is None or (connection := before.renamed()) is before:
            return
        self._connection = connection
        if connection.channel:
            self.output.progress(f"it is {printable(connection.name)} now")
        ctx = click.get_current_context(silent=True)
        if ctx is not None:  # there is none on the page
            retype(ctx, "channel", connection.channel or "CHANNEL")
            retype(ctx, "interface", self.bus.interface or "")
        if self._start is not None:
            self._start = replace(
                self._start,
                adapter=printable(connection.name),
                again=printable(self.again()),
            )
            self._write_start(self._start)

    def _failed(self, error: FlasherError) -> None:
        """Complete an error, with the command that restores the settings."""
        self._name_adapter()
        self.on_failure(error)
        if self._saved is not None:
            error.remedy = text(
                "{remedy} Its settings are saved, and can be written back after that: `{command}`.",
                remedy=error.remedy,
                command=self._saved.command,
            )

    # -- the history -------------------------------------------------------------------------------

    def _left_open(self, adapter: str) -> UpgradeLeftOpen | None:
        """Return the upgrade that may have left the device here in its transfer (R26)."""
        if self.bus.mock:
            return None
        target, adapter = self.job.plan.target.name, printable(adapter)
        found = None
        with contextlib.suppress(FlasherError, OSError):
            found = left_open(self._history.flashes()[0], target=target, adapter=adapter)
        if found is None:
            return None
        return UpgradeLeftOpen(found.began.at, found.began.image, found.ended is not None)

    def _reached(self, phase: Phase, packet: int) -> None:
        if self._name is not None:
            with contextlib.suppress(OSError):
                self._history.reached(self._name, Reached(phase.value, packet))

    def _began(self, connection: Connection) -> None:
        image = self.job.plan.image
        self._start = Began(
            at=_now(),
            command="rescue" if self.job.options.at_power_up else "flash",
            target=self.job.plan.target.name,
            is_virtual=not connection.link.is_physical,
            adapter=MOCK if self.bus.mock else printable(connection.name),
            image=printable(image.source),
            image_sha256=image.sha256,
            image_size_bytes=image.size_bytes,
            image_version=image.version,
            waived=", ".join(self.job.waived),
            again=printable(self.again()),
            folder=working_folder(),
            **_signed(self.job),
        )
        self._write_start(self._start)

    def _write_start(self, began: Began) -> None:
        def write() -> None:
            if self._name is None:
                self._name = self._history.begin(began)
            else:
                self._history.changed(self._name, began)

        self._carefully(write)

    def _ended(self, failure: BaseException | None) -> None:
        """Record the end, with the exception if it failed."""
        name, result = self._name, self._result
        if name is None:
            return
        error = self.error if failure is None else failure
        bundle = None if self.record is None else self.record.bundle
        outcome = None if result is None else result.outcome
        ended = Ended(
            at=_now(),
            exit_code=int(result.exit_code if result and not failure else _exit_code(error)),
            what=_words(error),
            serial_number=self._serial_number,
            previous_version=result.previous_version if result else None,
            transferred=None if outcome is None else outcome.is_transferred,
            completed=None if outcome is None else outcome.is_completed,
            running_version=result.running_version if result else None,
            needs_rescue=outcome.device_left.needs_rescue
            if outcome
            else getattr(error, "needs_rescue", True),
            bundle=None if bundle is None else printable(str(bundle)),
        )
        self._carefully(lambda: self._history.end(name, ended))

    def _carefully(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as problem:  # noqa: BLE001  the flash is what matters
            reason = getattr(problem, "strerror", None) or str(problem) or type(problem).__name__
            self.warning = printable(f"no history in {self._history.path}: {reason}")
            self.output.error_line(f"warning: {self.warning}")


def _signed(job: Job) -> dict[str, Any]:
    """Return what the history records of a signed release."""
    release, provenance = job.identity.release, job.identity.provenance
    if release is None or provenance is None or not provenance.signers:
        return {}
    return {
        "product": release.product or "",
        "counter": release.counter or 0,
        "signers": ", ".join(provenance.signers),
    }


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _exit_code(error: BaseException | None) -> ExitCode:
    if isinstance(error, KeyboardInterrupt):
        return ExitCode.INTERRUPTED
    return error.exit_code if isinstance(error, FlasherError) else ExitCode.INTERNAL


def _words(error: BaseException | None) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "Interrupted at once."
    return "" if error is None else printable(getattr(error, "what", str(error)))
