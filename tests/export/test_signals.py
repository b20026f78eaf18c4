"""Traces as rows: for a table, a CSV and a measurement file."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest

from flasher.errors import ExitCode, UsageError
from flasher.export.signals import trace_rows
from flasher.protocol.frame import Frame
from flasher.trace.reader import read_trace
from tests.cli.conftest import Flasher
from tests.peers.wording import REPORT
from tests.trace import traffic
from tests.trace.tape import START_S, Tape


@pytest.fixture
def trace(tmp_path: Path) -> Path:
    """A battery that speaks, an upgrade with a NAK, and damage."""
    tape = Tape()
    for frame in (*traffic.running(), *traffic.faults(b"\x03\x00\x00\x80")):
        tape.frame(frame)
    tape.message(0x725, REPORT, 0x5210, b"=1+1.           ")
    tape.to_packet(3).damaged_packet(3).nak(3).packet(3).ack(3).error()
    return tape.save(tmp_path / "trace.blf")


def test_a_row_has_the_fields_with_their_units(trace: Path) -> None:
    rows = list(trace_rows(trace))
    first = rows[0]
    assert first["message"] == "running information"
    assert (first["id"], first["sender"], first["receiver"]) == ("720", "BMS", "all")
    assert first["running_information.voltage_mv"] == 36_000
    assert first["running_information.mean_current_ma"] == -1000
    assert first["running_information.cell_temperature_c"] == 25
    assert first["running_information.status"] == "charger connected"
    assert first["frame"] == 4
    assert first["time_s"] == pytest.approx(0.0015, abs=1e-5)
    assert first["stamp_s"] == pytest.approx(START_S + 0.002, abs=1e-5)
    faults = rows[1]["faults.faults"]
    assert faults.startswith("second level discharge over current protection, charge over")
    kinds = [row["kind"] for row in rows]
    assert kinds.count("damaged") == 1
    assert kinds.count("error_frame") == 1
    assert [row["nak.number"] for row in rows if row["message"] == "NAK"] == [3]


def test_frames_are_counted_as_wireshark_counts_them(trace: Path) -> None:
    numbers = [row["frame"] for row in trace_rows(trace)]
    assert numbers == sorted(numbers)
    assert numbers[-1] == len(list(read_trace(trace)))


def test_a_file_that_is_cut_off_is_reported(tmp_path: Path) -> None:
    path = Tape().to_end().save(tmp_path / "trace.log")
    path.write_text(path.read_text(encoding="ascii") + "(17000", encoding="ascii")
    with pytest.raises(UsageError):
        list(trace_rows(path))


# -- csv ------------------------------------------------------------------------------------------


def test_a_table_has_a_column_for_each_field(flasher: Flasher, trace: Path) -> None:
    ran = flasher("export", "csv", trace)
    assert ran.code == ExitCode.OK
    lines = list(csv.DictReader(io.StringIO(ran.out)))
    assert len(lines) == len(list(trace_rows(trace)))
    assert lines[0]["running_information.voltage_mv"] == "36000"
    assert lines[0]["running_information.mean_current_ma"] == "-1000"
    assert lines[1]["running_information.voltage_mv"] == ""
    assert [line["user_string_1.text"] for line in lines if line["message"] == "user string 1"] == [
        "'=1+1"  # no formula
    ]


def test_only_some_messages_are_wanted(flasher: Flasher, trace: Path, tmp_path: Path) -> None:
    path = tmp_path / "acks.csv"
    words = ("--message", "REQUEST", "--message", "boot", "-o", path)
    document = flasher("export", "csv", trace, *words, "--json").document
    lines = path.read_text(encoding="utf-8").splitlines()
    assert document["messages"] == len(lines) - 1
    assert {line.split(",")[7] for line in lines[1:]} == {"request transfer", "boot version"}
    assert flasher("export", "csv", trace, "--message", "nothing").code == ExitCode.USAGE


def test_json_needs_a_file(flasher: Flasher, trace: Path) -> None:
    assert flasher("export", "csv", trace, "--json").code == ExitCode.USAGE


def test_a_cut_trace_is_a_table_up_to_there(flasher: Flasher, tmp_path: Path) -> None:
    path = Tape().to_end().save(tmp_path / "trace.log")
    whole = len(list(trace_rows(path)))
    path.write_text(path.read_text(encoding="ascii") + "(17000", encoding="ascii")
    ran = flasher("export", "csv", path, "-o", tmp_path / "out.csv")
    assert ran.code == ExitCode.OK
    assert f"{whole} messages" in ran.out
    assert "ends there" in ran.err


# -- other programs' packages ---------------------------------------------------------------------


@pytest.mark.slow
def test_a_notebook_reads_a_trace_in_two_lines(trace: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="needs the extra table")
    table = pandas.DataFrame(trace_rows(trace))
    acks = table[table.message == "ACK"]
    assert list(acks["ack.number"]) == [1, 2, 3]
    assert table["running_information.voltage_mv"].mean() == 36_000


@pytest.mark.slow
def test_a_measurement_file_has_a_channel_for_each_number_and_flag(
    flasher: Flasher, trace: Path, tmp_path: Path
) -> None:
    asammdf = pytest.importorskip("asammdf", reason="needs the extra mf4")
    path = tmp_path / "signals.mf4"
    ran = flasher("export", "mf4", trace, "-o", path)
    assert ran.code == ExitCode.OK, ran.err
    with asammdf.MDF(path) as mdf:
        voltage = mdf.get("running_information.voltage_mv")
        assert (list(voltage.samples), voltage.unit) == ([36_000], "mV")
        assert list(mdf.get("packet.number").samples) == [1, 2, 3]
        assert list(mdf.get("running_information.status.charger_connected").samples) == [1]
        assert list(mdf.get("faults.faults.afe_fault").samples) == [0]
        assert mdf.get("running_information.cell_temperature_c").unit == "°C"
        assert mdf.start_time.timestamp() == pytest.approx(START_S, abs=0.01)
        rows = [row for row in trace_rows(trace) if row["message"] == "packet"]
        times = [row["time_s"] for row in rows]
        assert list(mdf.get("packet.number").timestamps) == pytest.approx(times)


def test_without_its_package_a_measurement_file_is_refused(
    flasher: Flasher, trace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flasher.cli.extras.importlib.util.find_spec", lambda _name: None)
    ran = flasher("export", "mf4", trace, "-o", tmp_path / "signals.mf4")
    assert ran.code == ExitCode.USAGE
    assert "asammdf" in ran.err
    assert ".[mf4]" in ran.err


def test_a_measurement_file_is_named_as_one(flasher: Flasher, trace: Path, tmp_path: Path) -> None:
    pytest.importorskip("asammdf", reason="needs the extra mf4")
    ran = flasher("export", "mf4", trace, "-o", tmp_path / "signals.dat")
    assert ran.code == ExitCode.USAGE
    assert "does not end with .mf4" in ran.err


def test_nothing_is_a_table_without_rows(flasher: Flasher, tmp_path: Path) -> None:
    path = Tape().frame(Frame(0x100, b"x")).save(tmp_path / "trace.blf")
    ran = flasher("export", "csv", path)
    assert ran.out.split() == ["time_s,stamp_s,frame,id,sender,receiver,kind,message"]
