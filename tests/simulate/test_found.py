"""Plans that showed a fault of the host, kept as they were found."""

from __future__ import annotations

import pytest

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
        # In the first answer of the version check, and in the wait for a second one's.
        "job packets=4 timeout=0.8618 ; mock start_delay_s=0.5",
        "job packets=4 timeout=0.95 ; mock start_delay_s=0.5",
    ],
)
def test_the_deadline_counts_while_a_second_device_is_waited_for(line: str) -> None:
    verdict = play(Plan.parse(line))
    assert verdict.violations == ()
    assert (verdict.ending, verdict.exit_code) == ("completed, no_answer", ExitCode.VERIFICATION)


def test_ctrl_c_ends_the_wait_for_a_second_device() -> None:
    verdict = play(Plan.parse("job packets=4 ; mock ; @end+0.05 interrupt"))
    assert (verdict.ending, verdict.exit_code) == ("completed, interrupted", ExitCode.INTERRUPTED)


def test_ctrl_c_ends_the_wait_for_a_device_without_power() -> None:
    line = "job packets=5 others=false ; independent ; @packet2 power seconds=20 ; @4 interrupt"
    verdict = play(Plan.parse(line))
    assert (verdict.exit_code, verdict.violations) == (ExitCode.INTERRUPTED, ())
    assert verdict.took_s < 8.0


_TWO_DEVICES = "job packets=60 ; independent {0} ; independent answers=false {0}"


@pytest.mark.slow
@each(
    "choices, ending",
    [("", "completed, in_bootloader"), ("empty=listens", "completed, no_answer")],
)
def test_a_second_device_that_lost_its_application_needs_a_rescue(
    choices: str, ending: str
) -> None:
    """It is in its bootloader, and the other one confirms for both and answers no query."""
    devices = _TWO_DEVICES.format(choices)
    verdict = play(Plan.parse(f"{devices} ; @packet41 power ; @packet82 busoff"))
    assert verdict.violations == ()
    assert (verdict.ending, verdict.left) == (ending, "none / new")


@pytest.mark.slow
@each(
    "line",
    [
        """
        job ; independent {0} ; independent {0} ; @flash112+0.000756 hang seconds=1.230382
        @end restart
        """,
        # Two restarts look like one device that passes through its bootloader twice.
        """
        job packets=300 image=980 ; mock reset_delay_s=0.447516 after_complete=restarts
        mock version=V1r1r0_20230101 reset_delay_s=0.447516 after_complete=restarts
        @packet10+0.049042 power seconds=3.328559
        """,
    ],
)
def test_a_restart_after_the_last_packet_looks_like_the_start_of_the_new_application(
    line: str,
) -> None:
    choices = (
        "restart=0.28644 window=0.674998 empty=listens erase=1.505184 bad_packet=nak_received"
        " older_packet=silent store=0.141036 start=0.306286 app_upgrade=silent"
    )
    verdict = play(Plan.parse(line.format(choices)))
    assert [each.kind for each in verdict.violations] == ["UNSEEN"]
    assert (verdict.ending, verdict.left) == ("completed", "none / new")


def test_frames_that_a_killed_process_left_in_its_adapter_are_those_of_a_host() -> None:
    """They leave when a device that acknowledges them has power again."""
    verdict = play(
        Plan.parse(
            "job packets=10 others=false ; independent spacing=0.0481 listens=after_burst"
            " empty=listens deaf_in_erase=true update_again=ignored start=0.028774"
            " ; @packet5+0.002032 power seconds=14.760073"
            " ; @1.310641 kill again=8.261613 rescue=true"
        )
    )
    assert verdict.violations == ()


@pytest.mark.slow
@each(
    "line",
    [
        # Pauses cut packets, whose refusals wait in the adapter.
        """
        job target=wmc packets=18 gap=0.051 ; mock bad_packet=nak_received
        @packet7+0.000125 stall seconds=1.6 ; @packet10+0.0034 stall seconds=1.5
        @packet13+0.0034 stall seconds=1.5
        """,
        # A host that paused reads boot versions of different times at once.
        """
        job packets=8 gap=0.024 ; mock reset_in_transfer=restarts after_complete=restarts
        @end+0.147118 stall seconds=6.62761 ; @packet2 power seconds=0.070656
        """,
        # A bootloader that starts its application hangs in its announcement.
        "job ; mock after_complete=restarts ; @end+0.113727 hang seconds=4.939419",
        # An answer that is late by more than the rest of the run would disturb the next one.
        """
        job packets=45 timeout=3.8 ; independent application=none store=0.031856
        @packet29 answer becomes=twice shift=-1 late=7.409289 count=2
        @update hang seconds=1.047747
        """,
        # A line doubles a boot version.
        "job target=obc ; independent begins=boot ; @update answer becomes=twice",
        # Frames that waited for a device's power leave when it is back, not before.
        """
        job packets=5 others=false ; independent erase=3.598112 store=0.000289
        @frame75 interrupt ; @packet2 power seconds=7.357221
        """,
        # An update command with gaps takes longer than the device listens.
        """
        job packets=10 gap=0.056 ; adapter echoes=true delay=0.000477 jitter=0.005232 seed=60055551
        independent restart=0.220692 listens=after_burst window=0.121274
        """,
        # A packet that has begun is finished.
        """
        job timeout=3.7 gap=0.078 ; adapter echoes=true delay=0.164021 queue=2 seed=60030255
        mock application=none window_s=0.103743 erase_time_s=0.184007 program_time_s=0.000806
        """,
        # A host that paused reads a second request for packet 1 when it has sent it.
        """
        job packets=4 ; adapter echoes=true delay=0.001482 seed=60047295
        independent begins=boot spacing=0.0489 update_in_transfer=ignored session=2.0
        independent begins=boot spacing=0.0489 update_in_transfer=ignored session=2.0 late=1.9e-05
        @update stall seconds=2.970722
        """,
        # A pause cuts packet 1, and the answer to a second update command comes meanwhile.
        """
        job packets=3 gap=0.037 ; independent restart=0.02 erase=0.07 update_again=erases store=0.25
        @packet1 stall
        """,
        # A device that restarts more slowly than the tool waits.
        "job packets=4 ; independent restart=4.999772",
        "job packets=4 ; mock reset_delay_s=5.00062",
        # The third frame of packet 2 begins as a message does; a stray boot version is no restart.
        "job packets=10 image=471 ; mock ; @packet2 unsolicited what=boot",
        # A question in which this computer paused is sent again.
        "job packets=3 gap=0.052 ; @0.144301 stall seconds=0.076924",
        # The answer to the first copy of a packet arrives late, after the second copy.
        "job packets=4 ; mock ; @packet2+0.0075 delay count=8 seconds=0.425",
        """
        job packets=8 gap=0.028 ; mock program_time_s=0.136398
        @packet4 tool count=5 every=1.189281 ; @packet4 delay sender=device count=2 seconds=1.266394
        """,
        # Copies of a packet wait in an adapter that is alone on the bus.
        """
        job packets=4 others=false ; independent restart=0.771168
        @packet2+0.0025 power seconds=1.113372
        """,
        # Another tool sends the same update command at the same time.
        "job packets=3 ; @0.2848 tool does=updates",
        # Ctrl-C comes with a frame that waited in an adapter that was alone on the bus.
        "job packets=3 others=false ; mock ; @frame75 interrupt ; @packet2 power seconds=7",
        # The second end of transfer is sent in the same bits as that of another tool.
        """
        job packets=3 short=64 ; independent store=0.000688
        @packet3 unsolicited count=20 ; @end tool does=ends
        """,
        # Two restarts of a device whose application answers no query: two bursts, then silence.
        """
        job packets=3 image=952 ; independent after_complete=restarts answers=false
        @packet1+0.000665 restart ; @end+1.1 restart
        """,
    ],
)
def test_what_only_looks_like_a_fault_is_none(line: str) -> None:
    assert play(Plan.parse(line)).violations == ()


@each(
    "line",
    [
        "job packets=4 ; independent restart=4.997",
        # Its application starts through the bootloader, 5.1 s after the final answer.
        "job packets=4 ; independent window=0.95 after_complete=restarts start=1.97",
    ],
)
def test_a_device_that_restarts_in_time_is_upgraded(line: str) -> None:
    verdict = play(Plan.parse(line))
    assert (verdict.ending, verdict.violations) == ("completed", ())


@each(
    "line",
    [
        """
        job packets=3 ; mock reset_delay_s=0.413 start_delay_s=0.011 erase_time_s=0.0007
        @end+0.05 stall ; @end+0.1 tool does=resets ; @end+0.5 tool does=packets
        @end+0.6 tool does=updates
        """,
        # This target has no version query.
        """
        job target=obc packets=8 ; mock ; @end+0.000118 stall seconds=1.8
        @end+0.05 tool does=packets ; @end+0.3 tool does=updates
        """,
    ],
)
def test_a_second_tool_that_wrote_in_a_pause_of_this_computer_is_seen(line: str) -> None:
    verdict = play(Plan.parse(line))
    assert (verdict.ending, verdict.violations) == ("completed, second_tool", ())


def test_a_boot_version_that_is_arriving_when_the_upgrade_begins_counts() -> None:
    """Soon after it the reset is confirmed, so that an application is there as well (R27)."""
    choices = "application=none drift=0.007 confirms_writes=true answers=false"
    verdict = play(Plan.parse(f"job packets=3 gap=0.03 ; independent {choices}"))
    assert verdict.violations == ()
