"""One upgrade with everything that is kept of it: frames, a bundle when it fails, the history."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

from flasher.api import Connection, Job, Watch
from flasher.cli.options import Bus
from flasher.cli.output import Output
from flasher.cli.recording import Recording, RecordingOptions, recording
from flasher.cli.upgrade.kept import Keeper, kept
from flasher.cli.upgrade.text import UpgradeDocument, plan_document, upgrade_document
from flasher.errors import FlasherError
from flasher.events import CheckMade
from flasher.host.session import Result

Watching = Callable[[Connection, Recording], AbstractContextManager[Watch]]
"""Begins when the bus is open, and says who watches the upgrade."""


@dataclass
class Carried:
    """An upgrade; `carry_out` fills in what is known of it."""

    job: Job
    bus: Bus
    recorded: RecordingOptions
    output: Output
    on_failure: Callable[[FlasherError], None] = lambda _error: None
    """Completes an error before it is kept."""
    checks: list[CheckMade] = field(default_factory=list)
    record: Recording | None = None
    document: UpgradeDocument | None = None
    error: FlasherError | None = None
    """What stands for a bad end, completed."""
    took_s: float = 0.0
    keeper: Keeper | None = None
    """Knows whether the history has it, at the end."""

    def carry_out(
        self, connect: Callable[[], AbstractContextManager[Connection]], watching: Watching
    ) -> Result:
        """Returns the result, good or bad. Raises BusError and InterruptedByUserError."""
        job, plan = self.job, self.job.plan
        with (
            kept(self.output) as keeper,
            recording(self.recorded, self.bus, self.output, target=plan.target) as record,
        ):
            self.record, self.keeper = record, keeper
            keeper.record = record
            record.facts["plan"] = plan_document(plan, job.options)
            record.facts["waived"] = job.waived
            record.facts["image_sha256"] = plan.image.sha256
            try:
                with connect() as connection:
                    record.opened(connection)
                    began_at = connection.clock.now()
                    with watching(connection, record) as watch:
                        name = "rescue" if job.options.at_power_up else "flash"
                        keeper.began(name, job, connection.name, is_mock=self.bus.mock)

                        def on_event(event: object) -> None:
                            if isinstance(event, CheckMade):
                                self.checks.append(event)
                                record.facts["checks"] = self.checks
                            keeper.heard(event)
                            tell = watch.get("on_event")
                            if tell is not None:
                                tell(event)

                        device = connection.device(plan.target, dialect=self.bus.dialect)
                        result = device.upgrade(
                            plan,
                            options=job.options,
                            verify=job.level,
                            identity=job.identity,
                            taps=record.taps,
                            on_event=on_event,
                            cancelled=watch.get("cancelled"),
                            hung_up=watch.get("hung_up"),
                        )
                    self.took_s = connection.clock.now() - began_at
            except FlasherError as failure:
                self.error = failure
                self.on_failure(failure)
                raise
            keeper.result = result
            self.error = error = result.error()
            self.document = document = upgrade_document(
                plan, job.options, result, self.checks, record.link_report()
            )
            record.facts["outcome"] = document.outcome
            record.facts["verification"] = document.verification
            if error is not None:
                self.on_failure(error)
                record.failed(error)
        return result
