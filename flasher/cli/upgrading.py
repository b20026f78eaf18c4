"""What `flash` and `rescue` do: one upgrade from file to last line."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager, ExitStack

from flasher import api
from flasher.cli import arguments
from flasher.cli.output import Output
from flasher.cli.plan_text import image_lines, plan_document, plan_lines, vector_lines
from flasher.cli.profile import profile_of
from flasher.cli.progress import Progress
from flasher.cli.recording import Recording, recording
from flasher.cli.repair import repair_command
from flasher.cli.stop import stop_on_signal
from flasher.cli.upgrade_options import chosen_level, chosen_options, waived_checks
from flasher.cli.upgrade_text import (
    UpgradeDocument,
    check_documents,
    check_line,
    dry_run_document,
    failed,
    link_lines,
    summary_lines,
    upgrade_document,
    verdict_of,
)
from flasher.errors import ExitCode, FlasherError
from flasher.events import CheckMade
from flasher.host.options import UpgradeOptions
from flasher.host.outcome import AGAIN
from flasher.host.session import Result
from flasher.host.verify import Level
from flasher.image.cortexm import vector_table
from flasher.image.plan import Plan
from flasher.image.release import Release
from flasher.settings.profile import Profile
from flasher.trace.figures import LinkReport


def run_upgrade(
    options: argparse.Namespace,
    output: Output,
    *,
    at_power_up: bool = False,
    power_up_timeout_s: float | None = None,
    skip_same_version: bool = False,
) -> int:
    """Run `flash` or `rescue`; returns the exit code."""
    output.ending = failed
    profile = profile_of(options)
    release = api.find_release(options.image, options.manifest)
    plan = _make_plan(options, profile, release)
    chosen = chosen_options(
        options,
        profile,
        release,
        at_power_up=at_power_up,
        power_up_timeout_s=power_up_timeout_s,
    )
    image = plan.image
    show = output.result if options.dry_run else output.progress
    for line in (
        *image_lines(image),
        *vector_lines(vector_table(image)),
        *plan_lines(plan, chosen),
    ):
        show(line)
    identity = profile.identity(
        release=release,
        waived=waived_checks(options),
        skip_same_version=skip_same_version,
        goes_on_unchecked=at_power_up,
    )
    checks = [found.event for found in api.check_image(plan, identity)]
    if options.dry_run:
        for check in checks:
            output.result(check_line(check))
        output.result("dry run: nothing was sent")
        output.document(dry_run_document(plan, chosen, checks))
        return ExitCode.OK
    level = chosen_level(options, plan, chosen)
    return _Upgrading(options, output, plan, chosen, level, identity).run()


def _make_plan(options: argparse.Namespace, profile: Profile, release: Release | None) -> Plan:
    image = api.release_checked(arguments.load_image(options), release)
    profile.check_fits(image)
    return api.make_plan(
        image,
        options.target,
        options.dialect,
        bitrate_bps=arguments.bit_rate(options).bps,
        has_upgrade=profile.has_upgrade,
    )


class _Upgrading:
    """One upgrade on a bus, and what is said about it."""

    def __init__(
        self,
        options: argparse.Namespace,
        output: Output,
        plan: Plan,
        chosen: UpgradeOptions,
        level: Level,
        identity: api.Identity,
    ) -> None:
        self._options = options
        self._output = output
        self._plan = plan
        self._chosen = chosen
        self._level = level
        self._identity = identity
        self._checks: list[CheckMade] = []
        self._took_s = 0.0

    def run(self) -> int:
        """Returns the exit code."""
        with recording(self._options, self._output, target=self._plan.target) as record:
            record.facts["plan"] = plan_document(self._plan, self._chosen)
            record.facts["image_sha256"] = self._plan.image.sha256
            try:
                result = self._upgrade(record)
            except FlasherError as failure:
                self._add_repair(failure)
                raise
            link, error = record.link_report(), result.error()
            document = upgrade_document(self._plan, self._chosen, result, self._checks, link)
            record.facts["outcome"] = document["outcome"]
            record.facts["verification"] = document["verification"]
            if error is not None:
                self._add_repair(error)
                record.failed(error)
        # The bundle is told of before the error, so that the verdict stands at the end.
        return self._tell(result, error, document, link)

    def _upgrade(self, record: Recording) -> Result:
        options, output = self._options, self._output
        with ExitStack() as stack:
            connection = stack.enter_context(
                _connection(options, at_power_up=self._chosen.at_power_up)
            )
            record.opened(connection)
            output.progress(f"on {connection.name} at {connection.bit_rate}")
            progress = stack.enter_context(Progress(self._plan, output))
            stop = stack.enter_context(
                stop_on_signal(lambda: output.error_line("stopping at the end of the message ..."))
            )

            def hung_up() -> bool:
                if stop.has_hung_up and not record.is_alone:
                    record.is_alone = True
                    output.leave_terminal("the terminal is gone")
                return stop.has_hung_up

            def on_event(event: object) -> None:
                if isinstance(event, CheckMade):
                    self._checks.append(event)
                    record.facts["checks"] = check_documents(self._checks)
                output.event(event)
                progress(event)

            began_at = connection.clock.now()
            device = connection.device(options.target, dialect=options.dialect)
            result = device.upgrade(
                self._plan,
                options=self._chosen,
                verify=self._level,
                identity=self._identity,
                taps=record.taps,
                on_event=on_event,
                cancelled=stop.asked,
                hung_up=hung_up,
            )
            self._took_s = connection.clock.now() - began_at
            return result

    def _tell(
        self,
        result: Result,
        error: FlasherError | None,
        document: UpgradeDocument,
        link: LinkReport | None,
    ) -> int:
        output = self._output
        show = output.result if error is None else output.progress
        if result.outcome.ok:
            for line in summary_lines(result, self._plan):
                show(line)
        if link is not None:
            for line in link_lines(link):
                output.progress(line, level=1)
        verdict = verdict_of(result, self._checks, self._took_s)
        if error is None:
            output.verdict(verdict)
            output.document(document, exit_code=result.exit_code)
        else:
            output.ending = lambda _error: verdict
            output.failure(error, **document)
        return result.exit_code

    def _add_repair(self, error: FlasherError) -> None:
        """The exact command that repairs a device that was left without an application."""
        if not error.needs_rescue or self._options.mock:
            return
        options = self._options
        # An image that the device has refused repairs nothing.
        refused = options.image if error.exit_code is ExitCode.REFUSED else None
        error.command = repair_command(options.command_line, options.command, refused)
        error.remedy = error.remedy.replace(f"{AGAIN} ", "")


def _connection(
    options: argparse.Namespace, *, at_power_up: bool
) -> AbstractContextManager[api.Connection]:
    if options.mock:
        return api.connect_mock(
            options.target,
            options.dialect,
            speed=options.mock_speed,
            has_application=not at_power_up,
        )
    holder = arguments.holder_of(options)
    return api.connect(options.dialect, holder=holder, **arguments.bus_config(options))
