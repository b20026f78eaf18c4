"""`flasher explain`: what it prints, its page and its JSON."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flasher.errors import ExitCode
from flasher.protocol.frame import Frame
from tests.trace.tape import Tape

from .conftest import SAMPLES, Flasher


def failed(folder: Path) -> Path:
    tape = Tape().to_packet(7)
    for _ in range(5):
        tape.packet(7).nak(7)
    return tape.save(folder / "failed.log")


def test_the_verdict_comes_first_then_the_story(flasher: Flasher, tmp_path: Path) -> None:
    run = flasher("explain", failed(tmp_path))
    assert run.code == 0
    lines = run.out.splitlines()
    assert lines[1] == ("verdict: a packet was refused again and again (transferring, packet 7)")
    assert lines[2] == "  Packet 7 of 10 was sent 5 times and refused 5 times (NAK)."
    assert lines[3].startswith("  likely cause: ")
    assert lines[4].startswith("  what to do: ")
    for words in (
        "  boot version:  BMS V1.2.3",
        "packets 1 to 6, acknowledged in",
        "! NAK: number 7",
        "6 of 7 acknowledged, 4 repeated, 5 NAKs",
        "(min / median / p95 / p99 / max)",
        "bus load: ",
    ):
        assert words in run.out


def test_a_foreign_trace_states_that_there_is_no_upgrade(flasher: Flasher, tmp_path: Path) -> None:
    tape = Tape()
    for number in range(30):
        tape.frame(Frame(0x180 + number % 3, bytes([number])))
    run = flasher("explain", tape.save(tmp_path / "foreign.asc"))
    assert run.code == 0
    assert "verdict: no upgrade, only traffic of other kinds" in run.out
    assert "180       foreign     10 frames" in run.out


def test_packets_and_all_show_more(flasher: Flasher, tmp_path: Path) -> None:
    trace = failed(tmp_path)
    run = flasher("explain", trace, "--packets", "--all")
    assert run.out.count("packet: number") == 11
    assert "attempt  packet" in run.out
    assert sum(line.endswith("none") for line in run.out.splitlines()) == 1


def test_json_gives_the_same_as_data(flasher: Flasher, tmp_path: Path) -> None:
    document = flasher("explain", failed(tmp_path), "--json").document
    assert (document["ok"], document["exit_code"]) == (True, 0)
    verdict = document["story"]["verdict"]
    assert (verdict["cause"], verdict["phase"], verdict["packet"]) == (
        "packet_refused", "transfer", 7,
    )  # fmt: skip
    packets = document["story"]["upgrades"][0]["packets"]
    assert [packet["tries"] for packet in packets] == [1] * 6 + [5]


def test_the_page_is_written_beside_the_text(flasher: Flasher, tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    page = tmp_path / "story.html"
    run = flasher("explain", failed(tmp_path), "--html", page)
    assert run.code == 0
    assert "verdict:" in run.out
    assert "a packet was refused again and again" in page.read_text(encoding="utf-8")


def test_a_page_that_cannot_be_written_is_reported_before_the_work(
    flasher: Flasher, tmp_path: Path
) -> None:
    run = flasher("explain", failed(tmp_path), "--html", tmp_path / "none" / "story.html")
    assert run.code == 2
    assert "--html" in run.err
    assert run.out == ""


@pytest.mark.parametrize("name", ["missing.log", "trace.xyz", "."])
def test_what_is_no_trace_is_wrong_usage(name: str, flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "trace.xyz").write_bytes(b"x")
    run = flasher("explain", tmp_path / name)
    assert run.code == 2
    assert "Traceback" not in run.err


def test_hostile_texts_do_not_reach_the_terminal(flasher: Flasher, tmp_path: Path) -> None:
    trace = Tape().reset().feedback().boot(b"\x1b[2J\r\n").save(tmp_path / "hostile.asc")
    run = flasher("explain", trace)
    assert r"\x1b[2J\r\n" in run.out
    assert "\x1b" not in run.out


def test_the_bit_rate_can_be_given(flasher: Flasher, tmp_path: Path) -> None:
    run = flasher("explain", failed(tmp_path), "--bitrate", "500000")
    assert "500 kbit/s" in run.out


def test_a_page_never_replaces_the_trace_that_it_is_made_from(
    flasher: Flasher, tmp_path: Path
) -> None:
    trace = failed(tmp_path)
    before = trace.read_bytes()
    other_name = tmp_path / "same.log"
    other_name.symlink_to(trace)
    for page in (trace, other_name):
        run = flasher("explain", trace, "--html", page)
        assert run.code == ExitCode.USAGE
        assert "is a file of the command itself" in run.err
    assert trace.read_bytes() == before


def test_an_empty_trace_has_no_figures_of_a_bus(flasher: Flasher, tmp_path: Path) -> None:
    empty = tmp_path / "empty.log"
    empty.write_text("")
    assert flasher("explain", empty).out.endswith("bus load: none, the trace has no frames\n")


def test_where_the_trace_of_a_bundle_breaks_off_the_tool_gave_up_and_not_the_recording(
    flasher: Flasher, tmp_path: Path
) -> None:
    run = flasher(
        "flash", SAMPLES / "obc.bin", "-t", "obc", "--mock", "--mock-speed", "0", "--timeout",
        "0.3", "--bundle-dir", tmp_path,
    )  # fmt: skip
    assert run.code == ExitCode.TRANSFER
    (bundle,) = tmp_path.iterdir()
    page = tmp_path / "story.html"
    printed = flasher("explain", bundle, "--html", page).out
    assert "verdict: the tool gave up in the middle (transferring, packet " in printed
    assert "Here the tool ended: OBC: the overall deadline passed." in printed
    assert "the recording was stopped" not in printed
    assert "what to do: Allow more time with --timeout" in page.read_text()
    for name in ("trace.blf", "report.json"):
        refused = flasher("explain", bundle, "--html", bundle / name)
        assert refused.code == ExitCode.USAGE
    assert flasher("explain", bundle).out == printed


def test_what_was_not_answered_is_marked_and_red(
    flasher: Flasher, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape = Tape().reset(2).feedback().boot().update().request()
    tape.packets(1, 4).packet(5).wait(0.5).packet(5).ack(5).packet(6).wait(3.0)
    tape.message(0x710, 0x0C, 0x1305, b"READY")
    path = tape.save(tmp_path / "t.log")
    printed = flasher("explain", path, "--html", tmp_path / "t.html").out.splitlines()
    marked = [line.split("  ! ")[1] for line in printed if "  ! " in line]
    assert marked == [
        "reset: not answered",
        "packet: number 5, total 10, not answered",
        "packet: number 6, total 10, not answered",
    ]
    page = (tmp_path / "t.html").read_text("utf-8")
    assert page.count("not answered") >= 3
    monkeypatch.setattr("flasher.cli.look.explain.takes_colour", lambda _stream: True)
    red = [line for line in flasher("explain", path).out.splitlines() if "\x1b[1;31m" in line]
    assert len(red) == len(marked)


def test_no_share_of_a_line_is_more_than_all_of_it(flasher: Flasher, tmp_path: Path) -> None:
    path = Tape().to_end().complete().save(tmp_path / "t.log")
    for words in ((), ("--html", tmp_path / "t.html")):
        printed = flasher("explain", path, "-b", "20000", *words).out
        assert "more than all of 20 kbit/s" in printed
        shares = re.findall(r"([\d.]+) ?%", printed)
        assert all(float(share) <= 100 for share in shares), printed
    page = (tmp_path / "t.html").read_text("utf-8")
    assert "more than the line carries" in page


def test_a_trace_of_the_conformance_suite_is_no_second_tool(
    flasher: Flasher, tmp_path: Path
) -> None:
    """It breaks the protocol on purpose: a reset and a query in the midst of a transfer."""
    tape = Tape().to_packet(4).ack(4).tool(0x3300, b"", mode=0x11).packet(5).ack(5).reset()
    plain = tape.feedback().boot().save(tmp_path / "plain.log")
    assert "verdict: two tools send on the bus" in flasher("explain", plain).out
    ran = flasher(
        "conformance", "-t", "bms", "--mock", "--trace-dir", tmp_path, "--case", "TX-13",
        "--variant", "reset-in-transfer-hangs",
    )  # fmt: skip
    assert ran.code == ExitCode.PARTIAL, ran.out
    printed = flasher("explain", tmp_path / "TX-13.log").out
    assert "two tools" not in printed
    suite = tmp_path / "suite.log"
    suite.write_text(plain.read_text().replace(" can0 ", " conformance "))
    assert "two tools" not in flasher("explain", suite).out


def test_a_packed_bundle_has_to_be_unpacked_first(flasher: Flasher, tmp_path: Path) -> None:
    (tmp_path / "flasher-bms.zip").write_bytes(b"PK")
    for command in ("explain", "bundle"):
        run = flasher(command, tmp_path / "flasher-bms.zip")
        assert run.code == 2
        assert "Unpack it into a folder of its own" in run.err
