"""Plans that showed a fault of the host, kept as they were found."""

from __future__ import annotations

from flasher.errors import ExitCode
from flasher.simulate.plan import Plan
from flasher.simulate.play import play
from tests.loops import each


@each(
    "line",
    [
        "job packets=4 timeout=0.683832 ; independent",
        "job packets=4 timeout=0.334824 ; mock",
        "job packets=4 timeout=0.335 ; mock ; @end+0.01 hang seconds=20",
    ],
)
def test_the_deadline_counts_while_a_second_device_is_waited_for(line: str) -> None:
    verdict = play(Plan.parse(line))
    assert verdict.violations == ()
    assert (verdict.ending, verdict.exit_code) == ("completed, no_answer", ExitCode.VERIFICATION)


def test_ctrl_c_ends_the_wait_for_a_second_device() -> None:
    verdict = play(Plan.parse("job packets=4 ; mock ; @end+0.05 interrupt"))
    assert (verdict.ending, verdict.exit_code) == ("completed, interrupted", ExitCode.INTERRUPTED)
