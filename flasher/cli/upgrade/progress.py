"""Progress of an upgrade on stderr: a bar on a terminal, elsewhere one line per phase."""

from __future__ import annotations

from typing import Self

from flasher import events
from flasher.cli.bar import Bar
from flasher.cli.output import Output
from flasher.cli.terminal import painted
from flasher.host.event_text import progress_line, warning_text
from flasher.image.plan import Plan
from flasher.protocol.spec import PACKET_DATA_SIZE


class Progress:
    """Shows the events of an upgrade, and prints them with --events."""

    def __init__(self, plan: Plan, output: Output) -> None:
        self._size_bytes = plan.image.size_bytes
        self._output = output
        self._bar = Bar(output, unit="B", unit_scale=True, desc=plan.target.node.name)
        self._repetitions = 0
        self._wait = Bar(output, bar_format="{desc} |{bar}|")
        self._wait_s = 0.0

    def __enter__(self) -> Self:
        self._output.shows = _is_shown
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
        self._wait.close()
        self._output.shows = lambda _event: False

    def __call__(self, event: object) -> None:
        self._output.event(event)
        match event:
            case events.PacketAcknowledged(number, total, _):
                note = f"{self._repetitions} repeated" if self._repetitions else ""
                done = min(number * PACKET_DATA_SIZE, self._size_bytes)
                self._bar.move_to(done, self._size_bytes, note=note)
                if number == total:
                    self._bar.close()
            case events.PhaseEntered(phase, _) if phase is not events.Phase.TRANSFER:
                self._bar.close()
            case events.AttemptStarted():
                self._bar.close()
            case events.MessageRepeated():
                self._repetitions += 1
            case events.AdapterLost(_, wait_s):
                self._wait_s = wait_s
            case events.AdapterAwaited(left_s):
                self._wait.move_to(self._wait_s - left_s, self._wait_s)
                self._wait.describe(f"waiting for the adapter, {left_s} s left")
            case events.AdapterBack():
                self._wait.close()
            case events.PowerCycleAwaited(limit_s):
                # An instruction to the user must be visible.
                text = f"power-cycle the device now (waiting {limit_s:.0f} s)"
                bold = painted(text, "yellow") if self._output.colour else text
                self._output.error_line(f">>> {bold}")
        if warning := warning_text(event):
            self._bar.close()
            self._output.error_line(f"warning: {warning}")
        elif line := progress_line(event):
            text, level = line
            self._output.progress(text, level=level)


def _is_shown(event: object) -> bool:
    """True for an event with its own line or bar."""
    has_more = isinstance(
        event, events.PacketAcknowledged | events.AdapterAwaited | events.PowerCycleAwaited
    )
    return has_more or bool(warning_text(event) or progress_line(event))
