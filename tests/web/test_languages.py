"""Pages in German and Chinese are whole: of ten common failures nothing stays in English."""

from __future__ import annotations

import html
import re
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from flasher.bus.bit_rate import bit_rate
from flasher.bus.opening import open_bus
from flasher.cli.look.backup import backup_folder
from flasher.protocol.spec import BMS
from flasher.station.board import Board
from flasher.station.certificate import proven, render_certificate
from flasher.station.health import HealthWatch
from flasher.station.label_printer import LabelPrinter, send_tcp
from flasher.station.messages import JournalWrite
from flasher.station.records.model import RunState
from flasher.station.shift_counts import DEFAULT_SHIFTS, ShiftCounts
from flasher.station.socket import Source
from flasher.translation import NAMES, translator
from flasher.web.archive import Archive
from flasher.web.bench import BenchController as BikeBench
from flasher.web.bench_page import BenchPage
from flasher.web.bench_state import BenchState
from flasher.web.operator import CurrentLot, Screen
from flasher.web.operator import _messages as messages
from flasher.web.pages import Pages
from flasher.web.query_processes import Question
from flasher.web.supervisor import open_supervisor
from flasher.web.virtual_bike import BikeFault
from tests.end_to_end.stage import NEW, image_of
from tests.loops import each
from tests.station.factory import SERIAL, USUAL, Bench
from tests.station.line_bench import LineBench
from tests.station.records.test_forgeries import Forger
from tests.station.test_certificate_check import each_code_is_drawn_once
from tests.station.test_exchanges import lose_power_once
from tests.station.test_labels import template
from tests.station.unit_bench import NEW_UNIT, UnitBench
from tests.web.answering import app_of, client_of
from tests.web.bench_place import BenchPlace, order
from tests.web.own_loop import in_own_loop

__all__ = ["each_code_is_drawn_once"]
FOREIGN = tuple(code for code in NAMES if code != "en")
_ENGLISH = re.compile(r"(?:\b[A-Za-z]?[a-z]+[,;:]? ){2,}[a-z]{2,}\b")
"""Three words of English."""
_COMMAND = re.compile(r"`[^`]*`|\bflasher [a-z-]+(?: [A-Z-]+)?|--[a-z-]+|[\w./-]+\.\w+")
"""Commands, options and names of files are the same in every language."""
_NAMES = frozenset({"a simulated bus"})
_PLAIN = frozenset({"code", "script", "style", "pre", "input", "option"})


class _Texts(HTMLParser):
    """The texts of a page, without commands and what is stored as it is."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[str] = set()
        self._open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("input", "meta", "link", "br"):
            self._open.append(tag)
        self.found |= {value for name, value in attrs if name in ("aria-label", "title") and value}

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not _PLAIN & set(self._open):
            self.found.add(" ".join(data.split()))


def _texts(html: str) -> set[str]:
    parser = _Texts()
    parser.feed(html)
    return parser.found


def _check(pages: Mapping[str, str], *, shows: str) -> None:
    """The page by language: the English one shows the failure, the others nothing in English."""
    english = _texts(pages["en"]) - _NAMES
    assert any(shows in text for text in english), (shows, english)
    for language in FOREIGN:
        left = {
            text
            for text in _texts(pages[language]) - _NAMES
            if _ENGLISH.search(_COMMAND.sub("", text))
        }
        if language == "de":  # its words are of the same letters
            left &= english
        assert left == set(), language


# -- the bench -------------------------------------------------------------------------------------


def _bench_pages(place: BenchPlace, state: BenchState) -> dict[str, str]:
    page = BenchPage(Pages(), place.bench, place.shelf, is_mock=True)
    return {
        language: "".join(page._parts(translator(language), state).values()) for language in NAMES
    }


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BenchPlace:
    """With a history of its own, which a page shows."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return BenchPlace(tmp_path)


def _use(fault: BikeFault) -> Callable[[BikeBench], object]:
    return order(BikeBench.use_adapter, fault.value)


@pytest.mark.slow
def test_no_adapter(place: BenchPlace) -> None:
    state = place.do(lambda _bench: open_bus({"interface": "socketcan", "channel": "can97"}))
    assert state.trouble is not None
    _check(_bench_pages(place, state), shows="The adapter cannot be opened")


@pytest.mark.slow
def test_a_silent_device(place: BenchPlace) -> None:
    state = place.do(_use(BikeFault.OFF))
    _check(_bench_pages(place, state), shows="No device of the drive system")


def test_a_wrong_image_and_a_damaged_file(place: BenchPlace) -> None:
    (place.shelf.folder / "display.bin").write_bytes(image_of(3, f"OBC {NEW}").data)
    state = place.do(_use(BikeFault.NONE), order(BikeBench.choose_target, BMS.name))
    assert {offer.name for offer in state.offers if offer.refusal} == {"broken.hex", "display.bin"}
    pages = _bench_pages(place, state)
    _check(pages, shows="is a damaged Intel HEX file")
    _check(pages, shows="the image names the OBC inside")


def test_other_bit_rates(place: BenchPlace) -> None:
    usb = {"interface": "slcan", "channel": "usb"}
    for bus, shows in (
        ({"bitrate": "fast"}, "is not a bit rate"),
        ({"bitrate": 500_000}, "The bit rate would be"),
    ):
        state = place.do(partial(_bit_rate, usb | bus))
        _check(_bench_pages(place, state), shows=shows)


def _bit_rate(merged: Mapping[str, Any], _bench: BikeBench) -> object:
    return bit_rate(250_000, {}, merged)


@pytest.mark.slow
@each(
    "name, data, shows",
    [
        ("cut.elf", b"\x7fELF", "its header is truncated"),
        ("new.elf", b"\x7fELF\x01\x01" + bytes(60), "is a damaged ELF file"),
        (
            "gap.hex",
            b":0400000000000000FC\n:0410000000000000EC\n:00000001FF\n",
            "is not a stack pointer",
        ),
    ],
)
def test_an_image_that_cannot_be_read(
    place: BenchPlace, name: str, data: bytes, shows: str
) -> None:
    (place.shelf.folder / name).write_bytes(data)
    state = place.do(_use(BikeFault.NONE), order(BikeBench.choose_target, BMS.name))
    _check(_bench_pages(place, state), shows=shows)


@each(
    "name, data, shows",
    [
        ("a.blf", bytes(200), "it has no header of this format"),
        ("b.blf", b"LOGG" + struct.pack("<I", 144) + bytes(136) + b"LOBJ", "within an object"),
        ("c.pcapng", b"none", "it does not begin as a capture of Wireshark does"),
        ("d.pcapng", b"\n\r\r\n" + struct.pack("<II", 28, 0x1A2B3C4D), "within a block"),
        ("e.log", b"(0.0) can0 1#\x00", "it holds NUL bytes"),
    ],
)
def test_a_trace_that_cannot_be_read(place: BenchPlace, name: str, data: bytes, shows: str) -> None:
    (place.shelf.traces / name).write_bytes(data)
    archive = Archive(place.shelf.folder, backup_folder(), place.shelf.traces)
    asked = [Question("/kept/story", {"trace": name}, language=each) for each in NAMES]
    pages = {each.language: archive.answer(each).body.decode() for each in asked}
    _check(pages, shows=shows)


@pytest.mark.slow
@each("fault", [BikeFault.POWER, BikeFault.PULLED, BikeFault.SECOND_TOOL, BikeFault.REFUSES])
def test_an_upgrade_that_fails(place: BenchPlace, fault: BikeFault) -> None:
    state = place.do(
        _use(fault),
        order(BikeBench.choose_target, BMS.name),
        order(BikeBench.choose_image, "new.bin"),
    )
    assert state.offer is not None
    state = place.do(order(BikeBench.upgrade, state.selection))
    assert state.done is not None
    _check(_bench_pages(place, state), shows="State of the device")
    assert state.done.bundle is not None
    archive = Archive(state.done.bundle.parent, backup_folder(), place.shelf.traces)
    for path, shows in (("/kept/story", "How to read this page"), ("/kept", "Bundles")):
        fields = {"bundle": state.done.bundle.name}
        asked = {each: Question(path, fields, language=each) for each in NAMES}
        pages = {each: archive.answer(asked[each]).body.decode() for each in NAMES}
        _check(pages, shows=shows)


# -- the line --------------------------------------------------------------------------------------


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.store.close()


def _line_pages(line: LineBench) -> dict[str, str]:
    """What the operator page shows after these events."""
    watch = HealthWatch(line.bench.folder, line.bench.clock.utc, line.bench.clock.monotonic_s)
    board, screen = Board(), Screen(ShiftCounts(), watch)
    for happened in line.events:
        board.apply(happened)
        screen.show(happened, board)
    screen.turn(board, operator="Jo", lot=CurrentLot("L17", 500, 12))
    screen.feed.close()

    async def messages_in(language: str) -> list[object]:
        follow = messages(screen.feed, translator(language), Source())
        return [message async for message in follow]

    return {
        language: "".join(
            f"<p>{html.escape(text)}</p>" for text in _strings(in_own_loop(messages_in(language)))
        )
        for language in NAMES
    }


def _strings(value: object) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _strings(inner)


def test_a_duplicate_label(bench: Bench) -> None:
    line = LineBench(bench)
    line.make("A", SERIAL)
    line.leave("A")
    line.scan(SERIAL)
    line.arrive("A")
    _check(_line_pages(line), shows="has passed already")


def test_a_recipe_that_was_changed_and_a_serial_number_of_another(bench: Bench) -> None:
    line = LineBench(bench)
    line.scan("W2605")
    _check(_line_pages(line), shows="does not fit the pattern")
    bench.recipe.path.write_text(USUAL + "\n", "utf-8")
    line.scan(SERIAL)
    line.arrive("A")
    _check(_line_pages(line), shows="was changed")


def _no_room(connection: Any, _record: object) -> None:
    connection.execute("PRAGMA max_page_count = 1")


def test_a_full_disk(bench: Bench) -> None:
    line = LineBench(bench)
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")
    bench.store.database.close()
    event.listen(bench.store.database.engine, "connect", _no_room)
    for _ in range(200):
        if line.ask("A", JournalWrite("bms", "flash", "V" * 200)).error:
            break
    line.end("A")
    event.remove(bench.store.database.engine, "connect", _no_room)
    bench.store.database.close()
    _check(_line_pages(line), shows="the disk is full")


def test_a_printer_that_is_gone(bench: Bench) -> None:
    def send(data: bytes, limit_s: float) -> None:
        send_tcp(("127.0.0.1", 9), data, limit_s)

    line = LineBench(bench, labels=LabelPrinter(template(bench), send, limit_s=5.0))
    line.make("A", SERIAL)
    line.station.close()
    _check(_line_pages(line), shows="not printed")


# -- the records -----------------------------------------------------------------------------------


def _wrong_unit(folder: Path) -> UnitBench:
    return UnitBench(folder, profile=replace(NEW_UNIT, serial_number="W2605009"))


def _exchanged_unit(folder: Path) -> UnitBench:
    unit = UnitBench(folder)
    lose_power_once(unit, 1.0)
    return unit


@pytest.mark.slow
@each(
    "made, code, shows",
    [
        (_wrong_unit, "WRONG_UNIT", "The unit reports 'W2605009'"),
        (_exchanged_unit, "UNIT_CHANGED", "announced its bootloader"),
    ],
)
def test_a_failed_run_in_the_records(
    bench: Bench, tmp_path: Path, made: Callable[[Path], UnitBench], code: str, shows: str
) -> None:
    folder = tmp_path / code
    folder.mkdir()
    unit = made(folder)
    result = unit.run()
    assert result.code == code
    run_id = bench.claim().run_id
    bench.work(run_id)
    for report in unit.journal.reports:
        bench.store.step(
            run_id, report.name, report.state, duration_s=report.duration_s, code=report.code,
            text=report.text, measurements=report.measurements,
        )  # fmt: skip
    bench.store.finish(run_id, replace(bench.ending(result.outcome, code), text=result.text))
    client = client_of(app_of(bench.path, bench.keys))
    for path in (
        "/units",
        "/units/certificate",
        "/units/certificate.html",
        f"/runs/{run_id}/trace",
    ):
        answers = {
            language: client.get(path, params={"serial": SERIAL, "lang": language})
            for language in NAMES
        }
        assert {answer.status_code for answer in answers.values()} == {200}
        pages = {language: answer.text for language, answer in answers.items()}
        _check(pages, shows=shows if path.startswith("/units") else "How to read this page")


@pytest.mark.slow
@each(
    "statement, shows",
    [
        ("UPDATE step SET duration_s = 1 WHERE run_id = 1", "its steps"),
        ("UPDATE run SET state = 'FAIL' WHERE id = 1", "the run itself"),
        ("UPDATE unit SET part = 'BAT-48' WHERE id = 1", "serial number or part"),
        ("DELETE FROM audit WHERE run_id = 1 AND event = 'claimed'", "the previous row is missing"),
        ("UPDATE audit SET signature = '' WHERE run_id = 1", "not signed with the key"),
        ("UPDATE audit SET at = '' WHERE run_id = 1", "changed after it was written"),
        ("DELETE FROM attachment WHERE run_id = 1", "its attachments"),
        ("", "it was removed"),
    ],
)
def test_records_that_were_changed(tmp_path: Path, statement: str, shows: str) -> None:
    bench = Bench(Path(tempfile.mkdtemp(dir=tmp_path)))
    bench.make(RunState.PASS, SERIAL)
    life, now = bench.store.read.unit(SERIAL), datetime.now(UTC)
    made = render_certificate(life, now, proven(bench.store, life, now))
    bench.store.close()
    forger = Forger(bench.path)
    if statement:
        forger(statement)
    else:
        del forger.rules["run_update"]
    forger.put_back()
    files = bench.path.with_name(f"{bench.path.name}.files")
    supervisor = open_supervisor(str(bench.path), files, bench.key_locations, DEFAULT_SHIFTS)
    for path in ("/units/certificate", "/certificate"):
        fields, body = {"serial": SERIAL}, made.encode()
        asked = [Question(path, fields, language=each, body=body) for each in NAMES]
        pages = {each.language: supervisor.answer(each).body.decode() for each in asked}
        _check(pages, shows=shows)
    supervisor.store.close()
