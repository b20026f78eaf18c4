"""How a dialogue becomes a sequence diagram."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flasher.report.chart import WIDTHS
from flasher.report.sequence import DiagramItem, Part, diagram, thinned

WIDE = WIDTHS["wide"]


def arrow(
    at_s: float, sender: str = "CDL", receiver: str = "BMS", title: str = "reset"
) -> DiagramItem:
    return DiagramItem(at_s, title, "", sender, receiver)


def only(parts: list[Part]) -> Part:
    assert len(parts) == 1
    return parts[0]


def test_an_arrow_goes_from_sender_to_receiver() -> None:
    drawn = only(diagram([arrow(0.1), arrow(0.2, "BMS", "CDL")], ["CDL", "BMS"], WIDE))
    tool, device = drawn.lifelines
    there, back = drawn.rows
    assert (there.begin_x, there.tips) == (tool.x, (device.x,))
    assert (back.begin_x, back.tips) == (device.x, (tool.x,))
    assert there.time == "0.100 s"
    assert there.y < back.top < back.y


def test_a_broadcast_goes_to_everybody_else() -> None:
    drawn = only(diagram([arrow(0, "BMS", "all")], ["CDL", "BMS", "WMC"], WIDE))
    tool, _, motor = drawn.lifelines
    assert drawn.rows[0].tips == (tool.x, motor.x)


def test_an_empty_dialogue_is_no_diagram() -> None:
    assert diagram([], ["CDL", "BMS"], WIDE) == []


def test_a_diagram_needs_somebody() -> None:
    with pytest.raises(ValueError, match="participants"):
        diagram([arrow(0)], [], WIDE)


def test_one_participant_alone_can_be_drawn() -> None:
    drawn = only(diagram([arrow(0, "BMS", "all")], ["BMS"], WIDE))
    assert len(drawn.lifelines) == 1
    assert drawn.rows[0].tips == ()


def test_the_title_is_the_beginning_of_the_first_line() -> None:
    item = DiagramItem(0, "boot version", "name BMS, version V1.0.0", "BMS", "CDL")
    row = only(diagram([item], ["CDL", "BMS"], WIDE)).rows[0]
    assert row.title == "boot version"
    assert row.lines == ("boot version: name BMS, version V1.0.0",)


def test_trouble_is_marked_by_a_sign_too() -> None:
    item = DiagramItem(0, "NAK", "number 3", "BMS", "CDL", is_trouble=True)
    row = only(diagram([item], ["CDL", "BMS"], WIDE)).rows[0]
    assert row.is_trouble
    assert row.lines == ("! NAK: number 3",)


def test_a_long_text_is_broken_into_lines_that_end_in_an_ellipsis() -> None:
    item = DiagramItem(0, "x" * 3000, "word " * 500, "CDL", "BMS")
    row = only(diagram([item], ["CDL", "BMS"], WIDTHS["narrow"])).rows[0]
    assert len(row.lines) <= 4
    assert row.lines[-1].endswith("\u2026")
    assert row.lines[0].startswith(row.title)


def test_escaped_characters_count_with_the_length_that_they_are_shown_with() -> None:
    item = DiagramItem(0, "boot version", "\u202e" * 60, "BMS", "CDL")
    row = only(diagram([item], ["CDL", "BMS"], WIDE)).rows[0]
    assert "\\u202e" in "".join(row.lines)
    assert max(map(len, row.lines)) < 130


def test_a_long_pause_is_reported_and_a_short_one_is_not() -> None:
    drawn = only(diagram([arrow(0), arrow(0.9), arrow(4.4)], ["CDL", "BMS"], WIDE))
    assert [row.lines[0] for row in drawn.rows] == ["reset", "reset", "3.5 s later", "reset"]


def test_a_pause_that_the_dialogue_names_itself_is_not_reported_twice() -> None:
    gap = DiagramItem(4.0, "4 s of silence")
    drawn = only(diagram([arrow(0), gap, arrow(4)], ["CDL", "BMS"], WIDE))
    assert [row.lines[0] for row in drawn.rows] == ["reset", "4 s of silence", "reset"]


def test_a_folded_run_counts_as_talk_until_its_end() -> None:
    run = DiagramItem(0.1, "packets 1 to 300", end_s=3.5)
    drawn = only(diagram([arrow(0), run, arrow(3.6), arrow(5.6)], ["CDL", "BMS"], WIDE))
    assert [row.lines[0] for row in drawn.rows] == [
        "reset",
        "packets 1 to 300",
        "reset",
        "2 s later",
        "reset",
    ]


def test_a_long_diagram_comes_in_parts_that_lose_nothing() -> None:
    items = [arrow(0.1 * number, title=f"step {number}") for number in range(120)]
    parts = diagram(items, ["CDL", "BMS"], WIDE)
    assert len(parts) > 2
    reported = [row.lines[0] for part in parts for row in part.rows]
    assert reported == [item.title for item in items]
    assert all(len(part.lifelines) == 2 and part.height < 900 for part in parts)


def test_a_short_dialogue_is_left_as_it_is() -> None:
    items = [arrow(float(number)) for number in range(10)]
    assert thinned(items, 10) == items


def test_a_long_dialogue_keeps_its_ends_and_what_is_around_troubles() -> None:
    items = [arrow(number / 10, title=f"{number}") for number in range(1000)]
    items[500] = DiagramItem(50.0, "NAK", "", "BMS", "CDL", is_trouble=True)
    titles = [item.title for item in thinned(items, 60)]
    assert titles[:2] == ["0", "1"]
    assert titles[-1] == "999"
    around = titles.index("NAK")
    assert titles[around - 3 : around + 4] == ["497", "498", "499", "NAK", "501", "502", "503"]
    assert titles[around - 4] == "477 steps not drawn"


def test_what_is_left_out_of_a_dialogue_full_of_trouble_is_counted() -> None:
    items = [
        DiagramItem(number / 10, "NAK", "", "BMS", "CDL", is_trouble=True) for number in range(1000)
    ]
    shown = thinned(items, 60)
    assert len(shown) < 80
    blocks = [item for item in shown if not item.sender]
    assert blocks
    assert all("with trouble" in block.text and block.is_trouble for block in blocks)


@pytest.mark.slow
@given(st.lists(st.booleans(), max_size=400), st.integers(9, 60))
def test_thinning_accounts_for_every_step(troubles: list[bool], most: int) -> None:
    items = [
        DiagramItem(number / 10, "x", "", "A", "B", is_trouble=trouble)
        for number, trouble in enumerate(troubles)
    ]
    total = sum(
        int(item.title.split()[0]) if not item.sender else 1 for item in thinned(items, most)
    )
    assert total == len(items)
