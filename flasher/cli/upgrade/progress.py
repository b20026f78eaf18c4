"""How an upgrade goes, on stderr: a bar on a terminal, one line a phase elsewhere."""

from __future__ import annotations

import contextlib
import sys
from types import TracebackType
from typing import Any, Final, Self

from flasher import events
from flasher.cli.output import Output
from flasher.cli.terminal import painted
from flasher.host.table import Reason
from flasher.image.plan import Plan
from flasher.prose import prose, prose_of
from flasher.protocol.spec import PACKET_DATA_SIZE

SHOWN: Final = frozenset(
    {
        events.PacketAcknowledged,
        events.PhaseEntered,
        events.BootVersionSeen,
        events.AttemptStarted,
        events.MessageRepeated,
        events.Reported,
        events.CheckMade,
        events.PowerCycleAwaited,
        events.ShutdownHeard,
        events.ForeignQuery,
        events.AdapterLost,
        events.AdapterBack,
        events.BytesDamaged,
    }
)
"""The events that have lines or a bar of their own here: the log on stderr leaves them out."""


_BECAUSE: Final = {
    Reason.PACKET_REFUSED.value: "the device refused {what}",
    Reason.PACKET_UNANSWERED.value: "the device did not answer {what} in time",
    Reason.PACKET_GIVEN_UP.value: "the device did not take a packet, however often it was sent",
    Reason.REQUEST_AGAIN.value: "the device requested the transfer once more",
    Reason.REQUEST_LATE.value: "the device requested the transfer anew in the middle of it",
    Reason.RESTARTED.value: "the device restarted",
    Reason.BOOT_GIVEN_UP.value: "the device did not announce its bootloader",
    Reason.BOOT_SILENT.value: "the device neither answered the reset nor announced its bootloader",
    Reason.REQUEST_GIVEN_UP.value: "the device did not request the transfer in time",
    Reason.END_REFUSED.value: "the device refused the {what}",
    Reason.END_UNANSWERED.value: "the device did not answer the {what} in time",
    Reason.LINK_BACK.value: "the adapter was away for a while",
}
"""Why something is sent again, for people, by the engine's name for it."""


def because(reason: str, what: str = "") -> str:
    """The sentence for a reason of `MessageRepeated` and `AttemptStarted`."""
    return _BECAUSE.get(reason, "{reason}").format(what=what, reason=reason)


class Progress:
    """Takes the events of an upgrade and shows them."""

    def __init__(self, plan: Plan, output: Output) -> None:
        self._plan = plan
        self._output = output
        self._bar: Any = None
        self._repetitions = 0
        self._wants_bar = sys.stderr.isatty() and output.verbosity >= 0

    def __enter__(self) -> Self:
        self._output.shown_events = SHOWN
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._close_bar()
        self._output.shown_events = frozenset()

    def __call__(self, event: object) -> None:
        """Show one event. A terminal that is gone does not end the upgrade."""
        try:
            self._show(event)
        except OSError:
            self._wants_bar = False
            self._forget_bar()

    def _show(self, event: object) -> None:
        output = self._output
        match event:
            case events.PacketAcknowledged(number, total, _):
                self._move(number, total)
            case events.PhaseEntered(phase, _):
                if phase is not events.Phase.TRANSFER:
                    self._close_bar()
                output.progress(f"{prose(phase)} ...")
            case events.AttemptStarted(attempt, reason):
                self._close_bar()
                output.progress(f"{because(reason)}: beginning again, attempt {attempt}")
            case events.PowerCycleAwaited(limit_s):
                self._prompt(limit_s)
            case events.MessageRepeated(what, reason, tries):
                self._repetitions += 1
                text = f"{because(reason, what)}: sending {what} again, try {tries}"
                output.progress(text, level=1)
            case _ if warning := _warning(event):
                self._close_bar()
                output.error_line(f"warning: {warning}")
            case _ if note := _note(event):
                text, level = note
                output.progress(text, level=level)

    def _prompt(self, limit_s: float) -> None:
        """What the user has to do now, so that it is seen."""
        text = f"power-cycle the device now (waiting {limit_s:g} s)"
        bold = painted(text, "yellow") if self._output.colour else text
        self._output.error_line(f">>> {bold}")

    def _move(self, number: int, total: int) -> None:
        if not self._wants_bar:
            return
        if self._bar is None:
            self._bar = self._open_bar()
        size_bytes = self._plan.image.size_bytes
        self._bar.update(min(number * PACKET_DATA_SIZE, size_bytes) - self._bar.n)
        if self._repetitions:
            self._bar.set_postfix_str(f"{self._repetitions} repeated", refresh=False)
        if number == total:
            self._close_bar()

    def _open_bar(self) -> Any:
        from tqdm import tqdm  # noqa: PLC0415  only where a bar is shown

        bar = tqdm(
            total=self._plan.image.size_bytes,
            unit="B",
            unit_scale=True,
            desc=self._plan.target.node.name,
            file=sys.stderr,
            dynamic_ncols=True,
        )
        self._output.write_stderr = lambda text: bar.write(text, file=sys.stderr)
        return bar

    def _close_bar(self) -> None:
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.close()
            self._forget_bar()

    def _forget_bar(self) -> None:
        self._bar = None
        self._output.restore_stderr()


def _warning(event: object) -> str:
    """What nobody should miss, in words; empty for any other event."""
    match event:
        case events.ShutdownHeard(sender):
            return f"the {sender} sent the command SHUTDOWN: it switches off"
        case events.ForeignQuery(title):
            return f"another tool asks the device ({title}); the upgrade goes on. End that tool."
        case events.AdapterLost(reason, wait_s):
            return f"{reason} Waiting {wait_s:g} s for the adapter ..."
        case events.CheckMade(_, "warned" | "waived", text):
            return text
        case _:
            return ""


def _note(event: object) -> tuple[str, int] | None:
    """A line and the level of verbosity that shows it; None for an event without a line."""
    match event:
        case events.BootVersionSeen(name, version):
            return f"boot version: {name} {version}", 0
        case events.CheckMade(_, verdict, text):
            return f"check: {verdict}: {text}", 1 if verdict == "passed" else 0
        case events.AdapterBack():
            return "the adapter is back", 0
        case events.Reported(what):
            return f"note: {what}", 1
        case events.BytesDamaged(can_id, reason, data):
            why = prose_of("DamageReason", reason)
            return f"bytes on 0x{can_id:03X} ignored: {why}: {data[:24].hex(' ')}", 2
        case _:
            return None
