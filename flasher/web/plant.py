"""Supervisor pages of a plant: a station's pages over all stations, stations, deliveries."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy.engine import URL

from flasher.errors import UsageError
from flasher.i18n import text
from flasher.plant.alerts import CheckState, StationOverview, alerts, lasting, overviews
from flasher.plant.bounds import USUAL_BOUNDS, Bounds
from flasher.plant.deliveries import DeliveryState
from flasher.plant.delivery_list import Delivery, DeliveryFilter, deliveries_of, receivers_of
from flasher.station.records.overview import PAGE_SIZE, Page
from flasher.web.query_processes import Answer, Question
from flasher.web.supervisor import CHECK, PAGES, SupervisorPages, cursor_of, id_in, moment_in

STATIONS: Final = "/stations"
"""Path of the page of all stations."""
DELIVERIES: Final = "/deliveries"
"""Path of the page of runs that are handed over to the plant's systems."""
_STATES: Final = {
    CheckState.OK: ("good", text("in order")),
    CheckState.UNKNOWN: ("neutral", text("not known")),
    CheckState.ALERT: ("bad", text("alert")),
}
"""Class and word of a state."""
_DELIVERY_STATES: Final = {
    DeliveryState.WAITING: ("neutral", text("waiting")),
    DeliveryState.SENT: ("neutral", text("being sent")),
    DeliveryState.UNKNOWN: ("warning", text("unknown")),
    DeliveryState.REFUSED: ("bad", text("refused")),
    DeliveryState.CONFIRMED: ("good", text("confirmed")),
}
"""Class and word of a state."""


@dataclass(frozen=True)
class PlantPages(SupervisorPages):
    """Renders the pages of a plant."""

    bounds: Bounds = USUAL_BOUNDS

    @staticmethod
    def routes() -> Mapping[str, Callable[[Any, Question], Answer]]:
        return PLANT_PAGES

    @property
    def names(self) -> Mapping[str, str]:
        usual = {path: name for path, name in super().names.items() if path != CHECK}
        return {STATIONS: text("Stations"), **usual, DELIVERIES: text("Deliveries")}

    def stations(self, question: Question) -> Answer:
        """All stations with their checks; those with alerts first."""
        with self.store.database.reading() as connection:
            found = overviews(connection, self.bounds, self.shifts, self.now())
        return self._page(
            question,
            "stations.html",
            stations=sorted(found, key=_urgency),
            alerts=list(alerts(found)),
            states=_STATES,
            lasting=lasting,
            problem_of=lambda each, kind: next(
                check for check in each.checks if check.kind.value == kind
            ),
        )

    def deliveries(self, question: Question) -> Answer:
        """What became of the runs that are handed over to the plant's systems."""
        chosen = _chosen(question)
        page: Page[Delivery] = Page((), None, None)
        with self.store.database.reading() as connection:
            receivers = receivers_of(connection)
            if receivers:  # else there may be no queue to read
                page = deliveries_of(connection, chosen, cursor_of(question), PAGE_SIZE)
        return self._page(
            question,
            "deliveries.html",
            receivers=receivers,
            page=page,
            stations=self.store.read.stations(),
            states=_DELIVERY_STATES,
            command=self._resend(chosen, page) if page.rows and chosen != DeliveryFilter() else "",
        )

    def _resend(self, chosen: DeliveryFilter, page: Page[Delivery]) -> str:
        """The command that sends the deliveries of a filter again."""
        url = self.store.database.location.url
        options = {
            "--receiver": chosen.receiver,
            "--state": chosen.state,
            "--station": chosen.station,
            "--serial": chosen.serial,
            "--key": chosen.key if chosen.run_id is None else page.rows[0].key,
            "--since": chosen.since and chosen.since.isoformat(),
            "--until": chosen.until and chosen.until.isoformat(),
            "--database": URL.create(
                "postgresql", "USER", host=url.host, port=url.port, database=url.database
            ).render_as_string(),
        }
        words = [word for name, value in options.items() if value for word in (name, value)]
        return shlex.join(["flasher", "plant", "deliveries", "--resend", *words])


def _chosen(question: Question) -> DeliveryFilter:
    """Parse the filter of a form. Raises UsageError for an invalid time or state."""
    fields = question.fields
    state = fields.get("state")
    if state is not None and state not in set(DeliveryState):
        raise UsageError("There is no such state.", remedy="Choose one of the form.")
    return DeliveryFilter(
        receiver=fields.get("receiver"),
        state=None if state is None else DeliveryState(state),
        station=fields.get("station"),
        serial=fields.get("serial"),
        key=fields.get("key"),
        run_id=id_in(question, "run"),
        since=moment_in(question, "from"),
        until=moment_in(question, "to"),
    )


def _urgency(each: StationOverview) -> tuple[int, str]:
    return -[*CheckState].index(each.state), each.status.station


PLANT_PAGES: Final[Mapping[str, Callable[[Any, Question], Answer]]] = {
    **PAGES,
    STATIONS: PlantPages.stations,
    DELIVERIES: PlantPages.deliveries,
}
"""Methods by route."""
