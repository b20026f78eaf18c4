"""Deliveries are listed by a filter and page by page, for the command and the page."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from flasher.plant.central import Central
from flasher.plant.deliveries import Answer, Deliveries, DeliveryState, parse_key
from flasher.plant.delivery_list import DeliveryFilter, deliveries_of, receivers_of
from flasher.plant.setup import setup
from flasher.station.records.newest import PageCursor
from flasher.web.query_processes import Question
from flasher.web.supervisor import SupervisorPages
from tests.plant.factory import COURIER, READER, Plant
from tests.station.postgres import Server

SERIALS = ["W2605002", "W2605003", "W2605004"]
BEGIN = datetime.min.replace(tzinfo=UTC)
REASON = "HTTP 422: no such part <b>"


@dataclass
class Desk:
    """Three runs of line-2 and one of line-3, for two receivers; `mes` refuses the first one."""

    plant: Plant
    central: Central

    def listed(self, chosen: DeliveryFilter) -> list[tuple[str, str]]:
        with self.central.reading() as connection:
            rows = deliveries_of(connection, chosen).rows
        return [(each.serial, each.receiver) for each in rows]

    def end(self, serial: str, state: DeliveryState, answer: str) -> str:
        """An attempt to deliver it to `mes`; returns its key."""
        deliveries = Deliveries(self.central)
        with self.central.reading() as connection:
            (row,) = deliveries_of(connection, DeliveryFilter("mes", serial=serial)).rows
        attempt = deliveries.begin("mes", *parse_key(row.key))
        assert attempt is not None
        deliveries.end(attempt, Answer(state, answer))
        return row.key


@pytest.fixture(scope="module")
def delivering(postgres: Server, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The database of `desk`, made once."""
    plant = Plant(postgres, tmp_path_factory.mktemp("plant"))
    with closing(Central(plant.url(COURIER))) as central:
        Deliveries(central).register(["mes", "erp"])
    for station, serials in (("line-2", SERIALS), ("line-3", ["W2605009"])):
        with closing(plant.sender(station)) as sender:
            for serial in serials:
                sender.bench.make(serial=serial)
            sender.send()
    with plant.connect() as owner:  # an hour after each other
        owner.execute("UPDATE chain_row SET arrived_at = arrived_at + id * interval '1 hour'")
    return plant.database


@pytest.fixture
def desk(postgres: Server, tmp_path: Path, delivering: str) -> Iterator[Desk]:
    plant = Plant(postgres, tmp_path, delivering)
    with closing(Central(plant.url(COURIER))) as central:
        yield Desk(plant, central)
    plant.drop()


def test_a_filter_chooses_by_each_of_its_fields(desk: Desk) -> None:
    key = desk.end("W2605002", DeliveryState.REFUSED, REASON)
    with desk.central.reading() as connection:
        rows = {each.serial: each for each in deliveries_of(connection, DeliveryFilter("mes")).rows}
    arrived = rows["W2605003"].arrived_at
    mes = [(serial, "mes") for serial in reversed(SERIALS)]
    assert desk.listed(DeliveryFilter("mes", station="line-2")) == mes
    assert desk.listed(DeliveryFilter("mes", station="line-3")) == [("W2605009", "mes")]
    assert desk.listed(DeliveryFilter(state=DeliveryState.REFUSED)) == [("W2605002", "mes")]
    both = [("W2605002", "erp"), ("W2605002", "mes")]
    assert desk.listed(DeliveryFilter(key=key)) == both
    assert desk.listed(DeliveryFilter(run_id=rows["W2605002"].run_id)) == both
    assert desk.listed(DeliveryFilter("mes", station="line-2", since=arrived)) == mes[:2], (
        "from then"
    )
    assert desk.listed(DeliveryFilter("mes", station="line-2", until=arrived)) == mes[2:]
    for before in (BEGIN, arrived - timedelta(days=400)):
        assert len(desk.listed(DeliveryFilter("mes", since=before))) == 4
        assert not desk.listed(DeliveryFilter("mes", until=before))
    after = arrived + timedelta(days=400)
    assert len(desk.listed(DeliveryFilter("mes", until=after))) == 4
    assert not desk.listed(DeliveryFilter("mes", since=after))
    assert desk.listed(DeliveryFilter("mes", serial="W260500")) == []


def test_a_time_is_looked_for_where_nothing_has_arrived(plant: Plant) -> None:
    with closing(Central(plant.url(READER))) as central, central.reading() as connection:
        assert not deliveries_of(connection, DeliveryFilter(since=BEGIN, until=BEGIN)).rows


def test_no_delivery_is_left_out_or_shown_twice_between_pages(desk: Desk) -> None:
    with desk.central.reading() as connection:
        everything = [
            (each.key, each.receiver) for each in deliveries_of(connection, DeliveryFilter()).rows
        ]
        assert len(everything) == 8
        for size in (2, 3, 5, 8):
            found: list[tuple[str, str]] = []
            last = ""
            cursor: PageCursor | None = PageCursor()
            while cursor is not None:
                page = deliveries_of(connection, DeliveryFilter(), cursor, size)
                found += [(each.key, each.receiver) for each in page.rows]
                if page.newer is not None:
                    back = deliveries_of(connection, DeliveryFilter(), page.newer, size)
                    assert back.rows[-1].key == last
                last, cursor = page.rows[-1].key, page.older
            assert found == everything


def test_the_oldest_open_run_of_a_receiver(desk: Desk) -> None:
    first = desk.end("W2605002", DeliveryState.REFUSED, REASON)
    with desk.central.reading() as connection:
        erp, mes = receivers_of(connection)
        (second,) = deliveries_of(connection, DeliveryFilter("mes", serial="W2605003")).rows
    assert (erp.oldest_open_key, mes.oldest_open_key) == (first, second.key)
    assert mes.oldest_open_at == second.arrived_at
    assert mes.counts == {DeliveryState.WAITING: 3, DeliveryState.REFUSED: 1}


def test_runs_of_a_station_with_new_records_are_listed(desk: Desk) -> None:
    setup(desk.plant.url(), (), datetime.now(UTC), renewed=["line-2"])
    assert len(desk.listed(DeliveryFilter("erp", station="line-2"))) == 3


# -- the page --------------------------------------------------------------------------------------


@pytest.fixture
def pages(desk: Desk) -> Iterator[SupervisorPages]:
    with desk.plant.pages() as made:
        yield made


def page(
    pages: SupervisorPages, path: str = "/deliveries", language: str = "en", **fields: str
) -> str:
    answer = pages.answer(Question(path, fields, language=language))
    assert answer.status == 200, answer.body.decode()
    return answer.body.decode()


def test_the_page_shows_what_was_refused_why_and_how_to_send_it_again(
    desk: Desk, pages: SupervisorPages
) -> None:
    key = desk.end("W2605002", DeliveryState.REFUSED, REASON)
    whole = page(pages)
    assert '<a href="/deliveries?receiver=mes&amp;state=refused" class="bad-text">1</a>' in whole
    assert "--resend" not in whole, "it would send everything again"
    refused = page(pages, receiver="mes", state="refused", **{"from": "2026-01-01"})
    assert key in refused
    assert "HTTP 422: no such part &lt;b&gt;" in refused
    assert "W2605003" not in refused
    (command,) = [
        line.removeprefix('<pre class="screen">').removesuffix("</pre>")
        for line in refused.splitlines()
        if "--resend" in line
    ]
    words = shlex.split(command)
    since = words.pop(words.index("--since") + 1)
    assert datetime.fromisoformat(since) == datetime(2026, 1, 1).astimezone()
    assert words == [
        "flasher", "plant", "deliveries", "--resend", "--receiver", "mes", "--state", "refused",
        "--since", "--database",
        f"postgresql://USER@127.0.0.1:{desk.plant.server.port}/{desk.plant.database}",
    ]  # fmt: skip
    for language in ("de", "zh"):
        page(pages, language=language, state="refused")


def test_a_unit_and_a_run_lead_to_their_deliveries(pages: SupervisorPages) -> None:
    unit = page(pages, "/units", serial="W2605003", part="BAT-36")
    assert '<a href="/deliveries?serial=W2605003">its deliveries</a>' in unit
    (link,) = [line for line in unit.splitlines() if "deliveries of this run" in line]
    run = link.partition("run=")[2].partition('"')[0]
    shown = page(pages, run=run)
    assert shown.count("W2605003</a>") == 2, "one to each receiver"
    assert "W2605002" not in shown
    assert "--key" in shown


@pytest.mark.parametrize(
    "fields",
    [{"state": "lost"}, {"from": "soon"}, {"key": "W2605002"}],
    ids=lambda each: next(iter(each)),
)
def test_a_wrong_field_is_explained(pages: SupervisorPages, fields: dict[str, str]) -> None:
    assert pages.answer(Question("/deliveries", fields)).status == 400


def test_without_a_receiver_there_is_nothing_to_filter(plant: Plant) -> None:
    with plant.connect() as owner:  # as `init` leaves it without the extra `handover`
        owner.execute("DROP TABLE procrastinate_jobs CASCADE")
    with plant.pages() as pages:
        shown = page(pages, serial="W2605002")
    assert "There is no receiver" in shown
    assert "<form" not in shown
