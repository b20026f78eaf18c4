"""The page that `flasher explain --html` writes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flasher.report.base import Status
from flasher.report.explain_page import render, status_of
from flasher.trace.story import Cause, PacketStory, Recorded, Story
from tests.loops import each
from tests.report import stories
from tests.report.pages import Page, assert_self_contained, assert_visible

MEGABYTE = 1_000_000

EVERY_KIND = {
    "one packet": stories.story(stories.upgrade(1)),
    "good": stories.story(stories.upgrade()),
    "troubled": stories.story(stories.troubled_upgrade()),
    "two": stories.story(stories.troubled_upgrade(), stories.upgrade(40, "WMC")),
    "no upgrade": stories.story(),
    "empty": stories.empty_story(),
}


@pytest.mark.slow
@each("name", EVERY_KIND)
def test_every_page_is_well_formed_and_complete_in_itself(name: str) -> None:
    page = Page(render(EVERY_KIND[name]))
    assert_self_contained(page)
    assert_visible(page.html)
    assert "http:" not in page.html
    assert "https:" not in page.html
    for drawing in page.drawings:
        box = drawing.attrib["viewBox"].split()
        assert float(box[2]) > 0
        assert float(box[3]) > 0


def test_a_drawing_with_meaning_has_a_title_and_a_description() -> None:
    page = Page(render(EVERY_KIND["troubled"]))
    meant = [one for one in page.drawings if one.get("aria-hidden") != "true"]
    assert len(meant) >= 8
    for drawing in meant:
        assert drawing.findtext("title")
        assert drawing.findtext("desc")
        assert drawing.get("role") in {"img", "group"}


def test_the_verdict_comes_first() -> None:
    reported = Page(render(EVERY_KIND["troubled"])).text
    places = [
        reported.index(text)
        for text in (
            "went wrong",
            "stopped answering at packet 311 of 613",
            "transferring, packet 311",
            "the battery switched itself off",
            "Wake the battery",
            "Phases",
            "Messages",
            "Answer time of each packet",
            "Link report",
            "Packets with trouble",
            "Other senders",
            "The bus",
            "How to read this page",
        )
    ]
    assert places == sorted(places)


def test_a_good_upgrade_names_the_running_version_and_no_trouble() -> None:
    page = Page(render(EVERY_KIND["good"]))
    assert "went well" in page.text
    assert "V1r0r4_20220512" in page.text
    assert "packets 1 to 613 acknowledged" in page.text
    assert "None: every packet was sent once and acknowledged." in page.text
    assert 'class="trouble"' not in page.html


def test_the_answer_times_of_packets_sent_once_are_counted() -> None:
    reported = Page(render(EVERY_KIND["troubled"])).text
    assert "How many packets were answered in which time" in reported
    assert "307 values from 1 ms to 80 ms" in reported
    assert "How many packets" not in Page(render(EVERY_KIND["one packet"])).text


def test_packets_with_trouble_are_listed_with_their_copies() -> None:
    page = Page(render(EVERY_KIND["troubled"]))
    rows = page.text[page.text.index("Packets with trouble") :]
    assert "200 1 2.430 s 3 2 2.431 s 3 ms" in rows
    assert "311 1 3.600 s 5 1 never" in rows
    assert " 42 1 " not in rows


def test_a_trace_without_an_upgrade_is_reported_as_such_with_its_senders() -> None:
    page = Page(render(EVERY_KIND["no upgrade"]))
    assert "This trace holds no upgrade." in page.text
    assert "handshake" in page.text
    assert "BMS > all" in page.text
    assert "18FF50E5" in page.text
    assert "Link report" not in page.text
    names = [one.text for one in page.drawings[0].iter("text") if one.get("class") == "mid strong"]
    assert sorted(filter(None, names)) == ["BMS", "OBC", "WMC"]


def test_an_empty_trace_is_a_page_too() -> None:
    page = Page(render(EVERY_KIND["empty"]))
    assert "There is no frame in this trace." in page.text
    assert "There is no sender." in page.text
    assert page.drawings == []


@pytest.mark.slow
def test_the_wall_time_is_shown_in_utc_and_nonsense_is_left_out() -> None:
    good = EVERY_KIND["good"]
    assert "from 2026-09-10 00:26:40 UTC on" in Page(render(good)).text
    for nonsense in (1e300, float("nan"), None):
        assert "UTC" not in Page(render(replace(good, started_at=nonsense))).text


def test_what_the_recording_tool_noted_is_shown() -> None:
    reported = Recorded(
        "flasher flash bms.hex -t bms", 7, "a packet was not acknowledged\n  where: x"
    )
    page = Page(render(replace(EVERY_KIND["troubled"], recorded=reported)))
    assert "exit code 7" in page.text
    assert "a packet was not acknowledged" in page.text


@pytest.mark.slow
@each("text", stories.HOSTILE)
def test_hostile_text_is_shown_and_does_nothing(text: str) -> None:
    printed = replace(stories.hostile_story(text), recorded=Recorded(text, None, text))
    page = Page(render(printed))
    assert_self_contained(page)
    assert_visible(page.html)
    harmless = Page(render(replace(stories.hostile_story("x"), recorded=Recorded("x", None, "x"))))
    count = {tag: harmless.tags.count(tag) for tag in ("svg", "section", "h1", "style", "title")}
    assert {tag: page.tags.count(tag) for tag in count} == count
    if "<" in text:
        assert text not in page.html.replace("</style>", "", 1)
        assert text in page.text


@pytest.mark.slow
def test_very_long_texts_are_cut() -> None:
    html = render(stories.hostile_story("x" * 100_000))
    assert len(html) < 60_000


@pytest.mark.slow
@pytest.mark.no_cover
def test_the_largest_upgrade_makes_a_page_of_bounded_size() -> None:
    html = render(stories.story(stories.upgrade(65_535)))
    assert len(html.encode()) < MEGABYTE / 4
    assert "65,535 packets" in html


@pytest.mark.slow
def test_a_trace_full_of_trouble_makes_a_page_of_bounded_size() -> None:
    packets = tuple(
        PacketStory(number, attempt, 5, 4, number / 10, None, None)
        for attempt in range(1, 6)
        for number in range(1, 801)
    )
    steps = tuple(
        stories.says(number / 10, "BMS>CDL", "NAK", f"number {number} " * 9, trouble=True)
        for number in range(2_000)
    )
    bad = replace(
        stories.troubled_upgrade(),
        packets=packets,
        steps=steps,
        attempts=5,
        remarks=("again",) * 500,
    )
    printed = replace(
        stories.story(*[bad] * 10), talkers=stories.talkers() * 3000, talkers_left_out=7
    )
    page = Page(render(printed))
    assert len(page.html.encode()) < 1.2 * MEGABYTE
    assert "3,975 more are not listed." in page.text
    assert "5,907 more are not listed." in page.text
    assert "460 more remarks" in page.text
    assert "steps not drawn" in page.text
    assert "More upgrades in this trace" in page.text


def test_each_of_the_last_attempts_has_its_latency_chart() -> None:
    good = stories.upgrade(20)
    packets = tuple(
        stories.good_packet(number, attempt) for attempt in range(1, 6) for number in range(1, 21)
    )
    reported = Page(render(stories.story(replace(good, attempts=5, packets=packets)))).text
    assert [f"each packet, attempt {attempt} " in reported for attempt in range(1, 6)] == [
        False,
        False,
        True,
        True,
        True,
    ]


def test_an_upgrade_that_never_sent_a_packet_has_neither_chart_nor_link_report() -> None:
    bare = replace(
        stories.upgrade(1),
        packets=(),
        link=None,
        phases=(),
        steps=(),
        image_size_bytes=None,
        total_packets=None,
        boot_version=None,
        running_version=None,
    )
    reported = Page(render(stories.story(bare))).text
    assert "never announced" in reported
    assert "size not in the trace" in reported
    assert "Link report" not in reported
    assert "Answer time of each packet" not in reported


def test_figures_that_were_not_measured_are_named_so() -> None:
    silent = tuple(PacketStory(n, 1, 1, 0, n / 10, None, None) for n in range(1, 4))
    printed: Story = stories.story(
        replace(stories.upgrade(3), packets=silent, link=stories.link_of(silent))
    )
    reported = Page(render(printed)).text
    assert "share of the line rate not measured" in reported
    assert "the device's answer to a packet not measured" in reported


@each(
    "cause, status",
    [
        (Cause.COMPLETED, Status.GOOD),
        (Cause.CONFIRMED_BY_VERSION, Status.GOOD),
        (Cause.UNCONFIRMED, Status.WARNING),
        (Cause.RECORDING_ENDS, Status.WARNING),
        (Cause.OTHER_VERSION, Status.BAD),
        (Cause.REFUSED, Status.BAD),
        (Cause.QUERIES_ONLY, Status.NEUTRAL),
        (Cause.EMPTY, Status.NEUTRAL),
    ],
)
def test_only_what_the_device_confirmed_is_good(cause: Cause, status: Status) -> None:
    assert status_of(cause) is status


def test_other_speakers_share_one_lifeline() -> None:
    crowd = tuple(stories.says(n / 10, f"N{n}>BMS", "hello") for n in range(9))
    printed = replace(stories.upgrade(1), steps=(*stories.opening(), *crowd))
    drawn = Page(render(stories.story(printed))).drawings
    first = next(one for one in drawn if one.get("role") == "group")
    names = [one.text for one in first.iter("text") if one.get("class") == "mid strong"]
    assert names[:2] == ["CDL", "BMS"]
    assert names[-1] == "others"
    assert len(names) == 4
