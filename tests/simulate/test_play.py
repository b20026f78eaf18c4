"""What plans do to devices and to the host's process."""

from __future__ import annotations

from flasher.simulate.plan import Plan
from flasher.simulate.play import Player
from tests.loops import each


def played(line: str) -> tuple[str, list[str]]:
    """Play a plan without violations; return its ending, and the faults and events."""
    lines: list[str] = []
    verdict = Player(Plan.parse(line), log=lines.append).play()
    assert verdict.violations == ()
    return verdict.ending, lines


def test_flash_operations_are_counted_on_after_one_that_a_power_cut_tore() -> None:
    """An upgrade erases two pages before the first packet."""
    ending, lines = played("job packets=3 ; mock ; @flash3+0.0005 power ; @flash5 power")
    cuts = [index for index, line in enumerate(lines) if line.endswith("power")]
    updates = [index for index, line in enumerate(lines) if "55 aa 16 0d a1 0b" in line]
    packets = [index for index, line in enumerate(lines) if "55 aa 16 87 a3 85" in line]
    assert ending == "completed"
    assert updates[0] < cuts[0] < updates[1] < cuts[1] < updates[2]
    assert not any(updates[1] < each < cuts[1] for each in packets)


@each("rescue, ending", [(False, "no_boot_version"), (True, "completed")])
def test_after_a_kill_rescue_has_an_operator_who_follows_its_prompts(
    *, rescue: bool, ending: str
) -> None:
    """The device is in a session without an end, and takes no update command in it."""
    device = "independent session=0.0 update_in_transfer=ignored"
    kill = f"@packet2 kill rescue={str(rescue).lower()}"
    assert played(f"job packets=3 ; {device} ; {kill}")[0] == ending
