"""Restores the device to the known state: the application of the good image runs.

Tries the protocol first, then a power cycle. The report distinguishes cases after which only a
power cycle helped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from flasher.conformance.bench import Bench
from flasher.conformance.diagnosis import diagnose
from flasher.conformance.profile import ConformanceProfile
from flasher.conformance.results import (
    CaseEnded,
    CaseLimitReached,
    DeviceCrashed,
    RunStopped,
    TraceEntry,
)
from flasher.conformance.subject import SIMULATED_BUS, Subject
from flasher.conformance.waits import Waits
from flasher.conformance.wire import Reply, reported_version

_MARGIN_S: Final = 60.0
_ASK_S: Final = 0.4
_UPGRADE_TRIES: Final = 3
BY_NOTHING: Final = "it ran"
BY_UPGRADE: Final = "upgrade"
BY_POWER: Final = "power cycle, then upgrade"


class RestoreResult(NamedTuple):
    """Result of `restore`: `how` is one of the texts above, or "" with a `reason` when all ways
    failed.
    """

    how: str
    reason: str = ""
    trace: tuple[TraceEntry, ...] = ()
    """Frames of all attempts, when none succeeded."""
    diagnosis: tuple[str, ...] = ()
    """Diagnosis of the received frames; empty for a device that crashed."""

    @property
    def ok(self) -> bool:
        return bool(self.how)


def restore(
    subject: Subject,
    profile: ConformanceProfile,
    *,
    flash: bool,
    stopped: Callable[[], bool] = lambda: False,
) -> RestoreResult:
    """Make the application of the good image run; with `flash` it is always flashed.

    Raises BusError when the adapter fails, RunStopped when the run is to end.
    """
    reasons: list[str] = []
    trace: list[TraceEntry] = []
    crashed = False
    began_at = subject.port.now()
    ways: list[tuple[str, Callable[[Bench], str]]] = []
    if not flash:
        ways.append((BY_NOTHING, _check_version))
    ways.append((BY_UPGRADE, _upgrade))
    if subject.has_power:
        ways.append((BY_POWER, _power_cycle))
    for how, way in ways:
        limit_s = _limit_s(subject, profile)
        bench = Bench(subject, profile, limit_s=limit_s, stopped=stopped)
        try:
            reason = way(bench)
        except RunStopped:
            raise
        except CaseLimitReached:
            reason = f"not finished after {limit_s:g} s"
        except CaseEnded as ended:
            reason = str(ended)
            crashed = crashed or isinstance(ended, DeviceCrashed)
        if not reason:
            return RestoreResult(how)
        reasons.append(f"{how}: {reason}")
        later_s = bench.tester.began_at - began_at
        trace += [one._replace(at_s=one.at_s + later_s) for one in bench.tester.trace]
    has_wires = subject.port.timestamp_source != SIMULATED_BUS
    diagnosis = [] if crashed else diagnose(trace, bench.encoder, has_wires=has_wires)
    return RestoreResult("", "; ".join(reasons), tuple(trace), tuple(diagnosis))


def is_reachable(
    subject: Subject, profile: ConformanceProfile, stopped: Callable[[], bool] = lambda: False
) -> bool:
    """True when the bootloader announces itself after a reset, a pause or a power cycle: a device
    that cannot be upgraded can still be judged. Raises like `restore`.
    """
    bench = Bench(subject, profile, limit_s=_limit_s(subject, profile), stopped=stopped)
    within_s = profile.limit("first_version_s") + profile.limit("pause_s")
    try:
        bench.send(bench.encoder.reset())
        if bench.wait_for(Reply.BOOT_VERSION, within_s=within_s) is not None:
            return True
        if subject.has_power:
            bench.power_cycle()
            return bench.wait_for(Reply.BOOT_VERSION, within_s=within_s) is not None
    except RunStopped:
        raise
    except CaseEnded:
        return False
    return False


def may_need_power(profile: ConformanceProfile) -> bool:
    """True when the profile allows a device on which only a power cycle ends a transfer."""
    only_power = (("tx_12", "waits"), ("tx_13", "ignored"), ("up_08", "rejected"))
    return all(profile.choice(key) in (value, "either") for key, value in only_power)


def needs_power(profile: ConformanceProfile) -> bool:
    """True when the profile says that only a power cycle ends a transfer."""
    choices = (profile.choice("tx_12"), profile.choice("tx_13"), profile.choice("up_08"))
    return choices == ("waits", "ignored", "rejected")


def _limit_s(subject: Subject, profile: ConformanceProfile) -> float:
    """Time limit of one attempt, each of whose upgrades may start over three times."""
    waits = Waits(profile, subject.port.bitrate_bps)
    return 3 * _UPGRADE_TRIES * waits.upgrade_s(len(subject.good_image)) + _MARGIN_S


def _check_version(bench: Bench) -> str:
    wanted = reported_version(bench.subject.target, bench.good_image)
    if wanted is None:
        return "" if bench.application_runs() else "no application answers"
    found = bench.application_version(bench.limit("start_s"))
    if found is None:
        return "no application answers"
    return "" if found == wanted else f"version {found!a}, not {wanted}"


def _upgrade(bench: Bench) -> str:
    """Upgrade by the protocol, whatever a reset (TX-13) or update command (UP-08) does during a
    transfer; repeats the attempt, as a burst may have just started or ended.
    """
    blind = bench.choice("up_08") != "rejected"
    reason = ""
    for attempt in range(_UPGRADE_TRIES):
        if attempt and bench.choice("tx_12") != "waits":
            bench.wait(bench.limit("pause_s"))
        is_last, tells = attempt == _UPGRADE_TRIES - 1, bench.encoder.has_version_query
        reset = not (blind and tells) or is_last or bench.application_version(_ASK_S) is not None
        # Without an application it may listen silently (RS-03).
        reason = _upgraded(bench, reset=reset, blind=blind or attempt > 0)
        if not reason:
            break
    return reason


def _upgraded(bench: Bench, *, reset: bool, blind: bool = False) -> str:
    ended = bench.upgrade(bench.good_image, reset=reset, blind=blind)
    return _check_version(bench) if ended.ok else ended.reason


def _power_cycle(bench: Bench) -> str:
    bench.power_cycle()
    return _upgraded(bench, reset=False)
