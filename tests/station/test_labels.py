"""Labels: only for units whose PASS is on disk, never at the cost of a verdict, and no value can be
a command of the printer.
"""

from __future__ import annotations

import errno
import os
import queue
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from flasher.errors import UsageError
from flasher.station import label_printer
from flasher.station.board import Board
from flasher.station.config import LabelConfig, load_config
from flasher.station.events import (
    LabelFailed,
    LabelPrinted,
    RunEnded,
    ScanAccepted,
    ScanRefused,
    SocketState,
)
from flasher.station.health import HealthWatch
from flasher.station.label_printer import LabelJob, LabelPrinter, NotPrinted, printer_of
from flasher.station.label_template import LabelTemplate, sample_of, values_of
from flasher.station.operators import Crew, Person, Role
from flasher.station.records import queries
from flasher.station.records.errors import DiskFullError
from flasher.station.records.model import Measurement, RunState, StepName
from flasher.station.records.store import Store
from tests.loops import each
from tests.station.factory import SERIAL, USUAL, Bench
from tests.station.line_bench import LineBench, tried
from tests.station.test_plant_answers import Plant

ZPL = "^XA^FO40,40^FD{{ serial }} {{ lot }} {{ match.week }}^FS^XZ\n"
OTHER = "W2605003"
LIMIT_S = 20.0
"""Nothing of these tests takes as long."""


def template(bench: Bench, text: str = ZPL) -> LabelTemplate:
    path = bench.folder / "label.zpl"
    path.write_text(text, "utf-8")
    return LabelTemplate(path, sample_of(bench.recipe.recipe, "line-2"))


class Printer:
    """A printer that a test looks at; `send` is what it does with a label."""

    def __init__(self, bench: Bench, send: Callable[[bytes], None] | None = None, **more: bool):
        self.came: queue.Queue[bytes] = queue.Queue()
        self._send = send or (lambda _data: None)
        self.labels = LabelPrinter(template(bench), self._take, limit_s=LIMIT_S, **more)

    def _take(self, data: bytes, _limit_s: float) -> None:
        self._send(data)
        self.came.put(data)


def refuse(_data: bytes) -> None:
    raise NotPrinted("The printer is out of paper.")


def finished(line: LineBench) -> None:
    """The station ends, and what waits for the printer is printed."""
    line.station.close()


# -- the way of a label ---------------------------------------------------------------------------


def test_a_unit_that_has_passed_gets_its_label(bench: Bench) -> None:
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    line.scan("LOT L17")
    line.make("A", SERIAL)
    assert printer.came.get(timeout=LIMIT_S) == b"^XA^FO40,40^FDW2605002 L17 05^FS^XZ\n"
    finished(line)
    assert line.of(LabelPrinted) == [LabelPrinted("A", SERIAL)]


@pytest.mark.slow
@each("outcome, code", [(RunState.FAIL, "NO_ANSWER"), (RunState.ERROR, "BUS")])
def test_another_verdict_gets_none(bench: Bench, outcome: RunState, code: str) -> None:
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    line.scan(SERIAL)
    line.arrive("A")
    line.work("A")
    line.end("A", outcome, code)
    line.scan(f"REPRINT {SERIAL}")
    assert line.last(ScanRefused).code == "NOT_PASSED"
    finished(line)
    assert printer.came.empty()
    bench.store.recover()


def test_no_label_before_the_pass_is_on_disk(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    real = Store.finish

    def finish(*_: object, **_more: object) -> None:
        raise DiskFullError("RECORD NOT SAVED: the disk is full.", remedy="Make room.")

    monkeypatch.setattr(Store, "finish", finish)
    line.make("A", SERIAL)
    line.scan(f"REPRINT {SERIAL}")
    assert line.last(ScanRefused).code == "NOT_PASSED"
    assert printer.came.empty()
    monkeypatch.setattr(Store, "finish", real)
    line.scan("RESUME")
    assert line.last(RunEnded).run.state is RunState.PASS
    assert SERIAL.encode() in printer.came.get(timeout=LIMIT_S)
    finished(line)


@pytest.mark.slow
def test_the_label_is_made_when_others_can_read_the_pass(bench: Bench) -> None:
    seen: list[str] = []

    def look(_data: bytes) -> None:
        with bench.outsider() as other:
            seen.extend(row[0] for row in other.execute("SELECT state FROM run"))

    printer = Printer(bench, look)
    line = LineBench(bench, labels=printer.labels)
    line.make("A", SERIAL)
    printer.came.get(timeout=LIMIT_S)
    finished(line)
    assert seen == ["PASS"]


def test_a_printer_that_hangs_delays_nothing(bench: Bench) -> None:
    goes_on = threading.Event()

    def hang(_data: bytes) -> None:
        goes_on.wait(LIMIT_S)

    printer = Printer(bench, hang)
    line = LineBench(bench, labels=printer.labels)
    line.make("A", SERIAL)
    line.make("B", OTHER)
    assert [event.run.state for event in line.of(RunEnded)] == [RunState.PASS] * 2
    assert line.state("B") is SocketState.PASS
    assert line.of(LabelPrinted) == []
    goes_on.set()
    finished(line)
    assert [event.serial for event in line.of(LabelPrinted)] == [SERIAL, OTHER]


def test_the_time_limit_holds_for_a_printer_that_knows_none(bench: Bench) -> None:
    """Windows has none for a device. What hangs is not sent to; then labels are printed again."""
    begun, goes_on, done = threading.Semaphore(0), threading.Event(), threading.Semaphore(0)

    def hang(_data: bytes, _limit_s: float) -> None:
        begun.release()
        goes_on.wait(LIMIT_S)

    labels = LabelPrinter(template(bench), hang, limit_s=0.05)
    labels.start(done.release)
    run = bench.store.read.run(bench.make()).run

    def job(serial: str) -> LabelJob:
        return LabelJob(replace(run, serial=serial), "A", values_of(run, {"week": "05"}))

    for serial in ("1", "2"):
        labels.submit(job(serial))
        assert done.acquire(timeout=LIMIT_S)
    assert [(job.run.serial, reason) for job, reason in labels.take()] == [
        ("1", "The printer took longer than 0.05 s."),
        ("2", "The printer took longer than 0.05 s."),
    ]
    assert begun.acquire(blocking=False)
    assert not begun.acquire(blocking=False), "two labels at once"
    goes_on.set()
    labels.submit(job("3"))
    assert done.acquire(timeout=LIMIT_S)
    assert [(job.run.serial, reason) for job, reason in labels.take()] == [("3", "")]
    labels.close()


def test_a_printer_that_fails_touches_no_verdict_and_is_reported(bench: Bench) -> None:
    printer = Printer(bench, refuse)
    line = LineBench(bench, labels=printer.labels)
    line.make("A", SERIAL)
    finished(line)
    failed = line.last(LabelFailed)
    assert (failed.socket, failed.serial) == ("A", SERIAL)
    assert failed.reason == "The printer is out of paper."
    assert failed.remedy == f"Repair the printer, then scan REPRINT {SERIAL}."
    assert bench.store.read.run(line.last(RunEnded).run.run_id).run.state is RunState.PASS
    board = Board()
    for event in line.events:
        board.apply(event)
    assert board.rows["A"].state is SocketState.PASS
    assert board.rows["A"].note.startswith(f"No label for {SERIAL}: The printer is out of paper.")
    board.apply(LabelPrinted("", SERIAL, is_reprint=True))
    assert not board.unprinted


def test_what_is_not_printed_stays_on_the_page(tmp_path: Path, bench: Bench) -> None:
    watch = HealthWatch(tmp_path, bench.clock.utc, bench.clock.monotonic_s)
    names = [check.name for check in watch.look(Board())]
    assert names == ["records", "disk", "clock"]
    failed = LabelFailed("A", "W1", "No paper.", "Put some in.")
    check = watch.look(Board(unprinted=dict.fromkeys(("W1", "W2", "W3", "W4"), failed)))[1]
    assert (check.name, check.is_good) == ("labels", False)
    assert check.text == "not printed: W1, W2, W3 and 1 more; scan REPRINT W1"


def test_a_template_that_fails_on_one_unit_is_reported(bench: Bench) -> None:
    labels = LabelPrinter(
        template(bench, "{% if serial == 'W2605003' %}{{ lot.x.y }}{% endif %}"),
        lambda *_: None,
        limit_s=LIMIT_S,
    )
    line = LineBench(bench, labels=labels)
    line.make("A", OTHER)
    line.make("B", SERIAL)
    finished(line)
    assert "cannot be made" in line.last(LabelFailed).reason
    assert [event.serial for event in line.of(LabelPrinted)] == [SERIAL]


def test_a_backlog_has_an_end(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_printer, "BACKLOG_MAX", 1)
    begun, goes_on = threading.Event(), threading.Event()

    def hang(_data: bytes) -> None:
        begun.set()
        goes_on.wait(LIMIT_S)

    labels = Printer(bench, hang).labels
    line = LineBench(bench, labels=labels)
    line.make("A", SERIAL)
    assert begun.wait(LIMIT_S)
    for serial in (OTHER, "W2605004"):
        line.make("B", serial)
        line.leave("B")
    line.turn()
    assert [event.serial for event in line.of(LabelFailed)] == ["W2605004"]
    goes_on.set()
    finished(line)
    assert not labels._thread.is_alive()  # else the station waited for its whole limit


def test_labels_that_wait_at_the_end_are_reported(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(label_printer, "BACKLOG_MAX", 1)
    begun, goes_on = threading.Event(), threading.Event()

    def hang(_data: bytes, _limit_s: float) -> None:
        begun.set()
        goes_on.wait(LIMIT_S)

    labels = LabelPrinter(template(bench), hang, limit_s=0.05)
    line = LineBench(bench, labels=labels)
    line.make("A", SERIAL)
    assert begun.wait(LIMIT_S)
    line.make("B", OTHER)
    finished(line)
    assert sorted(event.serial for event in line.of(LabelFailed)) == [SERIAL, OTHER]
    assert not line.of(LabelPrinted)
    goes_on.set()


# -- once more ------------------------------------------------------------------------------------


def test_a_label_is_printed_once_more_and_audited(bench: Bench) -> None:
    bench.make(lot="L9")
    printer = Printer(bench)
    crew = Crew([Person(name="Jo", code="BADGE-1", role=Role.OPERATOR)])
    line = LineBench(bench, labels=printer.labels, crew=crew)
    line.scan(f"REPRINT {SERIAL}")
    assert line.last(ScanRefused).code == "NOBODY"
    line.scan("BADGE-1")
    line.scan(f"REPRINT {SERIAL}")
    assert line.last(ScanAccepted) == ScanAccepted(f"REPRINT {SERIAL}", "reprint")
    assert b"L9" in printer.came.get(timeout=LIMIT_S)
    finished(line)
    assert line.last(LabelPrinted).is_reprint
    with bench.outsider() as other:
        query = "SELECT data FROM audit WHERE event = 'reprint'"
        rows = [row[0] for row in other.execute(query)]
    assert rows == ['{"by":"Jo","serial":"W2605002"}']


def test_a_label_printed_once_more_is_that_of_the_recipe_of_its_run(bench: Bench) -> None:
    bench.make()
    bench.use(USUAL.replace("<week>", "<day>").replace("<year>", "<week>"))
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    line.scan(f"REPRINT {SERIAL}")
    assert printer.came.get(timeout=LIMIT_S) == b"^XA^FO40,40^FDW2605002  05^FS^XZ\n"
    finished(line)


def test_what_is_not_audited_is_not_printed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def note(*_: object) -> None:
        raise DiskFullError("RECORD NOT SAVED: the disk is full.", remedy="Make room.")

    bench.make()
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "note", note)
        line.scan(f"REPRINT {SERIAL}")
    finished(line)
    assert any(event.code == "RECORD_NOT_SAVED" for event in line.of(ScanRefused))
    assert printer.came.empty()


@pytest.mark.slow
def test_units_that_did_not_pass_last_and_no_products_get_none(bench: Bench) -> None:
    bench.use(USUAL.replace("revision", 'duplicate = "reflash-with-reason"\nrevision', 1))
    bench.make()
    bench.make(RunState.FAIL, reason="it came back")
    bench.make(serial=OTHER, is_virtual=True)
    line = LineBench(bench, labels=Printer(bench).labels, mixes_virtual=True)
    codes = {SERIAL: "NOT_PASSED", OTHER: "NO_PRODUCT", "W2605009": "NOT_PASSED"}
    for serial, code in {**codes, "^XA": "NOT_PASSED"}.items():
        line.scan(f"REPRINT {serial}")
        assert line.last(ScanRefused).code == code, serial
    finished(line)


def test_without_a_printer_it_is_reported(bench: Bench) -> None:
    line = LineBench(bench)
    line.make("A", SERIAL)
    line.scan(f"REPRINT {SERIAL}")
    assert line.last(ScanRefused).code == "NO_PRINTER"


def test_only_what_is_asked_for_is_printed_where_it_is_set_so(bench: Bench) -> None:
    printer = Printer(bench, prints_each=False)
    line = LineBench(bench, labels=printer.labels)
    line.make("A", SERIAL)
    line.scan(f"REPRINT {SERIAL}")
    finished(line)
    assert [event.is_reprint for event in line.of(LabelPrinted)] == [True]


# -- labels that are due --------------------------------------------------------------------------


def killed_before_the_label(bench: Bench, *serials: str) -> None:
    """Units pass, and the station dies while its printer hangs."""

    def hang(_data: bytes) -> None:
        threading.Event().wait(LIMIT_S)

    line = LineBench(bench, labels=Printer(bench, hang).labels)
    for serial in serials:
        line.make("A", serial)
        line.leave("A")


def missing(line: LineBench) -> list[str]:
    board = Board()
    for event in line.events:
        board.apply(event)
    return list(board.unprinted)


def test_the_next_start_names_each_label_that_a_kill_has_lost(bench: Bench) -> None:
    bench.make()  # without a printer: no label is due
    killed_before_the_label(bench, OTHER, "W2605004")
    for _ in range(2):  # not lost by another kill
        line = LineBench(bench, labels=Printer(bench).labels)
        assert missing(line) == [OTHER, "W2605004"]
    failed = line.of(LabelFailed)[0]
    assert failed.reason == "The station ended before its label was reported as printed."
    assert failed.remedy == f"If it has none, scan REPRINT {OTHER}."
    line.scan(f"REPRINT {OTHER}")
    finished(line)
    assert missing(line) == ["W2605004"]
    assert bench.store.examine().problems == ()
    assert missing(LineBench(bench, labels=Printer(bench).labels)) == ["W2605004"]
    assert missing(LineBench(bench)) == []


def test_the_next_start_looks_for_the_labels_of_so_many_runs_and_no_more(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(queries, "LABELS_LOOKED_BACK", 2)
    killed_before_the_label(bench, SERIAL, OTHER, "W2605004")
    assert missing(LineBench(bench, labels=Printer(bench).labels)) == [OTHER, "W2605004"]


def test_a_label_of_the_product_before_is_printed_too(bench: Bench) -> None:
    killed_before_the_label(bench, SERIAL)
    bench.use(USUAL.replace("BAT-36", "BAT-48"))
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    assert missing(line) == [SERIAL]
    line.scan(f"REPRINT {SERIAL}")
    finished(line)
    assert missing(line) == []
    assert printer.came.get(timeout=LIMIT_S).startswith(b"^XA")


def test_a_unit_that_is_verified_gets_the_label_that_it_lacks(bench: Bench) -> None:
    bench.use(USUAL.replace("revision", 'duplicate = "verify-only"\nrevision', 1))
    killed_before_the_label(bench, SERIAL)
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    line.scan(SERIAL)
    line.arrive("A")
    line.ask("A", tried(StepName.VERIFY), (Measurement("bms version", text="V1"),))
    line.end("A")
    finished(line)
    assert [event.serial for event in line.of(LabelPrinted)] == [SERIAL]
    assert missing(LineBench(bench, labels=Printer(bench).labels)) == []


def test_a_unit_that_failed_since_gets_none(bench: Bench) -> None:
    bench.use(USUAL.replace("revision", 'duplicate = "verify-only"\nrevision', 1))
    killed_before_the_label(bench, SERIAL)
    line = LineBench(bench, labels=Printer(bench).labels)
    line.scan(SERIAL)
    line.arrive("A")
    line.end("A", RunState.FAIL, "NO_ANSWER")
    finished(line)
    assert missing(line) == []
    assert missing(LineBench(bench, labels=Printer(bench).labels)) == []


def test_a_unit_that_is_golden_since_gets_none(bench: Bench) -> None:
    killed_before_the_label(bench, SERIAL)
    bench.use(f'{USUAL}\n[golden]\nserial_numbers = ["{SERIAL}"]\nevery_h = 8\n')
    printer = Printer(bench)
    line = LineBench(bench, labels=printer.labels)
    line.make("A", SERIAL)
    finished(line)
    assert printer.came.empty()
    assert missing(LineBench(bench, labels=Printer(bench).labels)) == []


def test_a_pass_whose_duplicates_were_not_checked_gets_no_label_by_itself(bench: Bench) -> None:
    printer = Printer(bench)
    plant = Plant(bench, labels=printer.labels)
    line = plant.line
    plant.scan()
    bench.clock.go_on(4.0)
    line.turn()
    line.work("A")
    line.end("A")
    assert line.last(RunEnded).run.is_unchecked
    failed = line.last(LabelFailed)
    assert failed.reason == "It was not checked whether it has passed at another station."
    assert failed.remedy == f"If it has passed at no other station, scan REPRINT {SERIAL}."
    line.station.close()
    assert printer.came.empty()
    plant = Plant(bench, labels=Printer(bench).labels)
    assert plant.line.last(LabelFailed).reason == failed.reason
    plant.line.scan(f"REPRINT {SERIAL}")
    finished(plant.line)
    assert plant.line.last(LabelPrinted).is_reprint


# -- the template ---------------------------------------------------------------------------------


@each(
    "lot, plain, coded",
    [
        ("L17", "L17", "L17"),
        ("^XZ^XA~JA", "?XZ?XA?JA", "_5EXZ_5EXA_7EJA"),
        ("a\r\n\x1b\x00b", "a????b", "a_0D_0A_1B_00b"),
        ("_5EXA", "_5EXA", "_5F5EXA"),
        ("{{ 7 * 7 }}", "{{ 7 * 7 }}", "_7B_7B 7 _2A 7 _7D_7D"),
        ("\N{GREEK SMALL LETTER MU}", "\N{GREEK SMALL LETTER MU}", "_CE_BC"),
    ],
)
def test_no_value_is_a_command(bench: Bench, lot: str, plain: str, coded: str) -> None:
    text = "^FD{{ lot }}|{{ lot | upper | lower | string }}|^FH^FD{{ lot | fh }}^FS"
    sample = {**sample_of(bench.recipe.recipe, "s"), "lot": lot}
    made = template(bench, text).fill(sample).decode()
    assert made.startswith(f"^FD{plain}|")
    assert made.endswith(f"^FH^FD{coded}^FS")
    assert made.count("^") == 4
    assert "~" not in made


@each(
    "text",
    [
        "{{ serail }}",
        "{{ serial",
        "{{ ''.__class__.__mro__[1].__subclasses__() }}",
        "{% include '/etc/passwd' %}",
        "{% for a in range(99999) %}{% for b in range(99999) %}xxxxxxxx{% endfor %}{% endfor %}",
        "{{ match.nothing }}",
        "{{ 1 / 0 }}",
    ],
)
def test_a_template_that_cannot_work_is_found_before_the_shift(bench: Bench, text: str) -> None:
    with pytest.raises(UsageError, match="cannot be filled in"):
        template(bench, text)


def test_the_sample_knows_what_a_run_knows(bench: Bench) -> None:
    run = bench.store.read.run(bench.make()).run
    sample = sample_of(bench.recipe.recipe, "line-2")
    values = values_of(run, {"week": "05"})
    assert values.keys() == sample.keys()
    assert {key: type(value) for key, value in values.items()} == {
        key: type(value) for key, value in sample.items()
    }


# -- printers -------------------------------------------------------------------------------------


@contextmanager
def listening(*, accepts: bool = True) -> Iterator[tuple[str, queue.Queue[bytes]]]:
    """A printer on the network; one that does not accept takes nothing."""
    came: queue.Queue[bytes] = queue.Queue()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def take() -> None:
            connection, _ = server.accept()
            with connection, connection.makefile("rb") as stream:
                came.put(stream.read())

        if accepts:
            threading.Thread(target=take, daemon=True).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}", came


def configured(**values: object) -> LabelConfig:
    return LabelConfig.model_validate({"template": "label.zpl"} | values)


def test_a_printer_on_the_network() -> None:
    with listening() as (place, came):
        printer_of(configured(printer=place))(b"^XA^XZ", LIMIT_S)
        assert came.get(timeout=LIMIT_S) == b"^XA^XZ"
    with pytest.raises(NotPrinted, match="cannot be reached"):
        printer_of(configured(printer=place))(b"^XA^XZ", LIMIT_S)


def test_a_printer_on_the_network_that_takes_nothing() -> None:
    with listening(accepts=False) as (place, _):
        send = printer_of(configured(printer=place))
        with pytest.raises(NotPrinted, match=r"longer than 0\.05 s"):
            send(b"x" * 30_000_000, 0.05)


def test_a_file_and_a_device(tmp_path: Path) -> None:
    send = printer_of(configured(printer=f"file:{tmp_path / 'labels.zpl'}"))
    send(b"one", LIMIT_S)
    send(b"two", LIMIT_S)
    assert (tmp_path / "labels.zpl").read_bytes() == b"onetwo"
    with pytest.raises(NotPrinted, match="cannot be reached: No such file"):
        printer_of(configured(printer="file:/dev/no-such-printer"))(b"x", LIMIT_S)
    assert not Path("/dev/no-such-printer").exists()
    with pytest.raises(NotPrinted, match="cannot be reached"):
        printer_of(configured(printer=f"file:{tmp_path}"))(b"x", LIMIT_S)


def test_a_disk_that_gets_full_leaves_no_half_label(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, write = tmp_path / "labels.zpl", os.write
    send = printer_of(configured(printer=f"file:{path}"))
    send(b"^XA^XZ", LIMIT_S)

    def write_some(handle: int, data: bytes) -> int:
        if data != b"^XA^FDone^XZ":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(handle, data[:5])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write_some)
        with pytest.raises(NotPrinted, match="No space left"):
            send(b"^XA^FDone^XZ", LIMIT_S)
    assert path.read_bytes() == b"^XA^XZ"
    send(b"^XA^FDone^XZ", LIMIT_S)
    assert path.read_bytes() == b"^XA^XZ^XA^FDone^XZ"


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_device_that_takes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lp0"
    os.mkfifo(path)
    send = printer_of(configured(printer=f"file:{path}"))
    with pytest.raises(NotPrinted, match="cannot be reached"):
        send(b"x", LIMIT_S)  # without a reader
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(NotPrinted, match="longer than"):
        send(b"x" * 1_000_000, 0.05)
    os.close(reader)


@pytest.mark.slow
def test_a_command(tmp_path: Path) -> None:
    made = tmp_path / "made"
    program = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_bytes(sys.stdin.buffer.read())"
    printer_of(configured(command=(sys.executable, "-c", program, str(made))))(b"^XA", LIMIT_S)
    assert made.read_bytes() == b"^XA"
    bad = "import sys; sys.exit('out of paper')"
    with pytest.raises(NotPrinted, match="failed with exit code 1: out of paper"):
        printer_of(configured(command=(sys.executable, "-c", bad)))(b"^XA", LIMIT_S)
    with pytest.raises(NotPrinted, match="cannot be reached"):
        printer_of(configured(command=("no-such-program",)))(b"^XA", LIMIT_S)
    slow = "import time; time.sleep(60)"
    with pytest.raises(NotPrinted, match=r"longer than 0\.05 s"):
        printer_of(configured(command=(sys.executable, "-c", slow)))(b"^XA", 0.05)


SOCKET = '\n[[socket]]\nname = "A"\nmock = {}\n'


def test_the_station_file_names_template_and_printer(tmp_path: Path) -> None:
    path = tmp_path / "sockets.toml"
    path.write_text(f'[label]\ntemplate = "l.zpl"\nprinter = "file:out.zpl"\n{SOCKET}', "utf-8")
    label = load_config(path).label
    assert label is not None
    assert label.template == str(tmp_path / "l.zpl")
    assert label.printer == f"file:{tmp_path / 'out.zpl'}"


@each(
    "more, why",
    [
        ("", "printer or command"),
        ('printer = "file:x"\ncommand = ["lp"]', "printer or command"),
        ('printer = "10.0.0.7:9100"', "tcp://HOST:PORT"),
        ('printer = "tcp://10.0.0.7"', "tcp://HOST:PORT"),
        ('printer = "tcp://[::1]:0"', "tcp://HOST:PORT"),
        ('printer = "file:x"\non = "fail"', "pass, reprint"),
        ('printer = "file:x"\ntime_limit_s = 0', "seconds above 0"),
    ],
)
def test_what_is_wrong_with_a_printer_is_reported(tmp_path: Path, more: str, why: str) -> None:
    path = tmp_path / "sockets.toml"
    path.write_text(f'[label]\ntemplate = "l.zpl"\n{more}\n{SOCKET}', "utf-8")
    with pytest.raises(UsageError) as refused:
        load_config(path)
    assert why in f"{refused.value} {refused.value.remedy} {refused.value.faults}"
