"""`flasher acceptance`: walk a person through the first day with an adapter and a device."""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Final

import click

from flasher import __version__, api, jobs
from flasher.cli import values
from flasher.cli.adapters import choose_adapter
from flasher.cli.documents import ImageDocument
from flasher.cli.files import check_new, check_not_read, claimed, write_whole
from flasher.cli.framework import command, option
from flasher.cli.look.doctor import LISTEN_S, Diagnostics
from flasher.cli.look.findings import Severity
from flasher.cli.options import (
    Bus,
    ImageOptions,
    bus_options,
    image_options,
    profile_option,
    target_option,
)
from flasher.cli.output import ClosingLine, Output, counted, duration
from flasher.cli.recording import Recording, RecordingOptions
from flasher.cli.stop import Stop, stop_on_signal
from flasher.cli.terminal import agrees, can_ask
from flasher.cli.upgrade import text
from flasher.cli.upgrade.choices import EXIT_CODES, repair_command
from flasher.cli.upgrade.progress import Progress
from flasher.cli.upgrade.upgrade_run import UpgradeRun
from flasher.documents import as_json
from flasher.errors import ErrorCode, ExitCode, FlasherError, InterruptedByUserError, UsageError
from flasher.events import PacketAcknowledged
from flasher.host.outcome import AGAIN, DeviceLeft
from flasher.host.verify import Verdict
from flasher.i18n import without_options
from flasher.image.cortexm import vector_table
from flasher.protocol.spec import Target
from flasher.protocol.text import printable
from flasher.settings.profile import Profile, load_profile
from flasher.trace.decoder import content_fields
from flasher.wording import wording

_OUT: Final = "-o/--output"
_EXAMPLES: Final = """\
examples:
  flasher acceptance firmware.hex -t bms -i socketcan -c can0
  flasher acceptance firmware.hex -t bms -i pcan -c PCAN_USBBUS1 -o bench-3.html
  flasher acceptance firmware.hex -t bms --mock --yes --interrupt    practice

Ten minutes: bus, speed of the adapter, identity, reading, two upgrades with the maker's image, and
one that is interrupted in its middle on request and rescued. Nothing is erased before you agree.
The report (HTML, and JSON beside it) is written after each step, and names what was not tried.
Exit code 0: each step passed. 12: one was not tried, or saw something wrong. Otherwise the code of
the error that ended it.
"""
_OWN_OPTIONS: Final = frozenset({"--output", "--force", "--yes", "--interrupt"})
"""Options that flasher rescue does not have, or in another meaning."""
_NEVER: Final = (
    "a power cut while the device erases, writes or starts",
    "an adapter that is unplugged in the middle",
    "a second tool, or two devices of one kind, on the bus",
    "an image that is damaged or meant for another device, refused by the device itself",
    "writing of items, and the SHUTDOWN of a battery during an upgrade",
    "more than one unit, and other adapters than this one",
)
"""What no acceptance tries."""


class StepState(Enum):
    """State of a step."""

    PASSED = "passed"
    FAILED = "failed"
    STOPPED = "stopped"
    NOT_TRIED = "not tried"
    IMPOSSIBLE = "not possible"
    """The documents do not let a tool do it with this target."""


class AcceptanceVerdict(Enum):
    """Verdict of an acceptance."""

    PASSED = "passed"
    FAILED = "failed"
    INCOMPLETE = "incomplete"


@dataclass(frozen=True)
class AcceptanceStep:
    """A step, with what was seen."""

    name: str
    state: StepState
    what: str
    details: list[str]
    took_s: float


@dataclass(frozen=True)
class AcceptanceDocument:
    """Report of an acceptance."""

    verdict: AcceptanceVerdict
    """`passed` if each step passed, on whatever it ran: see `is_practice`."""
    is_practice: bool
    """True without hardware: the mock, or a virtual bus."""
    hardware: str
    """Adapter, or what stood in for hardware."""
    at: str
    flasher_version: str
    target: str
    image: ImageDocument
    steps: list[AcceptanceStep]
    never_tried: list[str]
    """Steps that were not tried with hardware, and what no acceptance tries."""
    device_state: str
    files: list[str]


DOCUMENTS: Final = (AcceptanceDocument,)


@command(
    epilog=_EXAMPLES,
    exit_codes=(*EXIT_CODES, ExitCode.PARTIAL),
)
@target_option()
@image_options
@profile_option
@option(
    "-o", "--output", "file", metavar="FILE", type=values.FilePath("html", gives=Path), brief=True,
    help="the report, an .html; a .json is written beside it (default: acceptance-TARGET.html)",
)  # fmt: skip
@option("--force", "overwrites", is_flag=True, help="overwrite an older report")
@option(
    "--yes", is_flag=True, brief=True,
    help="agree to two upgrades without a question, for a run without a terminal; the identity is "
    "then not compared with the label",
)  # fmt: skip
@option(
    "--interrupt", "interrupts", is_flag=True, brief=True,
    help="with --yes: also interrupt an upgrade, and rescue the device",
)  # fmt: skip
@bus_options(mock="practise with a device model in this process")
def acceptance(
    output: Output,
    target: Target,
    image: ImageOptions,
    bus: Bus,
    *,
    profile: str | None,
    file: Path | None,
    overwrites: bool,
    yes: bool,
    interrupts: bool,
) -> int:
    """Walk through the first day with an adapter and a device, step by step, and write a report to
    send. What was not tried is named in it.
    """
    if interrupts and not yes:
        raise UsageError(
            "--interrupt needs --yes.", remedy="Without --yes the question is asked: leave it out."
        )
    if not yes and not can_ask():
        raise UsageError(
            "The acceptance asks a person, and no person can answer here.",
            cause="standard input or standard error is not a terminal",
            remedy="Run it in a terminal, or add --yes (and --interrupt) to agree beforehand.",
        )
    path = file or Path(f"acceptance-{target.name}.html")
    if path.suffix.lower() != ".html":
        raise UsageError(
            f"{printable(str(path))} does not end in .html.",
            where=_OUT,
            remedy="Name an .html; the .json is written beside it.",
        )
    for each in (path, path.with_suffix(".json")):
        check_not_read(each, _OUT, [image.image])
        check_new(each, _OUT, force=overwrites)
    settings = load_profile(profile, target, bus.dialect)
    opened = jobs.open_image(image.source, target, **image.options())
    settings.check_fits(opened.image)
    bus = choose_adapter(bus.with_profile(profile), output)
    job = jobs.prepare(opened, settings, bitrate_bps=bus.bit_rate.bps)
    try:
        job.checked()
    except FlasherError as error:
        _offer_no_waiver(
            error,
            f"Take the maker's image for this {target.node.name}: an acceptance waives no check.",
        )
        raise
    with (
        claimed(path, _OUT, force=overwrites),
        stop_on_signal(lambda: output.error_line("stopping at the end of the message ...")) as stop,
    ):
        walk = _Walk(output, bus, job, settings, stop, path, agreed=yes, interrupts=interrupts)
        return walk.run()


_AGAIN: Final = f"{AGAIN[:-1]} with --force: it overwrites this report."
STEPS: Final = (
    "bus", "identity", "read", "first upgrade", "second upgrade", "interrupted and rescued",
    "identity afterwards",
)  # fmt: skip


def _offer_no_waiver(error: FlasherError, remedy: str) -> None:
    """Replace the options that would waive the check that refused: an acceptance has none."""
    if error.waiver:
        error.what = without_options(error.what)
        error.remedy = remedy


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


class _StepImpossibleError(Exception):
    """A step that the documents let no tool make; the acceptance goes on."""


class _StepError(Exception):
    """A step failed, and the later ones make no sense."""


@dataclass
class _Walk:
    """The steps, and the report that grows with them."""

    output: Output
    bus: Bus
    job: jobs.Job
    profile: Profile
    stop: Stop
    path: Path
    agreed: bool
    interrupts: bool
    steps: list[AcceptanceStep] = field(default_factory=list)
    device_state: str = "nothing was erased by this acceptance"
    error: FlasherError | None = None
    _practice: str = "on no hardware"
    _hardware: str = ""
    _is_practice: bool = False
    _at: str = field(default_factory=_now)
    _details: list[str] = field(default_factory=list)
    _before: api.DeviceInfo | None = None

    def run(self) -> int:
        """Run all steps, and write the report whatever happens; return the exit code."""
        target = self.job.plan.target
        self._is_practice = self.bus.mock
        self._hardware = "the built-in mock" if self.bus.mock else "the adapter was not opened"
        try:
            self._try("bus", self._look_at_bus)
            with self.bus.connect(target, profile=None) as connection:
                if not self.bus.mock:
                    self._hardware = printable(connection.name)
                    self._is_practice = not connection.link.is_physical
                device = connection.device(
                    target, dialect=self.bus.dialect, profile=self.profile, cancelled=self.stop
                )
                self._try("identity", lambda: self._identify(device))
                self._read(device)
                self._upgrades(connection, device)
        except _StepError:
            pass  # the steps say so
        except InterruptedByUserError as error:
            self._fail(error)
        except FlasherError as error:  # the adapter cannot be opened any more
            self._fail(error)
            self._add("adapter", StepState.FAILED, error.what)
        finally:
            self._add_the_rest()
            document = self._write()
        return self._end(document)

    # -- the steps ---------------------------------------------------------------------------------

    def _look_at_bus(self) -> str:
        """Check adapter, bus and traffic, and measure the adapter's speed."""
        examination = Diagnostics(self.bus, LISTEN_S, self.output)
        if self.bus.mock:
            examination.look_at_mock(self.stop)
        else:
            examination.look_at_adapters(self.stop)
        examination.measure(self.stop)
        found = [each for each in examination.findings if each.severity is not Severity.OK]
        self._details += [f"{each.about}: {each.what}" for each in examination.findings]
        problems = [each for each in found if each.severity is Severity.PROBLEM]
        if problems:
            raise _StepError(f"{problems[0].about}: {problems[0].what}")
        warnings = sum(each.severity is Severity.WARNING for each in found)
        return f"no problem, {counted(warnings, 'warning')}"

    def _identify(self, device: api.Device) -> str:
        """Ask for the identity, and have it compared with the label."""
        found = self._before = device.identify()
        node = found.target.node.name
        if not found.is_there and found.readings:
            raise _StepError(f"the {node} did not answer and sent nothing")
        if not found.is_there:
            raise _StepImpossibleError(
                "it sent nothing, and the documents give no query for it: a reset will show it"
            )
        rows = [] if found.version is None else content_fields(found.version)
        self._details += [f"{each.label}: {each.text}" for each in rows]
        if not rows and found.readings:
            raise _StepError(f"the {node} does not answer the query for its identity")
        if not rows:
            return "it sends; the documents give no query for its identity"
        shown = "; ".join(self._details)
        if self.agreed:
            return "it answers; not compared with the label by a person"
        if not self._asks(f"The {node} reports: {shown}.\nIs that the device in front of you?"):
            raise _StepError("a person answered that this is not the device in front of them")
        return "it answers, and a person compared it with the label"

    def _read(self, device: api.Device) -> None:
        """Read all items twice."""
        before, node = self._before, self.job.plan.target.node.name
        assert before is not None  # noqa: S101  set by the step before
        if not before.readings:
            why = f"the documents let no tool read the {node}"
            self._leave_out("read", StepState.IMPOSSIBLE, why)
        else:
            self._try("read", lambda: self._read_again(device.identify(), before))

    def _read_again(self, again: api.DeviceInfo, before: api.DeviceInfo) -> str:
        names = [each.title for each in again.readings if each.answer is not None]
        missing = [each.title for each in again.readings if each.answer is None]
        self._details += [f"answered: {', '.join(names)}"] if names else []
        self._details += [f"not answered: {', '.join(missing)}"] if missing else []
        if not names:
            raise _StepError("no query was answered")
        if again.version != before.version:
            raise _StepError("two identities in a row differ")
        return f"{len(names)} of {len(again.readings)} queries answered, twice"

    def _upgrades(self, connection: api.Connection, device: api.Device) -> None:
        """Flash twice, then interrupt and rescue, each only if the person agrees."""
        node, image = self.job.plan.target.node.name, self.job.plan.image
        what = f"{image.source} ({image.version or 'names no version'})"
        question = f"Flash {what} into the {node}, twice? Its application is erased and replaced."
        if not self.agreed and not self._asks(question):
            for name in ("first upgrade", "second upgrade"):
                self._leave_out(name, StepState.NOT_TRIED, "the person did not agree")
            return
        for name in ("first upgrade", "second upgrade"):
            self._try(name, lambda: self._flash(connection, self.job))
        if not (
            self.interrupts
            if self.agreed
            else self._asks(
                f"Interrupt a third upgrade of the {node} in its middle, and rescue it? Until it "
                "is rescued it has no application."
            )
        ):
            why = "not requested" if self.agreed else "the person did not agree"
            self._leave_out("interrupted and rescued", StepState.NOT_TRIED, why)
        else:
            self._try("interrupted and rescued", lambda: self._interrupt_and_rescue(connection))
        if self._before is not None and not self._before.readings:
            self._leave_out(STEPS[-1], StepState.IMPOSSIBLE, "the documents give no query for it")
        else:
            self._try(STEPS[-1], lambda: self._compare(device.identify()))

    def _flash(
        self, connection: api.Connection, job: jobs.Job, *, until_packet: int | None = None
    ) -> str:
        """Upgrade the device; with `until_packet` end at this packet, as a user would."""
        is_wanted = until_packet is not None
        reached = 0
        recorded = RecordingOptions(no_bundle=is_wanted)
        upgrade_run = UpgradeRun(job, self.bus, recorded, self.output, self._add_repair)

        @contextmanager
        def watching(_: api.Connection, _record: Recording) -> Iterator[api.CallOptions]:
            with Progress(job.plan, self.output) as progress:

                def on_event(event: object) -> None:
                    nonlocal reached
                    progress(event)
                    if isinstance(event, PacketAcknowledged):
                        reached = event.number

                def cancelled() -> bool:
                    return self.stop() or (until_packet is not None and reached >= until_packet)

                yield {"on_event": on_event, "cancelled": cancelled}

        self.device_state = "an upgrade was running: its state is not known"
        try:
            result = upgrade_run.write_planned(lambda: nullcontext(connection), watching)
        except FlasherError as error:
            if not error.needs_rescue:
                self.device_state = "this upgrade erased nothing"
            raise
        left = result.outcome.device_left
        self.device_state = wording(left)
        failure = upgrade_run.error
        if is_wanted and isinstance(failure, InterruptedByUserError) and not self.stop():
            return f"ended at packet {reached} of {job.plan.total_packets}"
        if failure is not None:
            raise failure
        if is_wanted:
            raise _StepError("the upgrade was over before it could be interrupted")
        figures = result.outcome.statistics
        self._details += text.summary_lines(result, job.plan)
        if left is DeviceLeft.NEW and result.running_version:
            self.device_state = f"it runs {result.running_version}"
        verdict = result.verification.verdict
        runs = "what runs is not known" if verdict is Verdict.NOT_ASKED else wording(verdict)
        return (
            f"{duration(figures.duration_s)}, {figures.repetitions} repeated, {figures.naks} NAK; "
            f"{runs}"
        )

    def _add_repair(self, error: FlasherError) -> None:
        """Add the command that repairs a device left without an application; advice to repeat this
        one has to name --force, because its report exists.
        """
        error.remedy = error.remedy.replace(AGAIN, _AGAIN)
        if error.needs_rescue and not self.bus.mock:
            is_refused = error.exit_code is ExitCode.REFUSED
            ctx = click.get_current_context()
            error.command = repair_command(ctx, is_refused=is_refused, without=_OWN_OPTIONS)

    def _interrupt_and_rescue(self, connection: api.Connection) -> str:
        job, total = self.job, self.job.plan.total_packets
        ended = self._flash(connection, job, until_packet=max(1, total // 2))
        self._details.append(f"interrupted: {ended}")
        rescue = jobs.prepare(
            job.plan.image,
            self.profile,
            bitrate_bps=job.plan.bitrate_bps,
            identity=job.identity,
            at_power_up=True,
        ).in_session()
        self.output.progress(
            "rescuing: leave the device as it is, and switch it off and on when that is requested"
        )
        return f"{ended}; rescued: {self._flash(connection, rescue)}"

    def _compare(self, after: api.DeviceInfo) -> str:
        """Compare the identity with that before, and the version with the image's."""
        before, version = self._before, after.version
        wanted = self.job.plan.image.version
        if before is None or version is None or before.version is None:
            raise _StepError("no version information was answered")
        for old, new in zip(content_fields(before.version), content_fields(version), strict=True):
            if old.text != new.text:
                self._details.append(f"{old.label}: {old.text} before, {new.text} now")
        if before.version.serial_number != version.serial_number:
            raise _StepError("it reports another serial number than before")
        if wanted is not None and str(version.firmware_version) != wanted:
            raise _StepError(f"it reports {version.firmware_version}, the image has {wanted}")
        return f"the same device, running {version.firmware_version}"

    # -- asking and noting -------------------------------------------------------------------------

    def _asks(self, question: str) -> bool:
        return agrees(question, interrupted=self.device_state)

    def _try(self, name: str, act: Callable[[], str]) -> None:
        """Run a step, which returns what it has to say, and add it, however it ends."""
        self._name(name)
        self._details = []
        begun = time.perf_counter()
        state, what = StepState.STOPPED, "interrupted at once"
        try:
            state, what = StepState.PASSED, act()
        except _StepImpossibleError as error:
            state, what = StepState.IMPOSSIBLE, str(error)
        except _StepError as error:
            state, what = StepState.FAILED, str(error)
            raise
        except InterruptedByUserError as error:
            what = error.what
            self._fail(error)
            raise
        except FlasherError as error:
            self._fail(error)
            state, what = StepState.FAILED, f"{error.what} [{error.code}]"
            raise _StepError from error
        finally:
            self._add(name, state, what, time.perf_counter() - begun)

    def _fail(self, error: FlasherError) -> None:
        remedy = without_options(error.remedy)
        if error.code is ErrorCode.UNCHECKED:
            remedy = "Take an image whose manifest has no rule that this device cannot answer."
        _offer_no_waiver(error, f"{remedy} An acceptance waives no check.".lstrip())
        self.error = self.error or error

    def _name(self, name: str) -> None:
        self.output.progress(f"{len(self.steps) + 1}. {name} ...")

    def _leave_out(self, name: str, state: StepState, what: str) -> None:
        """Add a step that is not begun."""
        self._name(name)
        self._add(name, state, what)

    def _add(self, name: str, state: StepState, what: str, took_s: float = 0.0) -> None:
        self.steps.append(AcceptanceStep(name, state, what, self._details, round(took_s, 2)))
        self._details = []
        self.output.progress(f"   {state.value}: {what}")
        self._write()

    def _add_the_rest(self) -> None:
        tried = {each.name for each in self.steps}
        self.steps += [
            AcceptanceStep(name, StepState.NOT_TRIED, "the acceptance ended before it", [], 0.0)
            for name in STEPS
            if name not in tried
        ]

    # -- the report --------------------------------------------------------------------------------

    def _document(self) -> AcceptanceDocument:
        states = {each.state for each in self.steps}
        verdict = AcceptanceVerdict.PASSED
        if states - {StepState.PASSED, StepState.IMPOSSIBLE} or not self.steps:
            verdict = AcceptanceVerdict.INCOMPLETE
        if StepState.FAILED in states:
            verdict = AcceptanceVerdict.FAILED
        image = self.job.plan.image
        missing = [
            f"{each.name}: {self._practice if self._is_practice else each.what}"
            for each in self.steps
            if self._is_practice or each.state not in (StepState.PASSED, StepState.FAILED)
        ]
        return AcceptanceDocument(
            verdict=verdict,
            is_practice=self._is_practice,
            hardware=self._hardware,
            at=self._at,
            flasher_version=__version__,
            target=self.job.plan.target.name,
            image=text.image_document(image, vector_table(image)),
            steps=self.steps,
            never_tried=[*missing, *_NEVER],
            device_state=self.device_state,
            files=[str(self.path), str(self.path.with_suffix(".json"))],
        )

    def _write(self) -> AcceptanceDocument:
        from flasher.report.base import Status, render_page  # noqa: PLC0415  loads jinja2

        document = self._document()
        statuses = {
            StepState.PASSED: Status.GOOD,
            StepState.FAILED: Status.BAD,
            StepState.STOPPED: Status.WARNING,
            StepState.NOT_TRIED: Status.NEUTRAL,
            StepState.IMPOSSIBLE: Status.NEUTRAL,
            AcceptanceVerdict.PASSED: Status.GOOD,
            AcceptanceVerdict.FAILED: Status.BAD,
            AcceptanceVerdict.INCOMPLETE: Status.WARNING,
        }
        page = render_page("acceptance.html", report=document, statuses=statuses)
        data = json.dumps(as_json(document), indent=1).encode("ascii") + b"\n"
        write_whole(self.path, page.encode("utf-8"), _OUT)
        write_whole(self.path.with_suffix(".json"), data, _OUT)
        return document

    def _end(self, document: AcceptanceDocument) -> int:
        output, node = self.output, self.job.plan.target.node.name
        output.result(f"state of the {node}: {document.device_state}")
        output.result(f"report: {', '.join(map(printable, document.files))}")
        practice = " (practice: no hardware was tried)" if document.is_practice else ""
        counts = [
            f"{sum(each.state is state for each in self.steps)} {state.value}"
            for state in StepState
            if any(each.state is state for each in self.steps)
        ]
        closing = ClosingLine(
            document.verdict.value.upper(),
            f"{', '.join(counts)}{practice}",
            "green" if document.verdict is AcceptanceVerdict.PASSED else "red",
        )
        if document.verdict is AcceptanceVerdict.PASSED:
            output.verdict(closing if not practice else closing._replace(colour="yellow"))
            return output.document(document)
        if self.error is not None:
            self.error.remedy = self.error.remedy.replace(AGAIN, _AGAIN)
            output.ending = lambda _error: closing
            return output.failure(self.error, document)
        output.verdict(closing)
        return output.document(document, exit_code=ExitCode.PARTIAL)
