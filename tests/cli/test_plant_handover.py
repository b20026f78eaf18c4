"""`flasher plant deliver`, `deliveries` and `reconcile`."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from flasher.cli.plant import handover
from flasher.documents import as_json
from flasher.errors import ExitCode
from flasher.plant.central import Central
from flasher.plant.deliveries import Deliveries
from flasher.plant.delivery_list import deliveries_of
from tests.cli.conftest import Flasher, Run
from tests.cli.test_schema import hold_output
from tests.plant.conftest import no_running_loop, plant, sender
from tests.plant.factory import COURIER, PASSWORD, READER, Plant, Sender
from tests.plant.receiver import Act, Receiver, receiving
from tests.schema_document import SCHEMA

__all__ = ["no_running_loop", "plant", "sender"]
pytestmark = pytest.mark.slow


@dataclass
class Desk:
    flasher: Flasher
    plant: Plant
    sender: Sender
    receiver: Receiver
    file: Path

    def deliver(self) -> Run:
        return self.run("deliver", "--receivers", self.file, "--once")

    def run(self, action: str, *words: object, role: str = COURIER) -> Run:
        url = self.plant.url(role)
        run = self.flasher("plant", action, *words, "--database", url, "--json")
        hold_output(json.loads(SCHEMA.read_text("utf-8")), run.out, run.code)
        assert PASSWORD not in run.out + run.err
        return run


@pytest.fixture
def desk(flasher: Flasher, plant: Plant, sender: Sender, tmp_path: Path) -> Iterator[Desk]:
    with receiving(Receiver()) as receiver:
        file = tmp_path / "receivers.toml"
        file.write_text(f'[[receiver]]\nname = "mes"\nurl = "{receiver.url}"\n', "utf-8")
        yield Desk(flasher, plant, sender, receiver, file)


def test_runs_are_delivered_listed_and_sent_again(desk: Desk) -> None:
    assert desk.deliver().document["attempts"] == {}
    desk.sender.bench.make()
    desk.sender.send()
    desk.receiver.plan = lambda: Act.REFUSE
    first = desk.deliver()
    assert first.document["attempts"] == {"refused": 1}
    assert "HTTP 422: no such part" in first.err
    listed = desk.run("deliveries", "--state", "refused", role=READER).document
    (row,) = listed["deliveries"]
    assert row["answer"] == "HTTP 422: no such part"
    assert listed["receivers"][0]["counts"] == {"refused": 1}
    desk.receiver.plan = lambda: Act.TAKE
    again = desk.run("deliveries", "--state", "refused", "--resend").document
    assert again["deliveries"][0]["state"] == "waiting"
    assert desk.deliver().document["attempts"] == {"confirmed": 1}
    shown = desk.run("deliveries", "--key", row["key"], role=READER).document
    assert shown["document"] == desk.receiver.documents[row["key"]], "as it was posted"
    assert desk.run("deliveries", "--state", "refused").document["deliveries"] == []


def test_all_that_the_options_choose_is_sent_again_and_listed_up_to_the_limit(desk: Desk) -> None:
    desk.deliver()
    for serial in ("W2605011", "W2605012", "W2605013"):
        desk.sender.bench.make(serial=serial)
    desk.sender.send()
    desk.receiver.plan = iter([Act.TAKE, Act.REFUSE, Act.REFUSE]).__next__
    desk.deliver()
    words = ("deliveries", "--state", "refused", "--station", "line-2", "--resend", "--limit", "1")
    url = desk.plant.url(COURIER)
    run = desk.flasher("plant", *words, "--database", url)
    assert "2 runs will be sent again" in run.out
    assert "mes: 1 confirmed, 2 waiting" in run.out
    assert [line for line in run.out.splitlines() if " to mes" in line] == [
        "W2605013, PASS, line-2: waiting to mes"
    ]
    waiting = ("deliveries", "--state", "waiting")
    begun = (*waiting, "--since", "2026-05-17T00:00Z")
    assert len(desk.run(*begun, role=READER).document["deliveries"]) == 2
    assert desk.run(*waiting, "--until", "2026-05-17T00:00Z").document["deliveries"] == []


def test_what_is_posted_is_the_document_that_the_schema_describes(desk: Desk) -> None:
    with closing(Central(desk.plant.url(COURIER))) as central:
        Deliveries(central).register(["mes"])
        desk.sender.bench.make()
        desk.sender.send()
        with central.reading() as connection:
            (row,) = deliveries_of(connection).rows
        document = as_json(Deliveries(central).document(row.key))
    desk.deliver()
    assert desk.receiver.documents == {row.key: document}


def test_a_receiver_that_lost_a_run_gets_it_again(desk: Desk, tmp_path: Path) -> None:
    desk.deliver()
    for serial in ("W2605011", "W2605012"):
        desk.sender.bench.make(serial=serial)
    desk.sender.send()
    desk.deliver()
    lost, kept = desk.receiver.documents
    del desk.receiver.documents[lost]
    listing = tmp_path / "list.csv"
    with listing.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([["serial", "key"], ["W2605012", kept], ["X", "other-1"]])
    words = (listing, "--receiver", "mes")
    found = desk.run("reconcile", *words, role=READER)
    assert found.code == ExitCode.VERIFICATION
    assert (found.document["missing"], found.document["unknown"]) == ([lost], ["other-1"])
    desk.run("reconcile", *words, "--resend")
    desk.deliver()
    assert set(desk.receiver.documents) == {lost, kept}
    listing.write_text(json.dumps([lost, kept]), "utf-8")
    assert desk.run("reconcile", *words).code == ExitCode.OK


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("deliveries", "--resend"), "would send every run again"),
        (("deliveries", "--receiver", "erp"), "There is no receiver erp"),
        (("deliveries", "--stop", "erp"), "There is no receiver erp"),
        (("deliveries", "--key", "W2605001"), "not the key of a run"),
        (("reconcile", "list.json", "--receiver", "erp"), "There is no receiver erp"),
    ],
)
def test_a_mistake_is_explained_and_changes_nothing(
    desk: Desk, words: tuple[Any, ...], what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(desk.file.parent)
    Path("list.json").write_text("[]", "utf-8")
    run = desk.run(*words)
    assert run.code == ExitCode.USAGE
    assert what in run.err


def test_a_reader_cannot_deliver(desk: Desk) -> None:
    run = desk.run("deliver", "--receivers", desk.file, "--once", role=READER)
    assert run.code == ExitCode.USAGE
    assert "lacks the right" in run.err


def test_what_was_retired_is_listed_up_to_a_limit(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.deliver()
    for number in range(5):
        desk.sender.bench.make(serial=f"W260502{number}")
    desk.sender.send()
    desk.deliver()
    with desk.plant.connect() as owner:  # as `plant retire` leaves them
        owner.execute("DELETE FROM chain_row")
    monkeypatch.setattr(handover, "_SHOWN_MAX", 2)
    listing = tmp_path / "list.json"
    listing.write_text("[]", "utf-8")
    run = desk.run("reconcile", listing, "--receiver", "mes", "--resend")
    assert run.err.splitlines() == [
        "5 runs that were retired to files are not sent again:",
        *(f"  {key}" for key in run.document["missing"][:2]),
        "  and 3 more",
    ]


def test_no_more_is_listed_than_the_limit(desk: Desk) -> None:
    with closing(Central(desk.plant.url(COURIER))) as central:
        Deliveries(central).register(["mes", "erp"])
    desk.sender.bench.make()
    desk.sender.send()
    for limit in (1, 2):
        listed = desk.run("deliveries", "--limit", limit, role=READER).document
        assert len(listed["deliveries"]) == limit


def test_a_receiver_that_is_stopped_gets_no_more(desk: Desk) -> None:
    desk.deliver()
    desk.run("deliveries", "--stop", "mes")
    desk.sender.bench.make()
    desk.sender.send()
    listed = desk.run("deliveries", role=READER).document
    assert listed["deliveries"] == []
    assert listed["receivers"][0]["stopped_at"] is not None
