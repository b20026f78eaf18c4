"""What `flasher doctor` makes of the traffic that it heard, without having sent anything."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from flasher.bus.health import LinkHealth
from flasher.cli.look.findings import Finding, Severity
from flasher.cli.output import counted
from flasher.host.survey import Survey
from flasher.protocol import contents
from flasher.protocol.frame import Frame
from flasher.protocol.spec import Dialect, Node
from flasher.trace.pieces import bits_of

_HIGH_LOAD: Final = 0.8
_MANY_ERRORS: Final = 0.1
"""Share of error frames from which a bus is called disturbed."""


class Traffic:
    """A tap that counts (see flasher.driver)."""

    def __init__(self) -> None:
        self.frames = 0
        self.error_frames = 0
        self.bits = 0
        """Bit times of the frames on the wire."""

    def __call__(self, frame: Frame, *, sent: bool, now: float) -> None:
        """Count a frame."""
        if frame.is_error:
            self.error_frames += 1
            return
        self.frames += 1
        self.bits += bits_of(frame)


@dataclass(frozen=True)
class Listened:
    """What was heard, for how long, and how."""

    traffic: Traffic
    survey: Survey
    health: LinkHealth
    duration_s: float
    bitrate_bps: int
    dialect: Dialect
    is_silent: bool
    """True when the adapter acknowledged nothing (listen-only)."""
    bus_arguments: str
    """What chooses this bus on the command line."""

    @property
    def frames_per_s(self) -> float:
        """Frames of the wire a second."""
        return self.traffic.frames / self.duration_s if self.duration_s else 0.0

    @property
    def load(self) -> float:
        """Share of the bus's time that the frames took, 0 to 1."""
        return self.traffic.bits / self.bitrate_bps / self.duration_s if self.duration_s else 0.0

    @property
    def foreign_frames(self) -> int:
        """Frames of other protocols; the survey counts error frames among them."""
        return self.survey.foreign_frames - self.traffic.error_frames


def traffic_findings(heard: Listened) -> Iterator[Finding]:
    """How the bus sounds, and who is on it."""
    traffic = heard.traffic
    if not traffic.frames:
        yield _only_errors(heard) if traffic.error_frames else _silence(heard)
        return
    nodes = ", ".join(sorted(node.name for node in heard.survey.heard)) or "no node of the system"
    what = f"{heard.frames_per_s:.0f} frames/s, {heard.load:.0%} load, from {nodes}"
    if heard.foreign_frames:
        what += f"; {counted(heard.foreign_frames, 'frame')} of other protocols"
    yield Finding(Severity.OK if heard.survey.heard else Severity.WARNING, "traffic", what)
    if heard.load > _HIGH_LOAD:
        what = "the bus is nearly full: an upgrade will be slow, and answers come late"
        fix = (f"flasher monitor {heard.bus_arguments}",)
        yield Finding(Severity.WARNING, "traffic", what, fix)
    if traffic.error_frames:
        many = traffic.error_frames > _MANY_ERRORS * traffic.frames
        what = f"{counted(traffic.error_frames, 'error frame')} among {traffic.frames:,} frames"
        yield Finding(
            Severity.WARNING if many else Severity.NOTE,
            "traffic",
            f"{what}{_reported(heard.health)}",
            ("check wiring, termination (60 ohms between CAN-H and CAN-L) and ground",),
        )
    yield from _nodes(heard)


def _reported(health: LinkHealth) -> str:
    return f", the last: {health.last_trouble.words}" if health.last_trouble else ""


def _only_errors(heard: Listened) -> Finding:
    causes = f"the bus runs at another bit rate than {heard.bitrate_bps / 1000:g} kbit/s, or "
    causes += (
        "one device is alone there and nobody acknowledges it while flasher only listens"
        if heard.is_silent
        else "CAN-H and CAN-L are swapped, or termination is missing"
    )
    other = "motinova" if heard.dialect.name == "welling" else "welling"
    errors = counted(heard.traffic.error_frames, "error frame")
    return Finding(
        Severity.PROBLEM,
        "traffic",
        f"{errors} and nothing else{_reported(heard.health)}: {causes}",
        (f"flasher doctor --dialect {other} {heard.bus_arguments}".rstrip(),),
    )


def _silence(heard: Listened) -> Finding:
    return Finding(
        Severity.WARNING,
        "traffic",
        f"the bus was silent for {heard.duration_s:g} s. In this order: the system is off or "
        "asleep (press its key); a device that is alone speaks only when asked (flasher scan asks "
        "it); wiring or connector; another bit rate",
        (f"flasher scan {heard.bus_arguments}".rstrip(),),
    )


def _nodes(heard: Listened) -> Iterator[Finding]:
    survey = heard.survey
    if Node.CDL in survey.heard:
        yield Finding(
            Severity.PROBLEM,
            "traffic",
            "another tool speaks as CDL on this bus: two at once spoil an upgrade",
            ("wait if it upgrades a device; else close the other tool, or disconnect it",),
        )
    for node, said in sorted(survey.heard.items(), key=lambda pair: pair[0].value):
        if any(isinstance(content, contents.Shutdown) for content in said.last.values()):
            what = f"the {node.name} sent the command SHUTDOWN: the system switches off"
            yield Finding(Severity.WARNING, "traffic", what, ("press the key of the system",))
        if said.boot_version:
            what = f"the {node.name} is in its bootloader ({said.boot_version})"
            fix = f"flasher flash IMAGE -t {node.name.lower()} {heard.bus_arguments}".rstrip()
            yield Finding(Severity.NOTE, "traffic", what, (fix,))
        if said.damaged:
            what = f"the {node.name} sent {counted(said.damaged, 'run')} of bytes that made no "
            yield Finding(Severity.NOTE, "traffic", f"{what}message")
    guessed, why = survey.guess_dialect()
    if guessed is not None and guessed is not heard.dialect:
        fix = f"flasher doctor --dialect {guessed.name} {heard.bus_arguments}".rstrip()
        what = f"the bus speaks {guessed.name}, not {heard.dialect.name}: {why}"
        yield Finding(Severity.WARNING, "traffic", what, (fix,))
