"""Stories for the tests of the report, made by hand: good, troubled, endless, empty, hostile."""

from __future__ import annotations

from dataclasses import replace

from flasher.events import Phase
from flasher.trace.figures import Distribution, LinkReport
from flasher.trace.story import (
    BusFigures,
    Cause,
    PacketRun,
    PacketStory,
    PhaseSpan,
    Step,
    StepKind,
    Story,
    StoryLine,
    Talker,
    TalkerKind,
    TraceVerdict,
    UpgradeStory,
)

CYCLE_S = 0.0104
"""From one packet to the next."""
TALK_AT_S = 0.35
"""When the first packet begins."""


def says(at_s: float, who: str, title: str, text: str = "", *, trouble: bool = False) -> Step:
    """A message; `who` is "CDL>BMS"."""
    sender, receiver = who.split(">")
    return Step(at_s, StepKind.MESSAGE, sender, receiver, title, text, trouble, 0x752)


def answer_s(number: int) -> float:
    """How long the device takes for a packet: mostly 1 to 2 ms, once in a while much longer."""
    return 0.08 if number % 97 == 0 else 0.001 + (number * 37 % 101) / 101_000


def good_packet(number: int, attempt: int = 1, begin_s: float = TALK_AT_S) -> PacketStory:
    sent_s = begin_s + CYCLE_S * number
    took_s = answer_s(number)
    return PacketStory(number, attempt, 1, 0, sent_s, sent_s + took_s, took_s)


def opening(begin_s: float = 0.0) -> list[StoryLine]:
    return [
        says(begin_s + 0.002, "CDL>BMS", "reset"),
        says(begin_s + 0.004, "BMS>CDL", "general feedback"),
        says(begin_s + 0.150, "BMS>CDL", "boot version", "name BMS, version V1.0.0"),
        says(begin_s + 0.152, "CDL>BMS", "update command", "text BMS_UPD, size 78351 B"),
        says(begin_s + 0.350, "BMS>CDL", "request transfer"),
    ]


def phases(end_s: float) -> tuple[PhaseSpan, ...]:
    return (
        PhaseSpan(Phase.RESET, 1, 0.0, 0.004),
        PhaseSpan(Phase.BOOT, 1, 0.004, 0.15),
        PhaseSpan(Phase.UPDATE, 1, 0.15, 0.35),
        PhaseSpan(Phase.TRANSFER, 1, 0.35, end_s - 0.1),
        PhaseSpan(Phase.END, 1, end_s - 0.1, end_s),
    )


def link_of(packets: tuple[PacketStory, ...]) -> LinkReport:
    answers = [packet.answer_s for packet in packets if packet.answer_s is not None]
    return LinkReport(
        packets=len(packets),
        acknowledged=len(answers),
        repetitions=sum(packet.tries - 1 for packet in packets),
        naks=sum(packet.naks for packet in packets),
        line_s=0.009 * len(answers),
        transfer_s=CYCLE_S * len(packets),
        share_of_line_rate=0.87 if answers else None,
        host_turnaround=Distribution.of([0.0002 + value / 20 for value in answers]),
        device_answer=Distribution.of(answers),
    )


def upgrade(count: int = 613, target: str = "BMS") -> UpgradeStory:
    """An upgrade without trouble."""
    packets = tuple(good_packet(number) for number in range(1, count + 1))
    end_s = TALK_AT_S + CYCLE_S * (count + 1) + 0.1
    steps: list[StoryLine] = [
        *opening(),
        PacketRun(1, count, TALK_AT_S, end_s - 0.1),
        says(end_s - 0.09, "CDL>BMS", "end of transfer"),
        says(end_s, "BMS>CDL", "complete"),
    ]
    return UpgradeStory(
        target=target,
        begin_s=0.0,
        end_s=end_s,
        image_size_bytes=count * 128,
        total_packets=count,
        boot_version="BMS V1.0.0",
        running_version="V1r0r4_20220512",
        attempts=1,
        phases=phases(end_s),
        packets=packets,
        steps=tuple(steps),
        steps_left_out=0,
        link=link_of(packets),
        remarks=(),
        verdict=TraceVerdict(
            Cause.COMPLETED, Phase.END, None, 1, "The BMS confirmed it; V1r0r4_20220512 runs."
        ),
    )


def troubled_upgrade() -> UpgradeStory:
    """Packet 311 is refused and unanswered until the tool gives up; a few others are repeated."""
    good = upgrade(310)
    fixed = {40: (2, 1, 0.004), 41: (2, 0, 0.006), 200: (3, 2, 0.003)}
    packets = []
    for packet in good.packets:
        tries, naks, took_s = fixed.get(packet.number, (1, 0, packet.answer_s))
        packets.append(replace(packet, tries=tries, naks=naks, answer_s=took_s))
    packets.append(PacketStory(311, 1, 5, 1, 3.6, None, None))
    steps: list[StoryLine] = [
        *opening(),
        PacketRun(1, 39, 0.35, 0.77),
        says(0.78, "BMS>CDL", "NAK", "number 40", trouble=True),
        says(0.79, "CDL>BMS", "packet", "number 40, total 613, sent again"),
        says(0.80, "BMS>CDL", "ACK", "number 40"),
        PacketRun(41, 310, 0.80, 3.58),
        Step(3.59, StepKind.DAMAGED, "CDL", "BMS", "damaged bytes", "wrong CRC", True, 0x752),
        says(3.6, "BMS>CDL", "NAK", "number 311", trouble=True),
        says(4.1, "BMS>all", "SHUTDOWN", "the battery switches off in one second", trouble=True),
        says(4.12, "WMC>all", "READY"),
        says(4.14, "OBC>all", "READY"),
        Step(4.2, StepKind.ERROR_FRAMES, "", "", "12 error frames", "in 40 ms", True),
        Step(5.2, StepKind.GAP, "", "", "1 s of silence", "", False),
        *(
            says(5.2 + 0.5 * again, "CDL>BMS", "packet", "number 311, no answer", trouble=True)
            for again in range(4)
        ),
        says(9.9, "CDL>BMS", "reset"),
    ]
    return replace(
        good,
        end_s=9.9,
        total_packets=613,
        running_version=None,
        packets=tuple(packets),
        steps=tuple(steps),
        link=link_of(tuple(packets)),
        phases=(*phases(3.7)[:3], PhaseSpan(Phase.TRANSFER, 1, 0.35, 9.9)),
        remarks=("12 error frames around 4.200 s", "the battery announced SHUTDOWN at 4.100 s"),
        verdict=TraceVerdict(
            Cause.SHUTDOWN,
            Phase.TRANSFER,
            311,
            1,
            "The BMS announced SHUTDOWN and stopped answering at packet 311 of 613.",
            "the battery switched itself off: the key was held, or the pack current was low",
            "Wake the battery, keep it awake, and run the same command again.",
        ),
    )


def talkers() -> tuple[Talker, ...]:
    return (
        Talker(0x720, is_extended=False, name="BMS > all", frames=812, kind=TalkerKind.NODE),
        Talker(0x18FF50E5, is_extended=True, name="", frames=90, kind=TalkerKind.FOREIGN),
    )


def story(*upgrades: UpgradeStory, source: str = "upgrade.asc") -> Story:
    """A trace of these upgrades; without one, of some queries."""
    steps: tuple[StoryLine, ...] = ()
    if upgrades:
        verdict = upgrades[0].verdict
    else:
        verdict = TraceVerdict(
            Cause.QUERIES_ONLY, None, None, 0, "No tool upgraded anything: 2 queries were answered."
        )
        steps = (
            says(0.5, "OBC>BMS", "read running information"),
            says(0.51, "BMS>all", "running information", "voltage 38893 mV"),
            says(3.5, "WMC>BMS", "handshake"),
            says(3.51, "BMS>WMC", "READY"),
        )
    duration_s = max((one.end_s for one in upgrades), default=4.0)
    return Story(
        source=source,
        format="asc",
        started_at=1_789_000_000.5,
        duration_s=duration_s,
        bitrate_bps=250_000,
        frames=12_345,
        bus=BusFigures(duration_s, 12_345, 0.81, 0.934, 12, 1, 0, 1.003, 4.2),
        upgrades=upgrades,
        talkers=talkers(),
        verdict=verdict,
        steps=steps,
        steps_left_out=0,
    )


def empty_story() -> Story:
    """A trace with no frame in it."""
    nothing = TraceVerdict(Cause.EMPTY, None, None, 0, "There is no frame in this trace.")
    bus = BusFigures(0.0, 0, None, None, 0, 0, 0, 0.0, 0.0)
    return Story("empty.log", "log", None, 0.0, 250_000, 0, bus, (), (), nothing, (), 0)


HOSTILE = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "'><svg onload=alert(1)>",
    "</style><style>*{display:none}</style>",
    "</title></svg></section><h1>Everything is fine</h1>",
    "{{ 7 * 7 }}{% raw %}",
    "\u202etxet desrever\u202c \u200b\u2066",
    "bell\x07 escape\x1b[31m nul\x00 delete\x7f high\x9b surrogate\udc80",
    "Z\u0310\u0311\u0312a\u0313\u0314lgo",
    "javascript:alert(1) https://example.invalid/x.js",
)


def hostile_story(text: str) -> Story:
    """Every text that could come from outside is `text`."""
    bad = upgrade(3, target=text)
    verdict = TraceVerdict(Cause.REFUSED, Phase.END, 3, 2, text, text, text)
    steps = tuple(
        Step(float(at), kind, sender, receiver, text, text, is_trouble)
        for at, (kind, sender, receiver, is_trouble) in enumerate(
            [
                (StepKind.MESSAGE, "CDL", text, False),
                (StepKind.MESSAGE, text, "CDL", True),
                (StepKind.DAMAGED, text, "all", True),
                (StepKind.NOTE, "", "", False),
            ]
        )
    )
    bad = replace(
        bad,
        boot_version=text,
        running_version=text,
        steps=steps,
        remarks=(text,),
        verdict=verdict,
    )
    printed = story(bad, source=text)
    return replace(
        printed,
        format=text,
        talkers=(Talker(0x123, is_extended=False, name=text, frames=1, kind=TalkerKind.FOREIGN),),
        steps=steps,
        verdict=verdict,
    )
